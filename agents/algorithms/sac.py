"""Soft Actor-Critic as it is used today (thesis Algorithm 1, "SAC-M", called SAC from chapter 5 on).

Two soft critics and their targets, valued by the smaller. With continuous actions a squashed Gaussian actor follows the
reparameterized gradient, with discrete ones a softmax actor the exact expectation.
Shapes: population P, batch B, action dimensions A, discrete actions n.

Deviations from the printed pseudo-code:
- Line 10 uses the online critics; section 2.3 and Haarnoja et al. (2019) use the target networks, as here.
- Line 10 puts −τ ln π outside γ and knows no termination: y = R + γ·continues·(min_i q_targ,i(S', A') − τ ln π(A'|S')).
- Lines 11 and 15 add the gradients of losses; they are descended here.
- Line 15: one sample a state estimates the KL divergence (continuous); the partition function does not depend on φ.
- The author's code takes ln π(a'_j | s'_0), of the batch's first state, for every j (discrete); here it is ln π(a'_j | s'_j).
- `entropy_tuning` "automatic" learns τ toward an entropy of −A (or 0.98·ln n) by gradient descent on
  ln τ·(−ln π(A|S) − target) (Haarnoja et al., 2019, equation 18); the thesis keeps it fixed.
"""

import math

import torch
from torch import Tensor

from agents.actor import Actor
from agents.algorithm import Task
from agents.critic import Critic
from agents.optimizer import PopulationAdam
from agents.policies import Softmax, SquashedGaussian
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose, RandomStream
from agents.spaces import Continuous, Discrete


class SAC:
    """P SAC agents in lock-step."""

    def __init__(self, population: Population, task: Task, stream: RandomStream) -> None:
        """Initialize θ_1, θ_2, θ_1,targ, θ_2,targ, φ (line 2)."""
        self.space = task.actions
        self.entropy_scale = population.stacked("entropy_scale")[:, None, None]
        self.critic = Critic(population, task, stream, double=True)
        self.actor = Actor(population, task, stream, network=2)
        self.tuning = None
        if population.shared.entropy_tuning == "automatic":
            self.tuning = EntropyTuning(self.entropy_scale, population.stacked("critic_step_size"), task)

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
        """Update critics, targets and actor, in this order (lines 9–15)."""
        next_actions, log_prob = self._next_actions(batch.next_states, step)
        next_values = self.critic.target_values(batch.next_states, next_actions) - self.entropy_scale * log_prob
        loss = self.critic.learn(batch, next_values)  # lines 9–11
        self.critic.update_target()  # lines 12–13
        if isinstance(self.space, Continuous):
            log_prob = self._update_gaussian_actor(self.space, batch.states, step)
        else:
            log_prob = self._update_softmax_actor(batch.states)
        if self.tuning is not None:
            self.tuning.step_(log_prob)
        return loss

    def _next_actions(self, states: Tensor, step: int) -> tuple[Tensor, Tensor]:
        """Draw A' ~ π(·|S') [P, B, A] and return its ln π [P, B, 1]."""
        if isinstance(self.space, Continuous):
            after = self.actor.sample_squashed(states, Purpose.NEXT_ACTION, step)
            return after.actions, after.log_prob
        policy = Softmax(self.actor.outputs(states))
        B = states.shape[1]
        actions = policy.sample(self.actor.stream.uniforms(Purpose.NEXT_ACTION, step, B).view(-1, B, 1))
        return actions, policy.log_prob(actions)

    def _update_gaussian_actor(self, space: Continuous, states: Tensor, step: int) -> Tensor:
        """Descend the mean of τ ln π(A|S) − min_i q_i(S, A), A reparameterized (line 15); return ln π(A|S) [P, B, 1]."""
        B = states.shape[1]
        outputs, kept = self.actor.outputs_for_gradient(states)
        sample = SquashedGaussian(space, outputs).sample(self.actor.noise(Purpose.POLICY_UPDATE, step, B, space.size))
        valuation = self.critic.evaluate(states, sample.actions)
        of_actions = valuation.action_gradient(torch.full_like(valuation.values, -1 / B))
        self.actor.descend(kept, sample.gradient(of_actions, (self.entropy_scale / B).expand_as(valuation.values)))
        return sample.log_prob

    def _update_softmax_actor(self, states: Tensor) -> Tensor:
        """Ascend the mean of Σ_a π(a)·[min_i q_i(S, a) − τ ln π(a)], the bracket constant (line 15); return Σ_a π ln π."""
        outputs, kept = self.actor.outputs_for_gradient(states)
        policy = Softmax(outputs)
        bracket = self.critic.values_of_all_actions(states) - self.entropy_scale * policy.log_probs
        self.actor.descend(kept, policy.expectation_gradient(bracket).mul_(-1 / states.shape[1]))
        return (policy.probs * policy.log_probs).sum(dim=-1, keepdim=True)


class EntropyTuning:
    """Learns each agent's τ by Adam on ln τ; writes it to `entropy_scale` [P, 1, 1] in place."""

    def __init__(self, entropy_scale: Tensor, step_sizes: Tensor, task: Task) -> None:
        """Start from the given τ (at least 1e-8) with the critic's step-sizes [P]."""
        self.entropy_scale = entropy_scale
        self.log_scale = entropy_scale.clamp(min=1e-8).log().view(-1, 1)
        self.optimizer = PopulationAdam(self.log_scale, step_sizes)
        discrete = isinstance(task.actions, Discrete)
        self.target = 0.98 * math.log(task.actions.count) if discrete else -float(task.actions.size)  # type: ignore[union-attr]

    def step_(self, log_prob: Tensor) -> None:
        """Descend ln τ·(−mean ln π − target), for ln π [P, B, 1] of the policy before its update."""
        self.optimizer.step_(-log_prob.mean(dim=(1, 2)).unsqueeze(1) - self.target)
        self.entropy_scale.copy_(self.log_scale.exp().view(-1, 1, 1))
