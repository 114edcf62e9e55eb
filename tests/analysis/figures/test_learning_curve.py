"""Learning curves: lines, bands and axes against numbers worked out by hand, and what is said of the runs behind them."""

import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures import learning_curve
from analysis.figures.drawing import Drawing
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query
from sweep.messages import UserError

PENDULUM, CAR = "Pendulum-CA", "MountainCar-CA"


def tune(store: SyntheticStore, agent: str, environment: str, worst: float = -100.0, **hypers: object) -> None:
    """Two settings on two seeds: step-size 0.1 is the best, 0.01 has the worst return."""
    for seed in range(2):
        store.finish(store.plan("demo", agent, environment, seed, critic_step_size=0.1, **hypers), [50.0 + seed])
        store.finish(store.plan("demo", agent, environment, seed, critic_step_size=0.01, **hypers), [worst])


def evaluate(store: SyntheticStore, agent: str, environment: str, *runs: list[float], **more: object) -> None:
    """Evaluate step-size 0.1; a run is the returns of its episodes."""
    for seed, returns in enumerate(runs, 10):
        member = store.plan("demo", agent, environment, seed, "evaluate", critic_step_size=0.1)
        if returns:
            store.finish(member, returns, **more)


def drawn(store: SyntheticStore | Path, study: str = "demo", **options: object) -> Drawing:
    path = store.write_studies() if isinstance(store, SyntheticStore) else store
    return learning_curve.draw(connect(path), study, Options(title="Title", **options))


def band(axes: Axes, number: int = 0) -> dict[float, tuple[float, float]]:
    """Return x → the lowest and the highest corner of a shaded band there."""
    corners = axes.collections[number].get_paths()[0].vertices
    return {x: (corners[corners[:, 0] == x, 1].min(), corners[corners[:, 0] == x, 1].max()) for x in set(corners[:, 0])}


def at(axes: Axes, step: float, line: int = 0) -> float:
    """Return the height of a line at the last reading that is not after `step`."""
    x, y = axes.lines[line].get_data()
    return float(y[np.searchsorted(x, step, side="right") - 1])


@pytest.fixture
def by_episode(tmp_path):
    store = SyntheticStore(tmp_path)
    tune(store, "SAC", PENDULUM)
    evaluate(store, "SAC", PENDULUM, [0, 10], [20, 30], [40, 80])
    return store


def test_episodes_of_one_length_are_counted_and_averaged_over_the_evaluation_runs(by_episode):
    drawing = drawn(by_episode)
    (axes,) = drawing.figure.axes
    assert (axes.get_xlabel(), axes.get_title()) == ("Episode", PENDULUM)
    assert drawing.figure.get_supylabel() == "Average episodic return"
    assert axes.lines[0].get_xydata().tolist() == [[1, 20], [2, 40]]
    errors = 20 / math.sqrt(3), math.sqrt((30**2 + 10**2 + 40**2) / 2) / math.sqrt(3)
    shaded = band(axes)
    assert shaded[1] == pytest.approx((20 - errors[0], 20 + errors[0]))
    assert shaded[2] == pytest.approx((40 - errors[1], 40 + errors[1]))
    said = "mean ± 1 standard error; 3 evaluation runs a line, 1,000 steps; tuned per environment"
    assert drawing.notes == [f"study demo: {said}", "SAC on Pendulum-CA: 40 at the end (19.18 to 60.82), n = 3"]
    assert drawing.figure.get_suptitle().replace("\n", " ") == f"Title {said}"


def test_episodes_of_different_lengths_are_repeated_over_their_steps(tmp_path):
    store = SyntheticStore(tmp_path)
    tune(store, "SAC", CAR)
    evaluate(store, "SAC", CAR, [0, 10], [100, 200, 300, 400])
    (axes,) = drawn(store).figure.axes
    assert axes.get_xlabel() == "Environment steps"
    assert len(axes.lines[0].get_xdata()) == 500
    readings = {1: 50, 249: 50, 260: 100, 490: 100, 520: 155, 745: 155, 760: 205, 1000: 205}
    assert {step: at(axes, step) for step in readings} == readings
    assert axes.lines[0].get_xdata()[[0, -1]].tolist() == [1, 1000]


