"""A ring buffer of transitions for every agent of a population, filled and sampled in lock-step."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents import kernels
from agents.clock import Clock
from agents.lasting import CheckpointError
from agents.rng import Purpose, RandomStream


@dataclass(frozen=True)
class Batch:
    """Transitions sampled by each agent, views of one tensor.

    `states` [P, B, S], `actions` [P, B, A], `rewards` and `continues` [P, B, 1] (0 where the transition terminated, else 1:
    a cutoff bootstraps), `next_states` [P, B, S]: the true successors, never a reset state. `states_actions` [P, B, S + A].
    """

    states: Tensor
    actions: Tensor
    states_actions: Tensor
    rewards: Tensor
    continues: Tensor
    next_states: Tensor


class Replay:
    """Transitions (S, A, R, continues, S') of P agents: [P, capacity, 2S + A + 2].

    With a clock that counts on the device, places in the buffer are read from it; one transition is added a step.
    """

    def __init__(
        self,
        population: int,
        capacity: int,
        state_size: int,
        action_size: int,
        device: torch.device,
        clock: Clock | None = None,
    ) -> None:
        self.capacity, self.state_size, self.action_size = capacity, state_size, action_size
        self.width = 2 * state_size + action_size + 2
        self.rows = torch.zeros(population, capacity, self.width, device=device)
        self.num_added = 0
        self._clock = clock if clock is not None and clock.tensor is not None else None
        self._native = kernels.library(self.rows.device.type)

    def add(self, states: Tensor, actions: Tensor, rewards: Tensor, terminated: Tensor, next_states: Tensor) -> None:
        """Add one transition an agent: [P, S], [P, A], [P], [P] (bool), [P, S]; the oldest gives way when full."""
        columns = [rewards.float().unsqueeze(1), terminated.logical_not().unsqueeze(1)]
        row = torch.cat([states, actions, *columns, next_states], dim=1)
        if self._clock is None:
            self.rows[:, self.num_added % self.capacity] = row
        else:
            self.rows.index_copy_(1, self._clock.place_in(self.capacity), row.unsqueeze(1))
        self.num_added += 1

    def state_for_checkpoint(self) -> dict[str, Any]:
        """Return the rows that are filled, a view where they lie on the CPU, and how many were ever added."""
        num_added = self.num_added if self._clock is None else self._clock.number  # captured steps do not come by here to count
        return {"num_added": num_added, "rows": self.rows[:, : min(num_added, self.capacity)].cpu().numpy()}

    def restore_from_checkpoint(self, state: dict[str, Any]) -> None:
        """Fill a new buffer. Raises CheckpointError for rows of another shape."""
        rows, filled = state["rows"], min(state["num_added"], self.capacity)
        if rows.shape != (len(self.rows), filled, self.width):
            raise CheckpointError(f"replay rows {list(rows.shape)}: must be {[len(self.rows), filled, self.width]}")
        if self.rows.device.type == "cpu":
            np.copyto(self.rows[:, :filled].numpy(), rows)
        else:
            self.rows[:, :filled] = torch.from_numpy(np.array(rows)).to(self.rows.device)
        self.num_added = state["num_added"]

    def sample(self, stream: RandomStream, step: int, batch_size: int) -> Batch:
        """Draw `batch_size` transitions an agent, uniformly with replacement. Raises ValueError for a stream of other agents."""
        if len(stream.seeds) != len(self.rows):
            raise ValueError(f"a stream of {len(stream.seeds)} agents for the buffers of {len(self.rows)}")
        size: int | Tensor = min(self.num_added, self.capacity)
        if self._clock is not None and self._clock.tensor is not None:
            size = self._clock.tensor.clamp(max=self.capacity)
        indices = stream.integers(Purpose.MINIBATCH, step, batch_size, size, offset=self.capacity)
        rows = self._gathered(indices)
        S, A = self.state_size, self.action_size
        return Batch(
            states=rows[..., :S],
            actions=rows[..., S : S + A],
            states_actions=rows[..., : S + A],
            rewards=rows[..., S + A : S + A + 1],
            continues=rows[..., S + A + 1 : S + A + 2],
            next_states=rows[..., S + A + 2 :],
        )

    def _gathered(self, indices: Tensor) -> Tensor:
        """Return the rows [P, B, width] at these places [P, B], counted over the buffers of all agents."""
        if self._native is None:
            return self.rows.view(-1, self.width).index_select(0, indices.view(-1)).view(*indices.shape, self.width)
        rows = torch.empty(*indices.shape, self.width)
        self._native.gather(indices.numel(), self.width, self.rows.data_ptr(), indices.data_ptr(), rows.data_ptr())
        return rows
