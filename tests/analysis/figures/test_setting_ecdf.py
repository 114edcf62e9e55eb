"""Distributions of settings: the shares and expectations drawn are those counted by hand."""

import itertools
import math

import numpy as np
import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures import setting_ecdf
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query

MEANS = [10, 20, 20, 50]


def study(path, means=MEANS, seeds=2, agents=("SAC",), environments=("Pendulum-CA",), spread=1):
    """A setting for each mean, its runs `spread` below and above it."""
    store = SyntheticStore(path)
    for agent, environment, (index, mean) in itertools.product(agents, environments, enumerate(means)):
        for seed in range(seeds):
            member = store.plan("study", agent, environment, seed, critic_step_size=0.1 / (1 + index))
            if mean is not None:
                store.finish(member, [mean + (spread * (2 * seed - 1) if seeds == 2 else 0)])
    return store.write_studies()


def drawn(store, **options):
    return setting_ecdf.draw(connect(store), "study", Options(title="Title", **options))


@pytest.fixture(scope="module")
def drawing(tmp_path_factory):
    return drawn(study(tmp_path_factory.mktemp("ecdf") / "store"))


def test_above_is_the_share_of_settings_at_least_so_good(drawing):
    (line,) = drawing.figure.axes[0].lines
    assert line.get_drawstyle() == "steps-pre"  # a share holds up to its score
    assert list(zip(*line.get_data(), strict=True)) == [(10, 1.0), (20, 0.75), (50, 0.25), (50, 0.0)]


def test_below_is_the_expected_best_of_m_settings(drawing):
    (line,) = drawing.figure.axes[1].lines
    expected = [np.mean([max(chosen) for chosen in itertools.combinations(MEANS, m)]) for m in range(1, 5)]
    assert list(line.get_xdata()) == [1, 2, 3, 4]
    assert list(line.get_ydata()) == pytest.approx(expected)


def test_the_bands_are_those_of_resampled_seeds(drawing):
    best = drawing.data[drawing.data["curve"] == "expected_best"]
    # all settings share their seeds: everything moves by −1, 0 or 1 at once
    assert (best["value"] - best["low"]).tolist() == pytest.approx([1] * 4)
    assert (best["high"] - best["value"]).tolist() == pytest.approx([1] * 4)
    share = drawing.data[drawing.data["curve"] == "share_at_least"].set_index("x")
    assert (share.loc[20, "low"], share.loc[20, "high"]) == pytest.approx((0.25, 0.75))
    assert len(drawing.figure.axes[0].collections) == len(drawing.figure.axes[1].collections) == 1


def test_axes_are_named_and_the_subtitle_says_n_steps_and_interval(drawing):
    above, below = drawing.figure.axes
    assert above.get_ylabel() == "Share of settings\nat least so good"
    assert (above.get_xlabel(), below.get_xlabel()) == ("Average episodic return", "Random settings m")
    assert below.get_ylabel() == "Expected best of m"
    title = drawing.figure.get_suptitle().replace("\n", " ")
    assert "mean over 2 tuning seeds with pointwise 95 % bootstrap band, 1,000 steps, episode mean" in title
    assert "SAC on Pendulum-CA: 4 settings; a random one 25, the best 50" in "\n".join(drawing.notes)


def test_a_column_an_environment_and_a_line_an_agent(tmp_path):
    store = study(tmp_path, agents=("GreedyAC", "SAC"), environments=("Acrobot-CA", "Pendulum-CA"))
    drawing = drawn(store)
    axes = drawing.figure.axes
    assert [panel.texts[0].get_text() for panel in axes[:2]] == ["Acrobot-CA", "Pendulum-CA"]
    assert all([line.get_label() for line in panel.lines] == ["GreedyAC", "SAC"] for panel in axes)
    assert len({line.get_linestyle() for line in axes[0].lines}) == 2
    assert [text.get_text() for text in drawing.figure.legends[0].texts] == ["GreedyAC", "SAC"]
    only = drawn(store, environments=("Pendulum-*",), agents=("SAC",))
    assert [len(panel.lines) for panel in only.figure.axes] == [1, 1]


