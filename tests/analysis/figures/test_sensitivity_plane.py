"""The plane of performance and sensitivity: points and crosses are those worked out by hand."""

import pytest
from matplotlib.colors import to_hex
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures import sensitivity_plane
from analysis.figures.options import NoDataError, Options
from sweep.messages import UserError

STEP_SIZES = (0.1, 0.01, 0.001)
MEANS = {
    ("GreedyAC", "Pendulum-CA"): (0, 50, 100),
    ("GreedyAC", "MountainCar-CA"): (-10, -30, -110),
    ("SAC", "Pendulum-CA"): (20, 40, 60),
    ("SAC", "MountainCar-CA"): (-60, -60, -10),
}
"""Min–max: GreedyAC (0, 0.5, 1) and (1, 0.8, 0), so Φ = 1 − 0.65; SAC (0.2, 0.4, 0.6) and (0.5, 0.5, 1), so Φ = 0."""


def study(path, agents=("GreedyAC", "SAC"), luck=(-5, 5)):
    """Mean scores by critic step-size; on Pendulum seed s is `luck[s]` better for all."""
    store = SyntheticStore(path / "store")
    for (agent, environment), means in MEANS.items():
        for step_size, mean in zip(STEP_SIZES, means, strict=True):
            for seed, shift in enumerate(luck):
                if agent in agents:
                    trial = store.plan("demo", agent, environment, seed, critic_step_size=step_size)
                    store.finish(trial, [float(mean + (shift if environment == "Pendulum-CA" else 0))])
    return store.write_studies()


def draw(store, study="demo", **options):
    return sensitivity_plane.draw(connect(store), study, Options(title="Title", **options))


def lines(drawing, label=None):
    """Return coordinates of the lines, of those with a label if one is given."""
    (axes,) = drawing.figure.axes
    return [
        (list(map(float, line.get_xdata())), list(map(float, line.get_ydata())))
        for line in axes.lines
        if label is None or line.get_label() == label
    ]


def test_points_are_where_they_were_worked_out(tmp_path):
    drawing = draw(study(tmp_path), normalizer="minmax")
    assert lines(drawing, "GreedyAC")[0] == (pytest.approx([0.35]), pytest.approx([1.0]))
    assert lines(drawing, "SAC")[0] == (pytest.approx([0.0], abs=1e-12), pytest.approx([0.8]))


def test_crosses_are_the_intervals(tmp_path):
    across, up = lines(draw(study(tmp_path), normalizer="minmax"))[:2]
    assert across == (pytest.approx([0.35, 0.35]), pytest.approx([1, 1]))  # luck that all settings share
    assert up == (pytest.approx([0.35, 0.35]), pytest.approx([0.975, 1.025]))  # ±5 of 100 on one of two environments


def test_lines_through_the_reference_part_the_plane(tmp_path):
    drawing = draw(study(tmp_path), normalizer="minmax")
    (axes,) = drawing.figure.axes
    level, slope = lines(drawing)[-2:]
    assert level[1] == pytest.approx([0.8, 0.8])
    assert [y - x for x, y in zip(*slope, strict=True)] == pytest.approx([0.8, 0.8])
    assert [text.get_text() for text in axes.texts] == ["better than SAC either way", "worse than SAC either way"]
    assert drawing.data.set_index("agent")["region"].to_dict() == {
        "GreedyAC": "better only tuned to each environment",
        "SAC": "reference",
    }


def test_the_reference_is_the_first_agent_where_sac_is_not_there(tmp_path):
    assert "regions are relative to GreedyAC" in draw(study(tmp_path, agents=("GreedyAC",))).notes


def test_one_agent_has_no_lines_to_compare_with(tmp_path):
    drawing = draw(study(tmp_path, agents=("GreedyAC",)), normalizer="minmax")
    assert len(lines(drawing)) == 3
    (legend,) = drawing.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["GreedyAC"]


def test_agents_differ_in_color_and_marker(tmp_path):
    (axes,) = draw(study(tmp_path)).figure.axes
    points = [line for line in axes.lines if line.get_label() in ("GreedyAC", "SAC")]
    assert len({line.get_marker() for line in points}) == len({to_hex(line.get_color()) for line in points}) == 2


def test_the_title_says_n_steps_interval_stage_and_normalizer(tmp_path):
    title = draw(study(tmp_path)).figure.get_suptitle().replace("\n", " ")
    for words in ("2 tuning seeds", "1,000 steps", "95 % bootstrap intervals", "percentile normalizer"):
        assert words in title


def test_the_thesis_normalizer_is_refused_with_the_reason(tmp_path):
    with pytest.raises(UserError, match=r"no lower end.*Choose one of"):
        draw(study(tmp_path), normalizer="thesis")


def test_one_seed_has_no_intervals_and_no_figure(tmp_path):
    with pytest.raises(NoDataError, match="needs at least two tuning seeds"):
        draw(study(tmp_path, luck=(0,)))


def test_a_real_study_is_drawn_with_its_evaluation(real_store, tmp_path):
    drawing = draw(real_store, "chapter-6", normalizer="cdf")
    drawing.save(tmp_path / "figure.png", "png")
    assert drawing.data["agent"].tolist() == ["GreedyAC", "SAC", "VanillaAC"]
    assert drawing.data["evaluated_sensitivity"].notna().all()
    assert sum("on 4 evaluation seeds" in note for note in drawing.notes) == 3
