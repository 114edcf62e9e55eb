"""What pydantic cannot know of a grid: names and ranges of hyperparameters, environments, seeds, choices. It lists all mistakes.

These functions look at the file as it was read, so that a mistake in one section does not hide those in another: whatever
has the wrong form is passed over here, because pydantic has already complained of it.
"""

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
from sweep.relations import Names, read_relations, zipped_names
from sweep.settings import shown, swept_values

_OF_TRIALS = {*schema.TRIALS.names, *schema.MEMBERS.names}
_SCORES = ("episode_mean", "step_mean", "final_mean")
#: Columns of the SQL views that show hyperparameters beside results: one named so would have no column there.
_OF_VIEWS = (
    {*schema.SELECTIONS.names, "standard_error", "source", "is_frozen", "num_planned", "num_diverged"}
    | {f"{score}_{what}" for score in _SCORES for what in ("standard_error", "low", "high")}
) - _OF_TRIALS
MAX_TRIALS = 1_000_000
MAX_SEEDS = 1_000_000
_SEED_END = 2**62
#: [select]: the valid choices, the default first (all of `by`).
SELECT_CHOICES = {
    "by": ("per-environment", "across-environments"),
    "score": _SCORES,
    "normalizer": ("thesis", "minmax", "percentile", "cdf"),
    "diverged": ("worst", "drop"),
}


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
    found += _environment_table_problems(raw, environments)
    found += _evaluation_problems(raw, known)
    for number, agent in enumerate(agents, start=1):
        found += _agent_problems(f"agent[{number}]", agent, [str(name) for name in environments], raw)
    found += _case_problems(raw, agents, shared_names)
    found += _select_problems(_table(raw.get("select")), raw, agents)
    return found


def names_in_reach(raw: dict[str, Any], agent: dict[str, Any], algorithm: Algorithm, place: str) -> Names:
    """Return the names that an agent's relations may refer to. The agent's own come before the study's."""
    table = algorithm.hypers.table
    fixed: dict[str, str] = {}
    swept: dict[str, tuple[str, tuple[Any, ...]]] = {}
    for tables, prefix, zipped in ((raw, "", ()), (agent, f"{place}.", zipped_names(agent.get("zip")))):
        for name in filter(table.__contains__, _table(tables.get("fixed"))):
            swept.pop(name, None)
            fixed[name] = f"{prefix}fixed"
        for name, sweep in _table(tables.get("sweep")).items():
            if name in table:
                fixed.pop(name, None)
                swept[name] = f"{prefix}sweep", _values(table[name], sweep, name in zipped)
    return Names(swept, fixed, table)


def _values(hyper: Hyper, sweep: Any, repeats: bool) -> tuple[Any, ...]:
    try:
        return swept_values(hyper, sweep, repeats)
    except HyperparameterError:
        return ()


