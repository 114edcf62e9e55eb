"""Hyperparameters: one frozen dataclass an algorithm, with the range of each value. Torch-free.

A hyperparameter is *stacked* when every agent of a population may have its own value (a tensor [P]), and *shared* when it
shapes the tensor program, so that only agents with equal values can be trained in lock-step.

Symbols (thesis, chapter 5): `critic_step_size` α_critic, `actor_step_size_scale` κ = α_actor / α_critic, `entropy_scale` τ,
`polyak` β (the weight of the online network), `elite_fraction` ρ, `num_action_samples` N.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

ActionKind = Literal["continuous", "discrete"]


class HyperparameterError(ValueError):
    """A hyperparameter is unknown, out of range or of the wrong type."""


@dataclass(frozen=True)
class Hyper:
    """What is known of one hyperparameter beside its name.

    `minimum` is inclusive unless `positive`; `choices` lists the valid strings; `shared` and `actions` as above:
    `actions` names the one kind of action space that the hyperparameter applies to (None: both).
    """

    type: Literal["float", "int", "choice", "widths"]
    meaning: str
    minimum: float | None = None
    maximum: float | None = None
    positive: bool = False
    choices: tuple[str, ...] = ()
    shared: bool = False
    actions: ActionKind | None = None

    def check(self, value: Any) -> Any:
        """Return `value` in its canonical type; raise HyperparameterError with the valid values."""
        if self.type == "choice":
            if value not in self.choices:
                raise HyperparameterError(f"must be one of {', '.join(map(repr, self.choices))}")
            return value
        if self.type == "widths":
            widths = tuple(value) if isinstance(value, list | tuple) else ()
            if not widths or not all(type(width) is int and width > 0 for width in widths):
                raise HyperparameterError("must be a list of layer widths, such as [64, 64]")
            return widths
        return self._check_number(value)

    def _check_number(self, value: Any) -> float | int:
        if type(value) not in (int, float) or (self.type == "int" and value != int(value if math.isfinite(value) else 0)):
            raise HyperparameterError("must be a whole number" if self.type == "int" else "must be a number")
        if not math.isfinite(value):
            raise HyperparameterError("must be finite")
        number = int(value) if self.type == "int" else float(value)
        if self.positive and number <= 0:
            raise HyperparameterError("must be greater than 0")
        if self.minimum is not None and number < self.minimum:
            raise HyperparameterError(f"must be at least {self.minimum:g}")
        if self.maximum is not None and number > self.maximum:
            raise HyperparameterError(f"must be at most {self.maximum:g}")
        return number


def _hyper(default: Any, type: Any, meaning: str, **known: Any) -> Any:
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

    def shared(self) -> tuple[tuple[str, Any], ...]:
        """Return the values that must be equal for agents to be trained in one population."""
        return tuple((name, getattr(self, name)) for name, hyper in self.table.items() if hyper.shared)


@dataclass(frozen=True, kw_only=True)
class ActorCriticHypers(Hypers):
    """What every actor-critic algorithm of the thesis has; defaults as in chapter 5."""

    critic_step_size: float = _hyper(1e-3, "float", "α_critic, Adam's step-size of the critic", positive=True)
    actor_step_size_scale: float = _hyper(1.0, "float", "κ, actor step-size ÷ critic step-size", positive=True)
    polyak: float = _hyper(0.01, "float", "β, weight of the online network in the target network", positive=True, maximum=1)
    batch_size: int = _hyper(32, "int", "transitions an update; the first update is at this step", minimum=1, shared=True)
    replay_capacity: int = _hyper(100_000, "int", "transitions that the replay buffer holds", minimum=1, shared=True)
    hidden_layers: tuple[int, ...] = _hyper((64, 64), "widths", "widths of the hidden layers of every network", shared=True)

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

    entropy_scale: float = _hyper(1e-2, "float", "τ, weight of the entropy (GreedyAC: of the proposal policy's)", minimum=0)


@dataclass(frozen=True, kw_only=True)
class GreedyACHypers(ActorCriticHypers):
    """Greedy Actor-Critic (thesis Algorithm 7, with the conditional cross-entropy method, Algorithm 6)."""

    entropy_scale: float = _hyper(
        1e-2, "float", "τ, weight of the entropy (GreedyAC: of the proposal policy's)", minimum=0, actions="continuous"
    )
    num_action_samples: int = _hyper(
        30,
        "int",
        "N, actions drawn from the proposal policy in each state",
        minimum=1,
        shared=True,
        actions="continuous",
    )
    elite_fraction: float = _hyper(
        0.1,
        "float",
        "ρ, share of the N actions that are elites",
        positive=True,
        maximum=1,
        shared=True,
        actions="continuous",
    )
    entropy_gradient: str = _hyper(
        "sampled",
        "choice",
        "estimate of the entropy's gradient: the thesis' formula, the Gaussian's closed form, or as the published code has it",
        choices=("sampled", "analytic", "score"),
        shared=True,
        actions="continuous",
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
