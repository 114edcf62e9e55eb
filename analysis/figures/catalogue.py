"""Figures by name: the thesis' by their numbers, and the kinds for studies of one's own. Loads no plotting library.

A kind is a module of this package with

    TAKES                                   the names of the `Options` that it takes
    draw(connection, study, options)        → Drawing; its docstring is the caption; NoDataError if the study has nothing for it
    studies(connection, options)            → list[str]: the studies in the store that have data for it, the likeliest first

A demonstration is drawn from what an algorithm does on the spot, not from a store: its module has `draw(rows, title)`, and
`agents.demonstrations` the function that yields the rows.
"""

import importlib
import inspect
from dataclasses import dataclass, field
from types import ModuleType

from analysis.figures.options import Options
from sweep.messages import UserError, suggestion

_CONTINUOUS = ("Acrobot-CA", "MountainCar-CA", "Pendulum-CA")


@dataclass(frozen=True)
class Entry:
    """A figure by name: its kind (a module's name), its title, the built-in studies made for it, and what is shown of a study.

    `demonstration`: the function of `agents.demonstrations` that it is drawn from, for a figure that needs no store.
    """

    name: str
    kind: str
    title: str
    studies: tuple[str, ...] = ()
    options: Options = field(default_factory=Options)
    demonstration: str | None = None

    def load(self) -> ModuleType:
        """Import and return the module that draws it."""
        return importlib.import_module(f"analysis.figures.{self.kind}")

    @property
    def caption(self) -> str:
        """The caption: the docstring of the kind's `draw`."""
        return inspect.getdoc(self.load().draw) or ""


def _curves(number: str, name: str, regime: str) -> Entry:
    options = Options(by=regime, environments=(f"{name.replace(' ', '')}-*",))
    tuned = "tuned per environment" if regime == "per-environment" else "tuned across environments"
    return Entry(number, "learning_curve", f"Learning on {name}, {tuned}", ("chapter-6", f"published-{regime}"), options)


THESIS = (
    Entry("2.1", "cem_update", "One update of the cross-entropy method", demonstration="cem_update"),
    Entry(
        "3.1",
        "evaluation_curve",
        "SAC and DDPG on HalfCheetah: mean, minimum and maximum of all runs",
        ("chapter-3",),
        Options(band="min-max", where={"exploration_noise": "ornstein-uhlenbeck"}),
    ),
    Entry(
        "3.2",
        "evaluation_curve",
        "The same with the five luckiest runs of each agent",
        ("chapter-3",),
        Options(band="min-max", where={"exploration_noise": "ornstein-uhlenbeck"}, best_runs=5),
    ),
    Entry(
        "3.3",
        "evaluation_curve",
        "SAC and tuned DDPG on HalfCheetah",
        ("chapter-3",),
        Options(band="standard-error", where={"exploration_noise": "gaussian"}),
    ),
    Entry("4.2", "ccem_progression", "The conditional cross-entropy method, update by update", demonstration="ccem_progression"),
    _curves("6.1", "Pendulum", "per-environment"),
    _curves("6.2", "Mountain Car", "per-environment"),
    _curves("6.3", "Acrobot", "per-environment"),
    _curves("6.4", "Pendulum", "across-environments"),
    _curves("6.5", "Mountain Car", "across-environments"),
    _curves("6.6", "Acrobot", "across-environments"),
    Entry(
        "7.1",
        "sensitivity_region",
        "Sensitivity to critic step-size and entropy scale",
        ("figure-7-1", "entropy-gradient-sampled"),
        Options(environments=("*-CA",), x="critic_step_size", over="entropy_scale"),
    ),
    Entry(
        "7.2",
        "learning_curve",
        "GreedyAC with N action samples, three of them elites",
        ("figure-7-2", "published-sample-size"),
        Options(by="per-environment", agents=("GreedyAC",), environments=("*-CA",), over="num_action_samples"),
    ),
)
KINDS = (
    Entry("learning-curve", "learning_curve", "Learning curves of the chosen settings"),
    Entry("evaluation-curve", "evaluation_curve", "Deterministic evaluation beside the learning"),
    Entry(
        "sensitivity-region",
        "sensitivity_region",
        "Sensitivity region",
        options=Options(x="critic_step_size", over="entropy_scale"),
    ),
    Entry("slice", "slice", "Each hyperparameter alone, around the best setting"),
    Entry("heat-map", "heat_map", "Two hyperparameters, best over the others"),
    Entry("performance-profile", "performance_profile", "Performance profile of the chosen settings"),
    Entry("sensitivity-plane", "sensitivity_plane", "Performance against hyperparameter sensitivity"),
    Entry("importance", "importance", "Importance of hyperparameters"),
    Entry("setting-ecdf", "setting_ecdf", "Distribution of settings"),
    Entry("seed-spread", "seed_spread", "Spread between seeds of the chosen settings"),
)
FIGURES: dict[str, Entry] = {entry.name: entry for entry in (*THESIS, *KINDS)}


def find(name: str) -> Entry:
    """Return the figure of that number or name; UserError with the known ones if there is none."""
    if name not in FIGURES:
        raise UserError(f'unknown figure "{name}": {suggestion(name, FIGURES)}')
    return FIGURES[name]


def list_figures() -> list[str]:
    """Return a line for each figure: its number or name, and its title."""
    width = max(map(len, FIGURES))
    return [f"{entry.name:<{width}}  {entry.title}" for entry in FIGURES.values()]
