"""What a report knows of a study beside its figures and tables: what was planned, trained and chosen, with what, and where.

Everything is read through one connection, and so of one state of the store, but for the grid's text, failures and launches under
way, which are no tables. Rows are dictionaries by column, in a fixed order.
"""

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import duckdb

from analysis.figures.options import REGIMES
from sweep.grid_file import KEYS
from sweep.messages import UserError
from sweep.overrides import apply
from sweep.status import status
from sweep.store import Store

Rows = list[dict[str, Any]]
_LAST_LINES = 60
"""Lines of a traceback that a report shows, the last ones."""

_PROGRESS = """
SELECT stage, agent, environment, planned, finished, diverged, failed, missing
FROM study_progress WHERE study = $1
ORDER BY stage DESC, agent, environment
"""
_SEEDS = (
    "SELECT stage, LIST(DISTINCT seed ORDER BY seed) AS seeds FROM members WHERE study = $1 GROUP BY stage ORDER BY stage DESC"
)
_CONDITIONS = """
SELECT members.environment, MIN(members.steps) AS fewest_steps, MAX(members.steps) AS most_steps,
    LIST(DISTINCT trials.cutoff ORDER BY trials.cutoff) AS cutoffs,
    LIST(DISTINCT trials.discount ORDER BY trials.discount) AS discounts
FROM members LEFT JOIN trials ON trials.trial = members.trial
WHERE members.study = $1
GROUP BY members.environment
ORDER BY members.environment
"""
_GRIDS = """
WITH settings AS (
    SELECT agent, environment, setting, COUNT(DISTINCT seed) AS num_seeds, MAX(steps) AS steps
    FROM members WHERE study = $1 AND stage = 'tune' GROUP BY agent, environment, setting
)
SELECT agent, environment, COUNT(*) AS num_settings, MIN(num_seeds) AS fewest_seeds, MAX(num_seeds) AS most_seeds,
    SUM(num_seeds * steps)::BIGINT AS agent_steps
FROM settings GROUP BY agent, environment
ORDER BY agent, environment
"""
_HYPERPARAMETERS = """
SELECT hyperparameters.agent, hyperparameter, BOOL_OR(is_swept) AS is_swept,
    LIST(DISTINCT value ORDER BY TRY_CAST(value AS DOUBLE), value) AS values
FROM hyperparameters
WHERE study = $1
GROUP BY hyperparameters.agent, hyperparameter
ORDER BY hyperparameters.agent, is_swept DESC, hyperparameter
"""
_PROVENANCE = """
SELECT {column} AS value, COUNT(*) AS trials, ROUND(SUM(wall_seconds) / 3600, 6) AS hours,
    LEFT(MIN(finished_at)::VARCHAR, 16) AS first, LEFT(MAX(finished_at)::VARCHAR, 16) AS last
FROM trials
WHERE trial IN (SELECT trial FROM members WHERE study = $1) AND status IN ('finished', 'diverged')
GROUP BY value
ORDER BY trials DESC, value
"""
_TOTALS = """
SELECT COUNT(*) AS trials, COALESCE(SUM(steps), 0)::BIGINT AS agent_steps,
    ROUND(COALESCE(SUM(wall_seconds), 0) / 3600, 6) AS core_hours, COALESCE(SUM(episodes), 0)::BIGINT AS episodes,
    LEFT(MIN(finished_at)::VARCHAR, 16) AS first, LEFT(MAX(finished_at)::VARCHAR, 16) AS last,
    COUNT(*) FILTER (WHERE status = 'finished' AND episode_mean IS NULL) AS without_score,
    COUNT(*) FILTER (WHERE trial IN (SELECT trial FROM members WHERE study <> $1)) AS shared
FROM trials
WHERE trial IN (SELECT trial FROM members WHERE study = $1) AND status IN ('finished', 'diverged')
"""
_RULES = 'SELECT score, normalizer, diverged, "by" FROM study_rules WHERE study = $1'
_CHOICES = """
SELECT '{by}' AS "by", agent, environment, for_each, setting, source, mean, num_seeds,
    num_settings, num_left_out, num_tied, on_edge
FROM {view} WHERE study = $1
ORDER BY agent, environment, for_each
"""
_SHOWN = """
SELECT "by", agent, environment, for_each, stage, COUNT(*) AS runs,
    COUNT(*) FILTER (WHERE status IN ('finished', 'diverged')) AS done,
    COUNT(*) FILTER (WHERE status = 'diverged') AS diverged
FROM chosen_runs WHERE study = $1
GROUP BY ALL
ORDER BY "by" DESC, agent, environment, for_each, stage
"""
_SPREADS = """
SELECT scores.environment, MIN(scores.score) AS low, MAX(scores.score) AS high,
    ANY_VALUE(constants.best_return) AS best_return, ANY_VALUE(worst_returns.worst_return) AS worst_return
FROM normalized_scores AS scores
INNER JOIN study_rules ON study_rules.study = scores.study AND study_rules.normalizer = scores.normalizer
LEFT JOIN normalizer_constants AS constants
    ON constants.study = scores.study AND constants.environment = scores.environment AND constants.normalizer = 'thesis'
LEFT JOIN worst_returns ON worst_returns.study = scores.study AND worst_returns.environment = scores.environment
WHERE scores.study = $1 AND scores.stage = 'tune'
GROUP BY scores.environment
ORDER BY scores.environment
"""


