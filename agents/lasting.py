"""What objects hold that lasts, described as JSON: a walk through attributes, lists, tuples and dicts, ours and a user's.

Tensors are noted by the memory that they lie in, once, however many views there are. Nothing is pickled. What can be neither
walked nor left out, a generator or an open file, raises CheckpointError, which names the attribute.

Random streams, engines and populations do not change, and are not looked into; functions, types and devices are noted by name.
"""

import collections
import dataclasses
import enum
import pathlib
import types
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.kernels.native import Library
from agents.networks import PopulationMLP
from agents.optimizer import PopulationAdam
from agents.population import Population
from agents.rng import RandomStream

_UNCHANGING = (RandomStream, Population, Library)
_BY_NAME: tuple[type, ...] = (type, types.ModuleType, types.MethodDescriptorType, np.ufunc, type(np.mean))
_BY_NAME += (torch.device, torch.dtype, torch.Size, np.dtype, enum.Enum, range, pathlib.PurePath)
# what the engines keep for themselves; the parameters are the memory that they work on, and stay where they are
_ENGINE = {PopulationMLP: {"_arithmetic", "_gradient", "layers"}, PopulationAdam: {"_native", "_scratch", "_update"}}
_WAYS_OUT = "name it in the class's `not_in_checkpoints` if it can be made anew, or give the class `state_for_checkpoint`"


class CheckpointError(Exception):
    """A state cannot be saved, or does not fit the objects that it is to be restored into; the message names the attribute."""


class Walk:
    """Describes objects. `memories`: name → the tensors in one storage, with their paths; `arrays`: name → array."""

    def __init__(self, *, outline: bool = False) -> None:
        """With `outline` only tensors are looked for, and no object is asked for a state of its own."""
        self.memories: dict[str, list[tuple[str, Tensor]]] = {}
        self.arrays: dict[str, np.ndarray] = {}
        self.pinned: set[str] = set()
        self._outline = outline
        self._by_address: dict[tuple[Any, ...], str] = {}
        self._bounds: list[tuple[int, int, str]] = []
        self._seen: dict[int, tuple[str, Any]] = {}  # the objects too: an id is unique while its object lives

    def describe(self, value: Any, path: str) -> Any:
        """Return a plain value as it is, and anything else as a dict whose first key says what it is."""
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, np.generic):
            return {"number": value.dtype.str, "bytes": value.tobytes().hex()}
        if isinstance(value, _UNCHANGING):
            return {"constant": name_of(type(value))}
        if isinstance(value, _BY_NAME):
            return {"constant": name_of(value)}
        if id(value) in self._seen:
            if isinstance(value, Tensor):
                self._note_memory(value, path)
            return {"same": self._seen[id(value)][0]}
        self._seen[id(value)] = path, value
        if isinstance(value, Tensor):
            return self._tensor(value, path)
        if isinstance(value, np.ndarray):
            return self._array(value, path, own=False)
        if isinstance(value, types.FunctionType | types.MethodType | types.BuiltinFunctionType):
            return {
                "function": name_of(value),
                "parts": [self.describe(part, f"{path}.{name}") for name, part, _ in cells(value)],
            }
        own = own_state(value)
        if own is not None:
            return {"own": name_of(type(value)), "state": None if self._outline else self._own(own[0](), path)}
        return self._container(value, path)

    def _container(self, value: Any, path: str) -> Any:
        if type(value) in (list, tuple, collections.deque) or (isinstance(value, tuple) and hasattr(value, "_fields")):
            items = [self.describe(item, f"{path}[{i}]") for i, item in enumerate(value)]
            return {"sequence": type(value).__name__, "items": items, "most": getattr(value, "maxlen", None)}
        if type(value) in (dict, collections.OrderedDict, collections.defaultdict, collections.Counter):
            items = [[_key(key, path), self.describe(item, f"{path}[{key!r}]")] for key, item in value.items()]
            return {"mapping": type(value).__name__, "items": items}
        if type(value) in (set, frozenset):
            return {"set": type(value).__name__, "items": [_key(key, path) for key in value]}
        described = {name: self.describe(part, f"{path}.{name}") for name, part in parts(value, path).items()}
        if isinstance(value, PopulationMLP):
            self.pinned.add(f"{path}.parameters")
        return {"object": name_of(type(value)), "parts": described}

    def _own(self, state: Any, path: str) -> Any:
        """Describe what an object says of itself: plain things, which are made anew. Its arrays may be views of anything."""
        if isinstance(state, np.ndarray):
            return self._array(state, path, own=True)
        if type(state) is dict:
            items = [[_key(key, path), self._own(value, f"{path}[{key!r}]")] for key, value in state.items()]
            return {"mapping": "dict", "items": items}
        if type(state) in (list, tuple):
            items = [self._own(item, f"{path}[{i}]") for i, item in enumerate(state)]
            return {"sequence": type(state).__name__, "items": items}
        if state is None or isinstance(state, bool | int | float | str | np.generic | Tensor):
            return self.describe(state, path)
        raise CheckpointError(
            f"{path}: state_for_checkpoint may return arrays, tensors and plain values, lists and dicts of them"
        )

    def _tensor(self, tensor: Tensor, path: str) -> Any:
        if type(tensor) not in (Tensor, torch.nn.Parameter) or tensor.layout != torch.strided or tensor.grad_fn is not None:
            raise CheckpointError(f"{path}: only plain tensors, outside of autograd's graph, can be saved in a checkpoint")
        return {
            "tensor": self._note_memory(tensor, path),
            "geometry": geometry(tensor),
            "needs_grad": tensor.requires_grad,
            "parameter": type(tensor) is torch.nn.Parameter,
            "grad": self.describe(tensor.grad, f"{path}.grad"),
        }

    def _note_memory(self, tensor: Tensor, path: str) -> str:
        """Return the name of a tensor's memory: the first path that led there."""
        storage = tensor.untyped_storage()
        key = (tensor.device, storage.data_ptr(), storage.nbytes()) if storage.nbytes() else (id(tensor),)
        if key not in self._by_address:
            self._by_address[key] = path
            self.memories[path] = []
            if tensor.device.type == "cpu":
                self._bounds.append((storage.data_ptr(), storage.data_ptr() + storage.nbytes(), path))
        self.memories[self._by_address[key]].append((path, tensor))
        return self._by_address[key]

    def _array(self, array: np.ndarray, path: str, *, own: bool) -> Any:
        if array.dtype.hasobject or type(array) is not np.ndarray:
            raise CheckpointError(f"{path}: only plain arrays of numbers can be saved in a checkpoint")
        axes = sorted(range(array.ndim), key=lambda axis: -abs(array.strides[axis]))  # sums go along memory: its order is kept
        self.arrays[path] = array.transpose(axes)
        if not own and array.size:
            self._bounds.append((*np.lib.array_utils.byte_bounds(array), path))
        return {"array": path, "axes": axes, "own": own}

    def refuse_overlaps(self) -> None:
        """Raise CheckpointError where arrays share memory: restored one by one, they would not."""
        last, before = 0, ""
        for start, end, path in sorted(self._bounds):
            if start < last:
                raise CheckpointError(f"{before} and {path} share memory: of arrays that cannot be saved in a checkpoint")
            last, before = end, path


