"""The shards that a launch has yet to train: what other launches train meanwhile, and what becomes of shards that fail.

A population fails as a whole, often because of one of its trials. It is tried again in halves, until the trials that fail are
alone: one failing trial harms no other. When MOST_ALIKE trials of a group have failed alike and none has succeeded in between,
whatever else fails so is not taken apart any more.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from cluster.worker import Receipt
from sweep.shards import Group, Shard
from sweep.trials import Trial

MOST_ALIKE = 8
_LOOK_SECONDS = 2.0


@dataclass(frozen=True)
class Failed:
    """Trials that are given up in this launch, and the receipt that says why."""

    shard: Shard
    receipt: Receipt
    attempts: int


class Backlog:
    """Shards in the order in which they start.

    `finished` returns the trials that are in the store by now, `claimed` those that other launches train; `pack` makes shards of
    trials that others have given up. `elsewhere` collects trials that were found in the store although they were waiting here.
    """

    def __init__(
        self,
        shards: Sequence[Shard],
        finished: Callable[[], Collection[str]],
        claimed: Callable[[], Collection[str]],
        pack: Callable[[Sequence[Trial]], Sequence[Shard]],
    ) -> None:
        self._waiting = deque(shards)
        self._deferred: list[Trial] = []
        self._finished, self._claimed, self._pack = finished, claimed, pack
        self._attempts: Counter[str] = Counter()
        self._alike: Counter[tuple[Group, str]] = Counter()
        self._taken: Collection[str] = ()
        self._present: Collection[str] = ()
        self._looked = float("-inf")
        self.elsewhere: list[Trial] = []

    def __bool__(self) -> bool:
        return bool(self._waiting or self._deferred)

    @property
    def waiting(self) -> Sequence[Shard]:
        """The shards that nobody trains yet, in order."""
        return list(self._waiting)

    @property
    def deferred(self) -> int:
        """How many trials are waited for, because another launch trains them."""
        return len(self._deferred)

    def clear(self) -> None:
        """Forget what waits."""
        self._waiting.clear()
        self._deferred.clear()

    def next(self) -> Shard | None:
        """Return the next shard of trials that are neither finished nor being trained elsewhere; None when there is none now."""
        self._look()
        while self._waiting:
            shard = self._waiting.popleft()
            self.elsewhere += [trial for trial in shard.trials if trial.id in self._present]
            missing = [trial for trial in shard.trials if trial.id not in self._present]
            free = [trial for trial in missing if trial.id not in self._taken]
            self._deferred += [trial for trial in missing if trial.id in self._taken]
            if len(free) == len(shard.trials):
                return shard
            if free:
                return self._part(shard, free)
        return None

    def _look(self) -> None:
        """See what others have done and do, every few seconds, and take up again what they have given up."""
        if time.monotonic() - self._looked < _LOOK_SECONDS:
            return
        self._taken, self._present = self._claimed(), self._finished()
        self._looked = time.monotonic()
        self.elsewhere += [trial for trial in self._deferred if trial.id in self._present]
        left = [trial for trial in self._deferred if trial.id not in self._present]
        self._deferred = [trial for trial in left if trial.id in self._taken]
        given_up = [trial for trial in left if trial.id not in self._taken]
        if given_up:
            self._waiting.extend(self._pack(given_up))

    def succeeded(self, shard: Shard) -> None:
        """Take note that a shard was trained: what fails in its group need not all fail."""
        for key in [key for key in self._alike if key[0] == shard.group]:
            del self._alike[key]

    def failed(self, receipt: Receipt, done: Collection[str] = ()) -> Failed | None:
        """Take back a shard that failed but for the trials `done`: parts of it are tried again, or else returned as given up."""
        shard = receipt.shard
        if receipt.culprit is not None:
            self._again(shard, [trial for trial in shard.trials if trial != receipt.culprit and trial.id not in done])
            return self._give_up(self._part(shard, [receipt.culprit]), receipt)
        alike = self._alike[shard.group, _kind(receipt)]
        if len(shard.trials) == 1 or receipt.store_is_unwritable or alike >= MOST_ALIKE:
            return self._give_up(shard, receipt)
        middle = len(shard.trials) // 2
        for part in (shard.trials[middle:], shard.trials[:middle]):
            self._again(shard, part)
        return None

    def _give_up(self, shard: Shard, receipt: Receipt) -> Failed:
        self._alike[shard.group, _kind(receipt)] += 1
        return Failed(shard, receipt, self._attempts[shard.id] + receipt.tries)

    def _again(self, shard: Shard, trials: Sequence[Trial]) -> None:
        if trials:
            part = self._part(shard, trials)
            self._attempts[part.id] += 1
            self._waiting.appendleft(part)

    def _part(self, shard: Shard, trials: Sequence[Trial]) -> Shard:
        part = Shard(tuple(trials))
        self._attempts[part.id] = self._attempts[shard.id]
        return part


def _kind(receipt: Receipt) -> str:
    """Return the type of the error: its message may differ from trial to trial."""
    lines = (receipt.error or "").strip().splitlines()
    return lines[-1].partition(":")[0] if lines else receipt.reason
