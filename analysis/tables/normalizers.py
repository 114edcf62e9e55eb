"""How much the choice across environments depends on the normalizer, and on each environment."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import duckdb
import numpy as np
import pandas as pd
from scipy import stats

from analysis import scores
from analysis.figures.options import NoDataError, Options
from analysis.figures.scope import Scope, describe_progress, find_rule, find_scope, studies_on_several_environments
from analysis.figures.sensitivity_data import run_scores
from analysis.scores import AcrossScores
from analysis.statistics.seed_resampling import winners
from analysis.tables.table import Table
from analysis.tuning_scale import find_normalizer
from sweep.messages import UserError, counted
from sweep.normalizers import NORMALIZERS

TAKES = ("score", "normalizer", "agents", "environments")
_UNEQUAL = 2.0
"""So many times the share of another is no equal weight."""


@dataclass(frozen=True)
class Scaled:
    """An agent's candidates under one normalizer: mean scores [E, H], N of the worst return of each environment [E]."""

    scores: AcrossScores
    means: np.ndarray
    floors: np.ndarray

    @property
    def shares(self) -> np.ndarray:
        """The share of each environment in the spread between candidates, highest − lowest mean; 0 where there is none."""
        spread = np.ptp(self.means, axis=1)
        return spread / spread.sum() if spread.sum() > 0 else np.zeros(len(spread))


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies with tuning runs of an agent's settings on several environments."""
    return studies_on_several_environments(connection)


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """The setting chosen across environments under each normalizer, with all environments and with one `left_out`. `is_same`:
    whether it is the choice under the study's own normalizer (where that is undefined, the first that is not) on all
    environments; `rank_of_own_choice`: the rank of that one here; `rank_correlation`: Kendall's τ between the ranking of all
    settings here and that one. In the row that leaves an environment out, `floor` is N of the environment's worst return, and
    `spread_share` its part of what tells an agent's settings apart: highest − lowest mean, as a share of the sum over
    environments. Equal weights would be equal shares; the thesis' normalizer has none. Scores are means over the tuning seeds,
    without intervals; diverged runs count
    by the study's rule (worst return, or left out); settings that lack a run are left out.
    """
    scope = find_scope(connection, study, options)
    own = find_rule(connection, study, "normalizer")
    names = [options.normalizer] if options.normalizer else list(NORMALIZERS)
    rows: list[dict[str, Any]] = []
    lines: list[str] = []
    for agent in scope.agents:
        scaled: dict[str, Scaled] = {}
        for name in dict.fromkeys((own, *names)):
            try:
                scaled[name] = _scale(connection, scope, agent, name)
            except UserError as error:
                lines.append(f"{agent}, {name}: {error}")
        for name in names:
            if name in scaled:
                rows += _rows(scope.study, name, scaled[name], scaled.get(own, next(iter(scaled.values()))))
                lines += _describe(agent, name, scaled[name])
    if not rows:
        raise NoDataError(
            f'study "{study}" has no choice across environments to show:\n' + "\n".join(f"  {line}" for line in lines)
        )
    data = pd.DataFrame(rows)
    head = [f"study {study}: {scope.subtitle()}, no interval; the study's own normalizer is {own}", *_stability(data)]
    return Table(data, [*head, *lines, *describe_progress(scope)], run_scores(scope))


def _scale(connection: duckdb.DuckDBPyConnection, scope: Scope, agent: str, normalizer: str) -> Scaled:
    """Return an agent's candidates under a normalizer. Raises UserError where there are none, or one environment."""
    environments = [place for place in scope.environments if (agent, place) in scope.progress]
    if len(environments) < 2:
        raise UserError("a choice across environments needs several, and there is one")
    loaded = scores.load_across(
        connection, scope.study, agent, score=scope.score, normalizer=normalizer, environments=environments
    ).without_incomplete()
    scale, _, _ = find_normalizer(connection, scope.study, scope.score, normalizer, environments)
    worst = dict(
        connection.execute("SELECT environment, worst_return FROM worst_returns WHERE study = ?", [scope.study]).fetchall()
    )
    floors = [scale.normalize(place, [worst[place]])[0] if place in worst else np.nan for place in loaded.environments]
    return Scaled(loaded, loaded.means, np.array(floors))


