"""The native engine against plain double-precision arithmetic and the pure-torch engine, and its own laws."""

import hashlib
import itertools
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from kernel_networks import SHAPES, P, network, variants

import agents
from agents import kernels
from agents.elites import best_actions
from agents.hypers import SACHypers
from agents.kernels import native
from agents.kernels.layout import lay_out
from agents.networks import PopulationMLP, polyak_average_
from agents.optimizer import PopulationAdam
from agents.rng import Purpose, RandomStream

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(not native.library_file().exists(), reason="no native kernels here")

GOLDEN = "21fe09a4fa83f1ae"  # of `everything`


@pytest.fixture(params=variants())
def engine(request):
    with kernels.using(request.param), torch.no_grad():
        yield request.param


def double_forward(layers, x):
    """Every layer's input, and the output, in double precision."""
    inputs = [x.double()]
    for index, (weights, biases) in enumerate(layers):
        x = inputs[-1] @ weights.double() + biases.double()
        inputs.append(x.relu() if index < len(layers) - 1 else x)
    return inputs


def close(found, expected, tolerance=2e-6):
    assert (found.double() - expected).norm() <= tolerance * expected.norm() + 1e-30


@pytest.mark.parametrize(("inputs", "hidden", "outputs", "batch"), SHAPES)
def test_forward_and_backward_are_those_of_double_precision(engine, inputs, hidden, outputs, batch):
    made, generator = network(inputs, hidden, (outputs,))
    x = torch.randn(P, batch, inputs, generator=generator)
    dy = torch.randn(P, batch, outputs, generator=generator)
    y, kept = made.forward_for_gradient(x)
    of_inputs = made.backward(kept, dy, inputs=True)
    *layer_inputs, expected = double_forward(made.layers, x)
    close(y, expected)
    assert torch.equal(made.forward(x), y)
    d = dy.double()
    for index in reversed(range(len(made.layers))):
        (weights, _), (of_weights, of_biases) = made.layers[index], made.gradient_layers[index]
        close(kept.inputs[index], layer_inputs[index])
        close(of_weights, layer_inputs[index].transpose(1, 2) @ d)
        close(of_biases, d.sum(1, keepdim=True))
        d = d @ weights.double().transpose(1, 2)
        d = d * (layer_inputs[index] > 0) if index else d
    close(of_inputs, d)
    weights_and_biases = sum(part[0].numel() for part in itertools.chain(*made.layers))
    assert (made.gradient[0] != 0).sum() <= weights_and_biases  # nothing is written where no parameter lies


@pytest.mark.parametrize("num_actions", [1, 3, 7, 30, 31])
@pytest.mark.parametrize(("inputs", "hidden", "outputs", "batch"), SHAPES)
def test_values_of_actions_are_those_of_the_forward_pass_bit_for_bit(engine, inputs, hidden, outputs, batch, num_actions):
    for action_size in {1, min(6, inputs - 1)} - {0}:
        if inputs == action_size:
            continue
        made, generator = network(inputs, hidden, (outputs,))
        states = torch.randn(P, batch, inputs - action_size, generator=generator)
        actions = torch.randn(P, batch, num_actions, action_size, generator=generator)
        pairs = torch.cat([states.unsqueeze(2).expand(-1, -1, num_actions, -1), actions], -1).flatten(1, 2)
        expected = made.forward(pairs)[..., 0].view(P, batch, num_actions)
        assert torch.equal(made.values_of_actions(states, actions), expected)
        everywhere = actions[:, :1].expand(-1, batch, -1, -1)  # a view that repeats itself
        assert torch.equal(made.values_of_actions(states, everywhere), made.values_of_actions(states, everywhere.contiguous()))


def test_inputs_may_be_views_of_wider_rows(engine):
    made, generator = network(3, (64, 64), (1,))
    rows = torch.randn(P, 32, 9, generator=generator)
    assert torch.equal(made.forward(rows[..., 2:5]).clone(), made.forward(rows[..., 2:5].contiguous()))
    turned = rows[..., 2:5].transpose(1, 2).contiguous().transpose(1, 2)  # the last axis is not dense
    assert torch.equal(made.forward(turned).clone(), made.forward(rows[..., 2:5].contiguous()))


def test_a_number_that_is_not_finite_is_never_hidden_by_a_relu(engine):
    for layer in range(3):
        made, generator = network(3, (64, 64), (1,))
        made.layers[layer][0][1, 0, 0] = torch.nan
        x = torch.randn(P, 32, 3, generator=generator)
        y, kept = made.forward_for_gradient(x.abs())
        made.backward(kept, torch.ones(P, 32, 1))
        values = made.values_of_actions(x[..., :2].abs(), torch.ones(P, 32, 6, 1))
        for result in (y, values, *((made.gradient,) if layer < 2 else ())):
            assert not result[1].isfinite().all(), layer
            assert result[[0, 2]].isfinite().all()


