"""A store as large as the thesis: chapter 6 and figure 7.1 with made-up returns, written as a launch writes them.

    python tests/support/full_size_store.py FOLDER [--share 1.0]

Chapter 6 has 23,400 tuning trials and those of the evaluation stage, figure 7.1 has 36,000, of which chapter 6 has 9,000; each is
100,000 steps long. On Mountain Car and Acrobot a trial has 100 to 500 episodes, of return minus length, some cut off at 1,000
steps; on Pendulum 100. One trial in 200 diverges. How good a trial is follows from its hyperparameters, and a little from chance.
"""

import argparse
import dataclasses
import itertools
import json
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sweep.grid import load
from sweep.provenance import Provenance
from sweep.selection import select
from sweep.selections import basis, gather_scores, table, write_selection
from sweep.store import Store
from sweep.tables import members_table, shard_tables
from sweep.trials import Trial, evaluation_trials, expand

ORIGIN = Provenance("cpu", "native-avx512", "here", "0" * 40, "{}")
TRIALS_A_SHARD = 256
_TERMINATED, _TRUNCATED, _BUDGET = range(3)
_SHARE_DIVERGED = 1 / 200
_DONE = "complete.json"


@dataclass
class Records:
    """Episodes as training records them."""

    steps: int
    agent: np.ndarray
    episode: np.ndarray
    first_step: np.ndarray
    length: np.ndarray
    episodic_return: np.ndarray
    ending: np.ndarray
    diverged_at: np.ndarray


def full_size_store(folder: Path, share: float = 1.0) -> Path:
    """Return the store in `folder`, written there unless it is there already. `share` of the settings are in it."""
    said = {"share": share}
    if (folder / _DONE).exists() and json.loads((folder / _DONE).read_text()) == said:
        return folder / "store"
    store = Store.create(folder / "store")
    chapter, figure = (load(f"thesis/{name}") for name in ("chapter-6", "figure-7.1"))
    if share < 1:
        chapter, figure = (_thinned(grid, share) for grid in (chapter, figure))
    tuning, more = expand(chapter), expand(figure)
    there = {trial.id for trial in tuning}
    _write(store, [*tuning, *(trial for trial in more if trial.id not in there)])
    scores, worst = gather_scores(store, tuning, chapter.select.score)
    selection = select(chapter, scores, worst)
    constants = selection.normalizer.constants()
    write_selection(store, chapter.name, table(chapter.name, selection, basis(chapter, tuning), constants))
    chosen = [(choice.agent, choice.environment, choice.hypers) for choice in selection]
    evaluation = evaluation_trials(chapter, chosen)
    _write(store, evaluation, prefix="evaluate-")
    stages = {"tune": tuning, "evaluate": evaluation}
    store.write_study(chapter.name, chapter.text, members_table(chapter.name, stages))
    store.write_study(figure.name, figure.text, members_table(figure.name, {"tune": more}))
    (folder / _DONE).write_text(json.dumps(said))
    return store.path


def _thinned(grid, share: float):
    """Return a grid with some of the settings of each agent."""
    agents = [dataclasses.replace(agent, settings=agent.settings[:: max(1, round(1 / share))]) for agent in grid.agents]
    return dataclasses.replace(grid, agents=tuple(agents))


def _write(store: Store, trials: Sequence[Trial], prefix: str = "") -> None:
    def place(trial: Trial) -> tuple[str, str]:
        return trial.agent, trial.environment

    for (agent, environment), group in itertools.groupby(sorted(trials, key=place), key=place):
        for number, members in enumerate(_chunks(list(group))):
            name = f"{prefix}{agent}-{environment}-{number:04d}".lower()
            store.commit(name, shard_tables(members, _records(members), 20.0 * len(members), ORIGIN))


def _chunks(trials: list[Trial]) -> Iterator[list[Trial]]:
    for start in range(0, len(trials), TRIALS_A_SHARD):
        yield trials[start : start + TRIALS_A_SHARD]


def _records(trials: Sequence[Trial]) -> Records:
    """Return made-up episodes for trials of one agent on one environment; the same trial always has the same ones."""
    steps, cutoff = trials[0].steps, trials[0].cutoff
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("length", "episodic_return", "ending")}
    diverged_at = np.zeros(len(trials), np.int64)
    for agent, trial in enumerate(trials):
        generator = np.random.default_rng(int(trial.id, 16))
        level = _level(trial) + generator.normal(0.0, 0.05)
        if trial.environment.startswith("Pendulum"):
            length = np.full(steps // cutoff, cutoff)
            returns = 900 * np.clip(level + generator.normal(0.0, 0.1, len(length)), -1.0, 1.0)
            ending = np.full(len(length), _TRUNCATED, np.uint8)
        else:
            mean = cutoff * (1.1 - np.clip(level, 0.0, 0.9))
            length = np.clip(generator.normal(mean, mean / 3, steps // 60), 60, cutoff).astype(np.int64)
            count = int(np.searchsorted(length.cumsum(), steps)) + 1
            length = length[:count]
            ending = np.where(length == cutoff, _TRUNCATED, _TERMINATED).astype(np.uint8)
            if (over := int(length.sum()) - steps) > 0:
                length[-1] -= over
                ending[-1] = _BUDGET
            returns = -length.astype(np.float64)
        if generator.random() < _SHARE_DIVERGED:
            first = int(generator.integers(0, len(length)))
            diverged_at[agent] = length[:first].sum() + 1
            returns[first:] = math.nan
        columns["length"].append(length)
        columns["episodic_return"].append(returns)
        columns["ending"].append(ending)
    counts = [len(length) for length in columns["length"]]
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    first_step = np.concatenate([length.cumsum() - length + 1 for length in columns["length"]])
    return Records(
        steps=steps,
        agent=np.repeat(np.arange(len(trials), dtype=np.int32), counts),
        episode=np.concatenate([np.arange(count, dtype=np.int32) for count in counts]),
        first_step=first_step.astype(np.int32),
        length=joined["length"].astype(np.int32),
        episodic_return=joined["episodic_return"].astype(np.float32),
        ending=joined["ending"],
        diverged_at=diverged_at,
    )


def _level(trial: Trial) -> float:
    """Return how good a setting is, from 0 to 1: best at medium step-sizes, worse with a large entropy scale."""
    hypers = trial.applicable_hypers
    distance = abs(math.log10(hypers["critic_step_size"]) + 3) + abs(math.log10(hypers["actor_step_size_scale"])) / 2
    distance += max(0.0, math.log10(hypers.get("entropy_scale", 0.01)) + 2) / 4
    place = zlib.crc32(f"{trial.agent} {trial.environment}".encode()) % 100 / 1_000
    return 0.85 - 0.2 * distance + place


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--share", type=float, default=1.0, help="of the settings")
    arguments = parser.parse_args()
    print(full_size_store(arguments.folder, arguments.share))


if __name__ == "__main__":
    main()
