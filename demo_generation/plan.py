"""Plan one motion among the points of a cloud, or in the scene of a task, and write it to a file.

    roboarm plan --cloud table.ply --start "1 0.4 0 -1.8 0 2.2 0.8" --goal "-1 0.4 0 -1.8 0 2.2 0.8"
    roboarm plan --cloud table.ply --start "…" --goal-pose "0.4 -0.3 0.3 1 0 0 0" --output path.csv
    roboarm plan --cloud table.ply --start "…" --goal "…" --retime --output motion.yaml
    roboarm plan --task wall --start "…" --goal "…" --policy go-to-goal

The points are prepared first (docs/customise/point_cloud.md): those of the table, the floor and the
arm, outliers, and points outside the workspace are left out, and one point per cube stays. Without
`--policy`, OMPL's RRT-Connect plans a path around a ball at each point. With it, the motion is an
episode of that policy in the simulator, which observes the same points.

Printed are what was left out, times, the length of the motion, and its minimum clearance. The exit
code is 1 if there is no motion to the goal.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import POINT_RADIUS, ObservedScene, Scene
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_writable
from roboarm_nmp.utils.flags import NonNegativeFloat, NonNegativeInt, PositiveFloat, Seed
from roboarm_nmp.utils.signals import end_with_one_line, error_line

if TYPE_CHECKING:  # imported when they are needed, so that --help does not wait for Numba
    from roboarm_nmp.envs.collision.checker import CollisionChecker
    from roboarm_nmp.evaluation.rollout import Trajectory
    from roboarm_nmp.motions.trajectories import JointTrajectory

CLOUD_FLAGS = (
    *("robot", "units", "frame", "intrinsics", "recorded_at", "arm_distance", "table"),
    *("workspace", "cell", "min_points", "allow_empty", "point_radius"),
)


@dataclass
class Args:
    start: str
    """joint angles at the start, rad, separated by spaces"""
    goal: str | None = None
    """joint angles at the goal, rad"""
    goal_pose: str | None = None
    """instead: the end effector's pose at the goal, x y z (m) and a quaternion x y z w"""
    cloud: Path | None = None
    """the point cloud: a .ply, .pcd, .npy or .npz file, or a depth image (with --intrinsics)"""
    task: str | None = None
    """instead of a cloud: a task, one of `roboarm_nmp.TASKS`, or a scene file (.yaml); with another
    arm, TASK@FILE"""
    robot: Path | None = None
    """the arm beside a cloud: a robot's file (.urdf, .yaml; docs/customise/robot.md); by default
    the Panda"""
    policy: str = "planner"
    """`planner`, another baseline, a policy network, a run's folder, or the name of a pretrained
    policy (`roboarm policies`)"""
    units: Literal["m", "cm", "mm"] | None = None
    """of the lengths in the file; by default m, and mm for a .png"""
    frame: str | None = None
    """pose of the cloud's frame, or of the camera, in the frame of the robot's base: x y z (m) and
    a quaternion x y z w; by default the same frame"""
    intrinsics: str | None = None
    """of the depth image's camera: fx fy cx cy, pixels"""
    recorded_at: str | None = None
    """joint angles of the arm when the cloud was recorded, rad, whose points are left out; by
    default the start"""
    arm_distance: NonNegativeFloat | None = None
    """m: points nearer to the arm than this are its own; by default 0.02"""
    table: bool = True
    """the standard table and floor are there, and their points are left out; otherwise all that is
    there are points"""
    workspace: str | None = None
    """lower and upper corner, x y z x y z, m: points outside are left out; by default a cube that
    the arm cannot leave"""
    cell: PositiveFloat | None = None
    """m: one point stays per cube of this size; by default 0.025, scaled with the arm's reach"""
    min_points: NonNegativeInt | None = None
    """a cube is an outlier if it and the 26 around it have fewer points; by default 3"""
    allow_empty: bool = False
    """plan even if nearly all points of the cloud are left out as not finite or out of reach"""
    point_radius: NonNegativeFloat = POINT_RADIUS
    """m, of the ball around each point"""
    seed: Seed = 0
    """of random numbers"""
    time_limit: PositiveFloat = 5.0
    """seconds that the planner may search"""
    retime: bool = False
    """times, velocities and accelerations within the arm's limits, checked for collisions where the
    path has none (extra `trajectories`); otherwise the motion has the speed of the environment"""
    output: Path | None = None
    """write the motion to this file, .csv, .npz, .json or .yaml (docs/guide/trajectories.md)"""


