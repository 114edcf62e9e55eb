"""A policy network of a population with its optimizer: what the actor-critic algorithms of the thesis share."""

import math

from torch import Tensor

from agents.algorithm import Task
from agents.kernels.arithmetic import Activations
from agents.networks import PopulationMLP
from agents.optimizer import PopulationAdam
from agents.policies import Gaussian, Softmax
from agents.population import Population
from agents.rng import Purpose, RandomStream
from agents.spaces import Discrete


class Actor:
    """π_φ of P agents: heads for mean and ln σ [P, B, 2A], or logits [P, B, n]; `network` is its number within an agent."""

    def __init__(self, population: Population, task: Task, stream: RandomStream, network: int) -> None:
        hypers = population.shared
        self.space, self.stream = task.actions, stream
        heads = (task.actions.count,) if isinstance(task.actions, Discrete) else (task.actions.size,) * 2
        self.network = PopulationMLP(len(population), task.observation_size, hypers.hidden_layers, heads, population.device)
        self.network.initialize_(stream.uniforms(Purpose.INITIAL_WEIGHTS, network, self.network.parameters.shape[1]))
        self.optimizer = PopulationAdam(self.network.parameters, population.stacked("actor_step_size"))

    def outputs(self, states: Tensor) -> Tensor:
        """Return the network's outputs for states [P, B, S]; overwritten by the next call of that batch size."""
        return self.network.forward(states)

    def outputs_for_gradient(self, states: Tensor) -> tuple[Tensor, Activations]:
        """Return the network's outputs for states [P, B, S], and what `descend` needs of the pass."""
        return self.network.forward_for_gradient(states)

    def descend(self, kept: Activations, of_outputs: Tensor) -> None:
        """Take a step of Adam along ∂L/∂outputs, L a sum over the population."""
        self.network.descend(kept, of_outputs, self.optimizer)

    def noise(self, purpose: Purpose, step: int, *shape: int) -> Tensor:
        """Return standard normal numbers [P, *shape] for this step."""
        return self.stream.normals(purpose, step, math.prod(shape)).view(-1, *shape)

    def sample(self, states: Tensor, purpose: Purpose, step: int) -> Tensor:
        """Return one action a state [P, B, A], A ~ π(·|S): clamped Gaussian, or softmax."""
        B = states.shape[1]
        if isinstance(self.space, Discrete):
            policy = Softmax(self.outputs(states))
            actions = policy.sample(self.stream.uniforms(purpose, step, B).view(-1, B, 1))
            return policy.without_broken(actions) if purpose == Purpose.ACTION else actions
        return Gaussian(self.space, self.outputs(states)).sample(self.noise(purpose, step, B, 1, self.space.size)).squeeze(2)

    def mode(self, states: Tensor) -> Tensor:
        """Return the deterministic action of each state [P, B, A]: the Gaussian's mean, or the most probable action."""
        if isinstance(self.space, Discrete):
            return Softmax(self.outputs(states)).mode()
        return Gaussian(self.space, self.outputs(states)).mean
