"""Critics on their own: a step of learning, and what follows it."""

import pytest
import torch

from agents import kernels
from agents.algorithm import Task
from agents.critic import Critic
from agents.hypers import SACHypers
from agents.population import Population
from agents.replay import Batch
from agents.spaces import Continuous, Discrete

P, B, S = 3, 8, 4
STEP_SIZES, POLYAKS = (1e-1, 1e-2, 1e-3), (0.01, 0.5, 1.0)


@pytest.fixture(params=["auto", "torch"])
def engine(request):
    with kernels.using(request.param):
        yield


def critic(space, double):
    hypers = tuple(
        SACHypers(critic_step_size=step_size, polyak=polyak, discrete_critic_input="one-hot")
        for step_size, polyak in zip(STEP_SIZES, POLYAKS, strict=True)
    )
    population = Population(hypers, (0, 1, 2), torch.device("cpu"))
    return Critic(population, Task(S, space, 0.9), population.stream(), double=double)


def random_batch(seed):
    generator = torch.Generator().manual_seed(seed)
    states, actions = torch.randn(P, B, S, generator=generator), torch.randint(3, (P, B, 1), generator=generator).float()
    rewards, continues = torch.randn(P, B, 1, generator=generator), torch.ones(P, B, 1)
    return Batch(states, actions, torch.cat([states, actions], -1), rewards, continues, states.flip(1))


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("space", [Continuous((-1.0,), (2.0,)), Discrete(3)])
def test_learning_moves_the_target_as_update_target_does_and_only_when_asked_to(space, double):
    one, other = critic(space, double), critic(space, double)
    for seed in range(3):
        batch, before = random_batch(seed), other.target.parameters.clone()
        next_values = batch.rewards.flip(1)
        loss = one.learn(batch, next_values, moves_target=True)
        assert torch.equal(other.learn(batch, next_values), loss)
        assert torch.equal(other.target.parameters, before)
        other.update_target()
        assert not torch.equal(other.target.parameters, before)
        assert torch.equal(one.online.parameters, other.online.parameters)
        assert torch.equal(one.target.parameters, other.target.parameters)
    fully = other.target.parameters.view(P, -1)[2]
    torch.testing.assert_close(fully, other.online.parameters.view(P, -1)[2], rtol=1e-5, atol=1e-6)


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("double", [False, True])
def test_the_loss_is_the_mean_squared_error_of_each_critic_added_up(double):
    made, batch = critic(Continuous((-1.0,), (2.0,)), double), random_batch(0)
    count = 2 if double else 1
    pairs = batch.states_actions.repeat_interleave(count, dim=0)
    values = made.online.forward(pairs).clone().double().view(P, count, B)
    targets = (batch.rewards + 0.9 * batch.rewards.flip(1)).double().view(P, 1, B)
    expected = ((values - targets) ** 2).mean(dim=2).sum(dim=1)
    loss = made.learn(batch, batch.rewards.flip(1))
    torch.testing.assert_close(loss.double(), expected, rtol=1e-5, atol=0)
