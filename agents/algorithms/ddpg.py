"""Deep Deterministic Policy Gradient (thesis Algorithm 4; Lillicrap et al., 2016), continuous actions only.

A deterministic actor scaled into the action range by tanh, a critic, and targets for both.
Shapes: population P, batch B, action dimensions A.

Deviations from the printed pseudo-code:
- Line 5: noise is in units of half the action range, the action is clipped to the range; `exploration_noise` "gaussian" is as
  printed, "ornstein-uhlenbeck" the process of Lillicrap et al., ε ← ε − 0.15·ε + σ·N(0, 1), which goes on across episodes.
- Line 11 adds the gradient of a loss; it is descended here. Line 10 knows no termination: γ·continues.
"""

import torch
from torch import Tensor

from agents.algorithm import Task
from agents.critic import Critic
from agents.networks import PopulationMLP, polyak_average_
from agents.optimizer import PopulationAdam
from agents.policies import Deterministic
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose, RandomStream
from agents.spaces import Continuous

_REVERSION = 0.15


class DDPG:
    """P DDPG agents in lock-step."""

    capturable = True

    def __init__(self, population: Population, task: Task, stream: RandomStream) -> None:
        """Initialize θ, θ_targ, φ, φ_targ (line 2)."""
        assert isinstance(task.actions, Continuous)
        P, hypers = len(population), population.shared
        self.space, self.stream, self.exploration = task.actions, stream, hypers.exploration_noise
        self.polyak = population.stacked("polyak")[:, None]
        self.exploration_scale = population.stacked("exploration_scale")[:, None]
        self.noise = torch.zeros(P, task.actions.size, device=population.device)
        self.critic = Critic(population, task, stream)
        size = (P, task.observation_size, hypers.hidden_layers, (task.actions.size,), population.device)
        self.actor, self.actor_target = PopulationMLP(*size), PopulationMLP(*size)
        self.actor.initialize_(stream.uniforms(Purpose.INITIAL_WEIGHTS, 1, self.actor.parameters.shape[1]))
        self.actor_target.parameters.copy_(self.actor.parameters)
        self.actor_optimizer = PopulationAdam(self.actor.parameters, population.stacked("actor_step_size"))

    def act(self, observations: Tensor, step: int) -> Tensor:
        """Return π(S) + ε, clipped to the range (line 5)."""
        drawn = self.exploration_scale * self.stream.normals(Purpose.ACTION, step, self.space.size)
        self.noise.mul_(1 - _REVERSION if self.exploration == "ornstein-uhlenbeck" else 0).add_(drawn)
        policy = Deterministic(self.space, self.actor.forward(observations.unsqueeze(1)))
        return policy.perturbed(self.noise.unsqueeze(1)).squeeze(1)

    def act_deterministically(self, observations: Tensor) -> Tensor:
        """Return π(S), without noise."""
        return Deterministic(self.space, self.actor.forward(observations.unsqueeze(1))).actions.squeeze(1)

    def update(self, batch: Batch, step: int) -> Tensor:
        """Update critic, actor and targets (lines 9–16); the critic's target moves before the actor, which does not read it."""
        next_actions = Deterministic(self.space, self.actor_target.forward(batch.next_states)).actions
        next_values = self.critic.target_values(batch.next_states, next_actions)
        loss = self.critic.learn(batch, next_values, moves_target=True)  # lines 9–11 and 15
        self._update_actor(batch.states)
        polyak_average_(self.actor_target.parameters, self.actor.parameters, self.polyak)  # line 16
        return loss

    def _update_actor(self, states: Tensor) -> None:
        """Ascend the mean of q(S, π(S)) (lines 12–13)."""
        outputs, kept = self.actor.forward_for_gradient(states)
        policy = Deterministic(self.space, outputs)
        valuation = self.critic.evaluate(states, policy.actions)
        of_actions = valuation.action_gradient(torch.full_like(valuation.values, -1 / states.shape[1]))
        self.actor.descend(kept, policy.gradient(of_actions), self.actor_optimizer)
