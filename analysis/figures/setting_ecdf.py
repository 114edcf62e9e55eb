"""Distribution of settings: what a setting drawn at random gives, and the best of several."""

from dataclasses import dataclass
from typing import Any

import duckdb
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from analysis import scores
from analysis.figures import style
from analysis.figures.drawing import Drawing
from analysis.figures.options import NoDataError, Options
from analysis.figures.scope import Scope, describe_progress, find_scope, quoted
from analysis.statistics.setting_distribution import best_of, best_weights, distribution
from sweep.messages import UserError

TAKES = ("score", "agents", "environments")
_MANY = 20
"""With more settings than this the number that is tried has a log axis."""
_SQL = """
-- One row per (agent, environment, setting, seed): the scores of the tuning runs. A setting's score is the mean over its seeds;
-- diverged runs count by the study's rule.
SELECT study, agent, environment, setting, seed, status, {score}
FROM run_scores
WHERE study = {study} AND stage = 'tune'
ORDER BY agent, environment, setting, seed
"""


@dataclass(frozen=True)
class _Curve:
    """A curve of one panel: `low` and `high` are NaN without two seeds, `split_half` is NaN but for the best of m."""

    x: np.ndarray
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    split_half: np.ndarray


@dataclass(frozen=True)
class _Settings:
    """An agent on an environment: `shares` by score, `best` by number of settings, of `num_settings`; others were left out.

    `is_uneven`: diverged runs are left out, so that settings differ in their seeds.
    """

    agent: str
    environment: str
    num_settings: int
    num_left_out: int
    num_seeds: int
    is_uneven: bool
    shares: _Curve
    best: _Curve

    def rows(self) -> pd.DataFrame:
        """Return both curves, one below the other."""
        return pd.concat([_rows(self, "share_at_least", self.shares), _rows(self, "expected_best", self.best)])


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies with tuning runs of several settings."""
    rows = connection.execute(
        """
        SELECT study
        FROM settings
        WHERE stage = 'tune' AND num_seeds > 0
        GROUP BY study, agent, environment
        HAVING COUNT(*) > 1
        ORDER BY study
        """
    ).fetchall()
    return list(dict.fromkeys(row[0] for row in rows))


def draw(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Drawing:
    """Above: the share of an agent's settings whose mean score is at least the one on the axis. Below: the mean score to expect
    of the best of m settings drawn at random without replacement, for m up to all of them; it says what a small tuning budget
    buys. The mean score of a setting is over its tuning seeds; diverged runs count by the study's rule (worst return, or left
    out). Settings that lack a run are left out. Bands are pointwise 95 % percentile intervals over 1,000 bootstrap resamples of
    the tuning seeds, the same for all settings; with a single seed, or where a diverged run is left out, so that settings differ
    in their seeds, there are none. The best of several noisy means is optimistic, the more so the larger m is: the data hold it
    without that luck too, chosen on half of the seeds and scored on the others.
    """
    scope = find_scope(connection, study, options)
    found = [known for place in scope.progress if (known := _measure(connection, scope, *place, options.seed)) is not None]
    if not found:
        raise NoDataError(f'study "{study}" has no setting yet with all of its tuning runs')
    if all(known.num_settings == 1 for known in found):
        raise NoDataError(f'study "{study}" has one setting an agent: a distribution needs several')
    with style.styled():
        figure = _figure(scope, found, options.title)
    data = pd.concat([known.rows() for known in found], ignore_index=True)
    data.insert(0, "study", study)
    return Drawing(figure, data, _notes(scope, found, options.seed), _SQL.format(score=scope.score, study=quoted(study)))


def _measure(connection: duckdb.DuckDBPyConnection, scope: Scope, agent: str, environment: str, seed: int) -> _Settings | None:
    """Return the curves of an agent on an environment, None where no setting has all of its runs."""
    try:
        loaded = scores.load(connection, scope.study, agent, environment, scope.score)
        kept = loaded.without_incomplete()
    except UserError:
        return None
    values = kept.values
    num_settings, num_seeds = values.shape
    if num_seeds > 1 and not kept.dropped.any():
        # the share of means that are at least t is that of negative means that are at most −t
        shares, best = distribution(-values, seed=seed), best_of(values, seed=seed)
        curves = (
            _Curve(-shares.x[::-1], shares.value[::-1], shares.low[::-1], shares.high[::-1], np.full(len(shares.x), np.nan)),
            _Curve(best.curve.x, best.curve.value, best.curve.low, best.curve.high, best.split_half),
        )
    else:
        means = np.sort(kept.means)
        x = np.unique(means)
        expected = best_weights(num_settings, num_settings, replacement=False) @ means
        curves = (
            _bare(x, 1 - np.searchsorted(means, x, side="left") / num_settings),
            _bare(np.arange(1, num_settings + 1), expected),
        )
    return _Settings(
        agent, environment, num_settings, len(loaded.settings) - num_settings, num_seeds, bool(kept.dropped.any()), *curves
    )


def _bare(x: np.ndarray, value: np.ndarray) -> _Curve:
    none = np.full(len(x), np.nan)
    return _Curve(x, value, none, none, none)


def _rows(settings: _Settings, name: str, curve: _Curve) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "agent": settings.agent,
            "environment": settings.environment,
            "curve": name,
            "x": curve.x.astype(float),
            "value": curve.value,
            "low": curve.low,
            "high": curve.high,
            "split_half": curve.split_half,
            "num_settings": settings.num_settings,
            "num_seeds": settings.num_seeds,
        }
    )


def _figure(scope: Scope, found: list[_Settings], title: str) -> Figure:
    environments, agents = scope.environments, scope.agents
    figure, panels = style.panels(2, len(environments), share_x="none")
    colors = style.agent_colors(agents)
    dashes: dict[str, Any] = {agent: style.DASHES[i % len(style.DASHES)] for i, agent in enumerate(agents)}
    for column, environment in enumerate(environments):
        above, below = panels[:, column]
        here = [known for known in found if known.environment == environment]
        for known in here:
            look: dict[str, Any] = {
                "color": colors[known.agent],
                "linestyle": dashes[known.agent],
                "linewidth": 1.6,
                "label": known.agent,
            }
            _draw_shares(above, known.shares, look)
            below.plot(known.best.x, known.best.value, marker="." if known.num_settings < _MANY else None, **look)
            _fill(below, known.best.x, known.best.low, known.best.high, look["color"])
        if not here:
            for axes in (above, below):
                style.remark(axes, "no data yet")
        _name_axes(above, below, scope.label, max((known.num_settings for known in here), default=1))
    panels[0, 0].set_ylabel("Share of settings\nat least so good")
    panels[1, 0].set_ylabel("Expected best of m")
    style.name_columns(panels, environments)
    style.headline(figure, title, _subtitle(scope, found))
    style.legend(figure, [Line2D([], [], color=colors[agent], linestyle=dashes[agent], label=agent) for agent in agents])
    return figure


def _draw_shares(axes: Axes, curve: _Curve, look: dict[str, Any]) -> None:
    """Draw a share that holds up to each score, the score included, and falls to 0 after the last."""
    axes.plot(np.append(curve.x, curve.x[-1]), np.append(curve.value, 0.0), drawstyle="steps-pre", **look)
    _fill(axes, curve.x, curve.low, curve.high, look["color"], step="pre")


def _fill(axes: Axes, x: np.ndarray, low: np.ndarray, high: np.ndarray, color: Any, **how: Any) -> None:
    if not np.isnan(low).all():
        axes.fill_between(x, low, high, color=color, alpha=0.18, linewidth=0, **how)


def _name_axes(above: Axes, below: Axes, score: str, most: int) -> None:
    above.set_ylim(-0.03, 1.03)
    above.set_xlabel(score)
    above.xaxis.set_major_locator(MaxNLocator(4))
    below.set_xlabel("Random settings m")
    low, high = below.dataLim.intervaly
    if 0 <= high - low < 1e-9 * max(1.0, abs(high)):  # equal but for rounding, which an axis would magnify
        below.set_ylim(high - 1, high + 1)
    if most >= _MANY:
        below.set_xscale("log")
        below.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        below.xaxis.set_major_formatter("{x:g}")
        below.xaxis.set_minor_locator(NullLocator())
    else:
        below.xaxis.set_major_locator(MaxNLocator(6, integer=True))


def _subtitle(scope: Scope, found: list[_Settings]) -> str:
    banded = any(known.num_seeds > 1 and not known.is_uneven for known in found)
    lacking = ", no interval from one" if all(known.num_seeds == 1 for known in found) else ", no interval"
    interval = " with pointwise 95 % bootstrap band" if banded else lacking
    return f"settings by their {scope.subtitle(interval)}"


def _notes(scope: Scope, found: list[_Settings], seed: int) -> list[str]:
    lines = [f"study {scope.study}: {_subtitle(scope, found)}; 1,000 resamples of seeds, seed {seed}"]
    for known in found:
        where = f"{known.agent} on {known.environment}"
        random, best = known.best.value[0], known.best.value[-1]
        line = f"{where}: {_count(known.num_settings)}; a random one {random:.4g}, the best {best:.4g}"
        if not np.isnan(known.best.split_half[-1]):
            line += f" ({known.best.split_half[-1]:.4g} when chosen on half of the seeds and scored on the others)"
        lines.append(line)
        if known.num_left_out:
            lines.append(f"{where}: left out for lack of a run: {_count(known.num_left_out)}")
    if any(known.num_seeds == 1 for known in found):
        lines.append("one tuning seed: no interval; it needs two at least")
    uneven = [f"{known.agent} on {known.environment}" for known in found if known.is_uneven]
    if uneven:
        lines.append(f"no interval, since diverged runs are left out and settings differ in their seeds: {', '.join(uneven)}")
    absent = set(scope.progress) - {(known.agent, known.environment) for known in found}
    lines += [f"{agent} on {environment}: no setting has all of its runs yet" for agent, environment in sorted(absent)]
    return [*lines, *describe_progress(scope)]


def _count(settings: int) -> str:
    return "1 setting" if settings == 1 else f"{settings} settings"