def _rows(study: str, normalizer: str, scaled: Scaled, own: Scaled) -> list[dict[str, Any]]:
    """Return the row of all environments, and one for each that is left out."""
    known = scaled.scores
    baseline = own.means.mean(axis=0)
    own_choice = own.scores.settings[int(winners(baseline))]
    by_candidate = dict(zip(own.scores.settings, baseline, strict=True))
    found = []
    for left_out in (None, *range(len(known.environments))):
        kept = [place for place in range(len(known.environments)) if place != left_out]
        means = scaled.means[kept].mean(axis=0)
        best = int(winners(means))
        row: dict[str, Any] = {
            "study": study,
            "agent": known.agent,
            "normalizer": normalizer,
            "left_out": None if left_out is None else known.environments[left_out],
            **{name: _plain(values[best]) for name, values in known.hypers.items()},
            "score": float(means[best]),
            "is_same": known.settings[best] == own_choice,
            "rank_of_own_choice": _rank(means, known.settings, own_choice),
            "rank_correlation": _correlation(means, [by_candidate.get(settings, np.nan) for settings in known.settings]),
            "floor": np.nan if left_out is None else float(scaled.floors[left_out]),
            "spread_share": np.nan if left_out is None else float(scaled.shares[left_out]),
            "num_environments": len(kept),
            "num_settings": len(means),
            "num_seeds": known.values.shape[-1],
        }
        found.append(row)
    return found


def _plain(value: Any) -> Any:
    return str(list(value)) if isinstance(value, tuple) else value


def _rank(means: np.ndarray, settings: Sequence[tuple[str, ...]], wanted: tuple[str, ...]) -> int | None:
    """Return the rank of a candidate from 1, None where it is not among them."""
    if wanted not in settings:
        return None
    return 1 + int((means > means[list(settings).index(wanted)]).sum())


def _correlation(means: np.ndarray, others: Sequence[float]) -> float:
    both = np.isfinite(others)
    if both.sum() < 2 or np.ptp(means[both]) == 0 or np.ptp(np.array(others)[both]) == 0:
        return float("nan")
    return float(stats.kendalltau(means[both], np.array(others)[both]).statistic)


def _stability(data: pd.DataFrame) -> list[str]:
    """Return a line for each agent: how often the choice stays the same."""
    lines = []
    for agent, rows in data.groupby("agent"):
        whole = rows[rows["left_out"].isna()]
        less = rows[rows["left_out"].notna()]
        lines.append(
            f"{agent}: the same setting under {int(whole['is_same'].sum())} of {counted(len(whole), 'normalizer')}, and in "
            f"{int(less['is_same'].sum())} of {len(less)} choices with one environment left out"
        )
    return lines


def _describe(agent: str, normalizer: str, scaled: Scaled) -> list[str]:
    """Return the floors and shares of the environments; a warning where the thesis' normalizer weighs them unequally."""
    places = zip(scaled.scores.environments, scaled.floors, scaled.shares, strict=True)
    parts = ", ".join(f"{place} {floor:.3g} ({share:.0%})" for place, floor, share in places)
    lines = [f"{agent}, {normalizer}: N of the worst return, and share of the spread between settings: {parts}"]
    shares, depths = scaled.shares, 1 - scaled.floors
    if normalizer == "thesis" and any(weights.max() > _UNEQUAL * weights.min() for weights in (shares, depths)):
        heavy, light = (scaled.scores.environments[index] for index in (int(shares.argmax()), int(shares.argmin())))
        lines.append(
            f"warning: {agent}: the thesis' normalizer weighs environments unequally: {heavy} has {shares.max():.0%} of the "
            f"spread, {light} {shares.min():.0%}"
        )
    return lines
