"""The runs that show what the chosen settings do, as arrays: by tuning regime, agent and environment, as they are or normalized.

They are the evaluation runs where the study has any, else its tuning runs (view `chosen_runs`). A run that diverged counts
by the study's rule: it has the worst return of the environment, or is left out (view `run_scores`). One that is left out, is
missing, failed or completed no episode has no score and is counted apart; so an environment may be there on which no run has one.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import duckdb
import numpy as np

from analysis import tuning_scale
from analysis.figures.options import REGIMES, NoDataError, Options
from sweep.messages import UserError
from sweep.normalizers import UndefinedNormalizerError

FEW_RUNS = 10
"""Below this intervals cover less than they say, and cannot be trusted where some runs collapse."""
_RUNS = """
-- One row per (by, agent, for_each, environment, seed): the score of each run of a chosen setting, under the regimes that the
-- study's selection names, or both where nothing is selected yet.
SELECT
    chosen_runs.study,
    chosen_runs.by,
    chosen_runs.agent,
    chosen_runs.for_each,
    chosen_runs.environment,
    chosen_runs.stage,
    chosen_runs.setting,
    chosen_runs.trial,
    chosen_runs.seed,
    chosen_runs.status,
    run_scores.is_dropped,
    run_scores.{score}
FROM chosen_runs
INNER JOIN run_scores
    ON run_scores.study = chosen_runs.study
    AND run_scores.stage = chosen_runs.stage
    AND run_scores.trial = chosen_runs.trial
WHERE
    chosen_runs.study = '{study}'
    AND (
        chosen_runs.by IN (SELECT selections.by FROM selections WHERE selections.study = '{study}')
        OR NOT EXISTS (FROM selections WHERE selections.study = '{study}')
    )