def spread(*shape):
    """Numbers in (−1, 1) that are the same on every machine."""
    count = torch.Size(shape).numel()
    return ((torch.arange(count) * 2_654_435_761 % 2**24).float() / 2**23 - 1).view(shape)


def everything():
    """What the kernels of arithmetic and random numbers give for numbers that are the same on every machine."""
    made = PopulationMLP(P, 5, (65, 64, 130), (2, 1))
    for part in itertools.chain(*made.layers):
        part.copy_(spread(*part.shape) / part.shape[1] ** 0.5)
    optimizer = PopulationAdam(made.parameters, torch.full((P,), 1e-2))
    x, dy = spread(P, 33, 5), spread(P, 33, 3) / 7
    y, kept = made.forward_for_gradient(x)
    y = y.clone()
    of_inputs = made.backward(kept, dy, inputs=True)
    made.descend(kept, dy, optimizer)
    values = made.values_of_actions(x[..., :4], spread(P, 33, 11, 1))
    polyak_average_(target := spread(P, 100), spread(P, 100).flip(1), torch.full((P, 1), 0.3))
    stream = RandomStream(torch.tensor([1, 2, 2**40]))
    drawn = [stream.normals(1, 5, 1000), stream.uniforms(1, 5, 77), stream.integers(2, 3, 100, 1000).float()]
    return [y, of_inputs, made.gradient, made.parameters, values, target, *drawn]


def test_all_variants_give_the_same_bits_which_are_those_of_every_other_machine():
    """The digest was the same with GCC 11, GCC 12 and Clang 14; NEON, emulated, gave the bits of AVX in a driver of its own."""
    for name in variants():
        with kernels.using(name), torch.no_grad():
            assert kernels.engine_name("cpu") == name
            digest = hashlib.sha256(b"".join(result.contiguous().numpy().tobytes() for result in everything())).hexdigest()
        assert digest[:16] == GOLDEN, name


def test_random_numbers_are_those_of_the_torch_engine(engine):
    seeds = torch.tensor([0, 7, 2**40 + 1])
    ours = RandomStream(seeds)
    with kernels.using("torch"):
        torchs = RandomStream(seeds)
    for step, count in ((0, 1), (3, 64), (99_999, 1000)):
        assert torch.equal(ours.uniforms(Purpose.ACTION, step, count), torchs.uniforms(Purpose.ACTION, step, count))
        drawn = [s.integers(Purpose.MINIBATCH, step, count, 99_991, offset=100_000) for s in (ours, torchs)]
        assert torch.equal(*drawn)
        normals = [s.normals(Purpose.ACTION, step, count) for s in (ours, torchs)]
        torch.testing.assert_close(*normals, rtol=2e-6, atol=2e-6)


def test_normal_numbers_are_those_of_double_precision(engine):
    stream = RandomStream(torch.tensor([11]))
    uniform = stream.uniforms(Purpose.ACTION, 1, 6400).double().view(100, 4, 16)
    radius, angle = (-2 * uniform[:, 0::2].log()).sqrt(), 2 * torch.pi * uniform[:, 1::2]
    expected = torch.cat([radius * angle.cos(), radius * angle.sin()], 1).flatten()
    torch.testing.assert_close(stream.normals(Purpose.ACTION, 1, 6400)[0].double(), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("num_actions", "count"), [(30, 1), (30, 3), (30, 30), (1, 1), (7, 2), (16, 16), (17, 4), (48, 5), (101, 50)]
)
def test_best_actions_are_the_first_of_the_highest_values(engine, num_actions, count):
    generator = torch.Generator().manual_seed(0)
    values = torch.randint(-5, 7, (P, 50, num_actions), generator=generator).float()  # with ties, of 0 and -0, too
    values = torch.where(torch.rand(values.shape, generator=generator) < 0.05, torch.inf, values)
    values[..., ::2] *= -1
    actions = torch.randn(P, 50, num_actions, 2, generator=generator)
    order = values.argsort(dim=2, descending=True, stable=True)[..., :count]
    expected = actions.gather(2, order.unsqueeze(-1).expand(-1, -1, -1, 2))
    found = best_actions(values, actions, count)
    above = values.gather(2, order) > -torch.inf
    assert torch.equal(found[above], expected[above])
    assert torch.equal(found[~above], actions[:, :, :1].expand_as(found)[~above])
    values[1] = torch.nan
    found = best_actions(values, actions, count)
    assert torch.equal(found[1], actions[1, :, :1].expand_as(found[1]))
    values[0, :, 1:] = torch.nan  # one number among NaN is the best, wherever it is
    assert torch.equal(best_actions(values, actions, count)[0, :, 0], actions[0, :, 0])
    values[0, :, 0], values[0, :, -1] = torch.nan, -3.0
    assert torch.equal(best_actions(values, actions, count)[0, :, 0], actions[0, :, -1])


