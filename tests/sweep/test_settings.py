import itertools

import pytest

from sweep.grid import parse
from sweep.messages import UserError
from sweep.trials import candidates, expand

HEAD = '[study]\nname = "s"\nenvironments = ["Pendulum-CA"]\nsteps = 1000\n[seeds]\ntune = 1\n'


def settings(agent, *names, algorithm="GreedyAC", head=HEAD):
    """The values that some hyperparameters have together in the settings of the only agent."""
    grid = parse(f'{head}[[agent]]\nname = "{algorithm}"\n{agent}', "grid.toml")
    return [tuple(hypers.as_dict()[name] for name in names) for hypers in grid.agents[0].settings]


def test_swept_values_are_multiplied():
    found = settings("sweep = { polyak = [0.1, 0.2], batch_size = [8, 16, 32] }", "polyak", "batch_size")
    assert found == list(itertools.product([0.1, 0.2], [8, 16, 32]))


def test_zipped_values_vary_together_and_multiply_the_others():
    agent = "sweep = { polyak = [0.1, 0.2], entropy_scale = [1, 2, 3], batch_size = [8, 16] }\nzip = [['polyak', 'batch_size']]"
    together = [(0.1, 8), (0.2, 16)]
    expected = {(polyak, scale, batch) for polyak, batch in together for scale in (1.0, 2.0, 3.0)}
    found = settings(agent, "polyak", "entropy_scale", "batch_size")
    assert set(found) == expected
    assert len(found) == 6


def test_several_groups_are_multiplied_with_one_another():
    agent = (
        "sweep = { polyak = [0.1, 0.2], entropy_scale = [1, 2], batch_size = [8, 16], critic_step_size = [0.1, 0.2] }\n"
        "zip = [['polyak', 'batch_size'], ['critic_step_size', 'entropy_scale']]"
    )
    found = settings(agent, "polyak", "batch_size", "critic_step_size", "entropy_scale")
    assert set(found) == {(p, b, c, e) for p, b in [(0.1, 8), (0.2, 16)] for c, e in [(0.1, 1.0), (0.2, 2.0)]}


def test_a_value_may_come_again_in_a_zip_but_not_outside_of_one():
    agent = "sweep = { polyak = [0.1, 0.1], batch_size = [8, 16] }\n"
    assert settings(agent + "zip = [['polyak', 'batch_size']]", "polyak", "batch_size") == [(0.1, 8), (0.1, 16)]
    with pytest.raises(UserError, match=r"agent\[1\]\.sweep\.polyak: value 0\.1 is listed twice"):
        settings(agent, "polyak")


def test_what_the_study_sweeps_can_be_zipped_too():
    head = HEAD + "[sweep]\npolyak = [0.1, 0.2]\n"
    agent = "sweep = { batch_size = [8, 16] }\nzip = [['polyak', 'batch_size']]"
    assert settings(agent, "polyak", "batch_size", head=head) == [(0.1, 8), (0.2, 16)]


def test_derived_hyperparameters_follow_from_swept_fixed_default_and_other_derived_ones():
    agent = (
        "sweep = { num_action_samples = [10, 20, 30] }\nfixed = { batch_size = 64 }\n"
        'derive = { replay_capacity = "elite_fraction * 1000 * batch_size", elite_fraction = "3 / num_action_samples", '
        'polyak = "critic_step_size * 2" }'
    )
    found = settings(agent, "num_action_samples", "elite_fraction", "replay_capacity", "polyak")
    assert found == [(10, 0.3, 19200, 0.002), (20, 0.15, 9600, 0.002), (30, 0.1, 6400, 0.002)]
    assert [type(row[2]) for row in found] == [int] * 3


def test_excluded_settings_are_left_out():
    agent = (
        "sweep = { critic_step_size = [1e-3, 1e-4, 1e-5], actor_step_size_scale = [1, 10] }\n"
        'exclude = ["critic_step_size == 1e-5", "actor_step_size_scale == 10.0 and critic_step_size < 1e-3"]'
    )
    found = settings(agent, "critic_step_size", "actor_step_size_scale")
    assert found == [(1e-3, 1.0), (1e-3, 10.0), (1e-4, 1.0)]


def test_settings_can_be_excluded_by_what_is_derived_and_before_it_would_fail():
    agent = (
        "sweep = { num_action_samples = [1, 2, 10, 30] }\n"
        'derive = { elite_fraction = "3 / num_action_samples" }\n'
        'exclude = ["num_action_samples < 3", "elite_fraction == 0.1"]'
    )
    assert settings(agent, "num_action_samples", "elite_fraction") == [(10, 0.3)]


def test_conditions_may_overlap():
    agent = 'sweep = { batch_size = [8, 16, 32] }\nexclude = ["batch_size <= 16", "batch_size == 8"]'
    assert settings(agent, "batch_size") == [(32,)]


def test_settings_can_be_excluded_by_texts():
    agent = 'sweep = { entropy_gradient = ["sampled", "score"] }\nexclude = ["entropy_gradient == \'score\'"]'
    assert settings(agent, "entropy_gradient") == [("sampled",)]


def test_functions_know_the_names_that_they_are_given():
    agent = (
        'sweep = { n = [2, 4] }\nfixed = { kind = "x" }\n'
        'derive = { width = "n * 32", share = "1 / n" }\nexclude = ["width > 100"]'
    )
    assert settings(agent, "n", "kind", "width", "share", algorithm="textwrap:fill") == [(2, "x", 64, 0.5)]
    with pytest.raises(UserError, match=r'unknown hyperparameter "m"; Known: kind, n, share, width'):
        settings(agent.replace("1 / n", "1 / m"), algorithm="textwrap:fill")


def test_the_last_name_varies_fastest():
    head = HEAD + "[sweep]\npolyak = [0.1, 0.2]\n"
    assert settings("sweep = { batch_size = [8, 16] }", "polyak", "batch_size", head=head) == [
        (0.1, 8),
        (0.1, 16),
        (0.2, 8),
        (0.2, 16),
    ]


def test_settings_that_derive_makes_equal_become_one_trial():
    agent = '[[agent]]\nname = "GreedyAC"\nfixed = { num_action_samples = 10'
    text = HEAD + agent + ", elite_fraction = 0.3 }\n" + agent + ' }\nderive = { elite_fraction = "3 / num_action_samples" }\n'
    grid = parse(text, "grid.toml")
    assert len(expand(grid)) == len(candidates(grid)) == 1


@pytest.mark.parametrize(("exclude", "ok"), [("", False), ('exclude = ["num_action_samples < 4"]', True)])
def test_a_contradiction_is_none_where_the_setting_is_excluded(exclude, ok):
    agent = f"sweep = {{ num_action_samples = [2, 10] }}\nfixed = {{ elite_fraction = 0.2 }}\n{exclude}"
    if ok:
        assert settings(agent, "num_action_samples") == [(10,)]
    else:
        with pytest.raises(UserError, match=r"^grid\.toml: agent\[1\]: elite_fraction = 0\.2: with num_action_samples = 2 no"):
            settings(agent, "num_action_samples")
