"""Networks for tests of the native kernels, the variants of the kernels that this processor can run, and the shapes to try."""

import itertools

import torch

from agents.kernels import native
from agents.networks import PopulationMLP

P = 3
SHAPES = [
    # inputs, hidden, outputs, batch
    (3, (64, 64, 64), 1, 32),
    (2, (64, 64), 2, 32),
    (3, (64, 64), 1, 1),
    (4, (8,), 3, 5),
    (7, (10, 33, 7), 2, 13),
    (17, (256, 256), 6, 32),
    (5, (128, 112, 144), 1, 7),
    (1, (1, 1), 1, 2),
    (23, (65, 300), 4, 33),
    (4, (8,), 3, 200),
]


def variants():
    try:
        best = native.load(None)
    except native.NotAvailableError:
        return []
    return [f"native-{name}" for name in best.compiled[best.compiled.index(best.variant) :]]


def network(inputs, hidden, heads, seed=0, population=P):
    generator = torch.Generator().manual_seed(seed)
    made = PopulationMLP(population, inputs, hidden, heads)
    for part in itertools.chain(*made.layers):
        part.copy_(torch.randn(part.shape, generator=generator) / part.shape[1] ** 0.5)
    return made, generator
