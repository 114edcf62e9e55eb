import torch
from torch import nn

from agents.differentiable import differentiable, take_gradient
from agents.hypers import GreedyACHypers
from agents.networks import PopulationMLP
from agents.policies import Softmax
from agents.registry import ALGORITHMS
from agents.training import Run


def test_gradients_under_autograd_equal_those_of_torch_nn_even_through_two_passes():
    generator = torch.Generator().manual_seed(0)
    network = PopulationMLP(3, 4, (16, 8), (2,))
    network.initialize_(torch.rand(network.parameters.shape, generator=generator))
    first, second = torch.randn(2, 3, 5, 4, generator=generator).unbind()
    inputs = first.clone().requires_grad_()
    outputs = differentiable(network, inputs)
    ((outputs**2).mean(1).sum() + (outputs * differentiable(network, second)).sum()).backward()
    gradient = take_gradient(network)
    for p in range(3):
        layers = []
        for weights, biases in network.layers:
            layer = nn.Linear(*weights.shape[1:])
            layer.weight.data, layer.bias.data = weights[p].detach().T.clone(), biases[p, 0].detach().clone()
            layers += [layer, nn.ReLU()]
        twin = nn.Sequential(*layers[:-1])
        x = first[p].clone().requires_grad_()
        y = twin(x)
        ((y**2).mean(0).sum() + (y * twin(second[p])).sum()).backward()
        torch.testing.assert_close(inputs.grad[p], x.grad, rtol=1e-4, atol=1e-5)
        for (weights, biases), layer in zip(network._views(gradient), layers[::2], strict=True):
            torch.testing.assert_close(weights[p], layer.weight.grad.T, rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(biases[p, 0], layer.bias.grad, rtol=1e-4, atol=1e-5)
    assert network.parameters.grad is None
    differentiable(network, inputs, parameters=False).sum().backward()
    assert network.parameters.grad is None


def test_an_algorithm_may_learn_by_autograd_inside_the_training_loop(monkeypatch):
    """One that says nothing of itself; those that say they need no autograd run in inference mode, where it is off for good."""
    greedy, modes = ALGORITHMS["GreedyAC"].load(), []

    class ByAutograd(greedy):
        def _update_discrete_actor(self, states):
            modes.append(torch.is_inference_mode_enabled())
            best = self.critic.values_of_all_actions(states).argmax(dim=2, keepdim=True).to(states.dtype)
            with torch.enable_grad():
                log_probs = Softmax(differentiable(self.actor.network, states)).log_prob(best)
                (-log_probs.mean(1).sum()).backward()
            self.actor.optimizer.step_(take_gradient(self.actor.network))

    class Spy(greedy):
        capturable = True

        def _update_discrete_actor(self, states):
            modes.append(torch.is_inference_mode_enabled())
            super()._update_discrete_actor(states)

    trained = []
    for algorithm in (ByAutograd, Spy):
        monkeypatch.setattr(type(ALGORITHMS["GreedyAC"]), "load", lambda self, algorithm=algorithm: algorithm)
        run = Run("GreedyAC", "Pendulum-DA", [GreedyACHypers(batch_size=4)] * 2, [0, 1], steps=6)
        start = run._lockstep.agents.actor.network.parameters.clone()
        run.advance(6)
        trained.append(run._lockstep.agents.actor.network.parameters)
        assert not torch.equal(trained[-1], start)
    torch.testing.assert_close(*trained, rtol=1e-4, atol=1e-6)
    assert modes == [False] * 3 + [True] * 3
    Run("GreedyAC", "CartPole-v1", [GreedyACHypers(batch_size=4)] * 2, [0, 1], steps=4).advance(4)
    assert modes[-1] is False  # an environment of one's own may learn something by autograd, too
