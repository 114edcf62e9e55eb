"""Tests of claims, and their verdicts.

A claim is confirmed if every test of it is: its p-value is the largest of theirs (Berger 1982, *Technometrics* 24), corrected by
Holm for all claims that are judged together and have runs. That of "similar" is the larger of two one-sided tests (Schuirmann
1987). It is not confirmed if a test shows the opposite, at 5 % for all tests of the claim together (Bonferroni): if its interval
of 95 %, wider where there are several, lies outside what is claimed. Otherwise these runs leave it undecided.

Means are compared by Welch's interval, which takes the sides for independent. Where they share seeds, and luck, it is too wide.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from analysis.claims.claims import WIDTHS, WINDOWS, Claim, Claims, Side, Test
from analysis.claims.runs import Runs
from analysis.statistics.contrasts import Contrast, contrast
from analysis.statistics.corrections import correct
from analysis.statistics.estimate import Estimate
from analysis.statistics.width_differences import Tested, width_difference, width_less_reach
from sweep.messages import UserError

CONFIRMED, NOT_CONFIRMED, UNDECIDED, NOT_TESTED = "confirmed", "not confirmed", "undecided", "not tested"
LEVEL = 0.05
_PER, _ACROSS = "published-per-environment", "published-across-environments"


@dataclass(frozen=True)
class Evidence:
    """What a test found: d with its interval, what is claimed of d, and one-sided p-values. `means`: of both sides, if any.

    `p_value` is that of the claim, `p_opposite` that of d lying outside of what is claimed.
    """

    test: Test
    estimate: Estimate
    claimed: tuple[float, float]
    p_value: float
    p_opposite: float
    means: tuple[float, ...] = ()


@dataclass
class Judged:
    """A claim with its evidence and verdict; `p_value` before, `p_holm` after the correction, NaN where nothing was tested."""

    claim: Claim
    evidence: list[Evidence] = field(default_factory=list)
    verdict: str = NOT_TESTED
    why: str = ""
    p_value: float = float("nan")
    p_holm: float = float("nan")


def judge(claims: Sequence[Claim], rules: Claims, runs: Runs, seed: int = 0) -> list[Judged]:
    """Return the verdicts of claims, corrected for their number. What the store has no runs for is not tested, and says why."""
    judged = [_tested(claim, rules, runs, seed) for claim in claims]
    tested = [one for one in judged if one.evidence]
    for one in tested:
        one.p_value = max(evidence.p_value for evidence in one.evidence)
    for one, corrected in zip(tested, correct([one.p_value for one in tested], "holm"), strict=True):
        one.p_holm = float(corrected)
        refuted = min(evidence.p_opposite for evidence in one.evidence) < LEVEL / 2 / len(one.evidence)
        one.verdict = NOT_CONFIRMED if refuted else CONFIRMED if one.p_holm < LEVEL else UNDECIDED
    return judged


def _tested(claim: Claim, rules: Claims, runs: Runs, seed: int) -> Judged:
    if not claim.tests:
        return Judged(claim, why=claim.why)
    try:
        return Judged(claim, [_KINDS[test.kind](test, rules, runs, seed) for test in claim.tests])
    except UserError as error:
        return Judged(claim, why=str(error))


def _two_means(test: Test, rules: Claims, runs: Runs, seed: int) -> Evidence:
    assert test.second is not None
    first, second = runs.means(test.first, test.window), runs.means(test.second, test.window)
    found = contrast([first, second], [1, -1])
    claimed = {
        "higher": (0.0, np.inf),
        "at_least": (-rules.margin, np.inf),
        "similar": (-rules.margin, rules.margin),
    }[test.kind]
    return _evidence(test, found, claimed, (float(first.mean()), float(second.mean())))


def _level(test: Test, rules: Claims, runs: Runs, seed: int) -> Evidence:
    assert test.bound is not None
    found = contrast([runs.means(test.first, test.window)], [1])
    return _evidence(test, found, (test.bound, np.inf) if test.kind == "above" else (-np.inf, test.bound))


def _fall(test: Test, rules: Claims, runs: Runs, seed: int) -> Evidence:
    """Compare two parts of the same runs: their differences are the sample."""
    assert test.earlier is not None
    later, earlier = runs.means(test.first, test.window), runs.means(test.first, test.earlier)
    if not later.index.equals(earlier.index):
        raise UserError(f"{test.first.text()}: some runs have no completed episode in one of the two parts")
    return _evidence(test, contrast([later - earlier], [1]), (-np.inf, 0.0), (float(later.mean()), float(earlier.mean())))


def _loss(test: Test, rules: Claims, runs: Runs, seed: int) -> Evidence:
    """Compare what two agents lose, in units of |G*|, when one setting is for all environments."""
    assert test.second is not None
    groups, weights, means = [], [], []
    for sign, agent in ((1, test.first.agent), (-1, test.second.agent)):
        lost = 0.0
        for environment, best in rules.best_returns.items():
            tuned, shared = (runs.means(Side(agent, study, environment), test.window) for study in (_PER, _ACROSS))
            if not tuned.index.equals(shared.index):
                raise UserError(f"{agent} on {environment}: the two studies have runs of different seeds")
            groups.append(tuned - shared)  # by seed: where the settings are the same, so are the runs
            weights.append(sign / abs(best) / len(rules.best_returns))
            lost += abs(weights[-1]) * float(groups[-1].mean())
        means.append(lost)
    return _evidence(test, contrast(groups, weights), (-np.inf, 0.0), tuple(means))


def _narrower(test: Test, rules: Claims, runs: Runs, seed: int) -> Evidence:
    assert test.second is not None
    first, second = runs.region(test.first, test.at), runs.region(test.second, test.at)
    return Evidence(test, *_below_zero(width_difference(first, second, seed=seed)))


def _dominated(test: Test, rules: Claims, runs: Runs, seed: int) -> Evidence:
    return Evidence(test, *_below_zero(width_less_reach(runs.region(test.first, test.at), seed=seed)))


def _below_zero(tested: Tested) -> tuple[Estimate, tuple[float, float], float, float]:
    estimate, below, above = tested
    return estimate, (-np.inf, 0.0), below, above


def _evidence(test: Test, found: Contrast, claimed: tuple[float, float], means: tuple[float, ...] = ()) -> Evidence:
    low, high = claimed
    ends = [(found.p_above(low), found.p_below(low))] * bool(np.isfinite(low))
    ends += [(found.p_below(high), found.p_above(high))] * bool(np.isfinite(high))
    inside, outside = zip(*ends, strict=True)
    return Evidence(test, found.interval(), claimed, max(inside), min(outside), means)


_KINDS: dict[str, Callable[[Test, Claims, Runs, int], Evidence]] = {
    "higher": _two_means,
    "similar": _two_means,
    "at_least": _two_means,
    "above": _level,
    "below": _level,
    "falls_from": _fall,
    "loses_less": _loss,
    "narrower": _narrower,
    "dominated": _dominated,
}


def describe(test: Test) -> str:
    """Return d in words, as "last tenth: GreedyAC − SAC, Pendulum-CA"."""
    first = test.first.text(test.second)
    second = test.second.text(test.first) if test.second else ""
    same = test.second is None or test.second.environment == test.first.environment
    place = f", {test.first.environment}" if test.first.environment and same else ""
    if test.kind in WIDTHS:
        at = f" at critic step-sizes {', '.join(f'{value:g}' for value in test.at)}" if test.at else ""
        other = second if second else "what the critic step-size does"
        return f"mean width{at}: {first} − {other}{place}"
    window = _window_text(test.window)
    if test.kind == "loses_less":
        return f"{window}: loss across environments ÷ |G*|, {first} − {second}"
    if test.earlier is not None:
        return f"{window} − {_window_text(test.earlier)}: {first}{place}"
    return f"{window}: {first}{f' − {second}' if second else ''}{place}"


def _window_text(window: tuple[float, float]) -> str:
    names = {known: name for name, known in WINDOWS.items()}
    return names.get(window, f"{window[0]:.0%} to {window[1]:.0%}").replace("all", "all steps")
