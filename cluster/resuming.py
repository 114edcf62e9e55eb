"""Which shards a launch goes on with: those that left a checkpoint, of trials that are all still missing.

Numbers do not depend on who shares a shard, so trials could be packed anew; a checkpoint is of exactly the trials that it was
written of. One of which a trial is finished by now, or not asked for, is passed over, and removed after a month.
"""

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path

from sweep import checkpoints
from sweep.shards import Shard, can_share
from sweep.trials import Trial

_OLD_SECONDS = 30 * 24 * 3600


def resumable(store: Path, trials: Sequence[Trial]) -> tuple[dict[Shard, int], list[Trial]]:
    """Return shards with a checkpoint, the furthest first, with the agent-steps that are done, and the trials in none of them."""
    by_id = {trial.id: trial for trial in trials}
    found: list[tuple[int, Shard]] = []
    for file in checkpoints.files(store):
        try:
            header = checkpoints.read_header(file)
            names, step = [str(name) for name in header["trials"]], int(header["step"])
        except (OSError, KeyError, TypeError, ValueError, checkpoints.DamagedCheckpointError):
            _remove(file)
            continue
        if names and all(name in by_id for name in names) and len(set(names)) == len(names):
            shard = Shard(tuple(by_id[name] for name in names))
            if can_share(shard.trials):
                found.append((step, shard))
        elif _is_old(file):
            _remove(file)
    shards: dict[Shard, int] = {}
    for step, shard in sorted(found, key=lambda one: -one[0]):
        if all(trial.id in by_id for trial in shard.trials):  # of two that share a trial, the furthest
            shards[shard] = step * len(shard.trials)
            for trial in shard.trials:
                del by_id[trial.id]
    return shards, list(by_id.values())


def _is_old(file: Path) -> bool:
    with contextlib.suppress(OSError):
        return time.time() - file.stat().st_mtime > _OLD_SECONDS
    return False


def _remove(file: Path) -> None:
    with contextlib.suppress(OSError):
        file.unlink(missing_ok=True)
