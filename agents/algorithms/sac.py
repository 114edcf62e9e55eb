"""Soft Actor-Critic as it is used today (thesis Algorithm 1, "SAC-M", called SAC from chapter 5 on), continuous actions.

Two soft critics and their targets, valued by the smaller; a squashed Gaussian actor that follows the reparameterized gradient.
Shapes: population P, batch B, action dimensions A. The two critics of agent p are the networks 2p and 2p + 1.

Deviations from the printed pseudo-code:
- Line 10 uses the online critics; section 3 and Haarnoja et al. (2019) use the target networks, as here.
- Line 10 puts −τ ln π outside γ and knows no termination: y = R + γ·continues·(min_i q_targ,i(S', A') − τ ln π(A'|S')).
- Lines 11 and 15 add the gradients of losses; they are descended here.
- One sample a state estimates the KL divergence of line 15; the partition function does not depend on φ.
"""

import torch
from torch import Tensor

from agents.algorithm import Task
from agents.networks import PopulationMLP, polyak_average_
from agents.optimizer import PopulationAdam
from agents.policies import SquashedGaussian, SquashedSample
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose, RandomStream


class SAC:
    """P SAC agents in lock-step."""

    def __init__(self, population: Population, task: Task, stream: RandomStream) -> None:
        """Initialize θ_1, θ_2, θ_1,targ, θ_2,targ, φ (line 2)."""
        P, S, A = len(population), task.observation_size, task.actions.size
        hypers = population.shared
        self.task, self.stream = task, stream
        self.entropy_scale = population.stacked("entropy_scale")[:, None, None]
        self.polyak = _twice(population.stacked("polyak")[:, None])

        self.critics = PopulationMLP(2 * P, S + A, hypers.hidden_layers, (1,), population.device)
        self.targets = PopulationMLP(2 * P, S + A, hypers.hidden_layers, (1,), population.device)
        self.actor = PopulationMLP(P, S, hypers.hidden_layers, (A, A), population.device)
        size = self.critics.parameters.shape[1]
        uniform = [stream.uniforms(Purpose.INITIAL_WEIGHTS, index, size) for index in (0, 1)]
        self.critics.initialize_(torch.stack(uniform, dim=1).flatten(0, 1))
        self.actor.initialize_(stream.uniforms(Purpose.INITIAL_WEIGHTS, 2, self.actor.parameters.shape[1]))
        self.targets.parameters.copy_(self.critics.parameters)

        self.critic_optimizer = PopulationAdam(self.critics.parameters, _twice(population.stacked("critic_step_size")))
        self.actor_optimizer = PopulationAdam(self.actor.parameters, population.stacked("actor_step_size"))

    def act(self, observations: Tensor, step: int) -> Tensor:
        """Draw A ~ π(·|S) (line 6)."""
        return self._sample_actor(observations.unsqueeze(1), Purpose.ACTION, step).actions.squeeze(1)

    def update(self, batch: Batch, step: int) -> Tensor:
        """Update critics, targets and actor, in this order (lines 9–15)."""
        loss = self._update_critics(batch, step)
        polyak_average_(self.targets.parameters, self.critics.parameters, self.polyak)  # line 13
        self._update_actor(batch.states, step)
        return loss

    def _update_critics(self, batch: Batch, step: int) -> Tensor:
        """Descend the mean of (y − q_i(S, A))² (lines 9–11)."""
        P, B, _ = batch.states.shape
        after = self._sample_actor(batch.next_states, Purpose.NEXT_ACTION, step)
        next_values = self.targets.forward(_twice(torch.cat([batch.next_states, after.actions], dim=-1)))
        next_values = next_values.view(P, 2, B, 1).amin(dim=1)  # line 3
        targets = batch.rewards + self.task.discount * batch.continues * (next_values - self.entropy_scale * after.log_prob)
        values, kept = self.critics.forward_for_gradient(_twice(batch.states_actions))
        errors = values - _twice(targets)
        self.critics.backward(kept, errors * (2 / B))
        self.critic_optimizer.step_(self.critics.gradient)
        return errors.square().view(P, -1).mean(dim=1) * 2

    def _update_actor(self, states: Tensor, step: int) -> None:
        """Descend the mean of τ ln π(A|S) − min_i q_i(S, A), A reparameterized (line 15)."""
        P, B, S = states.shape
        outputs, actor_kept = self.actor.forward_for_gradient(states)
        noise = self.stream.normals(Purpose.POLICY_UPDATE, step, B * self.task.actions.size).view(P, B, -1)
        sample = SquashedGaussian(self.task.actions, outputs).sample(noise)
        values, kept = self.critics.forward_for_gradient(_twice(torch.cat([states, sample.actions], dim=-1)))
        of_values = _is_smaller_twin(values.view(P, 2, B, 1)).mul_(-1 / B).view(2 * P, B, 1)
        of_inputs = self.critics.backward(kept, of_values, parameters=False, inputs=True)
        assert of_inputs is not None
        of_actions = of_inputs.view(P, 2, B, -1).sum(dim=1)[..., S:]
        self.actor.backward(actor_kept, sample.gradient(of_actions, (self.entropy_scale / B).expand(P, B, 1)))
        self.actor_optimizer.step_(self.actor.gradient)

    def _sample_actor(self, states: Tensor, purpose: Purpose, step: int) -> SquashedSample:
        P, B, _ = states.shape
        policy = SquashedGaussian(self.task.actions, self.actor.forward(states))
        return policy.sample(self.stream.normals(purpose, step, B * self.task.actions.size).view(P, B, -1))


def _twice(x: Tensor) -> Tensor:
    """Return [2P, …] with every agent's slice twice in a row: one for each of its critics."""
    return x.repeat_interleave(2, dim=0)


def _is_smaller_twin(values: Tensor) -> Tensor:
    """Return 1 where a critic's value [P, 2, B, 1] is the smaller of the two (the first where they are equal), else 0."""
    first = (values[:, :1] <= values[:, 1:]).to(values.dtype)
    return torch.cat([first, 1 - first], dim=1)