def seeds(tune: int | list[int], evaluate: int | list[int] | None) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return explicit tuning and evaluation seeds: a count takes the numbers from 0, or those after the tuning seeds."""
    tune_seeds = tuple(range(tune)) if isinstance(tune, int) else tuple(tune)
    if isinstance(evaluate, int):
        first = max(tune_seeds) + 1
        return tune_seeds, tuple(range(first, first + evaluate))
    return tune_seeds, tuple(evaluate or ())


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
        if explicit[1][-1] >= _SEED_END:
            found.append(f"seeds.evaluate = {evaluate}: the seeds after the tuning ones are not below 2^62; list them")
        overlap = sorted(set(explicit[0]) & set(explicit[1]))
        if overlap:
            shown = ", ".join(map(str, overlap[:5])) + (", …" if len(overlap) > 5 else "")
            found.append(f"seeds.evaluate: overlaps with seeds.tune ({shown}): evaluation needs fresh seeds")
    return found


def _environment_table_problems(raw: dict[str, Any], environments: list[Any]) -> list[str]:
    names = [name for name in environments if isinstance(name, str)]
    return [
        f"environment.{name}: is none of the study's environments; {suggestion(name, names)}"
        for name in _table(raw.get("environment"))
        if names and name not in names
    ]


def _evaluation_problems(raw: dict[str, Any], known: list[Algorithm]) -> list[str]:
    study, tables = _table(raw.get("study")), _table(raw.get("environment"))
    every = _table(study.get("evaluation")).get("every")
    found = []
    lengths = {"": study.get("steps")} | {f" on {name}": _table(table).get("steps") for name, table in tables.items()}
    for where, steps in lengths.items():
        if type(every) is int and type(steps) is int and every > steps:
            found.append(f"study.evaluation.every = {every}: trials{where} end after {steps:,} steps; no evaluation would happen")
    if "evaluation" in study:
        found += [
            f"study.evaluation: {algorithm.name} cannot be evaluated: it has no act_deterministically"
            for algorithm in known
            if not algorithm.evaluates
        ]
    return found


def _select_problems(section: dict[str, Any], raw: dict[str, Any], agents: list[dict[str, Any]]) -> list[str]:
    found = []
    for key, choices in SELECT_CHOICES.items():
        value = section.get(key)
        listed = (
            {f"select.{key}[{i}]": item for i, item in enumerate(_list(value), start=1)}
            if key == "by"
            else {f"select.{key}": value}
        )
        seen: list[Any] = []
        for place, choice in listed.items():
            if isinstance(choice, str) and choice not in choices:
                found.append(f'{place} = "{choice}": unknown choice; {suggestion(choice, choices)}')
            if choice in seen:
                found.append(f'{place} = "{choice}": listed twice')
            seen.append(choice)
    swept = sorted({name for tables in (raw, *agents) for name in _table(tables.get("sweep"))})
    for number, name in enumerate(_list(section.get("for_each")), start=1):
        if isinstance(name, str) and name not in swept:
            found.append(f'select.for_each[{number}] = "{name}": is not swept; {suggestion(name, swept)}')
        if name in section["for_each"][: number - 1]:
            found.append(f'select.for_each[{number}] = "{name}": listed twice')
    return found


def are_seeds(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(type(seed) is int and 0 <= seed < _SEED_END for seed in value)
    return type(value) is int and 1 <= value <= MAX_SEEDS


def _agent_problems(place: str, agent: dict[str, Any], environments: list[str], raw: dict[str, Any]) -> list[str]:
    name = agent.get("name")
    algorithm = _algorithm(name)
    if not isinstance(algorithm, Algorithm):
        return [f'{place}.name = "{name}": {algorithm}'] if algorithm else []
    found = []
    zipped = zipped_names(agent.get("zip"))
    for section in ("fixed", "sweep"):
        for hyper_name, value in _table(agent.get(section)).items():
            table = algorithm.hypers.table
            hypers = [table[hyper_name]] if hyper_name in table else []
            found += _hyper_problems(
                f"{place}.{section}.{hyper_name}", section, hyper_name, value, hypers, table, hyper_name in zipped
            )
    found += _named_twice(agent, f"{place}.")
    derived = [name for name in _table(agent.get("derive")) if name in algorithm.hypers.table]
    found += [f"{place}.derive.{name}: {column}" for name in derived if (column := _column(name))]
    given = {key for section in ("fixed", "sweep", "derive") for key in (*_table(agent.get(section)), *_table(raw.get(section)))}
    declared = sorted(algorithm.hypers.table.keys() - given)  # columns as well, at their defaults
    found += [
        f'{place}.name = "{name}": its hyperparameter "{known}" {column}' for known in declared if (column := _column(known))
    ]
    found += read_relations(place, agent, names_in_reach(raw, agent, algorithm, place))[1]
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


def _hyper_problems(
    place: str, section: str, name: str, value: Any, hypers: list[Hyper], known: Any, repeats: bool = False
) -> list[str]:
    if column := _column(name):
        return [f"{place}: {column}"]
    if not hypers:
        return [f"{place}: unknown hyperparameter; {suggestion(name, known)}"] if known else []
    for hyper in hypers:  # every agent that has it must be able to take it
        try:
            if section == "sweep":
                swept_values(hyper, value, repeats)
            else:
                hyper.check(value)
        except HyperparameterError as error:
            return [f"{place}: {error}" if section == "sweep" else f"{place} = {shown(value)}: {error}"]
    return []


def _column(name: str) -> str | None:
    """Return what is wrong with a hyperparameter that is named like a column. SQL does not tell upper from lower case."""
    for columns, where in ((_OF_TRIALS, "of every trial"), (_OF_VIEWS, "of the tables of results")):
        if name.lower() in columns:
            return f"is the name of a column {where}; a hyperparameter needs another"
    return None


def _case_problems(raw: dict[str, Any], agents: list[dict[str, Any]], declared: list[str]) -> list[str]:
    """Names that differ in case alone from one that came before, or from one that an algorithm declares."""
    built_in = {name for algorithm in ALGORITHMS.values() for name in algorithm.hypers.table}
    first = {name.lower(): name for name in sorted({*declared, *built_in})}
    found = []
    for prefix, tables in (("", raw), *((f"agent[{number}].", agent) for number, agent in enumerate(agents, start=1))):
        for section in ("fixed", "sweep", "derive"):
            for name in _table(tables.get(section)):
                known = first.setdefault(name.lower(), name)
                if name != known and not _column(name):
                    found.append(f'{prefix}{section}.{name}: differs from "{known}" in case alone, which SQL does not tell apart')
    return found


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
