"""Heat maps: the best mean score for each pair of values of two hyperparameters."""

from dataclasses import dataclass

import duckdb
import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from analysis.figures import style
from analysis.figures.drawing import Drawing
from analysis.figures.options import NoDataError, Options
from analysis.figures.scope import Scope, describe_progress, find_scope, quoted
from analysis.figures.swept import Value, check_swept, find_swept, find_values
from sweep.messages import UserError

TAKES = ("x", "over", "score", "agents", "environments")
_COLORS = colormaps["viridis"]
_DARK = 0.55
"""Up to here the colors are dark."""
_SMALLEST = 4.5
"""Points: numbers that would have to be smaller are left out."""
_CELLS = """
-- One row per (agent, environment, {x}, {over}): the best setting among those that share both values, by the mean {score}
-- over the tuning seeds; of equally good ones the lowest setting hash. Cells without data yet have NULL. Diverged runs count by
-- the study's rule.
WITH scored AS (
    SELECT study, agent, environment, setting, AVG({score} ORDER BY seed) AS {score}, COUNT({score}) AS num_seeds
    FROM run_scores
    WHERE study = {study} AND stage = 'tune'
    GROUP BY study, agent, environment, setting
)
SELECT
    scored.study,
    scored.agent,
    scored.environment,
    x.value AS "{x}",
    y.value AS "{over}",
    MAX(scored.{score}) AS best_mean,
    FIRST(scored.setting ORDER BY scored.{score} DESC NULLS LAST, scored.setting ASC) AS setting,
    FIRST(scored.num_seeds ORDER BY scored.{score} DESC NULLS LAST, scored.setting ASC) AS num_seeds,
    COUNT(scored.{score}) AS num_settings,
    COUNT(*) AS num_settings_planned
FROM scored
INNER JOIN hyperparameters AS x
    ON x.study = scored.study AND x.agent = scored.agent AND x.environment = scored.environment
    AND x.setting = scored.setting AND x.hyperparameter = '{x}'
INNER JOIN hyperparameters AS y
    ON y.study = scored.study AND y.agent = scored.agent AND y.environment = scored.environment
    AND y.setting = scored.setting AND y.hyperparameter = '{over}'
GROUP BY scored.study, scored.agent, scored.environment, x.value, y.value
ORDER BY scored.agent, scored.environment, MIN(y.number), y.value, MIN(x.number), x.value
"""


