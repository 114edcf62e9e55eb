"""Many small shards made few large ones, with the same rows: a query then opens few files.

The shards of an agent on an environment are put together, sorted by setting and seed, in a new folder whose manifest says which
shards it replaces. One rename makes it visible and the others invisible, at once; then these are removed. Killed at any moment,
the store shows every trial exactly once, and the next compaction removes what is left over.
"""

import contextlib
import errno
import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from sweep import manifest, schema, shard_files
from sweep.manifest import DamagedError
from sweep.shard_checks import Problem, check
from sweep.store import Store
from sweep.tables import ShardTables

TARGET_TRIALS = 4096
_MOST_EPISODES = 2_000_000  # of a compacted shard: they are in memory together, 24 bytes each, two or three times


@dataclass
class Counts:
    """What a compaction did: shards and their bytes before and after, in the whole store, and the trials that were moved.

    `damaged` are problems of shards that were left alone.
    """

    shards_before: int = 0
    shards_after: int = 0
    bytes_before: int = 0
    bytes_after: int = 0
    trials: int = 0
    damaged: tuple[Problem, ...] = ()


@dataclass(frozen=True)
class _Small:
    """A shard that may be put together with others whose `key` is the same."""

    folder: Path
    key: tuple[Any, ...]
    trials: int
    episodes: int


def compact(store: Store, *, target_trials: int = TARGET_TRIALS, say: Callable[[str], None] = lambda _: None) -> Counts:
    """Put shards of less than half of `target_trials` together, to at most so many trials each; return what was done.

    Damaged shards are left alone, and so are those that a damaged one replaces. Raises UnwritableError when the store cannot be
    written to, and DamagedError when a compacted shard does not say which others it replaces. `say` is told what is under way.
    """
    left = _discard_superseded(store)
    shards = store.shards()
    counts = Counts(len(shards), bytes_before=_bytes(shards), damaged=left)
    damaged = {problem.shard for problem in left}
    small = _small([folder for folder in shards if folder.name not in damaged], target_trials, counts)
    bins = _bins(list(small), target_trials)
    for number, group in enumerate(bins, 1):
        agent, environment, *_ = group[0].key
        trials = sum(small.trials for small in group)
        say(f"{number:,} of {len(bins):,}: {len(group):,} shards of {agent} on {environment}, {trials:,} trials")
        with contextlib.suppress(FileNotFoundError):  # another compaction was faster
            counts.trials += _compact(store, [small.folder for small in group], counts)
    shards = store.shards()
    counts.shards_after, counts.bytes_after = len(shards), _bytes(shards)
    return counts


def _discard_superseded(store: Store) -> tuple[Problem, ...]:
    """Remove what killed compactions left over, if what replaces it is sound; return the problems of what is not."""
    sound: dict[Path, int] = {}
    problems: list[Problem] = []
    for shard in store.replacements():
        with contextlib.suppress(FileNotFoundError):  # another compaction was faster
            inode = shard.stat().st_ino
            checked = check(shard)
            if checked is not None and checked.problems:
                problems += checked.problems
            elif checked is not None:
                sound[shard] = inode
    if sound:
        with store.staged("superseded"), store.locked():
            for shard, replaced in store.replacements().items():
                with contextlib.suppress(FileNotFoundError):  # replaced itself, and removed by now
                    if sound.get(shard) == shard.stat().st_ino:
                        store.discard(replaced)
    return tuple(problem for problem in problems if (store.path / "shards" / problem.shard).exists())


def _small(shards: Sequence[Path], target_trials: int, counts: Counts) -> Iterator[_Small]:
    for folder in shards:
        try:
            trials = shard_files.read_table(folder / shard_files.TRIALS)
            if not set(schema.TRIALS.names) - schema.LATER_COLUMNS <= set(trials.column_names):
                continue  # `sweep verify` says so
            kinds = set(zip(trials["agent"].to_pylist(), trials["environment"].to_pylist(), strict=True))
            if 2 * trials.num_rows < target_trials and len(kinds) == 1:
                columns = tuple((field.name, str(field.type)) for field in trials.schema)
                key = (*kinds.pop(), columns, (folder / shard_files.EVALUATIONS).exists())
                yield _Small(folder, key, trials.num_rows, int(np.sum(trials["episodes"].to_numpy())))
        except DamagedError as error:
            counts.damaged += (Problem(folder.name, error.file, (), error.what),)
        except FileNotFoundError:  # another compaction was faster
            continue


