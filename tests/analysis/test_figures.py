"""Sensitivity regions: what is drawn equals the views, and what is missing is said."""

import itertools
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import matplotlib.colors
import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from synthetic_store import SyntheticStore, build

from analysis import connect
from analysis.analyze import Result, analyze, find
from analysis.figures import sensitivity_region
from analysis.figures.drawing import Drawing
from analysis.figures.options import Options
from sweep.messages import UserError

STEP_SIZES, SCALES = [1e-4, 1e-3, 1e-2], [0.1, 1.0]


def full_study(path: Path, environments: list[str], step_sizes: list[float], study: str = "demo") -> Path:
    """Every cell finished, one setting and one seed a cell; return = 1000·α + τ, on SAC 100 more."""
    store = SyntheticStore(path)
    for agent, environment, x, tau in itertools.product(["GreedyAC", "SAC"], environments, step_sizes, SCALES):
        trial = store.plan(study, agent, environment, 0, critic_step_size=x, entropy_scale=tau)
        store.finish(trial, [1000 * x + tau + (100 if agent == "SAC" else 0)])
    return store.write_studies()


def drawn(store: Path, study: str = "demo") -> Drawing:
    return sensitivity_region.draw(connect(store), study, Options(title="Title"))


def saved(store: Path, study: str | None, out: Path, formats: Sequence[str] = ("png",)) -> Result:
    """Figure 7.1, written to a folder."""
    (result,) = analyze(store, find(["7.1"], []), study, out, formats)
    return result


def panels(drawing: Drawing) -> list[Axes]:
    return drawing.figure.axes


@pytest.mark.parametrize("environments", [["Pendulum-CA"], ["Acrobot-CA", "MountainCar-CA", "Pendulum-CA"]])
@pytest.mark.parametrize("step_sizes", [STEP_SIZES, [1e-3]])
def test_every_shape_is_saved_without_a_warning(environments, step_sizes, tmp_path):
    store = full_study(tmp_path / "store", environments, step_sizes)
    result = saved(store, None, tmp_path / "out", ["png", "svg", "pdf", "csv"])
    assert [file.name for file in result.files] == [f"figure-7.1.{format}" for format in ("png", "svg", "pdf", "csv")]
    assert result.files[0].read_bytes().startswith(b"\x89PNG")
    ElementTree.parse(result.files[1])
    assert result.files[2].read_bytes().startswith(b"%PDF")


def test_a_row_an_agent_and_a_column_an_environment(tmp_path):
    drawing = drawn(full_study(tmp_path, ["MountainCar-CA", "Pendulum-CA"], STEP_SIZES))
    assert [axes.get_ylabel() for axes in panels(drawing)] == ["GreedyAC", "", "SAC", ""]
    assert [axes.texts[0].get_text() for axes in panels(drawing)[:2]] == ["MountainCar-CA", "Pendulum-CA"]
    assert panels(drawing)[0].get_ylim() == panels(drawing)[2].get_ylim()
    assert {axes.get_xscale() for axes in panels(drawing)} == {"log"}


def test_the_lines_are_the_best_means_by_entropy_scale(tmp_path):
    lines = panels(drawn(full_study(tmp_path, ["Pendulum-CA"], STEP_SIZES)))[1].lines
    assert [line.get_label() for line in lines] == ["0.1", "1"]
    for line, tau in zip(lines, SCALES, strict=True):
        assert list(line.get_xdata()) == STEP_SIZES
        assert list(line.get_ydata()) == pytest.approx([1000 * x + tau + 100 for x in STEP_SIZES], rel=1e-6)


def test_the_region_reaches_from_the_lowest_to_the_highest_line(tmp_path):
    (axes, _) = panels(drawn(full_study(tmp_path, ["Pendulum-CA"], STEP_SIZES)))
    corners = np.concatenate([region.get_paths()[0].vertices for region in axes.collections])
    for x in STEP_SIZES:
        at = corners[np.isclose(corners[:, 0], x, rtol=1e-9), 1]
        assert (at.min(), at.max()) == pytest.approx((1000 * x + 0.1, 1000 * x + 1), rel=1e-6)


def test_missing_cells_are_counted_hatched_and_named(tmp_path):
    drawing = drawn(build(tmp_path))
    greedy_pendulum, sac_car = panels(drawing)[1], panels(drawing)[2]
    assert greedy_pendulum.get_title("right") == "11 of 18 trials, 1 diverged"
    assert [region.get_hatch() for region in greedy_pendulum.collections] == ["////"]
    assert np.isnan(greedy_pendulum.lines[1].get_ydata()[0])  # c: no seed yet
    assert [text.get_text() for text in sac_car.texts] == ["no data yet"]
    assert [text.get_text() for text in panels(drawing)[0].texts] == ["not in this study", "MountainCar-CA"]
    assert drawing.notes[0].startswith("study demo: mean over 1 to 3 tuning seeds, 1,000 steps; best over actor_step_size_scale")
    assert [note for note in drawing.notes[1:] if "interval of the width" not in note] == [
        "GreedyAC on Pendulum-CA: best mean 50; region 49 wide on average, 49 at most",
        "GreedyAC on Pendulum-CA: 11 of 18 trials",
        "GreedyAC on Pendulum-CA: no data yet for (critic_step_size, entropy_scale) (0.001, 1)",
        "GreedyAC on Pendulum-CA: 1 diverged, counted as the worst return of the environment",
        "SAC on MountainCar-CA: 1 of 3 trials",
        "SAC on MountainCar-CA: no data yet for (critic_step_size, entropy_scale) (0.001, 0.1)",
        "SAC on MountainCar-CA: 1 diverged, counted as the worst return of the environment",
        "SAC on Pendulum-CA: best mean 60; no region: one line at most at each critic step-size",
        "SAC on Pendulum-CA: 2 of 3 trials",
    ]


