"""Demonstrations as episodes of a goal type: as an environment would have recorded them.

A demonstration (`datasets.demonstrations.Demo`) is a motion between two configurations. Its
observations, its achieved goals and the step that reaches the goal depend on the goal type: `ee`,
`config`, `combined` or `pose`. Trainers and the Minari export use these episodes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np

from roboarm_nmp.datasets.demonstrations import Demo, Demos, load_demo_files
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.subgoals import MAX_STEP

if TYPE_CHECKING:
    from roboarm_nmp.envs.arm_env import RoboArmEnv


class Episode(NamedTuple):
    """One episode of T steps, float32.

    `observation` (T + 1, o), `achieved_goal` (T + 1, g), `desired_goal` (g,), `action` (T, n), and
    `reached` (T + 1,), bool: whether that observation reaches the goal.
    """

    observation: np.ndarray
    achieved_goal: np.ndarray
    desired_goal: np.ndarray
    action: np.ndarray
    reached: np.ndarray


def observed(
    states: np.ndarray, goal: np.ndarray, goal_type: str, robot: Robot
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observations at `states`, without velocities, in an episode with `goal`.

    Args:
        states: normalised configurations (m, n).
        goal: joint angles (..., n), rad.
        goal_type: `ee`, `config`, `combined` or `pose`.
        robot: the `Robot`, with n joints.

    Returns:
        float32 `observation` (m, n + 3), for `pose` (m, n + 7), `achieved_goal` (m, g),
        `desired_goal` (..., g).
    """
    kind = GOAL_TYPES[goal_type]
    end_effectors = kind.end_effector(robot, robot.denormalise(states))
    observations = np.hstack([states, end_effectors])
    achieved = kind.achieved(states, end_effectors)
    desired = kind.achieved(robot.normalise(goal), kind.end_effector(robot, goal))
    return (
        observations.astype(np.float32),
        achieved.astype(np.float32),
        desired.astype(np.float32),
    )


def demo_episode(demo: Demo, env: "RoboArmEnv") -> Episode:
    """A demonstration as `env` would have recorded it, up to reaching its goal.

    Args:
        demo: the demonstration.
        env: an environment of `envs.make` without velocities. Its goal type, action mode, goal
            tolerances, encoder and appended link distances are those of the episode.
    """
    observation, achieved_goal, desired_goal = observed(
        demo.states, demo.goal, env.goal_type, env.robot
    )
    action = demo.actions
    if env.action_mode == "subgoal":
        action = demo.states[:-1] + demo.actions
    if getattr(env, "appends_link_distances", False):
        link_distances = env.link_distances_at  # pyright: ignore[reportAttributeAccessIssue]
        distances = link_distances(demo.states, demo.scene)
        observation = np.hstack([observation, distances.reshape(len(distances), -1)])
    encoder = getattr(env, "encoder", None)
    if encoder is not None:
        latent = np.tile(encoder(demo.scene), (len(observation), 1))
        observation = np.hstack([observation, latent])
    reached = env.compute_terminated(achieved_goal, desired_goal, {})
    length = int(np.argmax(reached[1:])) + 1 if reached[1:].any() else len(action)
    return Episode(
        observation=observation[: length + 1],
        achieved_goal=achieved_goal[: length + 1],
        desired_goal=desired_goal,
        action=action[:length],
        reached=reached[: length + 1],
    )


def transition(
    before: dict[str, np.ndarray], action: np.ndarray, after: dict[str, np.ndarray], collision: bool
) -> dict[str, Any]:
    """A replay buffer's entry: `action` led from the observation `before` (a dict) to `after`."""
    return {
        "observation": before["observation"],
        "action": action,
        "next_observation": after["observation"],
        "next_achieved_goal": after["achieved_goal"],
        "desired_goal": before["desired_goal"],
        "collision": collision,
    }


def demo_transitions(demo: Demo, env: "RoboArmEnv") -> list[dict[str, Any]]:
    """The episode of `demo_episode` as a list of such transitions."""
    episode = demo_episode(demo, env)
    observations = [
        {
            "observation": episode.observation[t],
            "achieved_goal": episode.achieved_goal[t],
            "desired_goal": episode.desired_goal,
        }
        for t in range(len(episode.observation))
    ]
    return [
        transition(observations[t], action, observations[t + 1], False)
        for t, action in enumerate(episode.action)
    ]


class DemoQueriesWrapper(gym.Wrapper):
    """Episodes on the queries of demonstrations: `reset` draws one of them.

    Its number in `demos` is in `info["demo"]`, also after each step. If the environment has an
    encoder, all scenes are encoded first, which may take minutes.

    Args:
        env: an environment of `envs.make`.
        demos: the `Demos`.

    Raises:
        ValueError: the scenes cannot be encoded.
    """

    env: "RoboArmEnv"

    def __init__(self, env: "RoboArmEnv", demos: Demos):
        super().__init__(env)
        self.demos = demos
        encoder = getattr(env, "encoder", None)
        if encoder is not None:
            encoder.encode_demos(demos)

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """As `RoboArmEnv.reset`."""
        if seed is not None:
            self.env.reset(seed=seed)
        self.number = int(self.np_random.integers(len(self.demos)))
        demo = self.demos[self.number]
        observation, info = self.env.reset_specific(demo.start, demo.goal, demo.scene)
        return observation, info | {"demo": self.number}

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """As `RoboArmEnv.step`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, info | {"demo": self.number}


def load_demos_for(env: "RoboArmEnv", files: Sequence[str | Path], task: str) -> Demos:
    """Load the demonstrations of a task's files, if they can be episodes of `env`.

    Args:
        env: an environment of `envs.make`.
        files: paths of demonstration files; without any, the task's own.
        task: the task that they must be for.

    Raises:
        DatasetError: they cannot be episodes of `env`; or as `load_demos`.
    """
    if env.velocities or env.max_step < MAX_STEP:
        raise DatasetError(
            f"demonstrations have no velocities, and steps up to {MAX_STEP}: unlike the environment"
        )
    observes = getattr(env, "encoder", None) or getattr(env, "appends_link_distances", False)
    if observes and not env.scene.is_static:
        raise DatasetError(
            "demonstrations among moving obstacles have no observations of the scene"
        )
    demos = load_demo_files(files, task)
    if env.stop_on_collision and demos.collided.any():
        raise DatasetError("--stop-on-collision, but some of these demonstrations have contacts")
    return demos
