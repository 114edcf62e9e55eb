"""Agent-steps a second of the whole loop, populations against a plain single agent, and the share of the machine's sgemm rate.

    python tests/benchmarks/training_speed.py [--algorithms GreedyAC SAC] [--populations 1 16 64 256] [--json FILE]

The whole loop is environment, replay buffer (full: 100,000 transitions an agent), noise, action, update and recording, on one
core, on Pendulum. The plain loop is the oracle of the tests (tests/support/plain_agents.py): torch.nn, autograd and
torch.optim.Adam, stepping in Python. The machine's speed drifts, so the variants take turns, the product of large matrices
(sgemm) among them, and each gets its best turn: compare ratios, not rates, between runs.

FLOPs are those of the matrix products of an update, counted dense, two for a multiplication and an addition: an evaluation of a
network counts once, a backward pass twice, one that only goes to the inputs once. Hidden units that are zero are counted though
the native kernels skip them, so that a share may exceed 100 %.
"""

import argparse
import json
import math
import random
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "support"))
import plain_agents

from agents import kernels
from agents.networks import PopulationMLP
from agents.population import padded
from agents.registry import ALGORITHMS, ENVIRONMENTS
from agents.training import _denormals_flushed, _make

WARM_UP = 60
CAPACITY = 100_000
BATCH = 32
DEPTHS = ((64, 64, 64), (64, 64))
PLAIN = {
    "GreedyAC": plain_agents.PlainGreedyAC,
    "VanillaAC": plain_agents.PlainVanillaAC,
    "SAC": plain_agents.PlainSAC,
    "SAC-original": plain_agents.PlainSACOriginal,
    "DDPG": plain_agents.PlainDDPG,
}


class PlainLoop:
    """One agent on Pendulum with a list as replay buffer, the way tutorials write it."""

    def __init__(self, algorithm, environment, hypers):
        self.discrete = environment.endswith("-DA")
        bounds = (None, 3) if self.discrete else (torch.tensor([-2.0]), torch.tensor([2.0]))
        self.agent = PLAIN[algorithm](hypers, 2, *bounds)
        self.policy_noise = (BATCH, 30, 1) if algorithm in ("GreedyAC", "VanillaAC") else (BATCH, 1)
        self.state, self.elapsed, self.replay, self.returns, self.episodic_return = (-math.pi, 0.0), 0, [], [], 0.0

    def act(self, state):
        if self.discrete:
            return self.agent.choose(self.agent.categorical(state).probs, torch.rand(1, 1)).item()
        return self.agent.act(state, torch.randn(1, 1)).item()

    def step(self):
        theta, omega = self.state
        action = self.act(torch.tensor([self.state]))
        torque = 2 * (action - 1) if self.discrete else action
        omega = omega + (15 * math.sin(theta) + 3 * torque) * 0.05
        theta = (theta + 0.05 * omega + math.pi) % (2 * math.pi) - math.pi
        omega = min(max(omega, -8.0), 8.0)
        reward = math.cos(theta)
        self.replay.append((self.state, (action,), (reward,), (1.0,), (theta, omega)))
        self.state, self.elapsed, self.episodic_return = (theta, omega), self.elapsed + 1, self.episodic_return + reward
        if self.elapsed == 1000:
            self.returns.append(self.episodic_return)
            self.state, self.elapsed, self.episodic_return = (-math.pi, 0.0), 0, 0.0
        if len(self.replay) >= BATCH:
            batch = [torch.tensor(column) for column in zip(*random.choices(self.replay, k=BATCH), strict=True)]
            following = torch.rand(BATCH, 1) if self.discrete else torch.randn(BATCH, 1)
            self.agent.update(*batch, {"next": following, "policy": torch.randn(self.policy_noise)}, 0.99)


