"""The cross-entropy methods at work: what is written down is what the algorithms do, by numpy, scipy and Adam on two numbers."""

import json
import math
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from agents import demonstrations, kernels
from agents.demonstrations import ccem_progression, cem_update

ENGINES = [
    "torch",
    pytest.param("native", marks=pytest.mark.skipif(kernels.report().engine == "torch", reason="no native kernels here")),
]
LOW, HIGH, UPDATES, STEP_SIZE, ENTROPY_SCALE = -3.0, 3.0, 40, 0.05, 0.3


def value(a):
    return 0.5 * np.exp(-(((a + 1.4) / 0.8) ** 2)) + np.exp(-(((a - 1) / 0.5) ** 2))


def by_series(rows):
    """(series, update) → actions and values [2, n]."""
    pairs = defaultdict(list)
    for row in rows:
        pairs[row["series"], row["update"]].append((row["action"], row["value"]))
    return {key: np.array(found).T for key, found in pairs.items()}


def parameters(rows, policy):
    """Means and standard deviations [2, updates + 1] of a policy."""
    found = by_series(rows)
    return np.concatenate([found[f"{policy} parameters", update] for update in range(UPDATES + 1)], axis=1)


@pytest.mark.parametrize("run", [cem_update, ccem_progression])
def test_rows_are_plain_and_have_four_columns(run):
    rows = run()
    assert json.loads(json.dumps(rows)) == rows
    assert {tuple(row) for row in rows} == {("update", "series", "action", "value")}
    assert {tuple(map(type, row.values())) for row in rows} == {(int, str, float, float)}


@pytest.mark.parametrize("run", [cem_update, ccem_progression])
def test_the_same_seed_gives_the_same_rows_and_another_one_others(run):
    assert run(3) == run(3)
    assert by_series(run(3))["sample", 0].tolist() != by_series(run(4))["sample", 0].tolist()


@pytest.mark.parametrize("run", [cem_update, ccem_progression])
def test_every_value_is_that_of_the_function_with_two_peaks(run):
    found = by_series(run())
    for (series, _), (actions, values) in found.items():
        if series in ("objective", "sample", "elite"):
            np.testing.assert_allclose(values, value(actions), atol=1e-6)
    grid, values = found["objective", 0]
    peaks = grid[1:-1][(values[1:-1] > values[:-2]) & (values[1:-1] > values[2:])]
    np.testing.assert_allclose(peaks, [-1.4, 1.0], atol=0.011)


@pytest.mark.parametrize(("run", "count", "elites"), [(cem_update, 30, 7), (ccem_progression, 30, 3)])
def test_the_elites_are_the_samples_of_highest_value(run, count, elites):
    found = by_series(run())
    updates = [update for series, update in found if series == "sample"]
    assert updates == [update for series, update in found if series == "elite"]
    for update in updates:
        samples = found["sample", update]
        assert samples.shape == (2, count)
        best = samples[:, np.argsort(samples[1])[-elites:]]
        assert sorted(best[0]) == sorted(found["elite", update][0])


@pytest.mark.parametrize("run", [cem_update, ccem_progression])
def test_every_density_is_the_normal_one_of_its_parameters(run):
    found = by_series(run())
    densities = [key for key in found if key[0] in ("density", "actor", "proposal")]
    assert len(densities) == (2 if run is cem_update else 2 * (UPDATES + 1))
    for series, update in densities:
        grid, density = found[series, update]
        mean, std = found[f"{series} parameters", update][:, 0]
        np.testing.assert_allclose(density, stats.norm(mean, std).pdf(grid), rtol=1e-3, atol=1e-6)


def test_after_the_update_mean_and_standard_deviation_are_those_of_the_elites():
    found = by_series(cem_update())
    elites = found["elite", 0][0]
    np.testing.assert_allclose(found["density parameters", 0][:, 0], [0, 1.2])
    np.testing.assert_allclose(found["density parameters", 1][:, 0], [elites.mean(), elites.std()])


