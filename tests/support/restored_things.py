"""Things that hold anything at all, and a new one that is given what an old one held."""

import collections
import enum
import json

import numpy as np

from agents.checkpoint import collect, restore


def through_json(state):
    """A state as a file gives it back: texts, plain values, read-only arrays."""
    result = json.loads(json.dumps({name: value for name, value in state.items() if not isinstance(value, np.ndarray)}))
    for name, value in state.items():
        if isinstance(value, np.ndarray):
            result[name] = np.frombuffer(value.tobytes(), value.dtype).reshape(value.shape)
    return result


def restored(old, new):
    restore({"thing": new}, through_json(collect({"thing": old})))
    return new


class Thing:
    def __init__(self, **parts):
        vars(self).update(parts)


class Color(enum.Enum):
    RED = 1
    BLUE = 2


Point = collections.namedtuple("Point", "x y")
