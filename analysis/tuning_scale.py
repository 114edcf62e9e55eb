"""The scale of a study: its normalizer, with the constants of its selection or of the tuning runs that a connection shows."""

import json
from collections.abc import Sequence

import duckdb
import numpy as np

from sweep.messages import UserError, suggestion
from sweep.normalizers import NORMALIZERS, Normalizer, TuningRuns


def find_normalizer(
    connection: duckdb.DuckDBPyConnection, study: str, score: str, name: str | None, environments: Sequence[str]
) -> tuple[Normalizer, str, bool]:
    """Return a normalizer with constants on the environments, its name, and whether they are those of the study's selection.

    `name` None is the selection's normalizer, and the thesis' where there is no selection. Constants are the selection's where it
    was made with this normalizer and this score of a run; otherwise they are of the study's tuning runs as they are now.
    Raises UserError for an unknown name, and where no setting on an environment has all of its runs.
    """
    rows = connection.execute(
        "SELECT DISTINCT environment, normalizer, score, constants FROM selections WHERE study = ?", [study]
    ).fetchall()
    name = name or next((row[1] for row in rows), "thesis")
    if name not in NORMALIZERS:
        raise UserError(f'normalizer "{name}" is not known; {suggestion(name, NORMALIZERS)}')
    # G* is of episodes, whatever score of a run the selection maximized
    frozen = {place: json.loads(text) for place, by, of, text in rows if by == name and (of == score or name == "thesis")}
    if set(environments) <= set(frozen):
        return Normalizer.from_constants(name, frozen), name, True
    runs = _tuning_runs(connection, study, score)
    lacking = [environment for environment in environments if environment not in runs]
    if lacking:
        raise UserError(
            f'study "{study}": no setting on {", ".join(lacking)} has all of its tuning runs yet: nothing to normalize by'
        )
    return Normalizer.from_runs(name, runs), name, False


def _tuning_runs(connection: duckdb.DuckDBPyConnection, study: str, score: str) -> dict[str, TuningRuns]:
    """Return what normalizers are made from, of the settings of all agents that have all runs that are not left out."""
    best = dict(
        connection.execute(
            """
            SELECT members.environment, MAX(trials.best_episode)
            FROM members
            INNER JOIN trials ON trials.trial = members.trial
            WHERE members.study = ? AND members.stage = 'tune' AND trials.best_episode IS NOT NULL
            GROUP BY members.environment
            """,
            [study],
        ).fetchall()
    )
    settings = connection.execute(
        f"""
        SELECT environment, agent, LIST({score} ORDER BY seed)
        FROM run_scores
        WHERE study = ? AND stage = 'tune' AND NOT is_dropped
        GROUP BY environment, agent, setting
        HAVING COUNT({score}) = COUNT(*)
        ORDER BY environment, agent, setting
        """,
        [study],
    ).fetchall()
    means: dict[str, list[float]] = {}
    runs: dict[str, dict[str, list[float]]] = {}
    for environment, agent, scores in settings:
        means.setdefault(environment, []).append(float(np.mean(scores)))
        runs.setdefault(environment, {}).setdefault(agent, []).extend(scores)
    return {place: TuningRuns(best[place], means[place], runs[place]) for place in means if place in best}


def normalize(normalizer: Normalizer, environment: str, values: np.ndarray) -> np.ndarray:
    """Return N of scores of any shape; NaN stays NaN."""
    normalized = np.full(values.shape, np.nan)
    finite = np.isfinite(values)
    normalized[finite] = normalizer.normalize(environment, values[finite].tolist())
    return normalized
