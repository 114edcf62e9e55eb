"""Policies as functions of an actor network's outputs, with their gradients in closed form.

A policy is conditioned on outputs: [P, B, 2A] for continuous actions (a head for the mean, one for ln σ), logits [P, B, n] for n
discrete ones. Then it is sampled and differentiated: gradients are with respect to the outputs, so that they can be
handed to the actor's `backward`.

Symbols: m and ℓ the two heads' outputs, μ the mean, σ the standard deviation, x an action before squashing, a an action.
ln σ = clamp(ℓ, ±ln 1000), with gradient zero where ℓ is outside.
"""

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from agents import kernels
from agents.kernels.native_gaussian import MOST_TERMS, NativeGaussian, is_plain
from agents.spaces import Continuous

_LOG_STD_LIMIT = math.log(1000)
_HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)
_SQUASH_EPSILON = 1e-6


class Gaussian:
    """Normal distribution whose mean is squashed into the action range and whose samples are clamped to it.

    μ = low + (tanh m + 1)/2 · (high − low). ln π(a) is the density of the un-truncated normal at the clamped action: what the
    thesis' author uses for GreedyAC and VanillaAC.
    """

    not_in_checkpoints = ("_native",)  # it points at what is

    def __init__(self, space: Continuous, outputs: Tensor) -> None:
        """Condition on outputs [P, B, 2A] of an actor network. Raises ValueError for outputs of another width."""
        A = space.size
        if outputs.shape[-1] != 2 * A:
            raise ValueError(f"outputs {tuple(outputs.shape)} for {A} action dimensions: must be [P, B, {2 * A}]")
        bounds = self._bounds = _bounds(space, outputs.device)
        library = kernels.library(outputs.device.type) if outputs.dim() == 3 and is_plain(outputs) else None
        self._native: NativeGaussian | None = None
        if library is not None:
            self._outputs = outputs.contiguous()
            ends = (bounds.low, bounds.high, bounds.middle, bounds.half_range)
            native = self._native = NativeGaussian(library, self._outputs, ends, _LOG_STD_LIMIT)
            self._tanh, self._mean, self._log_std, self._std = native.tanh, native.mean, native.log_std, native.std
        else:
            self._outputs = outputs
            self._tanh = torch.tanh(outputs[..., :A])
            self._mean = torch.addcmul(bounds.middle, self._tanh, bounds.half_range)
            self._log_std = _clamped_log_std(outputs[..., A:])
            self._std = torch.exp(self._log_std)

    @property
    def mean(self) -> Tensor:
        """μ [P, B, A]."""
        return self._mean

    @property
    def log_std(self) -> Tensor:
        """ln σ [P, B, A]."""
        return self._log_std

    @property
    def std(self) -> Tensor:
        """σ [P, B, A]."""
        return self._std

    def sample(self, noise: Tensor) -> Tensor:
        """Return actions [P, B, N, A] within the bounds for standard normal noise of that shape."""
        if self._native is not None and self._native.reads(noise):
            return self._native.sample(noise, clamps=True)
        return self._bounds.clamp_(self.sample_unclamped(noise))

    def sample_unclamped(self, noise: Tensor) -> Tensor:
        """Return samples [P, B, N, A] of the normal distribution itself, which may lie outside the action range."""
        if self._native is not None and self._native.reads(noise):
            return self._native.sample(noise, clamps=False)
        return torch.addcmul(self.mean.unsqueeze(2), noise, self.std.unsqueeze(2))

    def log_prob(self, actions: Tensor) -> Tensor:
        """Return ln π [P, B, N] of actions [P, B, N, A]."""
        if self._native is not None and actions.shape[3] <= MOST_TERMS and self._native.reads(actions):
            return self._native.log_prob(actions)
        u = (actions - self.mean.unsqueeze(2)).div_(self.std.unsqueeze(2))
        return (u.square_().mul_(-0.5) - self.log_std.unsqueeze(2)).sub_(_HALF_LOG_2_PI).sum(-1)

    def log_prob_gradient(self, actions: Tensor, weights: Tensor | float) -> Tensor:
        """Return ∂/∂outputs of Σ_n w_n ln π(a_n) [P, B, 2A], for actions [P, B, N, A] and constant weights [P, B, N] (or one)."""
        if self._native is not None and actions.shape[2] <= MOST_TERMS and self._native.reads(actions, weights):
            return self._native.log_prob_gradient(actions, weights)
        u = (actions - self.mean.unsqueeze(2)).div_(self.std.unsqueeze(2))
        weights = weights.unsqueeze(-1) if isinstance(weights, Tensor) else weights
        weighted = u * weights
        of_mean = weighted.sum(2).div_(self.std)
        of_log_std = (weighted.mul_(u).sub_(weights)).sum(2)
        return self._of_outputs(of_mean, of_log_std)

    def entropy_gradient(self, estimate: str, noise: Tensor) -> Tensor:
        """Estimate ∂H/∂outputs [P, B, 2A] of the normal's entropy from an action drawn with noise [P, B, 1, A].

        "sampled": −ln π(a)·∇ln π(a), a not clamped (thesis section 4.4). "analytic": of Σ ln σ + const, exactly (its footnote 5).
        "score": −∇ln π(a), a clamped, as the author's code has it: zero in expectation but for the clamped actions.
        """
        if estimate == "analytic":
            return self._of_outputs(torch.zeros_like(self.mean), torch.ones_like(self.std))
        if estimate == "score":
            return self.log_prob_gradient(self.sample(noise), -1.0)
        action = self.sample_unclamped(noise)
        return self.log_prob_gradient(action, -self.log_prob(action))

    def _of_outputs(self, of_mean: Tensor, of_log_std: Tensor) -> Tensor:
        slope = self._bounds.half_range - self._tanh.square().mul_(self._bounds.half_range)
        raw_log_std = self._outputs[..., self._tanh.shape[-1] :]
        return torch.cat([of_mean * slope, of_log_std * _inside(raw_log_std)], dim=-1)