def test_one_seed_has_no_band_and_it_is_said(tmp_path):
    drawing = drawn(study(tmp_path, seeds=1))
    above, below = drawing.figure.axes
    assert list(above.lines[0].get_ydata()) == [1.0, 0.75, 0.25, 0.0]
    assert list(below.lines[0].get_ydata()) == pytest.approx([25, 20 + 15, 42.5, 50])
    assert not above.collections
    assert drawing.data["low"].isna().all()
    assert "one tuning seed: no interval; it needs two at least" in drawing.notes


def test_settings_that_lack_a_run_are_left_out_and_counted(tmp_path):
    drawing = drawn(study(tmp_path, means=[10, 20, None]))
    assert set(drawing.data["num_settings"]) == {2}
    assert "SAC on Pendulum-CA: left out for lack of a run: 1 setting" in drawing.notes
    assert "SAC on Pendulum-CA: 4 of 6 trials" in drawing.notes


def test_an_agent_without_runs_is_said_to_have_none(tmp_path):
    store = SyntheticStore(tmp_path)
    for x in (0.1, 0.01):
        store.finish(store.plan("study", "SAC", "Pendulum-CA", 0, critic_step_size=x), [x])
        store.plan("study", "GreedyAC", "Pendulum-CA", 0, critic_step_size=x)
        store.plan("study", "SAC", "Acrobot-CA", 0, critic_step_size=x)
    drawing = drawn(store.write_studies())
    assert [text.get_text() for text in drawing.figure.axes[0].texts] == ["no data yet", "Acrobot-CA"]
    assert "GreedyAC on Pendulum-CA: no setting has all of its runs yet" in drawing.notes


def test_runs_that_all_diverged_are_one_step(tmp_path):
    store = SyntheticStore(tmp_path)
    for x, seed in itertools.product((0.1, 0.01), range(2)):
        store.finish(store.plan("study", "SAC", "Pendulum-CA", seed, critic_step_size=x), [-4, math.nan])
    drawing = drawn(store.write_studies())
    assert list(zip(*drawing.figure.axes[0].lines[0].get_data(), strict=True)) == [(-4, 1.0), (-4, 0.0)]
    low, high = drawing.figure.axes[1].get_ylim()
    assert low < -4.5 < -3.5 < high
    assert "SAC on Pendulum-CA: 4 diverged, counted as the worst return of the environment" in drawing.notes


def test_many_settings_are_on_a_logarithmic_axis(tmp_path):
    drawing = drawn(study(tmp_path, means=list(range(25)), seeds=1))
    assert drawing.figure.axes[1].get_xscale() == "log"


def test_the_query_gives_the_scores_of_the_runs(tmp_path):
    store = study(tmp_path)
    found = run_query(store, drawn(store).sql).to_pandas()
    assert sorted(found.groupby("setting")["episode_mean"].mean()) == MEANS


def test_a_single_setting_has_no_distribution(tmp_path):
    store = study(tmp_path, means=[10])
    with pytest.raises(NoDataError, match="one setting an agent: a distribution needs several"):
        drawn(store)
    assert setting_ecdf.studies(connect(store), Options()) == []


def test_it_is_drawn_from_runs_that_were_trained(real_store):
    connection = connect(real_store)
    drawing = setting_ecdf.draw(connection, "chapter-6", Options(title="Title"))
    assert len(drawing.figure.axes) == 2 * 4
    assert all(len(panel.lines) == 3 for panel in drawing.figure.axes)
    assert {"chapter-6", "figure-7-1", "figure-7-2"} <= set(setting_ecdf.studies(connection, Options()))


def test_a_diverged_run_is_left_out_by_a_study_that_drops_it_and_the_band_with_it(tmp_path):
    store = SyntheticStore(tmp_path)
    for x, scores in ((0.1, (4, float("nan"))), (0.01, (5, 7))):
        for seed, score in enumerate(scores):
            store.finish(store.plan("study", "SAC", "Pendulum-CA", seed, critic_step_size=x), [score])
    path = store.write_studies()
    (path / "studies" / "study" / "grid.toml").write_text('[select]\ndiverged = "drop"\n')
    drawing = setting_ecdf.draw(connect(path), "study", Options())
    best = drawing.data[drawing.data["curve"] == "expected_best"]
    assert best["value"].tolist() == [5, 6]
    assert best["low"].isna().all()
    assert any(note.startswith("no interval, since diverged runs are left out") for note in drawing.notes)
