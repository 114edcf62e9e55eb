"""Shards: trials that can share one tensor program, as units of work.

Who shares a shard changes no number, so shards are made anew from whatever is missing, in whatever sizes are fast here.
"""

import hashlib
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from agents.registry import find_algorithm
from sweep.trials import Trial

#: Where nothing was measured: near the best on every machine tried, and small enough for any replay buffer of the thesis' size.
DEFAULT_POPULATION = 64
#: A population of 16 reaches most of what a core gives: smaller ones only keep slots busy, or fit into memory.
MIN_POPULATION = 16
#: Between GreedyAC with three hidden layers (3,600 to 4,900) and discrete actions (up to 10,000), native kernels, one core.
NOMINAL_AGENT_STEPS_PER_SECOND = 4_000
TARGET_SECONDS = 1_800
SHARDS_PER_SLOT = 3
#: A function's trials are trained one after another, nobody knows how long: few enough a shard that the last ones do not drag on.
FUNCTION_TRIALS = 32
_FUNCTION_SHARDS_PER_SLOT = 16
_ROUNDING = 1e-9


class Group(NamedTuple):
    """What trials have in common that train at the same speed: agent, environment, shared hyperparameters."""

    agent: str
    environment: str
    shared: tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class Size:
    """What bounds a group's populations: the most agents, and how fast a worker trains so many, in agent-steps a second."""

    population: int = DEFAULT_POPULATION
    agent_steps_per_second: float = NOMINAL_AGENT_STEPS_PER_SECOND


@dataclass(frozen=True)
class Shard:
    """Trials that are trained together: equal in all but seed and stacked hyperparameters."""

    trials: tuple[Trial, ...]

    @cached_property
    def id(self) -> str:
        """16 hexadecimal digits for the set of trials."""
        return hashlib.sha256("".join(sorted(trial.id for trial in self.trials)).encode()).hexdigest()[:16]

    @property
    def agent_steps(self) -> int:
        """Environment steps over all trials."""
        return sum(trial.steps for trial in self.trials)

    @property
    def group(self) -> Group:
        """The group that all of the trials belong to."""
        return group_of(self.trials[0])


def group_of(trial: Trial) -> Group:
    """Return the group of a trial. A function's trials are one group: they are trained one after another."""
    shared = () if find_algorithm(trial.agent).one_trial else trial.hypers.shared()
    return Group(trial.agent, trial.environment, shared)


def _key(trial: Trial) -> tuple[Any, ...]:
    return (group_of(trial), trial.steps, trial.cutoff, trial.discount, trial.evaluation)


def can_share(trials: Iterable[Trial]) -> bool:
    """Return whether trials can be trained together."""
    return len({_key(trial) for trial in trials}) == 1


def name_of(group: Group, among: Iterable[Group]) -> str:
    """Return what a user calls a group: with the shared hyperparameters by which it differs from others of the same name."""
    alike = [dict(other.shared) for other in among if other[:2] == group[:2]]
    differing = [f"{name} {_shown(value)}" for name, value in group.shared if any(other.get(name) != value for other in alike)]
    return ", ".join([f"{group.agent} on {group.environment}", *differing])


def _shown(value: object) -> str:
    return str(list(value)) if isinstance(value, tuple) else str(value)


def pack(trials: Sequence[Trial], slots: int, sizes: Mapping[Group, Size] | None = None) -> list[Shard]:
    """Return shards of the trials for `slots` workers, those that take the longest first.

    A shard has at most as many trials as its group's size says (`Size()` where there is none). It is small enough to take about
    TARGET_SECONDS, and for every slot to have SHARDS_PER_SLOT of them, or fewer, but as many as the others, when they would be
    smaller than MIN_POPULATION. Only where slots would stay empty otherwise are shards smaller than that. Seeds of a setting lie
    side by side.
    """
    known = sizes or {}
    together: dict[tuple[Any, ...], list[Trial]] = {}
    for trial in trials:
        together.setdefault(_key(trial), []).append(trial)
    shards = []
    for (group, steps, *_), members in together.items():
        if find_algorithm(group.agent).one_trial:
            size = max(1.0, min(FUNCTION_TRIALS, len(members) / (slots * _FUNCTION_SHARDS_PER_SLOT)))
        else:
            size = _population(len(trials), steps, slots, known.get(group, Size()))
        count = math.ceil(len(members) / size - _ROUNDING)
        bounds = [round(i * len(members) / count) for i in range(count + 1)]
        shards += [Shard(tuple(members[a:b])) for a, b in itertools.pairwise(bounds)]
    return sorted(shards, key=lambda shard: -shard.agent_steps / known.get(shard.group, Size()).agent_steps_per_second)


def _population(num_trials: int, steps: int, slots: int, size: Size) -> float:
    """Return how many trials a shard has in the mean: not a whole number, so that there are as many shards as slots want."""
    by_time = max(MIN_POPULATION, int(TARGET_SECONDS * size.agent_steps_per_second // steps))
    shards_per_slot = max(1, min(SHARDS_PER_SLOT, num_trials // (slots * MIN_POPULATION)))
    return max(1.0, min(size.population, by_time, num_trials / (slots * shards_per_slot)))