class SquashedGaussian:
    """Normal distribution squashed by tanh into the action range, for SAC (Haarnoja et al., 2018, appendix C).

    x = m + σ·ε, a = scale·tanh x + bias, ln π(a) = ln N(x) − Σ ln(scale·(1 − tanh² x) + 1e-6).
    """

    def __init__(self, space: Continuous, outputs: Tensor) -> None:
        """Condition on outputs [P, B, 2A] of an actor network."""
        A = space.size
        bounds = _bounds(space, outputs.device)
        self._scale, self._bias = bounds.half_range, bounds.middle
        self.mean, self._raw_log_std = outputs[..., :A], outputs[..., A:]
        self.log_std = _clamped_log_std(self._raw_log_std)
        self.std = torch.exp(self.log_std)

    def mode(self) -> Tensor:
        """Return the deterministic action [P, B, A]: the squashed mean."""
        return torch.addcmul(self._bias, torch.tanh(self.mean), self._scale)

    def sample(self, noise: Tensor) -> "SquashedSample":
        """Return the sample at standard normal noise [P, B, A]."""
        return SquashedSample(self, noise)


class SquashedSample:
    """One reparameterized sample a state: `actions` [P, B, A], `log_prob` [P, B, 1], and their gradients."""

    def __init__(self, policy: SquashedGaussian, noise: Tensor) -> None:
        self._policy, self._noise = policy, noise
        self._tanh = torch.addcmul(policy.mean, policy.std, noise).tanh_()
        self._slope = policy._scale - self._tanh.square().mul_(policy._scale)  # ∂a/∂x
        self.actions = torch.addcmul(policy._bias, self._tanh, policy._scale)
        log_normal = noise.square().mul_(-0.5).sub_(policy.log_std).sub_(_HALF_LOG_2_PI)
        self.log_prob = log_normal.sub_(torch.log(self._slope + _SQUASH_EPSILON)).sum(-1, keepdim=True)

    def gradient(self, of_actions: Tensor, of_log_prob: Tensor) -> Tensor:
        """Return ∂L/∂outputs [P, B, 2A] from ∂L/∂actions [P, B, A] and ∂L/∂ln π [P, B, 1], the noise held fixed."""
        policy = self._policy
        log_prob_slope = 2 * self._tanh * self._slope / (self._slope + _SQUASH_EPSILON)  # ∂ ln π/∂x
        of_x = of_actions * self._slope + of_log_prob * log_prob_slope
        of_log_std = of_x * policy.std * self._noise - of_log_prob
        return torch.cat([of_x, of_log_std * _inside(policy._raw_log_std)], dim=-1)


