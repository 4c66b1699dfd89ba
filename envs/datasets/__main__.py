"""Queries and demonstrations of the tasks: all that reads and writes their files, and the command.

    python -m roboarm_nmp.envs.datasets validate envs/data/wall.h5 --simulate
    python -m roboarm_nmp.envs.datasets describe wall boxes

Import from here. What is where: `envs.datasets.queries`, `envs.datasets.demonstrations`, `envs.subgoals`, and the
files' format in `envs.datasets.format`.
"""

import argparse
import sys

from roboarm_nmp.envs.datasets.demonstrations import (
    describe,
    load_demos,
)
from roboarm_nmp.envs.datasets.format import (
    locate,
)
from roboarm_nmp.envs.datasets.queries import (
    query_path,
    validate,
)
from roboarm_nmp.envs.tasks import TASKS


def _main(arguments=None):
    parser = argparse.ArgumentParser(
        prog="python -m roboarm_nmp.envs.datasets",
        description="The files of the tasks: queries and demonstrations.",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser(
        "validate",
        help="check query files",
        description="Check query files. One line on stdout for each good one, one on stderr for "
        "each bad one, saying what is wrong; exits with 1 if any is bad. (For demonstrations: "
        "python -m roboarm_nmp.demo_generation.verify.)",
    )
    command.add_argument(
        "files", nargs="+", metavar="FILE", help="path of a file, or a task's name (its own file)"
    )
    command.add_argument("--task", choices=list(TASKS), help="the task the files must be for")
    command.add_argument(
        "--simulate",
        action="store_true",
        help="also check in the simulator that every start and goal is feasible (about 140 queries "
        "a second)",
    )
    command = commands.add_parser(
        "describe",
        help="statistics of demonstration files",
        description="Print statistics of demonstration files, one column per file.",
    )
    command.add_argument(
        "files", nargs="+", metavar="FILE", help="path of a file, or a task's name (its own file)"
    )
    options = parser.parse_args(arguments)
    run = {"validate": _main_validate, "describe": _main_describe}[options.command]
    return run(options)


def _main_validate(options):
    bad = False
    for file in options.files:
        try:
            path, task = locate(file, query_path)
            queries = validate(path, options.task or task, options.simulate, progress=True)
        except ValueError as error:
            print(f"error: {error}", file=sys.stderr)
            bad = True
        else:
            test, validation = queries["test"], queries["validation"]
            counts = f"{len(test)} test and {len(validation)} validation queries"
            print(f"{path}: good, {counts} for {test.task}, seed {test.seed}")
    return int(bad)


def _main_describe(options):
    try:
        columns = [describe(load_demos(file)) for file in options.files]
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(" | ".join(["", *options.files]))
    for name in columns[0]:
        values = [column.get(name, 0) for column in columns]
        print(" | ".join([name, *(f"{v:.4g}" if isinstance(v, float) else str(v) for v in values)]))
    return 0


if __name__ == "__main__":
    sys.exit(_main())
