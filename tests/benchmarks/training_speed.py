"""Agent-steps a second of the whole loop, the population against a plain single agent, all in one run.

    python tests/benchmarks/training_speed.py [--seconds 5] [--json FILE]

The whole loop is environment, replay buffer, action, update and recording, on one core, on Pendulum-CA. The plain loop is the
oracle of the tests (tests/support/plain_agents.py): torch.nn, autograd, torch.optim.Adam, Gymnasium-style stepping in Python. The
machine's speed drifts, so the variants take turns, and each gets its best turn. Compare ratios, not rates, between runs.
"""

import argparse
import json
import math
import random
import sys
import time
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "support"))
from plain_agents import PlainGreedyAC, PlainSAC

import agents
from agents.registry import ALGORITHMS

WARM_UP = 40
PLAIN = {"GreedyAC": PlainGreedyAC, "SAC": PlainSAC}


class PlainLoop:
    """One agent on Pendulum with a list as replay buffer, the way tutorials write it."""

    def __init__(self, algorithm, hypers):
        self.hypers = hypers
        self.agent = PLAIN[algorithm](hypers, 2, torch.tensor([-2.0]), torch.tensor([2.0]))
        self.policy_noise = (32, 30, 1) if algorithm == "GreedyAC" else (32, 1)
        self.state, self.elapsed, self.replay, self.returns, self.episodic_return = (-math.pi, 0.0), 0, [], [], 0.0

    def step(self):
        theta, omega = self.state
        action = self.agent.act(torch.tensor([self.state]), torch.randn(1, 1)).item()
        omega = omega + (15 * math.sin(theta) + 3 * action) * 0.05
        theta = (theta + 0.05 * omega + math.pi) % (2 * math.pi) - math.pi
        omega = min(max(omega, -8.0), 8.0)
        reward = math.cos(theta)
        self.replay.append((self.state, (action,), (reward,), (1.0,), (theta, omega)))
        self.state, self.elapsed, self.episodic_return = (theta, omega), self.elapsed + 1, self.episodic_return + reward
        if self.elapsed == 1000:
            self.returns.append(self.episodic_return)
            self.state, self.elapsed, self.episodic_return = (-math.pi, 0.0), 0, 0.0
        if len(self.replay) >= 32:
            batch = [torch.tensor(column) for column in zip(*random.choices(self.replay, k=32), strict=True)]
            noise = {"next": torch.randn(32, 1), "policy": torch.randn(self.policy_noise)}
            self.agent.update(*batch, noise, 0.99)


def plain_rate(algorithm, hypers, seconds):
    """Steps a second of one plain agent."""
    loop = PlainLoop(algorithm, hypers)
    for _ in range(WARM_UP):
        loop.step()
    started, steps = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        loop.step()
        steps += 1
    return steps / (time.perf_counter() - started)


class _TimeIsUpError(Exception):
    pass


def population_rate(algorithm, hypers, population, seconds):
    """Agent-steps a second of a population."""
    marks = {}

    def watch(step):
        now = time.perf_counter()
        if step == WARM_UP:
            marks["start"] = now
        elif step > WARM_UP and now - marks["start"] >= seconds:
            marks["rate"] = population * (step - WARM_UP) / (now - marks["start"])
            raise _TimeIsUpError

    try:
        agents.train(algorithm, "Pendulum-CA", [hypers] * population, range(population), steps=100_000, on_step=watch)
    except _TimeIsUpError:
        return marks["rate"]
    raise RuntimeError("100,000 steps were over before the time was")


def sgemm_rate(seconds=0.5):
    """GFLOP/s of a large single-precision matrix product: what this core can do at most."""
    a, best = torch.randn(1024, 1024), 0.0
    started = time.perf_counter()
    while time.perf_counter() - started < seconds:
        before = time.perf_counter()
        torch.mm(a, a)
        best = max(best, 2 * 1024**3 / (time.perf_counter() - before) / 1e9)
    return best


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=4.0, help="of each turn")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--populations", type=int, nargs="+", default=[1, 16, 64])
    parser.add_argument("--json", type=Path, help="write the results there too")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results = []
    for algorithm in PLAIN:
        for layers in ((64, 64), (64, 64, 64)):
            hypers = ALGORITHMS[algorithm].hypers(hidden_layers=layers)
            rates = {"plain": 0.0, **dict.fromkeys(arguments.populations, 0.0)}
            gemm = 0.0
            for _ in range(arguments.turns):
                gemm = max(gemm, sgemm_rate())
                rates["plain"] = max(rates["plain"], plain_rate(algorithm, hypers, arguments.seconds))
                for population in arguments.populations:
                    rate = population_rate(algorithm, hypers, population, arguments.seconds)
                    rates[population] = max(rates[population], rate)
            for variant, rate in rates.items():
                name = "plain single agent" if variant == "plain" else f"population of {variant}"
                row = {
                    "algorithm": algorithm,
                    "hidden_layers": list(layers),
                    "variant": name,
                    "agent_steps_per_second": round(rate),
                }
                results.append(row | {"times_plain": round(rate / rates["plain"], 2), "sgemm_gflops": round(gemm, 1)})
                print(
                    f"{algorithm:9} {layers!s:13} {name:19} {rate:8,.0f} agent-steps/s {rate / rates['plain']:6.2f} × plain",
                    flush=True,
                )
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
