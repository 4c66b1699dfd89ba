"""Wrappers that add to observations: what sensors observe, an encoded scene, link distances."""

import math
import warnings

import gymnasium as gym
import numpy as np

from roboarm_nmp.envs.perception.sensors import SensorWorld, cardinal


class SensorWrapper(gym.Wrapper):
    """Adds `sensors` to the observation: a dict of a sensor's name -> its observation (a dict).

    Args:
        env: a `RoboArmEnv`, possibly wrapped.
        sensors: dict of name -> sensor: an `envs.perception.sensors.Camera` or `PointCloud`, or
            any object with their `space` and `observe`; by default four cameras (`cardinal`).
        every_step: observe in every step; otherwise once per episode, at its start, with the arm in
            the start configuration (paper, appendix "Prediction times investigation").
    """

    def __init__(self, env, sensors=None, every_step=False):
        super().__init__(env)
        self.sensors = cardinal(robot=env.unwrapped.robot) if sensors is None else dict(sensors)
        self.every_step = every_step
        spaces = {name: sensor.space for name, sensor in self.sensors.items()}
        self.observation_space = gym.spaces.Dict(
            {**env.observation_space.spaces, "sensors": gym.spaces.Dict(spaces)}
        )
        self._world = SensorWorld()
        self._observed = None

    def _observe(self, observation):
        robot = self.unwrapped.robot
        configuration = robot.denormalise(observation["observation"][: robot.num_joints])
        self._world.show(self.unwrapped.current_scene, configuration)
        self._observed = {
            name: sensor.observe(self._world) for name, sensor in self.sensors.items()
        }

    def _with_sensors(self, observation):
        observed = {  # copies, because the user may change an observation
            name: {output: array.copy() for output, array in outputs.items()}
            for name, outputs in self._observed.items()
        }
        return {**observation, "sensors": observed}

    def _begin(self, observation, info):
        self._observe(observation)
        return self._with_sensors(observation), info

    def reset(self, *, seed=None, options=None):
        """As `RoboArmEnv.reset`."""
        return self._begin(*self.env.reset(seed=seed, options=options))

    def reset_specific(self, start, goal=None, scene=None, goal_pose=None):
        """As `RoboArmEnv.reset_specific`."""
        query = {"start": start, "goal": goal, "scene": scene, "goal_pose": goal_pose}
        return self.reset(options=query)

    def step(self, action):
        """As `RoboArmEnv.step`."""
        observation, *rest = self.env.step(action)
        if self.every_step:
            self._observe(observation)
        return self._with_sensors(observation), *rest

    def close(self):
        self._world.close()
        super().close()


