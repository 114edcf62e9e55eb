import math

import pytest
import torch
from torch.distributions import AffineTransform, Independent, Normal, TanhTransform, TransformedDistribution

from agents.policies import Gaussian, SquashedGaussian
from agents.spaces import Continuous

SPACE = Continuous((-1.0, 0.0), (2.0, 5.0))
LOW, HIGH = torch.tensor(SPACE.low), torch.tensor(SPACE.high)
P, B, N, A = 2, 4, 6, 2


@pytest.fixture
def outputs():
    return torch.randn(P, B, 2 * A, generator=torch.Generator().manual_seed(0))


def plain_normal(outputs):
    mean = LOW + (torch.tanh(outputs[..., :A]) + 1) / 2 * (HIGH - LOW)
    return Independent(Normal(mean.unsqueeze(2), outputs[..., A:].clamp(-math.log(1000), math.log(1000)).exp().unsqueeze(2)), 1)


def test_gaussian_samples_are_clamped_and_their_density_is_the_normal_one_at_the_clamped_action(outputs):
    noise = 3 * torch.randn(P, B, N, A, generator=torch.Generator().manual_seed(1))
    policy, normal = Gaussian(SPACE, outputs), plain_normal(outputs).base_dist
    actions = policy.sample(noise)
    expected = torch.minimum(torch.maximum(normal.mean + normal.stddev * noise, LOW), HIGH)
    torch.testing.assert_close(actions, expected)
    assert (actions == LOW).any() and (actions == HIGH).any()
    torch.testing.assert_close(policy.log_prob(actions), plain_normal(outputs).log_prob(actions), rtol=1e-5, atol=1e-5)


def test_gaussian_log_prob_gradient_equals_autograd(outputs):
    generator = torch.Generator().manual_seed(2)
    actions, weights = torch.randn(P, B, N, A, generator=generator), torch.randn(P, B, N, generator=generator)
    z = outputs.clone().requires_grad_()
    (plain_normal(z).log_prob(actions) * weights).sum().backward()
    torch.testing.assert_close(Gaussian(SPACE, outputs).log_prob_gradient(actions, weights), z.grad, rtol=1e-4, atol=1e-4)


def test_gaussian_entropy_gradient_equals_autograd(outputs):
    z = outputs.clone().requires_grad_()
    plain_normal(z).entropy().sum().backward()
    torch.testing.assert_close(Gaussian(SPACE, outputs).entropy_gradient("analytic", torch.zeros(P, B, 1, A)), z.grad)


def test_log_std_is_clamped_at_ln_1000_with_zero_gradient_outside():
    outputs = torch.tensor([[[0.0, 0.0, 7.0, -6.0]]])
    policy = Gaussian(SPACE, outputs)
    torch.testing.assert_close(policy.std[0, 0], torch.tensor([1000.0, math.exp(-6.0)]))
    gradient = policy.log_prob_gradient(torch.ones(1, 1, 1, 2), torch.ones(1, 1, 1))
    assert gradient[0, 0, 2] == 0 and gradient[0, 0, 3] != 0
    sample = SquashedGaussian(SPACE, outputs).sample(torch.ones(1, 1, 2))
    assert sample.gradient(torch.ones(1, 1, 2), torch.ones(1, 1, 1))[0, 0, 2] == 0


def test_squashed_gaussian_density_equals_a_transformed_normal(outputs):
    noise = torch.randn(P, B, A, generator=torch.Generator().manual_seed(3))
    sample = SquashedGaussian(SPACE, outputs).sample(noise)
    transforms = [TanhTransform(), AffineTransform((LOW + HIGH) / 2, (HIGH - LOW) / 2, event_dim=0)]
    squashed = TransformedDistribution(Normal(outputs[..., :A].double(), outputs[..., A:].double().exp()), transforms)
    x = outputs[..., :A].double() + outputs[..., A:].double().exp() * noise
    inside = (torch.tanh(x).abs() < 0.99).all(-1)  # further out the 1e-6 in the logarithm, and float32, are felt
    assert inside.sum() >= 4
    torch.testing.assert_close(
        sample.actions.double()[inside],
        ((LOW + HIGH) / 2 + (HIGH - LOW) / 2 * torch.tanh(x))[inside],
        rtol=1e-5,
        atol=1e-5,
    )
    expected = squashed.log_prob(sample.actions.double()).sum(-1, keepdim=True)
    torch.testing.assert_close(sample.log_prob.double()[inside], expected[inside], rtol=1e-3, atol=1e-3)


def test_squashed_gaussian_gradient_equals_autograd(outputs):
    generator = torch.Generator().manual_seed(4)
    outputs = outputs / 2  # where tanh saturates, 1 − tanh² loses its digits in float32
    noise, of_actions = torch.randn(P, B, A, generator=generator), torch.randn(P, B, A, generator=generator)
    of_log_prob = torch.randn(P, B, 1, generator=generator)
    z = outputs.double().requires_grad_()
    std = z[..., A:].exp()
    x = z[..., :A] + std * noise
    scale = (HIGH - LOW) / 2
    log_prob = Normal(z[..., :A], std).log_prob(x) - torch.log(scale * (1 - torch.tanh(x) ** 2) + 1e-6)
    loss = (scale * torch.tanh(x) * of_actions).sum() + (log_prob.sum(-1, keepdim=True) * of_log_prob).sum()
    loss.backward()
    gradient = SquashedGaussian(SPACE, outputs).sample(noise).gradient(of_actions, of_log_prob)
    torch.testing.assert_close(gradient.double(), z.grad, rtol=1e-3, atol=1e-4)