class Deterministic:
    """A deterministic action, scaled into the action range: a = scale·tanh z + bias. `actions` [P, B, A]."""

    def __init__(self, space: Continuous, outputs: Tensor) -> None:
        """Condition on outputs z [P, B, A] of an actor network."""
        self._bounds = _bounds(space, outputs.device)
        self._scale = self._bounds.half_range
        self._tanh = torch.tanh(outputs)
        self.actions = torch.addcmul(self._bounds.middle, self._tanh, self._scale)

    def perturbed(self, noise: Tensor) -> Tensor:
        """Return the actions with noise [P, B, A] in units of half the range added, clipped to the range."""
        return self._bounds.clamp_(torch.addcmul(self.actions, noise, self._scale))

    def gradient(self, of_actions: Tensor) -> Tensor:
        """Return ∂L/∂outputs [P, B, A] from ∂L/∂actions [P, B, A]."""
        return of_actions * self._scale * (1 - self._tanh.square())


class Softmax:
    """Boltzmann distribution over n actions with logits z: π(a) ∝ exp z_a."""

    def __init__(self, outputs: Tensor) -> None:
        """Condition on logits [P, B, n] of an actor network."""
        self.log_probs = torch.log_softmax(outputs, dim=-1)
        self.probs = torch.exp(self.log_probs)

    def sample(self, uniform: Tensor) -> Tensor:
        """Return action indices [P, B, 1] (float) for uniform numbers of that shape, by inversion."""
        below = self.probs.cumsum(dim=-1)[..., :-1] <= uniform
        return below.sum(dim=-1, keepdim=True).to(self.probs.dtype)

    def without_broken(self, actions: Tensor) -> Tensor:
        """Return action indices with NaN where the distribution itself is not finite: an action to be taken shows divergence."""
        return actions.masked_fill(self.probs.isnan().any(dim=-1, keepdim=True), torch.nan)

    def mode(self) -> Tensor:
        """Return the most probable action's index [P, B, 1] (float), the first of equal ones."""
        return self.log_probs.argmax(dim=-1, keepdim=True).to(self.probs.dtype)

    def log_prob(self, actions: Tensor) -> Tensor:
        """Return ln π [P, B, 1] of action indices [P, B, 1]."""
        return self.log_probs.gather(-1, actions.long())

    def log_prob_gradient(self, actions: Tensor) -> Tensor:
        """Return ∂/∂logits of ln π(a) [P, B, n] for action indices [P, B, 1]."""
        return torch.zeros_like(self.probs).scatter_(-1, actions.long(), 1.0).sub_(self.probs)

    def expectation_gradient(self, values: Tensor) -> Tensor:
        """Return ∂/∂logits of Σ_a π(a)·f(a) [P, B, n] for constant values f [P, B, n]."""
        return self.probs * (values - (self.probs * values).sum(dim=-1, keepdim=True))


def _clamped_log_std(raw: Tensor) -> Tensor:
    return raw.clamp(-_LOG_STD_LIMIT, _LOG_STD_LIMIT)


def _inside(raw_log_std: Tensor) -> Tensor:
    return raw_log_std.abs() <= _LOG_STD_LIMIT


@dataclass(frozen=True)
class _Bounds:
    """The action range of a space: [A] each, and as one number where it is the same in all dimensions."""

    low: Tensor
    high: Tensor
    middle: Tensor
    half_range: Tensor
    ends: tuple[float, float] | None

    def clamp_(self, actions: Tensor) -> Tensor:
        """Clamp actions [..., A] to the range in place; with numbers that is twice as fast as with tensors."""
        return actions.clamp_(*self.ends) if self.ends else torch.clamp(actions, self.low, self.high, out=actions)


@functools.cache
def _bounds(space: Continuous, device: torch.device) -> _Bounds:
    with torch.inference_mode(False):  # they serve algorithms with autograd, too
        low, high = (torch.tensor(end, dtype=torch.float32, device=device) for end in (space.low, space.high))
        ends = (space.low[0], space.high[0]) if len(set(space.low)) == len(set(space.high)) == 1 else None
        return _Bounds(low, high, (high + low) / 2, (high - low) / 2, ends)
