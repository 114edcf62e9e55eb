"""The rows of a store from the records of training: trials and episodes as Arrow tables, steps a block at a time.

Scores of a run (thesis section 6.1; names as in the tables): the budget-cut last episode never enters a mean.
"""

import datetime
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sweep import schema
from sweep.provenance import Provenance

if TYPE_CHECKING:
    from sweep.trials import Trial

_BUDGET = schema.ENDINGS.index("budget")
FINAL_SHARE = 0.1


class EpisodeColumns(Protocol):
    """The records of a population: what `agents.records.Records` declares, without importing it (it needs torch)."""

    @property
    def steps(self) -> int: ...
    @property
    def agent(self) -> np.ndarray: ...
    @property
    def episode(self) -> np.ndarray: ...
    @property
    def first_step(self) -> np.ndarray: ...
    @property
    def length(self) -> np.ndarray: ...
    @property
    def episodic_return(self) -> np.ndarray: ...
    @property
    def ending(self) -> np.ndarray: ...
    @property
    def diverged_at(self) -> np.ndarray: ...


@dataclass(frozen=True)
class ShardTables:
    """The tables of a shard, which are committed together; `evaluations` if its trials have evaluation episodes.

    The rows of `steps` are never here all at once: there may be a hundred million, and they follow from the episodes.
    """

    trials: pa.Table
    episodes: pa.Table
    evaluations: pa.Table | None = None

    def steps_in_blocks(self, rows: int) -> Iterator[pa.RecordBatch]:
        """Yield the table `steps`, trial after trial, in batches of `rows` rows; the last one holds the rest.

        A batch may end within a trial, and may hold several short ones.
        """
        trial = self.episodes["trial"].combine_chunks()
        owner = trial.indices.to_numpy()
        first_step, length, episodic_return = (
            self.episodes[name].to_numpy() for name in ("first_step", "length", "episodic_return")
        )
        end = np.cumsum(length, dtype=np.int64)
        before = end - length  # rows before an episode's own
        for start in range(0, int(length.sum()), rows):
            stop = min(start + rows, end[-1])
            first, last = np.searchsorted(end, [start, stop - 1], side="right")
            here = slice(first, last + 1)  # the episodes with rows in this block, the first and the last perhaps in part
            times = np.minimum(end[here], stop) - np.maximum(before[here], start)
            step = np.arange(start, stop) + np.repeat(first_step[here] - before[here], times)
            # a file repeats the dictionary in every row group: it names the trials of this block only
            names = trial.dictionary[owner[first] : owner[last] + 1]
            yield pa.record_batch(
                {
                    "trial": pa.DictionaryArray.from_arrays(np.repeat(owner[here] - owner[first], times), names),
                    "step": step.astype(np.int32),
                    "episodic_return": np.repeat(episodic_return[here], times),
                },
                schema.STEPS,
            )

    def without(self, trials: set[str]) -> "ShardTables":
        """Return the tables without the rows of some trials."""
        kept = pa.array([name for name in self.trials["trial"].to_pylist() if name not in trials], pa.string())
        tables = [self.trials, self.episodes, *([self.evaluations] if self.evaluations is not None else [])]
        return ShardTables(*(table.filter(pc.is_in(table["trial"], kept)) for table in tables))


def shard_tables(
    trials: Sequence["Trial"], records: EpisodeColumns, wall_seconds: float | Sequence[float], provenance: Provenance
) -> ShardTables:
    """Return the tables of trials that were trained together, agent p of the records being trial p.

    `wall_seconds` are those of all trials together; or each trial's own, of trials that were trained one after another.
    Raises ValueError when the episodes do not fill the trials' steps.
    """
    if records.length.sum() != len(trials) * records.steps:
        raise ValueError(
            f"the episodes have {records.length.sum():,} steps: {len(trials):,} trials of {records.steps:,} were trained"
        )
    if isinstance(wall_seconds, float | int):
        each, population = [wall_seconds / len(trials)] * len(trials), len(trials)
    else:
        each, population = list(wall_seconds), 1
    ids = [trial.id for trial in trials]
    episodes = {
        "trial": pa.DictionaryArray.from_arrays(pa.array(records.agent, pa.int32()), pa.array(ids, pa.string())),
        "episode": records.episode,
        "first_step": records.first_step,
        "length": records.length,
        "episodic_return": records.episodic_return,
        "ending": pa.DictionaryArray.from_arrays(pa.array(records.ending, pa.int32()), pa.array(schema.ENDINGS)),
    }
    rows = [
        {
            **identity_columns(trial),
            **run_scores(records, agent),
            "wall_seconds": each[agent],
            "population": population,
            **provenance.columns(),
            "finished_at": datetime.datetime.now(datetime.UTC),
        }
        for agent, trial in enumerate(trials)
    ]
    return ShardTables(
        trials=pa.Table.from_pylist(rows, schema.with_hypers(schema.TRIALS, trials[0].applicable_hypers)),
        episodes=pa.table(episodes, schema.EPISODES),
        evaluations=_evaluations_table(ids, getattr(records, "evaluations", None)),
    )


