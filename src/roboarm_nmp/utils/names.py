"""Misspelt names: what a message suggests instead."""

import difflib
from collections.abc import Iterable


def suggest(name: object, known: Iterable[str], otherwise: str | None = None) -> str:
    """The end of a message about an unknown name: `did you mean wall?`, or `one of wall, boxes`.

    Args:
        name: what was given; converted to a string.
        known: the names that exist.
        otherwise: what to say instead of the list, where no name is similar.
    """
    known = list(known)
    close = difflib.get_close_matches(str(name), known, n=1)
    if close:
        return f"did you mean {close[0]}?"
    return otherwise or f"one of {', '.join(known)}"
