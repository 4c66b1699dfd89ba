"""Rollouts: one episode of a policy on one query, recorded as a `Trajectory`.

    begin = make_policy("go-to-goal", env)
    trajectory = rollout(env, query, begin(0, query).act)
    trajectory.success, trajectory.collides, trajectory.configurations

`rollout` runs one episode. `Episode` is the same step by step, for a network that predicts the
actions of several episodes at once. Metrics and images are derived from trajectories.
"""

import math
import time
from dataclasses import dataclass

import numpy as np

from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot

REAL_TIME = "real_time"
"""A delay: as many steps as an action takes to compute, of wall-clock time."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """An episode of T steps of an arm with n joints.

    Attributes:
        states: float32 (T + 1, n), normalised configurations, from the start on.
        actions: float64 (T, n), as the environment received them.
        contacts: bool (T,), whether the arm was in contact during each step.
        times: float64 (T,), s, from each observation to its action; with a delay, to the next step.
        success: whether the goal was reached.
        robot: the `Robot`.
    """

    states: np.ndarray
    actions: np.ndarray
    contacts: np.ndarray
    times: np.ndarray
    success: bool
    robot: Robot = PANDA

    def __len__(self):
        """The number of steps."""
        return len(self.actions)

    @property
    def configurations(self):
        """Joint angles (T + 1, n), rad."""
        return self.robot.denormalise(self.states)

    @property
    def collides(self):
        """Whether there was a contact in any step."""
        return bool(self.contacts.any())


class Episode:
    """An episode on one query, recorded step by step.

    Args:
        env: a `RoboArmEnv`, possibly wrapped. It is reset to the query.
        query: an `datasets.queries.Query`.

    Attributes:
        observation, info: the last ones.
        ended: whether the episode is over, possibly at its start.

    Raises:
        ValueError: the environment refuses the query.
    """

    def __init__(self, env, query):
        self.observation, self.info = env.reset_specific(*query)
        self.env, self._robot = env, env.unwrapped.robot  # the query's, in its scene
        self.ended = self._success = self.info["is_success"]
        self._states, self._actions = [self._state()], []
        self._contacts, self._times = [], []
        self._observed = time.perf_counter()

    def _state(self):
        return self.observation["observation"][: self._robot.num_joints]

    def hold(self):
        """The action that keeps the arm where it is."""
        state = self._state()
        return state if self.env.unwrapped.action_mode == "subgoal" else np.zeros_like(state)

    def step(self, action):
        """One step of the environment. Raises ValueError: it refuses the action."""
        seconds = time.perf_counter() - self._observed
        self.observation, _, terminated, truncated, self.info = self.env.step(action)
        self.ended, self._success = terminated or truncated, self.info["is_success"]
        self._states.append(self._state())
        self._actions.append(np.array(action, dtype=np.float64))
        self._contacts.append(self.info["collision"])
        self._times.append(seconds)
        self._observed = time.perf_counter()

    def trajectory(self):
        """The `Trajectory` so far."""
        return Trajectory(
            np.array(self._states),
            np.array(self._actions).reshape(-1, self._robot.num_joints),
            np.array(self._contacts, dtype=bool),
            np.array(self._times),
            self._success,
            self._robot,
        )


def rollout(env, query, policy, delay=0, planning_seconds=0.0):
    """The `Trajectory` of a policy on a query.

    With a delay, an action takes effect some steps after its observation, and the policy observes
    nothing until then. Meanwhile the command before it applies: the arm makes that step, and then
    holds its configuration. Before the first action the arm holds its start.

    Args:
        env: a `RoboArmEnv`, possibly wrapped.
        query: an `datasets.queries.Query`.
        policy: a function from an observation to an action (n,); None: no step is made.
        delay: of each action, in steps; 0: the simulation waits for the policy. `REAL_TIME`: the
            steps of 1/30 s that pass while the policy computes, at least 1. The trajectory then
            depends on the machine and its load.
        planning_seconds: s, with `REAL_TIME`: what the policy has computed before the episode.

    Raises:
        ValueError: the environment refuses the query or an action.
    """
    episode, command = Episode(env, query), None
    while policy is not None and not episode.ended:
        began = time.perf_counter()
        action = policy(episode.observation)
        steps = delay
        if delay == REAL_TIME:
            seconds = time.perf_counter() - began + planning_seconds
            steps, planning_seconds = max(1, math.ceil(seconds / STEP_SECONDS)), 0.0
        if steps == 0:
            episode.step(action)
            continue
        for _ in range(steps):
            if not episode.ended:
                episode.step(episode.hold() if command is None else command)
                command = None
        command = action
    return episode.trajectory()


def render_strip(env, query, actions, steps):
    """Images of an episode side by side, uint8 (h, n * w, 3). The episode is replayed, exactly.

    Args:
        env: an environment like the episode's, which renders to `rgb_array`.
        query: the episode's.
        actions: (T, n), of its `Trajectory`.
        steps: n numbers from 0 (the start) to T: the steps after which there is an image.
    """
    env.reset_specific(*query)
    images = {0: env.render()}
    for step, action in enumerate(actions, start=1):
        env.step(action)
        if step in steps:
            images[step] = env.render()
    return np.concatenate([images[step] for step in steps], axis=1)
