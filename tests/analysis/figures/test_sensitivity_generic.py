"""Sensitivity regions of any two hyperparameters: axes, values of every kind, and what is said of widths."""

import itertools
import re

import numpy as np
import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures import sensitivity_region
from analysis.figures.options import NoDataError, Options
from sweep.messages import UserError

RATES = (0.1, 0.01)


def study(path, x, over, mean, seeds=2, luck=10, agent="SAC", missing=()):
    """`x`, `over`: (name, values); `mean(x, over)` is the score of seed 0, and `luck` more of each further seed."""
    store = SyntheticStore(path / "store")
    for a, b in itertools.product(x[1], over[1]):
        for seed in range(seeds):
            trial = store.plan("demo", agent, "Pendulum-CA", seed, **{x[0]: a, over[0]: b})
            if (a, b, seed) not in missing:
                store.finish(trial, [float(mean(a, b) + luck * seed)])
    return store.write_studies()


def draw(store, x=None, over=None, study="demo", **options):
    return sensitivity_region.draw(connect(store), study, Options(title="Title", x=x, over=over, **options))


def only(drawing):
    (axes,) = drawing.figure.axes
    return axes


def test_axes_and_legend_name_the_hyperparameters(tmp_path):
    store = study(tmp_path, ("polyak", (0.01, 0.1, 1.0)), ("batch_size", (16, 32)), lambda a, b: a + b)
    drawing = draw(store, "polyak", "batch_size")
    assert only(drawing).get_xlabel() == "Polyak averaging weight"
    assert only(drawing).get_xscale() == "log"
    (legend,) = drawing.figure.legends
    assert legend.get_title().get_text() == "Batch size"
    assert [text.get_text() for text in legend.get_texts()] == ["16", "32", "region"]
    assert [list(line.get_ydata()) for line in only(drawing).lines] == [
        pytest.approx([a + b + 5 for a in (0.01, 0.1, 1)]) for b in (16, 32)
    ]


@pytest.mark.parametrize(
    ("over", "values", "labels"),
    [
        ("entropy_tuning", ("fixed", "automatic"), ["automatic", "fixed"]),
        ("hidden_layers", ((8,), (16, 16)), ["[16, 16]", "[8]"]),
    ],
)
def test_lines_may_be_texts_and_lists(over, values, labels, tmp_path):
    store = study(tmp_path, ("critic_step_size", RATES), (over, values), lambda a, b: len(b))
    drawing = draw(store, "critic_step_size", over)
    assert [line.get_label() for line in only(drawing).lines] == labels
    assert any("mean width in" in note for note in drawing.notes)


def test_texts_are_no_axis(tmp_path):
    store = study(tmp_path, ("critic_step_size", RATES), ("entropy_tuning", ("fixed", "automatic")), lambda a, b: a)
    with pytest.raises(UserError, match="--x entropy_tuning: an axis needs numbers; exchange it with --over critic_step_size"):
        draw(store, "entropy_tuning", "critic_step_size")


def test_zero_has_a_place_of_its_own_beside_a_log_axis(tmp_path):
    values = (0.0, 0.01, 0.1, 1.0)
    axes = only(
        draw(
            study(tmp_path, ("entropy_scale", values), ("critic_step_size", RATES), lambda a, b: a + b),
            "entropy_scale",
            "critic_step_size",
        )
    )
    assert axes.get_xscale() == "symlog"
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0", "$10^{-2}$", "$10^{-1}$", "$10^{0}$"]
    places = axes.transData.transform([(value, 0) for value in values])[:, 0]
    gaps = np.diff(places) / (axes.bbox.x1 - axes.bbox.x0)
    assert (gaps > 0.1).all()
    assert axes.get_xlim()[0] < 0


def test_evenly_spaced_values_have_a_linear_axis(tmp_path):
    axes = only(
        draw(
            study(tmp_path, ("batch_size", (16, 32, 48)), ("critic_step_size", RATES), lambda a, b: a + b),
            "batch_size",
            "critic_step_size",
        )
    )
    assert axes.get_xscale() == "linear"
    assert [label.get_text() for label in axes.get_xticklabels()] == ["16", "32", "48"]


def test_the_region_follows_straight_lines_on_a_linear_axis(tmp_path):
    """At 24, between crossing lines (0 → 2 and 1 → 1), the lowest is 1 and the highest 1."""
    mean = {(16, 0.1): 0, (32, 0.1): 2, (16, 0.01): 1, (32, 0.01): 1}
    axes = only(
        draw(
            study(tmp_path, ("batch_size", (16, 32)), ("critic_step_size", RATES), lambda a, b: mean[a, b], luck=0),
            "batch_size",
            "critic_step_size",
        )
    )
    corners = axes.collections[0].get_paths()[0].vertices
    near = corners[np.abs(corners[:, 0] - 24) < 0.2]
    assert np.abs(near[:, 1] - 1).max() < 0.05
    assert corners[:, 1].min() == pytest.approx(0)


