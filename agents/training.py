"""The lock-step loop: every agent of a population takes a step, stores it and learns from it, all at once."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch

from agents.algorithm import Task
from agents.hypers import Hypers
from agents.population import padded
from agents.records import Recorder, Records
from agents.registry import ALGORITHMS, ENVIRONMENTS
from agents.replay import Replay


def train(
    algorithm: str,
    environment: str,
    hypers: Sequence[Hypers],
    seeds: Sequence[int],
    *,
    steps: int,
    cutoff: int | None = None,
    discount: float = 0.99,
    device: str = "cpu",
    on_step: Callable[[int], None] | None = None,
) -> Records:
    """Train one agent for each pair of hyperparameters and seed, and return their episodes.

    The result of an agent depends on its own hyperparameters and seed only, bit for bit on one machine, not on who is trained
    beside it. One update follows every step from the `batch_size`-th on; returns are those of the learning policy.
    `cutoff` truncates episodes (default: the environment's own); `on_step` is called after each step with its number.

    Raises KeyError for an unknown algorithm or environment, ValueError when the agents cannot be trained together or are not of
    this algorithm, or when steps or cutoff are less than 1.
    """
    if steps < 1 or (cutoff is not None and cutoff < 1):
        raise ValueError(f"steps = {steps}, cutoff = {cutoff}: must be at least 1")
    if not all(isinstance(one, ALGORITHMS[algorithm].hypers) for one in hypers):
        raise ValueError(f"{algorithm} takes {ALGORITHMS[algorithm].hypers.__name__}")
    known = ENVIRONMENTS[environment]
    population = padded(hypers, seeds, torch.device(device))
    world = known.load()()
    stream = population.stream()
    task = Task(world.observation_size, world.actions, discount)
    batch_size = population.shared.batch_size
    capacity = min(population.shared.replay_capacity, steps)
    with torch.no_grad(), _denormals_flushed():
        agents = ALGORITHMS[algorithm].load()(population, task, stream)
        replay = Replay(len(population), capacity, task.observation_size, task.actions.size, population.device)
        recorder = Recorder(len(population), population.device)
        states = world.start(stream, 0)
        observations = world.observe(states)
        elapsed = torch.zeros(len(population), dtype=torch.int64, device=population.device)
        for step in range(1, steps + 1):
            actions = agents.act(observations, step)
            transition = world.step(states, actions)
            states, next_observations = transition.states, world.observe(transition.states)
            replay.add(observations, actions, transition.rewards, transition.terminated, next_observations)
            finite = actions.isfinite().all(dim=1)
            if step >= batch_size:
                finite &= agents.update(replay.sample(stream, step, batch_size), step).isfinite()
            elapsed += 1
            truncated = (elapsed >= (cutoff or known.cutoff)) & ~transition.terminated
            ended = transition.terminated | truncated
            recorder.add(transition.rewards, transition.terminated, truncated, finite)
            observations = next_observations
            if ended.any():
                states = torch.where(ended[:, None], world.start(stream, step), states)
                observations = world.observe(states)
                elapsed = elapsed.masked_fill(ended, 0)
            if on_step is not None:
                on_step(step)
    return _without_copies(recorder.finish(), len(hypers))


@contextmanager
def _denormals_flushed() -> Iterator[None]:
    """Treat denormal numbers as zero: Adam's moments reach them in long runs, and they are slow."""
    flushed_before = torch.tensor(1e-40) * 1 == 0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(bool(flushed_before))


def _without_copies(records: Records, num_agents: int) -> Records:
    """Drop what `padded` added."""
    kept = records.agent < num_agents
    columns = {
        name: getattr(records, name)[kept] for name in ("agent", "episode", "first_step", "length", "episodic_return", "ending")
    }
    return replace(records, diverged_at=records.diverged_at[:num_agents], **columns)
