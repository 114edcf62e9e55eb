"""Soft Actor-Critic as first published (thesis Algorithm 2; Haarnoja et al., 2018), "SAC-original".

Beside two soft action-value critics it learns a state-value network v and its target, which alone bootstraps; the actor is SAC's
(`agents.soft_actor`). With discrete actions line 10 is an exact expectation, not a sample.
Shapes: population P, batch B, action dimensions A.

Step-sizes: α_state = `state_value_step_size`, α_action = `critic_step_size`, α_actor = κ · α_action.

Deviations from the printed pseudo-code:
- Lines 11, 14 and 18 add the gradients of losses; they are descended here.
- Line 13 knows no termination: y = R + γ·continues·v_targ(S').
"""

from torch import Tensor

from agents.algorithm import Task
from agents.critic import Critic
from agents.networks import PopulationMLP, polyak_average_
from agents.optimizer import PopulationAdam
from agents.policies import Softmax
from agents.population import Population
from agents.replay import Batch
from agents.rng import Purpose, RandomStream
from agents.soft_actor import SoftActor
from agents.spaces import Continuous


class SACOriginal:
    """P SAC-original agents in lock-step."""

    capturable = True

    def __init__(self, population: Population, task: Task, stream: RandomStream) -> None:
        """Initialize θ_1, θ_2, w, w_targ, φ (line 2)."""
        P, hypers = len(population), population.shared
        self.space = task.actions
        self.entropy_scale = population.stacked("entropy_scale")[:, None, None]
        self.polyak = population.stacked("polyak")[:, None]
        self.critic = Critic(population, task, stream, double=True, target=False)
        self.actor = SoftActor(population, task, stream, network=2)
        self.value = PopulationMLP(P, task.observation_size, hypers.hidden_layers, (1,), population.device)
        self.target = PopulationMLP(P, task.observation_size, hypers.hidden_layers, (1,), population.device)
        self.value.initialize_(stream.uniforms(Purpose.INITIAL_WEIGHTS, 3, self.value.parameters.shape[1]))
        self.target.parameters.copy_(self.value.parameters)
        self.value_optimizer = PopulationAdam(self.value.parameters, population.stacked("state_value_step_size"))

    def act(self, observations: Tensor, step: int) -> Tensor:
        """Draw A ~ π(·|S) (line 6)."""
        return self.actor.sample(observations.unsqueeze(1), Purpose.ACTION, step).squeeze(1)

    def act_deterministically(self, observations: Tensor) -> Tensor:
        """Return the actor's squashed mean, or its most probable action."""
        return self.actor.mode(observations.unsqueeze(1)).squeeze(1)

    def update(self, batch: Batch, step: int) -> Tensor:
        """Update v, the critics, the target and the actor, in this order (lines 9–18)."""
        self._update_value(self._soft_values(batch.states, step), batch.states)  # lines 9–11
        loss = self.critic.learn(batch, self.target.forward(batch.next_states))  # lines 12–14
        polyak_average_(self.target.parameters, self.value.parameters, self.polyak)  # lines 15–16
        self.actor.improve(self.critic, batch.states, self.entropy_scale, step)  # lines 17–18
        return loss

    def _soft_values(self, states: Tensor, step: int) -> Tensor:
        """Return min_i q_i(S, A') − τ ln π(A'|S) [P, B, 1] for A' ~ π(·|S) (line 10); discrete: its exact expectation."""
        if isinstance(self.space, Continuous):
            actions, log_prob = self.actor.sample_with_log_prob(states, Purpose.NEXT_ACTION, step)
            return self.critic.values(states, actions) - self.entropy_scale * log_prob
        policy = Softmax(self.actor.outputs(states))
        soft = self.critic.values_of_all_actions(states) - self.entropy_scale * policy.log_probs
        return (policy.probs * soft).sum(dim=-1, keepdim=True)

    def _update_value(self, soft_values: Tensor, states: Tensor) -> None:
        """Descend the mean of (v(S) − soft value)² (lines 10–11)."""
        self.value.regress(states, soft_values, self.value_optimizer)
