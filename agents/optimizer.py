"""Adam with a step-size an agent (Kingma and Ba, "Adam", ICLR 2015, algorithm 1), on flat parameters [P, n].

Decay rates 0.9 and 0.999, ε = 1e-8, no weight decay, no clipping, as `torch.optim.Adam` computes it by default.
"""

import math

import torch
from torch import Tensor

_DECAY_1, _DECAY_2, _EPSILON = 0.9, 0.999, 1e-8


class PopulationAdam:
    """Adam's moments of P agents; `step_` descends along a gradient."""

    def __init__(self, parameters: Tensor, step_sizes: Tensor) -> None:
        """Take parameters [P, n], updated in place, and step-sizes [P]."""
        self.parameters = parameters
        self.step_sizes = step_sizes[:, None]
        self.first_moment = torch.zeros_like(parameters)
        self.second_moment = torch.zeros_like(parameters)
        self.num_steps = 0
        self._scratch = torch.empty_like(parameters)
        self._update = torch.empty_like(parameters)

    def step_(self, gradient: Tensor) -> None:
        """Update the parameters with ∂L/∂parameters [P, n]."""
        self.num_steps += 1
        self.first_moment.mul_(_DECAY_1).add_(gradient, alpha=1 - _DECAY_1)
        torch.mul(gradient, gradient, out=self._scratch)
        self.second_moment.mul_(_DECAY_2).add_(self._scratch, alpha=1 - _DECAY_2)
        corrected = 1 / math.sqrt(1 - _DECAY_2**self.num_steps)
        torch.sqrt(self.second_moment, out=self._scratch).mul_(corrected).add_(_EPSILON)
        torch.div(self.first_moment, self._scratch, out=self._update)
        self.parameters.sub_(self._update.mul_(self.step_sizes / (1 - _DECAY_1**self.num_steps)))
