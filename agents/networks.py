"""P multilayer perceptrons of one shape, their parameters stacked along a leading axis: the population network.

The interface is small, so that one engine can stand in for another (`agents.kernels`): flat parameters [P, n], `forward`,
`forward_for_gradient`, `backward`, `descend`, `regress`, `values_of_actions`. Gradients are explicit: an algorithm hands the
gradient of its loss with respect to the outputs to `descend`, or to `backward`; a squared error is `regress`'s own.

An agent's numbers are the same, bit for bit, in every population: the engines see to that.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from agents import kernels
from agents.kernels import native_arithmetic, torch_arithmetic
from agents.kernels.arithmetic import Follower
from agents.kernels.layout import lay_out
from agents.kernels.native_arithmetic import NativeArithmetic
from agents.kernels.torch_arithmetic import TorchArithmetic

if TYPE_CHECKING:
    from agents.kernels.arithmetic import Activations, Arithmetic
    from agents.optimizer import PopulationAdam


class PopulationMLP:
    """P networks input → hidden ReLU layers (one at least) → linear heads.

    `heads` are the sizes of the linear heads, side by side in the output: they share the trunk, and each is initialized as
    a layer of its own. `parameters` are [P, n]; `layers` are views of them (weights [P, in, out], biases [P, 1, out]); what lies
    between the views stays zero. `gradient` and its views `gradient_layers` are made when they are first asked for.
    """

    def __init__(
        self,
        population: int,
        inputs: int,
        hidden: Sequence[int],
        heads: Sequence[int],
        device: torch.device | str = "cpu",
    ) -> None:
        self.heads = tuple(heads)
        self.layout = lay_out((inputs, *hidden, sum(heads)))
        self.parameters = torch.zeros(population, self.layout.size, device=device)
        self.layers = self._views(self.parameters)
        native = kernels.library(self.parameters.device.type)
        self._arithmetic: Arithmetic = (
            TorchArithmetic(self.layers, self.layout, self.parameters)
            if native is None
            else NativeArithmetic(native, self.layout, self.parameters)
        )
        self._gradient: Tensor | None = None

    @property
    def gradient(self) -> Tensor:
        """∂L/∂parameters [P, n], as `backward` wrote it last."""
        if self._gradient is None:
            self._gradient = torch.zeros_like(self.parameters)
        return self._gradient

    @property
    def gradient_layers(self) -> list[tuple[Tensor, Tensor]]:
        """Views of `gradient`, as `layers` are of the parameters."""
        return self._views(self.gradient)

    def _views(self, flat: Tensor) -> list[tuple[Tensor, Tensor]]:
        views = []
        for layer in self.layout.layers:
            head = layer is self.layout.layers[-1]
            rows = layer.fan_out if head else layer.fan_in
            matrix = flat[:, layer.weights : layer.weights + rows * layer.stride].unflatten(1, (rows, layer.stride))
            weights = matrix[:, :, : layer.fan_in].transpose(1, 2) if head else matrix[:, :, : layer.fan_out]
            views.append((weights, flat[:, layer.biases : layer.biases + layer.fan_out].unsqueeze(1)))
        return views

    def initialize_(self, uniform: Tensor) -> None:
        """Set Xavier-uniform weights with gain √2 from numbers on (0, 1) [P, ≥ weights], biases 0."""
        offset = 0
        for index, (weights, biases) in enumerate(self.layers):
            fan_in, fan_out = weights.shape[1:]
            for start, size in self._columns(index, fan_out):
                limit = math.sqrt(2) * math.sqrt(6 / (fan_in + size))
                drawn = uniform[:, offset : offset + fan_in * size].unflatten(1, (fan_in, size))
                weights[:, :, start : start + size] = (drawn * 2 - 1) * limit
                offset += fan_in * size
            biases.zero_()

    def _columns(self, layer: int, fan_out: int) -> list[tuple[int, int]]:
        if layer < len(self.layers) - 1:
            return [(0, fan_out)]
        return [(sum(self.heads[:i]), size) for i, size in enumerate(self.heads)]

    def forward(self, x: Tensor) -> Tensor:
        """Return the outputs [P, B, out] for inputs [P, B, in]. The result is overwritten by the next call of that batch size."""
        self._check(x, self.layout.inputs)
        return self._arithmetic.forward(x)

    def forward_for_gradient(self, x: Tensor) -> tuple[Tensor, "Activations"]:
        """Return the outputs [P, B, out] and what `backward` needs; both are valid until the next call of that batch size."""
        self._check(x, self.layout.inputs)
        return self._arithmetic.forward_for_gradient(x)

    def backward(
        self, kept: "Activations", output_gradient: Tensor, *, parameters: bool = True, inputs: bool = False
    ) -> Tensor | None:
        """Back-propagate ∂L/∂outputs [P, B, out], L a sum over the population.

        Writes ∂L/∂parameters to `gradient` unless `parameters` is False; returns ∂L/∂inputs [P, B, in] if `inputs`.
        """
        self._check(output_gradient, self.layout.outputs)
        return self._arithmetic.backward(kept, output_gradient, self.gradient if parameters else None, inputs)

    def descend(self, kept: "Activations", output_gradient: Tensor, optimizer: "PopulationAdam") -> None:
        """Back-propagate ∂L/∂outputs [P, B, out] and take the optimizer's step: `backward` and `step_` in one.

        `optimizer` is that of these parameters; `gradient` is left alone.
        """
        self._check(output_gradient, self.layout.outputs)
        self._arithmetic.descend(kept, output_gradient, optimizer)

    def regress(self, x: Tensor, targets: Tensor, optimizer: "PopulationAdam", follower: Follower | None = None) -> Tensor:
        """Take a step of `optimizer`, which is that of these parameters, down the mean over the batch of Σ_o (f(x) − targets)².

        f(x) are the outputs [P, B, out] for x [P, B, in], as targets [P, B, out]. Returns the losses [P] of before the step.
        Then the follower's parameters move towards the new ones. Counts as a call of `forward_for_gradient`.
        Raises ValueError for tensors of other shapes or types.
        """
        self._check(x, self.layout.inputs)
        self._check(targets, self.layout.outputs)
        if targets.shape[1] != x.shape[1] or x.shape[1] == 0:
            raise ValueError(f"targets {tuple(targets.shape)} for inputs {tuple(x.shape)}")
        return self._arithmetic.regress(x, targets, optimizer, follower)

    def values_of_actions(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the first output [P, B, N] for every (state, action) pair: states [P, B, S] and actions [P, B, N, A].

        The state's part of the first layer is computed once a state, not once an action.
        """
        self._check(states, self.layout.inputs - actions.shape[3])
        self._check(actions[:, :, 0], actions.shape[3])
        if actions.shape[1] != states.shape[1]:
            raise ValueError(f"actions {tuple(actions.shape)} for states {tuple(states.shape)}")
        return self._arithmetic.values_of_actions(states, actions)

    def _check(self, x: Tensor, width: int) -> None:
        """Refuse what the kernels, which see a pointer only, would misread."""
        if x.dtype != torch.float32 or x.dim() != 3 or x.shape[0] != len(self.parameters) or x.shape[2] != width:
            expected = f"[{len(self.parameters)}, B, {width}]"
            raise ValueError(f"a tensor {tuple(x.shape)} of {x.dtype}: must be {expected} of torch.float32")


def polyak_average_(target: Tensor, online: Tensor, weight: Tensor) -> None:
    """target ← (1 − β)·target + β·online, for parameters [P, n] and weights β [P, 1] or one for all (thesis equation 4.7).

    Raises ValueError for parameters of different shapes; the native engine wants them dense.
    """
    native = kernels.library(target.device.type)
    if native is None:
        torch_arithmetic.polyak_average_(target, online, weight)
    else:
        native_arithmetic.polyak_average_(native, target, online, weight)
