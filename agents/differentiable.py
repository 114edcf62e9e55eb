"""Population networks under autograd, for algorithms that do not want to write their gradients down.

    values = differentiable(network, inputs)        # [P, B, in] → [P, B, out]
    loss(values).sum().backward()                   # a mean over the batch, a *sum* over the population
    optimizer.step_(take_gradient(network))

The engine computes forward and backward passes; torch keeps the graph around them.
"""

from typing import Any

import torch
from torch import Tensor

from agents.networks import PopulationMLP


def differentiable(network: PopulationMLP, inputs: Tensor, *, parameters: bool = True) -> Tensor:
    """Return the network's outputs [P, B, out] as a node of autograd's graph; needs `torch.enable_grad()` around it.

    Gradients with respect to the parameters accumulate in `network.parameters.grad`, those with respect to the inputs in theirs.
    With `parameters` False the former are left alone: an actor's loss goes through a critic that does not learn from it.
    """
    if not parameters:
        return _Forward.apply(inputs, network.parameters.detach(), network)
    network.parameters.requires_grad_()
    return _Forward.apply(inputs, network.parameters, network)


def take_gradient(network: PopulationMLP) -> Tensor:
    """Return ∂L/∂parameters [P, n] accumulated since the last call, and forget it."""
    gradient, network.parameters.grad = network.parameters.grad, None
    assert gradient is not None, "nothing has been back-propagated to this network"
    return gradient


class _Forward(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, inputs: Tensor, parameters: Tensor, network: PopulationMLP) -> Tensor:
        outputs, kept = network.forward_for_gradient(inputs.detach())
        context.network = network
        context.kept = kept.clone()  # the network's own buffers serve the next pass
        return outputs.clone()

    @staticmethod
    def backward(context: Any, *output_gradients: Tensor) -> Any:
        (output_gradient,) = output_gradients
        of_inputs, of_parameters = context.needs_input_grad[:2]
        inputs_gradient = context.network.backward(
            context.kept, output_gradient.contiguous(), parameters=of_parameters, inputs=of_inputs
        )
        return (
            inputs_gradient.clone() if of_inputs else None,
            context.network.gradient.clone() if of_parameters else None,
            None,
        )
