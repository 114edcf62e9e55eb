"""What is true of the files of a shard, whoever wrote them: checked from the outside, with nothing that writes them.

- The files have the columns of `schema`, and tell of the same trials; each trial has one row in `trials`.
- A trial's episodes lie side by side, count from 0, and begin where the one before ended; their lengths sum to the trial's steps.
- `steps` is the episodes, spelled out row by row, or it is not there.
- The scores follow from the episodes (thesis section 6.1).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sweep import schema
from sweep.manifest import DamagedError
from sweep.shard_files import EPISODES, EVALUATIONS, STEPS, TRIALS, read_table, rows_in

_TOLERANCE = 1e-9  # of a score, in units of the largest return
_FINAL_TENTH = 0.1
_SCORES = ("episode_mean", "step_mean", "final_mean", "best_episode", "worst_episode")


@dataclass(frozen=True)
class Breach:
    """A law that a file breaks, and the trials for which it does."""

    file: Path
    what: str
    trials: tuple[str, ...]


def breaches(folder: Path, with_steps: bool = True) -> list[Breach]:
    """Return what is wrong with the tables of a shard, nothing if all is well. Of `steps`, a row group at a time is in memory.

    Raises DamagedError for a file that cannot be read.
    """
    trials, episodes = read_table(folder / TRIALS), read_table(folder / EPISODES)
    names = trials["trial"].to_pylist() if "trial" in trials.column_names else []
    every = tuple(str(name) for name in names)
    strange = [
        Breach(folder / file, what, every)
        for file, found, declared in ((TRIALS, trials.schema, schema.TRIALS), (EPISODES, episodes.schema, schema.EPISODES))
        if (what := _strangeness(found, declared, file == TRIALS))
    ]
    if strange:
        return strange
    if len(set(names)) < len(names) or None in names:
        return [Breach(folder / TRIALS, "trials are there more than once, or have no name", every)]
    if any(column.null_count for column in episodes.columns):
        return [Breach(folder / EPISODES, "has NULLs", every)]
    runs = _Runs(trials, episodes)
    found = [Breach(folder / file, what, tuple(who)) for file, what, who in runs.breaches() if who]
    if (folder / EVALUATIONS).exists():
        found += _evaluation_breaches(folder / EVALUATIONS, every)
    if with_steps and not found and (folder / STEPS).exists():
        found += _step_breaches(folder / STEPS, runs, every)
    return found


def _strangeness(found: pa.Schema, declared: pa.Schema, is_open: bool) -> str:
    """Say which columns are not as declared; nothing when all are. An open table may have others besides."""
    absent = schema.LATER_COLUMNS - {*found.names} if is_open else frozenset()
    names = [name for name in declared.names if name not in absent]
    strange = [name for name in names if _plain(found, name) != _plain(declared, name)]
    strange += [] if is_open else [name for name in found.names if name not in declared.names]
    return f"columns are not those of the schema: {', '.join(strange)}" if strange else ""


def _plain(columns: pa.Schema, name: str) -> pa.DataType | None:
    if name not in columns.names:
        return None
    type = columns.field(name).type
    return type.value_type if pa.types.is_dictionary(type) else type


class _Runs:
    """The trials and episodes of a shard as arrays: the episodes of run k are those from `start[k]` to `stop[k]`."""

    def __init__(self, trials: pa.Table, episodes: pa.Table) -> None:
        self._trials = trials
        names = _dictionary(episodes["trial"])
        codes = names.indices.to_numpy(zero_copy_only=False)
        changes = np.flatnonzero(np.diff(codes, prepend=-1))
        self.names = [names.dictionary[int(code)].as_py() for code in codes[changes]]
        self.start, self.stop = changes, np.append(changes[1:], len(codes)).astype(np.int64)
        self.owner = np.repeat(np.arange(len(changes)), self.stop - self.start)
        self.episode, self.first_step, self.length, self.episodic_return = (
            episodes[name].to_numpy() for name in ("episode", "first_step", "length", "episodic_return")
        )
        endings = _dictionary(episodes["ending"])
        self._is_known = np.array([text in schema.ENDINGS for text in endings.dictionary.to_pylist()], bool)
        self._is_budget = np.array([text == "budget" for text in endings.dictionary.to_pylist()], bool)
        self._ending = endings.indices.to_numpy(zero_copy_only=False)

    def breaches(self) -> Iterator[tuple[str, str, list[str]]]:
        """Yield file, what is wrong, and the trials that it is wrong for, of all laws but that of `steps`."""
        known = self._trials["trial"].to_pylist()
        yield EPISODES, "has episodes of trials that are not in the table trials", sorted(set(self.names) - set(known))
        yield EPISODES, "has no episode of trials of the table trials", sorted(set(known) - set(self.names))
        if len(set(self.names)) < len(self.names):
            yield EPISODES, "a trial's episodes do not lie side by side", known
        if sorted(self.names) != sorted(known):
            return
        row_of = {name: row for row, name in enumerate(known)}
        rows = self._trials.take(pa.array([row_of[name] for name in self.names], pa.int64()))
        count = self.stop - self.start
        position = np.arange(len(self.owner)) - self.start[self.owner]
        end = np.cumsum(self.length, dtype=np.int64)
        before = end - self.length  # steps before the episode, over all trials
        yield EPISODES, "episodes do not count from 0", self._runs_with(self.episode != position)
        yield EPISODES, "lengths are not positive", self._runs_with(self.length < 1)
        begins = before - before[self.start][self.owner] + 1
        yield EPISODES, "first_step is not where the episode before ended", self._runs_with(self.first_step != begins)
        yield EPISODES, "endings are not those of the schema", self._runs_with(~self._is_known[self._ending])
        total = end[self.stop - 1] - before[self.start]
        yield EPISODES, "lengths do not sum to the trial's steps", self._named(total != _numbers(rows["steps"]))
        yield TRIALS, "episodes is not the number of episodes", self._named(count != _numbers(rows["episodes"]))
        status = np.array(rows["status"].to_pylist())
        diverged = status == "diverged"
        fits = np.isin(status, ("finished", "diverged")) & (diverged == ~np.isnan(_numbers(rows["diverged_at"])))
        yield TRIALS, "status and diverged_at do not go together", self._named(~fits)
        scores, scale = self._scores(diverged)
        for name in (name for name in _SCORES if name in rows.column_names):  # stores of old lack the later ones
            given = _numbers(rows[name])
            same = (np.abs(given - scores[name]) <= _TOLERANCE * scale) | (np.isnan(given) & np.isnan(scores[name]))
            yield TRIALS, f"{name} does not follow from the episodes", self._named(~(same | (given == scores[name])))

    def _named(self, is_wrong: np.ndarray) -> list[str]:
        return [self.names[run] for run in np.flatnonzero(is_wrong)]

    def _runs_with(self, is_wrong: np.ndarray) -> list[str]:
        return [self.names[run] for run in np.unique(self.owner[is_wrong])]

    def _scores(self, diverged: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the scores of each run, NaN for none, and the largest return in it without its sign, 1 at least."""
        returns = self.episodic_return.astype(np.float64)
        completed = ~self._is_budget[self._ending]
        weight = np.where(completed, self.length, 0).astype(np.int64)
        value = np.where(completed, returns, 0.0)
        in_completed = self._sum(weight)
        # the last tenth of the steps in completed episodes: count them backwards
        until = np.cumsum(weight)
        after = until[self.stop - 1][self.owner] - until
        window = np.maximum(1, np.rint(_FINAL_TENTH * in_completed)).astype(np.int64)
        final = np.clip(window[self.owner] - after, 0, weight)
        counts = completed & np.isfinite(returns)
        with np.errstate(invalid="ignore", divide="ignore"):
            scores = {
                "episode_mean": self._sum(value) / self._sum(completed.astype(np.int64)),
                "step_mean": self._sum(value * weight) / in_completed,
                "final_mean": self._sum(value * final) / self._sum(final),
            }
        for name in scores:
            scores[name] = np.where(diverged | (in_completed == 0), np.nan, scores[name])
        highest = np.maximum.reduceat(np.where(counts, returns, -np.inf), self.start)
        lowest = np.minimum.reduceat(np.where(counts, returns, np.inf), self.start)
        scores["best_episode"] = np.where(np.isneginf(highest), np.nan, highest)
        scores["worst_episode"] = np.where(np.isposinf(lowest), np.nan, lowest)
        scale = np.maximum(1.0, np.maximum.reduceat(np.where(np.isfinite(returns), np.abs(returns), 0.0), self.start))
        return scores, scale

    def _sum(self, values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values, self.start)


