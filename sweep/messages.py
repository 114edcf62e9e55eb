"""What a user is told about a mistake: the place, the value, the valid choices and the nearest match."""

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """A mistake of the user's: shown as its message, without a traceback, with exit code 1."""


def suggestion(name: str, choices: Iterable[str]) -> str:
    """Return `did you mean "x"? Known: …` (or only the known names when nothing is near)."""
    known = sorted(choices)
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6) or difflib.get_close_matches(
        name.casefold(), [choice.casefold() for choice in known], n=1, cutoff=0.6
    )
    match = next((choice for choice in known if near and choice.casefold() == near[0].casefold()), None)
    start = f'did you mean "{match}"? ' if match else ""
    return f"{start}Known: {', '.join(known)}"
