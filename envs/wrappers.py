"""Wrappers that add to observations: what sensors observe, an encoded scene, link distances."""

import hashlib
import math
import warnings
from collections import deque

import gymnasium as gym
import numpy as np

from roboarm_nmp.envs.perception.noise import NO_NOISE, SensorNoise
from roboarm_nmp.envs.perception.sensors import SceneObservation, SensorWorld, cardinal
from roboarm_nmp.envs.scenes.primitives import ObservedScene


class SensorWrapper(gym.Wrapper):
    """Adds `sensors` to the observation: a dict of a sensor's name -> its observation (a dict).

    Args:
        env: a `RoboArmEnv`, possibly wrapped.
        sensors: dict of name -> sensor: an `envs.perception.sensors.Camera` or `PointCloud`, or
            any object with their `space` and `observe`; by default four cameras (`cardinal`).
        observe_every: steps from one observation to the next; None: in a static scene once per
            episode, at its start, with the arm in the start configuration (paper, appendix
            "Prediction times investigation"), otherwise in every step.
        sensor_noise: an `envs.perception.noise.SensorNoise`; None for none.

    Raises:
        ValueError: `observe_every` or `sensor_noise` is out of its range.
    """

    def __init__(self, env, sensors=None, observe_every=None, sensor_noise=None):
        super().__init__(env)
        self.sensors = cardinal(robot=env.unwrapped.robot) if sensors is None else dict(sensors)
        self._schedule = _Schedule(observe_every, sensor_noise)
        spaces = {name: sensor.space for name, sensor in self.sensors.items()}
        self.observation_space = gym.spaces.Dict(
            {**env.observation_space.spaces, "sensors": gym.spaces.Dict(spaces)}
        )
        self._world = SensorWorld(self._schedule.noise)
        self._observed = None

    def _observe(self, number):
        env = self.unwrapped
        configuration = _configuration(env) if number else env.start_configuration
        self._world.show(env.current_scene, configuration, number)
        return {name: sensor.observe(self._world) for name, sensor in self.sensors.items()}

    def _with_sensors(self, observation):
        observed = {  # copies, because the user may change an observation
            name: {output: array.copy() for output, array in outputs.items()}
            for name, outputs in self._observed.items()
        }
        return {**observation, "sensors": observed}

    def reset(self, *, seed=None, options=None):
        """As `RoboArmEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        env = self.unwrapped
        self._world.begin_episode(_key(env.start_configuration), len(self.sensors))
        self._observed = self._schedule.begin(env.scene.is_static, self._observe)
        return self._with_sensors(observation), info

    def reset_specific(self, start, goal=None, scene=None, goal_pose=None):
        """As `RoboArmEnv.reset_specific`."""
        query = {"start": start, "goal": goal, "scene": scene, "goal_pose": goal_pose}
        return self.reset(options=query)

    def step(self, action):
        """As `RoboArmEnv.step`."""
        observation, *rest = self.env.step(action)
        self._observed = self._schedule.step(self._observe)
        return self._with_sensors(observation), *rest

    def close(self):
        self._world.close()
        super().close()


class _Schedule:
    """When a wrapper observes, and when it receives what it observed.

    Arguments as of `SensorWrapper`.
    """

    def __init__(self, observe_every, sensor_noise):
        self.noise = NO_NOISE if sensor_noise is None else sensor_noise
        if not isinstance(self.noise, SensorNoise):
            raise ValueError(f"sensor_noise must be a SensorNoise or None, got {sensor_noise!r}")
        whole = isinstance(observe_every, (int, np.integer)) and not isinstance(observe_every, bool)
        if observe_every is not None and not (whole and observe_every >= 1):
            raise ValueError(f"observe_every must be at least 1 step, got {observe_every!r}")
        self.observe_every = observe_every

    def begin(self, static, observe):
        """The first observation of an episode, `observe(0)`; `static`: whether its scene is."""
        self._every = self.observe_every or (0 if static else 1)
        self._steps, self._due = 0, deque()
        self._received = observe(0)
        return self._received

    def step(self, observe):
        """The last observation received after one more step; `observe(number)` makes new ones."""
        self._steps += 1
        if self._every and self._steps % self._every == 0:
            number = self._steps // self._every
            self._due.append((self._steps + self.noise.latency, observe(number)))
        while self._due and self._due[0][0] <= self._steps:
            self._received = self._due.popleft()[1]
        return self._received


def _configuration(env):
    return env.robot.denormalise(env.world.read_arm()[0])


def _key(start):
    """Of an episode's noise, from its start (n,), rad: the same in whatever order they come."""
    return int.from_bytes(hashlib.sha256(np.float32(start).tobytes()).digest()[:8], "big")


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


