"""The populations' updates against plain single agents with autograd and torch.optim.Adam."""

import itertools

import pytest
import torch
from plain_agents import PlainGreedyAC, PlainSAC

from agents.algorithm import Task
from agents.algorithms.greedy_ac import GreedyAC
from agents.algorithms.sac import SAC
from agents.hypers import GreedyACHypers, SACHypers
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose
from agents.spaces import Continuous

P, B, S = 3, 8, 4
STEP_SIZES, SCALES, POLYAKS = (1e-2, 1e-3, 3e-4), (0.1, 1.0, 2.0), (0.01, 0.5, 0.1)
# Not 1: where all elites and the action of the "score" estimate are clamped, gradients cancel to 0 or 1e-9, and Adam makes a
# whole step of it.
ENTROPY_SCALES = (0.01, 0.7, 10.0)


def stacked_hypers(cls, **shared):
    return tuple(
        cls(critic_step_size=a, actor_step_size_scale=k, entropy_scale=t, polyak=b, batch_size=B, **shared)
        for a, k, t, b in zip(STEP_SIZES, SCALES, ENTROPY_SCALES, POLYAKS, strict=True)
    )


def random_batch(generator, num_actions):
    states = torch.randn(P, B, S, generator=generator)
    actions = torch.rand(P, B, num_actions, generator=generator) * 2 - 1
    return Batch(
        states=states,
        actions=actions,
        states_actions=torch.cat([states, actions], -1),
        rewards=torch.randn(P, B, 1, generator=generator),
        continues=(torch.rand(P, B, 1, generator=generator) > 0.3).float(),
        next_states=torch.randn(P, B, S, generator=generator),
    )


def linears(module):
    return [layer for layer in module.modules() if isinstance(layer, torch.nn.Linear)]


def copy_into(module, network, row):
    """Copy one agent's parameters from a population network into a plain one; heads lie side by side."""
    layers = linears(module)
    with torch.no_grad():
        for layer, (weights, biases) in zip(layers, network.layers[: len(layers)], strict=False):
            if layer.weight.shape == weights[row].T.shape:
                layer.weight.copy_(weights[row].T)
                layer.bias.copy_(biases[row, 0])
        weights, biases = network.layers[-1]
        heads = layers[len(network.layers) - 1 :]
        for head, w, b in zip(
            heads,
            weights[row].split([h.out_features for h in heads], 1),
            biases[row, 0].split([h.out_features for h in heads]),
            strict=True,
        ):
            head.weight.copy_(w.T)
            head.bias.copy_(b)


def assert_same(module, network, row):
    layers = linears(module)
    heads = layers[len(network.layers) - 1 :]
    plain = [(layer.weight.T, layer.bias) for layer in layers[: len(network.layers) - 1]]
    plain.append((torch.cat([head.weight.T for head in heads], 1), torch.cat([head.bias for head in heads])))
    for (weights, biases), (plain_weights, plain_biases) in zip(network.layers, plain, strict=True):
        distance = torch.cat([(weights[row] - plain_weights).flatten(), biases[row, 0] - plain_biases]).norm()
        assert distance <= 1e-5 * torch.cat([plain_weights.flatten(), plain_biases]).norm()