def test_many_lines_and_values_stay_apart(tmp_path):
    rates = tuple(10.0**-power for power in range(12))
    drawing = draw(
        study(tmp_path, ("critic_step_size", rates), ("entropy_scale", rates), lambda a, b: a + b),
        "critic_step_size",
        "entropy_scale",
    )
    looks = {
        (line.get_marker(), str(line.get_linestyle()), line._dash_pattern[1] and tuple(line._dash_pattern[1]))
        for line in only(drawing).lines
    }
    assert len(looks) == 12
    drawing.figure.draw_without_rendering()
    boxes = [label.get_window_extent() for label in only(drawing).get_xticklabels() if label.get_text()]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_one_line_is_no_region(tmp_path):
    drawing = draw(
        study(tmp_path, ("critic_step_size", RATES), ("entropy_scale", (1.0,)), lambda a, b: a),
        "critic_step_size",
        "entropy_scale",
    )
    assert not only(drawing).collections
    assert [text.get_text() for text in drawing.figure.legends[0].get_texts()] == ["1"]
    assert "SAC on Pendulum-CA: best mean 5.1; no region: one line at most at each critic step-size" in drawing.notes


def test_a_width_without_noise_is_certain(tmp_path):
    """Lines 3 apart at one step-size and 5 at the other; seeds are better for all alike."""
    mean = {(0.1, 1.0): 100, (0.1, 10.0): 103, (0.01, 1.0): 200, (0.01, 10.0): 195}
    drawing = draw(study(tmp_path, ("critic_step_size", RATES), ("entropy_scale", (1.0, 10.0)), lambda a, b: mean[a, b]))
    assert "SAC on Pendulum-CA: best mean 205; region 4 wide on average, 5 at most" in drawing.notes
    (said,) = [note for note in drawing.notes if "mean width in" in note]
    # levels: mean of all lines is 149.5, and 5 more with luck; resamples have 0, 5 or 10 of it
    assert said.startswith("SAC on Pendulum-CA: mean width in [4, 4], 4 without the bias of noise; noise alone gives 0; p = ")
    assert said.endswith("mean level of the lines 154.5 in [149.5, 159.5]")
    assert drawing.notes[-1].startswith("intervals: 95 %, percentile bootstrap of the tuning seeds, 1,000 resamples")


@pytest.mark.parametrize(("seeds", "expected"), [(2, True), (5, False)])
def test_widths_of_few_seeds_carry_a_caution(seeds, expected, tmp_path):
    values = ("critic_step_size", RATES), ("entropy_scale", (1.0, 10.0))
    notes = draw(study(tmp_path, *values, lambda a, b: a + b, seeds=seeds)).notes
    assert (f"{seeds} tuning seeds: intervals and widths without the bias of noise say little" in notes) == expected


def test_lines_without_an_effect_are_no_wider_than_noise(tmp_path):
    rng = np.random.default_rng(1)
    store = SyntheticStore(tmp_path / "store")
    for a, b, seed in itertools.product((0.1, 0.01, 0.001), (0.1, 1.0, 10.0), range(20)):
        store.finish(store.plan("demo", "SAC", "Pendulum-CA", seed, critic_step_size=a, entropy_scale=b), [50 + rng.normal()])
    (said,) = [note for note in draw(store.write_studies()).notes if "mean width in" in note]
    floor, p = (float(re.search(pattern, said)[1]) for pattern in (r"noise alone gives ([\d.]+)", r"p = ([\d.]+)"))
    assert floor == pytest.approx(1.693 / np.sqrt(20), rel=0.25)  # the expected range of three normal numbers
    assert p > 0.05


def test_narrow_because_everything_failed_is_warned_of(tmp_path):
    store = SyntheticStore(tmp_path / "store")
    for agent, (a, b), seed in itertools.product(("GreedyAC", "SAC"), itertools.product(RATES, (1.0, 10.0)), (0, 1)):
        trial = store.plan("demo", agent, "Pendulum-CA", seed, critic_step_size=a, entropy_scale=b)
        store.finish(trial, [-999.0 + b / 10 + seed if agent == "SAC" else 800.0 + b])
    notes = draw(store.write_studies()).notes
    (warning,) = [note for note in notes if "warning" in note]
    assert warning.startswith("SAC on Pendulum-CA: warning: the lines lie near the worst return (-998.9; the best is 810)")
    assert "everything failed, not that entropy_scale does not matter" in warning


