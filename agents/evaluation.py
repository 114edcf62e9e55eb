"""Deterministic evaluation episodes beside the learning (thesis chapter 3), which they do not touch.

They run in an environment of their own, from start states of their own random streams, and learn nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.algorithm import Algorithm
from agents.environment import Environment
from agents.records import ENDINGS, Evaluations
from agents.rng import RandomStream

_STREAM = 2**62  # seeds are smaller: an evaluation stream is nobody's training stream


@dataclass(frozen=True)
class Evaluation:
    """How often and how much: after every `every` steps, `episodes` episodes."""

    every: int
    episodes: int

    def __post_init__(self) -> None:
        if self.every < 1 or self.episodes < 1:
            raise ValueError(f"every = {self.every}, episodes = {self.episodes}: must be at least 1")


class Evaluator:
    """Runs evaluation episodes of a population and collects their returns."""

    def __init__(self, evaluation: Evaluation, world: Environment, seeds: Tensor, cutoff: int) -> None:
        """Take an environment that nobody trains in, and the agents' seeds [P]."""
        self.evaluation, self.world, self.cutoff = evaluation, world, cutoff
        self.stream = RandomStream(seeds + _STREAM)
        self._rows: list[tuple[np.ndarray, ...]] = []

    def run(self, agents: Algorithm, step: int, healthy: Tensor) -> None:
        """Evaluate the agents after `step` steps of learning; those that are not `healthy` [P] get the return NaN."""
        for episode in range(self.evaluation.episodes):
            total, length, ending = self._episode(agents, step * self.evaluation.episodes + episode, healthy)
            P = len(total)
            self._rows.append((np.arange(P), np.full(P, step), np.full(P, episode), length, total, ending))

    def _episode(self, agents: Algorithm, number: int, healthy: Tensor) -> Sequence[np.ndarray]:
        states = self.world.start(self.stream, number)
        total = torch.zeros(len(healthy), dtype=torch.float64, device=healthy.device)
        length = torch.zeros(len(healthy), dtype=torch.int64, device=healthy.device)
        running = torch.ones_like(healthy)
        terminated = torch.zeros_like(healthy)
        for _ in range(self.cutoff):
            actions = agents.act_deterministically(self.world.observe(states)).nan_to_num(0.0)
            transition = self.world.step(states, actions)
            states = transition.states
            total += torch.where(running, transition.rewards, 0.0)
            length += running
            terminated |= running & transition.terminated
            ended = transition.terminated if transition.truncated is None else transition.terminated | transition.truncated
            running &= ~ended
            if not running.any():
                break
            if ended.any():  # one that keeps its own state has to begin anew; what it does then does not count
                states = torch.where(ended[:, None], self.world.start(self.stream, number, ended), states)
        total = torch.where(healthy, total, torch.nan)
        ending = torch.where(terminated, ENDINGS.index("terminated"), ENDINGS.index("truncated"))
        return [x.cpu().numpy() for x in (total, length, ending)]

    def state_for_checkpoint(self) -> dict[str, Any]:
        """Return the episodes so far, one array a column; the environment starts anew with every evaluation."""
        return {"columns": [np.concatenate(column) for column in zip(*self._rows, strict=True)]}

    def restore_from_checkpoint(self, state: dict[str, Any]) -> None:
        """Go on where another evaluator was."""
        self._rows = [tuple(np.array(column) for column in state["columns"])] if state["columns"] else []

    def finish(self, num_agents: int) -> Evaluations:
        """Return the episodes of the first `num_agents` agents, by agent, step and episode."""
        columns = [np.concatenate(column) for column in zip(*self._rows, strict=True)] if self._rows else [np.zeros(0)] * 6
        agent, step, episode, length, total, ending = columns
        order = np.lexsort((episode, step, agent))
        order = order[agent[order] < num_agents]
        return Evaluations(
            agent=agent[order].astype(np.int32),
            step=step[order].astype(np.int32),
            episode=episode[order].astype(np.int32),
            length=length[order].astype(np.int32),
            episodic_return=total[order].astype(np.float32),
            ending=ending[order].astype(np.uint8),
        )
