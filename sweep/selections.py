"""Selections in a store: what was chosen is written down once, with what it was chosen from, and read by every later launch.

    studies/<study>/selections.parquet      `schema.SELECTIONS`, with a column for each hyperparameter

A selection is valid as long as its `basis` is that of the study: the same tuning trials and the same rules. Evaluation seeds
are no part of it, so that more of them can be asked for later without a new choice. The normalizer's constants are kept beside
the choices: evaluation runs are put on the scale that the choice was made on.
"""

import contextlib
import datetime
import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from agents.hypers import HyperparameterError, Hypers
from agents.registry import find_algorithm, find_environment
from sweep import schema
from sweep.files import UnwritableError, write_atomically
from sweep.grid import Grid
from sweep.messages import UserError
from sweep.normalizers import Normalizer
from sweep.selection import Choice, TrialScores, settings_of
from sweep.shard_files import EPISODES, TRIALS, read_table
from sweep.store import Store
from sweep.trials import Trial, candidates

_FILE = "selections.parquet"
_TEXTS = ("for_each", "hypers", "constants")  # columns of JSON


@dataclass(frozen=True)
class FrozenSelection:
    """A selection as a store keeps it. `rows`: the file's rows, `for_each`, `hypers` and `constants` no longer as text."""

    file: Path
    basis: str
    rows: list[dict[str, Any]]

    def chosen(self) -> list[tuple[str, str, Hypers]]:
        """Return agent, environment and hyperparameters of each choice, each once.

        Raises UserError when an agent does not take its hyperparameters any more.
        """
        chosen: dict[tuple[str, str, str], tuple[str, str, Hypers]] = {}
        for row in self.rows:
            try:
                hypers = find_algorithm(row["agent"]).hypers(**row["hypers"])
            except (HyperparameterError, LookupError, TypeError) as error:
                raise UserError(f"{self.file}: {row['agent']}: the chosen setting is none any more: {error}") from None
            chosen.setdefault((row["agent"], row["environment"], row["setting"]), (row["agent"], row["environment"], hypers))
        return list(chosen.values())

    def holds(self, selection: pa.Table) -> bool:
        """Return whether a selection is this one, whenever it was made."""
        rows = [dict(row) for row in selection.to_pylist()]
        for row in rows:
            row |= {name: json.loads(row[name]) for name in _TEXTS} | {"selected_at": None}
        return rows == [row | {"selected_at": None} for row in self.rows]

    def normalizer(self) -> Normalizer:
        """Return the normalizer that the selection was made with, for other runs on its environments."""
        return Normalizer.from_constants(self.rows[0]["normalizer"], {row["environment"]: row["constants"] for row in self.rows})


def basis(grid: Grid, tuning_trials: Iterable[Trial]) -> str:
    """Return 16 hexadecimal digits for all that choices depend on: the tuning trials, the candidates, and [select]."""
    rules = grid.select
    known = {
        "trials": sorted({trial.id for trial in tuning_trials}),
        "candidates": sorted([known.agent, sorted(settings_of(grid, known).values())] for known in candidates(grid)),
        "select": [sorted(rules.by), rules.score, rules.normalizer, rules.diverged, sorted(rules.for_each)],
    }
    return hashlib.sha256(json.dumps(known, separators=(",", ":")).encode()).hexdigest()[:16]


def table(study: str, choices: Iterable[Choice], basis: str, constants: Mapping[str, Mapping[str, Any]]) -> pa.Table:
    """Return the rows of a selection; `constants` are the normalizer's, by environment.

    A hyperparameter that is of different types in different agents becomes a text. One that is named like a column of
    `schema.SELECTIONS` has none of its own.
    """
    choices = list(choices)
    now = datetime.datetime.now(datetime.UTC)
    columns = [_hyper_columns(choice) for choice in choices]
    examples: dict[str, Any] = {}
    texts: set[str] = set()
    for row in columns:
        for name, value in row.items():
            if schema.hyper_field(name, examples.setdefault(name, value)).type != schema.hyper_field(name, value).type:
                texts.add(name)
    rows = [
        {
            **{name: str(value) if name in texts else value for name, value in hypers.items()},
            **{name: getattr(choice, name) for name in schema.SELECTIONS.names if hasattr(choice, name)},
            "study": study,
            "for_each": json.dumps(choice.for_each),
            "hypers": json.dumps(choice.hypers.as_dict()),
            "constants": json.dumps(constants[choice.environment]),
            "basis": basis,
            "selected_at": now,
        }
        for choice, hypers in zip(choices, columns, strict=True)
    ]
    hypers = {name: "" if name in texts else value for name, value in examples.items()}
    return pa.Table.from_pylist(rows, schema.with_hypers(schema.SELECTIONS, hypers, after="setting"))


