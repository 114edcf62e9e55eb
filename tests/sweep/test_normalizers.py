"""Normalizers against numbers worked out by hand, the thesis' among them."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.messages import UserError
from sweep.normalizers import NORMALIZERS, Normalizer, TuningRuns, UndefinedNormalizerError

finite = st.floats(-1e4, 1e4).map(lambda value: round(value, 3))


def normalizer(name, best_return=0.0, means=(), **run_scores):
    return Normalizer.from_runs(name, {"here": TuningRuns(best_return, means, run_scores)})


def test_the_worst_return_of_the_thesis_environments_is_at_its_printed_floor():
    # Table 6.1; Acrobot and Mountain Car cost −1 a step for 1,000 steps, Pendulum at most as much
    best = {"Acrobot-CA": -56, "MountainCar-CA": -65, "MountainCar-DA": -83, "Pendulum-CA": 930}
    thesis = Normalizer.from_constants("thesis", {name: {"best_return": value} for name, value in best.items()})
    floors = {name: round(thesis.normalize(name, [-1000.0])[0], 1) for name in best}
    assert floors == {"Acrobot-CA": -15.9, "MountainCar-CA": -13.4, "MountainCar-DA": -10.0, "Pendulum-CA": -1.1}
    assert thesis.normalize("Acrobot-CA", [-56.0]) == thesis.normalize("Pendulum-CA", [930.0]) == [1.0]


def test_half_of_a_positive_best_return_is_one_half_and_twice_a_negative_one_is_zero():
    assert normalizer("thesis", 930.0).normalize("here", [465.0]) == [0.5]
    assert normalizer("thesis", -50.0).normalize("here", [-100.0, -150.0]) == [0.0, -1.0]


def test_the_thesis_normalizer_is_undefined_where_the_best_return_is_zero():
    with pytest.raises(UserError) as error:
        normalizer("thesis", 0.0).normalize("here", [1.0])
    assert str(error.value) == (
        'here: normalizer "thesis" divides by |G*|, and G*, the highest return of an episode, is 0; '
        'choose "minmax", "percentile" or "cdf"'
    )


def test_minmax_puts_the_worst_setting_at_zero_and_the_best_at_one():
    assert normalizer("minmax", means=[30, -10, 10]).normalize("here", [-10, 10, 30, 50]) == [0, 0.5, 1, 1.5]


def test_the_percentiles_are_interpolated_between_neighbors():
    # of 0 … 100 the 5th and 95th percentiles are 5 and 95; of two values 0 and 10 they are 0.5 and 9.5
    assert normalizer("percentile", means=range(101)).normalize("here", [5, 50, 95, 100]) == pytest.approx([0, 0.5, 1, 95 / 90])
    assert normalizer("percentile", means=[10, 0]).normalize("here", [0, 5, 10]) == pytest.approx([-0.5 / 9, 0.5, 9.5 / 9])


def test_a_single_outlier_moves_minmax_and_hardly_the_percentiles():
    means = [*range(100), 10_000]
    assert normalizer("minmax", means=means).normalize("here", [90])[0] < 0.01
    assert normalizer("percentile", means=means).normalize("here", [90])[0] > 0.9


@pytest.mark.parametrize("name", ["minmax", "percentile"])
def test_a_normalizer_of_the_spread_is_undefined_where_all_settings_are_equal(name):
    with pytest.raises(UndefinedNormalizerError, match=r'here: normalizer ".*" divides by the spread .* are both -1000; choose'):
        normalizer(name, means=[-1000.0] * 30).normalize("here", [-1000.0])


def test_the_cdf_counts_runs_strictly_below_and_every_agent_the_same():
    cdf = normalizer("cdf", large=[4, 2, 3, 1], small=[2])
    # below 1: none of either; below 2: 1 of 4 and 0 of 1; below 2.5: 2 of 4 and 1 of 1; below 9: all
    assert cdf.normalize("here", [1, 2, 2.5, 9]) == [0, 0.125, 0.75, 1]


@settings(deadline=None)
@given(st.dictionaries(st.sampled_from("abc"), st.lists(st.integers(-5, 5), min_size=1), min_size=1), st.integers(-6, 6))
def test_the_cdf_is_the_mean_share_counted_one_by_one(runs, score):
    shares = [sum(run < score for run in scores) / len(scores) for scores in runs.values()]
    assert normalizer("cdf", **runs).normalize("here", [score])[0] == pytest.approx(sum(shares) / len(shares))


@settings(deadline=None)
@given(st.data(), st.sampled_from(sorted(NORMALIZERS)), st.lists(finite, min_size=2, unique=True), st.lists(finite, min_size=2))
def test_no_normalizer_reverses_an_order(data, name, means, scores):
    known = normalizer(name, data.draw(finite.filter(lambda best: abs(best) > 1e-3)), means, agent=means)
    try:
        values = known.normalize("here", sorted(scores))
    except UndefinedNormalizerError:
        return  # two means so near that their percentiles are equal
    assert values == sorted(values)


@pytest.mark.parametrize("name", NORMALIZERS)
def test_a_normalizer_is_rebuilt_from_its_constants_in_json(name):
    known = normalizer(name, -56.3, [-100.1, -80.7, -60.123456789], GreedyAC=[-90.0, -70.1], SAC=[-80.2])
    again = Normalizer.from_constants(name, json.loads(json.dumps(known.constants())))
    scores = [-500.0, -80.7, -75.123, 0.0]
    assert again.normalize("here", scores) == known.normalize("here", scores)
    assert again.constants() == known.constants()


@pytest.mark.parametrize("name", NORMALIZERS)
def test_the_order_of_runs_and_agents_makes_no_difference(name):
    one = normalizer(name, 5.0, [1.0, 2.0, 4.0], a=[1.0, 2.0], b=[4.0])
    other = normalizer(name, 5.0, [4.0, 1.0, 2.0], b=[4.0], a=[2.0, 1.0])
    assert json.dumps(one.constants()) == json.dumps(other.constants())


def test_an_unknown_normalizer_is_named_with_the_nearest():
    with pytest.raises(UserError) as error:
        Normalizer.from_constants("percentiles", {})
    assert str(error.value) == (
        'unknown normalizer "percentiles"; did you mean "percentile"? Known: cdf, minmax, percentile, thesis'
    )


def test_constants_of_another_normalizer_are_refused():
    with pytest.raises(ValueError, match="here: constants of minmax are low, high"):
        Normalizer.from_constants("minmax", {"here": {"best_return": 1.0}})