ORDER BY chosen_runs.by DESC, chosen_runs.agent, chosen_runs.for_each, chosen_runs.environment, chosen_runs.seed
"""

_Row = tuple[str, int, str, bool, float | None]
"""Setting, seed, status, whether the run is left out, score."""


@dataclass(frozen=True)
class Runs:
    """The runs of a chosen setting on an environment: `seeds` and `scores` [n] of those that have a score, by seed.

    `diverged` [n]: which of them diverged. `num_dropped`: runs that diverged and are left out. `num_failed`: runs that failed, or
    completed no episode. `num_missing`: those to come.
    """

    setting: str
    seeds: tuple[int, ...]
    scores: np.ndarray
    diverged: np.ndarray
    num_failed: int
    num_missing: int
    num_dropped: int = 0

    @property
    def num_done(self) -> int:
        """How many runs there are, with a score or without."""
        return len(self.scores) + self.num_failed + self.num_dropped

    def describe(self) -> str:
        """Return what became of runs that did not simply finish, "" where all did."""
        said = [f"{self.diverged.sum()} diverged, counted as the worst return"] if self.diverged.any() else []
        said += [f"{self.num_dropped} diverged, left out"] if self.num_dropped else []
        said += [f"{self.num_failed} failed"] if self.num_failed else []
        said += [f"{self.num_missing} missing"] if self.num_missing else []
        said += [] if len(self.scores) else ["no run has a score"]
        return "; ".join(said)

    def at(self, seeds: Sequence[int]) -> np.ndarray:
        """Return the scores of these seeds, in their order. Raises ValueError for a seed without one."""
        return self.scores[[self.seeds.index(seed) for seed in seeds]]


@dataclass(frozen=True)
class Chosen:
    """What an agent's settings, chosen by one regime, do: `runs` by environment.

    `name`: the agent, with the values that the settings were chosen for where there is a choice for each of several.
    """

    by: str
    agent: str
    name: str
    runs: dict[str, Runs]

    def on(self, environments: Iterable[str]) -> "Chosen":
        """Return the same on these environments alone."""
        return replace(self, runs={environment: self.runs[environment] for environment in environments})


@dataclass(frozen=True)
class ChosenRuns:
    """The chosen settings of a study, by regime (per environment first), agent and value that they were chosen for.

    `score`: column of `trials`. `stage`, `steps`: of the runs. `normalizer`: None while scores are as they are. `sql`: the query
    of the scores. `is_choice`: whether there was more than one setting to choose from.
    """

    study: str
    score: str
    stage: str
    steps: int
    normalizer: str | None
    is_choice: bool
    sql: str
    groups: list[Chosen]

    @property
    def regimes(self) -> list[str]:
        """The regimes that there are, per environment first."""
        return [by for by in REGIMES if any(group.by == by for group in self.groups)]

    @property
    def environments(self) -> list[str]:
        """Environments in alphabetical order."""
        return sorted({environment for group in self.groups for environment in group.runs})

    @property
    def names(self) -> list[str]:
        """The names of groups, each once, in order."""
        return list(dict.fromkeys(group.name for group in self.groups))

    @property
    def unscored(self) -> list[str]:
        """A line for each setting and environment where no run has a score."""
        return [
            _say(group, environment, runs)
            for group in self.groups
            for environment, runs in group.runs.items()
            if not len(runs.scores)
        ]

    def scored(self) -> "ChosenRuns":
        """Return the same without the environments, and agents, of which no run has a score."""
        groups = [group.on(place for place, runs in group.runs.items() if len(runs.scores)) for group in self.groups]
        return replace(self, groups=[group for group in groups if group.runs])

    def of(self, by: str) -> list[Chosen]:
        """Return the groups of a regime."""
        return [group for group in self.groups if group.by == by]

    def subtitle(self) -> str:
        """Return n, steps, score, stage and normalizer: `30 evaluation runs each, 100,000 steps, episode mean, …`."""
        counts = {len(runs.scores) for group in self.scored().groups for runs in group.runs.values()}
        number = f"{min(counts)} to {max(counts)}" if len(counts) > 1 else f"{min(counts)}"
        kind = "evaluation" if self.stage == "evaluate" else "tuning"
        normalized = f", normalizer {self.normalizer}" if self.normalizer else ""
        runs = "run" if counts == {1} else "runs"
        return f"{number} {kind} {runs} each, {self.steps:,} steps, {self.score.replace('_', ' ')}{normalized}"

    def notes(self) -> list[str]:
        """Return what a reader has to know: runs that the choice was made by, few, diverged, failed or missing runs."""
        lines = []
        if self.normalizer == "thesis" and len(self.environments) > 1:
            lines.append(
                "normalizer thesis does not weigh environments equally; --normalizer percentile or cdf does, or nearly so"
            )
        if self.stage != "evaluate" and self.is_choice:
            lines.append(
                "these are the tuning runs that the settings were chosen by: the scores are too good; "
                "`sweep launch` evaluates a study with [seeds] evaluate on fresh seeds"
            )
        fewest = min(len(runs.scores) for group in self.scored().groups for runs in group.runs.values())
        if fewest < 2:
            lines.append("one run: no interval; it needs two at least")
        elif fewest < FEW_RUNS:
            lines.append(f"{fewest} runs are few: under {FEW_RUNS} intervals cover less than they say, the bootstrap's above all")
        for group in self.groups:
            for environment, runs in group.runs.items():
                if runs.describe():
                    lines.append(_say(group, environment, runs))
        return lines


def studies_with_chosen_runs(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies with runs of chosen settings, those with evaluation runs first."""
    rows = connection.execute(
        """
        SELECT study
        FROM chosen_runs
        WHERE status IN ('finished', 'diverged')
        GROUP BY study
        ORDER BY MIN(stage), study
        """
    ).fetchall()
    return [row[0] for row in rows]


