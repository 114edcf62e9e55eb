"""Shards: trials that can share one tensor program, as units of work.

Who shares a shard changes no number, so shards are made anew from whatever is missing.
"""

import hashlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from agents.registry import find_algorithm
from sweep.trials import Trial

#: A population of 16 reaches most of what a core gives; one much larger than 64 no longer fits into its cache.
MIN_POPULATION, MAX_POPULATION = 16, 64
#: Measured with two hidden layers of 64 on one core: 2,200 (GreedyAC) to 3,900 (SAC) agent-steps a second.
NOMINAL_AGENT_STEPS_PER_SECOND = 2_500
TARGET_SECONDS = 600
SHARDS_PER_SLOT = 3


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


def pack(trials: Sequence[Trial], slots: int) -> list[Shard]:
    """Return shards of the trials for `slots` workers, the largest first.

    A shard is small enough to take about TARGET_SECONDS, and for every slot to have SHARDS_PER_SLOT of them, but not
    smaller than MIN_POPULATION unless slots would stay empty. Seeds of a setting lie side by side.
    """
    groups: dict[tuple[Any, ...], list[Trial]] = {}
    for trial in trials:
        key = (trial.agent, trial.environment, trial.steps, trial.cutoff, trial.discount, trial.evaluation, trial.hypers.shared())
        groups.setdefault(key, []).append(trial)
    shards = []
    for group in groups.values():
        alone = find_algorithm(group[0].agent).one_trial
        size = 1 if alone else _population(len(trials), group[0].steps, slots)
        count = math.ceil(len(group) / size)
        bounds = [round(i * len(group) / count) for i in range(count + 1)]
        shards += [Shard(tuple(group[a:b])) for a, b in itertools.pairwise(bounds)]
    return sorted(shards, key=lambda shard: -shard.agent_steps)


def _population(num_trials: int, steps: int, slots: int) -> int:
    by_time = min(MAX_POPULATION, max(MIN_POPULATION, TARGET_SECONDS * NOMINAL_AGENT_STEPS_PER_SECOND // steps))
    by_balance = max(MIN_POPULATION, math.ceil(num_trials / (slots * SHARDS_PER_SLOT)))
    return min(by_time, by_balance, math.ceil(num_trials / slots))
