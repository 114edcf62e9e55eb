"""Greedy Actor-Critic (thesis Algorithm 7) with the conditional cross-entropy method (Algorithm 6).

A Sarsa critic q with its target, and an actor π that follows the most valuable actions. With continuous actions they are the
best K = round(ρN) of N drawn from a wider proposal policy π̃; with discrete ones the best of all.
Shapes: population P, batch B, action dimensions A.

Deviations from the printed pseudo-code:
- Algorithm 7, line 13 and equation 4.6 add the gradient of a loss; it is descended here.
- Algorithm 7, lines 2–6: the branches are swapped; it is the continuous case that has a proposal policy.
- Algorithm 6, lines 12 and 14 sum over the elites; `elite_reduction` "mean" averages, as the code behind the published
  settings does, and "sum" is as printed. With Adam they differ in the weight of the entropy only.
- Algorithm 6, line 9 would give ⌊ρN⌋ + 1 elites; section 4.4 and chapter 7 say round(ρN), which is used.
- Algorithm 6, line 3: of several best discrete actions the first is taken.
- Algorithm 7 updates inside the episode only; here a minibatch update follows every step from the `batch_size`-th on.
- `entropy_gradient` selects the estimate of ∇H(π̃): "sampled" −ln π̃(a)·∇ln π̃(a), as printed, with a drawn without clamping;
  "analytic", footnote 5; "score" −∇ln π̃(a) with a clamped, the direction that the author's published code follows.
"""

from torch import Tensor

from agents.actor import Actor
from agents.algorithm import Task
from agents.algorithms.ccem import CCEM
from agents.critic import Critic
from agents.policies import Softmax
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose, RandomStream
from agents.spaces import Continuous


class GreedyAC:
    """P GreedyAC agents in lock-step. Gaussian actor and proposal, which starts as a copy of the actor; or a softmax actor."""

    capturable = True

    def __init__(self, population: Population, task: Task, stream: RandomStream) -> None:
        """Initialize θ, θ_targ, φ, and φ_prop if actions are continuous (Algorithm 7, lines 1–6)."""
        self.space = task.actions
        self.critic = Critic(population, task, stream)
        self.actor = Actor(population, task, stream, network=1)
        if isinstance(task.actions, Continuous):
            self.proposal = Actor(population, task, stream, network=1)
            entropy_scale = population.stacked("entropy_scale")[:, None, None]
            self.ccem = CCEM(population.shared, task.actions, self.actor, self.proposal, entropy_scale)

    def act(self, observations: Tensor, step: int) -> Tensor:
        """Draw A ~ π(·|S) (Algorithm 7, line 9)."""
        return self.actor.sample(observations.unsqueeze(1), Purpose.ACTION, step).squeeze(1)

    def act_deterministically(self, observations: Tensor) -> Tensor:
        """Return the actor's mean, or its most probable action."""
        return self.actor.mode(observations.unsqueeze(1)).squeeze(1)

    def update(self, batch: Batch, step: int) -> Tensor:
        """Update critic, target, then proposal and actor, neither of which sees the other's step (Algorithm 7, lines 12–18)."""
        next_actions = self.actor.sample(batch.next_states, Purpose.NEXT_ACTION, step)
        next_values = self.critic.target_values(batch.next_states, next_actions)
        loss = self.critic.learn(batch, next_values, moves_target=True)  # lines 12–15
        if isinstance(self.space, Continuous):
            self.ccem.update(self.critic, batch.states, step)  # lines 16–18
        else:
            self._update_discrete_actor(batch.states)
        return loss

    def _update_discrete_actor(self, states: Tensor) -> None:
        """The conditional cross-entropy method for discrete actions: maximize ln π(argmax_a q(S, a)) (Algorithm 6, line 3)."""
        outputs, kept = self.actor.outputs_for_gradient(states)
        best = self.critic.values_of_all_actions(states).argmax(dim=2, keepdim=True).to(states.dtype)
        self.actor.descend(kept, Softmax(outputs).log_prob_gradient(best).mul_(-1 / states.shape[1]))
