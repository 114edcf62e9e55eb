"""Importance as bars: lengths, places and intervals are those of the table, and empty panels say why."""

import numpy as np
import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures import importance
from analysis.figures.options import NoDataError, Options

ADDITIVE = {(0.1, 1.0): 7.0, (0.1, 0.1): -1.0, (0.01, 1.0): 1.0, (0.01, 0.1): -7.0}
"""Effects ±3 of the step-size and ±4 of the entropy scale: shares 0.36 and 0.64."""


def study(path, panels, seeds=2):
    """`panels`: (agent, environment) → scores by (critic step-size, entropy scale); None where a run is missing."""
    store = SyntheticStore(path / "store")
    for (agent, environment), scores in panels.items():
        for (step_size, scale), mean in scores.items():
            for seed in range(seeds):
                trial = store.plan("demo", agent, environment, seed, critic_step_size=step_size, entropy_scale=scale)
                if mean is not None:
                    store.finish(trial, [mean + 10 * seed])
    return store.write_studies()


def draw(store, study="demo"):
    return importance.draw(connect(store), study, Options(title="Title"))


def texts(axes):
    return [text.get_text() for text in axes.texts]


def test_bars_have_the_lengths_of_the_shares(tmp_path):
    (axes,) = draw(study(tmp_path, {("SAC", "Pendulum-CA"): ADDITIVE})).figure.axes
    assert [bar.get_width() for bar in axes.patches] == pytest.approx([0.64, 0.36, 0], abs=1e-9)
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["Entropy scale τ", "Critic step-size", "Critic step-size ×\nEntropy scale τ"]
    assert [bar.get_y() + bar.get_height() / 2 for bar in axes.patches] == pytest.approx([0, 1, 2])
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # the first on top


def test_pairs_are_hatched_and_the_legend_says_so(tmp_path):
    drawing = draw(study(tmp_path, {("SAC", "Pendulum-CA"): ADDITIVE}))
    assert [bar.get_hatch() for bar in drawing.figure.axes[0].patches] == [None, None, "////"]
    (legend,) = drawing.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["one hyperparameter", "a pair, beyond both"]


def test_intervals_are_those_of_the_data(tmp_path):
    store = SyntheticStore(tmp_path / "store")
    rng = np.random.default_rng(0)
    for (step_size, scale), mean in ADDITIVE.items():
        for seed in range(5):
            trial = store.plan("demo", "SAC", "Pendulum-CA", seed, critic_step_size=step_size, entropy_scale=scale)
            store.finish(trial, [mean + rng.normal()])
    drawing = draw(store.write_studies())
    (axes,) = drawing.figure.axes
    drawn = [tuple(line.get_xdata()) for line in axes.lines if line.get_marker() == "|"]
    assert drawn == list(zip(drawing.data["share_low"], drawing.data["share_high"], strict=True))
    assert all(low < high for low, high in drawn)
    assert [bar.get_width() for bar in axes.patches] == drawing.data["share"].tolist()


def test_a_row_an_agent_and_a_column_an_environment_and_what_is_missing_is_said(tmp_path):
    hole = {place: mean for place, mean in ADDITIVE.items() if place != (0.01, 0.1)}
    lacking = {**ADDITIVE, (0.1, 1.0): None}
    panels = {
        ("GreedyAC", "Acrobot-CA"): hole,
        ("GreedyAC", "Pendulum-CA"): ADDITIVE,
        ("SAC", "Acrobot-CA"): lacking,
        ("SAC", "MountainCar-CA"): dict.fromkeys(ADDITIVE, -100.0),
    }
    drawing = draw(study(tmp_path, panels))
    first, second = np.array(drawing.figure.axes).reshape(2, 3)
    assert [axes.get_ylabel() for axes in (first[0], second[0])] == ["GreedyAC", "SAC"]
    assert [texts(axes)[-1] for axes in first] == ["Acrobot-CA", "MountainCar-CA", "Pendulum-CA"]
    assert [texts(first[0])[0], texts(first[1])[0]] == ["not a full grid", "not in this study"]
    assert [texts(axes) for axes in second] == [["runs are missing"], ["no more than noise"], ["not in this study"]]
    assert len(first[2].patches) == 3
    assert any("critic_step_size = 0.1, entropy_scale = 1.0" in note for note in drawing.notes)


def test_nothing_to_show_is_refused_with_the_reasons(tmp_path):
    with pytest.raises(NoDataError, match=r"SAC on Pendulum-CA: .*at least 2 runs"):
        draw(study(tmp_path, {("SAC", "Pendulum-CA"): ADDITIVE}, seeds=1))


def test_many_pairs_share_a_bar(tmp_path):
    store = SyntheticStore(tmp_path / "store")
    names = ("critic_step_size", "actor_step_size_scale", "entropy_scale", "polyak", "exploration_scale")
    rng = np.random.default_rng(0)
    for code in range(2**5):
        hypers = {name: (0.1, 0.01)[code >> bit & 1] for bit, name in enumerate(names)}
        mean = rng.normal()
        for seed in range(2):
            store.finish(store.plan("demo", "SAC", "Pendulum-CA", seed, **hypers), [mean + seed])
    drawing = draw(store.write_studies())
    (axes,) = drawing.figure.axes
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels[-2:] == ["Other pairs", "Higher interactions"]
    assert len(labels) == 5 + 6 + 2
    pairs = drawing.data[drawing.data["order"] == 2]["share"]
    assert axes.patches[-1].get_width() == pytest.approx(pairs.sort_values().iloc[:4].sum())


def test_a_real_study_is_drawn(real_store, tmp_path):
    drawing = draw(real_store, "chapter-6")
    drawing.save(tmp_path / "figure.png", "png")
    count = "SELECT COUNT(DISTINCT agent) * COUNT(DISTINCT environment) FROM members WHERE study = 'chapter-6'"
    assert (len(drawing.figure.axes),) == connect(real_store).execute(count).fetchone()
    assert "tuning seeds" in drawing.figure.get_suptitle()
