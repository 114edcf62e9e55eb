"""Where the weights of a population network lie in an agent's flat parameters: the one truth for every engine. Torch-free.

A hidden layer is a matrix [fan_in, stride] and a row of biases; the head is stored transposed, [fan_out, stride], so that a row
of it can be multiplied with a row of activations. Everything starts at a cache line, and rows are padded to whole lines; the
padding is zero, and stays so: its gradient is zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

LINE = 16  # floats in a cache line
_ALIASED = 128  # rows that are a multiple of this many floats apart compete for few places in a first-level cache


@dataclass(frozen=True)
class LayerLayout:
    """One linear layer: the offsets of its weights and biases, its sizes, and the floats from one row to the next.

    A hidden layer has a row for each input (with padding, `rows`), the head one for each output; `stride` ≥ `columns` ≥ width.
    """

    weights: int
    biases: int
    fan_in: int
    fan_out: int
    rows: int
    columns: int
    stride: int


@dataclass(frozen=True)
class Layout:
    """All layers of a network, the head last; `size` is the number of floats of an agent, a multiple of LINE."""

    layers: tuple[LayerLayout, ...]
    size: int

    @property
    def inputs(self) -> int:
        """Width of the input."""
        return self.layers[0].fan_in

    @property
    def outputs(self) -> int:
        """Width of the output."""
        return self.layers[-1].fan_out

    @property
    def hidden(self) -> tuple[LayerLayout, ...]:
        """The hidden layers."""
        return self.layers[:-1]


def lay_out(widths: Sequence[int]) -> Layout:
    """Return the layout of a network input → hidden … → output, from the widths; at least one hidden layer."""
    layers, offset, rows = [], 0, widths[0]
    hidden = list(pairwise(widths[:-1]))
    for fan_in, fan_out in hidden:
        columns, stride = aligned(fan_out), _stride(fan_out)
        biases = offset + aligned(rows * stride)
        layers.append(LayerLayout(offset, biases, fan_in, fan_out, rows, columns, stride))
        offset, rows = biases + stride, columns
    below, outputs = layers[-1], widths[-1]
    biases = offset + outputs * below.stride
    layers.append(LayerLayout(offset, biases, below.fan_out, outputs, outputs, below.columns, below.stride))
    return Layout(tuple(layers), biases + aligned(outputs))


def aligned(size: int) -> int:
    """Round a number of floats up to whole cache lines."""
    return -(-size // LINE) * LINE


def _stride(width: int) -> int:
    return aligned(width) + (LINE if aligned(width) % _ALIASED == 0 else 0)
