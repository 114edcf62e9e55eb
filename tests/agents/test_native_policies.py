"""A Gaussian policy on the native kernels is the one in PyTorch, which others compare with autograd, bit for bit."""

import math

import numpy as np
import pytest
import torch
from kernel_networks import variants

from agents import checkpoint, kernels
from agents.kernels import native
from agents.policies import Gaussian, SquashedGaussian
from agents.spaces import Continuous

pytestmark = pytest.mark.skipif(not native.library_file().exists(), reason="no native kernels here")

P, B = 3, 7


@pytest.fixture(params=variants())
def variant(request):
    return request.param


def action_space(size, one_range):
    low = (-2.0,) * size if one_range else tuple(-1.0 - 0.5 * a for a in range(size))
    return Continuous(low, tuple(2.0 if one_range else 1.5 + a for a in range(size)))


def outputs_of(size, seed=0):
    """A view. Some of them lie outside the range of ln σ, and one is not a number."""
    outputs = (torch.randn(P, B, 2 * size + 1, generator=torch.Generator().manual_seed(seed)) * 2)[..., 1:]
    outputs[0, :3, size:] = torch.tensor([9.0, -9.0, math.log(1000)])[:, None]
    outputs[1, 1, -1] = torch.nan
    return outputs


def same(one, other):
    """Equal bit for bit, NaN at the same places."""
    return torch.equal(one.isnan(), other.isnan()) and torch.equal(one.nan_to_num(), other.nan_to_num())


@pytest.mark.parametrize("one_range", [True, False])
@pytest.mark.parametrize("count", [1, 3, 4, 5, 30])
@pytest.mark.parametrize("size", [1, 2, 4, 6])
def test_samples_densities_and_gradients_are_pytorchs_bit_for_bit(variant, size, count, one_range):
    space, outputs = action_space(size, one_range), outputs_of(size)
    generator = torch.Generator().manual_seed(1)
    noise, weights = torch.randn(P, B, count, size, generator=generator) * 2, torch.randn(P, B, count, generator=generator)
    found = []
    for engine in (variant, "torch"):
        with kernels.using(engine):
            policy = Gaussian(space, outputs)
        actions, first = policy.sample(noise), noise[:, :, :1]  # a view of wider rows
        found.append(
            [
                actions,
                policy.sample_unclamped(noise),
                policy.sample(first),
                policy.log_prob(actions),
                policy.log_prob(first),
                policy.log_prob_gradient(actions, weights),
                policy.log_prob_gradient(actions, 1 / 3),
                policy.log_prob_gradient(first, weights[:, :, -1:]),
                policy.log_prob_gradient(actions.transpose(0, 1).contiguous().transpose(0, 1), weights),
                policy.sample(noise[:, :, ::2]),
                policy.sample(noise[:, :, :1].repeat_interleave(2, dim=3)[..., ::2]),
                policy.sample(noise[:, :, : max(1, count - 1)]),
                policy.log_prob(noise.transpose(2, 3).contiguous().transpose(2, 3)),
                policy.log_prob_gradient(actions, weights[:, :, :1]),  # one for all samples of a state
                policy.log_prob(actions.double()).float(),
                *(policy.entropy_gradient(estimate, first) for estimate in ("sampled", "analytic", "score")),
            ]
        )
    for index, (one, other) in enumerate(zip(*found, strict=True)):
        assert same(one, other), index
    assert found[0][0][1, 1].isnan().any() and not found[0][0][2].isnan().any()
    low, high = torch.tensor(space.low), torch.tensor(space.high)
    if count == 30:
        assert (found[0][0] == low).any() and (found[0][0] == high).any()


def test_the_kernels_do_what_is_asked_of_them(variant, monkeypatch):
    """Otherwise the test above would compare PyTorch with itself."""
    called, names = [], ("condition", "sample", "log_prob", "log_prob_gradient")
    with kernels.using(variant):
        library = kernels.library("cpu")
        for name in names:
            monkeypatch.setattr(library, f"gaussian_{name}", lambda *_, name=name: called.append(name))
        policy, actions = Gaussian(action_space(4, True), outputs_of(4)), torch.zeros(P, B, 4, 4)
        policy.log_prob_gradient(policy.sample(actions), policy.log_prob(actions))
    assert called == list(names)


