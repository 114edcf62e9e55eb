"""Corrections of p-values: small tables by hand, and what each promises."""

import numpy as np
import pytest

from analysis.statistics.corrections import CORRECTIONS, correct
from sweep.messages import UserError


def test_holm_multiplies_the_smallest_by_all_and_each_next_by_one_less():
    # sorted 0.01 0.02 0.03 0.4 → 0.04 0.06 0.06 0.4: none below a smaller one
    assert correct([0.03, 0.01, 0.4, 0.02]) == pytest.approx([0.06, 0.04, 0.4, 0.06])
    assert correct([0.01, 0.013, 0.014, 0.19, 0.35]) == pytest.approx([0.05, 0.052, 0.052, 0.38, 0.38])


def test_benjamini_and_hochberg_multiply_by_the_number_over_the_rank():
    # sorted 0.01 0.02 0.03 0.4 → ×4, ×2, ×4/3, ×1 = 0.04 0.04 0.04 0.4
    assert correct([0.03, 0.01, 0.4, 0.02], "benjamini_hochberg") == pytest.approx([0.04, 0.04, 0.4, 0.04])
    # the fifteen p-values of Benjamini and Hochberg (1995): four are findings at 5 %, Holm finds three
    printed = [
        0.0001,
        0.0004,
        0.0019,
        0.0095,
        0.0201,
        0.0278,
        0.0298,
        0.0344,
        0.0459,
        0.3240,
        0.4262,
        0.5719,
        0.6528,
        0.7590,
        1.0,
    ]
    assert np.count_nonzero(correct(printed, "benjamini_hochberg") <= 0.05) == 4
    assert np.count_nonzero(correct(printed, "holm") <= 0.05) == 3


@pytest.mark.parametrize("method", CORRECTIONS)
def test_corrected_values_keep_their_order_and_their_range(method):
    given = np.random.default_rng(0).random(40) ** 2
    adjusted = correct(given, method)
    assert np.all(adjusted >= given) and np.all(adjusted <= 1)
    assert np.all(np.diff(adjusted[np.argsort(given)]) >= 0)
    assert correct([0.3], method) == [0.3]
    assert len(correct([], method)) == 0


@pytest.mark.parametrize("given", [[0.1, -0.1], [1.1], [0.2, np.nan]])
def test_what_is_no_p_value_is_refused(given):
    with pytest.raises(UserError, match="p-values"):
        correct(given)


def test_an_unknown_correction_is_answered_with_the_nearest():
    with pytest.raises(UserError, match=r'unknown correction "hulm"; did you mean "holm"\?'):
        correct([0.1], "hulm")
