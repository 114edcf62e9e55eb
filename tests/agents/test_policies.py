import math

import pytest
import torch
from torch.distributions import AffineTransform, Independent, Normal, TanhTransform, TransformedDistribution

from agents.policies import Gaussian, Softmax, SquashedGaussian
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


def test_the_squashed_density_integrates_to_one_and_gives_the_right_mean():
    """The correction of the density against numerical integration over the actions, on a grid fine at both ends."""
    space = Continuous((-1.0,), (3.0,))
    for mean, log_std in ((0.0, -0.5), (0.8, 0.0), (-1.0, -1.5)):
        std = math.exp(log_std)
        noise = torch.linspace(-5, 5, 20_001, dtype=torch.float64)
        outputs = torch.tensor([mean, log_std], dtype=torch.float64).expand(1, len(noise), 2)
        sample = SquashedGaussian(space, outputs).sample(noise.view(1, -1, 1))
        actions, density = sample.actions.flatten().double(), sample.log_prob.flatten().double().exp()
        assert torch.trapezoid(density, actions).item() == pytest.approx(1.0, abs=1e-3)
        weights = torch.exp(-0.5 * noise**2) / math.sqrt(2 * math.pi)
        expected = torch.trapezoid(weights * (1 + 2 * torch.tanh(mean + std * noise)), noise).item()
        assert torch.trapezoid(density * actions, actions).item() == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(("estimate", "expected_log_std"), [("analytic", 1.0), ("sampled", 1.0), ("score", 0.0)])
def test_entropy_gradients_have_their_expectations_in_closed_form(estimate, expected_log_std):
    """H = Σ ln σ + const, so ∂H/∂μ = 0 and ∂H/∂ln σ = 1; E[−∇ln π(a)] = 0. The actions are far from being clamped."""
    count = 200_000
    space = Continuous((-100.0,), (100.0,))
    outputs = torch.tensor([0.01, -0.3]).expand(1, count, 2)
    noise = torch.randn(1, count, 1, 1, generator=torch.Generator().manual_seed(0))
    gradient = Gaussian(space, outputs).entropy_gradient(estimate, noise)[0].double()
    mean, error = gradient.mean(0), gradient.std(0) / math.sqrt(count)
    slope = 100 * (1 - math.tanh(0.01) ** 2)  # ∂μ/∂m
    assert abs(mean[0] / slope) <= 4 * error[0] / slope + 1e-12
    assert abs(mean[1] - expected_log_std) <= 4 * error[1] + 1e-6


def test_the_score_estimate_is_biased_toward_what_clamping_takes_away():
    """Clamped at ±1 with σ = 2, −∂ln π/∂ln σ = 1 − u² has the expectation 1 − E[min(|x|, 1)²]/σ², by integration."""
    count, std = 200_000, 2.0
    outputs = torch.tensor([0.0, math.log(std)]).expand(1, count, 2)
    noise = torch.randn(1, count, 1, 1, generator=torch.Generator().manual_seed(0))
    gradient = Gaussian(Continuous((-1.0,), (1.0,)), outputs).entropy_gradient("score", noise)[0, :, 1].double()
    x = torch.linspace(-20, 20, 400_001, dtype=torch.float64)
    weights = torch.exp(-0.5 * (x / std) ** 2) / (std * math.sqrt(2 * math.pi))
    expected = 1 - torch.trapezoid(weights * x.abs().clamp(max=1) ** 2, x).item() / std**2
    assert abs(gradient.mean() - expected) < 4 * gradient.std() / math.sqrt(count)
    assert expected > 0.5


def test_softmax_equals_torch_categorical_and_autograd():
    generator = torch.Generator().manual_seed(5)
    logits, values = torch.randn(P, B, 4, generator=generator), torch.randn(P, B, 4, generator=generator)
    actions = torch.randint(4, (P, B, 1), generator=generator).float()
    policy, z = Softmax(logits), logits.clone().requires_grad_()
    categorical = torch.distributions.Categorical(logits=z)
    torch.testing.assert_close(policy.log_prob(actions).squeeze(-1), categorical.log_prob(actions.squeeze(-1)))
    (of_log_prob,) = torch.autograd.grad(categorical.log_prob(actions.squeeze(-1)).sum(), z, retain_graph=True)
    torch.testing.assert_close(policy.log_prob_gradient(actions), of_log_prob)
    (of_expectation,) = torch.autograd.grad((categorical.probs * values).sum(), z)
    torch.testing.assert_close(policy.expectation_gradient(values), of_expectation)


def test_softmax_samples_actions_as_often_as_their_probabilities_say():
    logits = torch.tensor([1.0, -1.0, 0.5]).expand(1, 100_000, 3)
    uniform = torch.rand(1, 100_000, 1, generator=torch.Generator().manual_seed(6))
    drawn = Softmax(logits).sample(uniform).flatten().long().bincount(minlength=3) / 100_000
    torch.testing.assert_close(drawn, torch.softmax(logits[0, 0], 0), atol=6e-3, rtol=0)
    assert Softmax(logits).sample(torch.full_like(uniform, 1.0)).max() == 2
