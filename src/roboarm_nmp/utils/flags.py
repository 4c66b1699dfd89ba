"""The flags of a script: parsing, a grouped `--help`, ranges as part of their types.

    @dataclass
    class Args:
        num_envs: PositiveInt = 4
        gamma: Share = 0.95

    args = parse(Args)
    check(args)   # or ValueError: "--gamma must be in [0, 1], got 2.0"

`--help` shows the ranges, too.
"""

import contextlib
import dataclasses
import os
import shutil
import sys
import textwrap
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import docstring_parser
import tyro
from tyro.conf import arg

from roboarm_nmp.utils.signals import program

T = TypeVar("T")

# The groups of `--help`, in its order, and the flags in each. Flags of other names are in OTHERS.
OTHERS = "algorithm"
GROUPS = {
    "policy": ("policy", "tries", "time_limit", "replan", "search", "unknown", "verify_else"),
    "task": (
        *("task", "robot", "start", "goal", "goal_pose", "goal_type", "split", "queries"),
        *("problems", "num_queries", "query", "num"),
        *("max_step", "horizon", "stop_on_collision", "contact_cost"),
    ),
    "observation": (
        *("encoder", "num_points", "velocities", "geometry_source", "link_distances"),
        *("observe_every", "sensor_noise"),
    ),
    "safety_filter": ("safety_margin", "escape", "approach", "lookahead", "obstacle_velocities"),
    "data": (
        *("demo_prob", "demos", "num_demos", "bc_weight"),
        *("paths", "observations", "validation_share"),
    ),
    OTHERS: (),
    "evaluation": (
        *("eval_every", "eval_queries", "test_queries", "stop_at_success", "eval_scenes"),
        *("capture_video", "measure_clearance", "action_delay", "real_time"),
    ),
    "run": (
        *("seed", "runs_dir", "resume", "device", "bf16", "track", "workers"),
        *("ray_address",),
    ),
    "output": ("output", "overwrite", "repair", "shard_size", "json", "image"),
}

# The cores that this process may use: the default of --workers.
CORES = min(len(os.sched_getaffinity(0)), 256)


class Range(typing.NamedTuple):
    """From `least` to `most`, both included; `words` say that in messages."""

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


def parse(
    Args: type[T],
    arguments: Sequence[str] | None = None,
    default: T | None = None,
    others: str = OTHERS,
) -> T:
    """The flags of the command line as an instance of a dataclass.

    `--help` shows the docstring of the dataclass's module, and the flags in their `GROUPS`, each
    with the docstring under it.

    Args:
        Args: the dataclass, all fields with types that tyro parses.
        arguments: the command line's words; None for those of the process.
        default: an instance with other defaults.
        others: the group of the flags that are not in `GROUPS`.

    Raises:
        SystemExit: after `--help`, or for flags that cannot be parsed.
    """
    kinds = typing.get_type_hints(Args, include_extras=True)
    docs = {}
    for parent in reversed(Args.__mro__):
        with contextlib.suppress(OSError, TypeError):  # no source: `object`, interactive sessions
            documented = docstring_parser.parse_from_object(parent).params
            docs.update({field.arg_name: field.description for field in documented})
    group_of = {name: group for group, names in GROUPS.items() for name in names}
    groups = {others if group == OTHERS else group: [] for group in GROUPS}
    for field in dataclasses.fields(Args):  # pyright: ignore[reportArgumentType]
        help_text = " ".join(docs.get(field.name, "").split())
        kind = Annotated[kinds[field.name], arg(help=help_text)]
        if default is not None:
            value = dataclasses.field(default=getattr(default, field.name))
        else:
            value = dataclasses.field(default=field.default, default_factory=field.default_factory)
        groups[group_of.get(field.name, others)].append((field.name, kind, value))
    # tyro shows a nested dataclass as a group.
    nested = []
    for group, fields in groups.items():
        if fields:
            made = dataclasses.make_dataclass(
                group, fields, namespace={"__doc__": ""}, kw_only=True
            )
            nested.append((group, tyro.conf.OmitArgPrefixes[made]))
    AllFlags = dataclasses.make_dataclass("AllFlags", nested)

    arguments = sys.argv[1:] if arguments is None else arguments
    if "-h" in arguments or "--help" in arguments:  # tyro's own description has ragged lines
        print(_wrapped(sys.modules[Args.__module__].__doc__ or ""), end="\n\n")
    parsed = tyro.cli(AllFlags, prog=program(), args=arguments, description="")
    values = {}
    for group, _ in nested:
        values.update(vars(getattr(parsed, group)))
    return Args(**values)


def _wrapped(text: str) -> str:
    """A docstring whose paragraphs fit the terminal; indented lines and lists stay as they are."""
    width = min(100, shutil.get_terminal_size().columns)
    paragraphs = text.strip().split("\n\n")
    return "\n\n".join(
        paragraph if paragraph.startswith((" ", "- ")) else textwrap.fill(paragraph, width)
        for paragraph in paragraphs
    )


def check(args: object) -> None:
    """Raise ValueError, in one line, unless every flag is within its range, and a path can exist.

    Args:
        args: an instance of a dataclass. None, or a word, where a flag may be that, is in range.
    """
    kinds = typing.get_type_hints(type(args), include_extras=True)
    for name, value in vars(args).items():
        flag = f"--{name.replace('_', '-')}"
        limits = _range_of(kinds[name])
        for number in value if isinstance(value, tuple) else [value]:
            if isinstance(number, Path):
                try:
                    number.exists()
                except OSError as error:  # a name that is too long
                    raise ValueError(f"{flag}: {error.strerror}: {number}") from error
            elif limits is None or number is None or isinstance(number, str):
                continue
            elif not limits.least <= number <= limits.most:  # true of NaN, too
                raise ValueError(f"{flag} must be {limits.words}, got {number!r}")


def _range_of(kind) -> Range | None:
    """The `Range` in a type, also inside a union or tuple; None without one."""
    for part in (*getattr(kind, "__metadata__", ()), *typing.get_args(kind)):
        limits = part if isinstance(part, Range) else _range_of(part)
        if limits is not None:
            return limits
    return None
