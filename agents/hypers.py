"""Hyperparameters: one frozen dataclass an algorithm, with the range of each value. Torch-free.

A hyperparameter is *stacked* when every agent of a population may have its own value (a tensor [P]), and *shared* when it
shapes the tensor program, so that only agents with equal values can be trained in lock-step.

Symbols (thesis, chapter 5): `critic_step_size` α_critic, `actor_step_size_scale` κ = α_actor / α_critic, `entropy_scale` τ,
`polyak` β (the weight of the online network), `elite_fraction` ρ, `num_action_samples` N.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

_LARGEST_INT, _LARGEST_WIDTH = 2**31 - 1, 65_536
_LARGEST_FLOAT, _SMALLEST_FLOAT = 3.4e38, 1.2e-38  # of single precision

ActionKind = Literal["continuous", "discrete"]


class HyperparameterError(ValueError):
    """A hyperparameter is unknown, out of range or of the wrong type."""


@dataclass(frozen=True)
class Hyper:
    """What is known of one hyperparameter beside its name.

    `minimum` is inclusive unless `positive`; `choices` lists the valid strings; `shared` and `actions` as above:
    `actions` names the one kind of action space that the hyperparameter applies to (None: both). One that `came_later` than
    results that exist is left out of a trial's name while it has its default, which must never change then.
    """

    type: Literal["float", "int", "choice", "widths", "any"]
    meaning: str
    minimum: float | None = None
    maximum: float | None = None
    positive: bool = False
    choices: tuple[str, ...] = ()
    shared: bool = False
    actions: ActionKind | None = None
    came_later: bool = False

    def check(self, value: Any) -> Any:
        """Return `value` in its canonical type; raise HyperparameterError with the valid values."""
        if self.type == "choice":
            if value not in self.choices:
                raise HyperparameterError(f"must be one of {', '.join(map(repr, self.choices))}")
            return value
        if self.type == "any":
            return _plain(value)
        if self.type == "widths":
            widths = tuple(value) if isinstance(value, list | tuple) else ()
            if not widths or not all(type(width) is int and 0 < width <= _LARGEST_WIDTH for width in widths):
                raise HyperparameterError("must be a list of layer widths, such as [64, 64]")
            return widths
        return self._check_number(value)

    def _check_number(self, value: Any) -> float | int:
        if type(value) not in (int, float):
            raise HyperparameterError("must be a whole number" if self.type == "int" else "must be a number")
        if isinstance(value, float) and not math.isfinite(value):
            raise HyperparameterError("must be finite")
        if self.type == "int" and value != int(value):
            raise HyperparameterError("must be a whole number")
        if abs(value) > (_LARGEST_INT if self.type == "int" else _LARGEST_FLOAT):
            raise HyperparameterError("is too large")
        if 0 < abs(value) < _SMALLEST_FLOAT:
            raise HyperparameterError("is too small: single precision takes it for 0")
        number = int(value) if self.type == "int" else float(value) + 0.0  # −0.0 becomes 0.0
        if self.positive and number <= 0:
            raise HyperparameterError("must be greater than 0")
        if self.minimum is not None and number < self.minimum:
            raise HyperparameterError(f"must be at least {self.minimum:g}")
        if self.maximum is not None and number > self.maximum:
            raise HyperparameterError(f"must be at most {self.maximum:g}")
        return number


def _plain(value: Any) -> Any:
    """Return a plain value, lists as tuples. Lists hold values of one type, so that they fit into a column."""
    if isinstance(value, list | tuple):
        items = tuple(_plain(item) for item in value)
        if len({type(item) for item in items}) <= 1 and not any(isinstance(item, tuple) for item in items):
            return items
    elif type(value) in (bool, str) or (type(value) is int and abs(value) < 2**63):
        return value
    elif type(value) is float and math.isfinite(value):
        return value + 0.0
    raise HyperparameterError("must be a finite number, a text, true or false, or a list of one kind of these")


def hyper(default: Any, type: Any, meaning: str, **known: Any) -> Any:
    """Declare a hyperparameter as a field of a `Hypers` dataclass; the keywords are those of `Hyper`."""
    return dataclasses.field(default=default, metadata={"hyper": Hyper(type, meaning, **known)})


@dataclass(frozen=True, kw_only=True)
class Hypers:
    """Base of every algorithm's hyperparameters; construction checks each value (HyperparameterError)."""

    table: ClassVar[Mapping[str, Hyper]] = {}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        declared = {name: field.metadata["hyper"] for name, field in vars(cls).items() if isinstance(field, dataclasses.Field)}
        cls.table = {**cls.table, **declared}

    def __post_init__(self) -> None:
        for name, hyper in self.table.items():
            try:
                object.__setattr__(self, name, hyper.check(getattr(self, name)))
            except HyperparameterError as error:
                raise HyperparameterError(f"{name} = {getattr(self, name)!r}: {error}") from None
        for problem in self.problems():
            raise HyperparameterError(problem)

    def problems(self) -> list[str]:
        """Rules that concern several hyperparameters at once: a message for each that is broken."""
        return []

    def as_dict(self) -> dict[str, Any]:
        """Return name → value in the order of declaration."""
        return {name: getattr(self, name) for name in self.table}

    def applicable(self, actions: ActionKind) -> dict[str, Any]:
        """Return name → value of the hyperparameters that the algorithm uses with this kind of action space."""
        return {name: getattr(self, name) for name, hyper in self.table.items() if hyper.actions in (None, actions)}

    def identity(self, actions: ActionKind) -> dict[str, Any]:
        """Return what of `applicable` is part of a trial's name."""
        fields = type(self).__dataclass_fields__
        return {
            name: value
            for name, value in self.applicable(actions).items()
            if not (self.table[name].came_later and value == fields[name].default)
        }

    def shared(self) -> tuple[tuple[str, Any], ...]:
        """Return the values that must be equal for agents to be trained in one population."""
        return tuple((name, getattr(self, name)) for name, hyper in self.table.items() if hyper.shared)