ALMOST_ALL = 0.99  # of a cloud's points: its units or its frame are probably others


def _numbers(flag: str, text: str, number: int) -> np.ndarray:
    """So many finite numbers in the text of a flag, float64. Raises ValueError."""
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError as error:
        raise ValueError(f"{flag}: {error}") from error
    if len(values) != number or not np.isfinite(values).all():
        raise ValueError(f"{flag} must be {number} finite numbers, got {text!r}")
    return values


def _configuration(flag: str, text: str, robot: Robot) -> np.ndarray:
    """A configuration (n,), rad, in the text of a flag. Raises ValueError: outside the limits."""
    configuration = _numbers(flag, text, robot.num_joints)
    outside = np.abs(robot.normalise(configuration)) > 1.0 + 1e-6
    if outside.any():
        joint = int(outside.argmax())
        limits = f"{robot.lower[joint]:.4f} to {robot.upper[joint]:.4f}"
        raise ValueError(f"{flag}: joint {joint + 1} is outside its limits, {limits} rad")
    return configuration


def _task_scene(args: Args) -> Scene:
    """The `Scene` of the task, a random one where scenes are drawn."""
    from roboarm_nmp.envs.tasks import get_task

    scene = get_task(str(args.task)).scene
    moves = not scene.is_static if isinstance(scene, Scene) else hasattr(scene, "animate")
    if moves:
        raise ValueError(f"--task: obstacles of {args.task} move, and plans are for scenes at rest")
    if isinstance(scene, Scene):
        return scene
    return scene.sample(np.random.default_rng(args.seed))


def _observed_scene(args: Args, path: Path, robot: Robot) -> ObservedScene:
    """The `ObservedScene` of the cloud, which is prepared and described."""
    from roboarm_nmp.datasets.cloud_files import load_cloud
    from roboarm_nmp.envs.perception.point_clouds import prepare_cloud
    from roboarm_nmp.envs.scenes.primitives import FLOOR, TABLE

    if args.recorded_at is None:
        recorded_at = _configuration("--start", args.start, robot)
    else:
        recorded_at = _configuration("--recorded-at", args.recorded_at, robot)
    frame = None if args.frame is None else _numbers("--frame", args.frame, 7)
    intrinsics = None
    if args.intrinsics is not None:
        intrinsics = _numbers("--intrinsics", args.intrinsics, 4).tolist()
    table, floor = (TABLE, FLOOR) if args.table else (None, None)
    options = {
        name: getattr(args, name)
        for name in ("cell", "min_points", "arm_distance")
        if getattr(args, name) is not None
    }
    if args.workspace is not None:
        options["workspace"] = _numbers("--workspace", args.workspace, 6).reshape(2, 3)
    cloud = load_cloud(path, args.units, frame, intrinsics)
    prepare_cloud(cloud[:0], robot, recorded_at)  # what happens once per arm, outside of the time
    began = time.perf_counter()
    points, removed = prepare_cloud(cloud, robot, recorded_at, table=table, floor=floor, **options)
    seconds = time.perf_counter() - began
    left_out = [f"{number:,} {step}" for step, number in removed.items() if number]
    print(f"{path}: {len(cloud):,} points; left out: {', '.join(left_out) or 'none'}")
    print(f"{len(points):,} points remain, prepared in {1000 * seconds:.0f} ms")
    unusable = removed["not finite"] + removed["outside the workspace"]
    if unusable >= ALMOST_ALL * len(cloud) and not args.allow_empty:
        raise ValueError(
            f"{path}: {unusable:,} of {len(cloud):,} points are not finite or out of reach, so "
            f"obstacles may be missing: check --units, --frame and --workspace, or plan without "
            f"them (--allow-empty)"
        )
    return ObservedScene(
        points=points, point_radius=args.point_radius, robot=robot, table=table, floor=floor
    )