def test_as_many_episodes_of_other_lengths_are_not_counted(tmp_path):
    store = SyntheticStore(tmp_path)
    tune(store, "SAC", CAR)
    evaluate(store, "SAC", CAR, [0, 10], lengths=[400, 600])
    store.finish(store.plan("demo", "SAC", CAR, 11, "evaluate", critic_step_size=0.1), [20, 30], lengths=[500, 500])
    (axes,) = drawn(store).figure.axes
    assert axes.get_xlabel() == "Environment steps"
    assert [at(axes, step) for step in (1, 450, 600)] == [10, 15, 20]


def test_the_budget_cut_episode_repeats_the_one_before_and_a_diverged_run_is_the_worst_from_then_on(tmp_path):
    store = SyntheticStore(tmp_path)
    tune(store, "SAC", CAR, worst=-7)
    evaluate(store, "SAC", CAR, [10, 999], endings=["terminated", "budget"], lengths=[400, 600])
    member = store.plan("demo", "SAC", CAR, 11, "evaluate", critic_step_size=0.1)
    store.finish(member, [30, math.nan], lengths=[600, 400])
    store.finish(store.plan("demo", "SAC", CAR, 12, "evaluate", critic_step_size=0.1), [5.0], ["budget"], [1000])
    drawing = drawn(store)
    (axes,) = drawing.figure.axes
    assert [at(axes, step) for step in (1, 590, 610, 1000)] == [20, 20, 1.5, 1.5]
    assert "SAC on MountainCar-CA: 1 diverged, counted as the worst return of the environment from then on" in drawing.notes
    assert "n = 2" in drawing.notes[-1]  # the third has completed nothing
    for kind in ("min-max", "runs"):  # from the runs' own curves: the same mean
        own = drawn(store, band=kind).figure.axes[0]
        lines = [line for line in own.lines if line.get_marker() != "None"]
        assert np.array_equal(lines[0].get_ydata(), axes.lines[0].get_ydata())
    assert band(drawn(store, band="min-max").figure.axes[0])[1] == (10, 30)
    assert band(drawn(store, band="min-max").figure.axes[0])[1000] == (-7, 10)


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [("standard-error", 1, 1), ("student", 4.302653, 4.302653), ("min-max", 20, 20)],
)
def test_bands_reach_as_far_as_they_say(kind, low, high, by_episode):
    drawing = drawn(by_episode, band=kind)
    scale = 1 if kind == "min-max" else 20 / math.sqrt(3)
    assert band(drawing.figure.axes[0])[1] == pytest.approx((20 - low * scale, 20 + high * scale), rel=1e-6)
    first = drawing.data.iloc[0]
    assert (first["low"], first["mean"], first["high"]) == pytest.approx((20 - low * scale, 20, 20 + high * scale), rel=1e-6)


def test_a_bootstrap_band_lies_between_the_extreme_runs_and_depends_on_the_seed(tmp_path):
    store = SyntheticStore(tmp_path)
    tune(store, "SAC", PENDULUM)
    scores = [0.0, 3.25, 11.5, 18.75, 31.125, 44.0, 52.625, 77.25]
    evaluate(store, "SAC", PENDULUM, *([score] for score in scores))
    first, again, other = (drawn(store, band="bootstrap", seed=seed).data for seed in (0, 0, 1))
    assert first.equals(again)
    assert not first.equals(other)
    # by 200,000 resamples of numpy's own
    means = np.random.default_rng(5).choice(scores, (200_000, 8)).mean(1)
    assert [first["low"][0], first["high"][0]] == pytest.approx(np.quantile(means, [0.025, 0.975]), abs=1.5)


def test_single_runs_are_thin_lines_without_a_band_and_have_rows(by_episode):
    drawing = drawn(by_episode, band="runs")
    (axes,) = drawing.figure.axes
    assert len(axes.collections) == 0
    assert sorted(line.get_ydata().tolist() for line in axes.lines if line.get_linewidth() < 1) == [[0, 10], [20, 30], [40, 80]]
    assert drawing.data["trial"].nunique() == 3
    assert sorted(drawing.data["episodic_return"].dropna()) == [0, 10, 20, 30, 40, 80]
    (plain,) = drawn(by_episode, band="none").figure.axes
    assert (len(plain.lines), len(plain.collections)) == (1, 0)


