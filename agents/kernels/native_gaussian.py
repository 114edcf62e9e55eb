"""A Gaussian policy on the native kernels: what `agents.policies.Gaussian` does, bit for bit, in a call each."""

import ctypes
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from agents.kernels.native import Library

if TYPE_CHECKING:
    from agents.policies import Bounds

MOST_TERMS = 4  # sums of so few are taken in order, by PyTorch too
_POINTER = ctypes.c_void_p


class _Gaussian(ctypes.Structure):
    _fields_ = (
        ("rows", ctypes.c_int64),
        ("size", ctypes.c_int32),
        ("log_std_limit", ctypes.c_float),
        ("outputs", _POINTER),
        ("tanh", _POINTER),
        ("mean", _POINTER),
        ("log_std", _POINTER),
        ("std", _POINTER),
        ("low", _POINTER),
        ("high", _POINTER),
        ("middle", _POINTER),
        ("half_range", _POINTER),
    )


class NativeGaussian:
    """The policy of an actor's outputs; `tanh` of their first half, `mean`, `log_std` and `std` are [P, B, A]."""

    def __init__(self, library: Library, outputs: Tensor, bounds: "Bounds", log_std_limit: float) -> None:
        """Condition on outputs [P, B, 2A], ln σ within ± the limit; they and the bounds are to be kept alive."""
        P, B, A = outputs.shape[0], outputs.shape[1], len(bounds.low)
        self._library, self._shape = library, (P, B, A)
        self.tanh = torch.tanh(outputs[..., :A])
        self.mean, self.log_std = torch.empty(P, B, A), torch.empty(P, B, A)
        ends = (bounds.low, bounds.high, bounds.middle, bounds.half_range)
        conditioned = (outputs, self.tanh, self.mean, self.log_std)
        pointers = [x.data_ptr() for x in conditioned]
        self._policy = _Gaussian(P * B, A, log_std_limit, *pointers, None, *(x.data_ptr() for x in ends))
        self._pointer = ctypes.addressof(self._policy)
        library.gaussian_condition(self._pointer)
        self.std = torch.exp(self.log_std)
        self._policy.std = self.std.data_ptr()

    def sample(self, noise: Tensor, *, clamps: bool) -> Tensor:
        """Return samples [P, B, N, A] for noise of that shape, clamped to the action range or not."""
        noise, row = self._read(noise)
        out = torch.empty(noise.shape)
        self._library.gaussian_sample(self._pointer, noise.shape[2], noise.data_ptr(), row, clamps, out.data_ptr())
        return out

    def log_prob(self, actions: Tensor) -> Tensor:
        """Return ln π [P, B, N] of actions [P, B, N, A], A at most MOST_TERMS."""
        actions, row = self._read(actions)
        out = torch.empty(actions.shape[:3])
        self._library.gaussian_log_prob(self._pointer, actions.shape[2], actions.data_ptr(), row, out.data_ptr())
        return out

    def log_prob_gradient(self, actions: Tensor, weights: Tensor | float) -> Tensor:
        """Return ∂/∂outputs of Σ_n w_n ln π(a_n) [P, B, 2A]: actions [P, B, N, A], weights [P, B, N], N at most MOST_TERMS."""
        actions, row = self._read(actions)
        many, one = None, 0.0
        if isinstance(weights, Tensor):
            if weights.shape != actions.shape[:3] or weights.dtype != torch.float32:
                raise ValueError(f"weights {tuple(weights.shape)} of {weights.dtype} for actions {tuple(actions.shape)}")
            weights = weights.contiguous()
            many = weights.data_ptr()
        else:
            one = weights
        P, B, A = self._shape
        out, N = torch.empty(P, B, 2 * A), actions.shape[2]
        self._library.gaussian_log_prob_gradient(self._pointer, N, actions.data_ptr(), row, many, one, out.data_ptr())
        return out

    def _read(self, x: Tensor) -> tuple[Tensor, int]:
        """Return actions or noise [P, B, N, A] as the kernels read them, and the floats from one state's to the next one's."""
        P, B, A = self._shape
        if x.dtype != torch.float32 or x.dim() != 4 or x.shape[:2] != (P, B) or x.shape[3] != A:
            raise ValueError(f"actions {tuple(x.shape)} of {x.dtype}: must be [{P}, {B}, N, {A}] of torch.float32")
        agent, row, sample, dimension = x.stride()
        if dimension != 1 or (sample != A and x.shape[2] > 1) or agent != B * row:
            x = x.contiguous()
            row = x.shape[2] * A
        return x, row
