"""Figure 4.2 of a small demonstration made by hand: panels, densities, elites, and the progression at the right."""

import xml.etree.ElementTree as ElementTree

import matplotlib.colors
import numpy as np
import pandas as pd
import pytest

from analysis.figures import ccem_progression

LAST = 15
SHOWN = [0, 1, 3, 7, 15]
WIDTH = {"actor": 0.8, "proposal": 0.95}
NAMES = ["action values", "samples", "elites", "actor", "proposal", "best action"]


def made_rows():
    """Actions −2 … 2 of value 4 − (a − 1)²; mean 1 − 1/(u + 1), standard deviation 0.8ᵘ or 0.95ᵘ after u updates."""
    rows = [(0, "objective", float(a), 4.0 - (a - 1) ** 2) for a in (-2, -1, 0, 1, 2)]
    for update in range(LAST + 1):
        samples = [-1 + update / 10, 0.5, update / 20]
        rows += [(update, "sample", a, 4 - (a - 1) ** 2) for a in samples]
        rows.append((update, "elite", 0.5, 3.75))
        for policy, width in WIDTH.items():
            rows += [(update, policy, float(a), (3 - abs(a)) / width**update) for a in (-2, 0, 2)]
            rows.append((update, f"{policy} parameters", 1 - 1 / (update + 1), width**update))
    return pd.DataFrame(rows, columns=["update", "series", "action", "value"])


ROWS = made_rows()


@pytest.fixture(scope="module")
def drawing():
    return ccem_progression.draw(ROWS.sample(frac=1, random_state=0), "Title")


@pytest.fixture(scope="module")
def panels(drawing):
    """Axes of the action values, of the densities, of the mean and the standard deviation."""
    axes = drawing.figure.axes
    return axes[:5], axes[5:10], axes[10], axes[11]


def points(line):
    return [tuple(map(float, point)) for point in zip(*line.get_data(), strict=True)]


def named(axes):
    return {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}


@pytest.mark.parametrize(("last", "shown"), [(0, [0]), (1, [0, 1]), (15, SHOWN), (40, [0, 2, 5, 15, 40])])
def test_panels_are_further_and_further_apart_up_to_the_last_update(last, shown):
    found = ccem_progression.shown_updates(last)
    assert found == shown
    assert list(np.diff(found)) == sorted(np.diff(found))


def test_twelve_axes_with_titles_and_labels(drawing, panels):
    values, densities, mean, std = panels
    assert len(drawing.figure.axes) == 12
    assert [axes.get_title() for axes in values] == [
        "before any update",
        "after 1 update",
        "after 3 updates",
        "after 7 updates",
        "after 15 updates",
    ]
    assert [axes.get_ylabel() for axes in (*values, *densities)] == ["Action value", *[""] * 4, "Density", *[""] * 4]
    assert {axes.get_xlabel() for axes in densities} == {"Action"}
    assert [axes.get_ylabel() for axes in (mean, std)] == ["Mean ± σ", "Deviation σ"]
    assert std.get_xlabel() == "Updates" and std.get_yscale() == "log"
    assert all(axes.get_shared_y_axes().joined(axes, values[0]) for axes in values)
    assert all(above.get_shared_x_axes().joined(above, below) for above, below in zip(values, densities, strict=True))
    assert drawing.figure.get_suptitle() == "Title\n3 actions drawn an update; the best of them, the elites: 1"


def test_each_panel_shows_the_values_samples_and_elites_of_its_update(panels):
    for update, axes in zip(SHOWN, panels[0], strict=True):
        lines = named(axes)
        assert list(lines) == ["action values", "samples", "elites"]
        assert points(lines["action values"]) == [(-2, -5), (-1, 0), (0, 3), (1, 4), (2, 3)]
        assert list(lines["samples"].get_xdata()) == sorted([-1 + update / 10, 0.5, update / 20])
        assert points(lines["elites"]) == [(0.5, 3.75)]


def test_each_panel_below_shows_both_densities_whole_with_ticks_and_boxes(panels):
    for update, axes in zip(SHOWN, panels[1], strict=True):
        lines = named(axes)
        assert list(lines) == ["actor", "proposal"]
        for policy, width in WIDTH.items():
            np.testing.assert_allclose(points(lines[policy]), [(a, (3 - abs(a)) / width**update) for a in (-2, 0, 2)])
        low, high = axes.get_ylim()
        assert low == 0 and high > 3 / WIDTH["actor"] ** update
        ticks, boxes = (line for line in axes.lines if line.get_label().startswith("_"))
        assert list(ticks.get_xdata()) == sorted([-1 + update / 10, 0.5, update / 20])
        assert ticks.get_color() == lines["proposal"].get_color()
        assert list(boxes.get_xdata()) == [0.5] and boxes.get_markerfacecolor() == "none"


def test_actor_and_proposal_look_the_same_everywhere_and_differ_in_color_and_dashes(panels):
    looks = {
        policy: {(named(axes)[policy].get_color(), named(axes)[policy].get_linestyle()) for axes in (*panels[1], *panels[2:])}
        for policy in WIDTH
    }
    ((actor_color, actor_dashes),) = looks["actor"]
    ((proposal_color, proposal_dashes),) = looks["proposal"]
    assert matplotlib.colors.to_rgb(actor_color) != matplotlib.colors.to_rgb(proposal_color)
    assert (actor_dashes, proposal_dashes) == ("-", "--")


def test_the_progression_shows_every_update_with_bands_of_one_standard_deviation(panels):
    _, _, mean, std = panels
    updates = range(LAST + 1)
    for policy, width in WIDTH.items():
        np.testing.assert_allclose(points(named(mean)[policy]), [(u, 1 - 1 / (u + 1)) for u in updates])
        np.testing.assert_allclose(points(named(std)[policy]), [(u, width**u) for u in updates])
    assert list(named(mean)["best action"].get_ydata()) == [1, 1]
    assert len(mean.collections) == 2
    for band, width in zip(mean.collections, WIDTH.values(), strict=True):
        corners = band.get_paths()[0].vertices
        for update in updates:
            at = corners[corners[:, 0] == update, 1]
            assert at.max() - at.min() == pytest.approx(2 * width**update)


def test_one_legend_names_everything(drawing):
    (legend,) = drawing.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == NAMES


def test_the_notes_say_where_both_policies_are_at_the_end(drawing):
    assert drawing.notes == [
        "actor after 15 updates: mean 0.938, standard deviation 0.0352 (the best action: 1)",
        "proposal after 15 updates: mean 0.938, standard deviation 0.463 (the best action: 1)",
    ]


def test_it_is_saved_in_every_format_without_a_warning_and_twice_the_same(tmp_path):
    for format in ("png", "svg", "pdf", "csv"):
        files = [tmp_path / f"{name}.{format}" for name in ("first", "second")]
        for file in files:
            ccem_progression.draw(ROWS, "Title").save(file, format)
        assert files[0].read_bytes() == files[1].read_bytes()
    ElementTree.parse(tmp_path / "first.svg")
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "first.csv"), ROWS)
