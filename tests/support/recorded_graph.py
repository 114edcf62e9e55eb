"""What a CUDA graph does, on any device: tensor operations recorded once, with their very tensors, and replayed."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


def tensors(tree):
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor)]


class RecordedGraph(TorchDispatchMode):
    """Operations within the block run, and are recorded; `replay` runs them again on the same memory.

    Numbers that Python computed are part of the recording, and so are the addresses of tensors: what changes from one run to the
    next, and is not in a tensor that the operations read, stays as it was recorded.
    """

    def __init__(self):
        super().__init__()
        self.calls = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        result = function(*args, **kwargs)
        self.calls.append((function, args, kwargs, result))
        return result

    def replay(self):
        for function, args, kwargs, recorded in self.calls:
            given = {x.untyped_storage().data_ptr() for x in tensors((args, kwargs))}
            again = function(*args, **kwargs)
            for old, new in zip(tensors(recorded), tensors(again), strict=True):
                if old.untyped_storage().data_ptr() not in given:  # neither a view nor changed in place
                    old.copy_(new)
