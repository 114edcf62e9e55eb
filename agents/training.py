"""The lock-step loop: every agent of a population takes a step, stores it and learns from it, all at once."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch

from agents import kernels
from agents.algorithm import Task
from agents.clock import Clock
from agents.environment import Environment
from agents.evaluation import Evaluation, Evaluator
from agents.hypers import Hypers
from agents.lockstep import LockStep
from agents.memory import keep_freed_memory
from agents.population import Population, padded
from agents.records import Recorder, Records
from agents.registry import Algorithm as AlgorithmEntry
from agents.registry import Environment as EnvironmentEntry
from agents.registry import find_algorithm, find_environment
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
    tf32: bool = False,
    evaluation: Evaluation | None = None,
    on_step: Callable[[int], None] | None = None,
) -> Records:
    """Train one agent for each pair of hyperparameters and seed, and return their episodes.

    The result of an agent depends on its own hyperparameters and seed only, bit for bit on one machine, not on who is trained
    beside it. One update follows every step from the `batch_size`-th on; returns are those of the learning policy.
    `cutoff` truncates episodes (default: the environment's own); `on_step` is called after each step with its number.
    `tf32` lets a GPU round the operands of matrix products to 10 bits of mantissa: faster, and other numbers.
    `evaluation` asks for deterministic episodes beside the learning, which does not change by them.

    An agent whose action, reward or critic loss stops being finite has diverged: it is marked, its returns are NaN from that
    episode on, and it stands still (action 0, or the nearest there is) for the rest of its steps.
    `algorithm` and `environment` are names that `agents.registry` can find: built in, a Gymnasium id, or `package.module:Name`.

    Raises AlgorithmLookupError or EnvironmentLookupError for names that lead nowhere, ValueError when the agents cannot be
    trained together, are not of this algorithm, or cannot act in this environment, or when steps or cutoff are less than 1.
    """
    entry, known = find_algorithm(algorithm), find_environment(environment)
    if entry.one_trial:
        raise ValueError(f"{algorithm} is a function that trains one trial: agents.function.train_function calls it")
    if steps < 1 or (cutoff is not None and cutoff < 1):
        raise ValueError(f"steps = {steps}, cutoff = {cutoff}: must be at least 1")
    if not all(isinstance(one, entry.hypers) for one in hypers):
        raise ValueError(f"{algorithm} takes {entry.hypers.__name__}")
    if known.actions not in entry.actions:
        raise ValueError(
            f"{algorithm} acts in {' and '.join(entry.actions)} action spaces only; {environment} is {known.actions}"
        )
    keep_freed_memory()
    population = padded(hypers, seeds, torch.device(device))
    world = known.make(len(population))
    with torch.no_grad(), _denormals_flushed(), _matrix_precision(tf32):
        lockstep = _make(entry, known, world, population, steps, cutoff, discount)
        evaluator = None
        if evaluation is not None:
            if not hasattr(lockstep.agents, "act_deterministically"):
                raise ValueError(f"{algorithm} cannot be evaluated: it has no act_deterministically")
            evaluator = Evaluator(evaluation, known.make(len(population)), lockstep.stream.seeds, cutoff or known.cutoff)
        for step in range(1, steps + 1):
            lockstep.run()
            if evaluator is not None and evaluation is not None and step % evaluation.every == 0:
                evaluator.run(lockstep.agents, step, lockstep.healthy)
            if on_step is not None:
                on_step(step)
        records = _without_copies(lockstep.recorder.finish(), len(hypers))
    return records if evaluator is None else replace(records, evaluations=evaluator.finish(len(hypers)))


def _make(
    entry: AlgorithmEntry,
    known: EnvironmentEntry,
    world: Environment,
    population: Population,
    steps: int,
    cutoff: int | None,
    discount: float,
) -> LockStep:
    """Put together what a population needs to train: its agents, its replay buffers, its recorder."""
    device, stream = population.device, population.stream()
    algorithm = entry.load()
    # An environment that keeps its own state is Python: it cannot be captured, nor can an algorithm that does not say it can.
    # Nor can a subclass of one that can, unless it says so itself.
    capturable = not known.keeps_state and vars(algorithm).get("capturable", False)
    counts_on_device = capturable and kernels.library(device.type) is None
    clock = Clock(device if counts_on_device else None)
    task = Task(world.observation_size, world.actions, discount)
    capacity = min(population.shared.replay_capacity, steps)
    agents = algorithm(population, task, stream)
    stream.follow(clock)  # from now on: what is drawn once, such as initial weights, is not drawn for every step
    return LockStep(
        agents,
        world,
        stream,
        Replay(len(population), capacity, task.observation_size, task.actions.size, device, clock),
        Recorder(len(population), device, clock),
        clock,
        cutoff or known.cutoff,
        population.shared.batch_size,
        captured=counts_on_device and device.type == "cuda",
    )


@contextmanager
def _denormals_flushed() -> Iterator[None]:
    """Treat denormal numbers as zero: Adam's moments reach them in long runs, and they are slow."""
    flushed_before = torch.tensor(1e-40) * 1 == 0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(bool(flushed_before))


@contextmanager
def _matrix_precision(tf32: bool) -> Iterator[None]:
    """Allow or forbid TF32 in matrix products on a GPU, whatever was set before."""
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = tf32
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before


def _without_copies(records: Records, num_agents: int) -> Records:
    """Drop what `padded` added."""
    kept = records.agent < num_agents
    columns = {
        name: getattr(records, name)[kept] for name in ("agent", "episode", "first_step", "length", "episodic_return", "ending")
    }
    return replace(records, diverged_at=records.diverged_at[:num_agents], **columns)
