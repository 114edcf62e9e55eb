"""Overrides: values of a grid changed from outside, as `path=value`, before anything of it is checked.

A path is what messages call the place: `study.steps`, `sweep.critic_step_size`, `agent[2].fixed.batch_size`, with list entries
counted from 1, `environment.Pendulum-CA.steps`. A value is written as in TOML; a bare word is a text.
"""

import re
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

from sweep.messages import UserError, suggestion

#: What may stand in a table: keys → what may stand in them. ANY: any name. None: a value.
Keys = Mapping[str, Any] | None
ANY = "*"
#: A list of tables, of which each has these keys.
EACH = "[]"

_STEP = re.compile(r'\.?(?:"(?P<quoted>[^"]*)"|(?P<bare>[^.\[\]"=\s]+)|\[(?P<index>\d{1,9})\])')
_WORD = re.compile(r"(?=.*[A-Za-z])[\w.:*?/+-]+")


class _OverrideError(ValueError):
    pass


def apply(raw: dict[str, Any], overrides: Sequence[str], keys: Mapping[str, Any]) -> None:
    """Change a grid as it was read. `keys` are those that a grid may have. Raises UserError with every mistake.

    Of two overrides of one path the later one holds.
    """
    problems = []
    for override in overrides:
        try:
            path, equals, text = override.partition("=")
            if not equals:
                raise _OverrideError("must be path=value, such as study.steps=1000")
            _assign(raw, _steps(path.strip()), _value(text.strip()), keys)
        except _OverrideError as error:
            problems.append(f"--set {override}: {error}")
    if problems:
        raise UserError("\n".join(problems))


def _steps(path: str) -> list[str | int]:
    """Return the names and the numbers (from 0) that a path consists of."""
    if match := re.fullmatch(r'environment\.([^"]+)\.([^."\[\]]+)', path):
        return ["environment", *match.groups()]  # names of environments may have dots
    steps: list[str | int] = []
    position = 0
    if not path:
        raise _OverrideError("must be path=value, such as study.steps=1000")
    while position < len(path):
        match = _STEP.match(path, position)
        if not match or (position == 0) == path[position:].startswith((".", "[")):
            raise _OverrideError(f'"{path}" is no path, such as study.steps or agent[1].fixed.batch_size')
        number = match["index"]
        steps.append(int(number) - 1 if number else match["quoted"] if match["quoted"] is not None else match["bare"])
        position = match.end()
    return steps


def _value(text: str) -> Any:
    try:
        read = tomllib.loads(f"value = {text}")
        if list(read) == ["value"]:
            return read["value"]
    except (ValueError, RecursionError):
        if _WORD.fullmatch(text):
            return text
    raise _OverrideError("the value cannot be read: write it as in a grid file, a text in quotes (a bare word needs none)")


def _assign(raw: dict[str, Any], steps: Sequence[str | int], value: Any, keys: Any) -> None:
    place, container = "", raw
    for position, step in enumerate(steps):
        keys = _check_step(place, container, step, keys)
        place += f"[{step + 1}]" if isinstance(step, int) else f".{step}" if place else step
        if position == len(steps) - 1:
            container[step] = value  # type: ignore[index]
        elif isinstance(step, int):
            container = container[step]  # type: ignore[index]
        else:
            container = container.setdefault(step, [] if isinstance(keys, Mapping) and EACH in keys else {})


def _check_step(place: str, container: Any, step: str | int, keys: Any) -> Any:
    """Return the keys that may stand where the step leads, None for those of a value."""
    if isinstance(step, int):
        if not isinstance(container, list):
            raise _OverrideError(f"{place} is no list")
        if not 0 <= step < len(container):
            raise _OverrideError(f"{place} has {len(container)} entries, counted from 1")
        return keys.get(EACH) if isinstance(keys, Mapping) else None
    if isinstance(container, list):
        raise _OverrideError(f"{place} is a list: say which entry, such as {place}[1]")
    if not isinstance(container, dict) or not isinstance(keys, Mapping):
        raise _OverrideError(f"{place} has no keys")
    if step not in keys and ANY not in keys:
        shown = f"{place}.{step}" if place else step
        raise _OverrideError(f"{shown}: unknown key; {suggestion(step, keys)}")
    return keys.get(step, keys.get(ANY))