@dataclass(frozen=True)
class Facts:
    """A study as its members, trials and choices tell it.

    `grid`: the grid's text ("" where the store does not keep it), `overrides`: what `--set` changed. `planned`: the grid as a
    table of tables, {} where there is none. `seeds`: stage → seeds. `rules`: score, normalizer, what becomes of diverged runs.
    `by`: the rules of choice that the study asks for; `choices`: the settings that tuning led to by these; `shown`: the stage
    and the number of the runs that show what a choice does. `spreads`: by environment, the normalized scores of settings.
    `failures`: trials with reason, host and the end of the error. `running`: trials that launches train just now.
    """

    study: str
    grid: str
    overrides: tuple[str, ...]
    planned: dict[str, Any]
    progress: Rows
    seeds: dict[str, list[int]]
    conditions: Rows
    grids: Rows
    hyperparameters: Rows
    provenance: dict[str, Rows]
    totals: dict[str, Any]
    rules: dict[str, str]
    by: list[str]
    choices: Rows
    shown: Rows
    spreads: Rows
    failures: Rows
    running: int

    @cached_property
    def agents(self) -> list[str]:
        """The study's agents, in alphabetical order."""
        return sorted({row["agent"] for row in self.progress})

    @cached_property
    def environments(self) -> list[str]:
        """The study's environments, in alphabetical order."""
        return sorted({row["environment"] for row in self.progress})

    @property
    def overlap(self) -> list[int]:
        """Seeds that are both tuning and evaluation seeds."""
        return sorted(set(self.seeds.get("tune", [])) & set(self.seeds.get("evaluate", [])))

    @property
    def has_choice(self) -> bool:
        """Whether any agent has several settings on an environment, so that one had to be chosen."""
        return any(row["num_settings"] > 1 for row in self.grids)

    @property
    def plans_evaluation(self) -> bool:
        """Whether the study has an evaluation stage, begun or not."""
        seeds = self.planned.get("seeds")
        return bool(self.seeds.get("evaluate") or (isinstance(seeds, dict) and seeds.get("evaluate")))

    def count(self, name: str, stage: str | None = None) -> int:
        """Return the number of trials that are planned, finished, diverged, failed or missing, in one stage or all."""
        return sum(row[name] for row in self.progress if stage in (None, row["stage"]))

    def values(self, name: str) -> list[str]:
        """Return what trials have as commit, versions, host, device or engine, the most frequent first; without NULL."""
        return [row["value"] for row in self.provenance[name] if row["value"] is not None]


def gather(connection: duckdb.DuckDBPyConnection, store: Store, study: str) -> Facts:
    """Return what is known of a study, finished or not. Raises duckdb.Error, and UserError for files that are damaged."""

    def rows(sql: str) -> Rows:
        answer = connection.execute(sql, [study])
        names = [column[0] for column in answer.description or ()]
        return [dict(zip(names, values, strict=True)) for values in answer.fetchall()]

    grid, overrides, planned = _grid(store, study)
    rules = (rows(_RULES) or [{"score": "episode_mean", "normalizer": "thesis", "diverged": "worst", "by": REGIMES}])[0]
    asked = rules.pop("by")
    by = [rule for rule in REGIMES if rule in asked]
    return Facts(
        study=study,
        grid=grid,
        overrides=overrides,
        planned=planned,
        progress=rows(_PROGRESS),
        seeds={row["stage"]: row["seeds"] for row in rows(_SEEDS)},
        conditions=rows(_CONDITIONS),
        grids=rows(_GRIDS),
        hyperparameters=rows(_HYPERPARAMETERS),
        provenance={
            column: rows(_PROVENANCE.format(column=f'"{column}"'))
            for column in ("commit", "versions", "host", "device", "engine")
        },
        totals=rows(_TOTALS)[0],
        rules=rules,
        by=by,
        choices=[row for rule in by for row in rows(_CHOICES.format(by=rule, view=f"tuned_{rule.replace('-', '_')}"))],
        shown=[row for row in rows(_SHOWN) if row["by"] in by],
        spreads=rows(_SPREADS),
        failures=_failures(store, study),
        running=sum(one.count("running") for one in status(store, [study])),
    )


def _grid(store: Store, study: str) -> tuple[str, tuple[str, ...], dict[str, Any]]:
    """Return the grid's text, overrides and tables, without checking them: the algorithms it names need not be here."""
    try:
        text, overrides = store.study_source(study)
        planned = tomllib.loads(text)
        apply(planned, overrides, KEYS)
    except (UserError, ValueError, RecursionError):
        return "", (), {}
    return text, overrides, planned


def _failures(store: Store, study: str) -> Rows:
    """Return a row for each trial of the study that failed, as of the last time that it was tried."""
    wanted = store.study_trials(study)
    found = {
        trial["trial"]: {
            **{name: trial.get(name) for name in ("trial", "agent", "environment", "seed")},
            "reason": failure.reason,
            "attempts": failure.attempts,
            "host": failure.host,
            "at": failure.at,
            "error": "\n".join(failure.error.strip().splitlines()[-_LAST_LINES:]),
        }
        for failure in store.failures()
        for trial in failure.trials
        if trial["trial"] in wanted
    }
    return [found[trial] for trial in sorted(found)]


def span(values: Iterable[float]) -> str:
    """Return one value, or the lowest and the highest: `100,000` or `10 to 30`."""
    known = sorted(set(values))
    return f"{known[0]:,g}" if len(known) == 1 else f"{known[0]:,g} to {known[-1]:,g}"


def seed_list(seeds: Sequence[int]) -> str:
    """Return seeds as ranges: `0–9, 12`."""
    parts: list[list[int]] = []
    for seed in sorted(set(seeds)):
        if parts and parts[-1][-1] == seed - 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}–{part[-1]}" for part in parts)