def test_complete_panels_say_nothing_of_trials_and_are_not_hatched(tmp_path):
    drawing = drawn(full_study(tmp_path, ["Pendulum-CA"], STEP_SIZES))
    assert {axes.get_title("right") for axes in panels(drawing)} == {""}
    assert {region.get_hatch() for axes in panels(drawing) for region in axes.collections} == {None}
    assert "mean over 1 tuning seed, 1,000 steps; one setting a point" in drawing.figure.get_suptitle().replace("\n", " ")


def test_a_single_critic_step_size_has_a_region_too(tmp_path):
    (axes, _) = panels(drawn(full_study(tmp_path, ["Pendulum-CA"], [1e-3])))
    heights = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == pytest.approx((1.1, 2.0), rel=1e-6)


def test_lines_differ_in_lightness_and_marker(tmp_path):
    lines = panels(drawn(full_study(tmp_path, ["Pendulum-CA"], STEP_SIZES)))[0].lines
    lightness = [sum(matplotlib.colors.to_rgb(line.get_color())) for line in lines]
    assert lightness == sorted(lightness)
    assert len({line.get_marker() for line in lines}) == len(lines)


def test_the_csv_holds_the_rows_of_the_view(tmp_path):
    store = build(tmp_path / "store")
    saved(store, None, tmp_path, ["csv"])
    expected = connect(store).execute("FROM sensitivity_lines ORDER BY agent, environment, entropy_scale, critic_step_size").df()
    written = pd.read_csv(tmp_path / "figure-7.1.csv", dtype={"setting": str})
    pd.testing.assert_frame_equal(written, expected, check_dtype=False, rtol=1e-12)


def test_the_same_data_give_the_same_bytes(tmp_path):
    store = full_study(tmp_path / "store", ["Pendulum-CA"], STEP_SIZES)
    first, second = (saved(store, None, tmp_path / name, ["png", "svg", "pdf", "csv"]) for name in "ab")
    assert [a.read_bytes() for a in first.files] == [b.read_bytes() for b in second.files]


def two_studies(path: Path, first: str, second: str) -> Path:
    """Two studies that need the same trials."""
    full_study(path, ["Pendulum-CA"], [1e-3], first)
    store = SyntheticStore(path)
    for tau in SCALES:
        store.plan(second, "SAC", "Pendulum-CA", 0, critic_step_size=1e-3, entropy_scale=tau)
    return store.write_studies()


def test_of_several_studies_with_data_one_must_be_named(tmp_path):
    store = two_studies(tmp_path / "store", "first", "second")
    with pytest.raises(UserError, match="choose with --study: first, second"):
        saved(store, None, tmp_path)
    assert saved(store, "second", tmp_path).study == "second"


def test_studies_that_do_not_sweep_the_entropy_scale_come_second(tmp_path):
    store = SyntheticStore(tmp_path / "store")
    for study, scales in (("all", SCALES), ("one", SCALES[:1])):
        for tau in scales:
            trial = store.plan(study, "SAC", "Pendulum-CA", 0, entropy_scale=tau)
            if study == "all":
                store.finish(trial, [1.0])
    assert saved(store.write_studies(), None, tmp_path, ["csv"]).study == "all"
    del store.members["all"][1:]
    with pytest.raises(UserError, match="choose with --study: all, one"):
        saved(store.write_studies(), None, tmp_path, ["csv"])


def test_the_figures_own_study_goes_before_others(tmp_path):
    assert saved(two_studies(tmp_path / "store", "first", "figure-7-1"), None, tmp_path).study == "figure-7-1"


def test_an_empty_store_has_no_figure(empty_store, tmp_path):
    with pytest.raises(UserError, match="no study yet"):
        saved(empty_store, None, tmp_path)


def test_a_study_without_any_trial_yet_is_drawn_only_by_name(tmp_path):
    store = SyntheticStore(tmp_path / "store")
    store.plan("demo", "SAC", "Pendulum-CA", 0)
    path = store.write_studies()
    with pytest.raises(UserError, match="no study has data for it yet"):
        saved(path, None, tmp_path)
    assert saved(path, "demo", tmp_path, ["png"]).notes[1:] == ["SAC on Pendulum-CA: 0 of 1 trials"]
