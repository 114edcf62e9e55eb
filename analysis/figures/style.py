"""The one look of all figures: colors that color-blind readers tell apart, markers and dashes for print, panels with titles."""

import contextlib
import math
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, NullLocator

Sharing = bool | Literal["none", "all", "row", "col"]
MARKERS = "os^Dvp*Xh<>"
DASHES = ("-", "--", ":", "-.", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
_TAKEN = ("GreedyAC", "VanillaAC", "SAC", "DDPG", "SAC-original")  # these keep their color from figure to figure


# seaborn's "colorblind" palette and "ticks" style, written out: importing seaborn takes longer than drawing a figure.
_PALETTE = ("#0173b2", "#de8f05", "#029e73", "#d55e00", "#cc78bc", "#ca9161", "#fbafe4", "#949494", "#ece133", "#56b4e9")
_STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": ".15",
    "axes.grid": True,
    "axes.labelcolor": ".15",
    "font.family": ["sans-serif"],
    "font.sans-serif": ["Arial", "DejaVu Sans", "Liberation Sans", "Bitstream Vera Sans", "sans-serif"],
    "grid.color": "0.92",
    "hatch.linewidth": 0.6,
    "lines.solid_capstyle": "round",
    "patch.edgecolor": "w",
    "patch.force_edgecolor": True,
    "text.color": ".15",
    "xtick.color": ".15",
    "ytick.color": ".15",
}


@contextlib.contextmanager
def styled() -> Iterator[None]:
    """Draw in the style of all figures: ticks, a light grid."""
    with rc_context(_STYLE):
        yield


def agent_colors(agents: Sequence[str]) -> dict[str, tuple[float, float, float]]:
    """Return a color for each agent; built-in agents have the same one in every figure."""
    order = [*_TAKEN, *sorted(set(agents) - set(_TAKEN))]
    return {agent: to_rgb(_PALETTE[order.index(agent) % len(_PALETTE)]) for agent in agents}


def ordered_colors(count: int) -> list[tuple[float, float, float]]:
    """Return colors for values that have an order, from dark to light."""
    return [to_rgb(color) for color in colormaps["viridis"](np.linspace(0, 1, count + 3)[1 : count + 1])]


def panels(rows: int, columns: int, *, share_x: Sharing = True, share_y: Sharing = False) -> tuple[Figure, np.ndarray]:
    """Return a figure and its axes [rows, columns], without the upper and the right spine."""
    figure = Figure(figsize=(max(5.6, 1.0 + 2.75 * columns), 1.5 + 1.95 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=share_x, sharey=share_y, squeeze=False)
    for panel in axes.flat:
        panel.spines[["top", "right"]].set_visible(False)
    return figure, axes


def name_rows(axes: np.ndarray, names: Sequence[str]) -> None:
    """Write a name beside each row of panels."""
    for panel, name in zip(axes[:, 0], names, strict=True):
        panel.set_ylabel(name, weight="bold", size=11)


def name_columns(axes: np.ndarray, names: Sequence[str]) -> None:
    """Write a name above each column of panels, over what the panels' own titles say."""
    above = 18 if any(panel.get_title("right") for panel in axes[0]) else 6
    for panel, name in zip(axes[0], names, strict=True):
        panel.annotate(name, (0.5, 1), (0, above), "axes fraction", "offset points", ha="center", weight="bold", size=11)


def headline(figure: Figure, title: str, subtitle: str = "") -> None:
    """Write the title, and below it what is shown: n, steps, kind of interval."""
    lines = textwrap.wrap(subtitle, width=int(13 * figure.get_figwidth()))
    figure.suptitle("\n".join([title, *lines]), size=10, linespacing=1.4)


def legend(figure: Figure, handles: Sequence[object], title: str | None = None) -> None:
    """Put one legend for all panels below them, in as many columns as fit.

    Labels wider than the figure are wrapped; a legend of more than three lines makes the figure higher, not its panels smaller.
    """
    width, height = figure.get_size_inches()
    labels = [textwrap.fill(str(handle.get_label()), int((width - 0.5) / 0.085)) for handle in handles]  # type: ignore[attr-defined]
    longest = max((len(line) for label in labels for line in label.split("\n")), default=0)
    columns = min(len(handles), max(1, int(width / 0.9)), max(1, int(width / (0.35 + 0.085 * longest))))
    lines = math.ceil(sum(label.count("\n") + 1 for label in labels) / max(1, columns))
    figure.set_size_inches(width, height + 0.22 * max(0, lines - 3))
    spacing = {"columnspacing": 1.4, "handletextpad": 0.5, "handlelength": 1.8}
    figure.legend(
        handles=handles, labels=labels, ncols=columns, loc="outside lower center", title=title, frameon=False, **spacing
    )


def remark(axes: Axes, text: str) -> None:
    """Write in an empty panel why it is empty."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color="0.4")


def is_logarithmic(values: Sequence[float]) -> bool:
    """Return whether values of a hyperparameter belong on a log axis: they are positive and span a decade, or there is one."""
    return min(values) > 0 and (max(values) >= 10 * min(values) or min(values) == max(values))


def hyper_axis(axes: Axes, values: Sequence[float]) -> None:
    """Make the x-axis (shared by panels) one of a hyperparameter, with ticks at the values themselves as far as they fit."""
    low, high = min(values), max(values)
    if is_logarithmic(values):
        axes.set_xscale("log")
        axes.set_xlim(low / 10**0.3, high * 10**0.3)
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_minor_formatter(NullFormatter())
    if len(values) <= 7:
        axes.set_xticks(list(values), [number(value) for value in values])


def number(value: float) -> str:
    """Return a value as a tick shows it: powers of ten as such."""
    exponent = round(np.log10(value)) if value > 0 else 0
    return f"$10^{{{exponent}}}$" if np.isclose(value, 10.0**exponent, rtol=1e-9) else f"{value:g}"


def words(name: str) -> str:
    """Return a hyperparameter's name as text: `critic_step_size` is "Critic step-size"."""
    known = {
        "critic_step_size": "Critic step-size",
        "actor_step_size_scale": "Actor step-size scale κ",
        "entropy_scale": "Entropy scale τ",
        "num_action_samples": "Action samples N",
        "elite_fraction": "Elite fraction ρ",
        "polyak": "Polyak averaging weight",
    }
    return known.get(name, name.replace("_", " ").capitalize())