_ENTROPY_SCALE = "τ, weight of the entropy (GreedyAC: of the proposal policy's)"
_ENTROPY_GRADIENT = (
    "estimate of the entropy's gradient: the thesis' formula, the Gaussian's closed form, or as the published code has it"
)
_ENTROPY_GRADIENTS = ("sampled", "analytic", "score")


@dataclass(frozen=True, kw_only=True)
class ActorCriticHypers(Hypers):
    """What every actor-critic algorithm of the thesis has; defaults as in chapter 5."""

    critic_step_size: float = hyper(1e-3, "float", "α_critic, Adam's step-size of the critic", positive=True)
    actor_step_size_scale: float = hyper(1.0, "float", "κ, actor step-size ÷ critic step-size", positive=True)
    polyak: float = hyper(0.01, "float", "β, weight of the online network in the target network", positive=True, maximum=1)
    batch_size: int = hyper(32, "int", "transitions an update; the first update is at this step", minimum=1, shared=True)
    replay_capacity: int = hyper(100_000, "int", "transitions that the replay buffer holds", minimum=1, shared=True)
    hidden_layers: tuple[int, ...] = hyper((64, 64), "widths", "widths of the hidden layers of every network", shared=True)
    discrete_critic_input: str = hyper(
        "index",
        "choice",
        "how a discrete action enters the critic",
        choices=("index", "one-hot"),
        shared=True,
        actions="discrete",
    )

    def problems(self) -> list[str]:
        if self.replay_capacity < self.batch_size:
            return [f"replay_capacity = {self.replay_capacity}: must be at least batch_size = {self.batch_size}"]
        return []

    @property
    def actor_step_size(self) -> float:
        """α_actor = κ · α_critic."""
        return self.actor_step_size_scale * self.critic_step_size


@dataclass(frozen=True, kw_only=True)
class SACHypers(ActorCriticHypers):
    """Soft Actor-Critic (thesis Algorithm 1)."""

    entropy_scale: float = hyper(1e-2, "float", _ENTROPY_SCALE, minimum=0)
    entropy_tuning: str = hyper(
        "fixed",
        "choice",
        "whether τ stays as it is or is learned from there",
        choices=("fixed", "automatic"),
        shared=True,
        came_later=True,
    )


@dataclass(frozen=True, kw_only=True)
class SACOriginalHypers(ActorCriticHypers):
    """Soft Actor-Critic as first published (thesis Algorithm 2); `critic_step_size` is α_action."""

    entropy_scale: float = hyper(1e-2, "float", _ENTROPY_SCALE, minimum=0)
    state_value_step_size: float = hyper(1e-3, "float", "α_state, Adam's step-size of the state-value network", positive=True)


