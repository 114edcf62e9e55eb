"""The cross-entropy method: optimization (thesis Algorithms 5 and 9) and rare-event estimation (Algorithm 8).

A density h_ψ is moved, generation by generation, onto the samples of highest value under H: by weighted maximum likelihood,
which for the normal family has a closed form. Everything is in float64; samples are [N, D] for D-dimensional arguments.

Deviations from the printed pseudo-code:
- Algorithm 5, line 4 keeps ⌊ρN⌋ samples; `improve` keeps those from H_⌈(1−ρ)N⌉ on, as Algorithm 9 does: one more.
- Algorithm 9 may never stop: `max_generations` bounds it, and the result says whether the thresholds had converged.
- Algorithm 8 may stall when no elite passes the last threshold: ρ_t is then shrunk until one does or a sample is left
  (Rubinstein and Kroese, 2004, section 2.5); after `max_generations` ConvergenceError is raised.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

Objective = Callable[[Tensor], Tensor]


class ConvergenceError(RuntimeError):
    """The event's threshold was not reached in the generations that were allowed."""


@dataclass(frozen=True)
class Normal:
    """Independent normal densities with mean [D] and standard deviation [D]: the family of h_ψ.

    With `learns_std` False the standard deviation stays. Estimation needs that: with a density narrower than the nominal one the
    importance ratio f_ξ/h_ψ is unbounded in the tails, and its variance infinite below 1/√2 of the nominal width.
    """

    mean: Tensor
    std: Tensor
    learns_std: bool = True

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Return samples [count, D]."""
        noise = torch.randn(count, len(self.mean), generator=generator, dtype=torch.float64)
        return self.mean + self.std * noise

    def log_density(self, y: Tensor) -> Tensor:
        """Return ln h(y) [N] of arguments [N, D]."""
        u = (y - self.mean) / self.std
        return (-0.5 * u.square() - self.std.log() - 0.5 * math.log(2 * math.pi)).sum(dim=1)

    def fit(self, y: Tensor, weights: Tensor) -> "Normal":
        """Return argmax_ψ Σ_i w_i ln h_ψ(y_i) for y [N, D] and weights [N] (equations B.12 and B.20)."""
        share = (weights / weights.sum()).unsqueeze(1)
        mean = (share * y).sum(dim=0)
        if not self.learns_std:
            return Normal(mean, self.std, learns_std=False)
        return Normal(mean, (share * (y - mean).square()).sum(dim=0).sqrt().clamp(min=1e-12))


@dataclass(frozen=True)
class Generation:
    """One update: the density sampled from, the samples [N, D], their values [N], the threshold ζ_t, the next density."""

    density: Normal
    samples: Tensor
    values: Tensor
    threshold: float
    next_density: Normal


@dataclass(frozen=True)
class Optimum:
    """What optimization found: the estimate of max H, the last density, whether the thresholds converged, every generation."""

    value: float
    density: Normal
    converged: bool
    generations: tuple[Generation, ...]


@dataclass(frozen=True)
class RareEvent:
    """What estimation found: the probability, its standard error, the density sampled from, every generation."""

    probability: float
    standard_error: float
    density: Normal
    generations: tuple[Generation, ...]


def improve(objective: Objective, density: Normal, count: int, fraction: float, generator: torch.Generator) -> Generation:
    """Sample, keep the elites, fit: one generation of optimization (Algorithm 5, lines 3–5; Algorithm 9, lines 7–13)."""
    samples = density.sample(count, generator)
    values = objective(samples)
    threshold = _percentile(values, fraction)
    return Generation(density, samples, values, threshold, density.fit(samples, (values >= threshold).double()))


def optimize(
    objective: Objective,
    initial: Normal,
    *,
    count: int,
    fraction: float,
    generator: torch.Generator,
    final_count: int = 1000,
    patience: int = 5,
    tolerance: float = 1e-8,
    max_generations: int = 1000,
) -> Optimum:
    """Maximize H (Algorithm 9): N = `count`, ρ = `fraction`, K = `final_count`, d = `patience`, δ = `tolerance`."""
    generations: list[Generation] = []
    thresholds: list[float] = []
    density, converged = initial, False
    while not converged and len(generations) < max_generations:
        generations.append(improve(objective, density, count, fraction, generator))
        density = generations[-1].next_density
        thresholds.append(generations[-1].threshold)
        recent = thresholds[-patience - 1 :]
        converged = len(recent) > patience and all(
            abs(later - earlier) < tolerance for earlier, later in itertools.pairwise(recent)
        )
    value = objective(density.sample(final_count, generator)).mean().item()  # lines 15–16
    return Optimum(value, density, converged, tuple(generations))


def estimate_rare_event(
    objective: Objective,
    threshold: float,
    nominal: Normal,
    *,
    count: int,
    fraction: float,
    generator: torch.Generator,
    final_count: int = 10_000,
    max_generations: int = 100,
    learns_std: bool = False,
) -> RareEvent:
    """Estimate P(H(Y) ≥ ζ) under f_ξ = `nominal` by importance sampling (Algorithm 8): N = `count`, K = `final_count`.

    Only the mean of the density moves, unless `learns_std`, which is unsafe for the reason that `Normal` gives.

    Raises ConvergenceError when the event stays out of reach.
    """
    generations: list[Generation] = []
    density, reached = replace(nominal, learns_std=learns_std), -math.inf
    while reached != threshold:
        if len(generations) == max_generations:
            raise ConvergenceError(f"threshold {reached:g} of {threshold:g} after {max_generations} generations")
        samples = density.sample(count, generator)
        values = objective(samples)
        reached = _next_threshold(values, fraction, threshold, reached)  # lines 10–11
        log_ratio = nominal.log_density(samples) - density.log_density(samples)
        weights = (log_ratio - log_ratio.max()).exp() * (values >= reached)  # their scale does not matter to the fit
        if not values.isfinite().all() or not weights.sum() > 0:
            raise ConvergenceError(f"no sample with a finite weight above the threshold {reached:g}")
        fitted = density.fit(samples, weights)  # lines 12–13
        generations.append(Generation(density, samples, values, reached, fitted))
        density = fitted
    samples = density.sample(final_count, generator)  # lines 16–17
    ratio = (nominal.log_density(samples) - density.log_density(samples)).exp()
    hits = ratio * (objective(samples) >= threshold)
    return RareEvent(hits.mean().item(), (hits.std() / math.sqrt(final_count)).item(), density, tuple(generations))


def _next_threshold(values: Tensor, fraction: float, goal: float, before: float) -> float:
    """Return min(ζ, H_⌈(1−ρ)N⌉), with ρ halved until it exceeds the threshold before or one sample is left."""
    threshold = _percentile(values, fraction)
    while threshold <= before and fraction * len(values) >= 1:
        fraction /= 2
        threshold = _percentile(values, fraction)
    return min(goal, threshold)


def _percentile(values: Tensor, fraction: float) -> float:
    """Return H_⌈(1−ρ)N⌉, counted from 1 in ascending order."""
    rank = max(1, math.ceil((1 - fraction) * len(values) - 1e-9))
    return values.sort().values[rank - 1].item()
