import itertools
import math

import pytest
import torch
from torch import nn

from agents.kernels.arithmetic import Follower
from agents.networks import PopulationMLP, polyak_average_
from agents.optimizer import PopulationAdam

P, B = 3, 5


def network_and_twins(inputs, hidden, heads, seed=0):
    """A population network and P torch.nn networks with the same parameters."""
    generator = torch.Generator().manual_seed(seed)
    network = PopulationMLP(P, inputs, hidden, heads)
    network.initialize_(torch.rand(network.parameters.shape, generator=generator))
    for part in itertools.chain(*network.layers):
        part += 0.1 * torch.randn(part.shape, generator=generator)
    twins = []
    for p in range(P):
        layers = []
        for weights, biases in network.layers:
            layer = nn.Linear(*weights.shape[1:])
            layer.weight.data, layer.bias.data = weights[p].T.clone(), biases[p, 0].clone()
            layers += [layer, nn.ReLU()]
        twins.append(nn.Sequential(*layers[:-1]))
    return network, twins, generator


@pytest.mark.parametrize("hidden", [(8,), (64, 64), (16, 32, 16)])
def test_forward_and_backward_equal_torch_nn_with_autograd(hidden):
    network, twins, generator = network_and_twins(4, hidden, (2, 1))
    x = torch.randn(P, B, 4, generator=generator)
    weights = torch.randn(P, B, 3, generator=generator)
    outputs, kept = network.forward_for_gradient(x)
    input_gradient = network.backward(kept, weights, inputs=True)
    assert torch.equal(network.forward(x), outputs)
    for p, twin in enumerate(twins):
        z = x[p].clone().requires_grad_()
        y = twin(z)
        (y * weights[p]).sum().backward()
        torch.testing.assert_close(outputs[p], y, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(input_gradient[p], z.grad, rtol=1e-5, atol=1e-6)
        linears = [layer for layer in twin if isinstance(layer, nn.Linear)]
        for (weight_gradient, bias_gradient), layer in zip(network.gradient_layers, linears, strict=True):
            torch.testing.assert_close(weight_gradient[p], layer.weight.grad.T, rtol=1e-5, atol=1e-6)
            torch.testing.assert_close(bias_gradient[p, 0], layer.bias.grad, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("hidden", [(8,), (64, 64), (16, 32, 16)])
def test_regress_equals_torch_optim_on_the_mean_squared_error_and_an_average_of_its_parameters(hidden):
    network, twins, generator = network_and_twins(4, hidden, (1,))
    step_sizes, rates = [1e-1, 1e-2, 1e-3], [0.5, 0.01, 1.0]
    optimizer = PopulationAdam(network.parameters, torch.tensor(step_sizes))
    target = PopulationMLP(P, 4, hidden, (1,))
    target.parameters.copy_(network.parameters)
    follower = Follower(target.parameters, torch.tensor(rates)[:, None])
    theirs = [torch.optim.Adam(twin.parameters(), lr=one) for twin, one in zip(twins, step_sizes, strict=True)]
    averages = [[x.detach().clone() for x in twin.parameters()] for twin in twins]
    for _ in range(4):
        x, y = torch.randn(P, B, 4, generator=generator), torch.randn(P, B, 1, generator=generator)
        losses = network.regress(x, y, optimizer, follower)
        for p, twin in enumerate(twins):
            values = twin(x[p])
            theirs[p].zero_grad()
            loss = nn.functional.mse_loss(values, y[p])
            torch.testing.assert_close(losses[p], loss.detach(), rtol=1e-4, atol=1e-5)
            loss.backward()
            theirs[p].step()
            for average, now in zip(averages[p], twin.parameters(), strict=True):
                average.lerp_(now.detach(), rates[p])
    for p, twin in enumerate(twins):
        linears = [layer for layer in twin if isinstance(layer, nn.Linear)]
        for (weights, biases), layer in zip(network.layers, linears, strict=True):
            torch.testing.assert_close(weights[p], layer.weight.detach().T, rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(biases[p, 0], layer.bias.detach(), rtol=1e-4, atol=1e-5)
        followed = [part for weights, biases in target.layers for part in (weights[p].T, biases[p, 0])]
        for part, average in zip(followed, averages[p], strict=True):
            torch.testing.assert_close(part, average, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("num_actions", [1, 3])
@pytest.mark.parametrize("hidden", [(8,), (64, 64), (16, 32, 16)])
def test_values_of_actions_equal_the_forward_pass_on_every_pair(hidden, num_actions):
    network, _, generator = network_and_twins(4 + num_actions, hidden, (1,))
    states = torch.randn(P, B, 4, generator=generator)
    actions = torch.randn(P, B, 7, num_actions, generator=generator)
    pairs = torch.cat([states.unsqueeze(2).expand(P, B, 7, 4), actions], -1).flatten(1, 2)
    torch.testing.assert_close(
        network.values_of_actions(states, actions), network.forward(pairs).view(P, B, 7), rtol=1e-5, atol=1e-6
    )


def test_initial_weights_are_xavier_uniform_with_gain_root_two_and_each_head_on_its_own():
    network = PopulationMLP(200, 10, (64,), (1, 5))
    network.initialize_(torch.rand(network.parameters.shape, generator=torch.Generator().manual_seed(0)))
    (first, first_biases), (heads, head_biases) = network.layers
    for weights, fan_in, fan_out in ((first, 10, 64), (heads[:, :, :1], 64, 1), (heads[:, :, 1:], 64, 5)):
        limit = math.sqrt(2) * math.sqrt(6 / (fan_in + fan_out))
        assert weights.abs().max() <= limit
        assert weights.abs().max() > 0.99 * limit
        assert weights.std().item() == pytest.approx(limit / math.sqrt(3), rel=0.02)
    assert not first_biases.any() and not head_biases.any()


def test_polyak_averaging_moves_each_target_by_its_own_weight():
    target, online = torch.zeros(2, 3), torch.ones(2, 3)
    polyak_average_(target, online, torch.tensor([[0.25], [1.0]]))
    assert target.tolist() == [[0.25] * 3, [1.0] * 3]
