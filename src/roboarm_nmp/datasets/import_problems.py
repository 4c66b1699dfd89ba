"""Import problems from other programs' files into one `problems.h5`, and say which can be used.

    roboarm import bookshelf_tall_panda box_panda --output problems.h5
    roboarm import robometrics_set.yaml --output problems.h5
    roboarm evaluate --policy planner --problems problems.h5

A folder has `scene####.yaml` and `request####.yaml` files of MotionBenchMaker or MoveIt. A file is
robometrics' YAML, VAMP's JSON, a query file or a `problems.h5` (docs/customise/problems.md).

A problem is imported if its start, and at least one of its goals, is inside the joint limits and
free of collisions in the simulator, with the gripper as open as the file says. Other goals are left
out. Nothing is moved into the limits: that would be another problem. A goal that is a pose only is
not checked.
"""

import contextlib
import re
import shlex
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from roboarm_nmp.datasets.problems import Problem, Rejected, load_problems, write_problems
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.world import World
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_writable
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.signals import end_with_one_line, error_line

MAX_LISTED = 20  # rejected problems, and reasons


@dataclass
class Args:
    files: tyro.conf.Positional[tuple[Path, ...]]
    """Files and folders of problems."""
    output: Path = Path("problems.h5")
    """File to write."""
    robot: Path | None = None
    """The arm, if not the Panda: a robot's file (.urdf, .yaml; docs/customise/robot.md)."""
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
    kinds = Counter(_kind(problem.reason) for problem in rejected)
    for kind, count in kinds.most_common(MAX_LISTED):
        lines.append(f"not imported: {count}: {kind}")
    for name, reason in rejected[:MAX_LISTED]:
        lines.append(f"  {name}: {reason}")
    if len(rejected) > MAX_LISTED:
        lines.append(f"  ... and {len(rejected) - MAX_LISTED} more")
    return "\n".join(lines)


def _kind(reason):
    """A reason without what is of one problem only: file, line, links, joints and angles."""
    reason = re.sub(r"^\S*?:(\d+:)? ", "", reason)
    return re.sub(r"[\d.]+ rad", "... rad", reason.split(":")[0])


def main(args: Args) -> None:
    """Run the command. Raises SystemExit: nothing can be written."""
    try:
        flags.check(args)
        if not args.files:
            raise ValueError("name one or more files or folders")
        check_writable(args.output)
        if args.output.exists() and not args.overwrite:
            raise ValueError(f"{args.output} exists; --overwrite replaces it")
        robot = PANDA if args.robot is None else load_robot(args.robot)
        kept, rejected = import_problems(args.files, robot, progress=True)
        print(summary(kept, rejected))
        if not kept:
            raise ValueError("no problem can be used: nothing was written")
        command = ["roboarm", "import", *map(str, args.files), "--output", str(args.output)]
        if args.robot is not None:
            command += ["--robot", str(args.robot)]
        write_problems(args.output, kept, shlex.join(command))
    except (ValueError, OSError) as error:
        sys.exit(error_line(error))
    print(f"{args.output}: written")


if __name__ == "__main__":
    end_with_one_line("nothing was written")
    main(flags.parse(Args, others="problems"))
