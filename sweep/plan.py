"""A plan: what a launch would train, in how much time, memory and space. Arithmetic on what is known; it measures nothing."""

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sweep.calibration import Calibration
from sweep.disk import predicted_bytes
from sweep.shards import Group, Shard

#: A step of an evaluation episode ÷ a step of training, which learns as well.
EVALUATION_COST = 0.15
_SECONDS_PER_HOUR = 3_600


@dataclass(frozen=True)
class Basis:
    """What is taken for a group, and `how` it is known: measured now, measured before, or nominal."""

    calibration: Calibration
    how: str


@dataclass(frozen=True)
class Slots:
    """Where shards run: how many at once, how many of them on one machine, and its cores and bytes of memory (None: unknown)."""

    count: int
    on_a_machine: int
    cores: int
    available_bytes: int | None = None


@dataclass(frozen=True)
class GroupPlan:
    """What is missing of a group. `population` is its largest, and rate and memory are those of a worker that trains it."""

    group: Group
    trials: int
    agent_steps: int
    shards: int
    population: int
    agent_steps_per_second: float
    core_hours: float
    memory_bytes: int
    how: str

    def to_json(self) -> dict[str, Any]:
        """Return the plan of the group as values that JSON knows."""
        return {
            "agent": self.group.agent,
            "environment": self.group.environment,
            "shared": dict(self.group.shared),
            "trials": self.trials,
            "steps": self.agent_steps,
            "shards": self.shards,
            "population": self.population,
            "agent_steps_per_second": round(self.agent_steps_per_second, 1),
            "core_hours": round(self.core_hours, 4),
            "memory_bytes": self.memory_bytes,
            "rate": self.how,
        }


@dataclass(frozen=True)
class Plan:
    """What a launch would do. `hours` are of wall-clock time on the slots, `memory_bytes` the peak of one worker.

    `machine_memory_bytes` is what the workers of one machine may need at once, each at its peak.
    """

    study: str
    engine: str
    slots: Slots
    trials: int
    missing: int
    agent_steps: int
    shards: int
    core_hours: float
    hours: float
    bytes: int
    memory_bytes: int
    machine_memory_bytes: int
    groups: tuple[GroupPlan, ...]

    @property
    def finished(self) -> int:
        """Trials that are in the store already."""
        return self.trials - self.missing

    def to_json(self) -> dict[str, Any]:
        """Return the plan as values that JSON knows."""
        return {
            "study": self.study,
            "trials": self.trials,
            "finished": self.finished,
            "missing": self.missing,
            "steps": self.agent_steps,
            "core_hours": round(self.core_hours, 4),
            "hours": round(self.hours, 4),
            "bytes": self.bytes,
            "memory_bytes": self.memory_bytes,
            "machine_memory_bytes": self.machine_memory_bytes,
            "available_memory_bytes": self.slots.available_bytes,
            "slots": self.slots.count,
            "shards": self.shards,
            "engine": self.engine,
            "groups": [group.to_json() for group in self.groups],
        }


def plan(
    study: str,
    num_trials: int,
    shards: Sequence[Shard],
    bases: Mapping[Group, Basis],
    slots: Slots,
    engine: str,
    episode_lengths: Mapping[str, float],
    threads: int = 1,
) -> Plan:
    """Return the plan of a study of `num_trials` of which these shards are missing, in the order in which they would start."""
    again = len(shards) > slots.count  # then some worker takes a second shard, above what the first leaves loaded
    seconds = [_seconds(shard, bases[shard.group].calibration) for shard in shards]
    peaks = [bases[shard.group].calibration.peak_bytes(shard.trials[0], len(shard.trials), again) for shard in shards]
    crowded = max(1.0, slots.on_a_machine * threads / slots.cores)
    at_once = min(slots.on_a_machine, len(shards))
    groups = {group: [number for number, shard in enumerate(shards) if shard.group == group] for group in bases}
    return Plan(
        study=study,
        engine=engine,
        slots=slots,
        trials=num_trials,
        missing=sum(len(shard.trials) for shard in shards),
        agent_steps=sum(shard.agent_steps for shard in shards),
        shards=len(shards),
        core_hours=sum(seconds) * threads / _SECONDS_PER_HOUR,
        hours=makespan(seconds, slots.count) * crowded / _SECONDS_PER_HOUR,
        bytes=predicted_bytes(shards, episode_lengths),
        memory_bytes=max(peaks, default=0),
        machine_memory_bytes=sum(heapq.nlargest(at_once, peaks)),
        groups=tuple(
            _group_plan(
                group, bases[group], [shards[i] for i in own], [seconds[i] for i in own], [peaks[i] for i in own], threads
            )
            for group, own in groups.items()
        ),
    )


def _group_plan(
    group: Group, basis: Basis, shards: list[Shard], seconds: list[float], peaks: list[int], threads: int
) -> GroupPlan:
    population = max(len(shard.trials) for shard in shards)
    return GroupPlan(
        group=group,
        trials=sum(len(shard.trials) for shard in shards),
        agent_steps=sum(shard.agent_steps for shard in shards),
        shards=len(shards),
        population=population,
        agent_steps_per_second=basis.calibration.rate(population),
        core_hours=sum(seconds) * threads / _SECONDS_PER_HOUR,
        memory_bytes=max(peaks),
        how=basis.how,
    )


def _seconds(shard: Shard, calibration: Calibration) -> float:
    trial = shard.trials[0]
    work = float(shard.agent_steps)
    if trial.evaluation is not None:
        every, episodes = trial.evaluation
        work += EVALUATION_COST * len(shard.trials) * (trial.steps // every) * episodes * trial.cutoff
    return work / calibration.rate(len(shard.trials))


def makespan(seconds: Sequence[float], slots: int) -> float:
    """Return when the last of some jobs ends, if each starts in their order as soon as one of the slots is free."""
    free = [0.0] * slots
    for duration in seconds:
        heapq.heapreplace(free, free[0] + duration)
    return max(free)
