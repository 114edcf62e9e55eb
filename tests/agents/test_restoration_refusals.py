"""What is left out of a state, what cannot be in one, and states that do not fit: named and refused."""

import collections
import itertools
import json
import random
import threading

import numpy as np
import pytest
import torch
from restored_things import Color, Point, Thing, restored

from agents.checkpoint import CheckpointError, collect, restore


class WithItsOwnWay:
    def __init__(self):
        self.kept, self.lock = torch.zeros(4), threading.Lock()

    def state_for_checkpoint(self):
        return {"half": self.kept[:2], "rest": self.kept[2:].numpy(), "words": ["a", {"b": 1}]}

    def restore_from_checkpoint(self, state):
        assert state["words"] == ["a", {"b": 1}] and not state["rest"].flags.writeable
        self.kept = torch.cat([state["half"], torch.from_numpy(state["rest"].copy())])


def test_an_object_with_its_own_way_gives_and_gets_what_it_says():
    old = WithItsOwnWay()
    old.kept += torch.arange(4)
    new = WithItsOwnWay()
    restore({"thing": new}, collect({"thing": old}))
    assert new.kept.tolist() == [0, 1, 2, 3]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WithItsOwnWay, "state_for_checkpoint", lambda self: {"lock": [self.lock]})
        with pytest.raises(CheckpointError, match=r"^thing\['lock'\]\[0\]: state_for_checkpoint may return arrays, tensors"):
            collect({"thing": old})


class WithACache:
    not_in_checkpoints = ("lock", "cache")

    def __init__(self, count=0):
        self.lock, self.cache, self.count = threading.Lock(), count, count


class WithMore(WithACache):
    not_in_checkpoints = ("more",)
    more = None


def test_what_a_class_leaves_out_is_left_alone_also_in_its_subclasses():
    old, new = WithMore(5), WithMore(0)
    old.more, new.more = 1, 2
    restored(Thing(part=old), Thing(part=new))
    assert (new.count, new.cache, new.more) == (5, 0, 2)


@pytest.mark.parametrize(
    ("part", "kind"),
    [
        (itertools.count(), "itertools.count"),
        ((x for x in "ab"), "generator"),
        (threading.Lock(), "_thread.lock"),
        (random.Random(0), "random.Random"),
        (memoryview(b""), "memoryview"),
        (type("Number", (float,), {})(1.0), "tests.*Number"),
        (b"abc", "bytes"),
        (1j, "complex"),
    ],
)
def test_what_cannot_be_looked_into_is_named_with_the_ways_out(part, kind):
    message = rf"^thing\.parts\[0\]\['a'\]: a .*{kind} cannot be saved in a checkpoint: name it in .*`not_in_checkpoints`"
    with pytest.raises(CheckpointError, match=message):
        collect({"thing": Thing(parts=[{"a": part}])})


def test_what_hides_behind_a_function_is_named_too():
    for draw in (random.Random(0).random, random.random, (lambda dice: lambda: dice.random())(random.Random(0))):
        with pytest.raises(CheckpointError, match=r"^thing\.draw\.(__self__|dice): a random\.Random cannot be saved"):
            collect({"thing": Thing(draw=draw)})
    constants = Thing(parts=[torch.relu, torch.Tensor.sin, np.add, np.mean, len, "a".join, json, Thing, np.dtype("f4"), range(3)])
    restored(constants, constants)


def test_so_is_an_open_file(tmp_path):
    with open(tmp_path / "file", "w") as file, pytest.raises(CheckpointError, match=r"^thing\.file: a _io\.TextIOWrapper"):
        collect({"thing": Thing(file=file)})


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({Color.RED: 1}, "thing.part: has the key <Color.RED: 1>"),
        ({1.5, ("a", 2)}, None),
        ({Color.RED}, "thing.part: has the key <Color.RED: 1>"),
        (np.array([None, 1]), "thing.part: only plain arrays of numbers"),
        (np.ma.masked_array([1.0]), "thing.part: only plain arrays of numbers"),
        (torch.zeros(2).to_sparse(), "thing.part: only plain tensors"),
        (torch.zeros(2, requires_grad=True) * 2, "thing.part: only plain tensors, outside of autograd's graph"),
    ],
)
def test_what_would_not_come_back_as_it_was_is_refused(part, message):
    if message is None:
        collect({"thing": Thing(part=part)})
        return
    with pytest.raises(CheckpointError) as raised:
        collect({"thing": Thing(part=part)})
    assert message in str(raised.value)


def test_arrays_that_share_memory_are_refused():
    array = np.zeros(6)
    for shared in (Thing(a=array, b=array[2:]), Thing(a=array, b=torch.from_numpy(array)[:2].numpy(), c=torch.from_numpy(array))):
        with pytest.raises(CheckpointError, match="share memory"):
            collect({"thing": shared})
    new = restored(Thing(a=array, b=array), Thing(a=None, b=None))
    assert new.a is new.b


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (Thing(x=1), None, "Thing in the checkpoint, nothing"),
        (Thing(x=1), 5, "Thing in the checkpoint"),
        (WithACache(), Thing(), "WithACache in the checkpoint"),
        (torch.float32, torch.float64, "torch.float32 in the checkpoint, torch.float64 in a new population"),
        (len, sum, "builtins:len in the checkpoint"),
        (Thing, WithACache, "Thing in the checkpoint"),
        (collections.defaultdict(list, a=[1]), None, "a defaultdict in the checkpoint"),
        (Point(1, 2), None, "a Point in the checkpoint"),
        (np.random.default_rng(0), np.random.Generator(np.random.MT19937(0)), "the checkpoint does not fit: ValueError"),
    ],
)
def test_a_state_that_does_not_fit_is_refused_with_the_attribute(old, new, message):
    with pytest.raises(CheckpointError) as raised:
        restored(Thing(part=old), Thing() if new is None else Thing(part=new))
    assert message in str(raised.value)
