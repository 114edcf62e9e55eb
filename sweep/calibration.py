"""What one machine can do with a group of trials: how fast populations train there, and how much memory they take.

Measured by `cluster.calibration`, where shards run; here is what follows from the numbers.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from agents.registry import find_algorithm
from sweep.shards import DEFAULT_POPULATION, NOMINAL_AGENT_STEPS_PER_SECOND, Size
from sweep.trials import Trial

#: The smallest population that is within this share of the fastest is chosen, as it needs less memory. A larger share would be a
#: loss of speed for nothing: memory is bounded, and slots are kept busy, by rules of their own.
TOLERANCE = 0.01
#: Of the memory that is available, what the shards that run at once may take.
MEMORY_SHARE = 0.8
#: What a worker adds when it first commits rows: pyarrow's code and pools, which then stay. Measured: 52 to 60 MB.
COMMIT_BYTES = 58 * 2**20
_RECORDED_STEPS, _RECORDED_BYTES = 4_096, 10  # agents.records: a reward, an ending and a flag, a block of steps at a time
_EPISODE_BYTES = 150  # a row of the records, and its copies when they are put in order
_RECORDER_BYTES = 30_000  # of an agent, as it grows: arrays of a few episodes each
# A plain function is as fast as a single agent in plain PyTorch; a worker that trains takes this much.
_NOMINAL_FUNCTION, _NOMINAL_BASE, _NOMINAL_AGENT = 250, 280 * 2**20, 2**19


@dataclass(frozen=True)
class Calibration:
    """Speed and memory of a group's populations in one worker, while as many others train as the machine has slots for.

    `rates`: agent-steps a second of a worker, by the size of its population. Bytes: `base_bytes` of a worker that trains
    nothing yet but has everything loaded, `agent_bytes` for each agent, `row_bytes` for each transition in its replay,
    `commit_bytes` for writing rows down. They are of the processor's memory, or the GPU's where the replay lies there.
    `seconds` is how long the measurement took.
    """

    rates: Mapping[int, float]
    base_bytes: int
    agent_bytes: int
    row_bytes: int
    commit_bytes: int = COMMIT_BYTES
    seconds: float = 0.0

    @property
    def best_population(self) -> int:
        """The smallest population measured whose rate is within TOLERANCE of the best."""
        enough = (1 - TOLERANCE) * max(self.rates.values())
        return min(population for population, rate in self.rates.items() if rate >= enough)

    def rate(self, population: int) -> float:
        """Return agent-steps a second of a worker: between the sizes measured, the time of a lock-step is linear in the size.

        A smaller population than any measured is never faster than the smallest, and a larger one as fast as the largest.
        """
        points = sorted((size, size / rate) for size, rate in self.rates.items())
        (smallest, fastest), (largest, _) = points[0], points[-1]
        if population >= largest or len(points) == 1:
            return self.rates[largest]
        (a, s), (b, t) = next(pair for pair in itertools.pairwise(points) if population < pair[1][0])
        padded = max(population, 2)  # one agent is trained with a copy beside it
        seconds = s + (padded - a) * (t - s) / (b - a)
        if population < smallest:
            seconds = min(fastest, max(seconds, fastest * padded / smallest))
        return population / seconds

    def peak_bytes(self, trial: Trial, population: int, again: bool = True) -> int:
        """Return the most memory of a worker that trains a population of such trials, and then writes its rows.

        `again`: in a worker that has committed a shard before. The replay is freed when rows are written.
        """
        training = population * self._bytes_per_agent(trial)
        return self.base_bytes + (self.commit_bytes + training if again else max(self.commit_bytes, training))

    def largest_within(self, trial: Trial, budget: int) -> int:
        """Return the largest population of such trials whose memory stays within `budget` bytes; at least 1."""
        return max(1, (budget - self.base_bytes - self.commit_bytes) // self._bytes_per_agent(trial))

    def size(self, trials: Sequence[Trial], budget: int | None) -> Size:
        """Return the size of the fastest populations of these trials that fit into `budget` bytes a worker (None: unknown)."""
        population = self.best_population
        if budget is not None:
            population = min(population, *(self.largest_within(trial, budget) for trial in _different(trials)))
        return Size(population, self.rate(population))

    def _bytes_per_agent(self, trial: Trial) -> int:
        rows = min(trial.steps, getattr(trial.hypers, "replay_capacity", trial.steps))
        recorded = _RECORDED_BYTES * min(trial.steps, _RECORDED_STEPS) + _RECORDER_BYTES
        return self.agent_bytes + rows * self.row_bytes + recorded + _EPISODE_BYTES * math.ceil(trial.steps / trial.cutoff)

    def to_json(self) -> dict[str, Any]:
        """Return the calibration as values that JSON knows."""
        return {**asdict(self), "rates": {str(size): rate for size, rate in self.rates.items()}}

    @classmethod
    def from_json(cls, found: Any) -> "Calibration":
        """Return the calibration that `to_json` wrote. Raises ValueError, TypeError, KeyError or AttributeError."""
        rates = {int(size): float(rate) for size, rate in found["rates"].items()}
        memory = {name: int(found[name]) for name in ("base_bytes", "agent_bytes", "row_bytes", "commit_bytes")}
        calibration = cls(rates, **memory, seconds=float(found["seconds"]))
        if not rates or not all(size > 0 and 0 < rate < math.inf for size, rate in rates.items()) or min(memory.values()) < 0:
            raise ValueError("not a calibration")
        return calibration


def nominal(agent: str, row_bytes: int) -> Calibration:
    """Return what is taken where nothing was measured."""
    if find_algorithm(agent).one_trial:
        return Calibration({1: _NOMINAL_FUNCTION}, _NOMINAL_BASE, 0, 0)
    return Calibration({DEFAULT_POPULATION: NOMINAL_AGENT_STEPS_PER_SECOND}, _NOMINAL_BASE, _NOMINAL_AGENT, row_bytes)


def memory_budget(available: int | None, workers: int) -> int | None:
    """Return the bytes that each of `workers` on one machine may take of what is available there; None when that is unknown."""
    return None if available is None else int(MEMORY_SHARE * available / max(1, workers))


def _different(trials: Sequence[Trial]) -> list[Trial]:
    """Return one trial for each number of steps and cutoff, which is all that memory depends on within a group."""
    return list({(trial.steps, trial.cutoff): trial for trial in trials}.values())
