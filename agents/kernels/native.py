"""The native kernels: how the shared library is found, and its functions. Pointers and numbers only, no tensors; torch-free."""

import ctypes
import functools
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agents.kernels.layout import Layout

INTERFACE_VERSION = 3  # that of src/dispatch.cpp
_INT, _LONG, _WORD, _FLOAT, _POINTER = ctypes.c_int, ctypes.c_int64, ctypes.c_uint32, ctypes.c_float, ctypes.c_void_p
_ROWS = (_POINTER, _LONG, _LONG)  # data, floats from one agent to the next, from one row to the next
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "forward": (_POINTER, _INT, _INT, _POINTER, *_ROWS, _POINTER, _POINTER, _POINTER),
    "backward": (_POINTER, _INT, _INT, _POINTER, _POINTER, *_ROWS, _POINTER, _POINTER, _POINTER, _POINTER),
    "descend": (_POINTER, _INT, _INT, _POINTER, _POINTER, *_ROWS, *(_POINTER,) * 4, _FLOAT, _FLOAT, _POINTER),
    "regress": (_POINTER, _INT, _INT, _POINTER, *_ROWS, *(_POINTER,) * 4, _FLOAT, _FLOAT, *(_POINTER,) * 4),
    "values": (_POINTER, _INT, _INT, _INT, _INT, _POINTER, *_ROWS, *_ROWS, _POINTER, _POINTER),
    "best_actions": (_LONG, _INT, _INT, _INT, _POINTER, _POINTER, _POINTER, _POINTER),
    "adam": (_INT, _LONG, *(_POINTER,) * 5, _FLOAT, _FLOAT),
    "polyak": (_INT, _LONG, _POINTER, _POINTER, _POINTER),
    "uniforms": (_INT, _POINTER, _WORD, _WORD, _LONG, _POINTER),
    "normals": (_INT, _POINTER, _WORD, _WORD, _LONG, _POINTER),
    "integers": (_INT, _POINTER, _WORD, _WORD, _LONG, _WORD, _LONG, _POINTER),
    "gather": (_LONG, _LONG, _POINTER, _POINTER, _POINTER),
    "gaussian_condition": (_POINTER,),
    "gaussian_sample": (_POINTER, _LONG, _POINTER, _LONG, _INT, _POINTER),
    "gaussian_log_prob": (_POINTER, _LONG, _POINTER, _LONG, _POINTER),
    "gaussian_log_prob_gradient": (_POINTER, _LONG, _POINTER, _LONG, _POINTER, _FLOAT, _POINTER),
}


class NotAvailableError(RuntimeError):
    """The native kernels cannot be used here; the message says why."""


class _Layer(ctypes.Structure):
    _fields_ = (
        ("weights", _LONG),
        ("biases", _LONG),
        ("rows", ctypes.c_int32),
        ("columns", ctypes.c_int32),
        ("stride", ctypes.c_int32),
        ("width", ctypes.c_int32),
    )


class _Network(ctypes.Structure):
    _fields_ = (
        ("layers", _POINTER),
        ("size", _LONG),
        ("hidden", ctypes.c_int32),
        ("inputs", ctypes.c_int32),
        ("outputs", ctypes.c_int32),
    )


class Shape:
    """A network's layout as the kernels read it, kept alive; `pointer` is passed to them."""

    def __init__(self, layout: Layout) -> None:
        self._layers = (_Layer * len(layout.layers))(
            *(_Layer(x.weights, x.biases, x.rows, x.columns, x.stride, x.fan_out) for x in layout.layers)
        )
        layers = ctypes.addressof(self._layers)
        self._network = _Network(layers, layout.size, len(layout.hidden), layout.inputs, layout.outputs)
        self.pointer = ctypes.addressof(self._network)


class Library:
    """One variant of the kernels: a function for each name in the table above, and `scratch_size(shape, batch)` in floats."""

    forward: Callable[..., None]
    backward: Callable[..., None]
    descend: Callable[..., None]
    regress: Callable[..., None]
    values: Callable[..., None]
    best_actions: Callable[..., None]
    adam: Callable[..., None]
    polyak: Callable[..., None]
    uniforms: Callable[..., None]
    normals: Callable[..., None]
    integers: Callable[..., None]
    gather: Callable[..., None]
    gaussian_condition: Callable[..., None]
    gaussian_sample: Callable[..., None]
    gaussian_log_prob: Callable[..., None]
    gaussian_log_prob_gradient: Callable[..., None]
    scratch_size: Callable[[int, int], int]

    def __init__(self, path: Path, loaded: ctypes.CDLL, variant: str, compiled: tuple[str, ...]) -> None:
        self.path, self.variant, self.compiled = path, variant, compiled
        for name, arguments in _SIGNATURES.items():
            function = getattr(loaded, f"{name}_{variant}")
            function.argtypes, function.restype = arguments, None
            setattr(self, name, function)
        self.scratch_size = getattr(loaded, f"scratch_size_{variant}")
        self.scratch_size.argtypes, self.scratch_size.restype = (_POINTER, _LONG), _LONG  # type: ignore[attr-defined]


def library_file() -> Path:
    """Return where the library is, if it was compiled: by this version of Python, as its name says."""
    return Path(__file__).parent / f"_native{sysconfig.get_config_var('EXT_SUFFIX')}"


@functools.cache
def load(variant: str | None = None) -> Library:
    """Return the kernels in the best variant that this processor can run, or in the one that is named.

    Raises NotAvailableError when they were not compiled, cannot be loaded, or this processor lacks the instructions.
    """
    file = library_file()
    if not file.exists():
        raise NotAvailableError("the native kernels were not compiled when this package was installed (no C++ compiler?)")
    try:
        loaded = ctypes.CDLL(str(file))
        if loaded.interface_version() != INTERFACE_VERSION:
            raise NotAvailableError("the native kernels are those of another version of this package: install it again")
        loaded.best_variant.restype = loaded.compiled_variants.restype = ctypes.c_char_p
        best = loaded.best_variant().decode()
        compiled = tuple(loaded.compiled_variants().decode().split())
    except (OSError, AttributeError) as error:
        raise NotAvailableError(f"the native kernels cannot be loaded: {error}") from error
    if not best:
        raise NotAvailableError(f"this processor has none of the instruction sets of the native kernels ({', '.join(compiled)})")
    runnable = compiled[compiled.index(best) :]  # a processor that runs one variant runs those after it
    if variant is not None and variant not in runnable:
        raise NotAvailableError(
            f"there is no variant {variant} of the native kernels for this processor, only {', '.join(runnable)}"
        )
    return Library(file, loaded, variant or best, compiled)