def load_chosen(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> ChosenRuns:
    """Return the scores of the runs of chosen settings that `options` ask for; the score is the study's own by default.

    An environment on which no run has a score is there, without scores. Raises NoDataError where there is none with any.
    """
    score = options.score or _rule(connection, study, "score")
    sql = _RUNS.format(score=score, study=study.replace("'", "''"))
    rows = [row[1:] for row in connection.execute(sql).fetchall()]
    found: dict[tuple[str, str, str], dict[str, list[_Row]]] = {}
    stages: set[str] = set()
    for by, agent, for_each, environment, stage, setting, _, seed, status, is_dropped, value in rows:
        if options.keeps(agent, environment) and options.by in (None, by):
            runs = found.setdefault((by, agent, for_each), {}).setdefault(environment, [])
            runs.append((setting, seed, status, is_dropped, value))
            stages.add(stage)
    groups = [
        Chosen(by, agent, _name(agent, for_each), {environment: _runs(listed) for environment, listed in places.items()})
        for (by, agent, for_each), places in found.items()
    ]
    if not any(len(runs.scores) for group in groups for runs in group.runs.values()):
        asked = ", ".join((*((options.by,) if options.by else ()), *options.agents, *options.environments))
        raise NoDataError(
            f'study "{study}" has no finished run of a chosen setting'
            + (f" ({asked})" if asked else "")
            + ": `sweep launch` trains them"
        )
    steps, is_choice = connection.execute(
        """
        SELECT MAX(steps), MAX(num_settings) > 1
        FROM (
            SELECT MAX(steps) AS steps, COUNT(DISTINCT setting) AS num_settings
            FROM members
            WHERE study = ?
            GROUP BY agent, environment
        )
        """,
        [study],
    ).fetchall()[0]
    return ChosenRuns(study, score, stages.pop(), steps, None, is_choice, sql, groups)


def normalize(connection: duckdb.DuckDBPyConnection, chosen: ChosenRuns, name: str | None) -> ChosenRuns:
    """Return the runs with normalized scores; `name` None is the study's normalizer.

    Its constants are those of the study's selection, or of its tuning runs. Raises NoDataError where it is undefined.
    """
    try:
        normalizer, name, _ = tuning_scale.find_normalizer(connection, chosen.study, chosen.score, name, chosen.environments)
        groups = [
            replace(
                group,
                runs={
                    environment: replace(runs, scores=tuning_scale.normalize(normalizer, environment, runs.scores))
                    for environment, runs in group.runs.items()
                },
            )
            for group in chosen.groups
        ]
    except UndefinedNormalizerError as error:
        raise NoDataError(f"{error} with --normalizer") from None
    except UserError as error:
        raise NoDataError(str(error)) from None
    return replace(chosen, normalizer=name, groups=groups)


def same_seeds(runs: Iterable[Runs]) -> bool:
    """Return whether all have the same seeds: then they can be resampled jointly."""
    return len({known.seeds for known in runs}) == 1


def restrict(groups: Sequence[Chosen]) -> tuple[list[Chosen], list[str]]:
    """Return the groups on the environments that all (one at least) have, and the names of those environments."""
    common = sorted(set.intersection(*({*group.runs} for group in groups)))
    return [group.on(common) for group in groups], common


def on_common_environments(chosen: ChosenRuns) -> tuple[ChosenRuns, list[str]]:
    """Return the runs, in each regime, on the environments that all its groups have, and a note on each regime that loses some.

    Environments on which no run of a group has a score are none of its; a group without any does not count. Raises NoDataError
    where they have none in common.
    """
    kept: list[Chosen] = []
    notes = []
    known = {(group.by, group.name) for group in chosen.groups}
    chosen = chosen.scored()
    known -= {(group.by, group.name) for group in chosen.groups}
    notes += [f"tuned {by.replace('-', ' ')}: left out, since no run has a score: {name}" for by, name in sorted(known)]
    for by in chosen.regimes:
        groups, common = restrict(chosen.of(by))
        if not common:
            names = ", ".join(group.name for group in groups)
            raise NoDataError(f'study "{chosen.study}": no environment is common to {names}; choose agents with --agent')
        lost = sorted({place for group in chosen.of(by) for place in group.runs}.difference(common))
        if lost:
            notes.append(f"tuned {by.replace('-', ' ')}: left out, since not all agents have scores there: {', '.join(lost)}")
        kept += groups
    return replace(chosen, groups=kept), notes


def _runs(rows: Sequence[_Row]) -> Runs:
    scored = [(seed, value, status) for _, seed, status, _, value in rows if value is not None]
    num_missing = sum(status == "missing" for _, _, status, *_ in rows)
    num_dropped = sum(is_dropped for *_, is_dropped, _ in rows)
    return Runs(
        setting=rows[0][0],
        seeds=tuple(seed for seed, *_ in scored),
        scores=np.array([value for _, value, _ in scored], np.float64),
        diverged=np.array([status == "diverged" for *_, status in scored], bool),
        num_failed=len(rows) - len(scored) - num_missing - num_dropped,
        num_missing=num_missing,
        num_dropped=num_dropped,
    )


def _say(group: Chosen, environment: str, runs: Runs) -> str:
    return f"{group.name} on {environment}, tuned {group.by.replace('-', ' ')}: {runs.describe()}"


def _name(agent: str, for_each: str) -> str:
    values = json.loads(for_each)
    return agent + "".join(f", {name} = {value}" for name, value in values.items())


def _rule(connection: duckdb.DuckDBPyConnection, study: str, name: str) -> str:
    rows = connection.execute(f"SELECT {name} FROM study_rules WHERE study = ?", [study]).fetchall()
    return str(rows[0][0])
