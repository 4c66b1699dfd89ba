"""Import from other programs' files: motion planning problems, or recorded motions.

    roboarm import bookshelf_tall_panda box_panda --output problems.h5
    roboarm import robometrics_set.yaml --output problems.h5
    roboarm evaluate --policy planner --problems problems.h5
    roboarm import --format lerobot my_teleoperation --task wall --output teleop.h5
    roboarm train bc --task wall --demos teleop.h5

Problems: a folder has `scene####.yaml` and `request####.yaml` files of MotionBenchMaker or MoveIt.
A file is robometrics' YAML, VAMP's JSON, a query file or a `problems.h5`
(docs/customise/problems.md). A problem is imported if its start, and at least one of its goals, is
inside the joint limits and free of collisions in the simulator, with the gripper as open as the
file says. Other goals are left out. Nothing is moved into the limits: that would be another
problem. A goal that is a pose only is not checked.

Motions (`--format lerobot`): the episodes of LeRobot datasets become demonstrations of a task whose
scene is fixed. The simulated arm follows each of them, and what reaches its goal without contact is
imported (docs/customise/motions.md).
"""

import contextlib
import re
import shlex
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from roboarm_nmp.datasets.lerobot import load_joint_names, read_lerobot
from roboarm_nmp.datasets.problems import Problem, Rejected, load_problems, write_problems
from roboarm_nmp.datasets.recordings import write_demonstrations
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.tasks import get_task, task_name
from roboarm_nmp.envs.world import World
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_writable
from roboarm_nmp.utils.flags import CORES, Workers
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.signals import end_with_one_line, error_line

MAX_LISTED = 20  # rejected problems, and reasons


@dataclass
class Args:
    files: tyro.conf.Positional[tuple[Path, ...]]
    """Files and folders of problems, or folders of LeRobot datasets."""
    format: Literal["problems", "lerobot"] = "problems"
    """What they are; formats of problems are told apart by themselves."""
    output: Path | None = None
    """File to write. The default is `problems.h5`, or `<task>_recorded.h5`."""
    robot: Path | None = None
    """The arm of problems, if not the Panda: a robot's file (.urdf, .yaml;
    docs/customise/robot.md). For motions, name it by --task TASK@FILE."""
    task: str | None = None
    """Motions: the task, or scene file, that they are demonstrations of; required."""
    joints: Path | None = None
    """Motions: a YAML file with the names of the dataset's joints, where they are others."""
    allow_collisions: bool = False
    """Motions: also import those with contact in the simulator."""
    workers: Workers = CORES
    """Motions: number of processes, by default that of the cores."""
    overwrite: bool = False
    """Replace a file that exists."""


def usable(problem: Problem, world: World) -> Problem | Rejected:
    """A problem with those of its goals that are inside the limits and free, or why there is none.

    `world` is a `World` of the same arm; its scene is changed.
    """
    world.set_scene(problem.scene)
    reason = _obstruction(problem.start, world)
    if reason is not None:
        return Rejected(problem.name, f"start {reason}")
    reasons = [_obstruction(goal, world) for goal in problem.goals]
    goals = problem.goals[[reason is None for reason in reasons]]
    if len(goals) or problem.goal_pose is not None:
        return problem._replace(goals=goals)
    return Rejected(problem.name, f"goal {reasons[0]}")


def _obstruction(configuration, world):
    """Why an episode cannot begin or end there, in words; None if it can."""
    robot = world.robot
    angles = configuration.astype(np.float32)
    if (np.abs(robot.normalise(angles)) > 1.0 + 1e-6).any():  # as of `RoboArmEnv.reset_specific`
        beyond = np.maximum(robot.lower - configuration, configuration - robot.upper)
        joint = int(np.argmax(beyond))
        return f"outside the limits by {beyond[joint]:.3f} rad: joint {joint + 1}"
    if world.in_collision(angles.tolist()):
        return f"in collision: {world.contact_names()}"
    return None


def import_problems(
    paths: Iterable[str | Path], robot: Robot = PANDA, progress: bool = False
) -> tuple[list[Problem], list[Rejected]]:
    """The usable problems of files and folders, and those that cannot be used.

    Args:
        paths: of files and folders.
        robot: the `Robot` of the problems.
        progress: show a progress bar.

    Raises:
        ValueError: a file cannot be used; the message names it.
    """
    candidates = []
    kept = []
    rejected = []
    for path in paths:
        problems = load_problems(path, robot)
        candidates += problems.all
        rejected += problems.rejected
    if not candidates:
        return kept, rejected
    world = World(candidates[0].scene, drawn=False)
    with contextlib.closing(world), progress_bar(candidates, "import", disable=not progress) as bar:
        for candidate in bar:
            problem = usable(candidate, world)
            if isinstance(problem, Rejected):
                rejected.append(problem)
            else:
                kept.append(problem)
    return kept, rejected


