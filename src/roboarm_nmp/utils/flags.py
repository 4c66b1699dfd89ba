"""The flags of a script: parsing, a grouped `--help`, ranges as part of their types.

    @dataclass
    class Args:
        num_envs: PositiveInt = 4
        gamma: Share = 0.95

    args = parse(Args)
    check(args)   # or ValueError: "--gamma must be in [0, 1], got 2.0"

`--help` shows the ranges, too.
"""

import ast
import dataclasses
import inspect
import itertools
import math
import os
import re
import shutil
import sys
import textwrap
import typing
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import arg

# The groups of `--help`, in its order, and the flags in each. Flags of other names are in OTHERS.
OTHERS = "algorithm"
GROUPS = {
    "policy": ("policy", "tries", "time_limit", "replan"),
    "task": (
        *("task", "robot", "start", "goal", "goal_pose", "goal_type", "split", "queries"),
        *("problems", "num_queries", "query", "num"),
        *("action_mode", "max_step", "horizon", "stop_on_collision"),
    ),
    "observation": (
        *("encoder", "num_points", "velocities", "geometry_source", "link_distances"),
        *("observe_every", "sensor_noise"),
    ),
    "safety_filter": ("safety_margin", "escape", "approach", "lookahead"),
    "data": (
        *("demo_prob", "demos", "num_demos", "bc_weight", "demo_batch_size"),
        *("paths", "observations", "validation_share"),
    ),
    OTHERS: (),
    "evaluation": (
        *("eval_every", "eval_queries", "test_queries", "stop_at_success", "eval_scenes"),
        *("clearance", "action_delay", "real_time"),
    ),
    "run": (
        *("seed", "runs_dir", "resume", "device", "bf16", "compile", "track", "workers"),
        *("ray_address",),
    ),
    "output": ("output", "overwrite", "repair", "shard_size", "json", "image"),
}

# The cores that this process may use: the default of --workers.
CORES = min(len(os.sched_getaffinity(0)), 256)


class Range(typing.NamedTuple):
    """From `least` to `most`, both included."""

    least: float
    most: float
    words: str


LARGEST = sys.float_info.max
TINIEST = sys.float_info.min
PositiveInt = Annotated[int, Range(1, 10**12, "at least 1"), arg(metavar="INT >= 1")]
NonNegativeInt = Annotated[int, Range(0, 10**12, "at least 0"), arg(metavar="INT >= 0")]
Seed = Annotated[int, Range(0, 2**32 - 1, "in [0, 2^32)"), arg(metavar="INT IN [0, 2^32)")]
Workers = Annotated[int, Range(1, 256, "in [1, 256]"), arg(metavar="INT IN [1, 256]")]
# Processes beside this one.
Helpers = Annotated[int, Range(0, 256, "in [0, 256]"), arg(metavar="INT IN [0, 256]")]
Layers = Annotated[int, Range(1, 100, "in [1, 100]"), arg(metavar="INT IN [1, 100]")]
Width = Annotated[int, Range(1, 2**16, "in [1, 65536]"), arg(metavar="INT IN [1, 65536]")]
# Larger images are very slow.
Pixels = Annotated[int, Range(1, 4096, "in [1, 4096]"), arg(metavar="INT IN [1, 4096]")]
# So that an episode fits into replay buffers.
Horizon = Annotated[int, Range(1, 10**6, "in [1, 1000000]"), arg(metavar="INT IN [1, 1000000]")]
# PyBullet has room for 1,024.
Environments = Annotated[int, Range(1, 1000, "in [1, 1000]"), arg(metavar="INT IN [1, 1000]")]
Share = Annotated[float, Range(0.0, 1.0, "in [0, 1]"), arg(metavar="FLOAT IN [0, 1]")]
PositiveShare = Annotated[
    float, Range(TINIEST, 1.0, "above 0, and at most 1"), arg(metavar="FLOAT IN (0, 1]")
]
PositiveFloat = Annotated[
    float, Range(TINIEST, LARGEST, "above 0, and finite"), arg(metavar="FLOAT > 0")
]
NonNegativeFloat = Annotated[
    float, Range(0.0, LARGEST, "at least 0, and finite"), arg(metavar="FLOAT >= 0")
]
FiniteFloat = Annotated[float, Range(-LARGEST, LARGEST, "finite"), arg(metavar="FLOAT")]


