"""The claims of the thesis are about studies that are built in, and a file of claims is understood or refused."""

import sys
from pathlib import Path

import pytest

from analysis.claims.claims import Side, parse_claims, thesis_claims
from sweep.grid import load
from sweep.messages import UserError
from sweep.trials import expand

CLAIMS = thesis_claims().claims
STUDIES = sorted({side.study for claim in CLAIMS for test in claim.tests for side in (test.first, test.second) if side})
HEAD = "margin = 10\n[best_returns]\n"


def claim(test):
    return f'{HEAD}[[claim]]\nfigure = "6.1"\nstudy = "s"\nstatement = "so it is"\ntests = [{{ {test} }}]\n'


def parsed(test):
    return parse_claims(claim(test)).claims[0].tests[0]


@pytest.fixture(scope="module")
def settings():
    """Study → its (agent, environment) → the hyperparameters of its settings."""
    found = {}
    docs = Path(__file__).parents[3] / "docs"
    sys.path.insert(0, str(docs))
    grids = {study: load(str(docs / f"{study}.toml") if study == "fixed-start" else f"thesis/{study}") for study in STUDIES}
    sys.path.remove(str(docs))
    for study, grid in grids.items():
        of_study = found.setdefault(study, {})
        for trial in expand(grid):
            of_study.setdefault((trial.agent, trial.environment), {})[trial.setting] = trial.applicable_hypers
    return found


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_every_claim_is_about_runs_of_a_built_in_study(claim, settings):
    assert claim.tests or claim.why
    for test in claim.tests:
        for side in (test.first, test.second):
            for environment in {side.environment} - {None} if side else ():
                known = settings[side.study][side.agent, environment].values()
                meant = [hypers for hypers in known if all(hypers[name] == value for name, value in side.where.items())]
                assert len(meant) == 1 or test.kind in ("narrower", "dominated"), side


def test_claims_are_numbered_by_figure():
    names = [claim.name for claim in CLAIMS]
    assert len(set(names)) == len(names)
    assert [name for name in names if name.startswith("7.2")] == ["7.2.1", "7.2.2", "7.2.3", "7.2.4", "7.2.5"]


def test_a_side_is_an_agent_or_says_more():
    test = parsed(
        'environment = "E", window = [0.2, 0.3], higher = "A", than = { agent = "B", study = "t", environment = "F", n = 3 }'
    )
    assert (test.kind, test.window) == ("higher", (0.2, 0.3))
    assert test.first == Side("A", "s", "E")
    assert test.second == Side("B", "t", "F", {"n": 3})


@pytest.mark.parametrize(
    ("test", "message"),
    [
        ('agent = "A"', "claim 6.1.1: a test needs one of higher, .*, and has none"),
        ('higher = "A", than = "B", above = 3', "and has higher, above"),
        ('higher = "A", then = "B"', 'claim 6.1.1: unknown word "then": did you mean "than"'),
        ('higher = "A", than = "B", window = "last hour"', 'claim 6.1.1: unknown window "last hour"'),
        ('higher = "A", than = "B", window = [0.5, 0.4]', r"a window is a part of the steps, .* this one is \[0.5, 0.4\]"),
    ],
)
def test_what_cannot_be_understood_is_named(test, message):
    with pytest.raises(UserError, match=message):
        parse_claims(claim(test))
