"""One step of a whole population: act, step the environment, store, learn. On a GPU, captured once and replayed as a CUDA graph.

Nothing in a step waits for the device, and what lasts from step to step is updated in place: a captured step reads and writes the
same memory every time. `Clock` says how it knows which step it is.
"""

from typing import Any

import torch
from torch import Tensor

from agents.algorithm import Algorithm
from agents.clock import Clock
from agents.environment import Environment
from agents.records import Recorder
from agents.replay import Replay
from agents.rng import RandomStream
from agents.spaces import ActionSpace, Discrete

# learning steps before the capture, in which buffers and the libraries' workspaces are allocated; after a restoration, too
_WARM_UP_STEPS = 3


class LockStep:
    """P agents in their environments. `healthy` [P] (bool) are those whose numbers have been finite so far."""

    not_in_checkpoints = ("stream", "_standstill", "_side", "_graph", "_warm_up_steps")

    def __init__(
        self,
        agents: Algorithm,
        world: Environment,
        stream: RandomStream,
        replay: Replay,
        recorder: Recorder,
        clock: Clock,
        cutoff: int,
        batch_size: int,
        *,
        captured: bool = False,
    ) -> None:
        """Start the environments. `captured`: replay a CUDA graph from a few steps after the first update on."""
        self.agents, self.world, self.stream, self.replay, self.recorder = agents, world, stream, replay, recorder
        self.clock, self.cutoff, self.batch_size = clock, cutoff, batch_size
        self._on_device = clock.tensor is not None
        device = stream.seeds.device
        population = len(stream.seeds)
        self.states = world.start(stream, 0).clone()
        self.observations = world.observe(self.states).clone()
        self.elapsed = torch.zeros(population, dtype=torch.int64, device=device)
        self.healthy = torch.ones(population, dtype=torch.bool, device=device)
        self._standstill = standstill(world.actions, device)
        self._captured = captured
        self._side: Any = torch.cuda.Stream(device) if captured else None
        self._graph: Any = None
        self._warm_up_steps = 0

    def run(self) -> None:
        """Take the next step."""
        self.clock.number += 1
        self.stream.prepare(self.clock.number)
        learns = self.clock.number >= self.batch_size
        if self._captured:
            self._run_captured(learns)
        else:
            self._step(learns)
        if self._on_device:
            self.recorder.count()

    def _run_captured(self, learns: bool) -> None:
        if self._warm_up_steps < _WARM_UP_STEPS:
            self._warm_up_steps += learns
            self._side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(self._side):
                self._step(learns)
            torch.cuda.current_stream().wait_stream(self._side)
            return
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph, stream=self._side):  # records the step, does not take it
                self._step(learns)
        self._graph.replay()

    def _step(self, learns: bool) -> None:
        step = self.clock.number
        if self.clock.tensor is not None:
            self.clock.tensor.add_(1)
        actions = self.agents.act(self.observations, step)
        self.healthy &= actions.isfinite().all(dim=1)
        actions = torch.where(self.healthy[:, None], actions, self._standstill)
        transition = self.world.step(self.states, actions)
        outcomes = transition.rewards
        next_observations = self.world.observe(transition.states)
        self.replay.add(self.observations, actions, transition.rewards, transition.terminated, next_observations)
        if learns:
            batch = self.replay.sample(self.stream, step, self.batch_size)
            outcomes = outcomes + self.agents.update(batch, step)  # finite, in float64, if both are
        self.healthy &= outcomes.isfinite()
        self.elapsed += 1
        truncated = self.elapsed >= self.cutoff
        if transition.truncated is not None:
            truncated |= transition.truncated
        truncated &= ~transition.terminated
        self.recorder.add(transition.rewards, transition.terminated, truncated, self.healthy)
        self._go_on(transition.states, next_observations, transition.terminated | truncated, step)

    def _go_on(self, states: Tensor, observations: Tensor, ended: Tensor, step: int) -> None:
        """Make these the current states, but for agents whose episode has ended: they start anew."""
        if self._on_device or ended.any():  # asking a GPU would mean to wait for it
            states = torch.where(ended[:, None], self.world.start(self.stream, step, ended), states)
            observations = self.world.observe(states)
            self.elapsed.masked_fill_(ended, 0)
        if self._on_device:
            self.states.copy_(states)
            self.observations.copy_(observations)
        else:
            self.states, self.observations = states, observations


def standstill(space: ActionSpace, device: torch.device) -> Tensor:
    """Return the action [A] nearest to 0."""
    if isinstance(space, Discrete):
        return torch.zeros(1, device=device)
    low, high = torch.tensor(space.low, device=device), torch.tensor(space.high, device=device)
    return torch.zeros_like(low).clamp(low, high)
