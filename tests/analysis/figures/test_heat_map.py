"""Heat maps: the cells drawn are those worked out by hand."""

import itertools
import math

import numpy as np
import pytest
from matplotlib.patches import Rectangle
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures import heat_map
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query
from sweep.messages import UserError

SIZES, KAPPAS, SCALES = [1e-3, 1e-2], [0.1, 1.0, 2.0], [0.1, 1.0]


def mean(x, kappa, tau):
    return 1000 * x + 100 * kappa + tau


def study(path, agents=("SAC",), environments=("Pendulum-CA",), without=(), score=mean):
    store = SyntheticStore(path)
    for agent, environment, x, kappa, tau in itertools.product(agents, environments, SIZES, KAPPAS, SCALES):
        member = store.plan("study", agent, environment, 0, critic_step_size=x, actor_step_size_scale=kappa, entropy_scale=tau)
        if (x, kappa) not in without:
            store.finish(member, [score(x, kappa, tau)])
    return store.write_studies()


def drawn(store, **options):
    return heat_map.draw(connect(store), "study", Options(title="Title", **options))


def panels(drawing):
    return [axes for axes in drawing.figure.axes if axes.get_label() != "<colorbar>"]


def cells(axes):
    (image,) = axes.images
    return np.ma.filled(image.get_array(), np.nan)


def hatched(axes):
    return [(round(p.get_x() + 0.5), round(p.get_y() + 0.5)) for p in axes.patches if isinstance(p, Rectangle) and p.get_hatch()]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return study(tmp_path_factory.mktemp("heat-map") / "store")


def test_a_cell_is_the_best_over_the_others(store):
    (axes,) = panels(drawn(store))
    assert cells(axes) == pytest.approx(np.array([[mean(x, kappa, 1.0) for x in SIZES] for kappa in KAPPAS]))
    assert [text.get_text() for text in axes.texts] == ["12", "21", "102", "111", "202", "211"]


def test_the_two_most_widely_swept_hyperparameters_are_the_axes(store):
    drawing = drawn(store)
    (axes,) = panels(drawing)
    assert axes.get_xlabel() == "Critic step-size"
    assert drawing.figure.get_supylabel() == "Actor step-size scale κ"
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["$10^{-3}$", "$10^{-2}$"]
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["$10^{-1}$", "$10^{0}$", "2"]
    assert "best over entropy_scale" in drawing.figure.get_suptitle().replace("\n", " ")
    other = drawn(store, x="entropy_scale")
    assert (other.figure.axes[0].get_xlabel(), other.figure.get_supylabel()) == ("Entropy scale τ", "Critic step-size")


def test_the_best_cell_is_outlined(store):
    (axes,) = panels(drawn(store))
    (outline,) = [patch for patch in axes.patches if not patch.get_hatch()]
    center = outline.get_x() + outline.get_width() / 2, outline.get_y() + outline.get_height() / 2
    assert center == pytest.approx((1, 2))


def test_cells_that_wait_for_runs_are_hatched_and_named(tmp_path):
    drawing = drawn(study(tmp_path, without=[(1e-3, 2.0)]))
    (axes,) = panels(drawing)
    assert hatched(axes) == [(0, 2)]
    assert np.isnan(cells(axes)[2, 0])
    assert [text.get_text() for text in drawing.figure.legends[0].texts] == ["no data yet"]
    assert "SAC on Pendulum-CA: no data yet for (critic_step_size, actor_step_size_scale) (0.001, 2.0)" in drawing.notes
    assert "SAC on Pendulum-CA: 10 of 12 trials" in drawing.notes


def test_cells_that_are_no_part_of_the_study_are_empty(tmp_path):
    store = SyntheticStore(tmp_path)
    for x, kappa in ((1e-3, 0.1), (1e-2, 1.0)):
        store.finish(store.plan("study", "SAC", "Pendulum-CA", 0, critic_step_size=x, actor_step_size_scale=kappa), [kappa])
    drawing = drawn(store.write_studies())
    (axes,) = panels(drawing)
    assert np.isnan(cells(axes)).tolist() == [[False, True], [True, False]]
    assert hatched(axes) == []
    assert not drawing.figure.legends


def test_agents_on_an_environment_share_a_scale(tmp_path):
    store = study(tmp_path, agents=("GreedyAC", "SAC"), environments=("Acrobot-CA", "Pendulum-CA"))
    drawing = drawn(store)
    axes = panels(drawing)
    assert [panel.get_ylabel() for panel in axes] == ["GreedyAC", "", "SAC", ""]
    assert axes[0].images[0].norm is axes[2].images[0].norm
    assert axes[0].images[0].norm is not axes[1].images[0].norm
    bars = [panel for panel in drawing.figure.axes if panel not in axes]
    assert [bar.get_title() for bar in bars] == ["Acrobot-CA", "Pendulum-CA"]


