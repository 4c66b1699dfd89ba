"""Goal poses for policies whose goals are configurations, by inverse kinematics.

Such a policy heads for a configuration that has the pose: the one nearest to the start, with as
much clearance as `CLEARANCES` says, if there is one.
"""

from typing import TYPE_CHECKING

import numpy as np

from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.arm_env import Observation, RoboArmEnv
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Scene

if TYPE_CHECKING:  # Numba takes a while to import
    from roboarm_nmp.envs.collision.checker import CollisionChecker

# m, in the geometry source of the environment's link distances: the first that any solution has.
CLEARANCES = (0.02, 0.01, 0.0)


def goal_configuration(
    robot: Robot, pose: np.ndarray, start: np.ndarray, checker: "CollisionChecker | None" = None
) -> np.ndarray | None:
    """A configuration that has a pose, float32 (n,), rad; None if none was found.

    Args:
        robot: a `Robot` with n joints.
        pose: (7,), as of `Robot.end_effector_pose`.
        start: joint angles (n,), rad.
        checker: a `CollisionChecker`, in which the configuration is free; None for no checks.
    """
    # Here, because Numba takes a while to import.
    from roboarm_nmp.envs.robots.inverse_kinematics import inverse_kinematics

    configurations = inverse_kinematics(robot, pose, checker=checker, near=start)
    if not len(configurations):
        return None
    if checker is not None:
        states = robot.normalise(configurations)
        for clearance in CLEARANCES:
            has_clearance = checker.is_free(states, margin=clearance)
            if has_clearance.any():
                configurations = configurations[has_clearance]
                break
    return configurations[0].astype(np.float32)


def observed_at_start(env: RoboArmEnv, query: Query) -> Scene:
    """The scene of a `Query` as it is observed at the start of an episode in an environment."""
    try:
        observe = env.get_wrapper_attr("observed_at_start")
    except AttributeError:  # no `envs.wrappers.ObservedSceneWrapper`
        return query.scene.at(0.0)
    return observe(query.scene, query.start)


class ConfigurationGoals:
    """Observations in an environment of goal poses, as a policy for configurations expects them.

    Args:
        env: a `RoboArmEnv` with the goal type `pose`, possibly wrapped.
        goal_type: the policy's, `config` or `combined`.
    """

    def __init__(self, env: RoboArmEnv, goal_type: str):
        self.env = env
        self.robot = env.unwrapped.robot
        self._goal_type = GOAL_TYPES[goal_type]
        self._has_distances = "link_distances" in env.observation_space.spaces
        self._more = {}

    def begin(self, query: Query) -> bool:
        """Choose the goal of an episode, for a `datasets.queries.Query` with a goal's pose.

        Returns whether there is one.
        """
        scene = observed_at_start(self.env, query)
        checker = None
        if self._has_distances:
            checker = self.env.get_wrapper_attr("geometry_source")(scene)
        pose = self.robot.end_effector_pose(query.goal)
        goal = goal_configuration(self.robot, pose, query.start, checker)
        if goal is not None:
            self._set(self.robot.normalise(goal), pose[:3], scene)
        return goal is not None

    def begin_anywhere(self) -> None:
        """Choose any goal, to see what the policy would observe."""
        goal = np.zeros(self.robot.num_joints)
        self._set(goal, np.zeros(3), self.env.unwrapped.current_scene)

    def _set(self, state, position, scene):
        desired = self._goal_type.achieved(state, position)
        self._more = {"desired_goal": desired.astype(np.float32)}
        if self._has_distances:
            at = self.env.get_wrapper_attr("link_distances_at")
            self._more["goal_link_distances"] = at(np.clip(state, -1.0, 1.0), scene)

    def __call__(self, observation: Observation) -> Observation:
        """An observation of the environment as one of the policy."""
        inner = observation["observation"]
        end = self.env.unwrapped.observation_size  # of the quaternion
        position = inner[end - 7 : end - 4]
        return {
            **observation,
            "observation": np.delete(inner, np.s_[end - 4 : end]),
            "achieved_goal": self._goal_type.achieved(inner[: self.robot.num_joints], position),
            **self._more,
        }
