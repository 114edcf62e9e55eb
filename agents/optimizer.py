"""Adam with a step-size an agent (Kingma and Ba, "Adam", ICLR 2015, algorithm 1), on flat parameters [P, n].

Decay rates 0.9 and 0.999, ε = 1e-8, no weight decay, no clipping, as `torch.optim.Adam` computes it by default.
"""

import math

import torch
from torch import Tensor

from agents import kernels

_DECAY_1, _DECAY_2, _EPSILON = 0.9, 0.999, 1e-8


class PopulationAdam:
    """Adam's moments of P agents; `step_` descends along a gradient."""

    def __init__(self, parameters: Tensor, step_sizes: Tensor) -> None:
        """Take parameters [P, n] (dense), updated in place, and step-sizes [P]."""
        self.parameters = parameters
        self.step_sizes = step_sizes[:, None].contiguous()
        self.first_moment = torch.zeros_like(parameters)
        self.second_moment = torch.zeros_like(parameters)
        self.num_steps = 0
        self._native = kernels.library(parameters.device.type)
        if self._native is None:  # the count is kept where the parameters are: a step may be captured in a CUDA graph
            self._decays = torch.tensor([_DECAY_1, _DECAY_2], dtype=torch.float64, device=parameters.device)
            self._powers = torch.ones_like(self._decays)
            self._scratch, self._update = torch.empty_like(parameters), torch.empty_like(parameters)

    def next_corrections(self) -> tuple[float, float]:
        """Count a step and return its bias corrections, 1 − 0.9^t and 1/√(1 − 0.999^t): for kernels that take the step."""
        self.num_steps += 1
        return 1 - _DECAY_1**self.num_steps, 1 / math.sqrt(1 - _DECAY_2**self.num_steps)

    def step_(self, gradient: Tensor) -> None:
        """Update the parameters with ∂L/∂parameters [P, n]. Raises ValueError for a gradient of another shape or type."""
        if gradient.shape != self.parameters.shape or gradient.dtype != self.parameters.dtype:
            raise ValueError(f"a gradient {tuple(gradient.shape)} of {gradient.dtype} for {tuple(self.parameters.shape)}")
        if self._native is not None:
            P, n = self.parameters.shape
            pointers = (self.parameters, gradient.contiguous(), self.first_moment, self.second_moment, self.step_sizes)
            self._native.adam(P, n, *(x.data_ptr() for x in pointers), *self.next_corrections())
            return
        correction_1, correction_2 = (1 - self._powers.mul_(self._decays)).unbind()
        self.first_moment.mul_(_DECAY_1).add_(gradient, alpha=1 - _DECAY_1)
        torch.mul(gradient, gradient, out=self._scratch)
        self.second_moment.mul_(_DECAY_2).add_(self._scratch, alpha=1 - _DECAY_2)
        torch.sqrt(self.second_moment, out=self._scratch).mul_(correction_2.rsqrt()).add_(_EPSILON)
        torch.div(self.first_moment, self._scratch, out=self._update)
        self.parameters.sub_(self._update.mul_(self.step_sizes / correction_1.float()))
