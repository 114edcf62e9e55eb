"""The grid file: what a study trains. `load` returns a validated Grid or names every mistake at once.

The file's form is checked here with pydantic; hyperparameters, whose names and ranges the algorithms declare, in
`sweep.grid_checks`.
"""

import tomllib
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from agents.registry import find_algorithm, find_environment
from sweep import grid_checks
from sweep.messages import UserError, suggestion


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def _seeds(value: Any) -> Any:
    if not grid_checks.are_seeds(value):
        raise ValueError(
            f"must be a count of seeds (1 to {grid_checks.MAX_SEEDS:,}) or a list of seeds (whole numbers from 0, below 2^62)"
        )
    return value


_Seeds = Annotated[Any, BeforeValidator(_seeds)]


class EvaluationSection(_Section):
    """[study] evaluation: deterministic episodes beside the learning"""

    every: Annotated[int, Field(ge=1)]
    episodes: Annotated[int, Field(ge=1, le=10_000)]


class StudySection(_Section):
    """[study]"""

    name: Annotated[str, Field(pattern=r"^[a-z0-9-]{1,64}$")]
    environments: Annotated[list[str], Field(min_length=1)]
    steps: Annotated[int, Field(ge=1, le=2**31 - 1)]
    cutoff: Annotated[int, Field(ge=1, le=2**31 - 1)] | None = None
    discount: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.99
    evaluation: EvaluationSection | None = None


class SeedsSection(_Section):
    """[seeds]: counts, or explicit lists"""

    tune: _Seeds
    evaluate: _Seeds | None = None


class AgentSection(_Section):
    """[[agent]]"""

    name: str
    environments: Annotated[list[str], Field(min_length=1)] = ["*"]
    fixed: dict[str, Any] = {}
    sweep: dict[str, Any] = {}


class GridFile(_Section):
    """The whole file, as written."""

    study: StudySection
    seeds: SeedsSection
    agent: Annotated[list[AgentSection], Field(min_length=1)]
    fixed: dict[str, Any] = {}
    sweep: dict[str, Any] = {}


@dataclass(frozen=True)
class AgentGrid:
    """One [[agent]]: its environments, and for each hyperparameter the values it takes, in canonical types."""

    name: str
    environments: tuple[str, ...]
    values: dict[str, tuple[Any, ...]]


@dataclass(frozen=True)
class Grid:
    """A validated study. `text` is the file as it was read; seeds are explicit."""

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


def builtin_grids() -> dict[str, str]:
    """Return the names of the built-in studies and the texts of their grids."""
    folder = resources.files("sweep") / "grids"
    return {file.name.removesuffix(".toml"): file.read_text("utf-8") for file in folder.iterdir() if file.name.endswith(".toml")}


def load(path: str | Path) -> Grid:
    """Return the grid in a file, or the built-in study of that name. Raises UserError with every mistake in it."""
    file = Path(path)
    builtin = builtin_grids()
    if file.is_file():
        try:
            return parse(file.read_text("utf-8-sig"), str(path))
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"{path}: cannot be read: {error}") from None
    if str(path) in builtin:
        return parse(builtin[str(path)], str(path))
    raise UserError(f"{path}: no such grid file, and no built-in study of that name; {suggestion(str(path), builtin)}")


def parse(text: str, place: str) -> Grid:
    """Return the grid that a TOML text describes; `place` names it in messages. Raises UserError with every mistake in it."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{place}: not valid TOML: {error}") from None
    problems: list[str] = []
    try:
        file = GridFile.model_validate(raw)
    except ValidationError as error:
        problems += [_message(detail) for detail in error.errors(include_url=False)]
    problems += grid_checks.problems(raw)
    if problems:
        raise UserError("\n".join(f"{place}: {problem}" for problem in dict.fromkeys(problems)))
    return _resolve(file, text)


def _resolve(file: GridFile, text: str) -> Grid:
    tune, evaluate = grid_checks.seeds(file.seeds.tune, file.seeds.evaluate)
    return Grid(
        name=file.study.name,
        environments=tuple(file.study.environments),
        steps=file.study.steps,
        cutoff=file.study.cutoff,
        discount=file.study.discount,
        tune_seeds=tune,
        evaluate_seeds=evaluate,
        agents=tuple(_resolve_agent(agent, file) for agent in file.agent),
        text=text,
        evaluation=(evaluation.every, evaluation.episodes) if (evaluation := file.study.evaluation) else None,
    )


def _resolve_agent(agent: AgentSection, file: GridFile) -> AgentGrid:
    """The agent's own values come before the study's, and swept values before fixed ones of the same table."""
    known = find_algorithm(agent.name).hypers.table
    values: dict[str, tuple[Any, ...]] = {}
    for fixed, swept in ((file.fixed, file.sweep), (agent.fixed, agent.sweep)):
        values |= {name: (known[name].check(value),) for name, value in fixed.items() if name in known}
        values |= {name: grid_checks.swept_values(known[name], value) for name, value in swept.items() if name in known}
    environments = tuple(
        environment
        for environment in file.study.environments
        if any(fnmatchcase(environment, pattern) for pattern in agent.environments)
        and find_environment(environment).actions in find_algorithm(agent.name).actions
    )
    return AgentGrid(agent.name, environments, values)


def _message(detail: ErrorDetails) -> str:
    """Return `place: what is wrong` for one of pydantic's errors."""
    location = list(detail["loc"])
    place = ""
    for part in location:
        place += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if place else part
    value = detail["input"]
    match detail["type"]:
        case "missing":
            return f"{place}: is missing"
        case "extra_forbidden":
            return f"{place}: unknown key; {suggestion(str(location[-1]), _known_keys(location))}"
        case "string_pattern_mismatch":
            return f'{place} = "{value}": must be lower-case letters, digits and hyphens, 64 characters at most'
        case "too_short":
            return f"{place}: must not be empty"
        case _:
            expected = (
                detail["msg"]
                .removeprefix("Value error, ")
                .replace("Input should", "must")
                .replace("valid integer", "whole number")
            )
            return f"{place} = {value!r}: {expected}"


def _known_keys(location: list[Any]) -> list[str]:
    sections: dict[str, type[BaseModel]] = {"study": StudySection, "seeds": SeedsSection, "agent": AgentSection}
    return list((sections[location[0]] if len(location) > 1 else GridFile).model_fields)