class _ObservingWrapper(gym.Wrapper):
    """An environment with additional observations, and all other attributes of the wrapped one.

    `_extend` maps an observation of the wrapped environment to one of this.
    """

    def __getattr__(self, name):
        # `env` is missing while a copy is made. Python asks for special methods of copies, too.
        if name == "env" or name.startswith("__"):
            raise AttributeError(name)
        return self.env.get_wrapper_attr(name)

    def reset(self, *, seed=None, options=None):
        """As `RoboArmEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._extend(observation), info

    def reset_specific(self, start, goal=None, scene=None, goal_pose=None):
        """As `RoboArmEnv.reset_specific`."""
        query = {"start": start, "goal": goal, "scene": scene, "goal_pose": goal_pose}
        return self.reset(options=query)

    def step(self, action):
        """As `RoboArmEnv.step`."""
        observation, *rest = self.env.step(action)
        return self._extend(observation), *rest


class SceneEncodingWrapper(_ObservingWrapper):
    """Appends z_E, the encoded scene, to `observation` (paper, section 5.1).

    A scene is encoded once; one with moving obstacles in each step. All attributes of the wrapped
    environment are available.

    Args:
        env: a `RoboArmEnv`.
        encoder: an `envs.perception.encoders.SceneEncoder`; several environments may share it.
    """

    def __init__(self, env, encoder):
        super().__init__(env)
        self.encoder = encoder
        spaces = dict(env.observation_space.spaces)
        size = spaces["observation"].shape[0] + encoder.size
        spaces["observation"] = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.observation_space = gym.spaces.Dict(spaces)

    def _extend(self, observation):
        z = self.encoder(self.unwrapped.current_scene)
        return {**observation, "observation": np.concatenate([observation["observation"], z])}


class LinkDistancesWrapper(_ObservingWrapper):
    """Adds `link_distances` to the observation: the signed distance of each link, and its gradient.

    float32, the robot's `link_distances_shape`, a row per link that may collide: the distance from
    the nearest obstacle, table or floor in m, clipped to
    `envs.collision.checker.LINK_DISTANCE_RANGE`, and its gradient, m per unit of normalised
    configuration (zeros beyond the range). With goals that are configurations,
    `goal_link_distances` are the same at the goal. All attributes of the wrapped environment are
    available.

    Hindsight relabelling replaces goals, and must replace `goal_link_distances`, too: see
    docs/guide/environment.md, "Hindsight relabelling".

    Args:
        env: a `RoboArmEnv`, possibly in a `SceneEncodingWrapper`.
        geometry_source: a function from a `Scene` to a `CollisionChecker`
            (`envs.perception.geometry_source`).
        append: whether `observation` contains `link_distances`, too, flat, before an encoded scene.
        goal_link_distances: whether observations contain `goal_link_distances`, if the goal type
            is `config` or `combined`.
        fine_geometry_source: another one for approach paths (`envs.policies.approach_path`).
    """

    def __init__(
        self,
        env,
        geometry_source,
        append=False,
        goal_link_distances=True,
        fine_geometry_source=None,
    ):
        super().__init__(env)
        self.geometry_source, self.appends_link_distances = geometry_source, append
        self._fine_geometry_source = fine_geometry_source or geometry_source
        self._of_goals = goal_link_distances and self.goal_type in ("config", "combined")
        names = ["link_distances"] + ["goal_link_distances"] * self._of_goals
        shape = self.unwrapped.robot.link_distances_shape
        space = gym.spaces.Box(-np.inf, np.inf, shape, np.float32)
        spaces = env.observation_space.spaces | {name: space for name in names}
        if append:
            size = spaces["observation"].shape[0] + math.prod(shape)
            spaces["observation"] = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.observation_space = gym.spaces.Dict(spaces)
        self._goal, self._at_goal = None, None

    def current_checker(self):
        """The `CollisionChecker` of what is observed now; the same as long as nothing changes."""
        return self.geometry_source(self.unwrapped.current_scene)

    def link_distances_at(self, states, scene=None):
        """`link_distances` at normalised configurations (..., n): float32 (..., l, 1 + n).

        `scene`: a static `Scene`, by default that of the environment at this time.
        """
        checker = self.geometry_source(self.unwrapped.current_scene if scene is None else scene)
        return checker.link_distances(states)

    def fine_link_distances_at(self, states):
        """As `link_distances_at`, from the geometry source for approach paths."""
        return self._fine_geometry_source(self.unwrapped.current_scene).link_distances(states)

    def compute_reward(self, achieved_goal, desired_goal, info):
        """As `RoboArmEnv.compute_reward`; warns if goals are relabelled."""
        if self._of_goals and np.ndim(desired_goal) > 1:
            warnings.warn(
                "rewards of a batch of goals: after hindsight relabelling, goal_link_distances "
                'belong to another goal (docs/guide/environment.md, "Hindsight relabelling")',
                stacklevel=2,
            )
        compute_reward = self.env.get_wrapper_attr("compute_reward")
        return compute_reward(achieved_goal, desired_goal, info)

    def _extend(self, observation):
        inner, joints = observation["observation"], self.unwrapped.robot.num_joints
        more = {"link_distances": self.link_distances_at(inner[:joints])}
        if self.appends_link_distances:
            size = self.unwrapped.observation_space["observation"].shape[0]
            parts = inner[:size], more["link_distances"].ravel(), inner[size:]
            more["observation"] = np.concatenate(parts)
        if self._of_goals:
            goal = observation["desired_goal"][:joints]
            key = self.unwrapped.current_scene, goal.tobytes()
            if self._goal != key:
                self._goal, self._at_goal = key, self.link_distances_at(goal)
            more["goal_link_distances"] = self._at_goal.copy()
        return {**observation, **more}
