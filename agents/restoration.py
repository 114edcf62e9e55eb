"""From descriptions (`agents.lasting`) back to objects: those of a newly made population get what the saved ones held.

Memory is written in place wherever the same tensors lie together in it as before, so that whatever else refers to it, such as an
engine, keeps its meaning; where an algorithm has put another tensor in an attribute's place, one is made and put there. The same
goes for lists and dicts. Objects are never made: they are given what they held.
"""

import collections
import copy
import enum
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.lasting import CheckpointError, Walk, bytes_of, cells, geometry, is_frozen, name_of, own_state, parts

_MISSING = object()
_SEQUENCES: dict[str, Any] = {"list": list, "tuple": tuple}
_MAPPINGS: dict[str, Any] = {"dict": dict, "OrderedDict": collections.OrderedDict, "Counter": collections.Counter}
_SETS: dict[str, Any] = {"set": set, "frozenset": frozenset}


class Restoration:
    """One pass over new objects. `state` holds the arrays, `memories` says which tensors lie in which: name → paths, device."""

    def __init__(self, roots: Mapping[str, Any], state: Mapping[str, Any], memories: Mapping[str, Any]) -> None:
        self._state, self._memories = state, memories
        self._restored: dict[str, Any] = {}
        self._claimed: dict[int, Any] = {}
        self._filled: dict[str, Tensor] = {}
        self._places: dict[str, Tensor] = {}
        new = Walk(outline=True)
        for name, root in roots.items():
            new.describe(root, name)
        self._choose_places(new)

    def _choose_places(self, new: Walk) -> None:
        """Memory of the new objects serves again if all that lies in it lies together in the checkpoint, too."""
        groups = {path: tensors for tensors in new.memories.values() for path, _ in tensors}
        for name, memory in self._memories.items():
            known = [path for path in memory["paths"] if path in groups]
            for path in sorted(known, key=lambda path: path not in new.pinned):
                lying_there, tensor = {path for path, _ in groups[path]}, groups[path][0][1]
                fits = tensor.untyped_storage().nbytes() == self._saved(name).nbytes
                if fits and lying_there <= set(memory["paths"]) and str(tensor.device) == memory["device"]:
                    self._places[name] = tensor
                    break
        taken = {path for tensor in self._places.values() for path, tensors in groups.items() if tensors[0][1] is tensor}
        for path in sorted(new.pinned - taken):
            raise CheckpointError(f"{path}: is of another size, or shares its memory with others, than in the checkpoint")

    def _saved(self, name: str) -> np.ndarray:
        found = self._state[name]
        if not isinstance(found, np.ndarray):
            raise CheckpointError(f"{name}: is no array in the checkpoint")
        return found

    def _memory(self, name: str) -> Tensor:
        """Return the memory [n] (uint8) of that name, filled."""
        if name not in self._filled:
            saved = self._saved(name)
            if name in self._places:
                memory = bytes_of(self._places[name])
            else:
                memory = torch.empty(saved.nbytes, dtype=torch.uint8, device=self._memories[name]["device"])
            if memory.device.type == "cpu":
                np.copyto(memory.numpy(), saved)
            else:
                memory.copy_(torch.from_numpy(np.array(saved)))
            self._filled[name] = memory
        return self._filled[name]

    def value(self, node: Any, path: str, new: Any = _MISSING) -> Any:
        """Return what a description is of: `new` itself, changed if need be, where it can be that."""
        if not isinstance(node, dict):
            return new if type(new) is type(node) and repr(new) == repr(node) else node
        kind = next(iter(node))
        if kind == "same":
            return self._restored[node["same"]]
        self._restored[path] = new  # for what refers back to it
        self._restored[path] = result = _KINDS[kind](self, node, path, new)
        return result

    def _number(self, node: Any, path: str, new: Any) -> Any:
        return np.frombuffer(bytes.fromhex(node["bytes"]), np.dtype(node["number"]))[0]

    def _constant(self, node: Any, path: str, new: Any) -> Any:
        saved, kind = node["constant"], name_of(type(new))
        if isinstance(new, enum.Enum) and saved.startswith(f"{kind}."):
            return type(new)[saved.removeprefix(f"{kind}.")]
        _check_same(saved, kind if saved == kind else name_of(new), path)
        return new

    def _tensor(self, node: Any, path: str, new: Any) -> Any:
        memory, tensor = self._memory(node["tensor"]), new
        lies_there = isinstance(new, Tensor) and new.untyped_storage().data_ptr() == memory.untyped_storage().data_ptr()
        if not lies_there or geometry(new) != node["geometry"] or self._is_claimed(new):
            dtype, offset, shape, strides = node["geometry"]
            tensor = torch.empty(0, dtype=getattr(torch, dtype), device=memory.device)
            tensor.set_(memory.untyped_storage(), offset, shape, strides)
            tensor = torch.nn.Parameter(tensor, node["needs_grad"]) if node["parameter"] else tensor
            self._is_claimed(tensor)
        tensor.requires_grad_(node["needs_grad"])
        tensor.grad = self.value(node["grad"], f"{path}.grad", tensor.grad)
        return tensor

    def _array(self, node: Any, path: str, new: Any) -> Any:
        array = self._saved(node["array"]).transpose(np.argsort(node["axes"]))
        if not node["own"]:
            return array.copy(order="K")
        array.flags.writeable = False  # of this view: it may be the file
        return array

    def _function(self, node: Any, path: str, new: Any) -> Any:
        _check_same(node["function"], name_of(new), path)
        for (name, before, put), part in zip(list(cells(new)), node["parts"], strict=True):
            value = self.value(part, f"{path}.{name}", before)
            if value is not before:
                if put is None:
                    raise CheckpointError(f"{path}: is the method of another object in the checkpoint")
                put(value)
        return new

    def _own(self, node: Any, path: str, new: Any) -> Any:
        _check_same(node["own"], name_of(type(new)), path)
        way = own_state(new)
        assert way is not None
        way[1](self.value(node["state"], path))
        return new

    def _sequence(self, node: Any, path: str, new: Any) -> Any:
        usable = type(new).__name__ == node["sequence"] and isinstance(new, list | tuple | collections.deque)
        usable = usable and (isinstance(new, tuple) or not self._is_claimed(new))
        before = [*new] if usable else []
        before += [_MISSING] * (len(node["items"]) - len(before))
        items = [self.value(item, f"{path}[{i}]", before[i]) for i, item in enumerate(node["items"])]
        if usable and isinstance(new, tuple):
            unchanged = len(items) == len(new) and all(x is y for x, y in zip(items, new, strict=True))
            return new if unchanged else type(new)(*items) if hasattr(new, "_fields") else tuple(items)
        if usable:
            new.clear()
            new.extend(items)
            return new
        if node["sequence"] == "deque":
            return collections.deque(items, node["most"])
        return _made(_SEQUENCES, node["sequence"], path)(items)

    def _mapping(self, node: Any, path: str, new: Any) -> Any:
        usable = type(new).__name__ == node["mapping"] and isinstance(new, dict) and not self._is_claimed(new)
        before = dict(new) if usable else {}
        keys = [self.value(key, path) for key, _ in node["items"]]
        items = {
            key: self.value(item, f"{path}[{key!r}]", before.get(key, _MISSING))
            for key, (_, item) in zip(keys, node["items"], strict=True)
        }
        if not usable:
            return _made(_MAPPINGS, node["mapping"], path)(items)
        new.clear()
        new.update(items)
        return new

    def _set(self, node: Any, path: str, new: Any) -> Any:
        return _made(_SETS, node["set"], path)(self.value(key, path) for key in node["items"])

    def _object(self, node: Any, path: str, new: Any) -> Any:
        _check_same(node["object"], name_of(type(new)), path)
        if not is_frozen(new) and self._is_claimed(new):
            raise CheckpointError(f"{path}: is an object of its own in the checkpoint, and a shared one in a new population")
        before = parts(new, path)
        after = {name: self.value(part, f"{path}.{name}", before.get(name, _MISSING)) for name, part in node["parts"].items()}
        changed = {name: part for name, part in after.items() if name not in before or part is not before[name]}
        if changed and is_frozen(new):
            new = copy.copy(new)
        for name, part in changed.items():
            object.__setattr__(new, name, part)
        for name in before.keys() - after.keys():
            object.__delattr__(new, name)
        return new

    def _is_claimed(self, new: Any) -> bool:
        """Whether something else was given to this object already; from now on, something is."""
        claimed = id(new) in self._claimed
        self._claimed[id(new)] = new
        return claimed


_KINDS: dict[str, Callable[[Restoration, Any, str, Any], Any]] = {
    "number": Restoration._number,
    "constant": Restoration._constant,
    "tensor": Restoration._tensor,
    "array": Restoration._array,
    "function": Restoration._function,
    "own": Restoration._own,
    "sequence": Restoration._sequence,
    "mapping": Restoration._mapping,
    "set": Restoration._set,
    "object": Restoration._object,
}


def _check_same(saved: str, found: str, path: str) -> None:
    if saved != found:
        missing = found == name_of(type(_MISSING)) or found == repr(_MISSING)
        here = "nothing" if missing else found
        raise CheckpointError(f"{path}: {saved} in the checkpoint, {here} in a new population, where it cannot be made")


def _made(makers: Mapping[str, Any], kind: str, path: str) -> Any:
    if kind not in makers:
        raise CheckpointError(f"{path}: a {kind} in the checkpoint, where a new population has none")
    return makers[kind]
