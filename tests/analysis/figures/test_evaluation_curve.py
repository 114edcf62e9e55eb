"""Deterministic evaluation beside the learning: which runs make which line, and what becomes of diverged and of lucky ones."""

import math

import pytest
from matplotlib.colors import to_rgb
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures import catalogue, evaluation_curve
from analysis.figures.drawing import Drawing
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query

PLACE = "Pendulum-CA"
GAUSSIAN, OU = {"exploration_noise": "gaussian"}, {"exploration_noise": "ornstein-uhlenbeck"}


def run(store: SyntheticStore, agent: str, seed: int, evaluations: dict[int, list[float]], returns=(0.0,), **hypers) -> None:
    """A run with these evaluation returns by step."""
    member = store.plan("demo", agent, PLACE, seed, **hypers)
    store.finish(member, returns, evaluations=[(step, value) for step, values in evaluations.items() for value in values])


def drawn(store: SyntheticStore, **options: object) -> Drawing:
    return evaluation_curve.draw(connect(store.write_studies()), "demo", Options(title="Title", **options))


@pytest.fixture
def three_lines(tmp_path):
    """SAC on three seeds, and two DDPGs on two."""
    store = SyntheticStore(tmp_path)
    for seed, (first, second) in enumerate([(0, 10), (2, 60), (4, 20)]):
        run(store, "SAC", seed, {100: [first - 1, first + 1], 200: [second]})
    for seed in range(2):
        run(store, "DDPG", seed, {100: [5 + seed], 200: [7 + seed]}, exploration_scale=0.1, **GAUSSIAN)
        run(store, "DDPG", seed, {100: [15 + seed], 200: [17 + seed]}, exploration_scale=0.3, **OU)
    return store


def test_a_line_is_the_mean_over_runs_of_their_mean_over_episodes(three_lines):
    drawing = drawn(three_lines, agents=("SAC",))
    (axes,) = drawing.figure.axes
    assert axes.lines[0].get_xydata().tolist() == [[100, 2], [200, 30]]
    corners = axes.collections[0].get_paths()[0].vertices
    error = math.sqrt((20**2 + 30**2 + 10**2) / 2 / 3)
    assert max(corners[corners[:, 0] == 200, 1]) == pytest.approx(30 + error)
    assert (axes.get_xlabel(), drawing.figure.get_supylabel()) == ("Environment steps", "Average evaluation return")
    said = "mean ± 1 standard error; 3 tuning runs a line, 1,000 steps"
    assert drawing.notes == [
        f"study demo: {said}",
        f"SAC on Pendulum-CA: 30 at the end ({30 - error:.4g} to {30 + error:.4g}), n = 3",
    ]


def test_the_numbers_are_those_of_the_view(three_lines):
    data = drawn(three_lines, agents=("SAC",), band="min-max").data
    rows = connect(three_lines.path).execute(
        "SELECT step, mean, min, max FROM evaluation_curves WHERE agent = 'SAC' ORDER BY step"
    )
    assert data[["step", "mean", "low", "high"]].to_numpy().tolist() == [list(row) for row in rows.fetchall()]


def test_settings_that_nobody_chose_among_are_lines_named_by_what_tells_them_apart(three_lines):
    drawing = drawn(three_lines)
    names = ["DDPG, exploration noise gaussian", "DDPG, exploration noise ornstein-uhlenbeck", "SAC"]
    assert [text.get_text() for text in drawing.figure.legends[0].get_texts()] == names
    lines = {line.get_label(): line for line in drawing.figure.axes[0].lines}
    assert [lines[name].get_ydata()[0] for name in names] == [5.5, 15.5, 2]
    assert len({to_rgb(line.get_color()) for line in lines.values()}) == 3
    assert len({line.get_linestyle() for line in lines.values()}) == 3


@pytest.mark.parametrize(("where", "height"), [(GAUSSIAN, 5.5), (OU, 15.5)])
def test_where_keeps_settings_that_lack_the_hyperparameter_or_have_the_value(where, height, three_lines):
    lines = drawn(three_lines, where=where).figure.axes[0].lines
    assert {line.get_label(): line.get_ydata()[0] for line in lines} == {"DDPG": height, "SAC": 2}


def test_where_that_no_setting_meets_is_said(three_lines):
    with pytest.raises(NoDataError, match='"demo" has no setting with exploration_noise = pink'):
        drawn(three_lines, where={"exploration_noise": "pink"})
    assert evaluation_curve.studies(connect(three_lines.path), Options(where={"exploration_noise": "pink"})) == []
    assert evaluation_curve.studies(connect(three_lines.path), Options(where=GAUSSIAN)) == ["demo"]


def test_the_luckiest_runs_are_those_with_the_highest_mean_and_it_is_said(three_lines):
    drawing = drawn(three_lines, agents=("SAC",), best_runs=2, band="min-max")
    assert drawing.figure.axes[0].lines[0].get_ydata().tolist() == [3, 40]  # the runs (2, 60) and (4, 20)
    assert "mean, lowest and highest run; 2 of 3 tuning runs a line, chosen for their returns" in drawing.notes[0]
    assert "chosen for their returns" in drawing.figure.get_suptitle().replace("\n", " ")
    assert drawing.data[["low", "high"]].to_numpy().tolist() == [[2, 4], [20, 60]]
    assert "chosen" not in drawn(three_lines, agents=("SAC",), best_runs=3).notes[0]


