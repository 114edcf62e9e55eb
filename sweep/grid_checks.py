"""What pydantic cannot know of a grid: names and ranges of hyperparameters, environments, seeds. Every mistake is listed.

These functions look at the file as it was read, so that a mistake in one section does not hide those in another: whatever
has the wrong form is passed over here, because pydantic has already complained of it.
"""

import math
from collections import Counter
from fnmatch import fnmatchcase
from typing import Any

from agents.hypers import Hyper, HyperparameterError
from agents.registry import (
    ALGORITHMS,
    ENVIRONMENTS,
    Algorithm,
    AlgorithmLookupError,
    EnvironmentLookupError,
    find_algorithm,
    find_environment,
)
from sweep import schema
from sweep.messages import nearest, suggestion

_RESERVED = {*schema.TRIALS.names, *schema.MEMBERS.names}
MAX_TRIALS = 1_000_000
MAX_SEEDS = 1_000_000
_FORMS = "a list, { values = […] }, { logspace = [first exponent, last exponent, count] } or { range = [first, last, step] }"


def problems(raw: dict[str, Any]) -> list[str]:
    """Return a message for each mistake in a grid file's content."""
    found: list[str] = []
    agents = [agent for agent in _list(raw.get("agent")) if isinstance(agent, dict)]
    environments = _list(_table(raw.get("study")).get("environments"))
    found += _environment_problems(environments)
    found += _seed_problems(_table(raw.get("seeds")))
    known = [algorithm for agent in agents if isinstance(algorithm := _algorithm(agent.get("name")), Algorithm)]
    # a function takes any name: it does not make a misspelled one right for the others
    declaring = [algorithm for algorithm in known if not algorithm.one_trial] or known
    shared_names = sorted({name for algorithm in declaring for name in algorithm.hypers.table})
    for section in ("fixed", "sweep"):
        for name, value in _table(raw.get(section)).items():
            hypers = [algorithm.hypers.table[name] for algorithm in declaring if name in algorithm.hypers.table]
            found += _hyper_problems(f"{section}.{name}", section, name, value, hypers, shared_names)
    found += _named_twice(raw, "")
    found += _evaluation_problems(_table(raw.get("study")), known)
    for number, agent in enumerate(agents, start=1):
        found += _agent_problems(f"agent[{number}]", agent, [str(name) for name in environments])
    return found


