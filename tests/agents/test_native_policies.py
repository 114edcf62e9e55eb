"""A Gaussian policy on the native kernels is the one in PyTorch, which others compare with autograd, bit for bit."""

import math

import pytest
import torch
from kernel_networks import variants

from agents import kernels
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
    """Some of them lie outside the range of ln σ, and one is not a number."""
    outputs = torch.randn(P, B, 2 * size, generator=torch.Generator().manual_seed(seed)) * 2
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
                policy.log_prob_gradient(actions, weights),
                policy.log_prob_gradient(actions, 1 / 3),
                policy.log_prob_gradient(first, weights[:, :, -1:]),
                policy.log_prob_gradient(actions.transpose(0, 1).contiguous().transpose(0, 1), weights),
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
    called = []
    with kernels.using(variant):
        library = kernels.library("cpu")
        for name in ("gaussian_sample", "gaussian_log_prob", "gaussian_log_prob_gradient"):
            monkeypatch.setattr(library, name, lambda *_, name=name: called.append(name))
        policy = Gaussian(action_space(2, True), outputs_of(2))
        policy.log_prob_gradient(policy.sample(torch.zeros(P, B, 3, 2)), policy.log_prob(torch.zeros(P, B, 3, 2)))
    assert called == ["gaussian_sample", "gaussian_log_prob", "gaussian_log_prob_gradient"]


def test_what_a_kernel_would_misread_is_refused(variant):
    with kernels.using(variant):
        policy = Gaussian(action_space(2, True), outputs_of(2))
    for wrong in (torch.zeros(P, B, 3, 1), torch.zeros(P, B + 1, 3, 2), torch.zeros(P, B, 3, 2).double(), torch.zeros(P, B, 2)):
        with pytest.raises(ValueError, match=r"must be \[3, 7, N, 2\]"):
            policy.sample(wrong)
    with pytest.raises(ValueError, match="weights"):
        policy.log_prob_gradient(torch.zeros(P, B, 3, 2), torch.zeros(P, B, 2))


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
