"""What a user is told about a mistake: the place, the value, the valid choices and the nearest match."""

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """A mistake of the user's: shown as its message, without a traceback, with exit code 1."""


def suggestion(name: str, choices: Iterable[str]) -> str:
    """Return `did you mean "x"? Known: …` (or only the known names when nothing is near)."""
    known = sorted(choices)
    match = next(iter(nearest(name, known, 1)), None)
    start = f'did you mean "{match}"? ' if match else ""
    return f"{start}Known: {', '.join(known)}"


def nearest(name: str, choices: Iterable[str], count: int) -> list[str]:
    """Return up to `count` of the choices that are near to a name, the nearest first, whatever their case."""
    known = list(choices)
    near = difflib.get_close_matches(name, known, n=count, cutoff=0.6)
    if not near:
        folded = {choice.casefold(): choice for choice in known}
        near = [folded[match] for match in difflib.get_close_matches(name.casefold(), folded, n=count, cutoff=0.6)]
    return near


def duration(seconds: float | None) -> str:
    """Return a time for people, such as `2 h 05 min`; `…` when it is not known."""
    if seconds is None:
        return "…"
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {seconds:02} s" if minutes else f"{seconds} s"


def gist(traceback: str) -> str:
    """Return the line of a traceback that names the error, with the first line of its message."""
    lines = traceback.strip().splitlines() or [""]
    frames = [number for number, line in enumerate(lines) if line.startswith("  File ")]
    said = [line for line in lines[frames[-1] :] if not line.startswith(" ")] if frames else []
    return said[0] if said else lines[-1]


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, such as `1 trial` or `2,000 trials`."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"
