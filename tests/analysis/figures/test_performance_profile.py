"""Performance profiles: the shares drawn are those counted by hand."""

import numpy as np
import pytest
from chosen_study import DIVERGED, FAILED, same_everywhere, write

from analysis import connect
from analysis.figures import performance_profile
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query

SAC = {
    ("SAC", "Pendulum-CA", "a"): [2, 4, 6, 8],
    ("SAC", "Pendulum-CA", "b"): [1, 1, 1, 1],
    ("SAC", "MountainCar-CA", "b"): [10, 10, 10, 5],
}
GREEDY = {
    ("GreedyAC", place, letter): [7, 7, 7, 7]
    for place, letter in (("Pendulum-CA", "a"), ("Pendulum-CA", "b"), ("MountainCar-CA", "b"))
}


def drawn(store, **options):
    return performance_profile.draw(connect(store), "study", Options(title="Title", **options))


def at(line, threshold):
    """The height of a line that holds from each point to the next."""
    x, y = (np.asarray(values, float) for values in line.get_data())
    assert line.get_drawstyle() == "steps-post"
    return y[np.searchsorted(x, threshold + 1e-9, side="right") - 1]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write(tmp_path_factory.mktemp("profile") / "store", SAC | GREEDY)


@pytest.fixture(scope="module")
def drawing(store):
    return drawn(store)


def test_a_line_is_the_share_of_normalized_scores_above_each_threshold(drawing):
    per, across = drawing.figure.axes
    greedy, sac = per.lines
    # of SAC: 0.2 0.4 0.6 0.8 and 1 1 1 0.5
    for threshold, above in ((0.1, 8), (0.2, 7), (0.45, 6), (0.5, 5), (0.6, 4), (0.9, 3), (1.0, 0)):
        assert at(sac, threshold) == above / 8
    assert (at(greedy, 0.69), at(greedy, 0.7)) == (1, 0)
    assert at(across.lines[1], 0.2) == 4 / 8


def test_the_band_surrounds_the_line_and_has_no_width_without_spread(drawing):
    data = drawing.data[drawing.data["by"] == "per-environment"]
    assert (data["low"] <= data["share_above"]).all()
    assert (data["share_above"] <= data["high"]).all()
    greedy, sac = data[data["agent"] == "GreedyAC"], data[data["agent"] == "SAC"]
    assert (greedy["low"] == greedy["high"]).all()
    middle = sac[np.isclose(sac["threshold"], 0.5)].iloc[0]
    means = np.random.default_rng(4).choice([0.0, 0.0, 1.0, 1.0], (100_000, 4)).mean(1)
    others = np.random.default_rng(5).choice([1.0, 1.0, 1.0, 0.0], (100_000, 4)).mean(1)
    # seeds are drawn jointly; of these two environments the widest and the narrowest that this can be
    assert np.quantile((means + others) / 2, 0.025) - 0.2 < middle["low"] < 5 / 8 < middle["high"]
    assert len(drawing.figure.axes[0].collections) == 2


def test_agents_are_told_apart_by_color_and_dash_and_named_below(drawing):
    lines = drawing.figure.axes[0].lines
    assert len({line.get_color() for line in lines}) == len({line.get_linestyle() for line in lines}) == 2
    assert [text.get_text() for text in drawing.figure.legends[0].texts] == ["GreedyAC", "SAC"]
    assert [axes.texts[0].get_text() for axes in drawing.figure.axes] == ["tuned per environment", "tuned across environments"]
    assert drawing.figure.axes[0].get_xlabel() == "Normalized score (thesis)"
    title = drawing.figure.get_suptitle().replace("\n", " ")
    assert "4 evaluation runs each, 1,000 steps, episode mean, normalizer thesis, 2 environments" in title
    assert "pointwise 95 % stratified bootstrap band" in title


def test_one_regime_is_one_panel(store):
    (axes,) = drawn(store, by="across-environments", agents=("SAC",)).figure.axes
    assert len(axes.lines) == 1


