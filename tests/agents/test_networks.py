import itertools
import math

import pytest
import torch
from torch import nn

from agents.networks import PopulationMLP, polyak_average_

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