@pytest.mark.parametrize("seed", range(10))
def test_the_update_raises_the_likelihood_of_the_elites(seed):
    found = by_series(cem_update(seed))
    before, after = (
        stats.norm(*found["density parameters", update][:, 0]).logpdf(found["elite", 0][0]).mean() for update in (0, 1)
    )
    assert after > before


@pytest.mark.parametrize("seed", range(10))
def test_the_actor_concentrates_on_the_best_action_before_the_proposal_does(seed):
    rows = ccem_progression(seed)
    (actor_mean, actor_std), (_, proposal_std) = parameters(rows, "actor"), parameters(rows, "proposal")
    assert actor_std[0] == proposal_std[0] == 1 and actor_mean[0] == 0
    assert actor_mean[-1] == pytest.approx(1, abs=0.15)
    assert actor_std[-1] < 0.3
    assert actor_std[-1] < 0.9 * proposal_std[-1]
    assert actor_std.mean() < proposal_std.mean()


def test_without_entropy_the_actor_does_as_the_proposal_does(monkeypatch):
    monkeypatch.setattr(demonstrations, "_CCEM_HYPERS", replace(demonstrations._CCEM_HYPERS, entropy_scale=0.0))
    rows = ccem_progression()
    np.testing.assert_array_equal(parameters(rows, "actor"), parameters(rows, "proposal"))


class AdamOnTwoNumbers:
    """A policy by its two outputs (m, ℓ): mean 3·tanh m, standard deviation e^ℓ; in double precision."""

    def __init__(self):
        self.outputs, self.first, self.second, self.steps = np.zeros(2), np.zeros(2), np.zeros(2), 0

    def parameters(self):
        return HIGH * math.tanh(self.outputs[0]), math.exp(self.outputs[1])

    def score(self, action):
        """∇ ln π(action)."""
        mean, std = self.parameters()
        u = (action - mean) / std
        return np.array([u / std * HIGH * (1 - (mean / HIGH) ** 2), u**2 - 1])

    def ascend(self, gradient):
        self.steps += 1
        self.first = 0.9 * self.first + 0.1 * gradient
        self.second = 0.999 * self.second + 0.001 * gradient**2
        corrected = self.first / (1 - 0.9**self.steps), self.second / (1 - 0.999**self.steps)
        self.outputs = self.outputs + STEP_SIZE * corrected[0] / (np.sqrt(corrected[1]) + 1e-8)


@pytest.mark.parametrize("engine", ENGINES)
def test_both_policies_follow_the_elites_by_adam_and_the_proposal_its_entropy_too(engine):
    with kernels.using(engine):
        rows = ccem_progression(seed=5)
    found = by_series(rows)
    actor, proposal = AdamOnTwoNumbers(), AdamOnTwoNumbers()
    expected = {"actor": [], "proposal": []}
    for update in range(UPDATES + 1):
        expected["actor"].append(actor.parameters())
        expected["proposal"].append(proposal.parameters())
        elites, first = found["elite", update][0], found["sample", update][0, 0]
        assert LOW < first < HIGH  # the entropy's action is drawn without clamping: here it is the first sample
        log_density = stats.norm(*proposal.parameters()).logpdf(first)
        actor_ascent = np.mean([actor.score(a) for a in elites], axis=0)
        entropy_ascent = -log_density * proposal.score(first)
        proposal.ascend(np.mean([proposal.score(a) for a in elites], axis=0) + ENTROPY_SCALE * entropy_ascent)
        actor.ascend(actor_ascent)
    for policy, steps in expected.items():
        np.testing.assert_allclose(parameters(rows, policy), np.array(steps).T, rtol=2e-3, atol=2e-3)


def test_actions_are_drawn_from_the_proposal_within_the_bounds():
    drawn = []
    for seed in range(5):
        found = by_series(ccem_progression(seed))
        for update in range(UPDATES + 1):
            actions = found["sample", update][0]
            assert actions.min() >= LOW and actions.max() <= HIGH
            mean, std = found["proposal parameters", update][:, 0]
            inside = actions[(actions > LOW) & (actions < HIGH)]
            drawn.append((inside - mean) / std)
    spread = np.concatenate(drawn)
    assert abs(spread.mean()) < 0.05
    assert 0.93 < spread.std() < 1.02
