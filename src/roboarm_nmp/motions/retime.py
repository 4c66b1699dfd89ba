"""Make an executable trajectory of a joint path: as fast as the arm's limits allow.

    roboarm retime path.csv --output motion.yaml
    roboarm retime path.csv --output motion.csv --task double_walls
    roboarm retime path.json --output motion.yaml --robot ur5.yaml --velocity-scale 0.2
    roboarm retime episode.npz --output motion.npz --task random_boxes_hard --query 3

Input and output are files of docs/guide/trajectories.md (.csv, .npz, .json, .yaml, by the ending);
.yaml is ROS's trajectory_msgs/JointTrajectory. Only the joint angles of the input are used. Corners
of the path are rounded, by at most --deviation. With --task, the trajectory is checked for
collisions, and corners whose rounding collides are rounded less. Needs the extra `trajectories`.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_writable
from roboarm_nmp.utils.flags import NonNegativeFloat, NonNegativeInt, PositiveShare
from roboarm_nmp.utils.signals import end_with_one_line, error_line


@dataclass
class Args:
    file: tyro.conf.Positional[Path]
    """the joint path"""
    output: Path
    """the file to write"""
    task: str | None = None
    """a task, or a scene file (.yaml): check collisions in its scene. Another arm is TASK@FILE"""
    robot: Path | None = None
    """without --task, another arm than the Panda: a robot's file (.urdf, .yaml;
    docs/customise/robot.md)"""
    query: NonNegativeInt = 0
    """where scenes vary: in the scene of the query with this number"""
    split: Literal["test", "validation", "original"] = "test"
    """which of the task's queries"""
    deviation: NonNegativeFloat | None = None
    """rad, L2 in joint space: how far rounded corners may leave the path, by default 0.1; 0 to stop
    at each corner"""
    limits: Literal["urdf", "datasheet"] = "urdf"
    """which position limits hold: the URDF's, or those of the manufacturer's datasheet"""
    velocity_scale: PositiveShare = 1.0
    """share of the largest velocities"""
    acceleration_scale: PositiveShare = 1.0
    """share of the largest accelerations"""
    margin: NonNegativeFloat = 0.0
    """m, that the trajectory keeps from obstacles, in --task"""
    step: NonNegativeFloat = 0.01
    """s, between two samples, in [0.001, 1]"""


def retime(args: Args) -> str:
    """Write the trajectory. Returns what was written, in words. Raises ValueError, OSError."""
    flags.check(args)
    # Here, so that --help does not wait for Numba.
    from roboarm_nmp.envs.robots.files import load_robot
    from roboarm_nmp.envs.robots.panda import PANDA
    from roboarm_nmp.motions.metrics import motion_metrics
    from roboarm_nmp.motions.time_parameterisation import (
        DEFAULT_ACCELERATION,
        DEFAULT_VELOCITY,
        DEVIATION,
        time_parameterise,
    )
    from roboarm_nmp.motions.trajectories import check_ending, load_trajectory, save_trajectory

    check_ending(args.output)
    check_writable(args.output)
    checker = None
    robot = PANDA
    if args.task is not None and args.robot is not None:
        raise ValueError(f"--robot goes without --task: name the arm by --task {args.task}@FILE")
    if args.task is not None:
        checker = _checker(args)
        robot = checker.robot
    elif args.robot is not None:
        robot = load_robot(args.robot)
    velocity = DEFAULT_VELOCITY if robot.velocity is None else robot.velocity
    acceleration = DEFAULT_ACCELERATION if robot.acceleration is None else robot.acceleration
    path = load_trajectory(args.file, robot).positions
    try:
        trajectory = time_parameterise(
            path,
            robot,
            deviation=DEVIATION if args.deviation is None else args.deviation,
            checker=checker,
            margin=args.margin,
            limits=args.limits,
            velocity=args.velocity_scale * velocity,
            acceleration=args.acceleration_scale * acceleration,
            step=args.step,
        )
    except ValueError as error:
        raise ValueError(f"{args.file}: {error}") from error
    save_trajectory(args.output, trajectory)
    metrics = motion_metrics(trajectory, checker)
    text = (
        f"{args.output}: written, {len(trajectory)} samples, {metrics['duration']:.2f} s, path "
        f"{metrics['path_length']:.2f} rad, end effector {metrics['ee_path_length']:.2f} m"
    )
    clearance = metrics["min_clearance"]
    if clearance is None:
        return f"{text}; collisions were not checked (--task)"
    return f"{text}, smallest clearance {1000 * clearance:.1f} mm"


def _checker(args):
    from roboarm_nmp import envs
    from roboarm_nmp.datasets.queries import load_queries
    from roboarm_nmp.envs.collision.checker import CollisionChecker
    from roboarm_nmp.envs.scenes.primitives import Scene

    scene = envs.get_task(args.task).scene
    if not isinstance(scene, Scene):
        queries = load_queries(args.task, args.split)
        if args.query >= len(queries):
            raise ValueError(f"--query: the numbers are 0 to {len(queries) - 1}, got {args.query}")
        scene = queries[args.query].scene
    if not scene.is_static:
        raise ValueError(
            f"--task: obstacles of {args.task} move, and collisions are checked at rest"
        )
    return CollisionChecker(scene)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command. Returns the exit code: 0; 1 without toppra; 2 where nothing can be written."""
    args = flags.parse(Args, arguments, others="trajectory")
    try:
        print(retime(args))
    except (OSError, ValueError) as error:
        print(error_line(error), file=sys.stderr)
        return 2
    except ImportError as error:
        print(error_line(error), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    end_with_one_line("nothing was written")
    sys.exit(main())
