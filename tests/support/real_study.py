"""A small store of studies that were really trained, named after the thesis' own: what every figure and table is tried on.

    chapter-6     GreedyAC, VanillaAC, SAC on four environments, 3 tuning and 4 evaluation seeds, both rules
    figure-7-1    its trials of GreedyAC and SAC with continuous actions; trains nothing of its own
    figure-7-2    GreedyAC with a choice for each of three numbers of action samples
    chapter-3     SAC-original and two DDPGs, evaluated deterministically beside the learning; tuning seeds alone

Agents are tiny and runs short: nobody learns much. Numbers differ in their last bits from machine to machine, and so may choices.
"""

import io
from pathlib import Path

from rich.console import Console

from cluster import protocol
from cluster.executor import InProcessExecutor
from cluster.progress import Progress
from cluster.worker import Training
from sweep.grid import parse
from sweep.store import Store

_ENVIRONMENTS = """
[environment."Acrobot-CA"]
steps = 200
cutoff = 100
[environment."MountainCar-CA"]
steps = 250
cutoff = 100
"""
_FIXED = """
[fixed]
hidden_layers = [8]
batch_size = 4
replay_capacity = 1000
num_action_samples = 10
elite_fraction = 0.3
"""
_SWEEP = """
[sweep]
critic_step_size = [1e-1, 1e-2, 1e-3]
entropy_scale = [1e-2, 1e-1, 1.0]
actor_step_size_scale = [0.1, 1.0]
"""
CHAPTER_6 = f"""
[study]
name = "chapter-6"
environments = ["Acrobot-CA", "MountainCar-CA", "Pendulum-CA", "Pendulum-DA"]
steps = 160
cutoff = 40
{_ENVIRONMENTS}
[seeds]
tune = 3
evaluate = 4
{_FIXED}
{_SWEEP}
[[agent]]
name = "GreedyAC"
[[agent]]
name = "VanillaAC"
[[agent]]
name = "SAC"
"""
FIGURE_7_1 = f"""
[study]
name = "figure-7-1"
environments = ["Acrobot-CA", "MountainCar-CA", "Pendulum-CA"]
steps = 160
cutoff = 40
{_ENVIRONMENTS}
[seeds]
tune = 3
{_FIXED}
{_SWEEP}
[[agent]]
name = "GreedyAC"
[[agent]]
name = "SAC"
"""
FIGURE_7_2 = """
[study]
name = "figure-7-2"
environments = ["MountainCar-CA", "Pendulum-CA"]
steps = 160
cutoff = 40
[seeds]
tune = 2
evaluate = 3
[select]
by = ["per-environment"]
for_each = ["num_action_samples"]
[fixed]
hidden_layers = [8]
batch_size = 4
replay_capacity = 1000
[[agent]]
name = "GreedyAC"
sweep = { critic_step_size = [1e-1, 1e-2], num_action_samples = [10, 20, 30] }
derive = { elite_fraction = "3 / num_action_samples" }
"""
CHAPTER_3 = """
[study]
name = "chapter-3"
environments = ["Pendulum-CA"]
steps = 160
cutoff = 40
evaluation = { every = 40, episodes = 2 }
[seeds]
tune = 6
[fixed]
hidden_layers = [8]
batch_size = 4
replay_capacity = 1000
[[agent]]
name = "SAC-original"
[[agent]]
name = "DDPG"
fixed = { exploration_noise = "ornstein-uhlenbeck", exploration_scale = 0.3 }
[[agent]]
name = "DDPG"
fixed = { exploration_noise = "gaussian", exploration_scale = 0.1 }
"""
STUDIES = (CHAPTER_6, FIGURE_7_1, FIGURE_7_2, CHAPTER_3)


def train(path: Path) -> Path:
    """Take each study through tuning, selection and evaluation in a new store, and return the store's path."""
    store = Store.create(path)
    output = io.StringIO()
    progress = Progress(Console(file=output, width=200))
    for text in STUDIES:
        outcome = protocol.run(parse(text, "grid.toml"), store, InProcessExecutor, progress, Training())
        assert outcome.is_complete, output.getvalue()
    return path