def seeds(tune: int | list[int], evaluate: int | list[int] | None) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return explicit tuning and evaluation seeds: a count takes the numbers from 0, or those after the tuning seeds."""
    tune_seeds = tuple(range(tune)) if isinstance(tune, int) else tuple(tune)
    if isinstance(evaluate, int):
        first = max(tune_seeds) + 1
        return tune_seeds, tuple(range(first, first + evaluate))
    return tune_seeds, tuple(evaluate or ())


def swept_values(hyper: Hyper, sweep: Any) -> tuple[Any, ...]:
    """Return the values of a sweep in canonical types. Raises HyperparameterError when there are none, or one is bad."""
    if isinstance(sweep, dict):
        form, listed = next(iter(sweep.items())) if len(sweep) == 1 else ("", None)
        if form not in ("values", "logspace", "range") or not isinstance(listed, list):
            raise HyperparameterError(f"must be {_FORMS}")
        values = listed if form == "values" else _series(form, listed)
    elif isinstance(sweep, list):
        values = sweep
    else:
        raise HyperparameterError(f"must be {_FORMS}; a single value belongs in [fixed]")
    if not values:
        raise HyperparameterError("nothing to sweep: the list of values is empty")
    checked: list[Any] = []
    for value in values:
        try:
            checked.append(hyper.check(value))
        except HyperparameterError as error:
            raise HyperparameterError(f"value {value!r} {error}") from None
        if checked[-1] in checked[:-1]:
            raise HyperparameterError(f"value {value!r} is listed twice")
    return tuple(checked)


def _series(form: str, arguments: list[Any]) -> list[float | int]:
    if len(arguments) != 3 or not all(type(x) in (int, float) and math.isfinite(x) for x in arguments):
        raise HyperparameterError(f"{form} takes three numbers: {_FORMS}")
    first, last, third = arguments
    if form == "logspace":
        if type(third) is not int or not 2 <= third <= 10_000 or max(abs(first), abs(last)) > 300:
            raise HyperparameterError(
                "logspace = [first exponent, last exponent, count] needs a count of 2 to 10,000 and exponents within ±300"
            )
        return [float(f"{10 ** (first + (last - first) * i / (third - 1)):.12g}") for i in range(third)]
    if third == 0 or (last - first) / third < 0 or (last - first) / third > 10_000:
        raise HyperparameterError(
            "range = [first, last, step] needs a step that leads from first to last in at most 10,000 values"
        )
    count = math.floor((last - first) / third + 1e-9) + 1
    values = [first + i * third for i in range(count)]
    return [value if type(value) is int else float(f"{value:.12g}") for value in values]


def _environment_problems(environments: list[Any]) -> list[str]:
    found = []
    for number, name in enumerate(environments, start=1):
        if isinstance(name, str) and (problem := _environment_problem(name)):
            found.append(f'study.environments[{number}] = "{name}": {problem}')
        if name in environments[: number - 1]:
            found.append(f'study.environments[{number}] = "{name}": listed twice')
    return found


def _environment_problem(name: str) -> str | None:
    try:
        find_environment(name)
    except EnvironmentLookupError as error:
        if not error.choices:
            return error.reason
        ids = nearest(name, error.choices, 2) or ["CartPole-v1"]
        return f"{error.reason}; {suggestion(name, ENVIRONMENTS)}; or a Gymnasium id, such as {', '.join(ids)}"
    return None


def _seed_problems(section: dict[str, Any]) -> list[str]:
    found = []
    lists = {key: value for key, value in section.items() if key in ("tune", "evaluate") and isinstance(value, list)}
    for key, listed in lists.items():
        twice = (
            sorted(seed for seed, count in Counter(listed).items() if type(seed) is int and count > 1)
            if are_seeds(listed)
            else []
        )
        if twice:
            found.append(f"seeds.{key}: seed {twice[0]} is listed twice")
    tune, evaluate = section.get("tune"), section.get("evaluate")
    if are_seeds(tune) and are_seeds(evaluate):
        explicit = seeds(tune, evaluate)  # type: ignore[arg-type]
        overlap = sorted(set(explicit[0]) & set(explicit[1]))
        if overlap:
            shown = ", ".join(map(str, overlap[:5])) + (", …" if len(overlap) > 5 else "")
            found.append(f"seeds.evaluate: overlaps with seeds.tune ({shown}): evaluation needs fresh seeds")
    return found


def _evaluation_problems(study: dict[str, Any], known: list[Algorithm]) -> list[str]:
    every, steps = _table(study.get("evaluation")).get("every"), study.get("steps")
    found = []
    if type(every) is int and type(steps) is int and every > steps:
        found.append(f"study.evaluation.every = {every}: trials end after {steps:,} steps; no evaluation would happen")
    if "evaluation" in study:
        found += [
            f"study.evaluation: {algorithm.name} cannot be evaluated: it has no act_deterministically"
            for algorithm in known
            if not algorithm.evaluates
        ]
    return found


def are_seeds(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(type(seed) is int and 0 <= seed < 2**62 for seed in value)
    return type(value) is int and 1 <= value <= MAX_SEEDS


def _agent_problems(place: str, agent: dict[str, Any], environments: list[str]) -> list[str]:
    name = agent.get("name")
    algorithm = _algorithm(name)
    if not isinstance(algorithm, Algorithm):
        return [f'{place}.name = "{name}": {algorithm}'] if algorithm else []
    found = []
    for section in ("fixed", "sweep"):
        for hyper_name, value in _table(agent.get(section)).items():
            table = algorithm.hypers.table
            hypers = [table[hyper_name]] if hyper_name in table else []
            found += _hyper_problems(f"{place}.{section}.{hyper_name}", section, hyper_name, value, hypers, table)
    found += _named_twice(agent, f"{place}.")
    found += _pattern_problems(f"{place}.environments", algorithm, agent.get("environments", ["*"]), environments)
    return found


def _algorithm(name: Any) -> Algorithm | str | None:
    """Return the algorithm of that name, or what is wrong with the name; None where it is not a name at all."""
    if not isinstance(name, str):
        return None
    try:
        return find_algorithm(name)
    except AlgorithmLookupError as error:
        return error.reason if ":" in name else f"{error.reason}; {suggestion(name, ALGORITHMS)}; or package.module:Name"


def _hyper_problems(place: str, section: str, name: str, value: Any, hypers: list[Hyper], known: Any) -> list[str]:
    if name in _RESERVED:
        return [f"{place}: is the name of a column of every trial; a hyperparameter needs another"]
    if not hypers:
        return [f"{place}: unknown hyperparameter; {suggestion(name, known)}"] if known else []
    for hyper in hypers:  # every agent that has it must be able to take it
        try:
            if section == "sweep":
                swept_values(hyper, value)
            else:
                hyper.check(value)
        except HyperparameterError as error:
            return [f"{place}: {error}" if section == "sweep" else f"{place} = {value!r}: {error}"]
    return []


def _named_twice(tables: dict[str, Any], prefix: str) -> list[str]:
    both = _table(tables.get("fixed")).keys() & _table(tables.get("sweep")).keys()
    return [f"{prefix}sweep.{name}: is in {prefix}fixed too; keep one" for name in sorted(both)]


def _pattern_problems(place: str, algorithm: Algorithm, patterns: Any, environments: list[str]) -> list[str]:
    found = []
    for number, pattern in enumerate(_list(patterns), start=1):
        if not isinstance(pattern, str):
            continue
        matched = [name for name in environments if fnmatchcase(name, pattern)]
        if environments and not matched:
            found.append(f'{place}[{number}] = "{pattern}": matches none of the study\'s environments: {", ".join(environments)}')
        known = [find_environment(name) for name in matched if _environment_problem(name) is None]
        if known and all(environment.actions not in algorithm.actions for environment in known):
            found.append(f"{place}: {algorithm.name} acts in {' and '.join(algorithm.actions)} action spaces only")
    return found


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []
