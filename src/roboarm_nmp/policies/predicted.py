"""Reactive policies whose motion is predicted, and verified before the arm moves.

    begin = Predicted(begin, otherwise, env, seed=0)     # `registry.make_policy` makes it
    act, verified, searched = begin(number, query)

A policy that chooses one small motion after the other, with its safety filter if it has one, is run
at the start of an episode without the simulator: the arm is where each action commands it to be.
The path that this gives is checked in the observed cloud, as those of `policies.generative` are,
where space that no sensor sees counts as occupied, and shortened. The arm follows it if it is
verified; otherwise another policy acts. Among moving obstacles nothing is predicted.
"""

import numpy as np

from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.envs.perception.geometry_source import cautious_checker
from roboarm_nmp.envs.perception.point_clouds import DENSE_RAYS, sensor_images
from roboarm_nmp.envs.scenes.primitives import ObservedScene
from roboarm_nmp.policies.generative import MARGINS, finished_path, follow_gently, margins_near
from roboarm_nmp.policies.policy import BeginEpisode, EpisodePolicy, Policy
from roboarm_nmp.policies.pose_goals import observed_at_start

ARRIVED = 0.02  # L2, normalised: from here the path goes straight to the goal
STANDSTILL, LEAST_MOTION = 20, 0.01  # so many steps that move the arm by less end the prediction


class Predicted:
    """A policy for each episode of an environment: a function (number, `Query`) -> `EpisodePolicy`.

    Args:
        begin: the reactive policy, with its safety filter.
        otherwise: what begins an episode where no predicted motion is verified.
        env: the `RoboArmEnv`, whose goals are configurations.
        seed: of the random numbers that shorten paths, >= 0; each query has its own generator.
        searches: whether `otherwise` always searches, as planners do.

    Raises:
        ValueError: goals without a configuration, actions that are not displacements, or velocities
            or link distances in `observation`, which are not predicted.
    """

    def __init__(
        self,
        begin: BeginEpisode,
        otherwise: BeginEpisode,
        env: RoboArmEnv,
        seed: int = 0,
        searches: bool = False,
    ):
        if not GOAL_TYPES[env.goal_type].has_configuration or env.action_mode != "relative":
            raise ValueError(
                "motions are predicted for goals that contain a configuration, and actions that "
                "are displacements"
            )
        if env.velocities or getattr(env, "appends_link_distances", False):
            raise ValueError("neither velocities nor appended link distances are predicted")
        self._begin = begin
        self._otherwise = otherwise
        self._env = env
        self._seed = seed
        self._searches = searches

    def __call__(self, number: int, query: Query) -> EpisodePolicy:
        robot = self._env.robot
        begun = self._begin(number, query)
        if not query.scene.is_static:
            return begun._replace(plan_found=False)
        scene = observed_at_start(self._env, query)
        if not isinstance(scene, ObservedScene):
            sensor_images(scene, DENSE_RAYS)  # first: others need no casting then
        states = None if begun.act is None else self._predict(begun.act, query)
        if states is not None:
            ends = states[[0, -1]]
            rng = np.random.default_rng([self._seed, number])
            checker = cautious_checker(scene, ends)
            for margin, near in zip(MARGINS, margins_near(checker, ends), strict=True):
                path = finished_path(checker, states, margin, near, rng)
                if path is not None:
                    return EpisodePolicy(follow_gently(robot.denormalise(path), robot), True)
        begun = self._otherwise(number, query)
        searched = self._searches or begun.searched
        return begun._replace(plan_found=bool(begun.plan_found), searched=searched)

    def _predict(self, act: Policy, query):
        """The states (k, n), normalised, from start to goal; None if the arm does not arrive."""
        env = self._env
        robot, joints = env.robot, env.robot.num_joints
        observation, _ = env.reset_specific(*query)
        goal_type = GOAL_TYPES[env.goal_type]
        goal = np.clip(robot.normalise(query.goal), -1.0, 1.0)
        states = [np.clip(robot.normalise(query.start), -1.0, 1.0)]
        for _ in range(env.horizon):
            if np.linalg.norm(states[-1] - goal) < ARRIVED:
                return np.array([*states, goal])
            action = np.asarray(act(observation), np.float64)
            action *= min(1.0, env.max_step / max(np.linalg.norm(action), 1e-9))
            states.append(np.clip(states[-1] + action, -1.0, 1.0))
            stood = len(states) > STANDSTILL and (
                np.linalg.norm(states[-1] - states[-1 - STANDSTILL]) < LEAST_MOTION
            )
            if stood:
                return None
            position = goal_type.end_effector(robot, robot.denormalise(states[-1]))
            inner = observation["observation"].copy()
            inner[:joints] = states[-1]
            inner[joints : joints + len(position)] = position
            achieved = goal_type.achieved(states[-1], position).astype(np.float32)
            observation = {**observation, "observation": inner, "achieved_goal": achieved}
            if "link_distances" in observation:
                at = env.get_wrapper_attr("link_distances_at")
                observation["link_distances"] = at(inner[:joints])
        return None
