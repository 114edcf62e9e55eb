"""One counter-based random stream an agent, independent of who is trained beside it.

Philox4x32-10 (Salmon et al., "Parallel Random Numbers: As Easy as 1, 2, 3", SC 2011) with the agent's seed as the key and
(block, step, purpose, 0) as the counter: a number depends on (seed, purpose, step, index) and on nothing else. Nothing is
stored, so nothing has to be saved or restored, and drawing more numbers for one purpose moves no other.

Numbers come in groups of 64: group g holds the four words of the 16 counters 16g … 16g + 15, word by word.
"""

import math
from collections.abc import Callable
from enum import IntEnum

import torch
from torch import Tensor

from agents import kernels
from agents.clock import Clock

_LANES = 16
_WORD = 0xFFFFFFFF
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
_KEY_INCREMENTS = (0x9E3779B9, 0xBB67AE85)
_MOST_STEPS = 64
_BLOCK_ELEMENTS = {"cpu": 1 << 15, "cuda": 1 << 23}  # what a cache holds; enough to fill a GPU


class Purpose(IntEnum):
    """What a random number is for: streams of different purposes never meet."""

    INITIAL_WEIGHTS = 0
    START_STATE = 1
    ACTION = 2
    MINIBATCH = 3
    NEXT_ACTION = 4
    POLICY_UPDATE = 5
    ENTROPY = 6


