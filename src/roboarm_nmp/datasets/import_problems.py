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
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from roboarm_nmp.datasets.problems import Rejected, load_problems, write_problems
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.world import World
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_writable
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.signals import end_with_one_line, error_line

LISTED = 20  # rejected problems that are listed, at most


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


def usable(problem, world):
    """A `Problem` with those of its goals that are inside the limits and free, or a `Rejected`.

    `world` is a `World` of the same arm; its scene is changed.
    """
    world.set_scene(problem.scene)
    if reason := _fault(problem.start, world):
        return Rejected(problem.name, f"start {reason}")
    reasons = [_fault(goal, world) for goal in problem.goals]
    goals = problem.goals[[reason is None for reason in reasons]]
    if len(goals) or problem.goal_pose is not None:
        return problem._replace(goals=goals)
    return Rejected(problem.name, f"goal {reasons[0]}")


def _fault(configuration, world):
    """Why an episode cannot begin or end there, in words; None if it can."""
    robot, angles = world.robot, configuration.astype(np.float32)
    beyond = np.maximum(robot.lower - configuration, configuration - robot.upper)
    if (np.abs(robot.normalise(angles)) > 1.0 + 1e-6).any():  # as of `RoboArmEnv.reset_specific`
        joint = int(np.argmax(beyond))
        return f"outside the limits by {beyond[joint]:.3f} rad: joint {joint + 1}"
    if world.in_collision(angles.tolist()):
        return f"in collision: {world.contact_names()}"
    return None


def import_problems(paths, robot=PANDA, progress=False):
    """The usable problems of files and folders.

    Args:
        paths: of files and folders.
        robot: the `Robot` of the problems.
        progress: show a progress bar.

    Returns:
        list of `Problem`s, and list of `Rejected`.

    Raises:
        ValueError: a file cannot be used; the message names it.
    """
    sets = [load_problems(path, robot) for path in paths]
    found = [problem for problems in sets for problem in problems.all]
    kept, rejected = [], [one for problems in sets for one in problems.rejected]
    if not found:
        return kept, rejected
    world = World(found[0].scene, drawn=False)
    with contextlib.closing(world), progress_bar(found, "import", disable=not progress) as bar:
        for problem in bar:
            result = usable(problem, world)
            (rejected if isinstance(result, Rejected) else kept).append(result)
    return kept, rejected


def summary(kept, rejected):
    """How many problems were imported, and why others were not, in lines of text."""
    lines = [f"imported {len(kept)} of {len(kept) + len(rejected)} problems"]
    sets = Counter(problem.name.rpartition("/")[0] for problem in kept)
    lines += [f"  {name:<40}{count:>6}" for name, count in sets.items()]
    openings = Counter(str(problem.scene.robot.held) for problem in kept)
    if openings != {"{}": len(kept)}:
        lines += [f"  held joints {held}: {count}" for held, count in openings.items()]
    poses = sum(not len(problem.goals) for problem in kept)
    if poses:
        lines.append(f"  {poses} with a goal pose only")
    attached = sum(bool(problem.scene.robot.attached) for problem in kept)
    if attached:
        lines.append(f"  {attached} with attached objects")
    touching = sum(any(one.may_touch for one in problem.scene.obstacles) for problem in kept)
    if touching:
        lines.append(f"  {touching} with obstacles that links may touch")
    kinds = Counter(re.sub(r"[\d.]+ rad", "... rad", _kind(one.reason)) for one in rejected)
    lines += [f"not imported: {count}: {kind}" for kind, count in kinds.most_common(LISTED)]
    lines += [f"  {one.name}: {one.reason}" for one in rejected[:LISTED]]
    if len(rejected) > LISTED:
        lines.append(f"  ... and {len(rejected) - LISTED} more")
    return "\n".join(lines)


def _kind(reason):
    """A reason without what is of one problem only: file, line, links and joints."""
    reason = re.sub(r"^\S*?:(\d+:)? ", "", reason)
    return reason.split(":")[0]


def main(args):
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
        command += ["--robot", str(args.robot)] if args.robot else []
        write_problems(args.output, kept, shlex.join(command))
    except (ValueError, OSError) as error:
        sys.exit(error_line(error))
    print(f"{args.output}: written")


if __name__ == "__main__":
    end_with_one_line("nothing was written")
    main(flags.parse(Args, others="problems"))
