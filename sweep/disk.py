"""Bytes on disk of trials that are not there yet.

Measured on shards of 1 to 256 trials with 20 to 10,000 episodes each: within 10 % where the returns of episodes differ; where
they repeat, fewer. An episode has a row in `episodes`, and its return is named once in `steps`; the step numbers cost little.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from sweep import shard_files
from sweep.messages import UserError
from sweep.shards import Shard
from sweep.store import Store

SHARD_BYTES = 10_000
TRIAL_BYTES = 80
EPISODE_BYTES = 14.0
VARYING_LENGTH_BYTES = 4.5  # of each episode, where not all are as long as the cutoff
BYTES_PER_STEP = 0.015
EVALUATION_EPISODE_BYTES = 10


def predicted_bytes(shards: Sequence[Shard], episode_lengths: Mapping[str, float]) -> int:
    """Return the bytes that the files of these shards will take.

    `episode_lengths` are mean lengths by environment; where there is none, episodes are taken to be as long as the cutoff.
    """
    total = 0.0
    for shard in shards:
        trial = shard.trials[0]
        length = min(trial.cutoff, episode_lengths.get(trial.environment, trial.cutoff))
        each = TRIAL_BYTES + BYTES_PER_STEP * trial.steps
        each += math.ceil(trial.steps / length) * (EPISODE_BYTES + (VARYING_LENGTH_BYTES if length < trial.cutoff else 0.0))
        if trial.evaluation is not None:
            every, count = trial.evaluation
            each += EVALUATION_EPISODE_BYTES * count * (trial.steps // every)
        total += SHARD_BYTES + each * len(shard.trials)
    return round(total)


def episode_lengths(store: Path) -> dict[str, float]:
    """Return the mean length in steps of the episodes in a store, by environment; nothing for files that cannot be read."""
    steps: dict[str, int] = {}
    episodes: dict[str, int] = {}
    for folder in Store(store).shards(lenient=True):
        try:
            rows = shard_files.read_table(folder / shard_files.TRIALS, ["environment", "steps", "episodes"]).to_pylist()
        except (OSError, UserError):
            continue
        for row in rows:
            steps[row["environment"]] = steps.get(row["environment"], 0) + row["steps"]
            episodes[row["environment"]] = episodes.get(row["environment"], 0) + row["episodes"]
    return {environment: steps[environment] / episodes[environment] for environment in steps}
