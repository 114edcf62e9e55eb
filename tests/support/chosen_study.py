"""A study whose chosen settings and evaluation runs a test knows: two agents, two environments, three settings an agent.

    setting (critic step-size)   Pendulum-CA   MountainCar-CA   mean of N, normalizer thesis (G* = 10 on both)
    a (0.1)                      10            8                0.9
    b (0.01)                     9             10               0.95: chosen across environments
    c (0.001)                    2             2                0.2; the worst return, which a diverged run counts as

So a is chosen on Pendulum-CA and b on MountainCar-CA, and N(p) = p / 10 on both.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from synthetic_store import SyntheticStore

AGENTS, ENVIRONMENTS = ("GreedyAC", "SAC"), ("MountainCar-CA", "Pendulum-CA")
STEP_SIZES = {"a": 0.1, "b": 0.01, "c": 0.001}
TUNING = {
    "a": {"Pendulum-CA": 10, "MountainCar-CA": 8},
    "b": {"Pendulum-CA": 9, "MountainCar-CA": 10},
    "c": dict.fromkeys(ENVIRONMENTS, 2),
}
FIRST_SEED = 10
MISSING, FAILED, DIVERGED = None, "failed", math.nan

Evaluation = Mapping[tuple[str, str, str], Sequence[float | str | None]]
"""Agent, environment, setting → the score of each run, from seed 10 on."""


def write(
    path: Path, evaluation: Evaluation, agents: Sequence[str] = AGENTS, first_seeds: Mapping[str, int] | None = None
) -> Path:
    """Write the study "study" and return the store's path. `first_seeds`: of an environment's evaluation runs, if not 10."""
    store = SyntheticStore(path)
    runs: dict[str, list[tuple]] = {}
    for agent in agents:
        for letter, scores in TUNING.items():
            for environment, score in scores.items():
                for seed in range(2):
                    runs.setdefault(agent, []).append((_plan(store, agent, environment, letter, seed), [score]))
    for (agent, environment, letter), evaluated in evaluation.items():
        for index, score in enumerate(evaluated):
            seed = index + (first_seeds or {}).get(environment, FIRST_SEED)
            member = _plan(store, agent, environment, letter, seed, "evaluate")
            if score is FAILED:
                runs.setdefault(agent, []).append((member, [], (), (), (), {"status": "failed"}))
            elif score is not MISSING:
                runs.setdefault(agent, []).append((member, [score]))
    for together in runs.values():
        store.finish_together(together)
    return store.write_studies()


def same_everywhere(
    scores: Mapping[str, Sequence[float | str | None]],
) -> dict[tuple[str, str, str], Sequence[float | str | None]]:
    """Return an evaluation in which each agent has the same scores wherever its settings are evaluated."""
    places = (("Pendulum-CA", "a"), ("Pendulum-CA", "b"), ("MountainCar-CA", "b"))
    return {(agent, environment, letter): runs for agent, runs in scores.items() for environment, letter in places}


def _plan(store: SyntheticStore, agent: str, environment: str, letter: str, seed: int, stage: str = "tune") -> dict:
    return store.plan("study", agent, environment, seed, stage, critic_step_size=STEP_SIZES[letter])
