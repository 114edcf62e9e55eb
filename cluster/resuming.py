"""Which shards a launch goes on with: those that left a checkpoint, of trials that are all still missing.

Numbers do not depend on who shares a shard, so trials could be packed anew; a checkpoint is of exactly the trials that it was
written of. One of which a trial is finished by now, or not asked for, is passed over, and removed after a month.
"""

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path

from sweep import checkpoints
from sweep.shards import Shard
from sweep.trials import Trial

_OLD_SECONDS = 30 * 24 * 3600


def resumable(store: Path, trials: Sequence[Trial]) -> tuple[list[Shard], list[Trial]]:
    """Return the shards with a checkpoint, the furthest first, and the trials that are in none of them."""
    by_id = {trial.id: trial for trial in trials}
    found: list[tuple[int, Shard]] = []
    for file in checkpoints.files(store):
        try:
            header = checkpoints.read_header(file)
            names, step = list(header["trials"]), int(header["step"])
        except (OSError, KeyError, TypeError, ValueError, checkpoints.DamagedCheckpointError):
            _remove(file)
            continue
        if names and all(name in by_id for name in names):
            found.append((step, Shard(tuple(by_id.pop(name) for name in names))))
        elif _is_old(file):
            _remove(file)
    shards = [shard for _, shard in sorted(found, key=lambda one: -one[0])]
    return shards, list(by_id.values())


def _is_old(file: Path) -> bool:
    with contextlib.suppress(OSError):
        return time.time() - file.stat().st_mtime > _OLD_SECONDS
    return False


def _remove(file: Path) -> None:
    with contextlib.suppress(OSError):
        file.unlink(missing_ok=True)