@pytest.mark.parametrize("widths", [(3, 64, 64, 1), (2, 8, 2), (7, 10, 33, 7, 2), (17, 128, 256, 6)])
def test_layers_do_not_overlap_and_start_at_cache_lines(widths):
    layout = lay_out(widths)
    taken = []
    for index, layer in enumerate(layout.layers):
        head = index == len(widths) - 2
        assert (layer.fan_in, layer.fan_out) == (widths[index], widths[index + 1])
        rows = layer.fan_out if head else layer.fan_in
        assert layer.rows >= rows and layer.columns >= (layer.fan_in if head else layer.fan_out)
        taken.append(range(layer.weights, layer.weights + max(layer.rows, rows) * layer.stride))
        taken.append(range(layer.biases, layer.biases + (layer.fan_out if head else layer.columns)))
        assert layer.weights % 16 == layer.biases % 16 == layer.stride % 16 == 0
    assert all(a.stop <= b.start for a, b in itertools.pairwise(taken))
    assert taken[-1].stop <= layout.size and layout.size % 16 == 0


def test_what_cannot_be_had_is_refused_and_auto_falls_back(monkeypatch):
    def unavailable(variant=None):
        raise native.NotAvailableError("this processor has none of the instruction sets")

    with kernels.using("no-such"), pytest.raises(kernels.EngineError, match="must be one of auto, native, torch"):
        kernels.library("cpu")
    with kernels.using("native-avx9000"), pytest.raises(kernels.EngineError, match="no variant avx9000"):
        kernels.library("cpu")
    with kernels.using("native"):
        assert kernels.library("cuda") is None
    monkeypatch.setattr(kernels, "load", unavailable)
    with kernels.using("native"), pytest.raises(kernels.EngineError, match="none of the instruction sets"):
        kernels.library("cpu")
    with kernels.using("auto"):
        assert kernels.library("cpu") is None
        assert kernels.report() == kernels.Report("torch", "this processor has none of the instruction sets")


def test_tf32_is_off_unless_asked_for_and_recorded():
    seen = []
    for asked in (False, True):
        options = {"steps": 1, "tf32": asked, "on_step": lambda _: seen.append(torch.backends.cuda.matmul.allow_tf32)}
        agents.train("SAC", "Pendulum-CA", [SACHypers()], [0], **options)
    assert seen == [False, True]
    assert not torch.backends.cuda.matmul.allow_tf32
    assert [kernels.engine_name("cuda", tf32) for tf32 in (False, True)] == ["torch", "torch-tf32"]
    assert kernels.engine_name("cpu", True) == kernels.engine_name("cpu")


def test_a_library_of_another_version_is_not_used(monkeypatch):
    monkeypatch.setattr(native, "INTERFACE_VERSION", 0)
    with pytest.raises(native.NotAvailableError, match="another version of this package"):
        native.load.__wrapped__()


def test_tensors_that_a_kernel_would_misread_are_refused(engine):
    made, _ = network(3, (8,), (2,))
    x = torch.zeros(P, 4, 3)
    for wrong in (x[:2], x[..., :2], x.double(), x[0]):
        with pytest.raises(ValueError, match=r"must be \[3, B, 3\] of torch.float32"):
            made.forward(wrong)
    _, kept = made.forward_for_gradient(x)
    optimizer = PopulationAdam(made.parameters, torch.ones(P))
    with pytest.raises(ValueError, match=r"must be \[3, B, 2\]"):
        made.descend(kept, torch.zeros(P, 4, 1), optimizer)
    with pytest.raises(ValueError, match="for states"):
        made.values_of_actions(torch.zeros(P, 4, 2), torch.zeros(P, 5, 7, 1))
    with pytest.raises(ValueError, match="a gradient"):
        optimizer.step_(torch.zeros(P, 3))
    with pytest.raises(ValueError, match="must be dense, and alike"):
        polyak_average_(made.parameters, made.parameters[:, :5], torch.ones(P, 1))


def test_a_polyak_weight_may_be_one_number_for_all(engine):
    target, online = torch.zeros(P, 20), torch.ones(P, 20)
    polyak_average_(target, online, torch.tensor(0.25))
    assert torch.equal(target, torch.full((P, 20), 0.25))


def test_the_environment_variable_selects_the_engine():
    for wanted in ("torch", *variants()):
        command = [sys.executable, "-c", "from agents import kernels; print(kernels.report().engine)"]
        environment = {**os.environ, "SWEEP_ENGINE": wanted, "PYTHONPATH": str(ROOT)}
        assert subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip() == wanted


def test_the_install_succeeds_without_a_compiler_and_leaves_the_kernels_out(tmp_path):
    environment = {**os.environ, "CC": "/no/compiler", "CXX": "/no/compiler"}
    command = [
        sys.executable,
        "setup.py",
        "build_ext",
        "--build-lib",
        str(tmp_path / "lib"),
        "--build-temp",
        str(tmp_path / "temp"),
    ]
    ran = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert "the pure-torch engine will be used" in ran.stdout + ran.stderr
    assert not list(tmp_path.rglob("*.so"))
