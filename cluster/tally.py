"""How far a launch is: trials and agent-steps by agent and environment, the rate, the time that is left."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sweep.shards import Shard
from sweep.trials import Trial

_RATE_SECONDS = 30.0


@dataclass
class Row:
    """The trials of an agent on an environment. `left` is in seconds; None when nothing is known yet."""

    agent: str
    environment: str
    trials: int = 0
    done: int = 0
    failed: int = 0
    running: int = 0
    steps: int = 0
    done_steps: int = 0
    left: float | None = None

    @property
    def share(self) -> float:
        """The part of the agent-steps that is done."""
        return self.done_steps / self.steps if self.steps else 1.0


@dataclass
class Tally:
    """The numbers of one stage of a study. Trials that were in the store before it began are not among them."""

    study: str
    stage: str
    clock: Callable[[], float] = time.monotonic
    rows: dict[tuple[str, str], Row] = field(default_factory=dict)
    rate: float = 0.0
    _trained: int = 0
    _spared: dict[str, int] = field(default_factory=dict)
    _finished: dict[tuple[str, str], int] = field(default_factory=dict)
    _readings: list[tuple[float, int]] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        study: str,
        stage: str,
        shards: Iterable[Shard],
        clock: Callable[[], float] = time.monotonic,
        spared: Mapping[Shard, int] | None = None,
    ) -> "Tally":
        """Return the tally of shards that are to be trained; of some, checkpoints spare so many agent-steps."""
        tally = cls(study, stage, clock)
        tally._spared = {shard.id: steps for shard, steps in (spared or {}).items()}
        for shard in shards:
            for trial in shard.trials:
                row = tally.rows.setdefault(_key(trial), Row(trial.agent, trial.environment))
                row.trials += 1
                row.steps += trial.steps
        tally._readings = [(clock(), 0)]
        return tally

    def trained(self, shard: Shard, spared: int) -> None:
        """Count a shard that this launch has trained, but for the agent-steps that a checkpoint spared."""
        self.finished(shard.trials, here=True)
        self._trained -= spared

    def finished(self, trials: Iterable[Trial], *, here: bool) -> None:
        """Count trials as done; `here`: this launch trained them, which is what its rate is about."""
        for trial in trials:
            row = self.rows[_key(trial)]
            row.done += 1
            self._finished[_key(trial)] = self._finished.get(_key(trial), 0) + trial.steps
            self._trained += trial.steps if here else 0

    def failed(self, trials: Iterable[Trial]) -> None:
        """Count trials as failed: nobody waits for their steps any longer."""
        for trial in trials:
            row = self.rows[_key(trial)]
            row.failed += 1
            row.steps -= trial.steps

    def read(self, running: Mapping[Shard, int], waiting: Sequence[Shard]) -> None:
        """Bring rates and times up to date: agent-steps done of the shards under way, and those that wait, in order."""
        for key, row in self.rows.items():
            row.running, row.done_steps = 0, self._finished.get(key, 0)
        for shard, steps in running.items():
            row = self.rows[_key(shard.trials[0])]
            row.running += len(shard.trials)
            row.done_steps += min(steps, shard.agent_steps)
        self._rate(self._trained + sum(max(0, steps - self._spared.get(shard.id, 0)) for shard, steps in running.items()))
        self._times(running, waiting)

    def _rate(self, steps: int) -> None:
        now = self.clock()
        self._readings.append((now, steps))
        self._readings = [reading for reading in self._readings if reading[1] <= steps]  # a worker that began again
        while len(self._readings) > 2 and now - self._readings[1][0] > _RATE_SECONDS:
            self._readings.pop(0)
        then, before = self._readings[0]
        self.rate = max(0.0, (steps - before) / (now - then)) if now > then else 0.0

    def _times(self, running: Mapping[Shard, int], waiting: Sequence[Shard]) -> None:
        """A group ends when its last shard does, and shards start in order: all steps before that have to be trained first."""
        ahead = sum(max(0, shard.agent_steps - steps) for shard, steps in running.items())
        last: dict[tuple[str, str], int] = {_key(shard.trials[0]): ahead for shard in running}
        for shard in waiting:
            ahead += shard.agent_steps
            last[_key(shard.trials[0])] = ahead
        for key, row in self.rows.items():
            row.left = 0.0 if key not in last else last[key] / self.rate if self.rate else None

    @property
    def total(self) -> Row:
        """The sum over all rows."""
        total = Row("", "")
        for row in self.rows.values():
            for name in ("trials", "done", "failed", "running", "steps", "done_steps"):
                setattr(total, name, getattr(total, name) + getattr(row, name))
        left = [row.left for row in self.rows.values()]
        total.left = None if None in left else max((seconds for seconds in left if seconds is not None), default=0.0)
        return total

    def to_json(self) -> dict[str, Any]:
        """Return the numbers as values that JSON knows."""
        total = self.total
        return {
            "stage": self.stage,
            "planned": total.trials,
            "done": total.done,
            "failed": total.failed,
            "agent_steps": total.steps,
            "agent_steps_done": total.done_steps,
            "agent_steps_per_second": round(self.rate, 1),
            "eta_seconds": None if total.left is None else round(total.left, 1),
            "groups": [
                {
                    "agent": row.agent,
                    "environment": row.environment,
                    "planned": row.trials,
                    "done": row.done,
                    "failed": row.failed,
                    "running": row.running,
                    "eta_seconds": None if row.left is None else round(row.left, 1),
                }
                for row in self.rows.values()
            ],
        }


def _key(trial: Trial) -> tuple[str, str]:
    return trial.agent, trial.environment
