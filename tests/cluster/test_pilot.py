"""The pilot itself: real training, cut short."""

import dataclasses
import time

import pytest

from agents.algorithms.sac import SAC
from agents.hypers import SACHypers
from cluster.pilot import Pilot, footprint, run_pilot


def pilot(population, environment="Pendulum-CA", **hypers):
    known = SACHypers(**{"hidden_layers": (8,), "batch_size": 5, **hypers})
    return Pilot("SAC", environment, known, 1000, 0.99, population)


@pytest.fixture
def learning(monkeypatch):
    """Make every update of SAC take as long as the test says, and count the updates."""
    update, seconds, counted = SAC.update, [0.0], []

    def delayed(self, batch, step):
        counted.append(step)
        time.sleep(seconds[0])
        return update(self, batch, step)

    monkeypatch.setattr(SAC, "update", delayed)
    return seconds, counted


def test_a_rate_counts_every_agent_of_the_population_and_the_time_of_its_updates(learning):
    seconds, counted = learning
    seconds[0] = 0.02
    reading = run_pilot(pilot(30))
    assert 30 / 0.2 < reading.agent_steps_per_second < 30 / 0.02
    assert counted[0] == 5  # the first update is at step batch_size


def test_a_pilot_stops_by_itself_long_before_a_trial_would_end(learning):
    seconds, counted = learning
    seconds[0] = 0.02
    run_pilot(pilot(2))
    assert 7 <= len(counted) < 50


def test_a_population_that_is_too_slow_to_be_measured_has_no_rate(learning, monkeypatch):
    learning[0][0] = 0.05
    monkeypatch.setattr("cluster.pilot._PATIENCE_SECONDS", 0.1)
    assert run_pilot(pilot(2)).agent_steps_per_second is None


def test_what_the_agents_code_raises_is_raised(monkeypatch):
    monkeypatch.setattr(SAC, "update", lambda *arguments: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_pilot(pilot(2))


def test_only_the_replay_is_smaller_than_in_training_and_the_reading_says_how_large_it_was(monkeypatch):
    trained = []
    monkeypatch.setattr("agents.training.train", lambda *arguments, **options: trained.append((*arguments[2:], options)))
    tried = pilot(3, entropy_scale=0.5)
    reading = run_pilot(tried)
    ((hypers, seeds, options),) = trained
    assert reading.replay_rows == 5
    assert {dataclasses.replace(one, replay_capacity=100_000) for one in hypers} == {tried.hypers}
    assert {one.replay_capacity for one in hypers} == {5}
    assert (seeds, options["cutoff"], options["discount"]) == ([0, 1, 2], 1000, 0.99)


def test_the_memory_read_off_grows_with_the_agents_networks():
    run_pilot(pilot(16, hidden_layers=(256, 256)))  # loads whatever only the first training in a process loads

    def added(population, **hypers):
        reading = run_pilot(pilot(population, **hypers))
        return reading.peak_bytes - reading.base_bytes

    narrow, wide = added(64), added(64, hidden_layers=(256, 256))
    weights = 256 * 256 * 4  # of the largest layer of one network, in bytes; there are six networks, most with two moments
    assert wide - narrow > 64 * weights * 10


def test_the_footprint_of_a_transition_is_that_of_the_replay():
    from agents.replay import Replay

    for environment, observation, action in (("Pendulum-CA", 2, 1), ("Acrobot-DA", 4, 1), ("Pendulum-v1", 3, 1)):
        rows = Replay(1, 1, observation, action, "cpu").rows
        assert footprint(pilot(2, environment)).row_bytes == rows.numel() * rows.element_size()