def geometry(tensor: Tensor) -> list[Any]:
    """Return how a tensor lies in its memory: [type, offset, shape, strides]."""
    return [str(tensor.dtype).removeprefix("torch."), tensor.storage_offset(), list(tensor.shape), list(tensor.stride())]


def bytes_of(tensor: Tensor) -> Tensor:
    """Return the whole memory that a tensor lies in: uint8 [n]."""
    storage = tensor.untyped_storage()
    whole = torch.empty(0, dtype=torch.uint8, device=tensor.device)
    return whole.set_(storage, 0, (storage.nbytes(),), (1,))


def name_of(value: Any) -> str:
    """Return a name by which a function, type, device or the like can be compared."""
    if isinstance(value, enum.Enum):
        return f"{name_of(type(value))}.{value.name}"
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
    return f"{getattr(value, '__module__', None)}:{name}" if name else repr(value)


def cells(function: Any) -> Iterator[tuple[str, Any, Callable[[Any], None] | None]]:
    """Yield what a function or method refers to from outside: name, value, and how another value is put there."""
    if isinstance(function, types.MethodType | types.BuiltinFunctionType):
        yield "__self__", function.__self__, None
        return
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):

        def put(value: Any, cell: Any = cell) -> None:
            cell.cell_contents = value

        yield name, cell.cell_contents, put


def own_state(value: Any) -> tuple[Callable[[], Any], Callable[[Any], None]] | None:
    """Return how an object is asked for its state and given it, if it has a way of its own."""
    if callable(getattr(type(value), "state_for_checkpoint", None)):
        return value.state_for_checkpoint, value.restore_from_checkpoint
    if isinstance(value, torch.optim.Optimizer):
        return value.state_dict, value.load_state_dict
    if isinstance(value, torch.Generator):
        return lambda: value.get_state().numpy(), lambda state: _set_generator(value, state)
    if isinstance(value, np.random.Generator):
        return lambda: value.bit_generator.state, lambda state: setattr(value.bit_generator, "state", state)
    return None


def _set_generator(generator: torch.Generator, state: np.ndarray) -> None:
    generator.set_state(torch.from_numpy(np.array(state)))


def parts(value: Any, path: str) -> dict[str, Any]:
    """Return the attributes of an object of a class written in Python: name → value. Raises CheckpointError for any other."""
    bases = type(value).__mro__[:-1]
    slots = [name for base in bases for name in _slots(base)]
    # a class in C, of which there is one among the bases then, may hold more than attributes
    in_c = any(isinstance(vars(base).get("__new__"), types.BuiltinMethodType) for base in bases)
    if in_c or not (hasattr(value, "__dict__") or any("__slots__" in vars(base) for base in bases)):
        kind = name_of(type(value)).replace(":", ".").removeprefix("builtins.")
        raise CheckpointError(f"{path}: a {kind} cannot be saved in a checkpoint: {_WAYS_OUT}")
    left_out = {name for base in bases for name in vars(base).get("not_in_checkpoints", ())}
    left_out = left_out.union(*(_ENGINE.get(base, set()) for base in bases))
    found = {name: getattr(value, name) for name in slots if hasattr(value, name)} | getattr(value, "__dict__", {})
    return {name: part for name, part in found.items() if name not in left_out}


def is_frozen(value: Any) -> bool:
    """Whether it is a frozen dataclass: one that may be shared, and is replaced rather than changed."""
    return dataclasses.is_dataclass(value) and bool(getattr(type(value), "__dataclass_params__").frozen)  # noqa: B009


def _slots(base: type) -> list[str]:
    declared = vars(base).get("__slots__", ())
    names = [declared] if isinstance(declared, str) else list(declared)
    mangled = base.__name__.lstrip("_")
    names = [f"_{mangled}{name}" if name.startswith("__") and not name.endswith("__") else name for name in names]
    return [name for name in names if name not in ("__dict__", "__weakref__")]


def _key(key: Any, path: str) -> Any:
    if type(key) is tuple:
        return {"sequence": "tuple", "items": [_key(part, path) for part in key]}
    if key is not None and type(key) not in (bool, int, float, str):
        raise CheckpointError(f"{path}: has the key {key!r}; only texts, numbers and tuples of them can be saved in a checkpoint")
    return key