def _goal(args: Args, robot: Robot, start: np.ndarray) -> dict[str, np.ndarray]:
    """The goal as an argument of `Planner.plan`: `goal` (n,), rad, or `goal_pose` (7,)."""
    from roboarm_nmp.policies.pose_goals import goal_configuration

    if args.goal_pose is not None:
        pose = _numbers("--goal-pose", args.goal_pose, 7)
        if goal_configuration(robot, pose, start) is None:
            raise ValueError("--goal-pose: the arm cannot reach it")
        return {"goal_pose": pose}
    return {"goal": _configuration("--goal", args.goal or "", robot)}


def _check_end(
    flag: str, configuration: np.ndarray, checker: "CollisionChecker", point_radius: float
):
    """Raise ValueError if a point of the cloud is inside the arm, which the simulator ignores.

    That the arm is inside the ball around a point is allowed: balls are larger than surfaces.
    """
    from roboarm_nmp.envs.collision.checker import POINT

    robot = checker.robot
    state = np.clip(robot.normalise(configuration), -1.0, 1.0)
    near = checker.signed_distances(state, self_collisions=False)
    link = int(near.distance.argmin())
    depth = -near.distance[link] - point_radius
    if near.geometry[link] == POINT and depth > 0:
        name = robot.link_names[robot.collision_links[link]]
        raise ValueError(f"{flag} is in collision: a point is {1000 * depth:.0f} mm inside {name}")


def _planned(args: Args, scene: Scene, start: np.ndarray, goal: dict) -> tuple[np.ndarray, float]:
    """A path (k, n), rad, of the planner to a `_goal`, and its computing time (s).

    Raises PlanningError: there is none.
    """
    from roboarm_nmp.envs.arm_env import RoboArmEnv
    from roboarm_nmp.planning.planner import Planner

    planner = Planner(RoboArmEnv(scene))
    began = time.perf_counter()
    path = planner.plan(start, seed=args.seed, time_limit=args.time_limit, **goal)
    return path, time.perf_counter() - began


def _rolled_out(
    args: Args,
    checker: "CollisionChecker",
    start: np.ndarray,
    goal: np.ndarray | None = None,
    goal_pose: np.ndarray | None = None,
) -> "Trajectory":
    """The `Trajectory` of a policy from start to goal. Raises ValueError: it cannot act here."""
    from roboarm_nmp import envs
    from roboarm_nmp.datasets.queries import Query
    from roboarm_nmp.evaluation.rollout import rollout
    from roboarm_nmp.policies.pose_goals import goal_configuration
    from roboarm_nmp.policies.registry import find_policy, make_policy, own_safety_filter

    policy, options = find_policy(args.policy)
    if args.cloud is not None:
        for source in (options.get("encoder"), options.get("geometry_source")):
            if source not in (None, "point_cloud", "ground_truth"):
                raise ValueError(f"{args.policy} observes {source}, not points")
    if own_safety_filter(policy) or options.get("link_distances"):
        options["link_distances"] = True
        options.setdefault("geometry_source", "ground_truth")
    scene = checker.scene
    if goal_pose is not None:
        goal = goal_configuration(scene.robot, goal_pose, start, checker)
    if goal is None:
        raise ValueError("--goal-pose: the arm reaches it only in collision")
    env = envs.make(scene, **options)
    query = Query(start.astype(np.float32), goal.astype(np.float32), scene)
    begin = make_policy(policy, env, args.seed, time_limit=args.time_limit)
    return rollout(env, query, begin(0, query).act)


def _retimed(path: np.ndarray, checker: "CollisionChecker") -> "JointTrajectory":
    """The `JointTrajectory` of a path (k, n), rad, checked for collisions where that is possible.

    A path that is inside the ball around a point, as its ends may be, or in contact, as a policy's
    may be, is timed without a check, exactly along the path, and a line says so.
    """
    from roboarm_nmp.motions.time_parameterisation import time_parameterise

    began = time.perf_counter()
    try:
        trajectory = time_parameterise(path, checker.robot, checker=checker)
    except ValueError as error:
        trajectory = time_parameterise(path, checker.robot, deviation=0.0)
        print(f"timed exactly along the path, without a check: {error}")
    milliseconds = 1000 * (time.perf_counter() - began)
    print(f"timed in {milliseconds:.0f} ms: {trajectory.duration:.2f} s")
    return trajectory


