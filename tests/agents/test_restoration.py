"""What objects hold is found wherever it is, and a new object that gets it goes on as the old one does."""

import collections
import dataclasses
import pathlib

import numpy as np
import pytest
import torch
from restored_things import Color, Point, Thing, restored

from agents.checkpoint import CheckpointError
from agents.networks import PopulationMLP
from agents.optimizer import PopulationAdam


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (3, 4),
        (2**200, 0),
        (0.1 + 0.2, 0.3),
        (float("inf"), 1.0),
        (-0.0, 0.0),
        ("α", ""),
        (None, 1),
        (True, 1),
        (1, True),
        (1, None),
        ([1, [2, 3]], []),
        ([], [1, 2]),
        ((1, (2.5, "a")), (1, (2.5, "b"))),
        (Point(1, [2]), Point(0, [])),
        ({"a": 1, 2: {"b": None}, (1, "x"): 3, None: 0.5, True: 7}, {}),
        ({"b": 1, "a": 2}, {"a": 2, "b": 1}),
        (collections.OrderedDict(a=1), None),
        (collections.Counter(a=1), None),
        (collections.defaultdict(int, a=1), collections.defaultdict(int, b=2)),
        (pathlib.Path("a"), pathlib.Path("a")),
        (collections.deque([1, 2], maxlen=2), collections.deque([0], maxlen=2)),
        (collections.deque([1, 2], maxlen=2), None),
        ({1, 2}, {3}),
        (frozenset("ab"), None),
        (Color.BLUE, Color.RED),
        (np.float32(0.1), np.float32(0)),
        (np.datetime64("2020-01-01"), None),
    ],
)
def test_plain_values_and_what_holds_them_come_back_of_the_same_type_and_in_order(old, new):
    found = restored(Thing(part=old), Thing(part=new)).part
    assert type(found) is type(old)
    if isinstance(old, frozenset):  # texts lie in a set in whatever order the process hashes them
        assert found == old
    else:
        assert repr(found) == repr(old)


def test_a_list_and_a_dict_that_others_refer_to_are_filled_where_they_are():
    numbers, names = [1], {"a": 1}
    new = Thing(numbers=numbers, names=names)
    restored(Thing(numbers=[5, 6], names={"b": 2}), new)
    assert new.numbers is numbers == [5, 6] and new.names is names == {"b": 2}


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.arange(6.0).reshape(2, 3).T,
        np.arange(24, dtype=np.int16).reshape(2, 3, 4).transpose(1, 2, 0),
        np.array(2.5),
        np.zeros((0, 3), np.complex64),
        np.array(["a", "bc"]),
    ],
)
def test_arrays_come_back_in_the_same_order_in_memory_and_can_be_written_to(array):
    found = restored(Thing(part=array), Thing(part=None)).part
    assert found.dtype == array.dtype and found.strides == array.strides and found.flags.writeable
    np.testing.assert_array_equal(found, array)


@pytest.mark.parametrize("dtype", ["float32", "float64", "bfloat16", "int8", "int64", "bool", "complex64"])
def test_tensors_come_back_bit_for_bit_where_they_are(dtype):
    old = torch.tensor([[1.0, 0.0, -3.5], [2.0, float("nan"), 0.1]]).nan_to_num(5.0 if dtype in ("int8", "int64") else torch.nan)
    old = old.to(getattr(torch, dtype))
    memory = torch.zeros_like(old)
    new = restored(Thing(part=old), Thing(part=memory)).part
    assert new is memory and new.dtype == old.dtype
    assert torch.equal(new.view(torch.uint8), old.view(torch.uint8))


def test_a_tensor_that_was_not_there_comes_back_with_its_strides():
    old = torch.arange(6.0).view(2, 3).t()
    new = restored(Thing(part=old, empty=torch.zeros(0, 3)), Thing()).part
    assert torch.equal(new, old) and new.stride() == old.stride()


def test_views_of_one_memory_stay_views_of_one_memory():
    def make(base):
        return Thing(base=base, row=base[1], shifted=base.flatten()[2:])

    new = restored(make(torch.arange(6.0).view(2, 3)), make(torch.zeros(2, 3)))
    base = new.base
    new.row += 10
    assert base.tolist() == [[0, 1, 2], [13, 14, 15]] and new.shifted.tolist() == [2, 13, 14, 15]


def test_tensors_that_came_to_share_memory_share_it_again():
    shared = torch.ones(3)
    new = restored(Thing(a=shared, b=shared, c=shared[1:]), Thing(a=torch.zeros(3), b=torch.zeros(3), c=None))
    new.a.add_(1)
    assert new.b is new.a and new.c.tolist() == [2, 2]


def test_tensors_that_came_apart_are_apart_again():
    zeros = torch.zeros(3)
    new = restored(Thing(a=torch.ones(3), b=torch.full((3,), 2.0)), Thing(a=zeros, b=zeros))
    assert new.a.tolist() == [1, 1, 1] and new.b.tolist() == [2, 2, 2]
    new = restored(Thing(a=torch.ones(3), b=torch.full((3,), 2.0)), Thing(a=zeros, b=zeros.view(1, 3)))
    assert new.a.tolist() == [1, 1, 1] and new.b.tolist() == [2, 2, 2]


def test_a_tensor_and_another_on_its_memory_stay_two():
    old = torch.ones(3, requires_grad=True)
    same = torch.zeros(3)
    with torch.no_grad():
        new = restored(Thing(a=old, b=old.detach()), Thing(a=same, b=same))
        assert new.a.requires_grad and not new.b.requires_grad
        new.b.add_(1)
    assert new.a.tolist() == [2, 2, 2]


