"""Greedy Actor-Critic (thesis Algorithm 7) with the conditional cross-entropy method (Algorithm 6), continuous actions.

A Sarsa critic q and its target; an actor π that follows the most valuable of N actions drawn from a wider proposal policy π̃.
Shapes: population P, batch B, samples N, elites K = round(ρN), action dimensions A.

Deviations from the printed pseudo-code:
- Algorithm 7, line 13 and equation 4.6 add the gradient of a loss; it is descended here.
- Algorithm 7, lines 2–6: the branches are swapped; it is the continuous case that has a proposal policy.
- Algorithm 6, lines 12 and 14 sum over the elites; this averages, as the code behind the published settings does.
- Algorithm 6, line 9 would give ⌊ρN⌋ + 1 elites; section 4.4 and chapter 7 say round(ρN), which is used.
- Algorithm 7 updates inside the episode only; here a minibatch update follows every step from the `batch_size`-th on.
- `entropy_gradient` selects the estimate of ∇H(π̃): "sampled" −ln π̃(a)·∇ln π̃(a), as printed, with a drawn without clamping;
  "analytic", footnote 5; "score" −∇ln π̃(a) with a clamped, the direction that the author's published code follows.
"""

import torch
from torch import Tensor

from agents.algorithm import Task
from agents.networks import PopulationMLP, polyak_average_
from agents.optimizer import PopulationAdam
from agents.policies import Gaussian
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose, RandomStream


class GreedyAC:
    """P GreedyAC agents in lock-step. Gaussian actor and proposal, which starts as a copy of the actor."""

    def __init__(self, population: Population, task: Task, stream: RandomStream) -> None:
        """Initialize θ, θ_targ, φ, φ_prop (Algorithm 7, lines 1–6)."""
        P, S, A = len(population), task.observation_size, task.actions.size
        hypers = population.shared
        self.task, self.stream = task, stream
        self.num_samples, self.num_elites = hypers.num_action_samples, hypers.num_elites
        self.entropy_gradient = hypers.entropy_gradient
        self.entropy_scale = population.stacked("entropy_scale")[:, None, None]
        self.polyak = population.stacked("polyak")[:, None]

        self.critic = PopulationMLP(P, S + A, hypers.hidden_layers, (1,), population.device)
        self.target = PopulationMLP(P, S + A, hypers.hidden_layers, (1,), population.device)
        self.actor = PopulationMLP(P, S, hypers.hidden_layers, (A, A), population.device)
        self.proposal = PopulationMLP(P, S, hypers.hidden_layers, (A, A), population.device)
        for index, network in enumerate((self.critic, self.actor)):
            network.initialize_(stream.uniforms(Purpose.INITIAL_WEIGHTS, index, network.parameters.shape[1]))
        self.target.parameters.copy_(self.critic.parameters)
        self.proposal.parameters.copy_(self.actor.parameters)

        self.critic_optimizer = PopulationAdam(self.critic.parameters, population.stacked("critic_step_size"))
        self.actor_optimizer = PopulationAdam(self.actor.parameters, population.stacked("actor_step_size"))
        self.proposal_optimizer = PopulationAdam(self.proposal.parameters, population.stacked("actor_step_size"))

    def act(self, observations: Tensor, step: int) -> Tensor:
        """Draw A ~ π(·|S) (Algorithm 7, line 9)."""
        return self._sample_actor(observations.unsqueeze(1), Purpose.ACTION, step).squeeze(1)

    def update(self, batch: Batch, step: int) -> Tensor:
        """Update critic, target, then proposal and actor, neither of which sees the other's step (Algorithm 7, lines 12–18)."""
        loss = self._update_critic(batch, step)
        polyak_average_(self.target.parameters, self.critic.parameters, self.polyak)  # line 15
        self._update_policies(batch.states, step)
        return loss

    def _update_critic(self, batch: Batch, step: int) -> Tensor:
        """Sarsa: descend the mean of (R + γ q_targ(S', A') − q(S, A))² (Algorithm 7, lines 12–13)."""
        next_actions = self._sample_actor(batch.next_states, Purpose.NEXT_ACTION, step)
        next_values = self.target.forward(torch.cat([batch.next_states, next_actions], dim=-1))
        targets = batch.rewards + self.task.discount * batch.continues * next_values
        values, kept = self.critic.forward_for_gradient(batch.states_actions)
        errors = values - targets
        # the mean of the squared error, not of its half: with Adam the factor cancels but for ε
        self.critic.backward(kept, errors * (2 / errors.shape[1]))
        self.critic_optimizer.step_(self.critic.gradient)
        return errors.square().mean(dim=(1, 2))

    def _update_policies(self, states: Tensor, step: int) -> None:
        """The conditional cross-entropy method (Algorithm 6, lines 5–14)."""
        P, B, _ = states.shape
        A = self.task.actions.size
        actor_outputs, actor_kept = self.actor.forward_for_gradient(states)
        proposal_outputs, proposal_kept = self.proposal.forward_for_gradient(states)
        actor, proposal = Gaussian(self.task.actions, actor_outputs), Gaussian(self.task.actions, proposal_outputs)

        noise = self.stream.normals(Purpose.POLICY_UPDATE, step, B * self.num_samples * A)
        noise = noise.view(P, B, self.num_samples, A)
        actions = proposal.sample(noise)  # line 6
        values = self.critic.values_of_actions(states, actions)  # line 7
        best = values.topk(self.num_elites, dim=2).indices  # lines 8–10
        elites = actions.gather(2, best.unsqueeze(-1).expand(-1, -1, -1, A))

        weights = torch.full((1, 1, 1), 1 / self.num_elites, device=states.device)
        ascent = proposal.log_prob_gradient(elites, weights)
        ascent += self.entropy_scale * self._entropy_gradient(proposal, noise[:, :, :1])
        self.proposal.backward(proposal_kept, ascent.mul_(-1 / B))  # lines 11–13
        self.proposal_optimizer.step_(self.proposal.gradient)

        self.actor.backward(actor_kept, actor.log_prob_gradient(elites, weights).mul_(-1 / B))  # line 14
        self.actor_optimizer.step_(self.actor.gradient)

    def _entropy_gradient(self, proposal: Gaussian, noise: Tensor) -> Tensor:
        """Estimate ∂H(π̃)/∂outputs [P, B, 2A] from one of the N actions: the first, as they are independent and alike."""
        if self.entropy_gradient == "analytic":
            return proposal.entropy_gradient()
        if self.entropy_gradient == "score":
            return proposal.log_prob_gradient(proposal.sample(noise), torch.full((1, 1, 1), -1.0, device=noise.device))
        action = proposal.sample_unclamped(noise)
        return proposal.log_prob_gradient(action, -proposal.log_prob(action))

    def _sample_actor(self, states: Tensor, purpose: Purpose, step: int) -> Tensor:
        """Return one action a state [P, B, A], A ~ π(·|S)."""
        P, B, _ = states.shape
        policy = Gaussian(self.task.actions, self.actor.forward(states))
        noise = self.stream.normals(purpose, step, B * self.task.actions.size)
        return policy.sample(noise.view(P, B, 1, -1)).squeeze(2)
