"""Why three hidden layers fail where two succeed: GreedyAC on MountainCar-DA with the thesis' setting, ten seeds each.

    python tests/benchmarks/depth.py [--steps 12000]

Beside the returns it looks into the actor while it learns: the entropy of its policy on 256 states spread over the state space,
how many hidden units of its last layer are dead (zero on all of these states), and how much its policy depends on the state
(the standard deviation of π(right) over the states).
"""

import argparse

import numpy as np
import torch

import agents
from agents.hypers import GreedyACHypers
from agents.policies import Softmax
from agents.registry import ALGORITHMS

SEEDS, LOOKS = range(10), (0, 100, 300, 1000, 3000, 10_000)


def states_everywhere(population):
    """States [P, 256, 2] on a grid over positions and velocities."""
    x, v = torch.meshgrid(torch.linspace(-1.2, 0.5, 16), torch.linspace(-0.07, 0.07, 16), indexing="ij")
    return torch.stack([x.flatten(), v.flatten()], 1).expand(population, 256, 2).contiguous()


def look(network):
    """Entropy, share of dead units in the last hidden layer, and spread of π(right) of every agent: three arrays [P]."""
    logits, kept = network.forward_for_gradient(states_everywhere(len(network.parameters)))
    policy = Softmax(logits)
    entropy = -(policy.probs * policy.log_probs).sum(-1).mean(1)
    dead = (kept.inputs[-1] <= 0).all(dim=1).float().mean(1)
    return [x.numpy().copy() for x in (entropy, dead, policy.probs[..., 2].std(dim=1))]


def watch(hypers, steps):
    """Train, and return the records and what `look` saw at each of LOOKS."""
    cls, caught, seen = ALGORITHMS["GreedyAC"].load(), [], {}

    class Watched(cls):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            caught.append(self)
            seen[0] = look(self.actor.network)

    def on_step(step):
        if step in LOOKS:
            seen[step] = look(caught[0].actor.network)

    original = type(ALGORITHMS["GreedyAC"]).load
    type(ALGORITHMS["GreedyAC"]).load = lambda self: Watched
    try:
        records = agents.train("GreedyAC", "MountainCar-DA", [hypers] * len(SEEDS), SEEDS, steps=steps, on_step=on_step)
    finally:
        type(ALGORITHMS["GreedyAC"]).load = original
    return records, seen


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=12_000)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for depth in (2, 3):
        for scale in (2.0, 0.1):
            for critic_input in ("index", "one-hot"):
                hypers = GreedyACHypers(
                    critic_step_size=1e-3,
                    actor_step_size_scale=scale,
                    hidden_layers=(64,) * depth,
                    discrete_critic_input=critic_input,
                )
                records, seen = watch(hypers, arguments.steps)
                reached = len(np.unique(records.agent[records.ending == 0]))
                print(f"\n{depth} layers, κ = {scale:g}, critic input {critic_input}:")
                print(f"  {reached} of {len(SEEDS)} reach the goal in {arguments.steps:,} steps")
                for step, (entropy, dead, spread) in seen.items():
                    print(
                        f"  step {step:6,}: entropy {entropy.mean():.3f} (ln 3 = 1.099), {dead.mean():4.0%} of the last "
                        f"layer dead, π(right) varies by {spread.mean():.3f} between states",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