def test_outputs_and_actions_of_another_size_are_refused(variant):
    space = action_space(2, True)
    with kernels.using(variant):
        for width in (2, 3, 5):
            with pytest.raises(ValueError, match=r"must be \[P, B, 4\]"):
                Gaussian(space, torch.zeros(P, B, width))
        policy = Gaussian(space, outputs_of(2))
        for wrong in (torch.zeros(P, B + 1, 3, 2), torch.zeros(P, B, 3, 3)):
            with pytest.raises(RuntimeError):
                policy.sample(wrong)


def test_whole_numbers_bound_an_action_space_as_well(variant):
    with kernels.using(variant):
        actions = Gaussian(Continuous((-3,), (3,)), outputs_of(1)).sample(torch.full((P, B, 1, 1), 1e6))
    assert actions[0].eq(3).all()


def test_what_is_computed_from_a_policy_is_its_own(variant):
    with kernels.using(variant):
        policy = Gaussian(action_space(2, True), outputs_of(2))
    with pytest.raises(AttributeError):
        policy.std = torch.ones(P, B, 2)


def test_a_policy_that_is_kept_is_kept_in_checkpoints(variant):
    space, noise = action_space(2, True), torch.zeros(P, B, 1, 2)
    with kernels.using(variant):
        one, other = Gaussian(space, outputs_of(2)), Gaussian(space, outputs_of(2, seed=1))
        state = {name: np.copy(value) for name, value in checkpoint.collect({"policy": one}).items()}
        assert not same(one.sample(noise), other.sample(noise))
        checkpoint.restore({"policy": other}, state)
        assert same(one.sample(noise), other.sample(noise))


def test_actions_and_weights_of_a_users_own_are_differentiated_by_autograd(variant):
    with kernels.using(variant):
        policy = Gaussian(action_space(1, True), torch.zeros(P, B, 2))
    actions = torch.full((P, B, 1, 1), 0.5, requires_grad=True)
    policy.log_prob(actions).sum().backward()
    torch.testing.assert_close(actions.grad, torch.full((P, B, 1, 1), -0.5))  # −(a − μ)/σ²
    weights = torch.ones(P, B, 1, requires_grad=True)
    policy.log_prob_gradient(actions.detach(), weights)[..., 0].sum().backward()
    torch.testing.assert_close(weights.grad, torch.full((P, B, 1), 0.5 * 2))  # (a − μ)/σ² · ∂μ/∂m


@pytest.mark.parametrize("policy", [Gaussian, SquashedGaussian])
def test_gradients_of_a_users_own_are_left_to_autograd(variant, policy):
    """An algorithm may differentiate through a policy's samples, with `agents.differentiable`.

    So it may after others were trained in this process, in inference mode: what they made is no good for autograd.
    """
    space, noise = Continuous((-9.0,), (9.125,)), torch.ones(P, B, 1)
    with kernels.using(variant), torch.inference_mode():
        policy(space, torch.zeros(P, B, 2))
    outputs = torch.zeros(P, B, 2, requires_grad=True)
    with kernels.using(variant):
        sample = policy(space, outputs).sample(noise if policy is SquashedGaussian else noise.unsqueeze(2))
    actions = sample.actions if policy is SquashedGaussian else sample
    actions.sum().backward()
    # a = middle + half·tanh m + σ·ε, or middle + half·tanh(m + σ·ε), at m = 0, ln σ = 0 and ε = 1
    half = 9.0625
    slope = half * (1 - math.tanh(1) ** 2)
    expected = [slope, slope] if policy is SquashedGaussian else [half, 1.0]
    torch.testing.assert_close(outputs.grad, torch.tensor(expected).expand(P, B, 2))
