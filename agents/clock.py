"""Which lock-step it is."""

import torch
from torch import Tensor


class Clock:
    """Counts lock-steps from 1: `number` on the host, and `tensor` [1] (int64) where steps are captured in a CUDA graph.

    A captured step is the same kernels every time: what changes from step to step, the place in a buffer or in a random stream,
    has to be read from memory of the device.
    """

    def __init__(self, device: torch.device | None = None) -> None:
        """Count on the host; with a device, there too."""
        self.number = 0
        self.tensor: Tensor | None = None if device is None else torch.zeros(1, dtype=torch.int64, device=device)

    def place_in(self, size: int) -> Tensor:
        """Return the place [1] of this step in a ring buffer of a size: (step − 1) mod size. Needs the device's count."""
        assert self.tensor is not None
        return (self.tensor - 1) % size
