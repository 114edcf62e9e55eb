"""Action spaces. An action is a row of floats [A] whatever the space: a discrete one is its index, A = 1."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Continuous:
    """A box of actions: bounds `low` and `high`, one number a dimension."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def size(self) -> int:
        """A, the number of dimensions."""
        return len(self.low)


@dataclass(frozen=True)
class Discrete:
    """The actions 0 … count − 1."""

    count: int

    @property
    def size(self) -> int:
        """A = 1: the action's index."""
        return 1


ActionSpace = Continuous | Discrete