def test_environments_count_the_same_whatever_their_runs(tmp_path):
    scores = {("SAC", "Pendulum-CA", "a"): [2, 2, 2, 2, 2, 2], ("SAC", "MountainCar-CA", "b"): [8, 8]}
    (axes,) = drawn(write(tmp_path, scores, agents=["SAC"]), by="per-environment").figure.axes
    assert at(axes.lines[0], 0.5) == 0.5


def test_one_run_is_drawn_without_a_band(tmp_path):
    drawing = drawn(write(tmp_path, same_everywhere({"SAC": [5]}), agents=["SAC"]))
    assert not drawing.figure.axes[0].collections
    assert drawing.data["low"].isna().all()
    assert "no band from one run" in drawing.figure.get_suptitle().replace("\n", " ")
    assert "one run: no interval; it needs two at least" in drawing.notes


def test_runs_that_all_diverged_are_drawn_at_the_worst_return(tmp_path):
    drawing = drawn(write(tmp_path, same_everywhere({"SAC": [DIVERGED] * 3}), agents=["SAC"]))
    line = drawing.figure.axes[0].lines[0]
    assert (at(line, 0.19), at(line, 0.2)) == (1, 0)
    assert any("3 diverged, counted as the worst return" in note for note in drawing.notes)


def test_the_query_gives_the_scores_behind_it(store, drawing):
    found = run_query(store, drawing.sql).to_pandas()
    assert len(found) == 4 * 2 * 4
    assert sorted(found[found["agent"] == "SAC"]["episode_mean"])[:5] == [1, 1, 1, 1, 2]


def test_many_scores_are_drawn_at_their_quantiles(tmp_path):
    scores = same_everywhere({"SAC": [float(n) / 40 for n in range(400)]})
    drawing = drawn(write(tmp_path, scores, agents=["SAC"]), by="per-environment")
    line = drawing.figure.axes[0].lines[0]
    assert len(line.get_xdata()) <= 301
    assert at(line, 0.5) == pytest.approx(0.5, abs=0.01)


def test_a_study_without_runs_says_so(tmp_path):
    with pytest.raises(NoDataError, match=r"no finished run of a chosen setting \(Acrobot-CA\)"):
        drawn(write(tmp_path, {}), environments=("Acrobot-CA",))


def test_it_is_drawn_from_runs_that_were_trained(real_store):
    connection = connect(real_store)
    drawing = performance_profile.draw(connection, "chapter-6", Options(title="Title", normalizer="cdf"))
    assert [len(axes.lines) for axes in drawing.figure.axes] == [3, 3]
    several = performance_profile.draw(connection, "figure-7-2", Options(title="Title"))
    (axes,) = several.figure.axes
    assert [line.get_label() for line in axes.lines] == [f"GreedyAC, num_action_samples = {count}" for count in (10, 20, 30)]
    assert performance_profile.studies(connection, Options())[:2] == ["chapter-6", "figure-7-2"]


def test_the_median_weighs_environments_equally(tmp_path):
    scores = {("SAC", "Pendulum-CA", "a"): [1, 2, 3, 4, 5, 6], ("SAC", "MountainCar-CA", "b"): [8, 9]}
    drawing = drawn(write(tmp_path, scores, agents=["SAC"]), by="per-environment")
    # half of the weight lies at or below 0.6, the other half from 0.8 on; of the pooled runs the median is 0.45
    assert any("half of the runs above 0.7, the worst 0.1" in note for note in drawing.notes)


def test_an_environment_without_a_score_is_left_out_and_said(tmp_path):
    scores = {("SAC", "Pendulum-CA", "a"): [1, 2], ("SAC", "MountainCar-CA", "b"): [FAILED, FAILED]}
    drawing = drawn(write(tmp_path, scores, agents=["SAC"]), by="per-environment")
    assert set(drawing.data["num_environments"]) == {1}
    assert "SAC on MountainCar-CA, tuned per environment: 2 failed; no run has a score: left out" in drawing.notes