def test_a_diverged_run_is_left_out_from_then_on(tmp_path):
    store = SyntheticStore(tmp_path)
    run(store, "SAC", 0, {100: [1], 200: [2]})
    run(store, "SAC", 1, {100: [3], 200: [math.nan]}, returns=[0.0, math.nan])
    for band in ("standard-error", "bootstrap", "student"):
        drawing = drawn(store, band=band)
        assert drawing.figure.axes[0].lines[0].get_ydata().tolist() == [2, 2]
        assert drawing.data["low"].isna().to_list() == [False, True]
    assert "SAC on Pendulum-CA: 1 diverged, left out from then on: the mean is too good" in drawing.notes
    assert drawn(store, band="student").data["high"][0] == pytest.approx(2 + 12.7062, rel=1e-5)


def test_all_diverged_is_no_data(tmp_path):
    store = SyntheticStore(tmp_path)
    run(store, "SAC", 0, {100: [math.nan]}, returns=[math.nan])
    with pytest.raises(NoDataError, match="no run has a finite return yet"):
        drawn(store)


def test_without_evaluations_figures_of_chapter_3_show_learning_curves_and_others_nothing(tmp_path):
    store = SyntheticStore(tmp_path)
    run(store, "SAC", 0, {}, returns=[10.0, 20.0])
    run(store, "SAC", 1, {}, returns=[30.0, 60.0])
    with pytest.raises(NoDataError, match=r"has no evaluation episodes .*: see learning-curve"):
        drawn(store, band="runs")
    drawing = drawn(store, band="runs", where={"entropy_tuning": "fixed"})  # the figures of chapter 3 say which
    x, y = drawing.figure.axes[0].lines[-1].get_data()
    assert (x[0], x[-1], y[0], y[-1]) == (1, 1000, 20, 40)
    assert "learning curves, for want of deterministic evaluations" in drawing.figure.get_suptitle().replace("\n", " ")
    assert drawing.figure.get_supylabel() == "Average episodic return"
    assert 'the study has no deterministic evaluations ("evaluation" in its grid)' in drawing.notes[1]
    assert run_query(store.path, drawing.sql).num_rows == 4


def test_of_many_settings_the_chosen_one_is_drawn_with_a_warning(tmp_path):
    store = SyntheticStore(tmp_path)
    for index in range(7):
        for seed in range(2):
            run(store, "SAC", seed, {100: [float(index)]}, returns=[float(index)], critic_step_size=10.0 ** -(index + 1))
    drawing = drawn(store)
    assert [line.get_ydata().tolist() for line in drawing.figure.axes[0].lines] == [[6]]
    assert "by which the settings were chosen" in drawing.notes[0]
    assert any(note.startswith("warning: no evaluation runs") for note in drawing.notes)


def test_a_long_legend_makes_the_figure_higher_and_leaves_the_panel_as_it_is(tmp_path):
    store = SyntheticStore(tmp_path)
    settings = [(x, k, t) for x in (1e-3, 1e-4) for k in (0.1, 1.0) for t in (1e-3, 1e-2)][:6]
    for agent in ("GreedyAC", "SAC"):
        for x, k, t in settings:
            run(store, agent, 0, {100: [1.0], 200: [2.0]}, critic_step_size=x, actor_step_size_scale=k, entropy_scale=t)
    heights = []
    for agents in (("SAC",), ("GreedyAC", "SAC")):
        figure = drawn(store, agents=agents).figure
        figure.draw_without_rendering()  # a panel that vanishes is a warning, and so an error
        legend, panel = figure.legends[0].get_window_extent(), figure.axes[0].get_window_extent()
        assert legend.x0 >= 0
        assert legend.x1 <= figure.bbox.x1
        assert legend.y1 < panel.y0
        assert figure._supylabel.get_position()[1] * figure.bbox.height > legend.y1
        heights.append(panel.height / figure.dpi)
    assert min(heights) > 1.2


def test_at_most_500_points_are_shown_first_and_last_among_them(tmp_path):
    store = SyntheticStore(tmp_path)
    run(store, "SAC", 0, {step: [float(step)] for step in range(1, 1_201)})
    x, y = drawn(store).figure.axes[0].lines[0].get_data()
    assert (len(x), x[0], x[-1]) == (500, 1, 1200)
    assert x.tolist() == y.tolist()


@pytest.mark.parametrize(("number", "lines"), [("3.1", 2), ("3.2", 2), ("3.3", 2), ("evaluation-curve", 3)])
def test_figures_of_chapter_3_come_from_a_trained_study(number, lines, real_store):
    entry = catalogue.find(number)
    drawing = entry.load().draw(connect(real_store), "chapter-3", entry.options.but(title=entry.title))
    (axes,) = drawing.figure.axes
    assert len([line for line in axes.lines if line.get_linewidth() > 1]) == lines
    assert axes.lines[0].get_xdata().tolist() == [40, 80, 120, 160]
    assert ("chosen for their returns" in drawing.notes[0]) == (number == "3.2")
    assert run_query(real_store, drawing.sql).num_rows > 0


def test_studies_that_evaluate_go_before_the_others(real_store):
    assert evaluation_curve.studies(connect(real_store), Options()) == ["chapter-3"]
    assert evaluation_curve.studies(connect(real_store), Options(environments=("Acrobot-*",))) == []
