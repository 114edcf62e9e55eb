"""Soft Actor-Critic as it is used today (thesis Algorithm 1, "SAC-M", called SAC from chapter 5 on).

Two soft critics and their targets, valued by the smaller, and an actor that moves toward their Boltzmann policy
(`agents.soft_actor`). Shapes: population P, batch B, action dimensions A, discrete actions n.

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

from torch import Tensor

from agents.algorithm import Task
from agents.critic import Critic
from agents.optimizer import PopulationAdam
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose, RandomStream
from agents.soft_actor import SoftActor
from agents.spaces import Discrete


class SAC:
    """P SAC agents in lock-step."""

    capturable = True

    def __init__(self, population: Population, task: Task, stream: RandomStream) -> None:
        """Initialize θ_1, θ_2, θ_1,targ, θ_2,targ, φ (line 2)."""
        self.entropy_scale = population.stacked("entropy_scale")[:, None, None]
        self.critic = Critic(population, task, stream, double=True)
        self.actor = SoftActor(population, task, stream, network=2)
        self.tuning = None
        if population.shared.entropy_tuning == "automatic":
            self.tuning = EntropyTuning(self.entropy_scale, population.stacked("critic_step_size"), task)

    def act(self, observations: Tensor, step: int) -> Tensor:
        """Draw A ~ π(·|S) (line 6)."""
        return self.actor.sample(observations.unsqueeze(1), Purpose.ACTION, step).squeeze(1)

    def act_deterministically(self, observations: Tensor) -> Tensor:
        """Return the actor's squashed mean, or its most probable action."""
        return self.actor.mode(observations.unsqueeze(1)).squeeze(1)

    def update(self, batch: Batch, step: int) -> Tensor:
        """Update critics, targets and actor, in this order (lines 9–15)."""
        next_actions, log_prob = self.actor.sample_with_log_prob(batch.next_states, Purpose.NEXT_ACTION, step)
        next_values = self.critic.target_values(batch.next_states, next_actions) - self.entropy_scale * log_prob
        loss = self.critic.learn(batch, next_values, moves_target=True)  # lines 9–13
        log_prob = self.actor.improve(self.critic, batch.states, self.entropy_scale, step)  # lines 14–15
        if self.tuning is not None:
            self.tuning.step_(log_prob)
        return loss


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