def _bins(shards: Sequence[_Small], target_trials: int) -> list[list[_Small]]:
    """Return shards to be put together, two at least: of one key each, in the order of their names, not too many."""
    by_key: dict[tuple[Any, ...], list[_Small]] = {}
    bins: list[list[_Small]] = []
    for small in shards:
        by_key.setdefault(small.key, []).append(small)
    for group in by_key.values():
        current: list[_Small] = []
        for small in group:
            trials = sum(other.trials for other in current) + small.trials
            episodes = sum(other.episodes for other in current) + small.episodes
            if current and (trials > target_trials or episodes > _MOST_EPISODES):
                bins.append(current)
                current = []
            current.append(small)
        bins.append(current)
    return [group for group in bins if len(group) > 1]


def _compact(store: Store, folders: Sequence[Path], counts: Counts) -> int:
    """Put sound shards together, if there are two at least; return how many trials they have.

    Raises FileNotFoundError when one of them is taken away meanwhile.
    """
    sound = []
    for folder in folders:
        checked = check(folder)
        if checked is not None and not checked.problems:
            sound.append(folder)
        elif checked is not None:
            counts.damaged += tuple(checked.problems)
    if len(sound) < 2:
        return 0
    before = {folder: folder.stat().st_ino for folder in sound}
    tables = _put_together([shard_files.read(folder) for folder in sound])
    name = f"{manifest.COMPACTED}{_digest(tables.trials['trial'].to_pylist())}"
    replaced = {folder.name for folder in sound}
    for folder in sound:
        known = manifest.read(folder)  # of a compaction that was killed, older shards may be there still
        replaced.update(name for name in (known.replaces if known else ()) if (folder.parent / name).exists())
    with store.staged(name) as staging:
        shard_files.write(staging, tables, tuple(sorted(replaced)))
        written = check(staging)
        for problem in written.problems if written else ():
            raise OSError(errno.EIO, f"what was written cannot be read again: {problem.file.name}: {problem.what}")
        with store.locked():
            if any(not folder.exists() or folder.stat().st_ino != inode for folder, inode in before.items()):
                return 0  # another compaction was faster, or a shard was put aside
            store.publish(staging, store.free_name(name))
            store.discard(folder.parent / name for name in sorted(replaced))  # nobody puts the new one aside meanwhile
    return tables.trials.num_rows


def _put_together(parts: Sequence[ShardTables]) -> ShardTables:
    """Return the rows of all, by setting, seed, trial; a trial's own rows stay as they were."""
    trials = pa.concat_tables([part.trials for part in parts])
    trials = trials.sort_by([("setting", "ascending"), ("seed", "ascending"), ("trial", "ascending")])
    names = trials["trial"].combine_chunks()
    evaluations = [part.evaluations for part in parts if part.evaluations is not None]
    return ShardTables(
        trials,
        _in_order([part.episodes for part in parts], names),
        _in_order(evaluations, names) if evaluations else None,
    )


def _in_order(tables: Sequence[pa.Table], names: pa.Array) -> pa.Table:
    """Return the rows of tables with a dictionary of trials, in the order of the names."""
    table = pa.concat_tables(tables).unify_dictionaries()
    trial = table["trial"].combine_chunks()
    rank_of = {name: rank for rank, name in enumerate(names.to_pylist())}
    ranks = np.array([rank_of.get(name, -1) for name in trial.dictionary.to_pylist()], np.int32)
    rank = ranks[trial.indices.to_numpy()]
    order = np.argsort(rank, kind="stable")
    sorted_trial = pa.DictionaryArray.from_arrays(pa.array(rank[order]), names)
    return table.take(pa.array(order)).set_column(table.schema.get_field_index("trial"), "trial", sorted_trial)


def _digest(trials: Sequence[str]) -> str:
    return hashlib.sha256("".join(sorted(trials)).encode()).hexdigest()[:16]


def _bytes(shards: Sequence[Path]) -> int:
    total = 0
    for folder in shards:
        with contextlib.suppress(FileNotFoundError):
            total += sum(file.stat().st_size for file in folder.glob("*"))
    return total