def summary(kept: Sequence[Problem], rejected: Sequence[Rejected]) -> str:
    """How many problems were imported, and why others were not, in lines of text."""
    lines = [f"imported {len(kept)} of {len(kept) + len(rejected)} problems"]
    sets = Counter(problem.name.rpartition("/")[0] for problem in kept)
    for name, count in sets.items():
        lines.append(f"  {name:<40}{count:>6}")
    openings = Counter(str(problem.scene.robot.held) for problem in kept)
    for held, count in openings.items():
        if held != "{}":
            lines.append(f"  held joints {held}: {count}")
    notes = {
        "with a goal pose only": [not len(problem.goals) for problem in kept],
        "with attached objects": [bool(problem.scene.robot.attached) for problem in kept],
        "with obstacles that links may touch": [
            any(obstacle.may_touch for obstacle in problem.scene.obstacles) for problem in kept
        ],
    }
    for note, holds in notes.items():
        if any(holds):
            lines.append(f"  {sum(holds)} {note}")
    return "\n".join(lines + _reasons(rejected))


def _reasons(rejected):
    """Why problems or motions are not imported, in lines of text."""
    lines = []
    kinds = Counter(_kind(one.reason) for one in rejected)
    for kind, count in kinds.most_common(MAX_LISTED):
        lines.append(f"not imported: {count}: {kind}")
    for name, reason in rejected[:MAX_LISTED]:
        lines.append(f"  {name}: {reason}")
    if len(rejected) > MAX_LISTED:
        lines.append(f"  ... and {len(rejected) - MAX_LISTED} more")
    return lines


def _kind(reason):
    """A reason without what is of one problem only: file, line, links, joints and numbers."""
    reason = re.sub(r"^\S*?:(\d+:)? ", "", reason).split(":")[0]
    return re.sub(r"(?<![\w.])\d[\d.]*", "...", reason)


def _import_problems(args: Args, output: Path) -> None:
    robot = PANDA if args.robot is None else load_robot(args.robot)
    kept, rejected = import_problems(args.files, robot, progress=True)
    print(summary(kept, rejected))
    if not kept:
        raise ValueError("no problem can be used: nothing was written")
    command = ["roboarm", "import", *map(str, args.files), "--output", str(output)]
    if args.robot is not None:
        command += ["--robot", str(args.robot)]
    write_problems(output, kept, shlex.join(command))


def _import_motions(args: Args, output: Path) -> None:
    if args.task is None or args.robot is not None:
        raise ValueError("--format lerobot needs --task, where another arm is TASK@FILE")
    robot = get_task(args.task).base_scene.robot
    names = None if args.joints is None else load_joint_names(args.joints)
    recordings = []
    for folder in args.files:
        for one in read_lerobot(folder, robot, names):
            recordings.append(replace(one, name=f"{folder.name}/{one.name}"))
    command = ["roboarm", "import", "--format", "lerobot", *map(str, args.files)]
    command += ["--task", args.task, "--output", str(output)]
    if args.joints is not None:
        command += ["--joints", str(args.joints)]
    rejected = write_demonstrations(
        output,
        recordings,
        args.task,
        allow_collisions=args.allow_collisions,
        made_by=shlex.join(command),
        num_workers=args.workers,
        progress=True,
    )
    kept = len(recordings) - len(rejected)
    print("\n".join([f"imported {kept} of {len(recordings)} motions", *_reasons(rejected)]))


def main(args: Args) -> None:
    """Run the command. Raises SystemExit: nothing can be written."""
    try:
        flags.check(args)
        if not args.files:
            raise ValueError("name one or more files or folders")
        is_problems = args.format == "problems"
        default = "problems.h5" if is_problems else f"{task_name(args.task or '')}_recorded.h5"
        output = args.output or Path(default)
        check_writable(output)
        if output.exists() and not args.overwrite:
            raise ValueError(f"{output} exists; --overwrite replaces it")
        if is_problems:
            _import_problems(args, output)
        else:
            _import_motions(args, output)
    except (ImportError, ValueError, OSError) as error:
        sys.exit(error_line(error))
    print(f"{output}: written")


if __name__ == "__main__":
    end_with_one_line("nothing was written")
    main(flags.parse(Args, others="input"))