class ObservedSceneWrapper(_ObservingWrapper):
    """The scene as it is observed during an episode, which encoders and geometry sources receive.

    In a static scene, without noise and without `observe_every`, that is the scene itself, of which
    encoders and geometry sources observe the arm in its robot's `observed_pose`. Otherwise the
    scene of the moment is observed with the arm where it is. Observations do not change.

    Args:
        env: a `RoboArmEnv`.
        observe_every, sensor_noise: as of a `SensorWrapper`. Noise acts on what sensors observe;
            latency also on the obstacles of the geometry source `ground_truth`.

    Raises:
        ValueError: `observe_every` or `sensor_noise` is out of its range.
    """

    def __init__(self, env, observe_every=None, sensor_noise=None):
        super().__init__(env)
        self._schedule, self._observed = _Schedule(observe_every, sensor_noise), None
        self._observes_once = observe_every is None and self._schedule.noise == NO_NOISE

    @property
    def observed_scene(self):
        """The last observation received: a `Scene`, possibly a `SceneObservation`."""
        env = self.unwrapped
        is_itself = self._observed is None or self._is_received(env.scene)
        return env.current_scene if is_itself else self._observed

    def _is_received(self, scene):
        """Whether a scene itself is received."""
        return isinstance(scene, ObservedScene) or (self._observes_once and scene.is_static)

    def observed_at_start(self, scene, start):
        """The `observed_scene` after a reset to a `Scene` and a start (n,), rad."""
        if self._is_received(scene):
            return scene.at(0.0)
        return SceneObservation.of(scene.at(0.0), start, self._schedule.noise, _key(start))

    def _observe(self, number):
        env = self.unwrapped
        start = env.start_configuration
        if number == 0:
            return self.observed_at_start(env.scene, start)
        scene, noise = env.current_scene, self._schedule.noise
        if self._is_received(env.scene):
            return scene
        return SceneObservation.of(scene, _configuration(env), noise, _key(start), number)

    def reset(self, *, seed=None, options=None):
        """As `RoboArmEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._observed = self._schedule.begin(self.unwrapped.scene.is_static, self._observe)
        return observation, info

    def step(self, action):
        """As `RoboArmEnv.step`."""
        result = self.env.step(action)
        self._observed = self._schedule.step(self._observe)
        return result


def observed_scene(env):
    """What encoders and geometry sources receive of the scene in an environment: a `Scene`."""
    try:
        return env.get_wrapper_attr("observed_scene")
    except AttributeError:  # no `ObservedSceneWrapper`
        return env.unwrapped.current_scene


class SceneEncodingWrapper(_ObservingWrapper):
    """Appends z_E, the encoded scene, to `observation` (paper, section 5.1).

    A scene is encoded once; one with moving obstacles in each step, with the arm where it is. All
    attributes of the wrapped environment are available.

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
        z = self.encoder(observed_scene(self.env))
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
        fine_geometry_source: another one for approach paths (`planning.approach_path`).
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
        return self.geometry_source(observed_scene(self.env))

    def link_distances_at(self, states, scene=None):
        """`link_distances` at normalised configurations (..., n): float32 (..., l, 1 + n).

        `scene`: a `Scene`, by default the one that is observed in the environment.
        """
        checker = self.geometry_source(observed_scene(self.env) if scene is None else scene)
        return checker.link_distances(states)

    def fine_link_distances_at(self, states):
        """As `link_distances_at`, from the geometry source for approach paths."""
        return self._fine_geometry_source(observed_scene(self.env)).link_distances(states)

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
            key = observed_scene(self.env), goal.tobytes()
            if self._goal != key:
                self._goal, self._at_goal = key, self.link_distances_at(goal)
            more["goal_link_distances"] = self._at_goal.copy()
        return {**observation, **more}
