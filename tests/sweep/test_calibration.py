import json
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.hypers import SACHypers
from sweep.calibration import Calibration, memory_budget, nominal
from sweep.trials import Trial

MB = 2**20
MEASURED = Calibration({16: 3_200.0, 32: 4_000.0, 64: 4_600.0, 128: 4_700.0}, 300 * MB, MB // 2, 48, 60 * MB, 3.0)


def trial(steps=100_000, capacity=100_000):
    return Trial("SAC", "Pendulum-CA", SACHypers(replay_capacity=capacity), 0, steps, 1_000, 0.99)


def test_the_smallest_population_within_one_per_cent_of_the_fastest_is_the_best():
    assert MEASURED.best_population == 128  # 4,600 < 0.99 × 4,700 = 4,653
    assert replace(MEASURED, rates={16: 3_200.0, 64: 4_660.0, 128: 4_700.0}).best_population == 64
    assert replace(MEASURED, rates={16: 4_700.0, 64: 4_700.0, 128: 3_000.0}).best_population == 16


def test_between_sizes_the_time_of_a_lock_step_is_linear():
    assert MEASURED.rate(16) == pytest.approx(3_200)
    assert MEASURED.rate(64) == pytest.approx(4_600)
    assert MEASURED.rate(24) == pytest.approx(24 / ((5e-3 + 8e-3) / 2))  # 16 agents take 5 ms, 32 take 8
    assert MEASURED.rate(8) == pytest.approx(8 / 3.5e-3)
    assert MEASURED.rate(500) == 4_700
    assert MEASURED.rate(1) == pytest.approx(MEASURED.rate(2) / 2)  # trained with a copy beside it


@given(st.dictionaries(st.integers(1, 300), st.floats(1, 1e6), min_size=1), st.integers(1, 400))
def test_no_rate_is_beyond_those_measured_nor_zero(rates, population):
    rate = Calibration(rates, 0, 0, 0).rate(population)
    assert 0 < rate <= max(rates.values()) * 1.0001


def test_the_peak_is_what_training_takes_or_what_committing_takes_when_the_replay_is_freed():
    replay = 64 * 100_000 * 48
    first = MEASURED.peak_bytes(trial(), 64, again=False)
    assert 300 * MB + 64 * MB // 2 + replay < first < 300 * MB + 64 * MB // 2 + replay + 64 * 120_000
    assert MEASURED.peak_bytes(trial(), 64, again=True) == first + 60 * MB
    assert MEASURED.peak_bytes(trial(steps=10), 16, again=False) == 360 * MB
    assert MEASURED.peak_bytes(trial(steps=10**6), 64) - MEASURED.peak_bytes(trial(), 64) < 64 * 150 * 1000  # records only
    assert MEASURED.peak_bytes(trial(capacity=1_000), 64) < MEASURED.peak_bytes(trial(), 64) - 0.98 * replay


@given(st.integers(1, 2**36), st.integers(1, 10**6))
def test_the_largest_population_within_a_budget_fits_and_the_next_does_not(budget, steps):
    population = MEASURED.largest_within(trial(steps), budget)
    assert population == 1 or MEASURED.peak_bytes(trial(steps), population) <= budget
    assert MEASURED.peak_bytes(trial(steps), max(2, population + 1)) > budget


def test_populations_are_as_large_as_is_fast_and_fits():
    assert MEASURED.size([trial()], None).population == 128
    assert MEASURED.size([trial()], 2**40) == MEASURED.size([trial()], None)
    cramped = MEASURED.size([trial(), trial(10)], 680 * MB)
    assert 50 < cramped.population < 64
    assert cramped.agent_steps_per_second == MEASURED.rate(cramped.population)
    assert MEASURED.size([trial()], 1).population == 1


def test_workers_on_one_machine_share_four_fifths_of_what_is_available():
    assert memory_budget(10_000, 4) == 2_000
    assert memory_budget(None, 4) is None


def test_a_calibration_comes_back_from_json_as_it_was():
    assert Calibration.from_json(json.loads(json.dumps(MEASURED.to_json()))) == MEASURED


@pytest.mark.parametrize(
    "spoiled",
    [
        {},
        [],
        None,
        {"rates": {}},
        {**MEASURED.to_json(), "rates": {"64": 0}},
        {**MEASURED.to_json(), "rates": {"64": math.nan}},
        {**MEASURED.to_json(), "rates": {"many": 5}},
        {**MEASURED.to_json(), "rates": [64]},
        {**MEASURED.to_json(), "base_bytes": -1},
        {**MEASURED.to_json(), "base_bytes": None},
    ],
)
def test_what_is_not_a_calibration_is_not_taken_for_one(spoiled):
    with pytest.raises((ValueError, TypeError, KeyError, AttributeError)):
        Calibration.from_json(spoiled)


def test_without_a_measurement_populations_of_64_and_a_round_rate_are_taken():
    assert (nominal("SAC", 48).best_population, nominal("SAC", 48).rate(10)) == (64, 4_000)
    assert nominal("SAC", 48).peak_bytes(trial(), 64) > 64 * 100_000 * 48
