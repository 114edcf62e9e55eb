"""The native kernels that change parameters: each is its parts, one after another, bit for bit."""

import pytest
import torch
from kernel_networks import SHAPES, P, network, variants

from agents import kernels
from agents.kernels import native
from agents.kernels.arithmetic import Follower
from agents.networks import polyak_average_
from agents.optimizer import PopulationAdam

pytestmark = pytest.mark.skipif(not native.library_file().exists(), reason="no native kernels here")


@pytest.fixture(params=variants())
def engine(request):
    with kernels.using(request.param), torch.no_grad():
        yield request.param


@pytest.mark.parametrize(("inputs", "hidden", "outputs", "batch"), SHAPES)
def test_descend_is_backward_and_a_step_of_adam_bit_for_bit(engine, inputs, hidden, outputs, batch):
    results = []
    for fused in (True, False):
        made, generator = network(inputs, hidden, (outputs,))
        optimizer = PopulationAdam(made.parameters, torch.tensor([1e-1, 1e-3, 1e-5]))
        for _ in range(3):
            x = torch.randn(P, batch, inputs, generator=generator)
            dy = torch.randn(P, batch, outputs, generator=generator)
            made.forward(torch.randn(P, batch, inputs, generator=generator))  # another use of the same scratch memory
            _, kept = made.forward_for_gradient(x)
            if fused:
                made.descend(kept, dy, optimizer)
            else:
                made.backward(kept, dy)
                optimizer.step_(made.gradient)
        results.append((made.parameters, optimizer.first_moment, optimizer.second_moment))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    made, _ = network(inputs, hidden, (outputs,))
    assert not torch.equal(made.parameters, results[0][0])


@pytest.mark.parametrize("follows", [False, True])
@pytest.mark.parametrize(("inputs", "hidden", "outputs", "batch"), SHAPES)
def test_regress_is_a_forward_pass_descend_and_polyak_averaging_bit_for_bit(engine, inputs, hidden, outputs, batch, follows):
    results, losses = [], []
    for fused in (True, False):
        made, generator = network(inputs, hidden, (outputs,))
        optimizer = PopulationAdam(made.parameters, torch.tensor([1e-1, 1e-3, 1e-5]))
        target, rates = made.parameters.flip(0).contiguous(), torch.tensor([[1e-2], [0.3], [1.0]])
        seen = []
        for _ in range(3):
            x = torch.randn(P, batch, inputs + 2, generator=generator)[..., 1 : inputs + 1]  # a view of wider rows
            y = torch.randn(P, outputs, batch, generator=generator).transpose(1, 2)
            made.forward(torch.randn(P, batch, inputs, generator=generator))  # another use of the same scratch memory
            if fused:
                seen.append(made.regress(x, y, optimizer, Follower(target, rates) if follows else None))
                continue
            values, kept = made.forward_for_gradient(x)
            errors = values - y
            seen.append(errors.square().sum(dim=(1, 2)) / batch)
            made.descend(kept, errors * (2 / batch), optimizer)
            if follows:
                polyak_average_(target, made.parameters, rates)
        results.append((made.parameters, optimizer.first_moment, optimizer.second_moment, target))
        losses.append(torch.stack(seen))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    torch.testing.assert_close(*losses)
    made, _ = network(inputs, hidden, (outputs,))
    assert not torch.equal(made.parameters, results[0][0])


def test_adam_and_polyak_do_not_depend_on_the_number_of_parameters(engine):
    generator = torch.Generator().manual_seed(0)
    parameters, gradient = torch.randn(2, 100, generator=generator), torch.randn(2, 100, generator=generator)
    whole = parameters.clone()
    PopulationAdam(whole, torch.tensor([0.1, 0.2])).step_(gradient)
    target = torch.zeros_like(whole)
    polyak_average_(target, whole, torch.tensor([[0.3], [0.7]]))
    for count in (1, 3, 17, 99):
        part, part_target = parameters[:, :count].contiguous(), torch.zeros(2, count)
        PopulationAdam(part, torch.tensor([0.1, 0.2])).step_(gradient[:, :count].contiguous())
        polyak_average_(part_target, part, torch.tensor([[0.3], [0.7]]))
        assert torch.equal(part, whole[:, :count])
        assert torch.equal(part_target, target[:, :count])


def test_what_regress_would_misread_is_refused(engine):
    made, _ = network(3, (8,), (2,))
    optimizer, x, y = PopulationAdam(made.parameters, torch.ones(P)), torch.zeros(P, 4, 3), torch.zeros(P, 4, 2)
    before = made.parameters.clone()
    with pytest.raises(ValueError, match=r"must be \[3, B, 3\] of torch.float32"):
        made.regress(x[..., :2], y, optimizer)
    with pytest.raises(ValueError, match=r"must be \[3, B, 2\] of torch.float32"):
        made.regress(x, y.double(), optimizer)
    with pytest.raises(ValueError, match=r"targets \(3, 5, 2\) for inputs \(3, 4, 3\)"):
        made.regress(x, torch.zeros(P, 5, 2), optimizer)
    with pytest.raises(ValueError, match=r"targets \(3, 0, 2\) for inputs \(3, 0, 3\)"):
        made.regress(x[:, :0], y[:, :0], optimizer)
    with pytest.raises(ValueError, match="must be dense, and alike"):
        made.regress(x, y, optimizer, Follower(made.parameters[:, :5], torch.ones(P, 1)))
    assert torch.equal(made.parameters, before)
    assert optimizer.num_steps == 0
