"""Figure 2.1 of a small demonstration made by hand: what is drawn is what the rows say."""

import xml.etree.ElementTree as ElementTree

import matplotlib.colors
import numpy as np
import pandas as pd
import pytest

from analysis.figures import cem_update

ROWS = pd.DataFrame(
    [
        *((0, "objective", a, 4 - a**2) for a in (-2.0, -1.0, 0.0, 1.0, 2.0)),
        *((0, "sample", a, 4 - a**2) for a in (1.0, -2.0, 0.5, -1.0, 2.0)),
        *((0, "elite", a, 4 - a**2) for a in (0.5, 1.0)),
        *((0, "density", a, d) for a, d in ((-2.0, 0.1), (0.0, 0.3), (2.0, 0.1))),
        *((1, "density", a, d) for a, d in ((-2.0, 0.0), (0.0, 0.5), (2.0, 0.2))),
        (0, "density parameters", 0.0, 1.5),
        (1, "density parameters", 0.75, 0.25),
    ],
    columns=["update", "series", "action", "value"],
)


@pytest.fixture(scope="module")
def drawing():
    return cem_update.draw(ROWS.sample(frac=1, random_state=0), "Title")


def points(line):
    return [tuple(map(float, point)) for point in zip(*line.get_data(), strict=True)]


def named(axes):
    return {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}


def test_two_panels_share_the_axis_of_actions(drawing):
    above, below = drawing.figure.axes
    assert (above.get_ylabel(), below.get_ylabel(), below.get_xlabel()) == ("H", "Density", "Action")
    assert above.get_shared_x_axes().joined(above, below)
    assert below.get_ylim()[0] == 0
    assert drawing.figure.get_suptitle() == "Title\n5 samples; the best of them, the elites: 2"


def test_samples_are_open_and_elites_filled_circles_on_the_objective(drawing):
    lines = named(drawing.figure.axes[0])
    assert list(lines) == ["objective H", "threshold ζ", "samples", "elites"]
    assert points(lines["objective H"]) == [(-2, 0), (-1, 3), (0, 4), (1, 3), (2, 0)]
    assert points(lines["samples"]) == [(-2, 0), (-1, 3), (0.5, 3.75), (1, 3), (2, 0)]
    assert points(lines["elites"]) == [(0.5, 3.75), (1, 3)]
    for name, fill in (("samples", "white"), ("elites", "black")):
        assert (lines[name].get_marker(), lines[name].get_linestyle()) == ("o", "None")
        assert lines[name].get_markerfacecolor() == fill
    assert list(lines["threshold ζ"].get_ydata()) == [3, 3]


def test_the_density_after_the_update_is_solid_and_blue_the_one_before_dashed_and_red(drawing):
    lines = named(drawing.figure.axes[1])
    assert list(lines) == ["density before", "density after"]
    assert points(lines["density before"]) == [(-2, 0.1), (0, 0.3), (2, 0.1)]
    assert points(lines["density after"]) == [(-2, 0), (0, 0.5), (2, 0.2)]
    assert [line.get_linestyle() for line in lines.values()] == ["--", "-"]
    (red, _, less_blue), (less_red, _, blue) = (matplotlib.colors.to_rgb(line.get_color()) for line in lines.values())
    assert red > less_blue and blue > less_red


def test_ticks_below_are_the_samples_and_longer_ones_the_elites(drawing):
    samples, elites = (line for line in drawing.figure.axes[1].lines if line.get_label().startswith("_"))
    assert [action for action, _ in points(samples)] == [-2, -1, 0.5, 1, 2]
    assert [action for action, _ in points(elites)] == [0.5, 1]
    assert elites.get_markersize() > samples.get_markersize()


def test_one_legend_names_everything(drawing):
    (legend,) = drawing.figure.legends
    names = ["objective H", "threshold ζ", "samples", "elites", "density before", "density after"]
    assert [text.get_text() for text in legend.get_texts()] == names


def test_the_notes_give_the_parameters_before_and_after(drawing):
    assert drawing.notes == ["before: mean 0, standard deviation 1.5", "after: mean 0.75, standard deviation 0.25"]


def test_it_is_saved_in_every_format_without_a_warning_and_twice_the_same(drawing, tmp_path):
    for format in ("png", "svg", "pdf", "csv"):
        files = [tmp_path / f"{name}.{format}" for name in ("first", "second")]
        for file in files:
            cem_update.draw(ROWS, "Title").save(file, format)
        assert files[0].read_bytes() == files[1].read_bytes()
    ElementTree.parse(tmp_path / "first.svg")
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "first.csv"), ROWS)
    assert np.array_equal(drawing.data.sort_index().to_numpy(), ROWS.to_numpy())
