"""Write docs/reference/command_line.md: the flags of every subcommand of `roboarm`.

    python docs/make_command_line.py

Names, defaults and meanings come from the dataclasses of flags in the scripts. A test fails when
the page is out of date.
"""

import ast
import dataclasses
import importlib
import inspect
import re
import textwrap
import typing
from pathlib import Path

import tyro

from roboarm_nmp.__main__ import COMMANDS, TRAINERS

PAGE = Path(__file__).parent / "reference" / "command_line.md"
INTRODUCTION = """\
# Command line

`roboarm COMMAND [flags]` runs a script of the project. `python -m roboarm_nmp COMMAND` does the
same. `roboarm COMMAND --help` prints the flags with their ranges; this page lists names, defaults
and meanings.

- An empty default means that the flag is required, or that the meaning names the default.
- A flag with the default `no` is switched on by its name; `--no-NAME` switches a flag with the
  default `yes` off.
- `--task` takes a name from [tasks](../guide/tasks.md) or the path of a
  [scene file](../customise/scene.md).
- A flag out of its range, an unknown name or a missing file ends a command with one line and exit
  code 1 or 2. Ctrl-C ends a command with exit code 130, SIGTERM with 143.

| command | purpose |
|---|---|
"""
BY_HAND = {
    "policies": """\
`roboarm policies` lists the pretrained policies and encoders. `roboarm policies NAME` shows the
card of one policy. [Pretrained](pretrained.md) has all cards.

| flag | default | meaning |
|---|---|---|
| `--json` | `no` | print JSON, with all flags of training |
""",
    "data": """\
`roboarm data validate FILE ...` checks query files. Exit code 1 reports a bad file.
`roboarm data describe FILE ...` prints statistics of demonstration files. A `FILE` is a path, or
the name of a task.

| flag of `validate` | default | meaning |
|---|---|---|
| `--task` |  | the task that the files must be for |
| `--simulate` | `no` | also check in the simulator that every start and goal is feasible |
""",
    "benchmark": """\
`roboarm benchmark run` runs a method and writes its entry, `roboarm benchmark verify FOLDER ...`
replays all of it, and `roboarm benchmark table FOLDER` prints the table of verified rows. The page
[Enter the benchmark](../benchmark/enter.md) explains them.

| flag of `run` | default | meaning |
|---|---|---|
| `--policy`, `--function` or `--program` |  | the method |
| `--output` |  | folder of the entry |
| `--tasks` | all of the tracks but MotionBenchMaker's | tasks to run |
| `--problems` |  | folder of MotionBenchMaker's sets, a file SET.h5 each |
| `--num-queries` | `1000` | queries of each task |
| `--quick` | `no` | 50 queries of each task |
| `--split` | `test` | `validation` to choose something by; entries are of test queries |
| `--workers` | cores | processes |
| `--seed` | `0` | of the method's random numbers |
| `--observes` | `nothing`, or the policy's own | what the method is given of the scene |
| `--searches` | `no` | the method searches for paths |
| `--safety-margin` |  | m, of a safety filter around the policy; 0 for none |
| `--search` | `no` | a policy that draws paths searches where it can verify none |
| `--pose-goals` | `no` | goals are poses, reached at 1 cm and 15 degrees |
| `--name`, `--authors`, `--link`, `--licence` |  | what the table says about the method |
| `--training-data`, `--training-seeds`, `--hardware` |  | likewise |
| `--developed-on` |  | tasks whose scenes its makers looked at or tuned on |

| flag of `verify` | default | meaning |
|---|---|---|
| `--problems` |  | as of `run` |
| `--workers` | cores | processes |
| `--row` |  | write the verified row of the table to this file |
""",
}  # commands whose flags are not in a dataclass
SHARED = {
    "RunArgs": "Flags of the run",
    "EnvArgs": "Flags of the environment",
    "EncoderFlags": "Flags of the encoders",
    "CloudFlags": "Flags of the point cloud",
}  # base classes of the flags that several trainers have: class -> heading