def _numbers(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as float64, NaN for NULL."""
    return column.cast(pa.float64()).to_numpy(zero_copy_only=False)


def _dictionary(column: pa.ChunkedArray) -> pa.DictionaryArray:
    chunk = column.combine_chunks()
    return chunk.chunk(0) if isinstance(chunk, pa.ChunkedArray) else chunk


def _evaluation_breaches(file: Path, every: tuple[str, ...]) -> list[Breach]:
    evaluations = read_table(file)
    what = _strangeness(evaluations.schema, schema.EVALUATIONS, False)
    if not what and not set(evaluations["trial"].unique().to_pylist()) <= set(every):
        what = "has evaluation episodes of trials that are not in the table trials"
    return [Breach(file, what, every)] if what else []


def _step_breaches(file: Path, runs: _Runs, every: tuple[str, ...]) -> list[Breach]:
    """Compare each row group with the episodes that its rows belong to, by their place in the file."""
    end = np.cumsum(runs.length, dtype=np.int64)
    rows = int(end[-1]) if len(end) else 0
    if rows_in(file) != rows:
        return [Breach(file, f"has {rows_in(file):,} rows, the episodes {rows:,} steps", every)]
    number_of = {name: run for run, name in enumerate(runs.names)}
    wrong: set[int] = set()
    start = 0
    try:
        with pq.ParquetFile(file, read_dictionary=["trial"], page_checksum_verification=True) as opened:
            what = _strangeness(opened.schema_arrow, schema.STEPS, False)
            if what:
                return [Breach(file, what, every)]
            for group in range(opened.num_row_groups):
                table = opened.read_row_group(group, use_threads=False).unify_dictionaries()
                stop = start + table.num_rows
                first, last = np.searchsorted(end, (start, stop - 1), side="right")
                times = np.diff(np.minimum(end[first : last + 1], stop), prepend=start)
                names = _dictionary(table["trial"])
                owners = np.array([number_of.get(name, -1) for name in names.dictionary.to_pylist()], np.int64)
                owner = np.repeat(runs.owner[first : last + 1], times)
                offset = (runs.first_step.astype(np.int64) - (end - runs.length))[first : last + 1]
                given, expected = table["episodic_return"].to_numpy(), np.repeat(runs.episodic_return[first : last + 1], times)
                right = owners[names.indices.to_numpy(zero_copy_only=False)] == owner
                right &= table["step"].to_numpy() == np.arange(start, stop) + np.repeat(offset, times)
                right &= (given == expected) | (np.isnan(given) & np.isnan(expected))
                wrong.update(np.unique(owner[~right]).tolist())
                start = stop
    except (OSError, ValueError, pa.ArrowException) as error:
        raise DamagedError(file, f"cannot be read ({str(error).partition(chr(10))[0]})") from None
    trials = tuple(runs.names[run] for run in sorted(wrong))
    return [Breach(file, "is not the episodes spelled out, row by row", trials)] if trials else []
