"""The grid file: what a study trains. `load` returns a validated Grid or names every mistake at once.

The file's form is checked with pydantic (`sweep.grid_file`), names and ranges of hyperparameters, which the algorithms declare,
in `sweep.grid_checks`, and the settings that follow from them when they are expanded (`sweep.settings`).
"""

import math
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from agents.hypers import Hypers
from agents.registry import find_algorithm, find_environment
from sweep import grid_checks
from sweep.grid_file import KEYS, EnvironmentSection, GridFile, SelectSection, message
from sweep.messages import UserError, suggestion
from sweep.overrides import apply
from sweep.relations import Relations, read_relations, zipped_names
from sweep.settings import count, expand_settings, swept_values


@dataclass(frozen=True)
class AgentGrid:
    """One [[agent]]: its environments, the values of each hyperparameter that it fixes or sweeps, and its settings.

    `values` are in canonical types; derived hyperparameters are not among them. `settings` is what product, `relations` and
    defaults make of them, before anything is dropped that does not apply on an environment.
    """

    name: str
    environments: tuple[str, ...]
    values: dict[str, tuple[Any, ...]]
    relations: Relations = field(default_factory=Relations)
    settings: tuple[Hypers, ...] = ()


@dataclass(frozen=True)
class Conditions:
    """How long agents learn on an environment, after how many steps its episodes are cut off, and γ."""

    steps: int
    cutoff: int
    discount: float


@dataclass(frozen=True)
class Select:
    """What the evaluation stage evaluates: a choice for each of `by`, and for each value of the `for_each` hyperparameters.

    `score` is the column of a trial that is maximized, `normalizer` makes scores of several environments comparable, `diverged`
    says how a diverged trial counts.
    """

    by: tuple[str, ...] = grid_checks.SELECT_CHOICES["by"]
    score: str = "episode_mean"
    normalizer: str = "thesis"
    diverged: str = "worst"
    for_each: tuple[str, ...] = ()


@dataclass(frozen=True)
class Grid:
    """A validated study. `text` is the file as it was read, `overrides` what was changed in it; seeds are explicit.

    `steps`, `cutoff` and `discount` are the study's; `conditions` gives those of an environment.
    """

    name: str
    environments: tuple[str, ...]
    steps: int
    cutoff: int | None
    discount: float
    tune_seeds: tuple[int, ...]
    evaluate_seeds: tuple[int, ...]
    agents: tuple[AgentGrid, ...]
    text: str
    evaluation: tuple[int, int] | None = None
    select: Select = Select()
    overrides: tuple[str, ...] = ()
    environment_sections: dict[str, EnvironmentSection] = field(default_factory=dict)

    def conditions(self, environment: str) -> Conditions:
        """Return how agents learn on one of the study's environments: its own table comes before the study's."""
        own = self.environment_sections.get(environment, EnvironmentSection())
        return Conditions(
            steps=own.steps or self.steps,
            cutoff=own.cutoff or self.cutoff or find_environment(environment).cutoff,
            discount=self.discount if own.discount is None else own.discount,
        )


def builtin_grids() -> dict[str, str]:
    """Return the names of the built-in studies, such as `thesis/chapter-6`, and the texts of their grids."""
    folder = resources.files("sweep") / "grids"
    return dict(sorted(_grids(folder, "")))


def _grids(folder: Traversable, prefix: str) -> Iterator[tuple[str, str]]:
    for entry in folder.iterdir():
        if entry.is_dir():
            yield from _grids(entry, f"{prefix}{entry.name}/")
        elif entry.name.endswith(".toml"):
            yield prefix + entry.name.removesuffix(".toml"), entry.read_text("utf-8")


def load(path: str | Path, overrides: Sequence[str] = ()) -> Grid:
    """Return the grid in a file, or the built-in study of that name; a file comes before a study of the same name.

    `overrides` are `path=value` (`sweep.overrides`). Raises UserError with every mistake.
    """
    file = Path(path)
    builtin = builtin_grids()
    if file.is_file():
        try:
            return parse(file.read_text("utf-8-sig"), str(path), overrides)
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"{path}: cannot be read: {error}") from None
    if str(path) in builtin:
        return parse(builtin[str(path)], str(path), overrides)
    raise UserError(f"{path}: no such grid file, and no built-in study of that name; {suggestion(str(path), builtin)}")


