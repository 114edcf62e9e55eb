"""Vanilla Actor-Critic (thesis Algorithm 3): a Sarsa critic and a likelihood-ratio policy gradient with entropy regularization.

Shapes: population P, batch B, action dimensions A. With continuous actions N = `num_action_samples` are drawn from the actor in
each state: the first for the gradient, the last for the entropy, those between (28 of 30) for the baseline v̂.

Deviations from the printed pseudo-code:
- Lines 11 and 15 add gradients of losses; they are descended here.
- Line 15 writes a KL divergence to a Boltzmann policy; its gradient is equation 2.15 with an entropy term: for continuous actions
  ln π(a)·(q(s, a) − v̂(s)) + τ·H(π), estimated as in the author's code; for discrete ones the expectation is exact,
  Σ_a π(a)·[q(s, a) − τ ln π(a)], the bracket constant, and needs no baseline.
- `entropy_gradient` selects the estimate of ∇H(π), as for GreedyAC.
"""

from torch import Tensor

from agents.actor import Actor
from agents.algorithm import Task
from agents.critic import Critic
from agents.policies import Gaussian, Softmax
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose, RandomStream
from agents.spaces import Continuous


class VanillaAC:
    """P VanillaAC agents in lock-step, with a Gaussian or softmax actor."""

    capturable = True

    def __init__(self, population: Population, task: Task, stream: RandomStream) -> None:
        """Initialize θ, θ_targ, φ (line 2)."""
        self.hypers = population.shared
        self.space = task.actions
        self.entropy_scale = population.stacked("entropy_scale")[:, None, None]
        self.critic = Critic(population, task, stream)
        self.actor = Actor(population, task, stream, network=1)

    def act(self, observations: Tensor, step: int) -> Tensor:
        """Draw A ~ π(·|S) (line 6)."""
        return self.actor.sample(observations.unsqueeze(1), Purpose.ACTION, step).squeeze(1)

    def act_deterministically(self, observations: Tensor) -> Tensor:
        """Return the actor's mean, or its most probable action."""
        return self.actor.mode(observations.unsqueeze(1)).squeeze(1)

    def update(self, batch: Batch, step: int) -> Tensor:
        """Update critic, target and actor, in this order (lines 9–15)."""
        next_actions = self.actor.sample(batch.next_states, Purpose.NEXT_ACTION, step)
        next_values = self.critic.target_values(batch.next_states, next_actions)
        loss = self.critic.learn(batch, next_values, moves_target=True)  # lines 9–13
        if isinstance(self.space, Continuous):
            self._update_gaussian_actor(self.space, batch.states, step)
        else:
            self._update_softmax_actor(batch.states)
        return loss

    def _update_gaussian_actor(self, space: Continuous, states: Tensor, step: int) -> None:
        """Ascend the mean of ln π(a)·(q(S, a) − v̂(S)) + τ·H(π) (lines 3, 14–15)."""
        B, N = states.shape[1], self.hypers.num_action_samples
        outputs, kept = self.actor.outputs_for_gradient(states)
        policy = Gaussian(space, outputs)
        noise = self.actor.noise(Purpose.POLICY_UPDATE, step, B, N, space.size)
        actions = policy.sample(noise[:, :, : N - 1])
        values = self.critic.values_of_actions(states, actions)
        advantage = values[:, :, :1] - values[:, :, 1:].mean(dim=2, keepdim=True)  # line 3
        ascent = policy.log_prob_gradient(actions[:, :, :1], advantage)
        ascent += self.entropy_scale * policy.entropy_gradient(self.hypers.entropy_gradient, noise[:, :, N - 1 :])
        self.actor.descend(kept, ascent.mul_(-1 / B))

    def _update_softmax_actor(self, states: Tensor) -> None:
        """Ascend the mean of Σ_a π(a)·[q(S, a) − τ ln π(a)], the bracket constant (lines 14–15)."""
        outputs, kept = self.actor.outputs_for_gradient(states)
        policy = Softmax(outputs)
        bracket = self.critic.values_of_all_actions(states) - self.entropy_scale * policy.log_probs
        self.actor.descend(kept, policy.expectation_gradient(bracket).mul_(-1 / states.shape[1]))
