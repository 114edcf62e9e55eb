"""Which groups of trials are worth a pilot, and the pilots: as many at once as the machine will have shards at once.

Workers that train side by side share caches and memory bandwidth; a pilot alone would promise too much.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from agents.registry import find_algorithm
from cluster import calibration_cache
from cluster.executor import Executor
from cluster.machine import Machine, this_machine
from cluster.pilot import Pilot, Reading, footprint, run_pilot
from cluster.worker import Training
from sweep.calibration import MEMORY_SHARE, Calibration, memory_budget
from sweep.shards import NOMINAL_AGENT_STEPS_PER_SECOND, Group, Shard, Size, group_of, name_of
from sweep.trials import Trial

#: Work that keeps the slots busy for less than this, at a nominal rate, is not worth a pilot.
WORTH_SECONDS = 300.0
_SIZES = (16, 32, 64, 128, 256)
_SIZES_ON_GPU = (64, 256, 1_024, 4_096)  # a lock-step takes a GPU about as long for one agent as for hundreds
_LONGEST_SECONDS = 3.0
_ROUNDS = 2  # the better of two: whatever else the machine does for a moment must not decide


@dataclass(frozen=True)
class Calibrated:
    """What is known of a group, and `how`, for the user to read; None when its pilot failed."""

    calibration: Calibration | None
    how: str


@dataclass(frozen=True)
class Calibrations:
    """What is known of the groups, and of the machine that the most shards run on at once: `workers` of them."""

    groups: Mapping[Group, Calibrated]
    machine: Machine | None = None
    workers: int = 1

    def sizes(self, trials: Sequence[Trial]) -> dict[Group, Size]:
        """Return the sizes of the populations of those groups that something is known of."""
        budget = memory_budget(self.machine.available_bytes if self.machine else None, self.workers)
        return {
            group: known.calibration.size(members, budget)
            for group, members in by_group(trials).items()
            if (known := self.groups.get(group)) is not None and known.calibration is not None
        }


def by_group(trials: Iterable[Trial]) -> dict[Group, list[Trial]]:
    """Return the trials of each group, in the order in which they come."""
    groups: dict[Group, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(group_of(trial), []).append(trial)
    return groups


def _say_nothing(_text: str) -> None:
    pass


def calibrate(
    trials: Sequence[Trial],
    executor: Executor,
    training: Training,
    *,
    whatever_the_size: bool = False,
    say: Callable[[str], None] = _say_nothing,
) -> Calibrations:
    """Return what is known of the groups of these trials, measured now where it is worth that, else measured before.

    A group is worth a pilot when its trials would keep the executor's slots busy for WORTH_SECONDS, or `whatever_the_size`.
    Functions are not: they train one trial at a time. What a pilot's own code raises is no error here, training will report it.
    `say` is told what is being measured.
    """
    groups = {group: members for group, members in by_group(trials).items() if not find_algorithm(group.agent).one_trial}
    worth = {group for group, members in groups.items() if whatever_the_size or _seconds(members, executor) > WORTH_SECONDS}
    if not groups or not (worth or calibration_cache.is_there()):
        return Calibrations({})
    (machine,) = executor.gather(this_machine, training.device, 1)
    at_once = min(executor.slots_on_a_machine, len(trials))
    workers = min(at_once, machine.cores)
    found: dict[Group, Calibrated] = {}
    measured: dict[str, Calibration] = {}
    for group, members in groups.items():
        key = calibration_cache.key(group, machine, executor.name, workers, training)
        known = calibration_cache.load(key)
        if known is not None:
            found[group] = Calibrated(known, "measured before")
        elif group in worth:
            say(f"measuring {name_of(group, groups)}, {list(groups).index(group) + 1} of {len(groups)}")
            try:
                known = measured[key] = _measure(members[0], executor, training, machine, workers)
                found[group] = Calibrated(known, f"measured in {known.seconds:.0f} s")
            except Exception as error:  # whatever the user's agent or environment does
                found[group] = Calibrated(None, f"the pilot failed: {_said(error)}")
    calibration_cache.save(measured)
    return Calibrations(found, machine, at_once)


def _seconds(trials: Sequence[Trial], executor: Executor) -> float:
    return sum(trial.steps for trial in trials) / (NOMINAL_AGENT_STEPS_PER_SECOND * executor.slots)


def pilot_of(trial: Trial, training: Training) -> Pilot:
    """Return a pilot for the group of a trial, its smallest."""
    size = _SIZES[0]
    return Pilot(
        trial.agent,
        trial.environment,
        trial.hypers,
        trial.cutoff,
        trial.discount,
        size,
        training.device,
        training.threads,
        training.tf32,
    )


class _TooSlowError(Exception):
    """Not even the smallest population came to learn anything in the time that a pilot has."""


def _measure(trial: Trial, executor: Executor, training: Training, machine: Machine, workers: int) -> Calibration:
    begun = time.monotonic()
    pilot = pilot_of(trial, training)
    executor.gather(run_pilot, pilot, workers)  # imports, and whatever else only the first training in a process takes
    (takes,) = executor.gather(footprint, pilot, 1)
    known = Calibration({}, 0, 0, takes.row_bytes, takes.commit_bytes)
    on_gpu = takes.commit_bytes == 0
    sizes = _SIZES_ON_GPU if on_gpu else _SIZES
    took: dict[int, float] = {}
    for size in sizes * _ROUNDS:
        if took and not (_is_quick(took, size) and _fits(known, size, machine, workers)):
            continue
        started = time.monotonic()
        readings = executor.gather(run_pilot, replace(pilot, population=size), workers)
        took[size] = time.monotonic() - started
        rate = _mean_rate(readings)
        if rate is None:
            break
        base = max(reading.base_bytes for reading in readings)
        replay = max(reading.replay_rows for reading in readings) * size * takes.row_bytes
        added = max(reading.peak_bytes - reading.base_bytes for reading in readings) - replay
        rates = {**known.rates, size: max(rate, known.rates.get(size, 0.0))}
        known = replace(known, rates=rates, base_bytes=base, agent_bytes=max(0, added // size))
    if not known.rates:
        raise _TooSlowError("it was too slow to be measured")
    return replace(known, seconds=time.monotonic() - begun)


def _is_quick(took: Mapping[int, float], size: int) -> bool:
    """Whether a pilot of this size can be expected to take no longer than _LONGEST_SECONDS, environments being made included."""
    largest = max(took)
    return took.get(size, took[largest] * max(1.0, size / largest)) <= _LONGEST_SECONDS


def _fits(known: Calibration, size: int, machine: Machine, workers: int) -> bool:
    room = memory_budget(machine.available_bytes, workers)
    return room is None or known.base_bytes + size * known.agent_bytes <= room


def _mean_rate(readings: Sequence[Reading]) -> float | None:
    rates = [reading.agent_steps_per_second for reading in readings]
    found = [rate for rate in rates if rate is not None]
    return sum(found) / len(found) if len(found) == len(rates) else None


def _said(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[-1] if lines else type(error).__name__


def reports(calibrations: Calibrations, shards: Sequence[Shard]) -> list[str]:
    """Return a line for each group that something is said of: its populations, their speed, how that is known."""
    lines = []
    for group, known in calibrations.groups.items():
        largest = max((len(shard.trials) for shard in shards if shard.group == group), default=0)
        populations = f"{name_of(group, calibrations.groups)}: populations of {largest:,}"
        if known.calibration is None:
            lines.append(f"{populations}, not measured ({known.how})")
            continue
        lines.append(f"{populations}, {known.calibration.rate(largest):,.0f} agent-steps/s a worker ({known.how})")
        lines += _warnings(known.calibration, calibrations, [shard for shard in shards if shard.group == group])
    return lines


def _warnings(known: Calibration, calibrations: Calibrations, shards: Sequence[Shard]) -> list[str]:
    available = calibrations.machine.available_bytes if calibrations.machine else None
    peak = max((known.peak_bytes(shard.trials[0], len(shard.trials)) for shard in shards), default=0) * calibrations.workers
    if available is None or peak <= MEMORY_SHARE * available:
        return []
    return [f"  that may need {peak / 2**30:.1f} GB of memory, and {available / 2**30:.1f} GB are available: take fewer workers"]