def test_one_run_has_no_interval_and_it_is_said(tmp_path):
    store = SyntheticStore(tmp_path)
    tune(store, "SAC", PENDULUM)
    evaluate(store, "SAC", PENDULUM, [0, 10])
    for kind in ("standard-error", "student", "bootstrap"):
        drawing = drawn(store, band=kind)
        assert len(drawing.figure.axes[0].collections) == 0
        assert "a single run, no interval; 1 evaluation run a line" in drawing.notes[0]
        assert "one run gives no interval" in drawing.notes[-1]
        assert drawing.data["low"].isna().all()


def test_without_evaluation_runs_the_tuning_runs_are_drawn_with_a_warning(tmp_path):
    store = SyntheticStore(tmp_path)
    tune(store, "SAC", PENDULUM)
    drawing = drawn(store)
    assert drawing.data["mean"].to_list() == [50.5]
    assert "2 tuning runs that the settings were chosen by a line" in drawing.notes[0]
    assert (
        "warning: no evaluation runs; these are the tuning runs that the settings were chosen by: biased upwards" in drawing.notes
    )


def test_a_study_without_a_choice_is_not_biased(tmp_path):
    store = SyntheticStore(tmp_path)
    store.finish(store.plan("demo", "SAC", PENDULUM, 0), [1.0])
    notes = drawn(store).notes
    assert "chosen" not in "".join(notes)
    assert "tuned" not in "".join(notes)


def test_missing_runs_are_counted_and_empty_panels_are_explained(by_episode):
    evaluate(by_episode, "SAC", CAR, [])
    tune(by_episode, "SAC", CAR)
    drawing = drawn(by_episode)
    assert [axes.get_title() for axes in drawing.figure.axes] == [CAR, PENDULUM]
    assert [text.get_text() for text in drawing.figure.axes[0].texts] == ["no data yet"]
    assert "SAC on MountainCar-CA: 0 of 1 runs" in drawing.notes


def test_lines_differ_in_color_marker_and_dash_and_have_one_legend(tmp_path):
    store = SyntheticStore(tmp_path)
    for agent in ("GreedyAC", "SAC", "VanillaAC"):
        for environment in (CAR, PENDULUM):
            tune(store, agent, environment)
            evaluate(store, agent, environment, [0, 10], [1, 2])
    drawing = drawn(store)
    lines = drawing.figure.axes[0].lines
    for look in ("get_color", "get_marker", "get_linestyle"):
        assert len({getattr(line, look)() for line in lines}) == 3
    (legend,) = drawing.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["GreedyAC", "SAC", "VanillaAC"]
    only = drawn(store, agents=("S*",), environments=("Pend*",))
    assert [axes.get_title() for axes in only.figure.axes] == [PENDULUM]
    assert only.data["agent"].unique().tolist() == ["SAC"]


def test_six_environments_stand_in_two_rows(tmp_path):
    store = SyntheticStore(tmp_path)
    for index in range(5):
        tune(store, "SAC", f"Place-{index}")
    axes = drawn(store).figure.axes
    assert len(axes) == 5
    assert len({round(panel.get_subplotspec().rowspan.start) for panel in axes}) == 2


def test_over_draws_a_line_for_each_value_among_the_chosen_settings(tmp_path):
    store = SyntheticStore(tmp_path)
    for agent, polyak in (("GreedyAC", 0.1), ("SAC", 0.5)):
        tune(store, agent, PENDULUM, polyak=polyak)
    drawing = drawn(store, over="polyak")
    assert sorted(drawing.data["line"].unique()) == ["0.1", "0.5"]
    (legend,) = drawing.figure.legends
    assert legend.get_title().get_text() == "Polyak averaging weight"
    with pytest.raises(UserError, match=r'--over: unknown hyperparameter "polyac": did you mean "polyak"'):
        drawn(store, over="polyac")
    with pytest.raises(NoDataError, match=r'shows one batch_size only.*for_each = \["batch_size"\]'):
        drawn(store, over="batch_size")


