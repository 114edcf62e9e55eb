"""What runs where the training happens: one shard, from its trials to its committed rows."""

import errno
import socket
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace

from agents.registry import find_algorithm
from cluster import machine
from sweep import provenance
from sweep.provenance import Provenance
from sweep.shards import Shard
from sweep.store import Store
from sweep.tables import EpisodeColumns, shard_tables

_REPORT_SECONDS = 1.0
_UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class Training:
    """How shards are trained: on which device (auto, cpu, cuda), with how many threads each, at most how many trials.

    `tf32`: whether a GPU may round the operands of matrix products.
    """

    device: str = "cpu"
    threads: int = 1
    limit: int | None = None
    tf32: bool = False


@dataclass(frozen=True)
class Work:
    """A shard, the store that its rows go to, and how it is to be trained: `device`, `threads` and `tf32` as of `Training`."""

    shard: Shard
    store: str
    device: str = "cpu"
    threads: int = 1
    tf32: bool = False


@dataclass(frozen=True)
class Receipt:
    """What a worker sends back: never rows, which are in the store. `error` is a traceback, or None.

    `committed` counts the trials that were not in the store already; `store_is_unwritable` says that no other shard's rows
    could be committed either. `peak_memory` is the most bytes that the worker had in memory meanwhile.
    """

    shard: Shard
    host: str
    committed: int = 0
    diverged: int = 0
    error: str | None = None
    store_is_unwritable: bool = False
    peak_memory: int = 0


def run_shard(work: Work, on_progress: Callable[[], None] | None = None) -> Receipt:
    """Train a shard and commit its rows. An error is returned, not raised. `on_progress` is called about once a second."""
    machine.reset_peak()
    try:
        receipt = _train_and_commit(work, on_progress)
    except Exception as error:
        unwritable = isinstance(error, OSError) and error.errno in _UNWRITABLE
        receipt = Receipt(work.shard, socket.gethostname(), error=traceback.format_exc(), store_is_unwritable=unwritable)
    return replace(receipt, peak_memory=machine.peak_bytes())


def device_of(name: str) -> str:
    """Return the device that a name stands for: "auto" is a GPU if there is one. Imports torch."""
    import torch

    return ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name


def _train_and_commit(work: Work, on_progress: Callable[[], None] | None) -> Receipt:
    store, shard = Store.open(work.store), work.shard
    started = time.perf_counter()
    one_trial = find_algorithm(shard.trials[0].agent).one_trial
    records, origin = (_train_function if one_trial else _train_population)(work, _reporter(store, shard, on_progress))
    committed = store.commit(shard.id, shard_tables(shard.trials, records, time.perf_counter() - started, origin))
    store.clear_progress(shard.id)
    return Receipt(shard, origin.host, committed, int((records.diverged_at > 0).sum()))


def _train_population(work: Work, on_step: Callable[[int], None]) -> tuple[EpisodeColumns, Provenance]:
    import torch

    from agents import kernels
    from agents.evaluation import Evaluation
    from agents.training import train

    torch.set_num_threads(work.threads)
    device = device_of(work.device)
    # before the training: the code may change meanwhile
    origin = provenance.of_this_process(device, kernels.engine_name(device, work.tf32))
    trials, first = work.shard.trials, work.shard.trials[0]
    records = train(
        first.agent,
        first.environment,
        [trial.hypers for trial in trials],
        [trial.seed for trial in trials],
        steps=first.steps,
        cutoff=first.cutoff,
        discount=first.discount,
        device=device,
        tf32=work.tf32,
        evaluation=Evaluation(*first.evaluation) if first.evaluation else None,
        on_step=on_step,
    )
    return records, origin


def _train_function(work: Work, on_step: Callable[[int], None]) -> tuple[EpisodeColumns, Provenance]:
    from agents.function import train_function

    (trial,) = work.shard.trials
    origin = provenance.of_this_process("unknown", "function")
    study = {"environment": trial.environment, "steps": trial.steps, "cutoff": trial.cutoff, "discount": trial.discount}
    return train_function(find_algorithm(trial.agent).load(), study | trial.hypers.as_dict(), trial.seed, on_step), origin


def _reporter(store: Store, shard: Shard, on_progress: Callable[[], None] | None) -> Callable[[int], None]:
    last = time.monotonic()

    def report(step: int) -> None:
        nonlocal last
        if time.monotonic() - last >= _REPORT_SECONDS:
            last = time.monotonic()
            store.report_progress(shard.id, step * len(shard.trials))
            if on_progress is not None:
                on_progress()

    return report
