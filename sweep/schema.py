"""Names, types and units of the tables in a store: the one truth about the Parquet files.

`hyper_fields` adds a column for each hyperparameter, whose names depend on the algorithm: a file holds the columns of its own
algorithm, and the views put files side by side by column name.
"""

from collections.abc import Mapping
from typing import Any

import pyarrow as pa

STAGES = ("tune", "evaluate")
STATUSES = ("finished", "diverged", "failed")
ENDINGS = ("terminated", "truncated", "budget")

_TEXT = pa.dictionary(pa.int32(), pa.string())


def _table(*columns: tuple[str, pa.DataType, str]) -> pa.Schema:
    return pa.schema([pa.field(name, type, metadata={"description": text}) for name, type, text in columns])


#: One row per finished trial.
TRIALS = _table(
    ("trial", pa.string(), "16 hexadecimal digits: hash of the canonical configuration"),
    ("setting", pa.string(), "16 hexadecimal digits: hash of the agent and its hyperparameters"),
    ("agent", pa.string(), "algorithm"),
    ("environment", pa.string(), "environment"),
    ("seed", pa.int64(), "key of the trial's random stream"),
    ("steps", pa.int64(), "environment steps trained"),
    ("cutoff", pa.int64(), "steps after which an episode is truncated"),
    ("discount", pa.float64(), "γ"),
    ("episodes", pa.int64(), "episodes, the budget-cut last one included"),
    ("status", pa.string(), "finished, diverged (numbers stopped being finite) or failed"),
    ("diverged_at", pa.int64(), "step at which the agent's numbers stopped being finite; NULL if they never did"),
    (
        "episode_mean",
        pa.float64(),
        "mean episodic return over completed episodes; NULL if diverged or none was completed",
    ),
    ("step_mean", pa.float64(), "mean over steps in completed episodes of their episode's return; NULL as above"),
    ("final_mean", pa.float64(), "step_mean over the last tenth of those steps; NULL as above"),
    ("best_episode", pa.float64(), "highest return of a completed episode; NULL if none was completed"),
    ("worst_episode", pa.float64(), "lowest return of a completed episode; NULL if none was completed"),
    ("wall_seconds", pa.float64(), "wall-clock time of the trial's population ÷ its size"),
    ("population", pa.int64(), "trials that were trained together"),
    ("device", pa.string(), "cpu or cuda"),
    ("engine", pa.string(), "which implementation of the population network ran"),
    ("host", pa.string(), "machine"),
    ("commit", pa.string(), "git commit of the code, with +dirty when it had local changes; NULL outside git"),
    ("versions", pa.string(), "versions of python, sweep, torch, numpy, gymnasium, mujoco (where they are installed) as JSON"),
    ("finished_at", pa.timestamp("us", tz="UTC"), "time of the commit to the store"),
)

#: Columns of `trials` that came later than the first stores: files written before lack them, and views read NULL.
LATER_COLUMNS = frozenset({"worst_episode"})

#: One row per episode.
EPISODES = _table(
    ("trial", _TEXT, "trial"),
    ("episode", pa.int32(), "counts from 0"),
    ("first_step", pa.int32(), "counts from 1"),
    ("length", pa.int32(), "environment steps"),
    (
        "episodic_return",
        pa.float32(),
        "undiscounted sum of rewards; NaN from the episode on in which the agent diverged",
    ),
    ("ending", _TEXT, "terminated, truncated (cutoff), budget (the trial's steps were used up: the return is partial)"),
)

#: One row per deterministic evaluation episode, of the trials that have any.
EVALUATIONS = _table(
    ("trial", _TEXT, "trial"),
    ("step", pa.int32(), "steps of learning before it"),
    ("episode", pa.int32(), "which of the episodes at that step, from 0"),
    ("length", pa.int32(), "environment steps"),
    ("episodic_return", pa.float32(), "undiscounted sum of rewards; NaN for an agent that had diverged"),
    ("ending", _TEXT, "terminated or truncated"),
)

