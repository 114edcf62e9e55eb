import math

import pytest

from agents.hypers import GreedyACHypers, HyperparameterError, SACHypers
from agents.registry import ALGORITHMS, ENVIRONMENTS


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("critic_step_size", -1e-3, "critic_step_size = -0.001: must be greater than 0"),
        ("critic_step_size", 0, "critic_step_size = 0: must be greater than 0"),
        ("critic_step_size", math.nan, "critic_step_size = nan: must be finite"),
        ("critic_step_size", 1e308, "critic_step_size = 1e+308: is too large"),
        ("critic_step_size", 10**400, f"critic_step_size = {10**400}: is too large"),
        ("critic_step_size", 1e-60, "critic_step_size = 1e-60: is too small: single precision takes it for 0"),
        ("replay_capacity", 10**20, f"replay_capacity = {10**20}: is too large"),
        ("hidden_layers", [10**9], f"hidden_layers = [{10**9}]: must be a list of layer widths, such as [64, 64]"),
        ("critic_step_size", "0.1", "critic_step_size = '0.1': must be a number"),
        ("critic_step_size", True, "critic_step_size = True: must be a number"),
        ("polyak", 1.5, "polyak = 1.5: must be at most 1"),
        ("entropy_scale", -1, "entropy_scale = -1: must be at least 0"),
        ("batch_size", 0.5, "batch_size = 0.5: must be a whole number"),
        ("batch_size", 0, "batch_size = 0: must be at least 1"),
        ("hidden_layers", [], "hidden_layers = []: must be a list of layer widths, such as [64, 64]"),
        ("hidden_layers", [64, 0], "hidden_layers = [64, 0]: must be a list of layer widths, such as [64, 64]"),
        ("entropy_gradient", "exact", "entropy_gradient = 'exact': must be one of 'sampled', 'analytic', 'score'"),
        ("replay_capacity", 8, "replay_capacity = 8: must be at least batch_size = 32"),
        (
            "elite_fraction",
            0.01,
            "elite_fraction = 0.01: with num_action_samples = 30 no action is elite (round(ρN) = 0)",
        ),
    ],
)
def test_a_bad_value_is_named_with_what_would_be_valid(name, value, message):
    with pytest.raises(HyperparameterError) as caught:
        GreedyACHypers(**{name: value})
    assert str(caught.value) == message


def test_values_take_their_canonical_type():
    hypers = GreedyACHypers(critic_step_size=1, batch_size=16.0, hidden_layers=[64, 32])
    assert str(SACHypers(entropy_scale=-0.0).entropy_scale) == "0.0"
    assert (type(hypers.critic_step_size), type(hypers.batch_size), hypers.hidden_layers) == (float, int, (64, 32))


def test_the_thesis_defaults_hold():
    hypers = GreedyACHypers()
    assert (hypers.num_elites, hypers.num_action_samples, hypers.batch_size, hypers.polyak) == (3, 30, 32, 0.01)
    assert (hypers.hidden_layers, hypers.replay_capacity, hypers.entropy_gradient) == ((64, 64), 100_000, "sampled")
    assert GreedyACHypers(num_action_samples=10, elite_fraction=3 / 10).num_elites == 3
    assert SACHypers(critic_step_size=0.01, actor_step_size_scale=0.1).actor_step_size == pytest.approx(0.001)


def test_hyperparameters_that_do_not_apply_are_left_out():
    assert "entropy_scale" not in GreedyACHypers().applicable("discrete")
    assert "entropy_scale" in GreedyACHypers().applicable("continuous")


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_can_be_made_from_its_defaults_and_loaded(name):
    assert ALGORITHMS[name].hypers().as_dict().keys() == ALGORITHMS[name].hypers.table.keys()
    assert callable(ALGORITHMS[name].load())
    assert all(hyper.meaning for hyper in ALGORITHMS[name].hypers.table.values())


def test_registry_keys_are_the_names():
    assert all(key == entry.name for table in (ALGORITHMS, ENVIRONMENTS) for key, entry in table.items())
