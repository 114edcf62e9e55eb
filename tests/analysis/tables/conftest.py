"""A study of two agents on two environments whose choices, sensitivity and normalizers can be worked out by hand."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from synthetic_store import SyntheticStore

STEP_SIZES = (0.1, 0.01, 0.001)
MEANS = {
    ("GreedyAC", "Pendulum-CA"): (0, 50, 100),
    ("GreedyAC", "MountainCar-CA"): (-10, -30, -110),
    ("SAC", "Pendulum-CA"): (20, 40, 60),
    ("SAC", "MountainCar-CA"): (-60, -60, -10),
}
"""Mean score by critic step-size. Min–max: GreedyAC (0, 0.5, 1) and (1, 0.8, 0); SAC (0.2, 0.4, 0.6) and (0.5, 0.5, 1)."""

Builder = Callable[..., Path]


@pytest.fixture
def two_environments(tmp_path: Path) -> Builder:
    """Build the study: on seed s every run of Pendulum is `luck[s]` above its setting's mean."""

    def build(luck: Sequence[float] = (-5, 5), agents: Sequence[str] = ("GreedyAC", "SAC"), missing: int = 0) -> Path:
        store = SyntheticStore(tmp_path / "store")
        for (agent, environment), means in MEANS.items():
            if agent not in agents:
                continue
            for step_size, mean in zip(STEP_SIZES, means, strict=True):
                for seed, shift in enumerate(luck):
                    trial = store.plan("demo", agent, environment, seed, critic_step_size=step_size)
                    if missing and (agent, environment, step_size, seed) == ("GreedyAC", "Pendulum-CA", 0.01, 0):
                        continue
                    store.finish(trial, [float(mean + (shift if environment == "Pendulum-CA" else 0))])
        return store.write_studies()

    return build
