"""Misspelt names: what a message suggests instead."""

import difflib


def suggest(name, known, otherwise=None):
    """The end of a message about an unknown name: `did you mean wall?`, or `one of wall, boxes`.

    Args:
        name: what was given; converted to a string.
        known: list of the names that exist.
        otherwise: what to say instead of the list, where no name is similar.
    """
    close = difflib.get_close_matches(str(name), known, n=1)
    return f"did you mean {close[0]}?" if close else otherwise or f"one of {', '.join(known)}"
