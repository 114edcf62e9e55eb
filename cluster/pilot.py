"""The pilot: a second of real training in a worker, to see how fast a population is there and how much memory it takes.

It runs `agents.train` with the group's own environment and shared hyperparameters, and leaves it in the middle. Only its replay
is as small as can be: what a replay takes is known, and a large one that is hardly filled would blur what everything else takes.
"""

import contextlib
import time
from dataclasses import dataclass, replace

from agents.hypers import Hypers
from agents.registry import find_environment
from cluster import machine
from cluster.worker import device_of  # and with it whatever a worker loads: a shard's memory begins above that
from sweep.calibration import COMMIT_BYTES

_MEASURED_SECONDS = 0.4
_PATIENCE_SECONDS = 2.0
_MIN_STEPS = 2
#: Learning steps before the clock starts: buffers are allocated, caches fill; on a GPU, the step is captured.
WARM_UP_STEPS = 5
_LONGEST = 2_000  # steps after the warm-up, if they take less than the time to be measured
_FLOAT_BYTES = 4
_GPU_CONTEXT_BYTES = 600 * 2**20


@dataclass(frozen=True)
class Pilot:
    """A population to try: `hypers` is any one agent's of the group, `device`, `threads` and `tf32` are as for a shard."""

    agent: str
    environment: str
    hypers: Hypers
    cutoff: int
    discount: float
    population: int
    device: str = "cpu"
    threads: int = 1
    tf32: bool = False


@dataclass(frozen=True)
class Reading:
    """What one worker read off: agent-steps a second (None when it got nowhere in time), bytes before and at most.

    `replay_rows` are the transitions that the replay of each agent had room for.
    """

    agent_steps_per_second: float | None
    replay_rows: int
    base_bytes: int
    peak_bytes: int


@dataclass(frozen=True)
class Footprint:
    """Bytes of a transition in replay, and of committing a shard."""

    row_bytes: int
    commit_bytes: int


class _EnoughError(Exception):
    """The pilot has seen what it came for."""


class _Stopwatch:
    """Called after each step: times the steps after a warm-up and raises _EnoughError when they are enough."""

    def __init__(self, first_update: int, on_gpu: bool) -> None:
        self._start_step = first_update + WARM_UP_STEPS
        self._on_gpu = on_gpu
        self._begun = time.perf_counter()
        self._started = 0.0
        self.steps = 0
        self.seconds = 0.0

    def __call__(self, step: int) -> None:
        if self._on_gpu:
            import torch

            torch.cuda.synchronize()  # steps are only queued there
        now = time.perf_counter()
        if step == self._start_step:
            self._started = now
        elif step > self._start_step:
            self.steps, self.seconds = step - self._start_step, now - self._started
        measured = self.steps >= _MIN_STEPS
        if (measured and self.seconds >= _MEASURED_SECONDS) or now - self._begun > _PATIENCE_SECONDS:
            raise _EnoughError


def run_pilot(pilot: Pilot) -> Reading:
    """Train the population for a moment. Raises whatever the agent's or the environment's code raises."""
    import torch

    from agents.training import train

    torch.set_num_threads(pilot.threads)
    device = device_of(pilot.device)
    on_gpu = device != "cpu"
    first_update = replay_rows = pilot.hypers.batch_size  # type: ignore[attr-defined]  # of ActorCriticHypers, the base of all
    machine.release_freed_memory()
    machine.reset_peak()
    base = machine.resident_bytes()
    if on_gpu:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    watch = _Stopwatch(first_update, on_gpu)
    with contextlib.suppress(_EnoughError):
        train(
            pilot.agent,
            pilot.environment,
            [replace(pilot.hypers, replay_capacity=replay_rows)] * pilot.population,  # type: ignore[call-arg]
            list(range(pilot.population)),
            steps=first_update + WARM_UP_STEPS + _LONGEST,
            cutoff=pilot.cutoff,
            discount=pilot.discount,
            device=device,
            tf32=pilot.tf32,
            on_step=watch,
        )
    peak = machine.peak_bytes()
    if on_gpu:
        base, peak = _GPU_CONTEXT_BYTES, _GPU_CONTEXT_BYTES + torch.cuda.max_memory_reserved()
    machine.release_freed_memory()
    rate = pilot.population * watch.steps / watch.seconds if watch.steps >= _MIN_STEPS else None
    return Reading(rate, replay_rows, base, peak)


def footprint(pilot: Pilot) -> Footprint:
    """Return what a population's memory depends on beside what a pilot reads off. Imports torch, and makes the environment."""
    world = find_environment(pilot.environment).make(1)
    width = 2 * world.observation_size + world.actions.size + 2  # agents.replay: state, action, reward, continues, next state
    return Footprint(width * _FLOAT_BYTES, COMMIT_BYTES if device_of(pilot.device) == "cpu" else 0)
