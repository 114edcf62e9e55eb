"""P multilayer perceptrons of one shape, their parameters stacked along a leading axis: the population network.

The interface is small, so that another engine can stand in for this one (pure torch): flat parameters and gradients
[P, n], `forward`, `forward_for_gradient`, `backward`, `values_of_actions`. Gradients are explicit: an algorithm hands the
gradient of its loss with respect to the outputs to `backward`.

An agent's numbers are the same, bit for bit, in every population, which takes two things. The last bits of a matrix product
depend on how its operands lie in cache lines: every agent's part of every operand starts at the same place in one. And a
batched product takes another path for one matrix: `agents.training` never trains a population of one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

ENGINE = "torch"
_LINE = 16  # floats in a cache line


@dataclass(frozen=True)
class Activations:
    """What `backward` needs of a forward pass: the inputs of every layer, [P, B, width] each."""

    inputs: tuple[Tensor, ...]


class PopulationMLP:
    """P networks input → hidden ReLU layers → linear heads.

    `heads` are the sizes of the linear heads, side by side in the output: they share the trunk, and each is initialized as
    a layer of its own. `parameters` and `gradient` are [P, n]; `layers` and `gradient_layers` are
    views of them (weights [P, in, out], biases [P, 1, out]); what lies between the views stays zero.
    """

    def __init__(
        self,
        population: int,
        inputs: int,
        hidden: Sequence[int],
        heads: Sequence[int],
        device: torch.device | str = "cpu",
    ) -> None:
        self.widths = (inputs, *hidden, sum(heads))
        self.heads = tuple(heads)
        size = sum(
            _aligned(fan_in * fan_out) + _aligned(fan_out) for fan_in, fan_out in zip(self.widths, self.widths[1:], strict=False)
        )
        self.parameters = torch.zeros(population, size, device=device)
        self.gradient = torch.zeros(population, size, device=device)
        self.layers = self._views(self.parameters)
        self.gradient_layers = self._views(self.gradient)
        self._buffers: dict[tuple[str, int, tuple[int, ...]], Tensor] = {}

    def _views(self, flat: Tensor) -> list[tuple[Tensor, Tensor]]:
        views, offset = [], 0
        for fan_in, fan_out in zip(self.widths, self.widths[1:], strict=False):
            weights = flat[:, offset : offset + fan_in * fan_out].unflatten(1, (fan_in, fan_out))
            offset += _aligned(fan_in * fan_out)
            views.append((weights, flat[:, offset : offset + fan_out].unsqueeze(1)))
            offset += _aligned(fan_out)
        return views

    def _buffer(self, use: str, layer: int, *shape: int) -> Tensor:
        """Return scratch memory [P, …], allocated once for each use; an agent's part starts at a cache line."""
        key = (use, layer, shape)
        if key not in self._buffers:
            size = math.prod(shape[1:])
            flat = torch.zeros(shape[0], _aligned(size), device=self.parameters.device)
            self._buffers[key] = flat[:, :size].unflatten(1, shape[1:])
        return self._buffers[key]

    def _lined_up(self, x: Tensor, use: str) -> Tensor:
        """Return x [P, B, width] with every agent's part at the same place in a cache line: x itself, or a copy."""
        return x if x.stride(0) % _LINE == 0 else self._buffer(use, -1, *x.shape).copy_(x)

    def initialize_(self, uniform: Tensor) -> None:
        """Set Xavier-uniform weights with gain √2 from numbers on (0, 1) [P, n], biases 0."""
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
        return self._forward(x, "forward")[-1]

    def forward_for_gradient(self, x: Tensor) -> tuple[Tensor, Activations]:
        """Return the outputs [P, B, out] and what `backward` needs; both are valid until the next call of that batch size."""
        *inputs, outputs = self._forward(x, "gradient")
        return outputs, Activations(tuple(inputs))

    def _forward(self, x: Tensor, use: str) -> list[Tensor]:
        results = [x := self._lined_up(x, use)]
        for index, (weights, biases) in enumerate(self.layers):
            out = self._buffer(use, index, x.shape[0], x.shape[1], weights.shape[2])
            x = torch.baddbmm(biases, x, weights, out=out)
            if index < len(self.layers) - 1:
                x.relu_()
            results.append(x)
        return results

    def backward(
        self, kept: Activations, output_gradient: Tensor, *, parameters: bool = True, inputs: bool = False
    ) -> Tensor | None:
        """Back-propagate ∂L/∂outputs [P, B, out], L a sum over the population.

        Writes ∂L/∂parameters to `gradient` unless `parameters` is False; returns ∂L/∂inputs [P, B, in] if `inputs`.
        """
        d = self._lined_up(output_gradient, "backward")
        for index in reversed(range(len(self.layers))):
            weights, x = self.layers[index][0], kept.inputs[index]
            if parameters:
                weight_gradient, bias_gradient = self.gradient_layers[index]
                torch.bmm(x.transpose(1, 2), d, out=weight_gradient)
                torch.sum(d, dim=1, keepdim=True, out=bias_gradient)
            if index > 0 or inputs:
                below = self._buffer("backward", index, *x.shape)
                d = torch.bmm(d, weights.transpose(1, 2), out=below)
            if index > 0:
                d.mul_(x > 0)
        return d if inputs else None

    def values_of_actions(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the first output [P, B, N] for every (state, action) pair: states [P, B, S] and actions [P, B, N, A].

        The state's part of the first layer is computed once a state, not once an action. Needs at least one hidden layer.
        """
        P, B, N, A = actions.shape
        (weights, biases), S = self.layers[0], states.shape[2]
        width = weights.shape[2]
        x = self._buffer("values", 0, P, B, N, width)
        states = self._lined_up(states, "values")
        of_states = torch.baddbmm(biases, states, weights[:, :S], out=self._buffer("states", 0, P, B, width))
        torch.mul(actions[..., :1], weights[:, None, S : S + 1], out=x)
        for a in range(1, A):
            x.addcmul_(actions[..., a : a + 1], weights[:, None, S + a : S + a + 1])
        x.add_(of_states.unsqueeze(2)).relu_()
        x = x.flatten(1, 2)
        for index, (weights, biases) in enumerate(self.layers[1:-1], start=1):
            out = self._buffer("values", index, P, B * N, weights.shape[2])
            x = torch.baddbmm(biases, x, weights, out=out).relu_()
        weights, biases = self.layers[-1]  # a product with one column is slow as a matrix product: multiply and sum
        values = torch.sum(x.mul_(weights[:, :, :1].transpose(1, 2)), dim=2)
        return values.add_(biases[:, :, 0]).view(P, B, N)


def _aligned(size: int) -> int:
    """Round a number of floats up to whole cache lines."""
    return -(-size // _LINE) * _LINE


def polyak_average_(target: Tensor, online: Tensor, weight: Tensor) -> None:
    """target ← (1 − β)·target + β·online, for parameters [P, n] and weights β [P, 1] (thesis equation 4.7)."""
    target.add_((online - target).mul_(weight))