def test_numbers_that_do_not_fit_are_left_out(tmp_path):
    store = SyntheticStore(tmp_path)
    for x, kappa in itertools.product(range(1, 31), range(1, 3)):
        member = store.plan("study", "SAC", "Pendulum-CA", 0, critic_step_size=x / 10, actor_step_size_scale=kappa / 10)
        store.finish(member, [-x * 1000.5])
    (axes,) = panels(drawn(store.write_studies()))
    assert not axes.texts


def test_equal_cells_and_diverged_runs_are_drawn(tmp_path):
    store = SyntheticStore(tmp_path)
    for x, kappa in itertools.product(SIZES, KAPPAS):
        member = store.plan("study", "SAC", "Pendulum-CA", 0, critic_step_size=x, actor_step_size_scale=kappa)
        store.finish(member, [-3, math.nan])
    drawing = drawn(store.write_studies())
    assert (cells(panels(drawing)[0]) == -3).all()
    assert "SAC on Pendulum-CA: 6 diverged, counted as the worst return of the environment" in drawing.notes


def test_the_query_gives_the_rows(store):
    drawing = drawn(store)
    found = run_query(store, drawing.sql).to_pandas()
    assert found["best_mean"].tolist() == drawing.data["best_mean"].tolist()
    assert found["num_settings"].tolist() == [2] * 6


def test_mistakes_are_named(store, tmp_path):
    with pytest.raises(UserError, match="--x and --over are both entropy_scale"):
        drawn(store, x="entropy_scale", over="entropy_scale")
    with pytest.raises(UserError, match='--over: unknown hyperparameter "entropyscale": did you mean "entropy_scale"'):
        drawn(store, over="entropyscale")
    alone = SyntheticStore(tmp_path)
    for x in SIZES:
        alone.finish(alone.plan("study", "SAC", "Pendulum-CA", 0, critic_step_size=x), [x])
    with pytest.raises(NoDataError, match="sweeps critic_step_size alone: a heat map needs two"):
        drawn(alone.write_studies())
    assert heat_map.studies(connect(tmp_path), Options()) == []


def test_it_is_drawn_from_runs_that_were_trained(real_store):
    connection = connect(real_store)
    drawing = heat_map.draw(connection, "chapter-6", Options(title="Title", over="entropy_scale"))
    axes = panels(drawing)
    assert len(axes) == 3 * 4
    assert [text.get_text() for text in axes[3].texts] == ["without one of the two"]  # GreedyAC with discrete actions
    assert all(np.isfinite(cells(panel)).all() for panel in axes if panel.images)
    assert {"chapter-6", "figure-7-1", "figure-7-2"} <= set(heat_map.studies(connection, Options()))


def test_a_value_that_one_agent_has_fixed_outside_the_sweep_of_another_has_a_place(tmp_path):
    store = SyntheticStore(tmp_path)
    for x, kappa in itertools.product(SIZES, KAPPAS):
        store.finish(store.plan("study", "SAC", "Pendulum-CA", 0, critic_step_size=x, actor_step_size_scale=kappa), [x + kappa])
    for x in SIZES:
        store.finish(store.plan("study", "GreedyAC", "Pendulum-CA", 0, critic_step_size=x, actor_step_size_scale=0.5), [x])
    greedy, sac = panels(drawn(store.write_studies()))
    assert [tick.get_text() for tick in greedy.get_yticklabels()] == ["$10^{-1}$", "0.5", "$10^{0}$", "2"]
    assert cells(greedy)[1] == pytest.approx(SIZES)
    assert np.isnan(cells(sac)[1]).all()


def test_a_diverged_run_is_left_out_by_a_study_that_drops_it(tmp_path):
    store = SyntheticStore(tmp_path)
    for x, kappa, seed in itertools.product(SIZES, KAPPAS, (0, 1)):
        member = store.plan("study", "SAC", "Pendulum-CA", seed, critic_step_size=x, actor_step_size_scale=kappa)
        store.finish(member, [math.nan if (x, kappa, seed) == (1e-3, 0.1, 1) else 10 * kappa + seed])
    path = store.write_studies()
    (path / "studies" / "study" / "grid.toml").write_text('[select]\ndiverged = "drop"\n')
    drawing = drawn(path)
    assert cells(panels(drawing)[0])[0] == pytest.approx([1, 1.5])
    assert "SAC on Pendulum-CA: 1 diverged, left out" in drawing.notes
