"""The population network in PyTorch: on every device, and the oracle of the native kernels.

The last bits of a matrix product depend on how its operands lie in cache lines: every agent's part of every operand starts at the
same place in one. And a batched product takes another path for one matrix: `agents.training` never trains a population of one.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from agents.kernels.arithmetic import Follower
from agents.kernels.layout import LINE, Layout, aligned

if TYPE_CHECKING:
    from agents.optimizer import PopulationAdam

Views = list[tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class TorchActivations:
    """The inputs of every layer, [P, B, width] each."""

    inputs: tuple[Tensor, ...]

    def clone(self) -> "TorchActivations":
        """Return a copy; an agent's part of it starts at a cache line, as in the original."""
        return TorchActivations(tuple(_lined_up_copy(x) for x in self.inputs))


class TorchArithmetic:
    """Batched matrix products on views of the parameters: weights [P, in, out], biases [P, 1, out]."""

    def __init__(self, layers: Views, layout: Layout, parameters: Tensor) -> None:
        self._layers, self._layout, self._parameters, self._device = layers, layout, parameters, parameters.device
        self._gradient: Tensor | None = None
        self._buffers: dict[tuple[str, int, tuple[int, ...]], Tensor] = {}

    def _buffer(self, use: str, layer: int, *shape: int) -> Tensor:
        """Return scratch memory [P, …], allocated once for each use; an agent's part starts at a cache line."""
        key = (use, layer, shape)
        if key not in self._buffers:
            self._buffers[key] = _lined_up_empty(shape, self._device)
        return self._buffers[key]

    def _lined_up(self, x: Tensor, use: str) -> Tensor:
        """Return x [P, B, width] with every agent's part at the same place in a cache line: x itself, or a copy."""
        return x if x.stride(0) % LINE == 0 else self._buffer(use, -1, *x.shape).copy_(x)

    def forward(self, x: Tensor) -> Tensor:
        return self._forward(x, "forward")[-1]

    def forward_for_gradient(self, x: Tensor) -> tuple[Tensor, TorchActivations]:
        *inputs, outputs = self._forward(x, "gradient")
        return outputs, TorchActivations(tuple(inputs))

    def _forward(self, x: Tensor, use: str) -> list[Tensor]:
        results = [x := self._lined_up(x, use)]
        for index, (weights, biases) in enumerate(self._layers):
            out = self._buffer(use, index, x.shape[0], x.shape[1], weights.shape[2])
            x = torch.baddbmm(biases, x, weights, out=out)
            if index < len(self._layers) - 1:
                x.relu_()
            results.append(x)
        return results

    def backward(self, kept: TorchActivations, output_gradient: Tensor, gradient: Tensor | None, inputs: bool) -> Tensor | None:
        d = self._lined_up(output_gradient, "backward")
        for index in reversed(range(len(self._layers))):
            weights, x = self._layers[index][0], kept.inputs[index]
            if gradient is not None:
                self._write_gradient(gradient, index, x, d)
            if index > 0 or inputs:
                below = self._buffer("backward", index, *x.shape)
                d = torch.bmm(d, weights.transpose(1, 2), out=below)
            if index > 0:
                d.mul_(x > 0)
        return d if inputs else None

    def _write_gradient(self, gradient: Tensor, index: int, x: Tensor, d: Tensor) -> None:
        layer, head = self._layout.layers[index], index == len(self._layers) - 1
        first, second = (d, x) if head else (x, d)  # the head lies transposed
        rows, columns = first.shape[2], second.shape[2]
        matrix = gradient[:, layer.weights : layer.weights + rows * layer.stride].unflatten(1, (rows, layer.stride))
        torch.bmm(first.transpose(1, 2), second, out=matrix[:, :, :columns])
        torch.sum(d, dim=1, out=gradient[:, layer.biases : layer.biases + d.shape[2]])

    def descend(self, kept: TorchActivations, output_gradient: Tensor, optimizer: "PopulationAdam") -> None:
        if self._gradient is None:
            self._gradient = torch.zeros_like(optimizer.parameters)
        self.backward(kept, output_gradient, self._gradient, False)
        optimizer.step_(self._gradient)

    def regress(self, x: Tensor, targets: Tensor, optimizer: "PopulationAdam", follower: Follower | None) -> Tensor:
        outputs, kept = self.forward_for_gradient(x)
        errors = outputs - targets
        self.descend(kept, errors * (2 / x.shape[1]), optimizer)
        if follower is not None:
            polyak_average_(follower.parameters, self._parameters, follower.rates)
        return errors.square().flatten(1).sum(dim=1) / x.shape[1]

    def values_of_actions(self, states: Tensor, actions: Tensor) -> Tensor:
        P, B, N, A = actions.shape
        (weights, biases), S = self._layers[0], states.shape[2]
        width = weights.shape[2]
        x = self._buffer("values", 0, P, B, N, width)
        states = self._lined_up(states, "values")
        of_states = torch.baddbmm(biases, states, weights[:, :S], out=self._buffer("states", 0, P, B, width))
        torch.mul(actions[..., :1], weights[:, None, S : S + 1], out=x)
        for a in range(1, A):
            x.addcmul_(actions[..., a : a + 1], weights[:, None, S + a : S + a + 1])
        x.add_(of_states.unsqueeze(2)).relu_()
        x = x.flatten(1, 2)
        for index, (weights, biases) in enumerate(self._layers[1:-1], start=1):
            out = self._buffer("values", index, P, B * N, weights.shape[2])
            x = torch.baddbmm(biases, x, weights, out=out).relu_()
        weights, biases = self._layers[-1]  # a product with one column is slow as a matrix product: multiply and sum
        values = torch.sum(x.mul_(weights[:, :, :1].transpose(1, 2)), dim=2)
        return values.add_(biases[:, :, 0]).view(P, B, N)


def polyak_average_(target: Tensor, online: Tensor, rates: Tensor) -> None:
    """Move a target [P, n] towards parameters [P, n] at rates [P, 1]."""
    target.add_((online - target).mul_(rates))


def _lined_up_empty(shape: tuple[int, ...], device: torch.device) -> Tensor:
    size = math.prod(shape[1:])
    flat = torch.zeros(shape[0], aligned(size), device=device)
    return flat[:, :size].unflatten(1, shape[1:])


def _lined_up_copy(x: Tensor) -> Tensor:
    return _lined_up_empty(tuple(x.shape), x.device).copy_(x)
