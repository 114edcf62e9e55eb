"""Slices: the points drawn are those worked out by hand."""

import math

import numpy as np
import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures import slice as slices
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query
from sweep.messages import UserError

SIZES, SCALES = [1e-3, 1e-2, 1e-1], [0.1, 1.0]
MEANS = {(1e-3, 0.1): 10, (1e-2, 0.1): 40, (1e-1, 0.1): 20, (1e-3, 1.0): 30, (1e-2, 1.0): 25, (1e-1, 1.0): 5}


def study(path, seeds=2, agents=("SAC",), environments=("Pendulum-CA",), means=MEANS, spread=1):
    """Runs of a setting `spread` below and above its mean; one whose mean is None is planned and has no run."""
    store = SyntheticStore(path)
    for agent in agents:
        for environment in environments:
            for (x, tau), mean in means.items():
                for seed in range(seeds):
                    member = store.plan("study", agent, environment, seed, critic_step_size=x, entropy_scale=tau)
                    if mean is not None:
                        store.finish(member, [mean + (spread * (2 * seed - 1) if seeds == 2 else 0)])
    return store.write_studies()


def drawn(store, **options):
    return slices.draw(connect(store), "study", Options(title="Title", **options))


def lines(axes):
    """Best over the others, at the best setting, the star."""
    return [line for line in axes.lines if line.get_marker() in ("s", "o", "*")]


def points(line):
    return dict(zip(np.round(np.asarray(line.get_xdata(), float), 6), np.asarray(line.get_ydata(), float), strict=True))


def texts(drawing):
    return "\n".join(text.get_text() for text in drawing.figure.findobj(lambda artist: hasattr(artist, "get_text")))


@pytest.fixture(scope="module")
def drawing(tmp_path_factory):
    return drawn(study(tmp_path_factory.mktemp("slice") / "store"))


def test_a_slice_goes_through_the_best_setting(drawing):
    by_size, by_scale = drawing.figure.axes
    over, at_best, star = lines(by_size)
    assert points(at_best) == pytest.approx({1e-3: 10, 1e-2: 40, 1e-1: 20})
    assert points(over) == pytest.approx({1e-3: 30, 1e-2: 40, 1e-1: 20})
    assert points(star) == pytest.approx({1e-2: 40})
    over, at_best, star = lines(by_scale)
    assert points(at_best) == pytest.approx({0.1: 40, 1.0: 25})
    assert points(over) == pytest.approx({0.1: 40, 1.0: 30})
    assert points(star) == pytest.approx({0.1: 40})


def test_intervals_are_student_over_tuning_seeds(drawing):
    half = 12.7062 * math.sqrt(2) / math.sqrt(2)  # t of one degree of freedom; the runs lie 1 below and 1 above the mean
    row = drawing.data[(drawing.data["hyperparameter"] == "critic_step_size") & (drawing.data["number"] == 1e-3)].iloc[0]
    assert (row["low"], row["high"]) == pytest.approx((10 - half, 10 + half))
    bars = drawing.figure.axes[0].collections[0].get_segments()
    expected = np.array([[m - half, m + half] for m in (10, 20, 40)])
    assert np.array(sorted(bar[:, 1].tolist() for bar in bars)) == pytest.approx(expected)


def test_panels_are_named_by_hyperparameter_and_have_a_logarithmic_axis(drawing):
    by_size, by_scale = drawing.figure.axes
    assert (by_size.get_xlabel(), by_scale.get_xlabel()) == ("Critic step-size", "Entropy scale τ")
    assert by_size.get_ylabel() == "SAC\nPendulum-CA"
    assert by_size.get_xscale() == "log"
    assert [text.get_text() for text in drawing.figure.legends[0].texts] == [
        "the others as in the best setting",
        "best over the others",
        "best setting",
    ]
    assert "mean over 2 tuning seeds with Student's 95 % interval, 1,000 steps, episode mean" in texts(drawing)


def test_with_one_hyperparameter_the_columns_are_environments(tmp_path):
    store = study(tmp_path, agents=("GreedyAC", "SAC"), environments=("Acrobot-CA", "Pendulum-CA"))
    axes = drawn(store, x="entropy_scale").figure.axes
    assert [panel.get_ylabel() for panel in axes] == ["GreedyAC", "", "SAC", ""]
    assert [panel.texts[0].get_text() for panel in axes[:2]] == ["Acrobot-CA", "Pendulum-CA"]
    assert {panel.get_xlabel() for panel in axes[2:]} == {"Entropy scale τ"}
    assert axes[0].get_ylim() == axes[2].get_ylim()