def test_runs_that_all_diverged_are_no_insensitivity(tmp_path):
    store = SyntheticStore(tmp_path / "store")
    for a, b, seed in itertools.product(RATES, (1.0, 10.0), (0, 1)):
        store.finish(store.plan("demo", "SAC", "Pendulum-CA", seed, critic_step_size=a, entropy_scale=b), [-5.0, np.nan])
    notes = draw(store.write_studies()).notes
    assert "SAC on Pendulum-CA: 8 diverged, counted as the worst return of the environment" in notes
    assert any(
        "warning: every episode returned -5: a region without width says nothing of entropy_scale" in note for note in notes
    )


def test_one_seed_has_no_interval_of_the_width(tmp_path):
    notes = draw(study(tmp_path, ("critic_step_size", RATES), ("entropy_scale", (1.0, 10.0)), lambda a, b: a + b, seeds=1)).notes
    assert any(
        "no interval of the width: a region's interval needs at least 2 runs, and there is 1 run" in note for note in notes
    )
    assert not any(note.startswith("intervals:") for note in notes)


def test_missing_runs_have_no_interval_of_the_width(tmp_path):
    store = study(
        tmp_path, ("critic_step_size", RATES), ("entropy_scale", (1.0, 10.0)), lambda a, b: a + b, missing=[(0.1, 1.0, 0)]
    )
    assert any(
        "no interval of the width: a region needs a score of every run: 1 of 4 settings" in note for note in draw(store).notes
    )


def test_the_sql_gives_the_data_of_the_panels_asked_for(tmp_path):
    store = SyntheticStore(tmp_path / "store")
    for agent, place, a, b in itertools.product(("GreedyAC", "SAC"), ("Acrobot-CA", "Pendulum-CA"), RATES, (1.0, 10.0)):
        store.finish(store.plan("demo", agent, place, 0, critic_step_size=a, entropy_scale=b), [a + b])
    path = store.write_studies()
    drawing = draw(path, agents=("SAC",), environments=("Pend*",))
    rows = connect(path).execute(drawing.sql).df()
    assert rows.to_dict("list") == drawing.data.to_dict("list")
    assert set(rows["agent"]) == {"SAC"} and set(rows["environment"]) == {"Pendulum-CA"}
    assert len(drawing.figure.axes) == 1


def test_the_axis_names_the_score(tmp_path):
    store = study(tmp_path, ("critic_step_size", RATES), ("entropy_scale", (1.0, 10.0)), lambda a, b: a + b)
    assert draw(store).figure.get_supylabel() == "Average episodic return"
    assert draw(store, score="final_mean").figure.get_supylabel() == "Episodic return, last tenth of steps"


def test_what_was_asked_for_and_is_not_there_is_named(tmp_path):
    store = study(tmp_path, ("critic_step_size", RATES), ("entropy_scale", (1.0, 10.0)), lambda a, b: a + b)
    with pytest.raises(NoDataError, match=r'study "demo" has no tuning trial with both .* \(of GreedyAC\)'):
        draw(store, agents=("GreedyAC",))


def test_a_real_study_is_drawn_both_ways(real_store, tmp_path):
    for x, over in (("critic_step_size", "entropy_scale"), ("entropy_scale", "critic_step_size")):
        drawing = draw(real_store, x, over, "figure-7-1")
        drawing.save(tmp_path / "figure.png", "png")
        values = connect(real_store).execute(f"SELECT COUNT(DISTINCT {over}) FROM members WHERE study = 'figure-7-1'").fetchone()
        assert {len(axes.lines) for axes in drawing.figure.axes} == {values[0]}


def test_a_diverged_run_is_left_out_by_a_study_that_drops_it(tmp_path):
    store = SyntheticStore(tmp_path)
    for x, tau, seed in itertools.product((0.1, 0.01), (1.0, 10.0), (0, 1)):
        member = store.plan("study", "SAC", "Pendulum-CA", seed, critic_step_size=x, entropy_scale=tau)
        store.finish(member, [float("nan") if (x, tau, seed) == (0.1, 1.0, 1) else 10 * tau + seed])
    path = store.write_studies()
    (path / "studies" / "study" / "grid.toml").write_text('[select]\ndiverged = "drop"\n')
    drawing = sensitivity_region.draw(connect(path), "study", Options())
    rows = drawing.data.set_index(["critic_step_size", "entropy_scale"])
    assert (rows.loc[(0.1, 1.0), "best_mean"], rows.loc[(0.1, 1.0), "num_seeds"]) == (10, 1)
    assert rows.loc[(0.01, 1.0), "best_mean"] == 10.5
    assert "SAC on Pendulum-CA: 1 diverged, left out" in drawing.notes
