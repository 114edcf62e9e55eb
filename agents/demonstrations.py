"""One update of the cross-entropy method on a function of one action, and many of its conditional variant in one state.

The functions run `agents.algorithms.cem` and `agents.algorithms.ccem` as they are and write down what happened (thesis Figures
2.1 and 4.2). Nothing is trained that a study would train: the action values are given, `two_peaks`, and do not change.

A demonstration is a tidy table, a list of rows with the same four columns: `update` (how many updates came before), `series`,
`action`, `value`. What a row says depends on its series:
- "objective": the function's `value` at an `action` of a grid;
- "sample": an action that was drawn, and its value; "elite": the same of those samples that an update follows, again;
- "density", "actor", "proposal": the probability density `value` at an `action` of the grid;
- "density parameters", "actor parameters", "proposal parameters": the mean as `action`, the standard deviation as `value`.
"""

from collections.abc import Iterable
from typing import cast

import torch
from torch import Tensor

from agents.actor import Actor
from agents.algorithm import Task
from agents.algorithms.ccem import CCEM
from agents.algorithms.cem import Normal, improve
from agents.critic import Critic
from agents.elites import best_actions
from agents.hypers import GreedyACHypers
from agents.policies import Gaussian
from agents.population import padded
from agents.spaces import Continuous

Row = dict[str, float | str]

_LOW, _HIGH, _GRID_SIZE = -3.0, 3.0, 301
_CEM_SAMPLES, _CEM_FRACTION, _CEM_STD = 30, 0.2, 1.2
_CCEM_UPDATES = 40
_CCEM_HYPERS = GreedyACHypers(
    critic_step_size=0.05,
    actor_step_size_scale=1.0,
    entropy_scale=0.3,
    num_action_samples=30,
    elite_fraction=0.1,
)
"""Of the two policies only `actor_step_size` counts, which is large: in one state, tens of updates have to be enough."""


def two_peaks(actions: Tensor) -> Tensor:
    """Return the values [...] of actions [..., 1]: a broad peak of height 0.5 at −1.4, a narrow one of height 1 at 1."""
    a = actions[..., 0]
    return 0.5 * torch.exp(-(((a + 1.4) / 0.8) ** 2)) + torch.exp(-(((a - 1) / 0.5) ** 2))


def cem_update(seed: int = 0) -> list[Row]:
    """Return one update of the cross-entropy method on `two_peaks` (thesis Algorithm 5; Figure 2.1).

    Series: "objective", "sample" and "elite" at update 0; "density" and "density parameters" at update 0, before, and 1, after.
    """
    generator = torch.Generator().manual_seed(seed)
    before = Normal(torch.zeros(1, dtype=torch.float64), torch.full((1,), _CEM_STD, dtype=torch.float64))
    generation = improve(two_peaks, before, _CEM_SAMPLES, _CEM_FRACTION, generator)
    elite = generation.values >= generation.threshold
    grid = _grid(torch.float64)
    rows = _rows(0, "objective", grid, two_peaks(grid))
    rows += _rows(0, "sample", generation.samples, generation.values)
    rows += _rows(0, "elite", generation.samples[elite], generation.values[elite])
    for update, density in enumerate((generation.density, generation.next_density)):
        rows += _rows(update, "density", grid, density.log_density(grid).exp())
        rows += _rows(update, "density parameters", density.mean, density.std)
    return rows


def ccem_progression(seed: int = 0) -> list[Row]:
    """Return 40 updates of the conditional cross-entropy method in one state (thesis Algorithm 6; Figure 4.2); `seed` ≥ 0.

    The state is 0, where networks without biases have outputs 0: both policies start from the mean 0 and the standard deviation
    1 whatever the seed, and only the biases of their heads learn.

    Series: "objective" at update 0; "sample", "elite", and "actor" and "proposal" with their parameters at updates 0 … 40.
    """
    population = padded([_CCEM_HYPERS], [seed], torch.device("cpu"))
    task = Task(observation_size=1, actions=Continuous((_LOW,), (_HIGH,)), discount=1.0)
    stream = population.stream()
    actor, proposal = (Actor(population, task, stream, network=1) for _ in range(2))
    ccem = CCEM(_CCEM_HYPERS, Continuous((_LOW,), (_HIGH,)), actor, proposal, population.stacked("entropy_scale")[:, None, None])
    state, values, grid = torch.zeros(len(population), 1, 1), _FixedValues(), _grid(torch.float32)
    rows = _rows(0, "objective", grid, two_peaks(grid))
    for update in range(_CCEM_UPDATES + 1):
        policies = {
            "actor": Gaussian(ccem.space, actor.outputs(state)),
            "proposal": Gaussian(ccem.space, proposal.outputs(state)),
        }
        for name, policy in policies.items():
            rows += _rows(update, name, grid, policy.log_prob(grid.expand(len(population), 1, -1, 1))[0, 0].exp())
            rows += _rows(update, f"{name} parameters", policy.mean[0], policy.std[0])
        ccem.update(cast(Critic, values), state, update)
        elites = best_actions(values.values, values.actions, _CCEM_HYPERS.num_elites)
        rows += _rows(update, "sample", values.actions[0, 0], values.values[0, 0])
        rows += _rows(update, "elite", elites[0, 0], two_peaks(elites)[0, 0])
    return rows


class _FixedValues:
    """`two_peaks` in every state in place of a critic, as far as an update needs one; keeps what it was asked for last."""

    def values_of_actions(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the values [P, B, N] of actions [P, B, N, 1]."""
        self.actions, self.values = actions.clone(), two_peaks(actions)
        return self.values


def _grid(dtype: torch.dtype) -> Tensor:
    return torch.linspace(_LOW, _HIGH, _GRID_SIZE, dtype=dtype).unsqueeze(1)


def _rows(update: int, series: str, actions: Tensor, values: Tensor) -> list[Row]:
    pairs: Iterable[tuple[float, float]] = zip(actions.flatten().tolist(), values.flatten().tolist(), strict=True)
    return [{"update": update, "series": series, "action": action, "value": value} for action, value in pairs]
