"""The conditional cross-entropy method (thesis Algorithm 6): policy improvement by following the best of many actions.

`CCEM` updates an actor and a proposal policy on a batch of states, continuous actions; `percentile_greedy` is the policy that it
tracks, exactly, for finitely many actions (equations 4.4 and 4.5, Theorem 4.3.1).
Shapes: population P, batch B, samples N, elites K = round(ρN), action dimensions A.

Deviations from the printed pseudo-code: the list at the head of `agents.algorithms.greedy_ac`.
"""

import torch
from torch import Tensor

from agents.actor import Actor
from agents.critic import Critic
from agents.elites import best_actions
from agents.hypers import GreedyACHypers
from agents.policies import Gaussian
from agents.rng import Purpose
from agents.spaces import Continuous


class CCEM:
    """Updates the actors and proposal policies of a population; `entropy_scale` τ is [P, 1, 1]."""

    def __init__(self, hypers: GreedyACHypers, space: Continuous, actor: Actor, proposal: Actor, entropy_scale: Tensor) -> None:
        self.hypers, self.space, self.actor, self.proposal, self.entropy_scale = hypers, space, actor, proposal, entropy_scale
        self.elite_weight = 1 / hypers.num_elites if hypers.elite_reduction == "mean" else 1.0

    def update(self, critic: Critic, states: Tensor, step: int) -> None:
        """Take a step with both policies on states [P, B, S] (lines 5–14)."""
        B, N = states.shape[1], self.hypers.num_action_samples
        actor_outputs, actor_kept = self.actor.outputs_for_gradient(states)
        proposal_outputs, proposal_kept = self.proposal.outputs_for_gradient(states)
        actor, proposal = Gaussian(self.space, actor_outputs), Gaussian(self.space, proposal_outputs)

        noise = self.proposal.noise(Purpose.POLICY_UPDATE, step, B, N, self.space.size)
        actions = proposal.sample(noise)  # line 6
        values = critic.values_of_actions(states, actions)  # line 7
        elites = best_actions(values, actions, self.hypers.num_elites)  # lines 8–10

        ascent = proposal.log_prob_gradient(elites, self.elite_weight)
        # the entropy's action is any of the N: the first, as they are independent and alike
        ascent += self.entropy_scale * proposal.entropy_gradient(self.hypers.entropy_gradient, noise[:, :, :1])
        self.proposal.descend(proposal_kept, ascent.mul_(-1 / B))  # lines 11–13
        self.actor.descend(actor_kept, actor.log_prob_gradient(elites, self.elite_weight).mul_(-1 / B))  # line 14


def percentile_greedy(policy: Tensor, values: Tensor, fraction: float) -> Tensor:
    """Return the percentile-greedy policy ϱ_ρ [..., n] of a policy over n actions with these values (equations 4.4, 4.5).

    The actions of highest value keep their probability ÷ ρ until a share ρ of the probability is used up; the one at which that
    happens keeps the part that is left, so that equation 4.4 holds for discrete distributions too. Of equal values the
    first comes first. Raises ValueError unless 0 < ρ ≤ 1.
    """
    if not 0 < fraction <= 1:
        raise ValueError(f"elite fraction {fraction}: must be greater than 0 and at most 1")
    order = values.argsort(dim=-1, descending=True, stable=True)
    sorted_policy = policy.gather(-1, order)
    before = sorted_policy.cumsum(dim=-1) - sorted_policy
    kept = torch.minimum(sorted_policy, (fraction - before).clamp(min=0)) / fraction
    return torch.zeros_like(policy).scatter_(-1, order, kept)