def flags_of(module):
    """The dataclass of a script's flags, `Args` or `...Args`; None if it has none of its own."""
    own = {
        name: value
        for name, value in vars(module).items()
        if name.endswith("Args") and value.__module__ == module.__name__
    }
    return own.get("Args") or next(iter(own.values()), None)


def meanings(cls):
    """The string below each field that the class itself defines: dict of name -> text."""
    body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body
    found = {}
    for field, below in zip(body, [*body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign):
            is_text = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            text = " ".join(below.value.value.split()) if is_text else ""
            text = text.replace(" (see above)", "").removesuffix(".").replace("|", ",")
            found[field.target.id] = re.sub(r"docs/(\S+\.md)", r"[\1](../\1)", text)
    return found


def choices(kind):
    """The values of a `Literal` in a type."""
    if typing.get_origin(kind) is typing.Literal:
        return typing.get_args(kind)
    return tuple(value for one in typing.get_args(kind) for value in choices(one))


def words(value):
    """A default as it is typed on the command line."""
    if value in (None, (), dataclasses.MISSING):
        return ""
    if isinstance(value, bool):
        return "`yes`" if value else "`no`"
    values = value if isinstance(value, tuple) else (value,)
    return "`" + " ".join(str(one) for one in values) + "`"


def table(cls):
    """The flags that a class of flags defines itself, as lines of Markdown."""
    kinds = typing.get_type_hints(cls, include_extras=True)
    fields = {field.name: field for field in dataclasses.fields(cls)}
    lines = ["| flag | default | meaning |", "|---|---|---|"]
    for name, meaning in meanings(cls).items():
        flag = f"`--{name.replace('_', '-')}`"
        if tyro.conf.Positional in getattr(kinds[name], "__metadata__", ()):
            flag = f"`{name.upper()}`"
        options = [f"`{value}`" for value in choices(kinds[name])]
        if any(option not in meaning for option in options):
            meaning = f"{', '.join(options)}: {meaning}"
        default = words(fields[name].default)
        if re.search("(?i)by default.* cores", meaning):  # another number on another machine
            default = ""
        lines.append(f"| {flag} | {default} | {meaning} |")
    return lines


def page():
    """The text of the page."""
    lines = [INTRODUCTION.rstrip()]
    trainers = {f"train {name}": entry for name, entry in TRAINERS.items()}
    commands = trainers | {name: entry for name, entry in COMMANDS.items() if entry[0]}
    for name, (_, summary) in commands.items():
        lines.append(f"| [`{name}`](#roboarm-{name.replace(' ', '-')}) | {summary} |")
    shared = {}  # class of flags -> its table, and the trainers that have it
    sections = []
    for name, (path, summary) in commands.items():
        Args = flags_of(importlib.import_module(f"roboarm_nmp.{path}"))
        sections += ["", f"## roboarm {name}", "", f"{summary[:1].upper()}{summary[1:]}."]
        if Args is None:
            sections += ["", BY_HAND[name].rstrip()]
            continue
        bases = [one for one in Args.__mro__[1:] if dataclasses.is_dataclass(one)]
        for one in bases:  # each trainer's file has its own copy of a class
            rows, users = shared.setdefault(one.__name__, (table(one), []))
            assert rows == table(one), f"the trainers' {one.__name__} differ"
            users.append(name)
        if bases:
            links = []
            for one in bases:
                heading = SHARED[one.__name__].lower()
                links.append(f"[{heading}](#{heading.replace(' ', '-')})")
            sections += ["", f"Also the {' and the '.join(links)}."]
        sections += ["", *table(Args)]
    for name, (rows, users) in shared.items():
        sections += ["", f"## {SHARED[name]}", ""]
        sections += [f"Of `{'`, `'.join(users)}`.", "", *rows]
    return "\n".join([*lines, *sections, ""])


if __name__ == "__main__":
    PAGE.write_text(page())
