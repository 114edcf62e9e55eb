"""The state of a population under training: everything that a later number depends on, as flat arrays and plain values.

`collect` looks through objects (`agents.lasting`), `restore` gives the same to newly made ones (`agents.restoration`). What an
object refers to but need not have saved, such as a cache, its class names in `not_in_checkpoints`. A class may also take the
matter into its own hands: `state_for_checkpoint()` returns a dict of arrays, tensors and plain values, lists and dicts of them;
`restore_from_checkpoint(state)` of a new object gets the same, its arrays read-only.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from agents.lasting import CheckpointError, Walk, bytes_of
from agents.restoration import Restoration

__all__ = ["CheckpointError", "State", "Value", "collect", "restore"]

Value = np.ndarray | int | float | bool | str | None
State = dict[str, Value]

_STRUCTURE = "structure"  # how objects hold the arrays, as JSON


def collect(roots: Mapping[str, Any]) -> State:
    """Return the state of named objects. Arrays are the objects' own memory where that lies on the CPU, not copies.

    Raises CheckpointError for what cannot be saved.
    """
    walk = Walk()
    tree = {name: walk.describe(root, name) for name, root in roots.items()}
    walk.refuse_overlaps()
    memories = {
        name: {"paths": [path for path, _ in tensors], "device": str(tensors[0][1].device)}
        for name, tensors in walk.memories.items()
    }
    state: State = {name: bytes_of(tensors[0][1]).cpu().numpy() for name, tensors in walk.memories.items()}
    return {_STRUCTURE: json.dumps({"tree": tree, "memories": memories}), **state, **walk.arrays}


def restore(roots: Mapping[str, Any], state: Mapping[str, Value]) -> None:
    """Give newly made objects what `collect` returned of others like them. Raises CheckpointError when they are not alike."""
    try:
        structure = json.loads(str(state[_STRUCTURE]))
        restoration = Restoration(roots, state, structure["memories"])
        for name, root in roots.items():
            restoration.value(structure["tree"][name], name, root)
    except (LookupError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise CheckpointError(f"the checkpoint does not fit: {type(error).__name__}: {error}") from error