class PopulationLoop:
    """A population on Pendulum, its replay buffers full of what its first steps have seen."""

    def __init__(self, algorithm, environment, hypers, population):
        known = ENVIRONMENTS[environment]
        agents = padded([hypers] * population, range(population), torch.device("cpu"))
        self.lockstep = _make(ALGORITHMS[algorithm], known, known.make(len(agents)), agents, CAPACITY, None, 0.99)
        for _ in range(WARM_UP):
            self.lockstep.run()
        replay = self.lockstep.replay
        repeats = -(-CAPACITY // WARM_UP)
        replay.rows.copy_(replay.rows[:, :WARM_UP].repeat(1, repeats, 1)[:, :CAPACITY])
        replay.num_added = CAPACITY
        if (clock := self.lockstep.clock).tensor is not None:  # the torch engine reads the size from the clock
            clock.tensor += CAPACITY
            clock.number += CAPACITY

    def step(self):
        self.lockstep.run()


def rate(loop, agents, seconds):
    """Agent-steps a second, over at least four steps."""
    started, steps = time.perf_counter(), 0
    while steps < 4 or time.perf_counter() - started < seconds:
        loop.step()
        steps += 1
    return agents * steps / (time.perf_counter() - started)


def plain_rate(algorithm, environment, hypers, seconds):
    """Steps a second of one plain agent."""
    loop = PlainLoop(algorithm, environment, hypers)
    for _ in range(WARM_UP):
        loop.step()
    return rate(loop, 1, seconds)


def population_rate(algorithm, environment, hypers, population, seconds):
    """Agent-steps a second of a population."""
    with torch.inference_mode(), _denormals_flushed():  # as `agents.training.Run` has it for these algorithms
        return rate(PopulationLoop(algorithm, environment, hypers, population), population, seconds)


@contextmanager
def counted_flops():
    """Count the FLOPs of population networks within the block, for one agent's networks: yields a list of the counts."""
    counts, originals = [], {}

    def macs(network):
        return sum(weights.shape[1] * weights.shape[2] for weights, _ in network.layers)

    def counting(name, evaluations, rows):
        original = originals[name] = getattr(PopulationMLP, name)

        def wrapper(self, *args, **kwargs):
            times = evaluations(kwargs) if callable(evaluations) else evaluations
            counts.append(2 * macs(self) * len(self.parameters) * rows(*args) * times)
            return original(self, *args, **kwargs)

        setattr(PopulationMLP, name, wrapper)

    counting("forward", 1, lambda x: x.shape[1])
    counting("forward_for_gradient", 1, lambda x: x.shape[1])
    counting("values_of_actions", 1, lambda states, actions: actions.shape[1] * actions.shape[2])
    counting("descend", 2, lambda kept, dy, optimizer: dy.shape[1])
    counting("regress", 3, lambda x, targets, optimizer, follower=None: x.shape[1])
    counting("backward", lambda k: k.get("parameters", True) + k.get("inputs", False), lambda kept, dy: dy.shape[1])
    try:
        yield counts
    finally:
        for name, original in originals.items():
            setattr(PopulationMLP, name, original)


def flops_of_a_step(algorithm, environment, hypers):
    """FLOPs of an agent's lock-step that learns."""
    with torch.no_grad():
        loop = PopulationLoop(algorithm, environment, hypers, 2)
        with counted_flops() as counts:
            loop.step()
    return sum(counts) / 2


def sgemm_rate(seconds=0.3):
    """GFLOP/s of a large single-precision matrix product: what this core can do at most."""
    a, best = torch.randn(1024, 1024), 0.0
    started = time.perf_counter()
    while time.perf_counter() - started < seconds:
        before = time.perf_counter()
        torch.mm(a, a)
        best = max(best, 2 * 1024**3 / (time.perf_counter() - before) / 1e9)
    return best


def measure(algorithm, environment, hidden_layers, arguments):
    """Return a row for the plain agent and one for each population."""
    hypers = ALGORITHMS[algorithm].hypers(hidden_layers=hidden_layers)
    flops = flops_of_a_step(algorithm, environment, hypers)
    rates, gemm = {0: 0.0, **dict.fromkeys(arguments.populations, 0.0)}, 0.0
    for _ in range(arguments.turns):
        gemm = max(gemm, sgemm_rate())
        rates[0] = max(rates[0], plain_rate(algorithm, environment, hypers, arguments.seconds))
        for population in arguments.populations:
            found = population_rate(algorithm, environment, hypers, population, arguments.seconds)
            rates[population] = max(rates[population], found)
            gemm = max(gemm, sgemm_rate())
    return [
        {
            "algorithm": algorithm,
            "environment": environment,
            "hidden_layers": list(hidden_layers),
            "population": population or "plain",
            "engine": kernels.engine_name("cpu") if population else "plain",
            "agent_steps_per_second": round(value),
            "times_plain": round(value / rates[0], 2),
            "share_of_sgemm": round(value * flops / 1e9 / gemm, 3),
            "sgemm_gflops": round(gemm, 1),
            "mflop_per_step": round(flops / 1e6, 2),
        }
        for population, value in rates.items()
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=2.0, help="of each turn")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--populations", type=int, nargs="+", default=[1, 16, 64, 256])
    parser.add_argument("--algorithms", nargs="+", default=list(PLAIN), choices=list(PLAIN))
    parser.add_argument("--json", type=Path, help="write the results there too")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"engine {kernels.report().engine}, one thread; plain = one agent in plain PyTorch\n")
    print("| algorithm | actions | hidden layers | population | agent-steps/s | × plain | MFLOP a step | share of sgemm |")
    print("|---|---|---|---|---|---|---|---|")
    results = []
    for hidden_layers in DEPTHS:
        for algorithm in arguments.algorithms:
            for environment in ("Pendulum-CA", "Pendulum-DA"):
                if ENVIRONMENTS[environment].actions not in ALGORITHMS[algorithm].actions:
                    continue
                for row in measure(algorithm, environment, hidden_layers, arguments):
                    results.append(row)
                    print(
                        f"| {algorithm} | {environment[-2:]} | {'×'.join(map(str, hidden_layers))} | {row['population']} "
                        f"| {row['agent_steps_per_second']:,} | {row['times_plain']:.1f} | {row['mflop_per_step']:.1f} "
                        f"| {row['share_of_sgemm']:.0%} of {row['sgemm_gflops']:.0f} GFLOP/s |",
                        flush=True,
                    )
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
