"""Rollouts: episodes of a policy on queries, each recorded as a `Trajectory`.

    begin = make_policy("go-to-goal", env)
    trajectory = rollout(env, query, begin(0, query).act)
    trajectory.success, trajectory.collides, trajectory.configurations

`Episode` goes step by step, for a loop of your own. Metrics and images are derived from
trajectories.
"""

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.motions.trajectories import Trajectory
from roboarm_nmp.policies.policy import Policy

REAL_TIME = "real_time"
"""A delay: as many steps as an action takes to compute, of wall-clock time."""


class Episode:
    """An episode on one query, recorded step by step.

    Args:
        env: a `RoboArmEnv`, possibly wrapped. It is reset to the query.
        query: a `datasets.queries.Query`.

    Attributes:
        observation, info: the last ones.
        ended: whether the episode is over, possibly at its start.

    Raises:
        ValueError: the environment refuses the query.
    """

    def __init__(self, env: RoboArmEnv, query: Query):
        self.env = env
        self.observation, self.info = env.reset_specific(*query)
        self._robot = env.unwrapped.robot  # the query's, in its scene
        self._success = self.info["is_success"]
        self.ended = self._success
        self._states = [self._state()]
        self._actions = []
        self._contacts = []
        self._times = []
        self._delayed = None  # the last action, until it takes effect
        self._observed = time.perf_counter()

    def _state(self):
        return self.observation["observation"][: self._robot.num_joints]

    def _hold(self):
        """The action that keeps the arm where it is."""
        state = self._state()
        return state if self.env.unwrapped.action_mode == "subgoal" else np.zeros_like(state)

    def step(self, action: np.ndarray) -> None:
        """One step of the environment. Raises ValueError: it refuses the action."""
        seconds = time.perf_counter() - self._observed
        self.observation, _, terminated, truncated, self.info = self.env.step(action)
        self._success = self.info["is_success"]
        self.ended = terminated or truncated
        self._states.append(self._state())
        self._actions.append(np.array(action, dtype=np.float64))
        self._contacts.append(self.info["collision"])
        self._times.append(seconds)
        self._observed = time.perf_counter()

    def step_delayed(self, action: np.ndarray, delay: int) -> None:
        """Steps of the environment until an action takes effect `delay` steps later.

        Meanwhile the arm makes the step of the action before it, and then holds its configuration.
        """
        if delay == 0:
            self.step(action)
            return
        for _ in range(delay):
            if not self.ended:
                self.step(self._hold() if self._delayed is None else self._delayed)
                self._delayed = None
        self._delayed = action

    def trajectory(self) -> Trajectory:
        """The `Trajectory` so far."""
        return Trajectory(
            np.array(self._states),
            np.array(self._actions).reshape(-1, self._robot.num_joints),
            np.array(self._contacts, dtype=bool),
            np.array(self._times),
            self._success,
            self._robot,
        )


def rollout(
    env: RoboArmEnv,
    query: Query,
    policy: Policy | None,
    delay: int | str = 0,
    planning_seconds: float = 0.0,
) -> Trajectory:
    """The `Trajectory` of a policy on a query.

    With a delay, an action takes effect some steps after its observation, and the policy observes
    nothing until then. Meanwhile the command before it applies: the arm makes that step, and then
    holds its configuration. Before the first action the arm holds its start.

    Args:
        env: a `RoboArmEnv`, possibly wrapped.
        query: a `datasets.queries.Query`.
        policy: a function from an observation to an action (n,); None: no step is made.
        delay: of each action, in steps; 0: the simulation waits for the policy. `REAL_TIME`: the
            steps of 1/30 s that pass while the policy computes, at least 1. The trajectory then
            depends on the machine and its load.
        planning_seconds: s, with `REAL_TIME`: what the policy has computed before the episode.

    Raises:
        ValueError: the environment refuses the query or an action.
    """
    episode = Episode(env, query)
    while policy is not None and not episode.ended:
        began = time.perf_counter()
        action = policy(episode.observation)
        steps: Any = delay
        if delay == REAL_TIME:
            seconds = time.perf_counter() - began + planning_seconds
            planning_seconds = 0.0
            steps = max(1, math.ceil(seconds / STEP_SECONDS))
        episode.step_delayed(action, steps)
    return episode.trajectory()


def render_steps(
    env: RoboArmEnv, query: Query, actions: np.ndarray, steps: Sequence[int]
) -> list[np.ndarray]:
    """Images of an episode, uint8 (h, w, 3). The episode is replayed, exactly.

    Args:
        env: an environment like the episode's, which renders to `rgb_array`.
        query: the episode's.
        actions: (T, n), of its `Trajectory`.
        steps: numbers from 0 (the start) to T: the steps after which there is an image.
    """
    env.reset_specific(*query)
    images = {0: np.asarray(env.render())}
    for step, action in enumerate(actions, start=1):
        env.step(action)
        if step in steps:
            images[step] = np.asarray(env.render())
    return [images[step] for step in steps]
