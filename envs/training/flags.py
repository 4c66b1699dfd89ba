"""Ranges of a script's flags, as part of their types, and the check of all of them at once.

    @dataclass
    class Args:
        num_envs: PositiveInt = 4
        gamma: Share = 0.95

    check(args)   # or ValueError: "--gamma must be in [0, 1], got 2.0"

`--help` shows the ranges, too.
"""

import dataclasses
import math
import sys
import typing
from typing import Annotated

import tyro


class Range(typing.NamedTuple):
    """From `least` to `most`, both included."""

    least: float
    most: float
    words: str


def _number(kind, least, most, words, symbols):
    shown = tyro.conf.arg(metavar=f"{kind.__name__.upper()} {symbols}")
    return Annotated[kind, Range(least, most, words), shown]


LARGEST = sys.float_info.max
PositiveInt = _number(int, 1, 10**12, "at least 1", ">= 1")
NonNegativeInt = _number(int, 0, 10**12, "at least 0", ">= 0")
Seed = _number(int, 0, 2**32 - 1, "in [0, 2^32)", "IN [0, 2^32)")
Workers = _number(int, 1, 256, "in [1, 256]", "IN [1, 256]")
Layers = _number(int, 1, 100, "in [1, 100]", "IN [1, 100]")
Width = _number(int, 1, 2**16, "in [1, 65536]", "IN [1, 65536]")
Pixels = _number(int, 1, 4096, "in [1, 4096]", "IN [1, 4096]")  # larger images are very slow
Environments = _number(int, 1, 1000, "in [1, 1000]", "IN [1, 1000]")  # PyBullet has room for 1,024
Share = _number(float, 0.0, 1.0, "in [0, 1]", "IN [0, 1]")
PositiveShare = _number(float, sys.float_info.min, 1.0, "above 0, and at most 1", "IN (0, 1]")
PositiveFloat = _number(float, sys.float_info.min, LARGEST, "above 0, and finite", "> 0")
NonNegativeFloat = _number(float, 0.0, LARGEST, "at least 0, and finite", ">= 0")
FiniteFloat = _number(float, -LARGEST, LARGEST, "finite", "")


def check(args):
    """Raise ValueError, in one line, unless every flag is within its range.

    Args:
        args: an instance of a dataclass. None, where a flag may be that, is in every range.
    """
    hints = typing.get_type_hints(type(args), include_extras=True)
    for field in dataclasses.fields(args):
        limits, value = _range_of(hints[field.name]), getattr(args, field.name)
        values = value if isinstance(value, tuple) else [value]
        if limits is None or value is None:
            continue
        for one in values:
            if math.isnan(one) or not limits.least <= one <= limits.most:
                flag = f"--{field.name.replace('_', '-')}"
                raise ValueError(f"{flag} must be {limits.words}, got {one!r}")


def _range_of(kind):
    """The `Range` in a type, also inside a union or tuple; None without one."""
    for one in getattr(kind, "__metadata__", ()):
        if isinstance(one, Range):
            return one
    found = (_range_of(one) for one in typing.get_args(kind))
    return next((one for one in found if one is not None), None)