def test_lists_and_objects_that_came_together_or_apart_do_so_again():
    inner, numbers = Thing(x=1), [1]
    new = restored(Thing(a=inner, b=inner, n=numbers, m=numbers), Thing(a=Thing(x=0), b=None, n=[], m=[]))
    assert new.a is new.b and new.a.x == 1 and new.n is new.m and new.n == [1]
    for empty in ([], {}, collections.deque()):
        one, two = (type(empty)({x: x}) if empty == {} else type(empty)([x]) for x in (1, 2))
        new = restored(Thing(n=one, m=two), Thing(n=empty, m=empty))
        assert (new.n, new.m) == (one, two)
    both = Thing(x=0)
    with pytest.raises(CheckpointError, match=r"thing\.b: is an object of its own in the checkpoint, and a shared one"):
        restored(Thing(a=Thing(x=1), b=Thing(x=2)), Thing(a=both, b=both))


def test_what_refers_to_itself_comes_back_so():
    old, new = Thing(x=1), Thing(x=0)
    old.me, new.me = old, None
    assert restored(old, new).me is new


def test_attributes_that_are_gone_go_and_slots_are_looked_into():
    class Slotted:
        __slots__ = ("__hidden", "shown")

        def __init__(self, hidden, shown):
            self.__hidden, self.shown = hidden, shown

        def both(self):
            return self.__hidden, self.shown

    new = restored(Thing(s=Slotted(1, [2]), kept=1), Thing(s=Slotted(0, []), kept=1, gone=5))
    assert new.s.both() == (1, [2]) and not hasattr(new, "gone")


def test_a_frozen_dataclass_is_replaced_and_not_changed():
    @dataclasses.dataclass(frozen=True)
    class Frozen:
        count: int
        numbers: tuple[int, ...]

    shared = Frozen(0, (1,))
    new = restored(Thing(part=Frozen(3, (1, 2))), Thing(part=shared))
    assert new.part == Frozen(3, (1, 2)) and shared == Frozen(0, (1,))
    assert restored(Thing(part=Frozen(0, (1,))), Thing(part=shared)).part is shared
    new = restored(Thing(a=Frozen(1, ()), b=Frozen(2, ())), Thing(a=shared, b=shared))
    assert (new.a.count, new.b.count, shared.count) == (1, 2, 0)


def test_generators_of_numpy_and_torch_go_on():
    old = Thing(a=np.random.default_rng(1), b=np.random.Generator(np.random.MT19937(2)), c=torch.Generator().manual_seed(3))
    new = Thing(a=np.random.default_rng(4), b=np.random.Generator(np.random.MT19937(5)), c=torch.Generator().manual_seed(6))

    def draw(thing):
        return thing.a.random(), thing.b.random(), torch.rand(3, generator=thing.c).tolist()

    draw(old)
    restored(old, new)
    assert draw(old) == draw(new)


def test_a_network_and_an_optimizer_of_torch_go_on():
    def make(seed):
        torch.manual_seed(seed)
        network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1))
        return Thing(network=network, optimizer=torch.optim.Adam(network.parameters(), lr=0.01 * (1 + seed)))

    def learn(thing, count, clear=True):
        for i in range(count):
            thing.network(torch.full((2, 3), float(i))).square().sum().backward()
            thing.optimizer.step()
            if clear:
                thing.optimizer.zero_grad()

    old, new = make(0), make(1)
    learn(old, 5)
    learn(old, 1, clear=False)  # what has accumulated counts, too
    restored(old, new)
    learn(old, 3)
    learn(new, 3)
    for a, b in zip(old.network.parameters(), new.network.parameters(), strict=True):
        assert torch.equal(a, b) and b.requires_grad


def test_what_a_function_refers_to_is_looked_into():
    def make():
        count, seen = 0, []

        def following():
            nonlocal count
            count += 1
            seen.append(count)
            return count, len(seen)

        return Thing(following=following, method=seen.append)

    class Owner:
        def __init__(self):
            self.x, self.get = 0, self.method

        def method(self):
            return self.x

    old, new = Thing(following=make().following, owner=Owner()), Thing(following=make().following, owner=Owner())
    old.following(), old.following()
    old.owner.x = 5
    restored(old, new)
    assert new.following() == (3, 3) and new.owner.get() == 5


def test_the_engines_memory_stays_where_it_is():
    def make():
        network = PopulationMLP(2, 3, (4,), (1,))
        network.initialize_(torch.rand(2, network.parameters.shape[1]))
        return Thing(network=network, optimizer=PopulationAdam(network.parameters, torch.tensor([0.1, 0.2])))

    def learn(thing):
        outputs, kept = thing.network.forward_for_gradient(torch.ones(2, 5, 3))
        thing.network.descend(kept, outputs, thing.optimizer)

    old, new = make(), make()
    learn(old)
    parameters = new.network.parameters
    restored(old, new)
    assert new.network.parameters is parameters and new.optimizer.parameters is parameters
    learn(old), learn(new)
    assert torch.equal(old.network.parameters, new.network.parameters)
    assert torch.equal(old.network.layers[0][0], new.network.layers[0][0])
    for order in ((0, 1), (1, 0)):

        def with_alias(thing, alias, order=order):
            parts = [("alias", alias), ("network", thing.network)]
            return Thing(**dict(parts[i] for i in order), optimizer=thing.optimizer)

        aliased, fresh = make(), make()
        new = restored(with_alias(aliased, aliased.network.parameters), with_alias(fresh, torch.zeros_like(parameters)))
        assert new.alias is new.network.parameters is fresh.optimizer.parameters
        learn(aliased), learn(new)
        assert torch.equal(aliased.network.parameters, new.network.parameters)
    other = make()
    other.copy = other.network.parameters = torch.zeros(1, 5)
    with pytest.raises(CheckpointError, match=r"thing\.network\.parameters: is of another size, or shares its memory"):
        restored(other, make())