def test_one_seed_has_no_interval_and_it_is_said(tmp_path):
    drawing = drawn(study(tmp_path, seeds=1))
    assert drawing.data["low"].isna().all()
    assert not drawing.figure.axes[0].collections
    assert "no interval from one" in texts(drawing)
    assert "one tuning seed: no interval; it needs two at least" in drawing.notes


def test_a_value_without_runs_is_left_out_and_the_missing_trials_are_counted(tmp_path):
    drawing = drawn(study(tmp_path, means=MEANS | {(1e-1, 0.1): None}))
    over, at_best, _ = lines(drawing.figure.axes[0])
    assert points(at_best) == pytest.approx({1e-3: 10, 1e-2: 40})
    assert points(over) == pytest.approx({1e-3: 30, 1e-2: 40, 1e-1: 5})
    assert "SAC on Pendulum-CA: 10 of 12 trials" in drawing.notes


def test_texts_are_an_axis_too(tmp_path):
    store = SyntheticStore(tmp_path)
    for layers, mean in (((8,), 1), ((8, 8), 3), ((64, 64), 2)):
        store.finish(store.plan("study", "SAC", "Pendulum-CA", 0, hidden_layers=layers), [mean])
    (axes,) = drawn(store.write_studies()).figure.axes
    _, at_best, star = lines(axes)
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["[64, 64]", "[8, 8]", "[8]"]
    assert (list(at_best.get_ydata()), list(star.get_xdata())) == ([2, 3, 1], [1])


def test_runs_that_all_diverged_are_drawn_at_the_worst_return(tmp_path):
    store = SyntheticStore(tmp_path)
    for x in SIZES:
        store.finish(store.plan("study", "SAC", "Pendulum-CA", 0, critic_step_size=x), [-7, math.nan])
    drawing = drawn(store.write_studies())
    assert list(lines(drawing.figure.axes[0])[1].get_ydata()) == [-7, -7, -7]
    assert "SAC on Pendulum-CA: 3 diverged, counted as the worst return of the environment" in drawing.notes


def test_long_intervals_do_not_flatten_the_lines(tmp_path):
    drawing = drawn(study(tmp_path, spread=30))
    assert drawing.data["low"].min() < -370  # 12.7 times 30 below the mean
    low, high = drawing.figure.axes[0].get_ylim()
    assert low == pytest.approx(10 - 1.08 * 30)  # the means shown reach from 10 to 40: as much again on either side
    assert high == pytest.approx(40 + 1.08 * 30)


def test_the_query_gives_the_rows(tmp_path):
    store = study(tmp_path)
    drawing = drawn(store)
    found = run_query(store, drawing.sql).to_pandas()
    assert found["at_best"].tolist() == pytest.approx(drawing.data["at_best"].tolist())


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("critic_stepsize", UserError, 'did you mean "critic_step_size"'),
        ("polyak", NoDataError, "does not sweep polyak; it sweeps critic_step_size, entropy_scale"),
    ],
)
def test_a_hyperparameter_must_be_swept(name, error, message, tmp_path):
    with pytest.raises(error, match=message):
        drawn(study(tmp_path), x=name)


def test_a_study_without_runs_or_without_a_sweep_says_so(tmp_path):
    nothing = study(tmp_path / "nothing", means=dict.fromkeys(MEANS))
    with pytest.raises(NoDataError, match="no finished tuning run yet"):
        drawn(nothing)
    assert slices.studies(connect(nothing), Options()) == []
    with pytest.raises(NoDataError, match="sweeps no hyperparameter"):
        drawn(study(tmp_path / "one", means={(1e-3, 0.1): 1}))


def test_it_is_drawn_from_runs_that_were_trained(real_store):
    connection = connect(real_store)
    drawing = slices.draw(connection, "chapter-6", Options(title="Title"))
    assert len(drawing.figure.axes) == 3 * 4 * 3
    assert "not swept here" in texts(drawing)  # the entropy scale of GreedyAC with discrete actions
    assert {"chapter-6", "figure-7-1", "figure-7-2"} <= set(slices.studies(connection, Options()))
    assert slices.studies(connection, Options(x="num_action_samples")) == ["figure-7-2"]
