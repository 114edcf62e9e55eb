"""Sweeping code that was not written for populations: any function `train(config, seed, report)`, one trial a worker.

`config` is a dict of "environment", "steps", "cutoff", "discount" and the trial's hyperparameters; `seed` is a whole number.
The function calls `report(episodic_return, length)` after each episode, with `terminated=False` if it was cut off, until it
has used up `steps` environment steps; steps that it does not report become one last, unfinished episode without a return.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from agents.records import ENDINGS, Records

Function = Callable[[dict[str, Any], int, Callable[..., None]], None]


def train_function(
    function: Function, config: dict[str, Any], seed: int, on_step: Callable[[int], None] | None = None
) -> Records:
    """Call the function and return the episodes that it reports, as those of one agent.

    Raises ValueError when an episode has no steps or the episodes have more than `config["steps"]` together. A return that is not
    finite marks the trial as diverged, at the last step of that episode.
    """
    rows: list[tuple[float, int, int]] = []
    steps, used, diverged_at = config["steps"], 0, 0

    def report(episodic_return: float, length: int, terminated: bool = True) -> None:
        nonlocal used, diverged_at
        used += int(length)
        if length < 1 or used > steps:
            raise ValueError(f"reported an episode of {length} steps: {used:,} of {steps:,} steps are used")
        if not np.isfinite(episodic_return) and not diverged_at:
            diverged_at = used
        rows.append((float(episodic_return) if not diverged_at else np.nan, int(length), int(not terminated)))
        if on_step is not None:
            on_step(used)

    function(config, seed, report)
    if used < steps:
        rows.append((np.nan, steps - used, ENDINGS.index("budget")))
    returns, lengths, endings = (np.array(column) for column in zip(*rows, strict=True))
    return Records(
        steps=steps,
        agent=np.zeros(len(rows), np.int32),
        episode=np.arange(len(rows), dtype=np.int32),
        first_step=(np.cumsum(lengths) - lengths + 1).astype(np.int32),
        length=lengths.astype(np.int32),
        episodic_return=returns.astype(np.float32),
        ending=endings.astype(np.uint8),
        diverged_at=np.array([diverged_at]),
    )
