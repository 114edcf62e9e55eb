"""What a store of chapter 6 costs: 23,400 trials of 100,000 steps with synthetic returns, committed, verified, compacted.

    python tests/benchmarks/store_size.py [--share 1.0] [--folder DIR] [--compact] [--json FILE]

Lengths of episodes are uniform on 60 … 1,000 steps, and all returns differ, as those of most environments do. Shards are as large
as a launch on two workers packs them where nothing was measured.
"""

import argparse
import json
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sweep.compaction import compact
from sweep.grid import load
from sweep.provenance import Provenance
from sweep.shards import Shard, pack
from sweep.store import Store
from sweep.tables import members_table, shard_tables
from sweep.trials import expand
from sweep.verification import verify

ORIGIN = Provenance("cpu", "native-avx512", "here", "0" * 40, "{}")


@dataclass
class Records:
    """Episodes as training records them."""

    steps: int
    agent: np.ndarray
    episode: np.ndarray
    first_step: np.ndarray
    length: np.ndarray
    episodic_return: np.ndarray
    ending: np.ndarray
    diverged_at: np.ndarray


def synthetic(shard: Shard, generator: np.random.Generator) -> Records:
    """Return made-up episodes for a shard's trials; the last one of each is cut by the budget."""
    steps = shard.trials[0].steps
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("agent", "episode", "first_step", "length", "ending")}
    for agent in range(len(shard.trials)):
        lengths = generator.integers(60, 1_001, size=steps // 60)
        ends = lengths.cumsum()
        count = int(np.searchsorted(ends, steps)) + 1
        lengths = lengths[:count]
        lengths[-1] -= ends[count - 1] - steps
        columns["agent"].append(np.full(count, agent, np.int32))
        columns["episode"].append(np.arange(count, dtype=np.int32))
        columns["first_step"].append((lengths.cumsum() - lengths + 1).astype(np.int32))
        columns["length"].append(lengths.astype(np.int32))
        columns["ending"].append(np.r_[np.zeros(count - 1, np.uint8), np.uint8(2)])
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    returns = generator.normal(0.0, 100.0, len(joined["agent"])).astype(np.float32)
    return Records(steps, **joined, episodic_return=returns, diverged_at=np.zeros(len(shard.trials), np.int64))


def on_disk(folder: Path) -> tuple[int, int]:
    """Return the number of files in a folder, and their bytes."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    return len(files), sum(file.stat().st_size for file in files)


def measure(folder: Path, share: float, with_compact: bool) -> dict[str, float]:
    """Return seconds, files and bytes."""
    grid = load("thesis/chapter-6")
    trials = expand(grid)
    trials = trials[: round(share * len(trials))]
    store = Store.create(folder)
    store.write_study(grid.name, grid.text, members_table(grid.name, {"tune": trials}))
    generator = np.random.default_rng(0)
    shards = pack(trials, slots=2)
    found: dict[str, float] = {"trials": len(trials), "shards": len(shards)}
    seconds = 0.0
    for shard in shards:
        records = synthetic(shard, generator)
        started = time.perf_counter()
        store.commit(shard.id, shard_tables(shard.trials, records, 1.0, ORIGIN))
        seconds += time.perf_counter() - started
    found["commit_seconds"] = seconds
    found["files"], found["bytes"] = on_disk(folder)
    steps = list(folder.glob("shards/*/steps.parquet"))
    found["steps_bytes"] = sum(file.stat().st_size for file in steps)
    for name, quick in (("verify_quick", True), ("verify", False)):
        started = time.perf_counter()
        assert not verify(Store.open(folder), quick=quick).problems
        found[f"{name}_seconds"] = time.perf_counter() - started
    started = time.perf_counter()
    assert len(Store.open(folder).finished_trials()) == len(trials)
    found["finished_trials_seconds"] = time.perf_counter() - started
    if with_compact:
        started = time.perf_counter()
        counts = compact(store)
        found["compact_seconds"] = time.perf_counter() - started
        found["compacted_shards"] = counts.shards_after
        found["compacted_files"], found["compacted_bytes"] = on_disk(folder)
    found["memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--share", type=float, default=1.0, help="of the trials")
    parser.add_argument("--folder", type=Path, help="keep the store there")
    parser.add_argument("--compact", action="store_true", help="compact it, too")
    parser.add_argument("--json", type=Path, help="write the results there too")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        found = measure(arguments.folder or Path(temporary) / "store", arguments.share, arguments.compact)
    for name, value in found.items():
        print(f"{name:24} {value:16,.1f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
