"""Non-learning baselines, by name.

- go-to-goal: straight to the goal configuration, whatever is in the way (paper, section 5.1);
- random: a random action at every step;
- via-points: straight to the goal configuration if that motion is free of collisions; otherwise
  through the first of some random configurations for which the motion is free; without such a
  configuration, straight to the goal;
- planner: follows a plan of OMPL's RRT-Connect, which may search for a limited time;
- replanning: follows a plan, watches it, and plans again whenever it is blocked
  (`policies.replanning`);
- space-time: follows a plan that was made with the future motions of obstacles, the reference where
  obstacles move (`planning.space_time`).

Of a goal pose, the goal configuration is one that inverse kinematics finds, the nearest one to the
start; `via-points` and `planner` need one without collisions.

`via-points`, `planner` and `replanning` check collisions with the obstacles of a geometry source
(`envs.perception.geometry_source`); with the ground truth they are privileged. Where obstacles
move, the first two plan around obstacles as they are at the start, and `replanning` around those of
the present step. `space-time` always has the ground truth, the future included.
"""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.policies.policy import BeginEpisode, EpisodePolicy, Policy
from roboarm_nmp.policies.pose_goals import goal_configuration, observed_at_start

if TYPE_CHECKING:  # Numba takes a while to import
    from roboarm_nmp.envs.collision.checker import CollisionChecker
    from roboarm_nmp.envs.perception.geometry_source import Unknown
    from roboarm_nmp.policies.replanning import Replanning

SPACE_TIME = "space-time"
OMPL_PLANNERS = ("planner", SPACE_TIME)
"""The baselines that need OMPL, which is imported only when one of them is used."""
PLANNERS = ("via-points", *OMPL_PLANNERS)
"""The baselines that look for a motion before they move."""
REPLANNING = "replanning"
CHECKING = (*PLANNERS, REPLANNING)
"""The baselines that need a geometry source."""
BASELINES = ("go-to-goal", "random", *CHECKING)
TRIES = 16  # of `via-points`, by default
TIME_LIMIT = 5.0  # s, of `planner`, by default

GeometrySource = Callable[[Scene], "CollisionChecker"]


def make_baseline(
    name: str,
    env: RoboArmEnv,
    seed: int,
    tries: int,
    time_limit: float,
    geometry_source: str | Path,
    unknown: "Unknown | None" = None,
) -> BeginEpisode:
    """A baseline in an environment.

    Args:
        name: one of `BASELINES`.
        env, seed, tries, time_limit, geometry_source, unknown: see
            `policies.registry.make_policy`.

    Raises:
        ValueError: the environment's actions are not displacements, there is no such geometry
            source, or unseen space is not occupied for this baseline.
    """
    if unknown == "occupied" and (name != "planner" or geometry_source != "point_cloud"):
        raise ValueError(
            "unknown='occupied' is for policies that draw paths, and for planner with "
            "geometry_source='point_cloud'"
        )
    robot = env.robot
    if name == "random":

        def begin_random(number, query):
            rng = np.random.default_rng([seed, number])
            return EpisodePolicy(lambda observation: rng.uniform(-1.0, 1.0, robot.num_joints))

        return begin_random
    if env.action_mode != "relative":
        raise ValueError(f"{name} gives displacements, not actions of mode {env.action_mode!r}")
    if name == "go-to-goal":
        observes_goal = GOAL_TYPES[env.goal_type].has_configuration
        return lambda number, query: EpisodePolicy(
            _go_to_goal(_goal(env, query), robot, observes_goal)
        )
    # Here, because Numba takes a while to import.
    from roboarm_nmp.envs.perception.geometry_source import find_geometry_source

    source = find_geometry_source(geometry_source, robot)
    if name == SPACE_TIME:
        if geometry_source != "ground_truth":
            raise ValueError(f"space-time plans with the ground truth, not {geometry_source}")
        return _space_time(env, seed, time_limit)
    if name == "via-points":
        return _via_points(env, seed, tries, source)
    if name == REPLANNING:
        begin_replanning = make_replanning(env, seed, source)
        return lambda number, query: EpisodePolicy(begin_replanning(number, query))
    return _planner(env, seed, time_limit, source, unknown == "occupied")


def _goal(env, query, checker=None):
    """The goal's configuration (n,), rad; None if the goal is a pose, and there is none."""
    if env.goal_type != "pose":
        return query.goal
    pose = env.robot.end_effector_pose(query.goal)
    return goal_configuration(env.robot, pose, query.start, checker)


def _go_to_goal(goal, robot, observes_goal=False):
    if goal is None:
        return None
    target = robot.normalise(goal)

    def act(observation):
        desired = target
        if observes_goal:
            # It is another one where an approach path begins (`planning.approach_path`).
            observed = observation["desired_goal"][: len(target)]
            if np.abs(observed - target).max() >= 1e-5:
                desired = observed
        return desired - observation["observation"][: len(target)]

    return act