@dataclass(frozen=True)
class _Map:
    """What a heat map shows: the values of its axes, and the rows of its query."""

    scope: Scope
    x: str
    over: str
    columns: list[Value]
    rows: list[Value]
    cells: pd.DataFrame
    others: list[str]

    def panel(self, agent: str, environment: str) -> tuple[np.ndarray, np.ndarray]:
        """Return best means [over, x], NaN where there is none, and which cells the study asks for."""
        means = np.full((len(self.rows), len(self.columns)), np.nan)
        planned = np.zeros(means.shape, bool)
        row, column = ([value.text for value in values] for values in (self.rows, self.columns))
        cells = self.cells[(self.cells["agent"] == agent) & (self.cells["environment"] == environment)]
        for x, y, mean in zip(cells[self.x], cells[self.over], cells["best_mean"], strict=True):
            means[row.index(y), column.index(x)] = mean
            planned[row.index(y), column.index(x)] = True
        return means, planned


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies with tuning runs that sweep two hyperparameters."""
    rows = connection.execute(
        """
        SELECT study
        FROM hyperparameters
        WHERE is_swept AND study IN (SELECT study FROM settings WHERE stage = 'tune' AND num_seeds > 0)
        GROUP BY study
        HAVING COUNT(DISTINCT hyperparameter) > 1
        ORDER BY study
        """
    ).fetchall()
    return [row[0] for row in rows]


def draw(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Drawing:
    """Best mean score over the remaining hyperparameters for each pair of values of two hyperparameters, the two that are swept
    most widely unless others are named. Means over the tuning seeds; diverged runs count by the study's rule (worst return, or
    left out). One color scale an environment, so that agents can be compared; the best cell of a panel is outlined. Hatched
    cells are planned and have no data yet, empty ones are no part of the study. Each cell is a maximum over settings and thus
    optimistic, the more so the more settings it has.
    """
    data = _load(connection, study, options)
    with style.styled():
        figure = _figure(data, options.title)
    return Drawing(figure, data.cells, _notes(data), _sql(data))


def _load(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> _Map:
    scope = find_scope(connection, study, options)
    swept = find_swept(connection, study, options)
    x, over = _choose_axes(connection, study, options, swept)
    cells = connection.execute(_CELLS.format(x=x, over=over, score=scope.score, study=quoted(study))).df()
    cells = cells[[options.keeps(*row) for row in zip(cells["agent"], cells["environment"], strict=True)]]
    if cells.empty:
        raise NoDataError(f'study "{study}" has no setting with both {x} and {over}')
    if cells["best_mean"].isna().all():
        raise NoDataError(f'study "{study}" has no finished tuning run yet')
    others = [name for name in swept if name not in (x, over)]
    # an agent may have fixed what others sweep, at a value of its own
    columns, rows = (find_values(connection, study, name, cells[name]) for name in (x, over))
    return _Map(scope, x, over, columns, rows, cells, others)


def _choose_axes(
    connection: duckdb.DuckDBPyConnection, study: str, options: Options, swept: dict[str, list[Value]]
) -> tuple[str, str]:
    """Return the two hyperparameters: those asked for, otherwise those with the most values."""
    for flag, name in (("x", options.x), ("over", options.over)):
        if name is not None:
            check_swept(connection, study, flag, name, swept)
    free = [name for name in swept if name not in (options.x, options.over)]
    x = options.x or (free.pop(0) if free else None)
    over = options.over or (free.pop(0) if free else None)
    if x is None or over is None:
        raise NoDataError(f'study "{study}" sweeps {", ".join(swept)} alone: a heat map needs two hyperparameters')
    if x == over:
        raise UserError(f"--x and --over are both {x}: a heat map needs two hyperparameters")
    return x, over


def _sql(data: _Map) -> str:
    return _CELLS.format(x=data.x, over=data.over, score=data.scope.score, study=quoted(data.scope.study))


def _figure(data: _Map, title: str) -> Figure:
    agents, environments = data.scope.agents, data.scope.environments
    figure, panels = style.panels(len(agents), len(environments), share_x="all", share_y="all")
    for column, environment in enumerate(environments):
        maps = [data.panel(agent, environment) for agent in agents]
        known = np.concatenate([means[~np.isnan(means)] for means, _ in maps])
        scale = Normalize(known.min(), known.max()) if len(known) else Normalize()
        for axes, agent, (means, planned) in zip(panels[:, column], agents, maps, strict=True):
            _draw_panel(figure, axes, means, planned, scale)
            if not planned.any():
                is_there = (agent, environment) in data.scope.progress
                style.remark(axes, "without one of the two" if is_there else "not in this study")
        _draw_scale(figure, panels[:, column], scale, environment)
    for values, axis in ((data.columns, panels[0, 0].xaxis), (data.rows, panels[0, 0].yaxis)):
        axis.set_ticks(range(len(values)), [value.label for value in values])
    long = any(value.number is None and len(value.label) > 5 for value in data.columns)
    for axes in panels[-1]:
        axes.set_xlabel(style.words(data.x))
        axes.tick_params(axis="x", rotation=30 if long else 0)
    style.name_rows(panels, agents)
    figure.supylabel(style.words(data.over), size=10)
    style.headline(figure, title, _subtitle(data))
    if any(_missing(*data.panel(*place)).any() for place in data.scope.progress):
        style.legend(figure, [Patch(facecolor="none", edgecolor="0.4", hatch="////", label="no data yet")])
    return figure


def _draw_panel(figure: Figure, axes: Axes, means: np.ndarray, planned: np.ndarray, scale: Normalize) -> None:
    axes.grid(False)
    axes.set_xlim(-0.5, means.shape[1] - 0.5)
    axes.set_ylim(-0.5, means.shape[0] - 0.5)
    if not planned.any():
        return
    axes.imshow(means, cmap=_COLORS, norm=scale, aspect="auto", origin="lower")
    for row, column in zip(*np.nonzero(_missing(means, planned)), strict=True):
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor="none", edgecolor="0.4", linewidth=0, hatch="////"))
    if np.isnan(means).all():
        return
    best = np.unravel_index(np.nanargmax(means), means.shape)
    size = _text_size(figure, axes, means)
    for (row, column), mean in np.ndenumerate(means):
        if size is not None and not np.isnan(mean):
            axes.text(column, row, _short(mean), ha="center", va="center", size=size, color=_ink(mean, scale))
    axes.add_patch(
        Rectangle(
            (best[1] - 0.44, best[0] - 0.44), 0.88, 0.88, facecolor="none", edgecolor=_ink(means[best], scale), linewidth=1.5
        )
    )


def _draw_scale(figure: Figure, panels: np.ndarray, scale: Normalize, name: str) -> None:
    """Draw an environment's color scale above its panels, under its name."""
    bar = figure.colorbar(ScalarMappable(scale, _COLORS), ax=list(panels), location="top", aspect=25, ticks=MaxNLocator(4))
    bar.ax.tick_params(labelsize=7)
    bar.ax.set_title(name, weight="bold", size=11)