def philox(key: Tensor, counter: tuple[Tensor, Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the four 32-bit words (as int64) of Philox4x32-10 for int64 keys and counters that broadcast together."""
    k0, k1 = key & _WORD, (key >> 32) & _WORD
    c0, c1, c2, c3 = counter
    for _ in range(10):
        product0, product1 = c0 * _MULTIPLIERS[0], c2 * _MULTIPLIERS[1]  # modulo 2^64; the words are the same
        c0, c1, c2, c3 = (
            ((product1 >> 32) & _WORD) ^ c1 ^ k0,
            product1 & _WORD,
            ((product0 >> 32) & _WORD) ^ c3 ^ k1,
            product0 & _WORD,
        )
        k0, k1 = (k0 + _KEY_INCREMENTS[0]) & _WORD, (k1 + _KEY_INCREMENTS[1]) & _WORD
    return c0, c1, c2, c3


class RandomStream:
    """The random streams of P agents.

    Drawing is stateless: the same (purpose, step, shape) gives the same numbers again. The native kernels draw a step at a time;
    PyTorch computes blocks of consecutive steps at once and keeps them, because training asks for one step after another. Words,
    uniform numbers and integers are the same in both; normal ones differ by rounding.
    """

    def __init__(self, seeds: Tensor) -> None:
        """Take the agents' seeds [P] (int64, ≥ 0)."""
        self.seeds = seeds.contiguous()
        self._native = kernels.library(seeds.device.type)
        self._blocks: dict[tuple[str, int, int], tuple[int, Tensor]] = {}
        self._clock: Clock | None = None
        self._followed: set[tuple[str, int, int]] = set()

    def follow(self, clock: Clock) -> None:
        """Read numbers for the clock's step at the place that its count on the device gives, if it counts there."""
        self._clock = clock if clock.tensor is not None else None

    def prepare(self, step: int) -> None:
        """Make sure that whatever was drawn for the clock's steps before can be drawn for this one without a new block."""
        for kind, purpose, count in self._followed:
            self._block(step, kind, purpose, count)

    def words(self, purpose: int, first_step: int, num_steps: int, count: int) -> Tensor:
        """Return 32-bit words as int64 [P, num_steps, ⌈count / 64⌉, 4, 16] for `num_steps` steps from `first_step`."""
        groups = -(-count // (4 * _LANES))
        device = self.seeds.device
        key = self.seeds[:, None, None]
        block = torch.arange(groups * _LANES, device=device)[None, None, :]
        step = torch.arange(first_step, first_step + num_steps, device=device)[None, :, None]
        zero = torch.zeros((), dtype=torch.int64, device=device)
        words = philox(key, (block, step, zero + int(purpose), zero))
        shape = (len(self.seeds), num_steps, groups, _LANES)
        return torch.stack([word.expand(shape[0], num_steps, groups * _LANES).view(shape) for word in words], dim=3)

    def uniforms(self, purpose: int, step: int, count: int) -> Tensor:
        """Return float32 [P, count], uniform on (0, 1]: at most 2^24 values, of which 1 is the rarest (rounding)."""
        if self._native is not None:
            return self._drawn(self._native.uniforms, purpose, step, count)
        return self._at(step, "uniform", purpose, count)

    def normals(self, purpose: int, step: int, count: int) -> Tensor:
        """Return float32 [P, count], standard normal (Box–Muller on pairs of words)."""
        if self._native is not None:
            return self._drawn(self._native.normals, purpose, step, count)
        return self._at(step, "normal", purpose, count)

    def integers(self, purpose: int, step: int, count: int, high: int | Tensor, offset: int = 0) -> Tensor:
        """Return int64 [P, count], uniform on 0 … high − 1 (multiply-shift; bias below high / 2^32); plus p · offset, agent p."""
        if self._native is not None:
            P, out = len(self.seeds), torch.empty(len(self.seeds), count, dtype=torch.int64)
            self._native.integers(P, self.seeds.data_ptr(), purpose, step, count, high, offset, out.data_ptr())
            return out
        drawn = (self._at(step, "word", purpose, count) * high) >> 32
        return drawn + torch.arange(0, len(self.seeds) * offset, offset, device=drawn.device)[:, None] if offset else drawn

    def _drawn(self, kernel: Callable[..., None], purpose: int, step: int, count: int) -> Tensor:
        out = torch.empty(len(self.seeds), count)
        kernel(len(self.seeds), self.seeds.data_ptr(), purpose, step, count, out.data_ptr())
        return out

    def _at(self, step: int, kind: str, purpose: int, count: int) -> Tensor:
        first, block = self._block(step, kind, purpose, count)
        if self._clock is not None and self._clock.tensor is not None and step == self._clock.number:
            self._followed.add((kind, purpose, count))
            return block.index_select(1, self._clock.tensor % block.shape[1]).squeeze(1)
        return block[:, step - first]

    def _block(self, step: int, kind: str, purpose: int, count: int) -> tuple[int, Tensor]:
        """Return the first step of the block that holds a step, a multiple of its length, and the block [P, steps, count].

        A block that follows the clock is computed again in its place, where captured steps read it.
        """
        first, block = self._blocks.get((kind, purpose, count), (-1, None))
        if block is not None and first <= step < first + block.shape[1]:
            return first, block
        elements = _BLOCK_ELEMENTS.get(self.seeds.device.type, _BLOCK_ELEMENTS["cpu"])
        num_steps = max(1, min(_MOST_STEPS, elements // (len(self.seeds) * count)))
        first = step // num_steps * num_steps
        drawn = self._draw(kind, purpose, first, num_steps, count)
        followed = (kind, purpose, count) in self._followed
        block = block.copy_(drawn) if block is not None and followed else drawn.contiguous()
        self._blocks[kind, purpose, count] = first, block
        return first, block

    def _draw(self, kind: str, purpose: int, first_step: int, num_steps: int, count: int) -> Tensor:
        words = self.words(purpose, first_step, num_steps, count)
        if kind == "normal":
            uniform = _open_uniform(words)
            radius = torch.log(uniform[:, :, :, 0::2]).mul_(-2).sqrt_()
            angle = uniform[:, :, :, 1::2] * (2 * math.pi)
            values = torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)], dim=3)  # [P, T, G, 2, 2, 16]
        else:
            values = words if kind == "word" else _open_uniform(words)
        return values.flatten(2)[:, :, :count]


def _open_uniform(words: Tensor) -> Tensor:
    return (words >> 8).to(torch.float32).add_(0.5).mul_(2.0**-24)
