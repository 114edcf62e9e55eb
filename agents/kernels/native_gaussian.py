"""A Gaussian policy on the native kernels: what `agents.policies.Gaussian` does, bit for bit, in a call each."""

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from agents.kernels.native import Library

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

    def __init__(self, library: Library, outputs: Tensor, ends: Sequence[Tensor], log_std_limit: float) -> None:
        """Condition on dense float32 outputs [P, B, 2A] on the CPU, ln σ within ± the limit.

        `ends` are the action range's low and high end, middle, and half of its width, float32 [A] each.
        """
        P, B, A = outputs.shape[0], outputs.shape[1], outputs.shape[2] // 2
        self._library, self._shape = library, (P, B, A)
        self.tanh = torch.tanh(outputs[..., :A])
        self.mean, self.log_std = torch.empty(P, B, A), torch.empty(P, B, A)
        self._kept_alive = (outputs, *ends)
        pointers = [x.data_ptr() for x in (outputs, self.tanh, self.mean, self.log_std)]
        self._policy = _Gaussian(P * B, A, log_std_limit, *pointers, None, *(x.data_ptr() for x in ends))
        self._pointer = ctypes.addressof(self._policy)
        library.gaussian_condition(self._pointer)
        self.std = torch.exp(self.log_std)
        self._policy.std = self.std.data_ptr()

    def reads(self, x: Tensor, weights: Tensor | float = 0.0) -> bool:
        """Whether kernels can read actions or noise, [P, B, N, A], and weights [P, B, N], and nobody asks for their gradients.

        What else there is, such as numbers of another type or shapes that broadcast, is left to PyTorch.
        """
        P, B, A = self._shape
        if x.dim() != 4 or x.shape[0] != P or x.shape[1] != B or x.shape[3] != A or not is_plain(x):
            return False
        return not isinstance(weights, Tensor) or (weights.shape == x.shape[:3] and is_plain(weights))

    def sample(self, noise: Tensor, *, clamps: bool) -> Tensor:
        """Return samples [P, B, N, A] for noise of that shape, clamped to the action range or not."""
        noise, row = _rows(noise)
        out = torch.empty(noise.shape)
        self._library.gaussian_sample(self._pointer, noise.shape[2], noise.data_ptr(), row, clamps, out.data_ptr())
        return out

    def log_prob(self, actions: Tensor) -> Tensor:
        """Return ln π [P, B, N] of actions [P, B, N, A], A at most MOST_TERMS."""
        actions, row = _rows(actions)
        out = torch.empty(actions.shape[:3])
        self._library.gaussian_log_prob(self._pointer, actions.shape[2], actions.data_ptr(), row, out.data_ptr())
        return out

    def log_prob_gradient(self, actions: Tensor, weights: Tensor | float) -> Tensor:
        """Return ∂/∂outputs of Σ_n w_n ln π(a_n) [P, B, 2A]: actions [P, B, N, A], weights [P, B, N], N at most MOST_TERMS."""
        actions, row = _rows(actions)
        many, one = None, 0.0
        if isinstance(weights, Tensor):
            weights = weights.contiguous()
            many = weights.data_ptr()
        else:
            one = weights
        P, B, A = self._shape
        out, N = torch.empty(P, B, 2 * A), actions.shape[2]
        self._library.gaussian_log_prob_gradient(self._pointer, N, actions.data_ptr(), row, many, one, out.data_ptr())
        return out


def is_plain(x: Tensor) -> bool:
    """Whether kernels can read these numbers, and nobody asks for the graph of what is computed from them."""
    return x.dtype == torch.float32 and x.device.type == "cpu" and not x.requires_grad


def _rows(x: Tensor) -> tuple[Tensor, int]:
    """Return actions or noise [P, B, N, A] as the kernels read them, and the floats from one state's to the next one's."""
    _, B, N, A = x.shape
    agent, row, sample, dimension = x.stride()
    if dimension != 1 or (sample != A and N > 1) or agent != B * row:
        return x.contiguous(), N * A
    return x, row