def _hyper_columns(choice: Choice) -> dict[str, Any]:
    applicable = choice.hypers.applicable(find_environment(choice.environment).actions)
    return {name: value for name, value in applicable.items() if name not in schema.SELECTIONS.names}


def write_selection(store: Store, study: str, selection: pa.Table) -> None:
    """Freeze a selection in the store, in place of an earlier one of the study. Raises UnwritableError."""
    file = store.path / "studies" / study / _FILE
    sink = pa.BufferOutputStream()
    pq.write_table(selection, sink, compression="zstd", write_page_checksum=True, store_schema=False)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, sink.getvalue().to_pybytes())
    except OSError as error:
        message = f"{file}: the selection cannot be written to this store: {error.strerror or error}"
        raise UnwritableError(message, error.errno) from None


def read_selection(store: Store, study: str) -> FrozenSelection | None:
    """Return what is frozen for a study, None when nothing is. Raises UserError naming a file that is damaged."""
    file = store.path / "studies" / study / _FILE
    if not file.exists():
        return None
    try:
        frozen = pq.read_table(file, partitioning=None, page_checksum_verification=True)
        types = frozen.select(schema.SELECTIONS.names).schema.types  # names and types of columns have no checksum
        if types != schema.SELECTIONS.types or any(map(pa.types.is_binary, frozen.schema.types)):
            raise ValueError("its columns are of other types")
        rows = frozen.to_pylist()
        for row in rows:
            row |= {name: json.loads(row[name]) for name in _TEXTS}
        hypers = {name for row in rows for name in row["hypers"]}
        if not {*frozen.column_names} <= {*schema.SELECTIONS.names, *hypers}:
            raise ValueError("it has columns that are no hyperparameters")
        bases = {row["basis"] for row in rows}
        if len(bases) > 1:
            raise ValueError("its rows belong to different selections")
        return FrozenSelection(file, bases.pop(), rows) if rows else None
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{file}: is damaged and cannot be read: {error}; once removed, the next launch chooses again") from None


def gather_scores(store: Store, trials: Sequence[Trial], score: str) -> tuple[dict[str, TrialScores], dict[str, float]]:
    """Return what selection needs to know of the trials that are in the store, by trial, and the worst returns by environment.

    `score` names the column. A worst return is the lowest of a completed episode of all the trials on an environment; it
    is looked for where one of them diverged. Raises DamagedError (UserError) naming a file that cannot be read.
    """
    environments = {trial.id: trial.environment for trial in trials}
    while True:
        with contextlib.suppress(FileNotFoundError):  # a shard that was compacted since it was listed
            return _gather(store, environments, score)


def _gather(store: Store, environments: Mapping[str, str], score: str) -> tuple[dict[str, TrialScores], dict[str, float]]:
    scores: dict[str, TrialScores] = {}
    members: dict[Path, set[str]] = {}
    for shard in store.shards():
        columns = read_table(shard / TRIALS, ["trial", "status", score, "best_episode"]).to_pydict()
        for trial, *values in zip(*columns.values(), strict=True):
            if trial in environments:
                scores[trial] = TrialScores(*values)
                members.setdefault(shard, set()).add(trial)
    diverged = {environments[trial] for trial, known in scores.items() if known.status == "diverged"}
    worst: dict[str, float] = {}
    for shard, ids in members.items():
        wanted = {trial for trial in ids if environments[trial] in diverged}
        if wanted:
            for trial, lowest in _lowest_returns(shard / EPISODES, wanted):
                worst[environments[trial]] = min(worst.get(environments[trial], math.inf), lowest)
    return scores, worst


def _lowest_returns(file: Path, trials: set[str]) -> Iterable[tuple[str, float]]:
    """Yield the lowest return of a completed episode of each of the trials that has any."""
    episodes = read_table(file, ["trial", "episodic_return", "ending"])
    completed = pc.and_(pc.not_equal(episodes["ending"], "budget"), pc.is_finite(episodes["episodic_return"]))
    wanted = pc.is_in(episodes["trial"], pa.array(sorted(trials), pa.string()))
    lowest = episodes.filter(pc.and_(completed, wanted)).group_by("trial").aggregate([("episodic_return", "min")])
    return zip(lowest["trial"].to_pylist(), lowest["episodic_return_min"].to_pylist(), strict=True)
