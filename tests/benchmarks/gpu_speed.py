"""The engine on a GPU: whether it does what the CPU does, and agent-steps a second by population. Needs torch and numpy only.

    python tests/benchmarks/gpu_speed.py [--populations 64 256 1024 4096] [--tf32] [--json FILE]

Correctness: a small population takes steps on both devices from the same weights and random words. Normal numbers differ in the
last bits between devices, and training amplifies that, so that only the parameters after the first updates are compared.

Speed: the whole loop, replay buffers filled to what the run needs, after the CUDA graph is captured.
"""

import argparse
import json
import time
from pathlib import Path

import torch

from agents import kernels
from agents.networks import PopulationMLP
from agents.population import padded
from agents.registry import ALGORITHMS, ENVIRONMENTS
from agents.training import _make

PAIRS = [
    (algorithm, environment)
    for algorithm in ALGORITHMS
    for environment in ("Pendulum-CA", "Pendulum-DA")
    if ENVIRONMENTS[environment].actions in ALGORITHMS[algorithm].actions
]


def make(algorithm, environment, population, device, hypers, steps):
    known = ENVIRONMENTS[environment]
    agents = padded([hypers] * population, range(population), torch.device(device))
    return _make(ALGORITHMS[algorithm], known, known.make(population), agents, steps, None, 0.99)


def networks(thing, path=""):
    """Path → every population network within an object of this package."""
    if isinstance(thing, PopulationMLP):
        return {path: thing}
    if not type(thing).__module__.startswith("agents."):
        return {}
    return {k: v for name, part in vars(thing).items() for k, v in networks(part, f"{path}.{name}").items()}


def difference(algorithm, environment, device):
    """Largest relative difference of a network's parameters, to the pure-torch engine on the CPU, after five updates."""
    hypers = ALGORITHMS[algorithm].hypers(batch_size=32, hidden_layers=(64, 64))
    loops = []
    for where in ("cpu", device):
        with kernels.using("torch"):
            loop = make(algorithm, environment, 4, where, hypers, 1000)
        for _ in range(31 + 5):
            loop.run()
        loops.append(networks(loop.agents))
    pairs = [(network.parameters, loops[1][path].parameters.cpu()) for path, network in loops[0].items()]
    return max(((ours - theirs).norm() / ours.norm()).item() for ours, theirs in pairs)


def rate(algorithm, environment, population, device, seconds):
    """Agent-steps a second."""
    synchronize = torch.cuda.synchronize if device == "cuda" else lambda: None
    loop = make(algorithm, environment, population, device, ALGORITHMS[algorithm].hypers(hidden_layers=(64, 64, 64)), 20_000)
    for _ in range(40):
        loop.run()
    synchronize()
    started, steps = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        for _ in range(4):
            loop.run()
        synchronize()
        steps += 4
    return population * steps / (time.perf_counter() - started)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"], help="cpu: to try the script without a GPU")
    parser.add_argument("--populations", type=int, nargs="+", default=[64, 256, 1024, 4096])
    parser.add_argument("--algorithms", nargs="+", default=list(ALGORITHMS), choices=list(ALGORITHMS))
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--tolerance", type=float, default=1e-4)
    parser.add_argument("--tf32", action="store_true", help="matrix products with 10-bit mantissas")
    parser.add_argument("--json", type=Path, help="write the results there too")
    arguments = parser.parse_args()
    if arguments.device == "cuda" and not torch.cuda.is_available():
        parser.exit(1, "there is no CUDA device here\n")
    torch.set_num_threads(1)
    torch.backends.cuda.matmul.allow_tf32 = arguments.tf32
    name = torch.cuda.get_device_name() if arguments.device == "cuda" else "CPU, pure torch"
    print(f"{name}, torch {torch.__version__}, tf32 {'on' if arguments.tf32 else 'off'}\n")
    results, wrong = [], []
    print("| algorithm | environment | difference to the CPU | " + " | ".join(f"P = {p:,}" for p in arguments.populations) + " |")
    print("|---" * (3 + len(arguments.populations)) + "|")
    with torch.no_grad(), kernels.using("torch"):
        for algorithm, environment in PAIRS:
            if algorithm not in arguments.algorithms:
                continue
            apart = difference(algorithm, environment, arguments.device)
            rates = {
                p: round(rate(algorithm, environment, p, arguments.device, arguments.seconds)) for p in arguments.populations
            }
            if apart > arguments.tolerance and not arguments.tf32:
                wrong.append(f"{algorithm} on {environment}: {apart:.1e}")
            results.append({"algorithm": algorithm, "environment": environment, "difference": apart, "rates": rates})
            cells = " | ".join(f"{value:,}" for value in rates.values())
            print(f"| {algorithm} | {environment} | {apart:.1e} | {cells} |", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps({"device": name, "tf32": arguments.tf32, "results": results}, indent=1))
    if wrong:
        parser.exit(2, "further from the CPU than rounding explains:\n" + "\n".join(wrong) + "\n")


if __name__ == "__main__":
    main()
