import math

import pytest
import torch

from agents.rng import Purpose, RandomStream, philox


def stream(*seeds):
    return RandomStream(torch.tensor(seeds, dtype=torch.int64))


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [  # the known answers published with Random123 for philox4x32-10
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_the_published_known_answers(counter, key, expected):
    packed = key[0] | (key[1] << 32)
    packed -= (packed >> 63) << 64
    words = philox(torch.tensor([packed]), tuple(torch.tensor([c]) for c in counter))
    assert tuple(word.item() for word in words) == expected


def test_numbers_do_not_depend_on_the_neighbours_or_their_order():
    together = stream(5, 9, 2**40 + 1)
    for index, seed in enumerate((5, 9, 2**40 + 1)):
        for draw in ("normals", "uniforms"):
            crowd = getattr(together, draw)(Purpose.ACTION, 7, 100)
            assert torch.equal(getattr(stream(seed), draw)(Purpose.ACTION, 7, 100)[0], crowd[index])


def test_numbers_do_not_depend_on_what_was_drawn_before():
    one_after_another = stream(1, 2)
    drawn = [one_after_another.normals(Purpose.ACTION, step, 5).clone() for step in range(200)]
    for step in (0, 63, 64, 65, 130, 199):
        assert torch.equal(stream(1, 2).normals(Purpose.ACTION, step, 5), drawn[step])


def test_a_longer_draw_starts_with_the_shorter_one():
    assert torch.equal(stream(1).uniforms(2, 3, 1000)[:, :70], stream(1).uniforms(2, 3, 70))


def test_seeds_purposes_and_steps_give_different_numbers():
    numbers = [
        stream(seed).words(purpose, step, 1, 64).flatten() for seed in (0, 1, 2**32) for purpose in (0, 1) for step in (0, 1)
    ]
    values = torch.cat(numbers)
    assert len(values.unique()) == len(values)


def test_uniforms_lie_strictly_between_0_and_1_and_are_flat():
    numbers = stream(3).uniforms(Purpose.ACTION, 0, 200_000)
    assert numbers.min() > 0 and numbers.max() < 1
    counts = torch.histc(numbers, 20, 0, 1)
    chi_squared = ((counts - 10_000) ** 2 / 10_000).sum().item()
    assert chi_squared < 43.8  # 0.999 quantile with 19 degrees of freedom


def test_normals_have_the_moments_of_a_normal_distribution():
    x = stream(4).normals(Purpose.ACTION, 0, 400_000).double()
    assert abs(x.mean()) < 4 / math.sqrt(400_000)
    assert abs(x.var() - 1) < 4 * math.sqrt(2 / 400_000)
    assert abs((x**4).mean() - 3) < 4 * math.sqrt(96 / 400_000)
    share = (x.abs() > 1.959964).double().mean()
    assert abs(share - 0.05) < 4 * math.sqrt(0.05 * 0.95 / 400_000)
    pairs = x.view(-1, 4, 16)
    correlation = (pairs[:, 0] * pairs[:, 2]).mean()
    assert abs(correlation) < 4 / math.sqrt(100_000)


@pytest.mark.parametrize("high", [1, 7, 32, 100_000])
def test_integers_cover_their_range_evenly(high):
    numbers = stream(5).integers(Purpose.MINIBATCH, 3, 100_000, high)
    assert numbers.min() >= 0 and numbers.max() < high
    mean, deviation = (high - 1) / 2, math.sqrt((high**2 - 1) / 12)
    assert abs(numbers.double().mean() - mean) <= 4 * deviation / math.sqrt(100_000)
    if high <= 32:
        assert len(numbers.unique()) == high
