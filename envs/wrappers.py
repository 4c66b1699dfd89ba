"""Wrappers that add to the observation what sensors see, or what an encoder makes of it."""

import gymnasium as gym
import numpy as np

from roboarm_nmp.envs import panda
from roboarm_nmp.envs.perception.sensors import SensorWorld, cardinal


class SensorWrapper(gym.Wrapper):
    """Adds `sensors` to the observation: a dict of sensor's name -> its observation (a dict).

    Args:
        env: a `RoboArmEnv`, possibly wrapped.
        sensors: dict of name -> `envs.perception.sensors.Camera`, `PointCloud` or anything with their `space`
            and `observe`; by default four cameras (`cardinal()`).
        every_step: look in every step; otherwise once per episode, at its start, with the arm in
            the start configuration (paper, appendix "Prediction times investigation").
    """

    def __init__(self, env, sensors=None, every_step=False):
        super().__init__(env)
        self.sensors = cardinal() if sensors is None else dict(sensors)
        self.every_step = every_step
        spaces = {name: sensor.space for name, sensor in self.sensors.items()}
        self.observation_space = gym.spaces.Dict(
            {**env.observation_space.spaces, "sensors": gym.spaces.Dict(spaces)}
        )
        self._world = SensorWorld()
        self._seen = None

    def _look(self, observation):
        configuration = panda.denormalise(observation["observation"][: panda.NUM_JOINTS])
        self._world.show(self.unwrapped.scene, configuration)
        self._seen = {name: sensor.observe(self._world) for name, sensor in self.sensors.items()}

    def _with_sensors(self, observation):
        seen = {  # copies: an observation is its owner's to change
            name: {output: array.copy() for output, array in outputs.items()}
            for name, outputs in self._seen.items()
        }
        return {**observation, "sensors": seen}

    def _begin(self, observation, info):
        self._look(observation)
        return self._with_sensors(observation), info

    def reset(self, *, seed=None, options=None):
        """As `RoboArmEnv.reset`."""
        return self._begin(*self.env.reset(seed=seed, options=options))

    def reset_specific(self, start, goal, scene=None):
        """As `RoboArmEnv.reset_specific`."""
        return self._begin(*self.env.get_wrapper_attr("reset_specific")(start, goal, scene))

    def step(self, action):
        """As `RoboArmEnv.step`."""
        observation, *rest = self.env.step(action)
        if self.every_step:
            self._look(observation)
        return self._with_sensors(observation), *rest

    def close(self):
        self._world.close()
        super().close()


class _ObservingWrapper(gym.Wrapper):
    """An env with more in its observations; otherwise with all of its attributes.

    `_with_more` is given an observation of the env, and gives one of its own.
    """

    def __getattr__(self, name):
        if name == "env":  # before there is one
            raise AttributeError(name)
        return getattr(self.env, name)

    def reset(self, *, seed=None, options=None):
        """As `RoboArmEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._with_more(observation), info

    def reset_specific(self, start, goal, scene=None):
        """As `RoboArmEnv.reset_specific`."""
        observation, info = self.env.reset_specific(start, goal, scene)
        return self._with_more(observation), info

    def step(self, action):
        """As `RoboArmEnv.step`."""
        observation, *rest = self.env.step(action)
        return self._with_more(observation), *rest


class SceneEncodingWrapper(_ObservingWrapper):
    """Appends z_E, the encoded scene, to `observation` (paper, section 5.1).

    It is encoded once per scene. Otherwise this is its `RoboArmEnv`, with all of its attributes.

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

    def _with_more(self, observation):
        z = self.encoder(self.unwrapped.scene)
        return {**observation, "observation": np.concatenate([observation["observation"], z])}


class LinkDistancesWrapper(_ObservingWrapper):
    """Adds `link_distances` to the observation: how far each link is from the nearest thing.

    float32 (10, 8), a row per `envs.collision.checker.LINKS`: the distance from obstacles, table and floor
    in m, clipped to `envs.collision.checker.LINK_DISTANCE_RANGE`, and its gradient, m per unit of normalised
    configuration (zeros beyond the range). If the goal is a configuration, `goal_link_distances` is the
    same there. Otherwise this is its `RoboArmEnv`, with all of its attributes.

    Args:
        env: a `RoboArmEnv`, possibly in a `SceneEncodingWrapper`.
        geometry_source: from a `Scene` to the `CollisionChecker` that tells: `envs.perception.point_clouds.ground_truth_checker`
            or `observed_checker`.
        append: whether `observation` has `link_distances`, too: 80 numbers, before an encoded scene.
    """

    def __init__(self, env, geometry_source, append=False):
        super().__init__(env)
        self._geometry_source, self.appends_link_distances = geometry_source, append
        names = ["link_distances"] + ["goal_link_distances"] * (env.goal_type != "ee")
        # (Inside of something, a distance is at least minus the way out.)
        space = gym.spaces.Box(-np.inf, np.inf, (10, 8), np.float32)
        spaces = env.observation_space.spaces | {name: space for name in names}
        if append:
            size = spaces["observation"].shape[0] + 80
            spaces["observation"] = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.observation_space = gym.spaces.Dict(spaces)
        self._goal, self._of_goal = None, None

    def link_distances_at(self, states, scene=None):
        """What `link_distances` would be in other configurations: (..., 7) -> float32 (..., 10, 8).

        `scene`: a `Scene`, by default that of the environment.
        """
        checker = self._geometry_source(self.unwrapped.scene if scene is None else scene)
        return checker.link_distances(states)

    def _with_more(self, observation):
        seen = observation["observation"]
        more = {"link_distances": self.link_distances_at(seen[:7])}
        if self.appends_link_distances:
            size = self.unwrapped.observation_space["observation"].shape[0]
            parts = seen[:size], more["link_distances"].ravel(), seen[size:]
            more["observation"] = np.concatenate(parts)
        if self.goal_type != "ee":
            goal = observation["desired_goal"][:7]
            key = self.unwrapped.scene, goal.tobytes()
            if self._goal != key:
                self._goal, self._of_goal = key, self.link_distances_at(goal)
            more["goal_link_distances"] = self._of_goal.copy()
        return {**observation, **more}
