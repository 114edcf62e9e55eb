"""What an engine does for one population network, and what it keeps of a forward pass."""

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self

from torch import Tensor

if TYPE_CHECKING:
    from agents.optimizer import PopulationAdam


class Activations(Protocol):
    """What `backward` needs of a forward pass, in an engine's own form."""

    @property
    def inputs(self) -> tuple[Tensor, ...]:
        """The inputs of every layer, [P, B, width] each, the network's own first."""
        ...

    def clone(self) -> Self:
        """Return a copy that the next forward pass does not overwrite."""
        ...


class Follower(NamedTuple):
    """Parameters [P, n] that follow a network's by Polyak averaging, at `rates` [P, 1]: a target network's."""

    parameters: Tensor
    rates: Tensor


class Arithmetic(Protocol):
    """The methods of `agents.networks.PopulationMLP`, whose docstrings hold here."""

    def forward(self, x: Tensor) -> Tensor: ...
    def forward_for_gradient(self, x: Tensor) -> tuple[Tensor, Any]: ...
    def backward(self, kept: Any, output_gradient: Tensor, gradient: Tensor | None, inputs: bool) -> Tensor | None: ...
    def descend(self, kept: Any, output_gradient: Tensor, optimizer: "PopulationAdam") -> None: ...
    def regress(self, x: Tensor, targets: Tensor, optimizer: "PopulationAdam", follower: Follower | None) -> Tensor: ...
    def values_of_actions(self, states: Tensor, actions: Tensor) -> Tensor: ...
