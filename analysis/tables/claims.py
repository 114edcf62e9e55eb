"""What the thesis says of its figures, and what stored runs say to it."""

import duckdb
import numpy as np
import pandas as pd

from analysis.claims.claims import WIDTHS, Claim, thesis_claims, thesis_studies
from analysis.claims.judging import Judged, describe, judge
from analysis.claims.runs import Runs, window_means
from analysis.figures.options import NoDataError, Options
from analysis.figures.query_text import listed
from analysis.tables.table import Table

TAKES = ()
_PROGRESS = """
SELECT study, stage, agent, environment, planned, finished + diverged, diverged
FROM study_progress
WHERE study IN ({studies}) AND finished + diverged < planned OR study IN ({studies}) AND diverged > 0
ORDER BY ALL
"""
_WIDTHS = """
-- One row per tuning run: the scores that the widths of regions are computed from.
SELECT study, agent, environment, setting, seed, status, score
FROM run_scores
WHERE study IN ({studies}) AND stage = 'tune'
ORDER BY ALL
"""


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies that claims are about and that have runs."""
    rows = connection.execute("SELECT DISTINCT study FROM study_trials WHERE status IN ('finished', 'diverged')").fetchall()
    known = {row[0] for row in rows}
    return [study for study in thesis_studies() if study in known]


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """Statements of the thesis' chapters 6 and 7 about its figures, each with the tests that were named for it beforehand
    (analysis/claims/thesis.toml): a row for each test, with d (the first mean return less the second), its 95 % interval, what is
    claimed of d, and the one-sided p-value. A statement is confirmed if all of its tests are: p_holm is the largest of their
    p-values, after Holm's correction for all statements about the study that could be tested. It is not confirmed if a test shows
    the opposite, at 5 % for all tests of the statement together; otherwise these runs leave it undecided. Intervals of means are
    Welch's and Satterthwaite's, which take no notice of seeds that both sides share; those of widths are basic parametric
    bootstraps of the settings (2,000 resamples), with and without the noise floor (docs/statistics.md).
    """
    every = thesis_claims()
    claims = [claim for claim in every.claims if claim.study == study]
    if not claims:
        raise NoDataError(f'no claim is about study "{study}"; there are some about {", ".join(thesis_studies())}')
    judged = judge(claims, every, Runs(connection), options.seed)
    rows = [row for one in judged for row in _rows(one)]
    notes = [f"{one.claim.name} {one.verdict}: {one.claim.statement}{f' ({one.why})' if one.why else ''}" for one in judged]
    if not rows:
        raise NoDataError(f'study "{study}": no claim about it can be tested yet: {judged[0].why}')
    counts = pd.Series([one.verdict for one in judged]).value_counts()
    summary = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    notes.append(
        f"study {study}: {len(judged)} statements: {summary}; returns that differ by less than {every.margin:g} are similar"
    )
    about = sorted(
        {side.study for claim in claims for test in claim.tests for side in (test.first, test.second) if side} | {study}
    )
    return Table(pd.DataFrame(rows), [*notes, *_progress(connection, about)], _sql(claims, about))


def _progress(connection: duckdb.DuckDBPyConnection, studies: list[str]) -> list[str]:
    """Return a line for each agent and environment whose runs are not all there, or some of which diverged."""
    rows = connection.execute(_PROGRESS.format(studies=listed(studies))).fetchall()
    lines = []
    for study, stage, agent, environment, planned, done, diverged in rows:
        where = f"study {study}: {agent} on {environment} ({stage})"
        if done < planned:
            lines.append(f"{where}: {done:,} of {planned:,} runs: verdicts may change")
        if diverged:
            lines.append(f"{where}: {diverged:,} diverged, counted as the worst return of the environment")
    return lines


def _sql(claims: list[Claim], studies: list[str]) -> str:
    """Return the query of the runs that the tests are computed from: their mean returns, or the scores behind widths."""
    tests = [test for claim in claims for test in claim.tests if test.kind not in WIDTHS]
    if not tests:
        return _WIDTHS.format(studies=listed(studies))
    hypers = {name for test in tests for side in (test.first, test.second) if side for name in side.where}
    windows = {window for test in tests for window in (test.window, test.earlier) if window}
    return window_means(studies, windows, hypers)


def _rows(one: Judged) -> list[dict[str, object]]:
    return [
        {
            "claim": one.claim.name,
            "verdict": one.verdict,
            "d": describe(evidence.test),
            "value": _rounded(evidence.estimate.value),
            "low": _rounded(evidence.estimate.low),
            "high": _rounded(evidence.estimate.high),
            "claimed": _claimed(*evidence.claimed),
            "num_runs": evidence.estimate.num_runs,
            "p_value": _rounded(evidence.p_value),
            "p_holm": _rounded(one.p_holm),
        }
        for evidence in one.evidence
    ]


def _rounded(number: float) -> float:
    """Return a number to four digits: more would be noise to a reader."""
    return float(f"{number:.4g}")


def _claimed(low: float, high: float) -> str:
    if np.isinf(high):
        return f"> {low:g}"
    return f"< {high:g}" if np.isinf(low) else f"within ±{high:g}"
