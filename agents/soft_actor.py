"""The actor of the soft actor-critics: what SAC and SAC-original share.

Continuous actions: a squashed Gaussian that follows the reparameterized gradient. Discrete ones: a softmax that follows the exact
expectation. Shapes: population P, batch B, action dimensions A.
"""

import torch
from torch import Tensor

from agents.actor import Actor
from agents.critic import Critic
from agents.policies import Softmax, SquashedGaussian
from agents.rng import Purpose
from agents.spaces import Continuous, Discrete


class SoftActor(Actor):
    """π_φ of P agents, whose samples come with their log-probability."""

    def sample(self, states: Tensor, purpose: Purpose, step: int) -> Tensor:
        """Return one action a state [P, B, A], A ~ π(·|S)."""
        if isinstance(self.space, Discrete):
            return super().sample(states, purpose, step)
        return self.sample_with_log_prob(states, purpose, step)[0]

    def sample_with_log_prob(self, states: Tensor, purpose: Purpose, step: int) -> tuple[Tensor, Tensor]:
        """Return A ~ π(·|S) [P, B, A] and ln π(A|S) [P, B, 1]."""
        B = states.shape[1]
        if isinstance(self.space, Continuous):
            policy = SquashedGaussian(self.space, self.outputs(states))
            sample = policy.sample(self.noise(purpose, step, B, self.space.size))
            return sample.actions, sample.log_prob
        softmax = Softmax(self.outputs(states))
        actions = softmax.sample(self.stream.uniforms(purpose, step, B).view(-1, B, 1))
        return actions, softmax.log_prob(actions)

    def mode(self, states: Tensor) -> Tensor:
        """Return the deterministic action of each state [P, B, A]: the squashed mean, or the most probable action."""
        if isinstance(self.space, Discrete):
            return super().mode(states)
        return SquashedGaussian(self.space, self.outputs(states)).mode()

    def improve(self, critic: Critic, states: Tensor, entropy_scale: Tensor, step: int) -> Tensor:
        """Move π(·|S) toward the Boltzmann policy of the smaller value; return ln π before [P, B, 1].

        Continuous: descend the mean of τ ln π(A|S) − q(S, A), A reparameterized: one sample estimates the KL divergence, whose
        partition function does not depend on φ. Discrete: ascend the mean of Σ_a π(a)·[q(S, a) − τ ln π(a)], the bracket being
        constant. `entropy_scale` τ is [P, 1, 1].
        """
        B = states.shape[1]
        outputs, kept = self.outputs_for_gradient(states)
        if isinstance(self.space, Continuous):
            sample = SquashedGaussian(self.space, outputs).sample(self.noise(Purpose.POLICY_UPDATE, step, B, self.space.size))
            valuation = critic.evaluate(states, sample.actions)
            of_actions = valuation.action_gradient(torch.full_like(valuation.values, -1 / B))
            self.descend(kept, sample.gradient(of_actions, (entropy_scale / B).expand_as(valuation.values)))
            return sample.log_prob
        policy = Softmax(outputs)
        bracket = critic.values_of_all_actions(states) - entropy_scale * policy.log_probs
        self.descend(kept, policy.expectation_gradient(bracket).mul_(-1 / B))
        return (policy.probs * policy.log_probs).sum(dim=-1, keepdim=True)