@dataclass(frozen=True, kw_only=True)
class DDPGHypers(ActorCriticHypers):
    """Deep Deterministic Policy Gradient (thesis Algorithm 4)."""

    exploration_noise: str = hyper(
        "gaussian",
        "choice",
        "process of the noise that is added to actions",
        choices=("gaussian", "ornstein-uhlenbeck"),
        shared=True,
    )
    exploration_scale: float = hyper(0.1, "float", "σ, standard deviation of the noise ÷ half the action range", minimum=0)


@dataclass(frozen=True, kw_only=True)
class VanillaACHypers(ActorCriticHypers):
    """Vanilla Actor-Critic (thesis Algorithm 3)."""

    entropy_scale: float = hyper(1e-2, "float", _ENTROPY_SCALE, minimum=0)
    num_action_samples: int = hyper(
        30,
        "int",
        "N, actions drawn in each state (GreedyAC: from the proposal policy)",
        minimum=3,
        shared=True,
        actions="continuous",
    )
    entropy_gradient: str = hyper(
        "sampled", "choice", _ENTROPY_GRADIENT, choices=_ENTROPY_GRADIENTS, shared=True, actions="continuous"
    )


@dataclass(frozen=True, kw_only=True)
class GreedyACHypers(ActorCriticHypers):
    """Greedy Actor-Critic (thesis Algorithm 7, with the conditional cross-entropy method, Algorithm 6)."""

    entropy_scale: float = hyper(1e-2, "float", _ENTROPY_SCALE, minimum=0, actions="continuous")
    num_action_samples: int = hyper(
        30,
        "int",
        "N, actions drawn in each state (GreedyAC: from the proposal policy)",
        minimum=1,
        shared=True,
        actions="continuous",
    )
    elite_fraction: float = hyper(
        0.1, "float", "ρ, share of the N actions that are elites", positive=True, maximum=1, shared=True, actions="continuous"
    )
    elite_reduction: str = hyper(
        "mean",
        "choice",
        "how the elites' log-likelihoods are reduced",
        choices=("mean", "sum"),
        shared=True,
        actions="continuous",
        came_later=True,
    )
    entropy_gradient: str = hyper(
        "sampled", "choice", _ENTROPY_GRADIENT, choices=_ENTROPY_GRADIENTS, shared=True, actions="continuous"
    )

    @property
    def num_elites(self) -> int:
        """round(ρN): 3 of 30 in the thesis."""
        return round(self.elite_fraction * self.num_action_samples)

    def problems(self) -> list[str]:
        problems = super().problems()
        if self.num_elites < 1:
            problems.append(
                f"elite_fraction = {self.elite_fraction:g}: with num_action_samples = {self.num_action_samples} "
                "no action is elite (round(ρN) = 0)"
            )
        return problems


class _EveryName(Mapping[str, Hyper]):
    """A table that knows every name."""

    def __getitem__(self, name: str) -> Hyper:
        return Hyper("any", "whatever the function takes")

    def __iter__(self) -> Iterator[str]:
        return iter(())

    def __len__(self) -> int:
        return 0

    def __contains__(self, name: object) -> bool:
        return True


class FreeHypers(Hypers):
    """The hyperparameters of a function that declares none: any names, any plain values."""

    def __init_subclass__(cls) -> None:
        """Keep the table."""

    def __init__(self, **values: Any) -> None:
        object.__setattr__(self, "values", {name: self.table[name].check(value) for name, value in sorted(values.items())})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FreeHypers) and self.as_dict() == other.as_dict()

    def __hash__(self) -> int:
        return hash(tuple(self.as_dict().items()))

    def as_dict(self) -> dict[str, Any]:
        """Return name → value in alphabetical order."""
        values: dict[str, Any] = self.values  # type: ignore[attr-defined]
        return values

    def applicable(self, actions: ActionKind) -> dict[str, Any]:
        """Return all values: what the function does with them is its own affair."""
        return self.as_dict()

    def identity(self, actions: ActionKind) -> dict[str, Any]:
        """Return all values."""
        return self.as_dict()

    def shared(self) -> tuple[tuple[str, Any], ...]:
        """Return all values."""
        return tuple(self.as_dict().items())


FreeHypers.table = _EveryName()
