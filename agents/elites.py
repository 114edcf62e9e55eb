"""The most valuable of the actions drawn in each state: the elites of the conditional cross-entropy method."""

import torch
from torch import Tensor

from agents import kernels
from agents.kernels.layout import aligned


def best_actions(values: Tensor, actions: Tensor, count: int) -> Tensor:
    """Return the `count` actions [P, B, count, A] of highest value, best first, among actions [P, B, N, A] of values [P, B, N].

    Where no value is finite, as in an agent that has diverged, some of its actions are returned.
    """
    native = kernels.library(values.device.type)
    if native is None:
        best = values.topk(count, dim=2).indices
        return actions.gather(2, best.unsqueeze(-1).expand(-1, -1, -1, actions.shape[3]))
    P, B, N, A = actions.shape
    values, actions = values.contiguous(), actions.contiguous()
    best, scratch = torch.empty(P, B, count, A), torch.empty(aligned(N))
    pointers = (values.data_ptr(), actions.data_ptr(), best.data_ptr(), scratch.data_ptr())
    native.best_actions(P * B, N, A, count, *pointers)
    return best