def _text_size(figure: Figure, axes: Axes, means: np.ndarray) -> float | None:
    """Return the size in points at which all numbers of a panel fit into its cells, None where it is unreadable."""
    box = axes.get_position()
    width, height = figure.get_figwidth() * box.width, figure.get_figheight() * box.height
    longest = max(len(_short(mean)) for mean in means[~np.isnan(means)])
    size = min(8.0, 72 * 0.9 * width / means.shape[1] / (0.6 * longest), 72 * 0.6 * height / means.shape[0])
    return size if size >= _SMALLEST else None


def _ink(mean: float, scale: Normalize) -> str:
    return "white" if scale(mean) < _DARK else "black"


def _short(mean: float) -> str:
    return f"{mean:.0f}" if abs(mean) >= 100 else f"{mean:.3g}"


def _missing(means: np.ndarray, planned: np.ndarray) -> np.ndarray:
    return planned & np.isnan(means)


def _subtitle(data: _Map) -> str:
    maximized = f"best over {', '.join(data.others)}" if data.others else "one setting a cell"
    return f"{data.scope.subtitle()}; {maximized}; outlined: the best cell of a panel"


def _notes(data: _Map) -> list[str]:
    lines = [f"study {data.scope.study}: {_subtitle(data)}; no interval: a cell is a maximum over settings"]
    for (agent, environment), _ in sorted(data.scope.progress.items()):
        cells = data.cells[(data.cells["agent"] == agent) & (data.cells["environment"] == environment)]
        if cells["best_mean"].notna().any():
            best = cells.iloc[int(np.nanargmax(cells["best_mean"].to_numpy()))]
            where = f"{data.x} = {best[data.x]}, {data.over} = {best[data.over]}"
            lines.append(f"{agent} on {environment}: best {best['best_mean']:.4g} at {where}")
        empty = [f"({x}, {y})" for x, y in zip(*(cells[cells["best_mean"].isna()][n] for n in (data.x, data.over)), strict=True)]
        if empty:
            lines.append(f"{agent} on {environment}: no data yet for ({data.x}, {data.over}) {', '.join(empty)}")
    return [*lines, *describe_progress(data.scope)]
