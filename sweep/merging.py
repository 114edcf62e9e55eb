"""Other stores' trials, studies and selections brought into one: what is there already stays as it is.

A trial that both stores have is the same when its episodes are. Where they differ (another engine, machine or version), the
store's own rows stay, and the conflict is reported. A merge may be killed and repeated: nothing is brought twice.
"""

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from sweep import schema, shard_files, study_files
from sweep.files import UnwritableError
from sweep.messages import UserError
from sweep.shard_checks import check
from sweep.shard_files import TRIALS, read_table
from sweep.store import Store

_THREADS = 4
_ORIGIN = ("engine", "host", "commit", "versions")
_SELECTION = "selections.parquet"


@dataclass(frozen=True)
class Conflict:
    """A trial whose episodes differ between the store and another one; `ours` and `theirs` say with what it was trained."""

    trial: str
    agent: str
    environment: str
    seed: int
    store: Path
    ours: Mapping[str, Any]
    theirs: Mapping[str, Any]


@dataclass
class MergeReport:
    """What was brought: trials and studies. `same` counts the trials that were here already, with the same episodes.

    `study_conflicts` are sentences about studies and selections that differ; the store's own stay.
    """

    trials: int = 0
    same: int = 0
    conflicts: list[Conflict] = field(default_factory=list)
    studies: list[str] = field(default_factory=list)
    selections: list[str] = field(default_factory=list)
    study_conflicts: list[str] = field(default_factory=list)


def merge(
    store: Store, others: Sequence[Store], *, with_steps: bool = True, say: Callable[[str], None] = lambda _: None
) -> MergeReport:
    """Bring what other stores have into one. Failures are not brought, and `steps` only with `with_steps`.

    Raises UserError, before anything is written, for a store that is damaged, and for one that is given twice or is the
    target; UnwritableError when the target cannot be written to. `say` is told what is under way.
    """
    paths = [other.path.resolve() for other in (store, *others)]
    for path in paths:
        if paths.count(path) > 1:
            raise UserError(f"{path}: a store cannot be merged with itself")
    for other in others:
        say(f"checking {other.path}")
        _check(other)
    report = MergeReport()
    try:
        here = _Owned(store)
        for other in others:
            shards = other.shards()
            for number, folder in enumerate(shards, 1):
                say(f"{other.path}: {number:,} of {len(shards):,} shards")
                report.trials += _merge_shard(here, folder, other, report, with_steps)
            for study in other.studies():
                _merge_study(store, other, study, report)
    except FileNotFoundError as error:
        raise UserError(f"{error.filename}: is gone: the store was compacted meanwhile; merge again") from None
    return report


def _check(store: Store) -> None:
    """Raise UserError naming the first file that is damaged."""
    with ThreadPoolExecutor(_THREADS) as pool:
        for shard in pool.map(lambda folder: check(folder, quick=True), store.shards()):
            for problem in shard.problems if shard is not None else ():
                raise UserError(
                    f"{problem.file}: is damaged: {problem.what}; `sweep verify --store {store.path}` says what else is"
                )


class _Owned:
    """The target's trials: which shard has them, and what their episodes are."""

    def __init__(self, store: Store) -> None:
        self.store = store
        store.finished_trials()  # raises for what is damaged
        self.folder_of: dict[str, Path] = {}
        self._known: set[Path] = set()
        self._read: tuple[Path, dict[str, bytes], dict[str, dict[str, Any]]] | None = None
        self.look_around()

    def look_around(self) -> None:
        """Learn of shards that are new."""
        for folder in self.store.shards():
            if folder not in self._known:
                self._known.add(folder)
                self.folder_of.update(dict.fromkeys(shard_files.trials_in(folder), folder))

    def look_up(self, trial: str) -> tuple[bytes, dict[str, Any]]:
        """Return the digest of a trial's episodes and its row. Shards are kept one at a time."""
        folder = self.folder_of[trial]
        if self._read is None or self._read[0] != folder:
            self._read = (folder, _digests(folder), _rows(folder))
        return self._read[1][trial], self._read[2][trial]


def _merge_shard(here: _Owned, folder: Path, other: Store, report: MergeReport, with_steps: bool) -> int:
    """Bring the trials of a shard that are new, and compare the others; return how many were new."""
    trials = shard_files.trials_in(folder)
    known = trials & here.folder_of.keys()
    for conflict in _compared(here, folder, known, other):
        report.conflicts.append(conflict)
        report.same -= 1
    report.same += len(known)
    if known == trials:
        return 0
    brought = here.store.commit_copy(folder.name, folder, with_steps)
    here.look_around()
    return brought


