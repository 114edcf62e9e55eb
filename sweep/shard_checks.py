"""One shard, checked: every file against the manifest, then the tables against the laws (`sweep.laws`)."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from sweep import files, manifest
from sweep.laws import breaches
from sweep.manifest import DamagedError
from sweep.shard_files import EPISODES, EVALUATIONS, STEPS, TRIALS, read_table, rows_in


@dataclass(frozen=True)
class Problem:
    """What is wrong with a file, and the trials that it spoils. `shard` is its folder's name, "" for a file of a study."""

    shard: str
    file: Path
    trials: tuple[str, ...]
    what: str


@dataclass
class CheckedShard:
    """What is known of a shard once it is checked: trials from any file that still tells, the bytes of all files."""

    name: str
    trials: frozenset[str] = frozenset()
    bytes: int = 0
    has_checksums: bool = True
    problems: list[Problem] = field(default_factory=list)


def check(folder: Path, *, quick: bool = False) -> CheckedShard | None:
    """Check a shard, but not its `steps` against its episodes if `quick`; None when it is gone: compacted meanwhile."""
    shard = CheckedShard(folder.name)
    try:
        shard.trials = _trials_anywhere(folder)
        shard.problems += _file_problems(folder, shard)
        if not shard.problems:
            found = breaches(folder, with_steps=not quick)
            shard.problems += [Problem(folder.name, breach.file, breach.trials, breach.what) for breach in found]
    except DamagedError as error:
        shard.problems.append(Problem(folder.name, error.file, tuple(sorted(shard.trials)), error.what))
    except FileNotFoundError:
        pass
    except Exception as error:  # damage may have any effect: whatever it is, the other shards are checked
        what = f"cannot be checked ({type(error).__name__}: {error})"
        shard.problems.append(Problem(folder.name, folder, tuple(sorted(shard.trials)), what))
    return shard if folder.exists() else None


def _file_problems(folder: Path, shard: CheckedShard) -> Iterator[Problem]:
    """Yield files that are missing, of another size or content than was written, or that nobody wrote. Raises DamagedError."""
    known = manifest.read(folder)
    shard.has_checksums = known is not None
    there = {file.name: file.stat().st_size for file in folder.iterdir()}
    shard.bytes = sum(there.values())

    def problem(name: str, what: str) -> Problem:
        return Problem(folder.name, folder / name, tuple(sorted(shard.trials)), what)

    expected = set(known.files) if known else {TRIALS, EPISODES, STEPS}
    for name in sorted({TRIALS, EPISODES} | expected):
        if name not in there:
            yield problem(name, "it is missing")
        elif known is None:
            continue
        elif name not in known.files:
            yield problem(name, "the manifest does not name it")
        elif there[name] != known.files[name].bytes:
            yield problem(name, f"{there[name]:,} bytes, {known.files[name].bytes:,} were written")
        elif files.digest(folder / name) != known.files[name].sha256:
            yield problem(name, "its content is not what was written (SHA-256)")
        elif rows_in(folder / name) != known.files[name].rows:
            yield problem(name, f"{rows_in(folder / name):,} rows, {known.files[name].rows:,} were written")
    for name in (EVALUATIONS, STEPS):
        if known and name in there and name not in expected:
            yield problem(name, "the manifest does not name it")


def _trials_anywhere(folder: Path) -> frozenset[str]:
    """Return the trials of a shard, from whichever file still tells."""
    for name in (TRIALS, EPISODES, EVALUATIONS, STEPS):
        try:
            return frozenset(str(trial) for trial in read_table(folder / name, ["trial"])["trial"].unique().to_pylist())
        except DamagedError:
            continue
    return frozenset()