def _via_points(env: RoboArmEnv, seed: int, tries: int, geometry_source: GeometrySource):
    robot = env.robot

    # Without a margin, which would reject more than it saves: with 3 mm, collision-free success was
    # 2 to 5 points lower on `wall`, `double_walls` and `boxes`.
    def begin(number, query):
        checker = geometry_source(observed_at_start(env, query))
        configuration = _goal(env, query, checker)
        if configuration is None:
            return EpisodePolicy(None, plan_found=False)
        # float32 may round a limit to just beyond it.
        start, goal = np.clip(robot.normalise([query.start, configuration]), -1.0, 1.0)
        if checker.is_motion_free(start, goal):
            return EpisodePolicy(_go_to_goal(configuration, robot), plan_found=True)
        rng = np.random.default_rng([seed, number])
        for via in rng.uniform(-1.0, 1.0, (tries, robot.num_joints)):
            if checker.is_free(via) and checker.is_motion_free([start, via], [via, goal]).all():
                path = robot.denormalise(np.stack([start, via, goal]))
                return EpisodePolicy(follow_path(path, robot), plan_found=True)
        return EpisodePolicy(_go_to_goal(configuration, robot), plan_found=False)

    return begin


def make_replanning(
    env: RoboArmEnv, seed: int, geometry_source: GeometrySource
) -> Callable[[int, Query], "Replanning | None"]:
    """A function that makes the `Replanning` of an episode; None for a pose without a goal."""
    from roboarm_nmp.envs.wrappers import observed_scene
    from roboarm_nmp.policies.replanning import Replanning

    # Compile here what is compiled at its first call: an action's time is for planning.
    state = np.zeros(env.robot.num_joints)
    checker = geometry_source(env.unwrapped.current_scene)
    checker.find_path(state, state, np.random.default_rng(0), max_checks=1)

    def current_checker():
        return geometry_source(observed_scene(env))

    def begin(number, query):
        goal = _goal(env, query, geometry_source(observed_at_start(env, query)))
        if goal is None:
            return None
        rng = np.random.default_rng([seed, number])
        return Replanning(env.robot, goal, current_checker, rng)

    return begin


def _planner(
    env: RoboArmEnv,
    seed: int,
    time_limit: float,
    geometry_source: GeometrySource,
    unknown_is_occupied: bool,
):
    from roboarm_nmp.envs.perception.geometry_source import cautious_checker
    from roboarm_nmp.planning.planner import Planner, PlanningError

    planner_of_scenes = Planner(env, geometry_source=geometry_source)

    def begin(number, query):
        planner = planner_of_scenes
        observed = observed_at_start(env, query)
        if observed is not query.scene:
            # A planner has one checker per scene, but this one is of a single episode.
            planner = Planner(env, geometry_source=lambda _: geometry_source(observed))
        goal = query.goal
        goal_pose = None
        if env.goal_type == "pose":
            goal = None
            goal_pose = env.robot.end_effector_pose(query.goal)
        if unknown_is_occupied:
            ends = [query.start] if goal is None else [query.start, goal]
            checker = cautious_checker(observed, np.clip(env.robot.normalise(ends), -1.0, 1.0))
            planner = Planner(env, geometry_source=lambda _: checker)
        try:
            path = planner.plan(
                query.start,
                goal,
                query.scene,
                seed=[seed, number],
                time_limit=time_limit,
                goal_pose=goal_pose,
            )
        except PlanningError:
            return EpisodePolicy(None, plan_found=False)
        return EpisodePolicy(follow_path(path, env.robot), plan_found=True)

    return begin


def _space_time(env: RoboArmEnv, seed: int, time_limit: float):
    from roboarm_nmp.planning.planner import PlanningError
    from roboarm_nmp.planning.space_time import SpaceTimePlanner

    planner = SpaceTimePlanner(env.unwrapped)

    def begin(number, query):
        try:
            path = planner.plan(*query, seed=[seed, number], time_limit=time_limit)
        except PlanningError:
            return EpisodePolicy(None, plan_found=False)
        return EpisodePolicy(follow_path(path, env.robot), plan_found=True)

    return begin


def follow_path(path: np.ndarray, robot: Robot) -> Policy:
    """One sub-goal per step along a path (k, n), rad; at its end the goal, repeatedly."""
    return follow_subgoals(subgoals(path, robot), robot)


def follow_subgoals(targets: np.ndarray, robot: Robot) -> Policy:
    """One of the sub-goals (m, n), normalised, per step, from the second on, then the last."""
    remaining = itertools.chain(targets[1:], itertools.repeat(targets[-1]))
    return lambda observation: next(remaining) - observation["observation"][: robot.num_joints]
