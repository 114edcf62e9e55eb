"""What runs where the training happens: one shard, from its trials to its committed rows."""

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass

from sweep import provenance
from sweep.shards import Shard
from sweep.store import Store
from sweep.tables import shard_tables

_REPORT_SECONDS = 1.0


@dataclass(frozen=True)
class Work:
    """A shard, the store that its rows go to, and how it is to be trained."""

    shard: Shard
    store: str
    device: str = "cpu"
    threads: int = 1


@dataclass(frozen=True)
class Receipt:
    """What a worker sends back: never rows, which are in the store. `error` is a traceback, or None."""

    shard: str
    trials: int
    agent_steps: int
    diverged: int = 0
    seconds: float = 0.0
    error: str | None = None


def run_shard(work: Work) -> Receipt:
    """Train a shard and commit its rows. An error is recorded in the store and returned, not raised."""
    try:
        return _train_and_commit(work)
    except Exception as error:
        text = traceback.format_exc()
        store = Store(work.store)
        store.clear_progress(work.shard.id)
        trials = [trial.id for trial in work.shard.trials]
        store.record_failure(work.shard.id, {"error": repr(error), "traceback": text, "trials": trials})
        return Receipt(work.shard.id, len(trials), work.shard.agent_steps, error=text)


def _train_and_commit(work: Work) -> Receipt:
    import torch

    from agents.networks import ENGINE
    from agents.training import train

    torch.set_num_threads(work.threads)
    store, shard = Store.open(work.store), work.shard
    first = shard.trials[0]
    started = time.perf_counter()
    records = train(
        first.agent,
        first.environment,
        [trial.hypers for trial in shard.trials],
        [trial.seed for trial in shard.trials],
        steps=first.steps,
        cutoff=first.cutoff,
        discount=first.discount,
        device=work.device,
        on_step=_reporter(store, shard),
    )
    seconds = time.perf_counter() - started
    tables = shard_tables(shard.trials, records, seconds, provenance.of_this_process(work.device, ENGINE))
    store.commit(shard.id, tables)
    store.clear_progress(shard.id)
    return Receipt(shard.id, len(shard.trials), shard.agent_steps, int((records.diverged_at > 0).sum()), seconds)


def _reporter(store: Store, shard: Shard) -> Callable[[int], None]:
    last = time.monotonic()

    def report(step: int) -> None:
        nonlocal last
        if time.monotonic() - last >= _REPORT_SECONDS:
            last = time.monotonic()
            store.report_progress(shard.id, step * len(shard.trials))

    return report
