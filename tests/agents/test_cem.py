import math

import pytest
import torch

from agents.algorithms.cem import ConvergenceError, Normal, estimate_rare_event, improve, optimize


def normal(mean, std, **options):
    return Normal(torch.tensor(mean, dtype=torch.float64), torch.tensor(std, dtype=torch.float64), **options)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("threshold", [2.0, 4.0, 6.0])
def test_a_normal_tail_probability_is_estimated_within_its_standard_error(threshold):
    """P(Y ≥ 6) is 1e-9: a thousand samples of Y itself would never see it."""
    exact = 0.5 * math.erfc(threshold / math.sqrt(2))
    found = [
        estimate_rare_event(lambda y: y[:, 0], threshold, normal([0.0], [1.0]), count=1000, fraction=0.1, generator=generator(s))
        for s in range(10)
    ]
    z = torch.tensor([(event.probability - exact) / event.standard_error for event in found])
    assert z.abs().max() < 4
    assert abs(z.mean()) < 4 / math.sqrt(10)
    assert all(event.standard_error < 0.1 * exact for event in found)


def test_the_tail_of_a_sum_is_estimated_too():
    exact = 0.5 * math.erfc(12 / math.sqrt(2 * 5))
    event = estimate_rare_event(
        lambda y: y.sum(1),
        12.0,
        normal([0.0] * 5, [1.0] * 5),
        count=2000,
        fraction=0.1,
        generator=generator(),
        final_count=100_000,
    )
    assert abs(event.probability - exact) < 4 * event.standard_error
    assert event.standard_error < 0.1 * exact


def test_an_event_that_cannot_happen_is_reported():
    with pytest.raises(ConvergenceError):
        estimate_rare_event(
            lambda y: torch.tanh(y[:, 0]),
            1.5,
            normal([0.0], [1.0]),
            count=100,
            fraction=0.1,
            generator=generator(),
            max_generations=30,
        )


def test_an_event_beyond_what_numbers_can_weigh_is_reported_not_answered_with_nan():
    with pytest.raises(ConvergenceError):
        estimate_rare_event(
            lambda y: y[:, 0] * float("nan"), 1.0, normal([0.0], [1.0]), count=100, fraction=0.1, generator=generator()
        )


def test_optimization_finds_the_higher_of_two_peaks():
    def objective(y):
        return torch.exp(-((y[:, 0] + 3) ** 2)) + 2 * torch.exp(-((y[:, 0] - 4) ** 2))

    best = optimize(objective, normal([0.0], [5.0]), count=200, fraction=0.1, generator=generator())
    assert best.converged
    assert best.value == pytest.approx(2.0, abs=1e-3)
    assert best.density.mean.item() == pytest.approx(4.0, abs=1e-2)


def test_optimization_works_where_there_is_no_gradient_and_in_several_dimensions():
    goal = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    best = optimize(
        lambda y: -torch.ceil((y - goal).abs() * 100).sum(1),
        normal([0.0] * 3, [4.0] * 3),
        count=500,
        fraction=0.1,
        generator=generator(),
    )
    assert (best.density.mean - goal).abs().max() < 0.02


def test_thresholds_never_fall_far_and_the_budget_bounds_the_search():
    best = optimize(
        lambda y: -(y[:, 0] ** 2), normal([5.0], [2.0]), count=100, fraction=0.1, generator=generator(), max_generations=3
    )
    assert len(best.generations) == 3
    assert not best.converged
    thresholds = [generation.threshold for generation in best.generations]
    assert thresholds == sorted(thresholds)


def test_one_generation_fits_the_elites_by_maximum_likelihood():
    generation = improve(lambda y: y[:, 0], normal([0.0], [1.0]), 10, 0.3, generator())
    ascending = generation.values.sort().values
    assert generation.threshold == ascending[6].item()  # H_⌈0.7·10⌉, counted from 1
    elites = ascending[6:]
    assert generation.next_density.mean.item() == pytest.approx(elites.mean().item())
    assert generation.next_density.std.item() == pytest.approx(elites.std(correction=0).item())


def test_the_log_density_is_that_of_torch_distributions():
    y = torch.randn(5, 2, dtype=torch.float64, generator=generator())
    density = normal([1.0, -1.0], [2.0, 0.5])
    expected = torch.distributions.Normal(density.mean, density.std).log_prob(y).sum(1)
    torch.testing.assert_close(density.log_density(y), expected)
