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
from typing import TYPE_CHECKING

import numpy as np

from roboarm_nmp.datasets.cloud_flags import (
    CloudFlags,
    check_without_cloud,
    configuration_in,
    numbers_in,
    observed_scene,
)
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_writable
from roboarm_nmp.utils.flags import PositiveFloat, Seed
from roboarm_nmp.utils.signals import end_with_one_line, error_line

if TYPE_CHECKING:  # imported when they are needed, so that --help does not wait for Numba
    from roboarm_nmp.envs.collision.checker import CollisionChecker
    from roboarm_nmp.evaluation.rollout import Trajectory
    from roboarm_nmp.motions.trajectories import JointTrajectory


@dataclass(kw_only=True)
class Args(CloudFlags):
    start: str
    """joint angles at the start, rad, separated by spaces"""
    goal: str | None = None
    """joint angles at the goal, rad"""
    goal_pose: str | None = None
    """instead: the end effector's pose at the goal, x y z (m) and a quaternion x y z w"""
    task: str | None = None
    """instead of a cloud: a task, one of `roboarm_nmp.TASKS`, or a scene file (.yaml); with another
    arm, TASK@FILE"""
    robot: Path | None = None
    """the arm beside a cloud: a robot's file (.urdf, .yaml; docs/customise/robot.md); by default
    the Panda"""
    policy: str = "planner"
    """`planner`, another baseline, a policy network, a run's folder, or the name of a pretrained
    policy (`roboarm policies`)"""
    seed: Seed = 0
    """of random numbers"""
    time_limit: PositiveFloat = 5.0
    """seconds that the planner may search"""
    retime: bool = False
    """times, velocities and accelerations within the arm's limits, checked for collisions where the
    path has none (extra `trajectories`); otherwise the motion has the speed of the environment"""
    output: Path | None = None
    """write the motion to this file, .csv, .npz, .json or .yaml (docs/guide/trajectories.md)"""


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


def _goal(args: Args, robot: Robot, start: np.ndarray) -> dict[str, np.ndarray]:
    """The goal as an argument of `Planner.plan`: `goal` (n,), rad, or `goal_pose` (7,)."""
    from roboarm_nmp.policies.pose_goals import goal_configuration

    if args.goal_pose is not None:
        pose = numbers_in("--goal-pose", args.goal_pose, 7)
        if goal_configuration(robot, pose, start) is None:
            raise ValueError(
                "--goal-pose: the arm cannot reach it; move it nearer to the base, or turn it "
                "(position in m, quaternion x y z w, in the base's frame)"
            )
        return {"goal_pose": pose}
    return {"goal": configuration_in("--goal", args.goal or "", robot)}


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
        raise ValueError(
            f"{flag} is in collision: a point is {1000 * depth:.0f} mm inside {name}; if that is a "
            f"point of the arm itself, remove it, or check the cloud's --frame and --units"
        )


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
        raise ValueError(
            "--goal-pose: the arm reaches it only in collision; move it away from the obstacles"
        )
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
        check_without_cloud(args)
        if args.robot is not None:
            raise ValueError("--robot goes with --cloud: name the arm of a task as TASK@FILE")
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
        robot = load_robot(args.robot or PANDA.name)
        scene, _ = observed_scene(args, robot, configuration_in("--start", args.start, robot))
    else:
        scene = _task_scene(args)
    start = configuration_in("--start", args.start, scene.robot)
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
