"""Soft Actor-Critic as first published (thesis Algorithm 2; Haarnoja et al., 2018), "SAC-original".

Beside two soft action-value critics it learns a state-value network v and its target, which alone bootstraps. Continuous
actions: squashed Gaussian actor, reparameterized gradient. Discrete: softmax actor, exact expectation over the actions.
Shapes: population P, batch B, action dimensions A.

Step-sizes: α_state = `state_value_step_size`, α_action = `critic_step_size`, α_actor = κ · α_action.

Deviations from the printed pseudo-code:
- Lines 11, 14 and 18 add the gradients of losses; they are descended here.
- Line 13 knows no termination: y = R + γ·continues·v_targ(S').
"""

import torch
from torch import Tensor

from agents.actor import Actor
from agents.algorithm import Task
from agents.critic import Critic
from agents.networks import PopulationMLP, polyak_average_
from agents.optimizer import PopulationAdam
from agents.policies import Softmax, SquashedGaussian
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose, RandomStream
from agents.spaces import Continuous, Discrete


class SACOriginal:
    """P SAC-original agents in lock-step."""

    def __init__(self, population: Population, task: Task, stream: RandomStream) -> None:
        """Initialize θ_1, θ_2, w, w_targ, φ (line 2)."""
        P, hypers = len(population), population.shared
        self.space = task.actions
        self.entropy_scale = population.stacked("entropy_scale")[:, None, None]
        self.polyak = population.stacked("polyak")[:, None]
        self.critic = Critic(population, task, stream, double=True)
        self.actor = Actor(population, task, stream, network=2)
        self.value = PopulationMLP(P, task.observation_size, hypers.hidden_layers, (1,), population.device)
        self.target = PopulationMLP(P, task.observation_size, hypers.hidden_layers, (1,), population.device)
        self.value.initialize_(stream.uniforms(Purpose.INITIAL_WEIGHTS, 3, self.value.parameters.shape[1]))
        self.target.parameters.copy_(self.value.parameters)
        self.value_optimizer = PopulationAdam(self.value.parameters, population.stacked("state_value_step_size"))

    def act(self, observations: Tensor, step: int) -> Tensor:
        """Draw A ~ π(·|S) (line 6)."""
        states = observations.unsqueeze(1)
        if isinstance(self.space, Discrete):
            return self.actor.sample(states, Purpose.ACTION, step).squeeze(1)
        return self.actor.sample_squashed(states, Purpose.ACTION, step).actions.squeeze(1)

    def act_deterministically(self, observations: Tensor) -> Tensor:
        """Return the actor's squashed mean, or its most probable action."""
        states = observations.unsqueeze(1)
        if isinstance(self.space, Discrete):
            return self.actor.mode(states).squeeze(1)
        return SquashedGaussian(self.space, self.actor.outputs(states)).mode().squeeze(1)

    def update(self, batch: Batch, step: int) -> Tensor:
        """Update v, the critics, the target and the actor, in this order (lines 9–18)."""
        self._update_value(self._soft_values(batch.states, step), batch.states)  # lines 9–11
        loss = self.critic.learn(batch, self.target.forward(batch.next_states))  # lines 12–14
        polyak_average_(self.target.parameters, self.value.parameters, self.polyak)  # lines 15–16
        self._update_actor(batch.states, step)  # lines 17–18
        return loss

    def _soft_values(self, states: Tensor, step: int) -> Tensor:
        """Return min_i q_i(S, A') − τ ln π(A'|S) [P, B, 1] for A' ~ π(·|S) (line 10); discrete: its exact expectation."""
        if isinstance(self.space, Continuous):
            now = self.actor.sample_squashed(states, Purpose.NEXT_ACTION, step)
            return self.critic.values(states, now.actions) - self.entropy_scale * now.log_prob
        policy = Softmax(self.actor.outputs(states))
        soft = self.critic.values_of_all_actions(states) - self.entropy_scale * policy.log_probs
        return (policy.probs * soft).sum(dim=-1, keepdim=True)

    def _update_value(self, soft_values: Tensor, states: Tensor) -> None:
        """Descend the mean of (v(S) − soft value)² (lines 10–11)."""
        values, kept = self.value.forward_for_gradient(states)
        self.value.backward(kept, (values - soft_values) * (2 / states.shape[1]))
        self.value_optimizer.step_(self.value.gradient)

    def _update_actor(self, states: Tensor, step: int) -> None:
        """Descend the mean of τ ln π(A|S) − min_i q_i(S, A) (line 18)."""
        B = states.shape[1]
        outputs, kept = self.actor.outputs_for_gradient(states)
        if isinstance(self.space, Continuous):
            sample = SquashedGaussian(self.space, outputs).sample(
                self.actor.noise(Purpose.POLICY_UPDATE, step, B, self.space.size)
            )
            valuation = self.critic.evaluate(states, sample.actions)
            of_actions = valuation.action_gradient(torch.full_like(valuation.values, -1 / B))
            self.actor.descend(kept, sample.gradient(of_actions, (self.entropy_scale / B).expand_as(valuation.values)))
        else:
            policy = Softmax(outputs)
            bracket = self.critic.values_of_all_actions(states) - self.entropy_scale * policy.log_probs
            self.actor.descend(kept, policy.expectation_gradient(bracket).mul_(-1 / B))
