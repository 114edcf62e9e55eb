"""Action-value critics of a population, with their target networks: what the actor-critic algorithms of the thesis share.

One critic or two an agent ("double"): the value of a pair is then the smaller of the two, and the critics of agent p are the
networks 2p and 2p + 1. With discrete actions an action enters as its index or one-hot (`discrete_critic_input`).
"""

import torch
from torch import Tensor

from agents.algorithm import Task
from agents.kernels.arithmetic import Activations, Follower
from agents.networks import PopulationMLP, polyak_average_
from agents.optimizer import PopulationAdam
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose, RandomStream
from agents.spaces import Discrete


class Critic:
    """q_θ (and q_θ1, q_θ2 if `double`) of P agents, initialized with the networks numbered from 0."""

    def __init__(
        self, population: Population, task: Task, stream: RandomStream, *, double: bool = False, target: bool = True
    ) -> None:
        """`double`: two critics an agent. Without a `target`, nothing that asks for it is to be called."""
        hypers = population.shared
        self.count = 2 if double else 1
        self.task = task
        self._one_hot = isinstance(task.actions, Discrete) and hypers.discrete_critic_input == "one-hot"
        inputs = task.observation_size + (task.actions.count if self._one_hot else task.actions.size)  # type: ignore[union-attr]
        size = (self.count * len(population), inputs, hypers.hidden_layers, (1,), population.device)
        self.online = PopulationMLP(*size)
        num_weights = self.online.parameters.shape[1]
        uniform = [stream.uniforms(Purpose.INITIAL_WEIGHTS, index, num_weights) for index in range(self.count)]
        self.online.initialize_(torch.stack(uniform, dim=1).flatten(0, 1))
        if target:
            self.target = PopulationMLP(*size)
            self.target.parameters.copy_(self.online.parameters)
        self.optimizer = PopulationAdam(self.online.parameters, self._each(population.stacked("critic_step_size")))
        self._polyak = self._each(population.stacked("polyak")[:, None])

    def target_values(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return q_targ (the smaller) [P, B, 1] of states [P, B, S] and actions [P, B, A]."""
        return self.smaller(self.target.forward(self._each(self._pairs(states, actions))))

    def values(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return q (the smaller) [P, B, 1] of states [P, B, S] and actions [P, B, A]."""
        return self.smaller(self.online.forward(self._each(self._pairs(states, actions))))

    def values_of_actions(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return q (the smaller) [P, B, N] of states [P, B, S], each with N actions [P, B, N, A] (encoded, if discrete)."""
        return self.smaller(self.online.values_of_actions(self._each(states), self._each(actions)))

    def values_of_all_actions(self, states: Tensor, *, target: bool = False) -> Tensor:
        """Return q (the smaller), or q_targ, [P, B, n] of every discrete action."""
        assert isinstance(self.task.actions, Discrete)
        every = torch.arange(self.task.actions.count, dtype=states.dtype, device=states.device).view(1, 1, -1, 1)
        every = self._encoded(every)
        network, actions = self.target if target else self.online, every.expand(*states.shape[:2], *every.shape[2:])
        return self.smaller(network.values_of_actions(self._each(states), self._each(actions)))

    def learn(self, batch: Batch, next_values: Tensor, *, moves_target: bool = False) -> Tensor:
        """Descend the mean of (R + γ·continues·v' − q_i(S, A))² for the values v' [P, B, 1] of S'; return the loss [P].

        With a double critic the losses add up. `moves_target`: what `update_target` does follows at once, while an agent's
        parameters are in the cache; without it, targets do not move.
        """
        targets = batch.rewards + self.task.discount * batch.continues * next_values
        pairs = self._pairs(batch.states, batch.actions) if self._one_hot else batch.states_actions
        target = Follower(self.target.parameters, self._polyak) if moves_target else None
        # the mean of the squared error, not of its half as the thesis prints: with Adam the factor cancels but for ε
        losses = self.online.regress(self._each(pairs), self._each(targets), self.optimizer, target)
        return losses if self.count == 1 else losses.view(-1, 2).sum(dim=1)

    def update_target(self) -> None:
        """θ_targ ← (1 − β)·θ_targ + β·θ."""
        polyak_average_(self.target.parameters, self.online.parameters, self._polyak)

    def evaluate(self, states: Tensor, actions: Tensor) -> "Valuation":
        """Return q (the smaller) of states [P, B, S] and actions [P, B, A], differentiable with respect to the actions."""
        outputs, kept = self.online.forward_for_gradient(self._each(self._pairs(states, actions)))
        return Valuation(self, outputs, kept)

    def _each(self, x: Tensor) -> Tensor:
        """Return [count · P, …]: every agent's slice once for each of its critics."""
        return x if self.count == 1 else x.repeat_interleave(self.count, dim=0)

    def smaller(self, values: Tensor) -> Tensor:
        """Return the smaller of an agent's values [count · P, …] → [P, …]."""
        return values if self.count == 1 else values.view(-1, 2, *values.shape[1:]).amin(dim=1)

    def _pairs(self, states: Tensor, actions: Tensor) -> Tensor:
        return torch.cat([states, self._encoded(actions)], dim=-1)

    def _encoded(self, actions: Tensor) -> Tensor:
        if not self._one_hot:
            return actions
        assert isinstance(self.task.actions, Discrete)
        return (actions == torch.arange(self.task.actions.count, device=actions.device)).to(actions.dtype)


class Valuation:
    """One pass through the critic: `values` [P, B, 1], and their gradient with respect to the actions."""

    def __init__(self, critic: Critic, outputs: Tensor, kept: Activations) -> None:
        self._critic, self._outputs, self._kept = critic, outputs, kept
        self.values = critic.smaller(outputs)

    def action_gradient(self, of_values: Tensor) -> Tensor:
        """Return ∂L/∂actions [P, B, A] from ∂L/∂values [P, B, 1]; nothing is learned. Only the smaller of two critics counts."""
        critic = self._critic
        of_outputs = of_values
        if critic.count == 2:
            first, second = self._outputs.view(-1, 2, *self._outputs.shape[1:]).unbind(dim=1)
            is_first = (first <= second).to(of_values.dtype)
            of_outputs = torch.stack([of_values * is_first, of_values * (1 - is_first)], dim=1).flatten(0, 1)
        of_inputs = critic.online.backward(self._kept, of_outputs, parameters=False, inputs=True)
        assert of_inputs is not None
        of_actions = of_inputs[..., critic.task.observation_size :]
        return of_actions if critic.count == 1 else of_actions.view(-1, 2, *of_actions.shape[1:]).sum(dim=1)
