"""The benchmark: enter a method, verify an entry, render the table.

    roboarm benchmark run --policy go-to-goal --quick --output entry
    roboarm benchmark run --function my_planner:plan --observes point_cloud --output entry
    roboarm benchmark run --program "./my_planner" --observes ground_truth --output entry
    roboarm benchmark verify entry
    roboarm benchmark table benchmarks/leaderboard

docs/benchmark/enter.md explains the rules, the files and what a method is given.
"""

import argparse
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from roboarm_nmp.envs import TASKS
from roboarm_nmp.evaluation.entrants import FunctionMethod, ProgramMethod
from roboarm_nmp.evaluation.evaluate import EvaluationError
from roboarm_nmp.evaluation.leaderboard import leaderboard
from roboarm_nmp.evaluation.submissions import (
    PROBLEM_SETS,
    TRACKS,
    SubmissionError,
    verify_submission,
    write_submission,
)
from roboarm_nmp.policies.baselines import CHECKING, PLANNERS, REPLANNING
from roboarm_nmp.policies.policy import Method
from roboarm_nmp.utils.files import write_atomically
from roboarm_nmp.utils.flags import CORES
from roboarm_nmp.utils.names import suggest
from roboarm_nmp.utils.signals import end_with_one_line, error_line

ALL_TASKS = [task for tasks in TRACKS.values() for task in tasks if tasks != PROBLEM_SETS]
QUICK = 50  # queries of each task


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. Returns the exit code: 0, or 1 if something is wrong."""
    options = _parser().parse_args(arguments)
    try:
        return {"run": _run, "verify": _verify, "table": _table}[options.command](options)
    except (ValueError, OSError, RuntimeError) as error:
        print(error_line(error), file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="roboarm benchmark",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    problems = {
        "type": Path,
        "metavar": "FOLDER",
        "help": "MotionBenchMaker's sets: a file SET.h5 of `roboarm import` for each",
    }
    workers = {"type": int, "default": CORES, "metavar": "N", "help": "processes"}

    run = commands.add_parser("run", help="run a method on the benchmark and write its submission")
    method = run.add_mutually_exclusive_group(required=True)
    method.add_argument("--policy", help="a policy's name, a run's folder or a policy.onnx")
    method.add_argument("--function", metavar="MODULE:FUNCTION", help="a Python function")
    method.add_argument("--program", metavar="COMMAND", help="a program that speaks JSON lines")
    run.add_argument("--output", type=Path, required=True, help="folder of the submission")
    run.add_argument(
        "--tasks",
        nargs="+",
        default=ALL_TASKS,
        metavar="TASK",
        help="by default all tracks but MotionBenchMaker's",
    )
    run.add_argument("--problems", **problems)
    run.add_argument("--num-queries", type=int, default=1000, help="queries of each task")
    run.add_argument("--quick", action="store_true", help=f"{QUICK} queries of each task")
    run.add_argument(
        "--split", choices=("test", "validation"), default="test",
        help="`validation` to choose something by; entries are of test queries",
    )  # fmt: skip
    run.add_argument("--workers", **workers)
    run.add_argument("--seed", type=int, default=0, help="of the method's random numbers")
    run.add_argument(
        "--observes",
        choices=("nothing", "point_cloud", "ground_truth"),
        help="what --function or --program is given of the scene, or the geometry source of a "
        "policy; by default nothing, or the policy's own",
    )
    run.add_argument("--searches", action="store_true", help="the method searches for paths")
    run.add_argument(
        "--safety-margin", type=float, metavar="M",
        help="put a safety filter with this margin (m) around the policy, e.g. 0.01; 0 for none",
    )  # fmt: skip
    run.add_argument(
        "--search", action="store_true", help="of a policy that draws paths: else search for one"
    )
    run.add_argument(
        "--pose-goals", action="store_true",
        help="goals are poses of the end effector, reached at 1 cm and 15 degrees",
    )  # fmt: skip
    about = run.add_argument_group("about the method, for the table")
    about.add_argument("--name", help="by default that of the policy, function or program")
    about.add_argument("--authors", default="", help="names")
    about.add_argument("--link", default="", help="paper or repository")
    about.add_argument("--training-data", default="none", help="what it has learned from")
    about.add_argument("--training-seeds", type=int, default=1, help="trainings behind this row")
    about.add_argument(
        "--developed-on", nargs="*", default=[], metavar="TASK",
        help="tasks whose scenes its makers looked at or tuned on",
    )  # fmt: skip
    about.add_argument("--hardware", default="", help="by default this machine's processor")
    about.add_argument("--licence", default="", help="of the method's code")

    verify = commands.add_parser(
        "verify", help="replay all episodes of submissions and compare with what they claim"
    )
    verify.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    verify.add_argument("--problems", **problems)
    verify.add_argument("--workers", **workers)
    verify.add_argument(
        "--row", type=Path, metavar="FILE", help="write the verified row of the table here (.yaml)"
    )

    table = commands.add_parser("table", help="print the table of verified rows as Markdown")
    table.add_argument("folder", type=Path, help="of rows that `verify --row` has written")
    return parser


def _run(options: argparse.Namespace) -> int:
    for task in options.tasks:
        known = (*TASKS, *PROBLEM_SETS)
        if task not in known:
            raise SubmissionError(f"no such task: {task}: {suggest(task, known)}")
        if task not in (*ALL_TASKS, *PROBLEM_SETS):
            print(f"{task}: not in the benchmark, so in no table", file=sys.stderr)
    policy, arguments, observes, searches, privileged = _method(options)
    description = {
        "method": options.name or str(policy),
        "command": _command(options),
        "split": options.split,
        "authors": options.authors,
        "link": options.link,
        "observes": observes,
        "searches": searches,
        "privileged": privileged,
        "training_data": options.training_data,
        "developed_on": options.developed_on,
        "hardware": options.hardware or _processor(),
        "licence": options.licence,
        "training_seeds": options.training_seeds,
    }
    document = write_submission(
        options.output,
        policy,
        description,
        options.tasks,
        QUICK if options.quick else options.num_queries,
        progress=True,
        problems=options.problems,
        workers=options.workers,
        seed=options.seed,
        **arguments,
    )
    for task, numbers in document["tasks"].items():
        rates = (numbers["success_rate"], numbers["collision_free_success_rate"])
        print(f"{task:<24} success {rates[0]:.3f}, collision-free {rates[1]:.3f}")
    print(f"{options.output}: verify it with `roboarm benchmark verify {options.output}`")
    return 0


def _command(options: argparse.Namespace) -> str:
    """The flags that decide what the method does."""
    flags = []
    for name in (
        *("policy", "function", "program", "observes", "safety_margin", "search", "pose_goals"),
        "seed",
    ):
        value = getattr(options, name)
        if value is not None and value is not False:
            flags.append(f"--{name.replace('_', '-')}")
            flags += [] if value is True else [str(value)]
    return shlex.join(flags)


def _method(options) -> tuple[str | Method, dict[str, Any], str, bool, bool]:
    """The policy, arguments of `evaluate`, what it observes, whether it searches, privileged."""
    from roboarm_nmp.evaluation.evaluate import is_privileged
    from roboarm_nmp.policies.registry import find_policy, own_safety_filter
    from roboarm_nmp.policies.safety_filter import SafetyFilter

    if options.policy is None:
        if options.safety_margin is not None or options.search or options.pose_goals:
            raise EvaluationError("--safety-margin, --search and --pose-goals are for policies")
        observes = options.observes or "nothing"
        if options.function:
            method = FunctionMethod(options.function, observes)
        else:
            method = ProgramMethod(options.program, observes)
        words = observes.replace("_", " ")
        return method, {}, words, options.searches, observes == "ground_truth"
    try:
        policy, trained = find_policy(options.policy)
    except ValueError as error:
        raise EvaluationError(f"--policy: {error}") from error
    arguments: dict[str, Any] = {}
    if options.observes:
        arguments["geometry_source"] = options.observes
    if options.safety_margin is not None:
        margin = options.safety_margin
        arguments["safety_filter"] = SafetyFilter(margin) if margin else False
    if options.pose_goals:
        arguments["goal_type"] = "pose"
    if options.search:
        arguments["search"] = True
    has_filter = arguments.get("safety_filter", own_safety_filter(policy))
    source = options.observes or trained.get("geometry_source")
    if source is None and (policy in CHECKING or has_filter):
        source = "ground_truth"
    encoder = trained.get("encoder")
    if source == "ground_truth" or is_privileged(trained):
        observes = "ground truth"
    elif "point_cloud" in (source, encoder):
        observes = "point cloud"
    else:
        observes = "latent code" if encoder else "nothing"
    searches = options.searches or options.search or policy in PLANNERS or policy == REPLANNING
    return options.policy, arguments, observes, searches, observes == "ground truth"


def _processor() -> str:
    """The processor's name, and how many of its cores this process may use."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{name}, {len(os.sched_getaffinity(0))} cores"


def _verify(options: argparse.Namespace) -> int:
    code = 0
    if options.row is not None and (len(options.folders) > 1 or not options.row.parent.is_dir()):
        raise SubmissionError("--row: a file in a folder that exists, for one submission")
    for folder in options.folders:
        try:
            row = verify_submission(
                folder, options.workers, progress=True, problems=options.problems
            )
        except SubmissionError as error:
            print(error_line(error), file=sys.stderr)
            code = 1
            continue
        count = sum(numbers["num_queries"] for numbers in row["tasks"].values())
        print(f"{folder}: {row['method']}: {count:,} episodes replayed, all as claimed")
        if options.row is not None:
            text = yaml.safe_dump(row, sort_keys=False, allow_unicode=True)
            write_atomically(options.row, text.encode())
    return code


def _table(options: argparse.Namespace) -> int:
    print(leaderboard(options.folder))
    return 0


if __name__ == "__main__":
    end_with_one_line("tasks that are finished are kept; repeat the command to continue")
    sys.exit(main())