def _describe(configurations: np.ndarray, checker: "CollisionChecker"):
    """Print the length of a motion (m, n), rad, and its minimum clearance from the scene."""
    from roboarm_nmp.envs.collision.checker import FLOOR, NOTHING, POINT, TABLE
    from roboarm_nmp.motions.metrics import path_length

    robot = checker.robot
    names = {TABLE: "the table", FLOOR: "the floor", POINT: "a point"}
    joints = path_length(configurations)
    metres = path_length(robot.forward_kinematics(configurations))
    print(f"path length {joints:.2f} rad, of the end effector {metres:.2f} m")
    states = np.clip(robot.normalise(configurations), -1.0, 1.0)
    near = checker.signed_distances(states, self_collisions=False)
    nearest = np.unravel_index(near.distance.argmin(), near.distance.shape)
    if near.geometry[nearest] != NOTHING:
        geometry = names.get(int(near.geometry[nearest]), "an obstacle")
        print(f"minimum clearance {1000 * near.distance[nearest]:.1f} mm, from {geometry}")


def _check(args: Args):
    """Raise ValueError for flags that do not go together."""
    flags.check(args)
    if (args.cloud is None) == (args.task is None):
        raise ValueError("one of --cloud and --task is needed")
    if args.cloud is None:
        for name in CLOUD_FLAGS:
            if getattr(args, name) != getattr(Args, name):
                raise ValueError(f"--{name.replace('_', '-')} goes with --cloud")
    if (args.goal is None) == (args.goal_pose is None):
        raise ValueError("one of --goal and --goal-pose is needed")


def _plan(args: Args) -> bool:
    """Plan, describe and write the motion. Returns whether it reaches the goal."""
    _check(args)
    # Here, because --help need not wait for Numba.
    from roboarm_nmp.envs.collision.checker import CollisionChecker
    from roboarm_nmp.envs.robots.files import load_robot
    from roboarm_nmp.envs.robots.panda import PANDA
    from roboarm_nmp.motions.trajectories import (
        check_ending,
        save_joint_path,
        save_trajectory,
        timed,
    )

    if args.output is not None:
        check_ending(args.output)
        check_writable(args.output)
    if args.cloud is not None:
        scene = _observed_scene(args, args.cloud, load_robot(args.robot or PANDA.name))
    else:
        scene = _task_scene(args)
    start = _configuration("--start", args.start, scene.robot)
    checker = CollisionChecker(scene)
    goal = _goal(args, scene.robot, start)
    if args.cloud is not None:
        _check_end("--start", start, checker, args.point_radius)
        if args.goal is not None:
            _check_end("--goal", goal["goal"], checker, args.point_radius)
    episode = trajectory = None
    if args.policy == "planner":
        path, seconds = _planned(args, scene, start, goal)
        _, configurations = timed(path, scene.robot)
        print(f"planned in {1000 * seconds:.0f} ms: {len(path)} waypoints")
    else:
        episode = _rolled_out(args, checker, start, **goal)
        path = configurations = episode.configurations
        reached = "reached" if episode.success else "not reached"
        seconds = episode.times.sum()
        print(f"{len(episode)} steps, goal {reached}; policy's time {1000 * seconds:.0f} ms")
    if args.retime:
        trajectory = _retimed(path, checker)
        configurations = trajectory.positions
    _describe(configurations, checker)
    if args.output is not None:
        if trajectory is not None:
            save_trajectory(args.output, trajectory)
        elif episode is not None:
            save_trajectory(args.output, episode)
        else:
            times, configurations = timed(path, scene.robot)
            save_joint_path(args.output, configurations, times, scene.robot)
        print(f"{args.output}: {len(configurations)} configurations")
    return episode is None or episode.success


def main(args: Args):
    """The command."""
    try:
        reached = _plan(args)
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        sys.exit(error_line(error))
    sys.exit(0 if reached else 1)


if __name__ == "__main__":
    end_with_one_line("nothing was written")
    main(flags.parse(Args, others="cloud"))