def _compared(here: _Owned, folder: Path, trials: Collection[str], other: Store) -> Iterator[Conflict]:
    if not trials:
        return
    digests, rows = _digests(folder), _rows(folder)
    for trial in sorted(trials, key=lambda trial: (here.folder_of[trial], trial)):
        digest, row = here.look_up(trial)
        if digest != digests[trial]:
            ours, theirs = ({name: known[name] for name in _ORIGIN} for known in (row, rows[trial]))
            yield Conflict(trial, row["agent"], row["environment"], row["seed"], other.path, ours, theirs)


def _rows(folder: Path) -> dict[str, dict[str, Any]]:
    columns = ["trial", "agent", "environment", "seed", *_ORIGIN]
    return {row["trial"]: row for row in read_table(folder / TRIALS, columns).to_pylist()}


def _digests(folder: Path) -> dict[str, bytes]:
    """Return trial → digest of its episodes, and of its evaluation episodes if it has any."""
    tables = shard_files.read(folder)
    digests: dict[str, Any] = {}
    for table, declared in ((tables.episodes, schema.EPISODES), (tables.evaluations, schema.EVALUATIONS)):
        if table is None:
            continue
        trial = table["trial"].combine_chunks()
        codes = trial.indices.to_numpy()
        order = np.argsort(codes, kind="stable")
        columns = [_comparable(table[name])[order] for name in declared.names if name != "trial"]
        bounds = np.searchsorted(codes[order], np.arange(len(trial.dictionary) + 1))
        for code, name in enumerate(trial.dictionary.to_pylist()):
            known = digests.setdefault(name, hashlib.sha256())
            for column in columns:
                known.update(column[bounds[code] : bounds[code + 1]].tobytes())
    return {name: known.digest() for name, known in digests.items()}


def _comparable(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as numbers: texts by their place in the schema, one NaN for all, one zero for both."""
    if pa.types.is_dictionary(column.type):
        texts = column.cast(pa.string()).to_pylist()
        return np.array([schema.ENDINGS.index(text) for text in texts], np.int8)
    values = column.to_numpy()
    if values.dtype.kind == "f":
        return np.where(np.isnan(values), np.nan, values).astype(values.dtype) + values.dtype.type(0)
    return values


def _merge_study(store: Store, other: Store, study: str, report: MergeReport) -> None:
    """Bring a study that is missing or has more trials there, and a selection; say where they differ."""
    ours, theirs = (known.path / "studies" / study for known in (store, other))
    if not (theirs / study_files.MEMBERS).exists():
        return
    try:
        here = _members(ours) if (ours / study_files.MEMBERS).exists() else set()
        there = _members(theirs)
        if here < there:  # missing here, or further along there
            # the members last: until they are here, too, this is done again
            _copy(theirs, ours, (study_files.GRID, study_files.OVERRIDES, _SELECTION, study_files.MEMBERS))
            report.studies.append(study)
        elif there < here:
            return
        elif here != there:
            report.study_conflicts.append(f"study {study} of {other.path} has other trials than this store's: it was left out")
        elif not (ours / _SELECTION).exists():
            if (theirs / _SELECTION).exists():
                _copy(theirs, ours, (_SELECTION,))
                report.selections.append(study)
        elif (theirs / _SELECTION).exists() and _choices(ours) != _choices(theirs):
            report.study_conflicts.append(
                f"study {study} of {other.path} has another selection than this store's: it was left out"
            )
    except OSError as error:
        raise UnwritableError(f"{ours}: cannot be written to: {error.strerror or error}", error.errno) from None


def _copy(source: Path, target: Path, names: Sequence[str]) -> None:
    """Make these files the other study's, in this order, and remove those that it lacks."""
    for name in names:
        study_files.keep(target / name, (source / name).read_bytes() if (source / name).exists() else None)


def _members(folder: Path) -> set[tuple[str, str]]:
    table = read_table(folder / study_files.MEMBERS, ["stage", "trial"])
    return set(zip(table["stage"].to_pylist(), table["trial"].to_pylist(), strict=True))


def _choices(folder: Path) -> set[tuple[str, ...]]:
    """Return what is chosen, and from what: not when."""
    columns = ["by", "agent", "environment", "for_each", "hypers", "basis"]
    table = read_table(folder / _SELECTION, columns)
    return set(zip(*(table[name].to_pylist() for name in columns), strict=True))
