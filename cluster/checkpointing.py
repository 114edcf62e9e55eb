"""A shard's checkpoint in its store: when it is written, and whether one that is found may be gone on from.

    .checkpoints/<shard>.checkpoint     the newest state of a shard that is not finished

A trial that went on from a checkpoint must be what it would have been without: one that other code, another engine, other
versions or another kind of processor wrote is not used. Whatever else is wrong with a checkpoint, the shard begins anew.
"""

import contextlib
import functools
import hashlib
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.registry import find_algorithm, find_environment
from sweep import checkpoints
from sweep.provenance import Provenance
from sweep.shards import Shard

if TYPE_CHECKING:
    from agents.training import Run

_MOST_FILES = 2_000
_SHARE = 0.02  # of the time may go into writing checkpoints


class Checkpointing:
    """The checkpoint of one shard. `problem` says why there is none, where its state cannot be saved."""

    def __init__(self, store: Path, shard: Shard, origin: Provenance, threads: int, every_seconds: float) -> None:
        self._file = checkpoints.file_of(store, shard.id)
        self._identity = _identity(shard, origin, threads)
        self._name = f"{shard.trials[0].agent} on {shard.trials[0].environment}"
        self._every = every_seconds
        self._started = self._last = time.monotonic()
        self._before = 0.0
        self._wait = every_seconds
        self.problem: str | None = None

    @property
    def seconds(self) -> float:
        """Seconds of training so far."""
        return self._before + time.monotonic() - self._started

    def is_due(self) -> bool:
        """Return whether it is time to write one."""
        return self.problem is None and time.monotonic() - self._last >= self._wait

    def save(self, run: "Run") -> None:
        """Write the state of a run. One whose state cannot be saved, or a disk that takes none, is no error."""
        if self.problem is not None or run.step == 0:
            return
        begun = time.monotonic()
        try:
            header = {**self._identity, "step": run.step, "steps": run.steps, "seconds": self.seconds}
            checkpoints.save(self._file, header, run.state())
        except OSError:
            pass  # the commit will say what is wrong with the disk
        except Exception as error:  # CheckpointError, or whatever a user's own way to save raises
            self.problem = f"{self._name} has no checkpoints: {error or type(error).__name__}"
        self._last = time.monotonic()
        self._wait = max(self._every, (self._last - begun) / _SHARE)

    def begin(self, make: "Callable[[], Run]") -> "Run":
        """Return a new run, brought to where the checkpoint was written if there is one that may be used."""
        run = make()
        try:
            header, state = checkpoints.load(self._file)
            if {name: header.get(name) for name in self._identity} != self._identity:
                return run
            run.restore(state)
            self._before = float(header["seconds"])
        except FileNotFoundError:
            return run
        except Exception:  # damaged, of other objects, or whatever a user's own way to restore raises
            self.discard()
            return make()  # the other may have been restored in part
        return run

    def discard(self) -> None:
        """Remove the checkpoint: the shard is finished, or the checkpoint is of no use."""
        with contextlib.suppress(OSError):
            self._file.unlink(missing_ok=True)


def _identity(shard: Shard, origin: Provenance, threads: int) -> dict[str, Any]:
    """Return all that must be equal for a run to go on as if it had never stopped."""
    first = shard.trials[0]
    own = (find_algorithm(first.agent).implementation, find_environment(first.environment).implementation)
    modules = [implementation.partition(":")[0] for implementation in own] + [_module_of_gymnasium(first.environment)]
    return {
        "shard": shard.id,
        "trials": [trial.id for trial in shard.trials],
        "device": origin.device,
        "engine": origin.engine,
        "threads": threads,
        "versions": origin.versions,
        "processor": _processor(origin.device),
        "code": [_code_of("agents"), *(_code_of(module) for module in modules)],
    }


def _processor(device: str) -> str:
    import torch

    return torch.cuda.get_device_name() if device == "cuda" else str(torch.backends.cpu.get_cpu_capability())


def _module_of_gymnasium(environment: str) -> str:
    """Return the module that an environment of Gymnasium's comes from; nothing for a built-in one."""
    if not find_environment(environment).keeps_state:
        return ""
    import gymnasium

    entry = gymnasium.spec(environment.rpartition(":")[2]).entry_point
    return entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "")


@functools.cache
def _code_of(module: str) -> str:
    """Return a digest of the code that a module belongs to: its package, or the modules beside it. "" where there is none.

    Sources and compiled libraries count. What lies in an installed package of its own, such as Gymnasium's, has a version.
    """
    name = module.partition(".")[0]
    try:
        spec = importlib.util.find_spec(name) if name else None
    except (ImportError, ValueError):
        spec = None
    if spec is None:
        return ""
    files: list[Path] = []
    for folder in spec.submodule_search_locations or ():
        files += [file for file in Path(folder).rglob("*") if file.suffix in (".py", ".so")]
    if not spec.submodule_search_locations and spec.origin:
        files += Path(spec.origin).parent.glob("*.py")
    digest = hashlib.sha256()
    for file in sorted(files)[:_MOST_FILES]:
        with contextlib.suppress(OSError):
            digest.update(file.read_bytes())
    return digest.hexdigest()
