"""The spread between seeds: points are the runs, and intervals what they say."""

import math

import numpy as np
import pytest
from chosen_study import DIVERGED, same_everywhere, write
from matplotlib.collections import LineCollection, PathCollection
from scipy import stats
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures import seed_spread
from analysis.figures.drawing import Drawing
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query


def drawn(store, study="study", **options) -> Drawing:
    return seed_spread.draw(connect(store), study, Options(title="Title", **options))


def points(axes) -> list[list[float]]:
    """The heights of the groups of runs."""
    groups = [found for found in axes.collections if isinstance(found, PathCollection) and found.get_sizes()[0] < 20]
    return [sorted(group.get_offsets()[:, 1].tolist()) for group in groups]


def bars(axes) -> list[tuple[float, float]]:
    """The ends of the thick bars: intervals of means."""
    thick = [found for found in axes.collections if isinstance(found, LineCollection) and found.get_linewidth()[0] > 2]
    return [tuple(bar.get_segments()[0][:, 1]) for bar in thick]


def test_every_run_is_a_point_and_the_bar_is_the_students_interval(tmp_path):
    runs = [2.0, 4.0, 9.0]
    drawing = drawn(write(tmp_path, same_everywhere({"SAC": runs}), agents=["SAC"]), by="per-environment")
    assert [axes.get_title() for axes in drawing.figure.axes] == ["MountainCar-CA", "Pendulum-CA"]
    half = stats.t.ppf(0.975, 2) * np.std(runs, ddof=1) / math.sqrt(3)
    for axes in drawing.figure.axes:
        assert points(axes) == [runs]
        assert bars(axes) == [pytest.approx((5 - half, 5 + half))]
        assert [line.get_ydata()[0] for line in axes.lines] == [pytest.approx(5)]
        assert [label.get_text() for label in axes.get_xticklabels()] == ["SAC"]
    assert "3 evaluation runs each, 1,000 steps, episode mean" in drawing.notes[0]
    assert "95 % Student interval of the mean; thin: lowest, median, highest run" in drawing.notes[0]
    assert any("lowest 2, median 4, highest 9" in note for note in drawing.notes)
    assert "46 runs are needed" in drawing.notes[-1]


def test_both_regimes_stand_side_by_side_filled_and_open_unless_one_is_asked_for(tmp_path):
    store = write(tmp_path, same_everywhere({"SAC": [2.0, 4.0], "GreedyAC": [3.0, 6.0]}))
    both, one = drawn(store), drawn(store, by="across-environments")
    assert [len(points(axes)) for axes in both.figure.axes] == [4, 4]
    assert [len(points(axes)) for axes in one.figure.axes] == [2, 2]
    filled = [len(found.get_facecolor()) > 0 for found in both.figure.axes[0].collections if isinstance(found, PathCollection)]
    assert {True, False} <= set(filled)
    labels = [text.get_text() for text in both.figure.legends[0].get_texts()]
    assert labels[:2] == ["tuned per environment", "tuned across environments"]
    assert set(both.data["by"]) == {"per-environment", "across-environments"}
    assert set(one.data["by"]) == {"across-environments"}


def test_with_enough_runs_the_thin_line_is_a_tolerance_interval(tmp_path):
    runs = [float(value) for value in range(100)]
    drawing = drawn(write(tmp_path, same_everywhere({"SAC": runs}), agents=["SAC"]), by="per-environment")
    assert "thin: tolerance interval" in drawing.notes[0]
    thin = [
        found
        for found in drawing.figure.axes[0].collections
        if isinstance(found, LineCollection) and found.get_linewidth()[0] < 2
    ]
    low, high = thin[0].get_segments()[0][:, 1]
    # as many runs are left out as a binomial allows: P(Binomial(100, 0.9) < high - low) >= 0.95
    assert stats.binom.cdf(high - low - 1, 100, 0.9) >= 0.95 > stats.binom.cdf(high - low - 2, 100, 0.9)
    assert "contains a share 0.9 of runs with confidence" in "".join(drawing.notes)


def test_one_run_has_no_interval(tmp_path):
    drawing = drawn(write(tmp_path, same_everywhere({"SAC": [5.0]}), agents=["SAC"]), by="per-environment")
    assert [bars(axes) for axes in drawing.figure.axes] == [[], []]
    assert "a single run each, no interval" in drawing.notes[0]
    assert any("one run, 5; no interval" in note for note in drawing.notes)


def test_a_diverged_run_is_the_worst_return_and_counted(tmp_path):
    drawing = drawn(write(tmp_path, same_everywhere({"SAC": [4.0, DIVERGED]}), agents=["SAC"]), by="per-environment")
    assert points(drawing.figure.axes[0]) == [[2, 4]]
    assert any("1 diverged, counted as the worst return" in note for note in drawing.notes)


def test_tuning_runs_are_named_as_what_the_choice_was_made_by(tmp_path):
    drawing = drawn(write(tmp_path, {}))
    assert "by which the settings were chosen" in drawing.notes[0]


def test_rows_are_the_runs_and_the_query_gives_them(tmp_path):
    store = write(tmp_path, same_everywhere({"SAC": [2.0, 4.0]}), agents=["SAC"])
    drawing = drawn(store)
    rows = run_query(store, drawing.sql).to_pylist()
    assert len(rows) == len(drawing.data) == 8
    assert sorted(row["episode_mean"] for row in rows) == sorted(drawing.data["score"])


def test_a_study_without_runs_has_no_figure(tmp_path):
    store = SyntheticStore(tmp_path)
    store.plan("demo", "SAC", "Pendulum-CA", 0)
    with pytest.raises(NoDataError, match="no finished run of a chosen setting"):
        drawn(store.write_studies(), "demo")


def test_values_of_one_hyperparameter_stand_on_the_axis(real_store):
    drawing = drawn(real_store, "figure-7-2")
    for axes in drawing.figure.axes:
        assert axes.get_xlabel() == "Action samples N"
        assert [label.get_text() for label in axes.get_xticklabels()] == ["10", "20", "30"]
        assert [len(group) for group in points(axes)] == [3, 3, 3]
    assert len(drawn(real_store, "chapter-6").figure.axes) == 4


def test_an_environment_where_every_run_failed_is_an_empty_panel_and_said(tmp_path):
    scores = {("SAC", "Pendulum-CA", "a"): [1, 2], ("SAC", "MountainCar-CA", "b"): ["failed", "failed"]}
    store = write(tmp_path, scores, agents=["SAC"])
    drawing = seed_spread.draw(connect(store), "study", Options(by="per-environment"))
    (empty, _) = drawing.figure.axes
    assert [text.get_text() for text in empty.texts] == ["no run has a score"]
    assert "SAC on MountainCar-CA, tuned per environment: 2 failed; no run has a score" in drawing.notes
