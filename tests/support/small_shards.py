"""Shards of SAC on Pendulum with numbers that need no training, and a look at all the rows of a store."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from agents.hypers import SACHypers
from sweep.provenance import Provenance
from sweep.tables import ShardTables, shard_tables
from sweep.trials import Trial


def trial(seed: int, steps: int = 1000, environment: str = "Pendulum-CA", evaluation: tuple[int, int] | None = None) -> Trial:
    return Trial("SAC", environment, SACHypers(), seed, steps, 1000, 0.99, evaluation)


def tables(
    seeds: Sequence[int],
    steps: int = 1000,
    length: int = 100,
    *,
    environment: str = "Pendulum-CA",
    host: str = "host",
    shift: float = 0.0,
    evaluated: bool = False,
) -> ShardTables:
    """A shard of one trial a seed, with episodes of one length; a trial's returns depend on its seed alone, and `shift`."""
    trials = [trial(seed, steps, environment, (500, 2) if evaluated else None) for seed in seeds]
    episodes = steps // length
    returns = [np.random.default_rng(seed).normal(size=episodes) + shift for seed in seeds]
    evaluations = SimpleNamespace(
        agent=np.repeat(np.arange(len(seeds), dtype=np.int32), 4),
        step=np.tile(np.array([500, 500, 1000, 1000], np.int32), len(seeds)),
        episode=np.tile(np.array([0, 1, 0, 1], np.int32), len(seeds)),
        length=np.full(4 * len(seeds), 100, np.int32),
        episodic_return=np.repeat(np.array(seeds, np.float32), 4),
        ending=np.ones(4 * len(seeds), np.uint8),
    )
    records = SimpleNamespace(
        steps=steps,
        agent=np.repeat(np.arange(len(seeds), dtype=np.int32), episodes),
        episode=np.tile(np.arange(episodes, dtype=np.int32), len(seeds)),
        first_step=np.tile(np.arange(episodes, dtype=np.int32) * length + 1, len(seeds)),
        length=np.full(len(seeds) * episodes, length, np.int32),
        episodic_return=np.concatenate(returns).astype(np.float32),
        ending=np.zeros(len(seeds) * episodes, np.uint8),
        diverged_at=np.zeros(len(seeds), np.int64),
        evaluations=evaluations if evaluated else None,
    )
    return shard_tables(trials, records, 1.0, Provenance("cpu", "torch", host, None, "{}"))


def rows(store: Path, table: str, shards: Sequence[Path] | None = None) -> list[dict[str, Any]]:
    """All rows of a table, read by pyarrow alone: of these shards, or of every folder in `shards`."""
    folders = sorted(store.glob("shards/*")) if shards is None else shards
    files = [folder / f"{table}.parquet" for folder in folders]
    return [row for file in files if file.exists() for row in pq.read_table(file, partitioning=None).to_pylist()]