def _evaluations_table(ids: list[str], evaluations: Any) -> pa.Table | None:
    if evaluations is None:
        return None
    columns = {name: getattr(evaluations, name) for name in ("step", "episode", "length", "episodic_return")}
    trial = pa.DictionaryArray.from_arrays(pa.array(evaluations.agent, pa.int32()), pa.array(ids, pa.string()))
    ending = pa.DictionaryArray.from_arrays(pa.array(evaluations.ending, pa.int32()), pa.array(schema.ENDINGS))
    return pa.table({"trial": trial, **columns, "ending": ending}, schema.EVALUATIONS)


def identity_columns(trial: "Trial") -> dict[str, Any]:
    """Return the columns of `trials` that are known before a trial is trained."""
    return {
        "trial": trial.id,
        "setting": trial.setting,
        "agent": trial.agent,
        "environment": trial.environment,
        "seed": trial.seed,
        **trial.applicable_hypers,
        "steps": trial.steps,
        "cutoff": trial.cutoff,
        "discount": trial.discount,
    }


def run_scores(records: EpisodeColumns, agent: int) -> dict[str, Any]:
    """Return status, counts and scores of one run; a score without completed episodes, or of a diverged run, is None.

    episode_mean: unweighted mean over completed episodes. step_mean: mean over the steps in completed episodes of their
    episode's return. final_mean: the same over the last tenth (FINAL_SHARE) of those steps. best_episode and
    worst_episode: the highest and the lowest return of a completed episode, which a run that diverged later may have too.
    """
    first, last = np.searchsorted(records.agent, [agent, agent + 1])
    completed = records.ending[first:last] != _BUDGET
    returns = records.episodic_return[first:last][completed].astype(np.float64)
    lengths = records.length[first:last][completed].astype(np.int64)
    diverged_at = int(records.diverged_at[agent]) or None
    finite = returns[np.isfinite(returns)]
    scores: dict[str, float | None] = {"episode_mean": None, "step_mean": None, "final_mean": None}
    if diverged_at is None and len(returns):
        in_completed = lengths.sum()
        window_start = in_completed - max(1, round(FINAL_SHARE * in_completed))
        ends = lengths.cumsum()
        in_window = np.clip(ends - window_start, 0, lengths)
        scores = {
            "episode_mean": float(returns.mean()),
            "step_mean": float(np.average(returns, weights=lengths)),
            "final_mean": float(np.average(returns, weights=in_window)),
        }
    return {
        "episodes": int(last - first),
        "status": "diverged" if diverged_at else "finished",
        "diverged_at": diverged_at,
        **scores,
        "best_episode": float(finite.max()) if len(finite) else None,
        "worst_episode": float(finite.min()) if len(finite) else None,
    }


def members_table(study: str, stages: Mapping[str, Sequence["Trial"]]) -> pa.Table:
    """Return the trials that a study needs, stage by stage (`schema.STAGES`), with the hyperparameters of all agents as columns.

    A trial that two stages need has two rows. A hyperparameter that is of different types in different agents becomes a text.
    """
    stage_names = [stage for stage, trials in stages.items() for _ in trials]
    members = [trial for trials in stages.values() for trial in trials]
    # a setting's hyperparameters are looked at once: most trials differ by their seeds alone
    number_of: dict[tuple[str, int], int] = {}
    settings: list[dict[str, Any]] = []
    owner = np.empty(len(members), np.int64)
    for position, trial in enumerate(members):
        number = number_of.setdefault((trial.environment, id(trial.hypers)), len(settings))
        if number == len(settings):
            settings.append(trial.applicable_hypers)
        owner[position] = number
    hypers = _one_type_each(settings)
    columns: dict[str, Any] = {"study": [study] * len(members), "stage": stage_names}
    for name in ("id", "setting", "agent", "environment", "seed", "steps"):
        columns["trial" if name == "id" else name] = [getattr(trial, name) for trial in members]
    types = schema.with_hypers(schema.MEMBERS, hypers)
    for name in hypers:
        columns[name] = pa.array([setting.get(name) for setting in settings], types.field(name).type).take(pa.array(owner))
    return pa.table({name: columns[name] for name in types.names}, types)


def _one_type_each(settings: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a value of each hyperparameter; those of several types are made texts in all settings."""
    samples: dict[str, Any] = {}
    texts: set[str] = set()
    for setting in settings:
        for name, value in setting.items():
            sample = samples.setdefault(name, value)
            if sample is not value and schema.hyper_field(name, sample).type != schema.hyper_field(name, value).type:
                texts.add(name)
    if texts:
        settings[:] = [{name: str(v) if name in texts else v for name, v in setting.items()} for setting in settings]
    return samples | dict.fromkeys(texts, "")
