"""Whether a store is what was written to it: every file against its checksum, every shard against the laws (`sweep.laws`).

A damaged file is named, with the trials that it spoils, and the rest is checked all the same.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from sweep import checkpoints, manifest, schema
from sweep.manifest import DamagedError
from sweep.shard_checks import CheckedShard, Problem, check
from sweep.shard_files import TRIALS, read_table
from sweep.store import STALE_SECONDS, Store, is_stale

_THREADS = 4
_CHECKPOINT_SECONDS = 30 * 24 * 3600  # so long a launch may go on with one (`cluster.resuming`)
_WORK_FOLDERS = (".staging", ".launches", ".checkpoints", ".progress")


@dataclass(frozen=True)
class Report:
    """What was checked: so many shards, trials, bytes.

    `unchecked` are the shards without checksums, which were written before there were any: these were held to the laws alone.
    `leftovers` are files and folders that nothing reads any longer; `quarantined`, shards that were put aside.
    """

    shards: int
    trials: int
    bytes: int
    problems: tuple[Problem, ...]
    unchecked: tuple[str, ...] = ()
    leftovers: tuple[Path, ...] = ()
    quarantined: tuple[Path, ...] = ()

    @property
    def damaged_trials(self) -> set[str]:
        """Trials that a problem spoils."""
        return {trial for problem in self.problems for trial in problem.trials}


def verify(store: Store, *, quick: bool = False, say: Callable[[str], None] = lambda _: None) -> Report:
    """Check everything that a store shows; `quick` does not spell out the episodes to compare them with `steps`.

    `say` is told how far it is.
    """
    folders = store.shards(lenient=True)
    shards = []
    # reading, hashing and comparing leave Python to other threads most of the time
    with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:
        for number, shard in enumerate(pool.map(lambda folder: _checked(folder, quick), folders), 1):
            if shard is not None:
                shards.append(shard)
            say(f"{number:,} of {len(folders):,} shards")
    problems = [problem for shard in shards for problem in shard.problems]
    problems += [*_shared_trials(store, shards), *_study_problems(store)]
    return Report(
        shards=len(shards),
        trials=len(frozenset().union(*(shard.trials for shard in shards))),
        bytes=sum(shard.bytes for shard in shards),
        problems=tuple(problems),
        unchecked=tuple(shard.name for shard in shards if not shard.has_checksums),
        leftovers=tuple(_leftovers(store)),
        quarantined=tuple(sorted(store.path.glob(".quarantine/*"))),
    )


def _checked(folder: Path, quick: bool) -> CheckedShard | None:
    """Check a shard, and the trials that its manifest names; these are what is known of one whose files do not tell any."""
    shard = check(folder, quick=quick)
    try:
        known = manifest.read(folder)
    except (DamagedError, FileNotFoundError):  # is a problem already, or was compacted meanwhile
        return shard
    if shard is None or known is None or known.trials is None:
        return shard
    named = frozenset(known.trials)
    if not shard.trials:
        shard.trials = named
        shard.problems = [replace(problem, trials=problem.trials or tuple(sorted(named))) for problem in shard.problems]
    elif not shard.problems and named != shard.trials:
        different = tuple(sorted(named ^ shard.trials))
        shard.problems.append(Problem(shard.name, folder / manifest.NAME, different, "names other trials than the tables"))
    return shard


def _shared_trials(store: Store, shards: list[CheckedShard]) -> Iterator[Problem]:
    """Yield shards that have trials of another one: of two, that which has other problems, too, or else the later by name."""
    owner: dict[str, str] = {}
    for shard in sorted(shards, key=lambda shard: (bool(shard.problems), shard.name)):
        twice = sorted(trial for trial in shard.trials if trial in owner)
        if twice:
            others = ", ".join(sorted({owner[trial] for trial in twice}))
            file = store.path / "shards" / shard.name / TRIALS
            yield Problem(shard.name, file, tuple(twice), f"trials are in {others}, too")
        owner.update(dict.fromkeys(shard.trials - owner.keys(), shard.name))


def _study_problems(store: Store) -> Iterator[Problem]:
    for study in store.studies():
        folder = store.path / "studies" / study
        for name, declared in (("members.parquet", schema.MEMBERS), ("selections.parquet", schema.SELECTIONS)):
            if (folder / name).exists():
                try:
                    table = read_table(folder / name)
                except DamagedError as error:
                    yield Problem("", error.file, (), error.what)
                    continue
                missing = [column for column in declared.names if column not in table.column_names]
                if missing:
                    yield Problem("", folder / name, (), f"has no column {', '.join(missing)}")


def _leftovers(store: Store) -> Iterator[Path]:
    """Yield what was left behind by processes that were killed."""
    yield from store.superseded()
    hidden = [file for folder in _WORK_FOLDERS for file in store.path.glob(f"{folder}/*")]
    hidden += [file for pattern in (".sweep-store*", "failures/.*", "studies/*/.*") for file in store.path.glob(pattern)]
    kept = set(checkpoints.files(store.path))
    for file in sorted(hidden):
        try:
            if is_stale(file, _CHECKPOINT_SECONDS if file in kept else STALE_SECONDS):
                yield file
        except OSError:  # removed meanwhile
            continue