def test_what_a_study_lacks_is_named(tmp_path):
    store = SyntheticStore(tmp_path)
    store.plan("demo", "SAC", PENDULUM, 0)
    with pytest.raises(NoDataError, match=r"no runs of chosen settings yet: .*`sweep launch` trains them"):
        drawn(store)
    tune(store, "SAC", CAR)
    with pytest.raises(NoDataError, match="no such agent on such an environment; it has SAC on MountainCar-CA, Pendulum-CA"):
        drawn(store, agents=("DDPG",))


def test_a_study_whose_runs_all_diverged_at_once_has_no_curve(tmp_path):
    store = SyntheticStore(tmp_path)
    for seed in range(2):
        store.finish(store.plan("demo", "SAC", PENDULUM, seed), [math.nan])
    with pytest.raises(NoDataError):
        drawn(store)


def test_the_query_gives_the_readings_of_the_figure(by_episode):
    rows = run_query(by_episode.write_studies(), drawn(by_episode).sql).to_pylist()
    assert [(row["step"], row["mean"], row["num_seeds"]) for row in rows] == [(1, 20, 3), (501, 40, 3)]
    rows = run_query(by_episode.path, drawn(by_episode, band="min-max").sql).to_pylist()
    assert sorted(row["episodic_return"] for row in rows) == [0, 10, 20, 30, 40, 80]


def test_studies_are_those_with_runs_and_with_over_those_that_choose_for_each_value(real_store, empty_store):
    connection = connect(real_store)
    every = ["chapter-3", "chapter-6", "figure-7-1", "figure-7-2"]
    assert learning_curve.studies(connection, Options()) == every
    assert learning_curve.studies(connection, Options(environments=("Acrobot-*",))) == ["chapter-6", "figure-7-1"]
    assert learning_curve.studies(connection, Options(over="num_action_samples")) == ["figure-7-2"]
    assert learning_curve.studies(connection, Options(over="critic_step_size")) == every[1:]
    assert learning_curve.studies(connection, Options(over="batch_size")) == []
    with pytest.raises(UserError, match=r'--over: unknown hyperparameter "polyac": did you mean "polyak"'):
        learning_curve.studies(connection, Options(over="polyac"))
    assert learning_curve.studies(connect(empty_store), Options()) == []


def test_a_rule_that_a_study_has_not_chosen_by_is_refused(real_store):
    with pytest.raises(
        NoDataError, match='"figure-7-2" has chosen no settings across-environments; it chose them per-environment'
    ):
        drawn(real_store, "figure-7-2", by="across-environments")
    assert "across-environments" in drawn(real_store, "chapter-6", by="across-environments").data["by"].to_list()
    assert learning_curve.studies(connect(real_store), Options(by="across-environments")) == [
        "chapter-3",
        "chapter-6",
        "figure-7-1",
    ]


def test_a_line_for_each_value_of_a_real_study_equals_the_mean_of_its_episodes(real_store):
    drawing = drawn(real_store, "figure-7-2", over="num_action_samples", environments=(PENDULUM,))
    (axes,) = drawing.figure.axes
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    assert list(lines) == ["10", "20", "30"]
    for value, line in lines.items():
        rows = (
            connect(real_store)
            .execute(
                """
                SELECT episodes.episode, avg(CAST(episodes.episodic_return AS DOUBLE))
                FROM selections
                INNER JOIN members USING (study, agent, environment, setting)
                INNER JOIN episodes ON episodes.trial = members.trial
                WHERE study = 'figure-7-2' AND members.stage = 'evaluate' AND environment = 'Pendulum-CA'
                    AND selections.num_action_samples = ?
                GROUP BY episodes.episode
                ORDER BY episodes.episode
                """,
                [int(value)],
            )
            .fetchall()
        )
        assert len(rows) == 4
        assert line == pytest.approx([mean for _, mean in rows], rel=1e-9)
