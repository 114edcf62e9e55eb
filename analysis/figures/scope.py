"""What part of a study's tuning stage a figure shows: agents, environments, score, and how far its trials are."""

from dataclasses import dataclass

import duckdb

from analysis.figures.options import NoDataError, Options

FEW_SEEDS = 5
"""Below so many a bootstrap of the seeds says little, and notes say so."""
LABELS = {
    "episode_mean": "Average episodic return",
    "step_mean": "Episodic return, mean over steps",
    "final_mean": "Episodic return, last tenth of steps",
}


@dataclass(frozen=True)
class Progress:
    """Trials of an agent on an environment: planned, done (diverged ones among them), diverged."""

    planned: int
    done: int
    diverged: int


@dataclass(frozen=True)
class Scope:
    """The tuning stage of `study`, as far as options ask for it.

    `score`: column of `trials`. `seeds`: planned a setting. `steps`: of a trial. `progress`: of each agent on each environment.
    `diverged`: what diverged runs count for, "worst" or "drop".
    """

    study: str
    score: str
    seeds: int
    steps: int
    progress: dict[tuple[str, str], Progress]
    diverged: str = "worst"

    @property
    def agents(self) -> list[str]:
        """Agents in alphabetical order."""
        return sorted({agent for agent, _ in self.progress})

    @property
    def environments(self) -> list[str]:
        """Environments in alphabetical order."""
        return sorted({environment for _, environment in self.progress})

    @property
    def label(self) -> str:
        """What an axis of the score is named."""
        return LABELS[self.score]

    def subtitle(self, interval: str = "") -> str:
        """Return n, steps, score and stage: `mean over 10 tuning seeds, 100,000 steps; episode mean`."""
        seeds = f"mean over {self.seeds} tuning {'seed' if self.seeds == 1 else 'seeds'}"
        return f"{seeds}{interval}, {self.steps:,} steps, {self.score.replace('_', ' ')}"


def find_scope(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Scope:
    """Return what `options` ask for of the study's tuning stage; the score is the study's own unless another is asked for.

    Raises NoDataError if nothing of it is planned, or nothing of what is planned is done.
    """
    rows = connection.execute(
        """
        SELECT agent, environment, planned, finished + diverged, diverged
        FROM study_progress
        WHERE study = ? AND stage = 'tune'
        ORDER BY agent, environment
        """,
        [study],
    ).fetchall()
    progress = {(agent, place): Progress(*counts) for agent, place, *counts in rows if options.keeps(agent, place)}
    if not progress:
        asked = ", ".join((*options.agents, *options.environments))
        raise NoDataError(f'study "{study}" has no tuning trial' + (f" for {asked}" if asked else ""))
    if not any(known.done for known in progress.values()):
        raise NoDataError(f'study "{study}" has no finished tuning run yet: `sweep launch` trains them')
    seeds, steps = connection.execute(
        """
        SELECT MAX(num_planned), MAX(steps)
        FROM (
            SELECT COUNT(DISTINCT seed) AS num_planned, MAX(steps) AS steps
            FROM members
            WHERE study = ? AND stage = 'tune'
            GROUP BY agent, environment, setting
        )
        """,
        [study],
    ).fetchall()[0]
    score = options.score or find_rule(connection, study, "score")
    return Scope(study, score, seeds, steps, progress, find_rule(connection, study, "diverged"))


def find_rule(connection: duckdb.DuckDBPyConnection, study: str, name: str) -> str:
    """Return a rule of the study, a column of the view `study_rules`: `score`, `normalizer` or `diverged`."""
    rows = connection.execute(f"SELECT {name} FROM study_rules WHERE study = ?", [study]).fetchall()
    return str(rows[0][0])


def describe_progress(scope: Scope) -> list[str]:
    """Return a line for each agent and environment with trials that are missing or diverged."""
    lines = []
    for (agent, environment), progress in sorted(scope.progress.items()):
        if progress.done < progress.planned:
            lines.append(f"{agent} on {environment}: {progress.done:,} of {progress.planned:,} trials")
        if progress.diverged:
            lines.append(f"{agent} on {environment}: {progress.diverged:,} diverged, {describe_diverged(scope.diverged)}")
    return lines


def describe_diverged(rule: str) -> str:
    """Return what a study's rule, "worst" or "drop", makes of runs that diverged."""
    return "left out" if rule == "drop" else "counted as the worst return of the environment"


def quoted(text: str) -> str:
    """Return a text as SQL writes it."""
    return "'" + text.replace("'", "''") + "'"


def studies_on_several_environments(connection: duckdb.DuckDBPyConnection) -> list[str]:
    """Return the studies with tuning runs of several settings of an agent on several environments."""
    rows = connection.execute(
        """
        SELECT study
        FROM settings
        WHERE stage = 'tune' AND num_seeds > 0
        GROUP BY study, agent
        HAVING COUNT(DISTINCT environment) > 1 AND COUNT(DISTINCT setting) > 1
        ORDER BY study
        """
    ).fetchall()
    return list(dict.fromkeys(row[0] for row in rows))