def program():
    """The name of the running program, for messages: `roboarm evaluate`, or a script's name."""
    main = sys.modules["__main__"]
    return getattr(main, "PROGRAM", Path(sys.argv[0]).name)  # `roboarm` sets it


def parse(Args, arguments=None, default=None, others=OTHERS):
    """The flags of the command line as an instance of a dataclass.

    `--help` shows the docstring of the dataclass's module, and the flags in their `GROUPS`, each
    with the docstring under it.

    Args:
        Args: the dataclass, all fields with types that tyro parses.
        arguments: list of strings; None for those of the process.
        default: an instance with other defaults.
        others: the group of the flags that are not in `GROUPS`.

    Raises:
        SystemExit: after `--help`, or for flags that cannot be parsed.
    """
    kinds, docs = typing.get_type_hints(Args, include_extras=True), _docs(Args)
    group_of = {name: group for group, names in GROUPS.items() for name in names}
    groups = {others if group == OTHERS else group: [] for group in GROUPS}
    for field in dataclasses.fields(Args):
        kind = Annotated[kinds[field.name], tyro.conf.arg(help=docs.get(field.name))]
        one = dataclasses.field(default=field.default, default_factory=field.default_factory)
        if default is not None:
            one = dataclasses.field(default=getattr(default, field.name))
        groups[group_of.get(field.name, others)].append((field.name, kind, one))
    made = [
        (group, tyro.conf.OmitArgPrefixes[_dataclass(group, fields)])
        for group, fields in groups.items()
        if fields
    ]
    arguments = sys.argv[1:] if arguments is None else arguments
    if {"-h", "--help"} & set(arguments):  # tyro would not wrap its lines
        description = getattr(sys.modules.get(Args.__module__), "__doc__", None) or ""
        print(_wrapped(description, min(100, shutil.get_terminal_size().columns)), end="\n\n")
    parsed = tyro.cli(_dataclass("Flags", made), prog=program(), args=arguments, description="")
    values = (vars(getattr(parsed, group)) for group, _ in made)
    return Args(**{name: value for group in values for name, value in group.items()})


def _dataclass(name, fields):
    made = dataclasses.make_dataclass(name, fields, kw_only=True)
    made.__doc__ = None  # otherwise its signature, which `--help` would show
    return made


def _wrapped(text, width):
    """A docstring with its paragraphs and list items wrapped. Indented lines stay as they are."""
    blocks = []
    for block in text.strip().split("\n\n"):
        if not block.startswith(" "):
            items = [" ".join(item.split()) for item in re.split(r"\n(?=- )", block)]
            block = "\n".join(
                textwrap.fill(
                    item,
                    width,
                    subsequent_indent="  " * item.startswith("- "),
                    break_long_words=False,
                    break_on_hyphens=False,
                )
                for item in items
            )
        blocks.append(block)
    return "\n\n".join(blocks)


def _docs(Args):
    """The docstrings under a dataclass's fields, and under those of its base classes, by name."""
    docs = {}
    for one in reversed(Args.__mro__[:-1]):
        try:
            source = inspect.getsource(one)
        except (OSError, TypeError):  # a class of an interactive session has none
            continue
        for field, text in itertools.pairwise(ast.parse(textwrap.dedent(source)).body[0].body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                docs[field.target.id] = " ".join(ast.literal_eval(text.value).split())
    return docs


def check(args):
    """Raise ValueError, in one line, unless every flag is within its range, and a path can exist.

    Args:
        args: an instance of a dataclass. None, or a word, where a flag may be that, is in range.
    """
    hints = typing.get_type_hints(type(args), include_extras=True)
    for field in dataclasses.fields(args):
        limits, value = _range_of(hints[field.name]), getattr(args, field.name)
        values = value if isinstance(value, tuple) else [value]
        flag = f"--{field.name.replace('_', '-')}"
        for path in (one for one in values if isinstance(one, Path)):
            try:
                path.exists()
            except OSError as error:  # a name that is too long
                raise ValueError(f"{flag}: {error.strerror}: {path}") from error
        if limits is None or value is None or isinstance(value, str):
            continue
        for one in values:
            if math.isnan(one) or not limits.least <= one <= limits.most:
                raise ValueError(f"{flag} must be {limits.words}, got {one!r}")


def _range_of(kind):
    """The `Range` in a type, also inside a union or tuple; None without one."""
    for one in getattr(kind, "__metadata__", ()):
        if isinstance(one, Range):
            return one
    found = (_range_of(one) for one in typing.get_args(kind))
    return next((one for one in found if one is not None), None)
