"""The form of a grid file: its sections and keys, checked with pydantic, and what to say where a file has another form."""

import json
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import ErrorDetails

from sweep import grid_checks
from sweep.messages import suggestion
from sweep.overrides import ANY, EACH, Keys
from sweep.settings import shown


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


class EnvironmentSection(_Section):
    """[environment.NAME]: what is other than in [study] on one of its environments"""

    steps: Annotated[int, Field(ge=1, le=2**31 - 1)] | None = None
    cutoff: Annotated[int, Field(ge=1, le=2**31 - 1)] | None = None
    discount: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] | None = None


class SelectSection(_Section):
    """[select]: what the evaluation stage evaluates"""

    by: Annotated[list[str], Field(min_length=1)] = list(grid_checks.SELECT_CHOICES["by"])
    score: str = "episode_mean"
    normalizer: str = "thesis"
    diverged: str = "worst"
    for_each: list[str] = []


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
    zip: list[list[str]] = []
    derive: dict[str, str] = {}
    exclude: list[str] = []


class GridFile(_Section):
    """The whole file, as written."""

    study: StudySection
    seeds: SeedsSection
    agent: Annotated[list[AgentSection], Field(min_length=1)]
    select: SelectSection = SelectSection()
    environment: dict[str, EnvironmentSection] = {}
    fixed: dict[str, Any] = {}
    sweep: dict[str, Any] = {}


_FREE: Keys = {ANY: {ANY: None}}
_AGENT_KEYS = dict.fromkeys(AgentSection.model_fields) | {"fixed": _FREE, "sweep": _FREE, "derive": _FREE}
#: What may stand in a grid file, for `--set`.
KEYS: dict[str, Keys] = {
    "study": dict.fromkeys(StudySection.model_fields) | {"evaluation": dict.fromkeys(EvaluationSection.model_fields)},
    "seeds": dict.fromkeys(SeedsSection.model_fields),
    "agent": {EACH: _AGENT_KEYS},
    "select": dict.fromkeys(SelectSection.model_fields),
    "environment": {ANY: dict.fromkeys(EnvironmentSection.model_fields)},
    "fixed": _FREE,
    "sweep": _FREE,
}


def message(detail: ErrorDetails) -> str:
    """Return `place: what is wrong` for one of pydantic's errors."""
    location = list(detail["loc"])
    place = ""
    for part in location:
        place += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if place else part
    value = shown(detail["input"])
    match detail["type"]:
        case "missing":
            return f"{place}: is missing"
        case "extra_forbidden":
            return f"{place}: unknown key; {suggestion(str(location[-1]), _known_keys(location))}"
        case "string_pattern_mismatch":
            return (
                f"{place} = {json.dumps(detail['input'])}: must be lower-case letters, digits and hyphens, 64 characters at most"
            )
        case "too_short":
            return f"{place}: must not be empty"
        case "list_type" if place == "agent":
            return "agent: must be a list of tables: [[agent]]"
        case "model_type" | "dict_type":
            return f"{place} = {value}: must be a table"
        case _:
            expected = detail["msg"].removeprefix("Value error, ").replace("Input should", "must")
            for theirs, ours in (("valid integer", "whole number"), ("valid string", "text"), ("valid ", "")):
                expected = expected.replace(theirs, ours)
            return f"{place} = {value}: {expected}"


def _known_keys(location: list[Any]) -> list[str]:
    """Return the keys that the table may have in which pydantic found an unknown one."""
    keys: Any = dict.fromkeys(GridFile.model_fields) | KEYS
    for part in location[:-1]:
        keys = keys[EACH] if isinstance(part, int) else keys.get(part, keys.get(ANY))
    return list(keys)