#: One row per environment step.
STEPS = _table(
    ("trial", _TEXT, "trial"),
    ("step", pa.int32(), "counts from 1"),
    (
        "episodic_return",
        pa.float32(),
        "return of the episode that the step belongs to (partial when its ending is budget)",
    ),
)

#: One row per study and trial: what the study needs, finished or not.
MEMBERS = _table(
    ("study", pa.string(), "study"),
    ("stage", pa.string(), "tune or evaluate"),
    ("trial", pa.string(), "trial"),
    ("setting", pa.string(), "setting"),
    ("agent", pa.string(), "algorithm"),
    ("environment", pa.string(), "environment"),
    ("seed", pa.int64(), "key of the trial's random stream"),
    ("steps", pa.int64(), "environment steps"),
)

#: One row per study, rule, agent, environment and combination of `for_each` values: the setting that the evaluation stage
#: evaluates. `hypers` keeps what does not apply on the environment and has no column there.
SELECTIONS = _table(
    ("study", pa.string(), "study"),
    ("by", pa.string(), "per-environment or across-environments"),
    ("agent", pa.string(), "algorithm"),
    ("environment", pa.string(), "environment"),
    ("for_each", pa.string(), "values of the hyperparameters for each of which a choice is made, as JSON"),
    ("setting", pa.string(), "the chosen setting"),
    ("hypers", pa.string(), "the chosen candidate's hyperparameters, those included that do not apply here, as JSON"),
    ("score", pa.string(), "score of a run that was maximized: episode_mean, step_mean or final_mean"),
    ("normalizer", pa.string(), "thesis, minmax, percentile or cdf"),
    ("diverged", pa.string(), "what a diverged run counts for: worst or drop"),
    ("mean", pa.float64(), "mean score over the tuning runs on this environment: biased upwards, as a maximum is"),
    ("normalized", pa.float64(), "mean normalized score; across environments over all of them, which was maximized"),
    ("num_seeds", pa.int64(), "tuning runs behind the mean"),
    ("num_settings", pa.int64(), "settings that were compared"),
    ("num_left_out", pa.int64(), "settings that were not, because a run was missing or had no score"),
    ("runner_up", pa.string(), "the second best setting; NULL where there was no other"),
    ("runner_up_mean", pa.float64(), "its mean score on this environment"),
    ("runner_up_normalized", pa.float64(), "its mean normalized score, as above"),
    ("num_tied", pa.int64(), "other settings that were exactly as good: the lowest hash was chosen"),
    ("on_edge", pa.list_(pa.string()), "swept hyperparameters whose value is the lowest or highest of at least three swept"),
    ("constants", pa.string(), "the normalizer's constants on this environment, as JSON"),
    ("basis", pa.string(), "16 hexadecimal digits: hash of the tuning trials and the rules that the choice was made from"),
    ("selected_at", pa.timestamp("us", tz="UTC"), "time of the choice"),
)


def hyper_field(name: str, value: Any) -> pa.Field:
    """Return the column of a hyperparameter from one of its values: float64, int64, string, bool, or a list of these."""
    if isinstance(value, tuple | list):
        return pa.field(name, pa.list_(hyper_field("item", value[0]).type if value else pa.int64()))
    types: Mapping[type, pa.DataType] = {float: pa.float64(), int: pa.int64(), str: pa.string(), bool: pa.bool_()}
    return pa.field(name, types[type(value)])


def with_hypers(schema: pa.Schema, hypers: Mapping[str, Any], after: str = "seed") -> pa.Schema:
    """Return `schema` with a column for each hyperparameter, placed after the column `after`."""
    position = schema.get_field_index(after) + 1
    fields = list(schema)
    return pa.schema([*fields[:position], *(hyper_field(name, value) for name, value in hypers.items()), *fields[position:]])
