"""The lock-step loop: every agent of a population takes a step, stores it and learns from it, all at once."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch

from agents import checkpoint, kernels
from agents.algorithm import Task
from agents.checkpoint import CheckpointError
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
    `cutoff` truncates episodes (default: the environment's own); `on_step` is called after each step with its number, where
    autograd is off.
    `tf32` lets a GPU round the operands of matrix products to 10 bits of mantissa: faster, and other numbers.
    `evaluation` asks for deterministic episodes beside the learning, which does not change by them.

    An agent whose action, reward or critic loss stops being finite has diverged: it is marked, its returns are NaN from that
    episode on, and it stands still (action 0, or the nearest there is) for the rest of its steps.
    `algorithm` and `environment` are names that `agents.registry` can find: built in, a Gymnasium id, or `package.module:Name`.

    Raises AlgorithmLookupError or EnvironmentLookupError for names that lead nowhere, ValueError when the agents cannot be
    trained together, are not of this algorithm, or cannot act in this environment, or when steps or cutoff are less than 1.
    """
    run = Run(
        algorithm,
        environment,
        hypers,
        seeds,
        steps=steps,
        cutoff=cutoff,
        discount=discount,
        device=device,
        tf32=tf32,
        evaluation=evaluation,
    )
    run.advance(steps, on_step)
    return run.finish()


class Run:
    """A population under training: what `train` does, as far and as fast as one likes, to be saved and gone on with elsewhere.

    `step` counts the lock-steps taken, of `steps` in all. A run that was restored goes on as the one that was saved would have,
    bit for bit, on the same kind of device with the same engine and version of torch.
    """

    def __init__(
        self,
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
    ) -> None:
        """Make the agents and start their environments; arguments and errors are those of `train`."""
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
        cutoff = cutoff or known.cutoff
        self.steps, self._num_agents, self._tf32 = steps, len(hypers), tf32
        self._inference = population.device.type == "cpu" and _is_capturable(entry, known)
        with self._conditions():
            self._lockstep = _make(entry, known, known.make(len(population)), population, steps, cutoff, discount)
            self._evaluator: Evaluator | None = None
            if evaluation is not None:
                if not hasattr(self._lockstep.agents, "act_deterministically"):
                    raise ValueError(f"{algorithm} cannot be evaluated: it has no act_deterministically")
                world = known.make(len(population))
                self._evaluator = Evaluator(evaluation, world, self._lockstep.stream.seeds, cutoff)
        self._arguments: dict[str, Any] = {
            "algorithm": [algorithm, entry.results_version],
            "environment": [environment, known.results_version],
            "hypers": _digest(repr([one.as_dict() for one in hypers])),
            "seeds": _digest(repr(list(seeds))),
            "steps": steps,
            "cutoff": cutoff,
            "discount": discount,
            "evaluation": [evaluation.every, evaluation.episodes] if evaluation else None,
            "device": population.device.type,
            "engine": "torch" if kernels.library(population.device.type) is None else "native",
            "tf32": tf32,
        }

    @property
    def step(self) -> int:
        """The number of lock-steps taken."""
        return self._lockstep.clock.number

    def advance(self, count: int = 1, on_step: Callable[[int], None] | None = None) -> None:
        """Take `count` lock-steps, and the evaluations that fall on them; `on_step` is called after each with its number.

        Raises ValueError when fewer steps are left.
        """
        lockstep, evaluator, last = self._lockstep, self._evaluator, self.step + count
        if last > self.steps:
            raise ValueError(f"{count} steps from step {self.step} on: there are {self.steps} in all")
        with self._conditions():
            for step in range(self.step + 1, last + 1):
                lockstep.run()
                if evaluator is not None and step % evaluator.evaluation.every == 0:
                    evaluator.run(lockstep.agents, step, lockstep.healthy)
                if on_step is not None:
                    on_step(step)

    def state(self) -> checkpoint.State:
        """Return everything that a later number depends on: names → arrays and plain values.

        The arrays are living memory, not copies: save or copy them before the next step. Raises CheckpointError where something
        cannot be saved, such as a generator that an algorithm keeps (`agents.checkpoint`).
        """
        with self._conditions():
            return {"arguments": json.dumps(self._arguments), "step": self.step, **checkpoint.collect(self._lasting())}

    def restore(self, state: Mapping[str, checkpoint.Value]) -> None:
        """Become the run that the state is of, made with the same arguments. Arrays are copied, and may be read-only.

        Raises CheckpointError when the state does not fit, and when an environment does not repeat its own episode; the run is of
        no use then.
        """
        saved = json.loads(str(state.get("arguments", "{}")))
        for name, value in self._arguments.items():
            if saved.get(name) != value:
                raise CheckpointError(f"{name}: {saved.get(name)} in the checkpoint, {value} here")
        with self._conditions():
            checkpoint.restore(self._lasting(), state)
        if self.step != state.get("step"):
            raise CheckpointError(f"step: {state.get('step')} in the checkpoint, but its clock says {self.step}")

    def finish(self) -> Records:
        """Return the episodes of all steps. Raises ValueError while some are left."""
        if self.step < self.steps:
            raise ValueError(f"{self.step} steps of {self.steps} are taken")
        records = _without_copies(self._lockstep.recorder.finish(), self._num_agents)
        return records if self._evaluator is None else replace(records, evaluations=self._evaluator.finish(self._num_agents))

    def _lasting(self) -> dict[str, Any]:
        return {"lockstep": self._lockstep, "evaluator": self._evaluator}

    @contextmanager
    def _conditions(self) -> Iterator[None]:
        # every call of PyTorch costs less in inference mode, but what is computed there is lost to autograd for good
        without_gradients = torch.inference_mode() if self._inference else torch.no_grad()
        with without_gradients, _denormals_flushed(), _matrix_precision(self._tf32):
            yield


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _is_capturable(entry: AlgorithmEntry, known: EnvironmentEntry) -> bool:
    """Whether a lock-step is tensor operations only, and free of autograd.

    An algorithm says so itself (`agents.algorithm`); a subclass of one that does, for itself. An environment that keeps its own
    state is Python, with whatever it uses.
    """
    return not known.keeps_state and bool(vars(entry.load()).get("capturable", False))


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
    counts_on_device = _is_capturable(entry, known) and kernels.library(device.type) is None
    clock = Clock(device if counts_on_device else None)
    task = Task(world.observation_size, world.actions, discount)
    capacity = min(population.shared.replay_capacity, steps)
    agents = entry.load()(population, task, stream)
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
