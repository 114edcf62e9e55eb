"""Environments by name: built in, Gymnasium's, a user's own; and what cannot be trained on."""

import pickle
import subprocess
import sys

import pytest

from agents.registry import ENVIRONMENTS, EnvironmentLookupError, find_environment


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_built_in_name_leads_to_the_built_in_environment(name):
    assert find_environment(name) is ENVIRONMENTS[name]


@pytest.mark.parametrize(
    ("name", "actions", "cutoff"),
    [
        ("CartPole-v1", "discrete", 500),
        ("Pendulum-v1", "continuous", 200),
        ("MountainCarContinuous-v0", "continuous", 999),
        ("sweep/Acrobot-DA-v0", "discrete", 1000),
        ("counting_environments:counting/Box-v0", "continuous", 1000),
        ("counting_environments:counting/Limited-v0", "discrete", 30),
    ],
)
def test_a_gymnasium_id_is_known_with_its_actions_and_its_cutoff(name, actions, cutoff):
    found = find_environment(name)
    assert (found.name, found.actions, found.cutoff, found.keeps_state) == (name, actions, cutoff, True)
    assert found.make(2).observation_size >= 2


MODULE = "counting_environments:"
REFUSED = [
    (MODULE + "counting/Image-v0", r"observations in Box\(0, 255, \(8, 8, 3\), uint8\) are not supported, only vectors"),
    (MODULE + "counting/Dict-v0", r"observations in Dict\('position': Box.* are not supported, only vectors"),
    ("FrozenLake-v1", r"observations in Discrete\(16\) are not supported"),
    (MODULE + "counting/Many-v0", r"actions in MultiDiscrete\(\[2 3\]\) are not supported, only Discrete, or a bounded Box"),
    (MODULE + "counting/Unbounded-v0", r"actions in Box\(-inf, inf, \(1,\), float32\) are unbounded"),
    (MODULE + "counting/Matrix-v0", r"actions in Box\(-1.0, 1.0, \(2, 2\), float32\) are not supported"),
    (MODULE + "counting/Whole-v0", r"actions in Box\(0, 5, \(1,\), int64\) are not supported"),
    (MODULE + "counting/Broken-v0", "cannot be made: AttributeError: .*Absent"),
    ("no_such_module:Any-v0", "module no_such_module cannot be imported: ModuleNotFoundError"),
]


@pytest.mark.parametrize(("name", "reason"), REFUSED)
def test_what_cannot_be_trained_on_is_refused_with_its_reason(name, reason):
    with pytest.raises(EnvironmentLookupError, match=reason) as caught:
        find_environment(name)
    assert not caught.value.choices
    assert str(caught.value).startswith(f'"{name}": ')


@pytest.mark.parametrize("name", ["CartPole-v7", "CartPole", "Nothing/Like-v0", MODULE + "counting/Absent-v0", "not an id!", ""])
def test_an_unknown_id_comes_with_those_that_there_are(name):
    with pytest.raises(EnvironmentLookupError, match="unknown environment") as caught:
        find_environment(name)
    assert "CartPole-v1" in caught.value.choices
    assert not [choice for choice in caught.value.choices if choice.startswith("sweep/")]


def test_the_error_survives_the_way_between_processes():
    error = EnvironmentLookupError("Foo-v0", "unknown environment", ("Bar-v0",))
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.name, copy.choices) == (str(error), "Foo-v0", ("Bar-v0",))


def modules_after(code):
    program = f"import sys; from agents.registry import find_environment, EnvironmentLookupError; {code}; print(*sys.modules)"
    return subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout.split()


def test_gymnasium_is_imported_for_foreign_names_only_and_torch_never():
    assert not {"torch", "gymnasium", "numpy"} & set(modules_after("find_environment('Acrobot-DA')"))
    loaded = modules_after("find_environment('CartPole-v1')")
    assert "gymnasium" in loaded and "torch" not in loaded


def test_a_missing_extra_is_named():
    code = """
import sys
sys.modules["mujoco"] = None
from agents.registry import find_environment
try:
    find_environment("HalfCheetah-v5")
except LookupError as error:
    print(error)
"""
    printed = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert printed == '"HalfCheetah-v5": needs the mujoco extra, which is not installed: pip install "sweep-rl[mujoco]"\n'
