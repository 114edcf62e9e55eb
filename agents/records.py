"""What training leaves behind: the episodes of every agent, as columns."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.clock import Clock

ENDINGS = ("terminated", "truncated", "budget")
_TERMINATED, _TRUNCATED, _BUDGET = range(3)
_BLOCK_STEPS = 4096
_BLOCK = ("_rewards", "_endings", "_finite")
_SO_FAR = ("_in_block", "_steps", "_partial_return", "_first_step", "_diverged_at")


@dataclass(frozen=True)
class Records:
    """Episodes of P agents, sorted by agent and time; one entry an episode.

    `agent` counts from 0, `episode` from 0, `first_step` from 1; `episodic_return` is float32, NaN from the episode on in which
    the agent diverged; `ending` indexes ENDINGS. The lengths of an agent's episodes sum to `steps`. `diverged_at` [P] is
    the step at which an agent's numbers stopped being finite, 0 if they never did.
    """

    steps: int
    agent: np.ndarray
    episode: np.ndarray
    first_step: np.ndarray
    length: np.ndarray
    episodic_return: np.ndarray
    ending: np.ndarray
    diverged_at: np.ndarray
    evaluations: "Evaluations | None" = None


@dataclass(frozen=True)
class Evaluations:
    """Deterministic evaluation episodes, one entry each: `step` is the steps of learning before, `episode` counts within it.

    `ending` indexes ENDINGS; `episodic_return` is float32, NaN for an agent that had diverged.
    """

    agent: np.ndarray
    step: np.ndarray
    episode: np.ndarray
    length: np.ndarray
    episodic_return: np.ndarray
    ending: np.ndarray


def side_by_side(records: Sequence[Records]) -> Records:
    """Return the records of agents that were trained one after another as those of one population. Evaluations are not kept."""
    counts = np.cumsum([0, *(len(one.diverged_at) for one in records)])
    return Records(
        steps=records[0].steps,
        agent=np.concatenate([one.agent + first for one, first in zip(records, counts[:-1], strict=True)]).astype(np.int32),
        episode=np.concatenate([one.episode for one in records]),
        first_step=np.concatenate([one.first_step for one in records]),
        length=np.concatenate([one.length for one in records]),
        episodic_return=np.concatenate([one.episodic_return for one in records]),
        ending=np.concatenate([one.ending for one in records]),
        diverged_at=np.concatenate([one.diverged_at for one in records]),
    )


class Recorder:
    """Collects rewards step by step and turns them into episodes a block at a time: memory does not grow with the steps."""

    def __init__(self, population: int, device: torch.device, clock: Clock | None = None) -> None:
        """With a clock that counts on the device, one step is added for each of its own, at the place that it gives."""
        self._clock = clock if clock is not None and clock.tensor is not None else None
        self._rewards = torch.zeros(_BLOCK_STEPS, population, dtype=torch.float64, device=device)
        self._endings = torch.zeros(_BLOCK_STEPS, population, dtype=torch.uint8, device=device)
        self._finite = torch.ones(_BLOCK_STEPS, population, dtype=torch.bool, device=device)
        self._in_block = 0
        self._steps = 0
        self._partial_return = np.zeros(population)
        self._first_step = np.ones(population, dtype=np.int64)
        self._diverged_at = np.zeros(population, dtype=np.int64)
        self._episodes: list[tuple[np.ndarray, ...]] = []

    def add(self, rewards: Tensor, terminated: Tensor, truncated: Tensor, finite: Tensor) -> None:
        """Add one step: rewards [P], how an episode ended with it [P] (bool), and whether the agents' numbers are finite [P]."""
        endings = terminated + 2 * truncated.to(torch.uint8)
        if self._clock is None:
            i = self._in_block
            self._rewards[i], self._endings[i], self._finite[i] = rewards, endings, finite
            self.count()
            return
        place = self._clock.place_in(len(self._rewards))
        for column, now in ((self._rewards, rewards), (self._endings, endings), (self._finite, finite)):
            column.index_copy_(0, place, now.unsqueeze(0))

    def count(self) -> None:
        """Note on the host that a step was added; `add` does so itself unless the clock counts on the device."""
        self._in_block += 1
        if self._in_block == len(self._rewards):
            self._flush()

    def state_for_checkpoint(self) -> dict[str, Any]:
        """Return the steps of the block that is not full yet, and the episodes so far, one array a column."""
        block = {name: getattr(self, name)[: self._in_block].cpu().numpy() for name in _BLOCK}
        episodes = [np.concatenate(column) for column in zip(*self._episodes, strict=True)]
        return {**block, **{name: getattr(self, name) for name in _SO_FAR}, "episodes": episodes}

    def restore_from_checkpoint(self, state: dict[str, Any]) -> None:
        """Go on where another recorder was."""
        for name in _BLOCK:
            now = state[name]
            getattr(self, name)[: len(now)] = torch.from_numpy(np.array(now)).to(self._rewards.device)
        for name in _SO_FAR:
            setattr(self, name, np.array(state[name]) if isinstance(state[name], np.ndarray) else state[name])
        self._episodes = [tuple(np.array(column) for column in state["episodes"])] if state["episodes"] else []

    def _flush(self) -> None:
        rewards = self._rewards[: self._in_block].cpu().numpy()
        endings = self._endings[: self._in_block].cpu().numpy()
        finite = self._finite[: self._in_block].cpu().numpy()
        first_bad = np.where(finite.all(axis=0), 0, self._steps + 1 + np.argmin(finite, axis=0))
        self._diverged_at = np.where(self._diverged_at > 0, self._diverged_at, first_bad)
        for agent in range(rewards.shape[1]):
            self._flush_agent(agent, rewards[:, agent], endings[:, agent])
        self._steps += self._in_block
        self._in_block = 0

    def _flush_agent(self, agent: int, rewards: np.ndarray, endings: np.ndarray) -> None:
        (last,) = np.nonzero(endings)
        rest = rewards
        if len(last):
            starts = np.concatenate([[0], last[:-1] + 1])
            returns = np.add.reduceat(rewards[: last[-1] + 1], starts)
            returns[0] += self._partial_return[agent]
            last_step = self._steps + last + 1
            first_step = np.concatenate([[self._first_step[agent]], last_step[:-1] + 1])
            codes = endings[last] - 1
            self._episodes.append((np.full(len(last), agent), first_step, last_step - first_step + 1, returns, codes))
            self._first_step[agent] = last_step[-1] + 1
            self._partial_return[agent] = 0.0
            rest = rewards[last[-1] + 1 :]
        self._partial_return[agent] += rest.sum()

    def finish(self) -> Records:
        """Return the records; an unfinished last episode ends by the budget."""
        if self._in_block:
            self._flush()
        (open_,) = np.nonzero(self._first_step <= self._steps)
        first = self._first_step[open_]
        rest = (open_, first, self._steps - first + 1, self._partial_return[open_], np.full(len(open_), _BUDGET))
        agent, first, length, returns, ending = map(np.concatenate, zip(*self._episodes, rest, strict=True))
        order = np.lexsort((first, agent))
        agent, first, length, returns, ending = (x[order] for x in (agent, first, length, returns, ending))
        starts = np.searchsorted(agent, np.arange(len(self._diverged_at)))
        diverged_at = self._diverged_at[agent]
        returns = np.where((diverged_at > 0) & (first + length - 1 >= diverged_at), np.nan, returns)
        return Records(
            steps=self._steps,
            agent=agent.astype(np.int32),
            episode=(np.arange(len(agent)) - starts[agent]).astype(np.int32),
            first_step=first.astype(np.int32),
            length=length.astype(np.int32),
            episodic_return=returns.astype(np.float32),
            ending=ending.astype(np.uint8),
            diverged_at=self._diverged_at,
        )
