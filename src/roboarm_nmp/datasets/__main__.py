"""The command `roboarm data`: validates files of queries, describes files of demonstrations.

roboarm data validate src/roboarm_nmp/datasets/data/wall.h5 --simulate
roboarm data describe wall boxes
roboarm data describe no_obstacles@ur5.yaml
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from roboarm_nmp.datasets.demonstrations import demo_path, describe, load_demos
from roboarm_nmp.datasets.format import locate
from roboarm_nmp.datasets.queries import query_path, validate
from roboarm_nmp.envs.tasks import get_task
from roboarm_nmp.utils.signals import end_with_one_line, error_line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. Returns the exit code: 0, or 1 if a file is bad."""
    options = _parser().parse_args(arguments)
    try:
        if options.task is not None:
            get_task(options.task)
    except ValueError as error:
        print(error_line(f"--task: {error}"), file=sys.stderr)
        return 1
    if options.command == "validate":
        return _validate(options)
    return _describe(options)


def _parser():
    files = argparse.ArgumentParser(add_help=False)
    files.add_argument("files", nargs="+", metavar="FILE", help="path of a file, or task")
    files.add_argument(
        "--task",
        help="the task the files must be for; files of arms other than the Panda need it, as "
        "TASK@FILE with a robot's file (.urdf, .yaml; docs/customise/robot.md)",
    )
    parser = argparse.ArgumentParser(
        prog="roboarm data",
        description="Files of the tasks: queries and demonstrations.",
        epilog="examples: roboarm data validate wall --simulate; roboarm data describe wall boxes",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser(
        "validate",
        parents=[files],
        help="check query files",
        description="Check query files. Each good file gives a line on stdout, each bad one a line "
        "on stderr that names the error. The exit code is 1 if any is bad. (For demonstrations: "
        "roboarm verify.)",
    )
    command.add_argument(
        "--simulate",
        action="store_true",
        help="also check in the simulator that every start and goal is feasible (about 140 queries "
        "a second)",
    )
    commands.add_parser(
        "describe",
        parents=[files],
        help="statistics of demonstration files",
        description="Print statistics of demonstration files, one column per file.",
    )
    return parser


def _locate(
    file: str, path_of_task: Callable[[str], Path], options: argparse.Namespace
) -> tuple[Path, str | None]:
    """(path, task it must be for) of a file, or of a task."""
    path, task = locate(file, path_of_task)
    return path, options.task or task


def _validate(options):
    exit_code = 0
    for file in options.files:
        try:
            path, task = _locate(file, query_path, options)
            queries = validate(path, task, options.simulate, progress=True)
        except ValueError as error:
            print(error_line(error), file=sys.stderr)
            exit_code = 1
            continue
        test, validation = queries["test"], queries["validation"]
        counts = f"{len(test)} test and {len(validation)} validation queries"
        print(f"{path}: good, {counts} for {test.task}, seed {test.seed}")
    return exit_code


def _describe(options):
    columns = []
    try:
        for file in options.files:
            path, task = _locate(file, demo_path, options)
            columns.append(describe(load_demos(path, task)))
    except ValueError as error:
        print(error_line(error), file=sys.stderr)
        return 1
    print(" | ".join(["", *options.files]))
    for name in columns[0]:
        values = [column.get(name, 0) for column in columns]
        cells = [f"{value:.4g}" if isinstance(value, float) else str(value) for value in values]
        print(" | ".join([name, *cells]))
    return 0


if __name__ == "__main__":
    end_with_one_line("no file has changed")
    sys.exit(main())
