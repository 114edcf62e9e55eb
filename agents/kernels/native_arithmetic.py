"""The population network on the native kernels: tensors to pointers. Inputs may be strided views; nothing is copied for them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from agents.kernels.arithmetic import Follower
from agents.kernels.layout import Layout
from agents.kernels.native import Library, Shape

if TYPE_CHECKING:
    from agents.optimizer import PopulationAdam


@dataclass(frozen=True)
class NativeActivations:
    """The network's inputs x [P, B, in], and the hidden activations of every agent, block by block [P, Σ B · stride]."""

    x: Tensor
    hidden: Tensor
    layout: Layout

    @property
    def inputs(self) -> tuple[Tensor, ...]:
        """The inputs of every layer, [P, B, width] each: views."""
        (P, B, _), views, offset = self.x.shape, [self.x], 0
        for layer in self.layout.hidden:
            block = self.hidden[:, offset : offset + B * layer.stride].view(P, B, layer.stride)
            views.append(block[:, :, : layer.fan_out])
            offset += B * layer.stride
        return tuple(views)

    def clone(self) -> "NativeActivations":
        """Return a copy."""
        return NativeActivations(self.x.clone(), self.hidden.clone(), self.layout)


class NativeArithmetic:
    """One agent after another inside a kernel, so that an agent's weights stay in the cache while they are used."""

    def __init__(self, library: Library, layout: Layout, parameters: Tensor) -> None:
        self._library, self._layout, self._parameters = library, layout, parameters
        self._shape = Shape(layout)
        self._floats_of_activations = sum(layer.stride for layer in layout.hidden)
        self._buffers: dict[tuple[str, int], Tensor] = {}

    def _buffer(self, use: str, batch: int, *shape: int) -> Tensor:
        key = (use, batch)
        if key not in self._buffers:
            self._buffers[key] = torch.zeros(shape)
        return self._buffers[key]

    def _scratch(self, batch: int) -> int:
        key = ("scratch", batch)
        if key not in self._buffers:
            self._buffers[key] = torch.zeros(self._library.scratch_size(self._shape.pointer, batch))
        return self._buffers[key].data_ptr()

    def forward(self, x: Tensor) -> Tensor:
        return self._forward("forward", x, None)

    def forward_for_gradient(self, x: Tensor) -> tuple[Tensor, NativeActivations]:
        P, B, _ = x.shape
        x = _dense(x)
        hidden = self._buffer("activations", B, P, B * self._floats_of_activations)
        return self._forward("gradient", x, hidden), NativeActivations(x, hidden, self._layout)

    def _forward(self, use: str, x: Tensor, hidden: Tensor | None) -> Tensor:
        P, B, _ = x.shape
        x = _dense(x)
        out = self._buffer(use, B, P, B, self._layout.outputs)
        self._library.forward(
            self._shape.pointer,
            P,
            B,
            self._parameters.data_ptr(),
            x.data_ptr(),
            x.stride(0),
            x.stride(1),
            out.data_ptr(),
            None if hidden is None else hidden.data_ptr(),
            self._scratch(B),
        )
        return out

    def backward(self, kept: NativeActivations, output_gradient: Tensor, gradient: Tensor | None, inputs: bool) -> Tensor | None:
        (P, B, _), x = kept.x.shape, kept.x
        of_inputs = torch.empty(P, B, self._layout.inputs) if inputs else None
        output_gradient = output_gradient.contiguous()
        self._library.backward(
            self._shape.pointer,
            P,
            B,
            self._parameters.data_ptr(),
            kept.hidden.data_ptr(),
            x.data_ptr(),
            x.stride(0),
            x.stride(1),
            output_gradient.data_ptr(),
            None if gradient is None else gradient.data_ptr(),
            None if of_inputs is None else of_inputs.data_ptr(),
            self._scratch(B),
        )
        return of_inputs

    def descend(self, kept: NativeActivations, output_gradient: Tensor, optimizer: "PopulationAdam") -> None:
        (P, B, _), x = kept.x.shape, kept.x
        output_gradient = output_gradient.contiguous()
        correction_1, correction_2 = optimizer.next_corrections()
        self._library.descend(
            self._shape.pointer,
            P,
            B,
            self._parameters.data_ptr(),
            kept.hidden.data_ptr(),
            x.data_ptr(),
            x.stride(0),
            x.stride(1),
            output_gradient.data_ptr(),
            optimizer.first_moment.data_ptr(),
            optimizer.second_moment.data_ptr(),
            optimizer.step_sizes.data_ptr(),
            correction_1,
            correction_2,
            self._scratch(B),
        )

    def regress(self, x: Tensor, targets: Tensor, optimizer: "PopulationAdam", follower: Follower | None) -> Tensor:
        P, B, _ = x.shape
        rates = None if follower is None else _rates(follower.parameters, self._parameters, follower.rates)
        x, targets, losses = _dense(x), targets.contiguous(), torch.empty(P)
        correction_1, correction_2 = optimizer.next_corrections()
        self._library.regress(
            self._shape.pointer,
            P,
            B,
            self._parameters.data_ptr(),
            x.data_ptr(),
            x.stride(0),
            x.stride(1),
            targets.data_ptr(),
            optimizer.first_moment.data_ptr(),
            optimizer.second_moment.data_ptr(),
            optimizer.step_sizes.data_ptr(),
            correction_1,
            correction_2,
            None if follower is None else follower.parameters.data_ptr(),
            None if rates is None else rates.data_ptr(),
            losses.data_ptr(),
            self._scratch(B),
        )
        return losses

    def values_of_actions(self, states: Tensor, actions: Tensor) -> Tensor:
        P, B, N, A = actions.shape
        if actions.stride()[2:] != (A, 1):
            actions = actions.contiguous()
        states = _dense(states)
        values = torch.empty(P, B, N)
        self._library.values(
            self._shape.pointer,
            P,
            B,
            N,
            states.shape[2],
            self._parameters.data_ptr(),
            states.data_ptr(),
            states.stride(0),
            states.stride(1),
            actions.data_ptr(),
            actions.stride(0),
            actions.stride(1),
            values.data_ptr(),
            self._scratch(B),
        )
        return values


def _dense(x: Tensor) -> Tensor:
    """Return x, or a copy, with its last axis dense."""
    return x if x.stride(-1) == 1 else x.contiguous()


def polyak_average_(library: Library, target: Tensor, online: Tensor, rates: Tensor) -> None:
    """Move a target [P, n] towards parameters [P, n] at rates [P, 1]. Raises ValueError where a kernel would misread them."""
    rates = _rates(target, online, rates)
    library.polyak(*target.shape, target.data_ptr(), online.data_ptr(), rates.data_ptr())


def _rates(target: Tensor, online: Tensor, rates: Tensor) -> Tensor:
    """Return the rates [P, 1] as kernels read them, for a target and parameters that can be averaged."""
    if online.shape != target.shape or not (target.is_contiguous() and online.is_contiguous()):
        raise ValueError(f"parameters {tuple(online.shape)} for a target {tuple(target.shape)}: both must be dense, and alike")
    return rates.to(torch.float32).expand(len(target), 1).contiguous()