@pytest.mark.parametrize(
    ("entropy_gradient", "hidden_layers", "num_actions"),
    [*itertools.product(("sampled", "analytic", "score"), ((64, 64), (64, 64, 64)), (1,)), ("sampled", (32,), 2)],
)
def test_greedy_ac_equals_a_plain_agent_after_five_updates(entropy_gradient, hidden_layers, num_actions):
    hypers = stacked_hypers(GreedyACHypers, entropy_gradient=entropy_gradient, hidden_layers=hidden_layers)
    space = Continuous((-1.0,) * num_actions, (2.0,) * num_actions)
    population = Population(hypers, (3, 1, 4), torch.device("cpu"))
    stream = population.stream()
    agents = GreedyAC(population, Task(S, space, 0.99), stream)
    plain = [PlainGreedyAC(h, S, torch.tensor(space.low), torch.tensor(space.high)) for h in hypers]
    for p, agent in enumerate(plain):
        for name in ("critic", "target", "actor", "proposal"):
            copy_into(getattr(agent, name), getattr(agents, name), p)
    generator = torch.Generator().manual_seed(0)
    for step in range(1, 6):
        batch = random_batch(generator, num_actions)
        with torch.no_grad():
            losses = agents.update(batch, step)
        for p, agent in enumerate(plain):
            noise = {
                "next": stream.normals(Purpose.NEXT_ACTION, step, B * num_actions)[p].view(B, num_actions),
                "policy": stream.normals(Purpose.POLICY_UPDATE, step, B * 30 * num_actions)[p].view(B, 30, num_actions),
            }
            loss = agent.update(
                batch.states[p],
                batch.actions[p],
                batch.rewards[p],
                batch.continues[p],
                batch.next_states[p],
                noise,
                0.99,
            )
            assert losses[p].item() == pytest.approx(loss, rel=1e-4)
    for p, agent in enumerate(plain):
        for name in ("critic", "target", "actor", "proposal"):
            assert_same(getattr(agent, name), getattr(agents, name), p)


@pytest.mark.parametrize(("hidden_layers", "num_actions"), [((64, 64), 1), ((64, 64, 64), 1), ((32,), 2)])
def test_sac_equals_a_plain_agent_after_five_updates(hidden_layers, num_actions):
    hypers = stacked_hypers(SACHypers, hidden_layers=hidden_layers)
    space = Continuous((-1.0,) * num_actions, (2.0,) * num_actions)
    population = Population(hypers, (3, 1, 4), torch.device("cpu"))
    stream = population.stream()
    agents = SAC(population, Task(S, space, 0.99), stream)
    plain = [PlainSAC(h, S, torch.tensor(space.low), torch.tensor(space.high)) for h in hypers]
    for p, agent in enumerate(plain):
        copy_into(agent.actor, agents.actor, p)
        for i in (0, 1):
            copy_into(agent.critics[i], agents.critics, 2 * p + i)
            copy_into(agent.targets[i], agents.targets, 2 * p + i)
    generator = torch.Generator().manual_seed(0)
    for step in range(1, 6):
        batch = random_batch(generator, num_actions)
        with torch.no_grad():
            losses = agents.update(batch, step)
        for p, agent in enumerate(plain):
            noise = {
                "next": stream.normals(Purpose.NEXT_ACTION, step, B * num_actions)[p].view(B, num_actions),
                "policy": stream.normals(Purpose.POLICY_UPDATE, step, B * num_actions)[p].view(B, num_actions),
            }
            loss = agent.update(
                batch.states[p],
                batch.actions[p],
                batch.rewards[p],
                batch.continues[p],
                batch.next_states[p],
                noise,
                0.99,
            )
            assert losses[p].item() == pytest.approx(loss, rel=1e-4)
    for p, agent in enumerate(plain):
        assert_same(agent.actor, agents.actor, p)
        for i in (0, 1):
            assert_same(agent.critics[i], agents.critics, 2 * p + i)
            assert_same(agent.targets[i], agents.targets, 2 * p + i)


def test_the_two_critics_of_a_sac_agent_start_differently_and_the_proposal_as_the_actor():
    population = Population(stacked_hypers(SACHypers), (0, 1, 2), torch.device("cpu"))
    task = Task(S, Continuous((-1.0,), (1.0,)), 0.99)
    critics = SAC(population, task, population.stream()).critics.parameters
    assert not torch.equal(critics[0], critics[1])
    population = Population(stacked_hypers(GreedyACHypers), (0, 1, 2), torch.device("cpu"))
    agents = GreedyAC(population, task, population.stream())
    assert torch.equal(agents.actor.parameters, agents.proposal.parameters)
    assert torch.equal(agents.critic.parameters, agents.target.parameters)