def parse(text: str, place: str, overrides: Sequence[str] = ()) -> Grid:
    """Return the grid that a TOML text describes; `place` names it in messages. Raises UserError with every mistake in it.

    Mistakes that only the settings show, such as a derived value out of its range, are listed once nothing else is wrong.
    """
    try:
        raw = tomllib.loads(text)
    except RecursionError:
        raise UserError(f"{place}: not valid TOML: nested too deeply") from None
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{place}: not valid TOML: {error}") from None
    except ValueError:
        raise UserError(f"{place}: not valid TOML: a number of thousands of digits") from None
    apply(raw, overrides, KEYS)
    problems: list[str] = []
    try:
        file = GridFile.model_validate(raw)
    except ValidationError as error:
        problems += [message(detail) for detail in error.errors(include_url=False)]
    problems += grid_checks.problems(raw)
    grid = None if problems else _resolve(file, raw, text, tuple(overrides), problems)
    if grid is None or problems:
        raise UserError("\n".join(f"{place}: {problem}" for problem in dict.fromkeys(problems)))
    return grid


def _resolve(file: GridFile, raw: dict[str, Any], text: str, changes: tuple[str, ...], problems: list[str]) -> Grid | None:
    """Return the grid, and add what is wrong with its settings to `problems`; None when there are too many of them."""
    tune, evaluate = grid_checks.seeds(file.seeds.tune, file.seeds.evaluate)
    agents = [_resolve_agent(number, file, raw) for number in range(1, len(file.agent) + 1)]
    problems += _size_problems(agents, len(tune), len(evaluate), file.select)
    if problems:
        return None
    expanded = []
    for number, agent in enumerate(agents, start=1):
        hypers = find_algorithm(agent.name).hypers
        settings, wrong = expand_settings(hypers, agent.values, agent.relations, f"agent[{number}]")
        problems += wrong
        expanded.append(replace(agent, settings=settings))
    return Grid(
        name=file.study.name,
        environments=tuple(file.study.environments),
        steps=file.study.steps,
        cutoff=file.study.cutoff,
        discount=file.study.discount,
        tune_seeds=tune,
        evaluate_seeds=evaluate,
        agents=tuple(expanded),
        text=text,
        evaluation=(evaluation.every, evaluation.episodes) if (evaluation := file.study.evaluation) else None,
        select=Select(
            tuple(file.select.by),
            file.select.score,
            file.select.normalizer,
            file.select.diverged,
            tuple(file.select.for_each),
        ),
        overrides=changes,
        environment_sections=file.environment,
    )


def _resolve_agent(number: int, file: GridFile, raw: dict[str, Any]) -> AgentGrid:
    """The agent's own values come before the study's, and swept values before fixed ones of the same table."""
    agent, place = file.agent[number - 1], f"agent[{number}]"
    algorithm = find_algorithm(agent.name)
    known = algorithm.hypers.table
    values: dict[str, tuple[Any, ...]] = {}
    for fixed, swept, zipped in ((file.fixed, file.sweep, ()), (agent.fixed, agent.sweep, zipped_names(agent.zip))):
        values |= {name: (known[name].check(value),) for name, value in fixed.items() if name in known}
        values |= {name: swept_values(known[name], value, name in zipped) for name, value in swept.items() if name in known}
    environments = tuple(
        environment
        for environment in file.study.environments
        if any(fnmatchcase(environment, pattern) for pattern in agent.environments)
        and find_environment(environment).actions in algorithm.actions
    )
    section = raw["agent"][number - 1]
    relations, _ = read_relations(place, section, grid_checks.names_in_reach(raw, section, algorithm, place))
    return AgentGrid(agent.name, environments, values, relations)


def _size_problems(agents: list[AgentGrid], num_tune: int, num_evaluate: int, select: SelectSection) -> list[str]:
    """Refuse an enormous product from the counts, before anything of it is expanded."""
    tuning = evaluation = 0
    for agent in agents:
        settings = count(agent.values, agent.relations.zipped)
        groups = math.prod(len(agent.values.get(name, (None,))) for name in select.for_each)
        tuning += settings * len(agent.environments) * num_tune
        evaluation += min(settings, len(select.by) * groups) * len(agent.environments) * num_evaluate
    sizes = {"trials": tuning, "evaluation trials": evaluation}
    return [
        f"{size:,} {what}; at most {grid_checks.MAX_TRIALS:,} are planned at once"
        for what, size in sizes.items()
        if size > grid_checks.MAX_TRIALS
    ]
