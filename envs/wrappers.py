"""Wrappers that add to observations: what sensors observe, an encoded scene, link distances."""

import hashlib
import math
import warnings
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from roboarm_nmp.envs.arm_env import Observation, RoboArmEnv, unbounded_box
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.envs.perception.noise import NO_NOISE, SensorNoise
from roboarm_nmp.envs.perception.sensors import SceneObservation, SensorWorld, cardinal
from roboarm_nmp.envs.scenes.primitives import ObservedScene, Scene

if TYPE_CHECKING:  # they import PyTorch and Numba, which takes seconds
    from roboarm_nmp.envs.collision.checker import CollisionChecker
    from roboarm_nmp.envs.perception.encoders import SceneEncoder
    from roboarm_nmp.envs.perception.geometry_source import GeometrySource


class ArmWrapper(gym.Wrapper):
    """An environment with additional observations, and all other attributes of the wrapped one.

    `_extend` maps an observation of the wrapped environment to one of this.
    """

    observation_space: gym.spaces.Dict

    @property
    def unwrapped(self) -> RoboArmEnv:
        """The `RoboArmEnv` in all wrappers."""
        return super().unwrapped  # pyright: ignore[reportReturnType]

    def __getattr__(self, name: str) -> Any:
        # `env` is missing while a copy is made. Python asks for special methods of copies, too.
        if name == "env" or name.startswith("__"):
            raise AttributeError(name)
        return self.env.get_wrapper_attr(name)

    def _extend(self, observation: Observation) -> Observation:
        return observation

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """As `RoboArmEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._extend(observation), info

    def reset_specific(
        self,
        start: ArrayLike,
        goal: ArrayLike | None = None,
        scene: Scene | None = None,
        goal_pose: ArrayLike | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """As `RoboArmEnv.reset_specific`."""
        query = {"start": start, "goal": goal, "scene": scene, "goal_pose": goal_pose}
        return self.reset(options=query)

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """As `RoboArmEnv.step`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._extend(observation), float(reward), terminated, truncated, info


class SensorWrapper(ArmWrapper):
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

    def __init__(
        self,
        env: gym.Env,
        sensors: Mapping[str, Any] | None = None,
        observe_every: int | None = None,
        sensor_noise: SensorNoise | None = None,
    ) -> None:
        super().__init__(env)
        self.sensors = cardinal(robot=self.unwrapped.robot) if sensors is None else dict(sensors)
        self._schedule = _Schedule(observe_every, sensor_noise)
        spaces = dict(_spaces(env))
        spaces["sensors"] = gym.spaces.Dict(
            {name: sensor.space for name, sensor in self.sensors.items()}
        )
        self.observation_space = gym.spaces.Dict(spaces)
        self._world = SensorWorld(self._schedule.noise)
        self._observed: dict[str, Observation] = {}

    def _observe(self, number):
        env = self.unwrapped
        configuration = _configuration(env) if number else env.start_configuration
        assert configuration is not None  # there was a reset
        self._world.show(env.current_scene, configuration, number)
        return {name: sensor.observe(self._world) for name, sensor in self.sensors.items()}

    def _extend(self, observation):
        observed = {  # copies, because the user may change an observation
            name: {output: array.copy() for output, array in outputs.items()}
            for name, outputs in self._observed.items()
        }
        return {**observation, "sensors": observed}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """As `RoboArmEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        env = self.unwrapped
        self._world.begin_episode(_key(env.start_configuration), len(self.sensors))
        self._observed = self._schedule.begin(env.scene.is_static, self._observe)
        return self._extend(observation), info

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """As `RoboArmEnv.step`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._observed = self._schedule.step(self._observe)
        return self._extend(observation), float(reward), terminated, truncated, info

    def close(self) -> None:
        self._world.close()
        super().close()


class _Schedule:
    """When a wrapper observes, and when it receives what it observed.

    Arguments as of `SensorWrapper`.
    """

    def __init__(self, observe_every: int | None, sensor_noise: SensorNoise | None) -> None:
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


def _spaces(env: Any) -> dict[str, Any]:
    """The spaces of an environment's observations, by name."""
    return env.observation_space.spaces


class ObservedSceneWrapper(ArmWrapper):
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

    def __init__(
        self,
        env: gym.Env,
        observe_every: int | None = None,
        sensor_noise: SensorNoise | None = None,
    ) -> None:
        super().__init__(env)
        self._schedule = _Schedule(observe_every, sensor_noise)
        self._observed: Scene | None = None
        self._observes_once = observe_every is None and self._schedule.noise == NO_NOISE

    @property
    def observed_scene(self) -> Scene:
        """The last observation received: a `Scene`, possibly a `SceneObservation`."""
        env = self.unwrapped
        if self._observed is None or self._is_received(env.scene):
            return env.current_scene
        return self._observed

    def _is_received(self, scene):
        """Whether a scene itself is received."""
        return isinstance(scene, ObservedScene) or (self._observes_once and scene.is_static)

    def observed_at_start(self, scene: Scene, start: np.ndarray) -> Scene:
        """The `observed_scene` after a reset to a `Scene` and a start (n,), rad."""
        if self._is_received(scene):
            return scene.at(0.0)
        return SceneObservation.of(scene.at(0.0), start, self._schedule.noise, _key(start))

    def _observe(self, number):
        env = self.unwrapped
        start = env.start_configuration
        assert start is not None  # there was a reset
        if number == 0:
            return self.observed_at_start(env.scene, start)
        scene, noise = env.current_scene, self._schedule.noise
        if self._is_received(env.scene):
            return scene
        return SceneObservation.of(scene, _configuration(env), noise, _key(start), number)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """As `RoboArmEnv.reset`."""
        result = super().reset(seed=seed, options=options)
        self._observed = self._schedule.begin(self.unwrapped.scene.is_static, self._observe)
        return result

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """As `RoboArmEnv.step`."""
        result = super().step(action)
        self._observed = self._schedule.step(self._observe)
        return result


def observed_scene(env: gym.Env) -> Scene:
    """What encoders and geometry sources receive of the scene in an environment: a `Scene`."""
    try:
        return env.get_wrapper_attr("observed_scene")
    except AttributeError:  # no `ObservedSceneWrapper`
        return env.get_wrapper_attr("current_scene")


class SceneEncodingWrapper(ArmWrapper):
    """Appends z_E, the encoded scene, to `observation` (paper, section 5.1).

    A scene is encoded once; one with moving obstacles in each step, with the arm where it is. All
    attributes of the wrapped environment are available.

    Args:
        env: a `RoboArmEnv`.
        encoder: an `envs.perception.encoders.SceneEncoder`; several environments may share it.
    """

    def __init__(self, env: gym.Env, encoder: "SceneEncoder") -> None:
        super().__init__(env)
        self.encoder = encoder
        spaces = dict(_spaces(env))
        spaces["observation"] = unbounded_box(spaces["observation"].shape[0] + encoder.size)
        self.observation_space = gym.spaces.Dict(spaces)

    def _extend(self, observation):
        z = self.encoder(observed_scene(self.env))
        return {**observation, "observation": np.concatenate([observation["observation"], z])}


class LinkDistancesWrapper(ArmWrapper):
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
        env: gym.Env,
        geometry_source: "GeometrySource",
        append: bool = False,
        goal_link_distances: bool = True,
        fine_geometry_source: "GeometrySource | None" = None,
    ) -> None:
        super().__init__(env)
        self.geometry_source = geometry_source
        self.appends_link_distances = append
        self._fine_geometry_source = fine_geometry_source or geometry_source
        has_configuration = GOAL_TYPES[env.get_wrapper_attr("goal_type")].has_configuration
        self._of_goals = goal_link_distances and has_configuration
        shape = self.unwrapped.robot.link_distances_shape
        spaces = dict(_spaces(env))
        spaces["link_distances"] = unbounded_box(*shape)
        if self._of_goals:
            spaces["goal_link_distances"] = unbounded_box(*shape)
        if append:
            size = spaces["observation"].shape[0]
            spaces["observation"] = unbounded_box(size + math.prod(shape))
        self.observation_space = gym.spaces.Dict(spaces)
        self._goal = None  # the scene and the goal of `_at_goal`
        self._at_goal = np.empty(0)

    def current_checker(self) -> "CollisionChecker":
        """The `CollisionChecker` of what is observed now; the same as long as nothing changes."""
        return self.geometry_source(observed_scene(self.env))

    def link_distances_at(self, states: np.ndarray, scene: Scene | None = None) -> np.ndarray:
        """`link_distances` at normalised configurations (..., n): float32 (..., l, 1 + n).

        `scene`: a `Scene`, by default the one that is observed in the environment.
        """
        checker = self.geometry_source(observed_scene(self.env) if scene is None else scene)
        return checker.link_distances(states)

    def fine_link_distances_at(self, states: np.ndarray) -> np.ndarray:
        """As `link_distances_at`, from the geometry source for approach paths."""
        return self._fine_geometry_source(observed_scene(self.env)).link_distances(states)

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> np.ndarray:
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
        inner = observation["observation"]
        joints = self.unwrapped.robot.num_joints
        distances = self.link_distances_at(inner[:joints])
        extended = {**observation, "link_distances": distances}
        if self.appends_link_distances:
            size = self.unwrapped.observation_size
            parts = inner[:size], distances.ravel(), inner[size:]
            extended["observation"] = np.concatenate(parts)
        if self._of_goals:
            goal = observation["desired_goal"][:joints]
            key = observed_scene(self.env), goal.tobytes()
            if self._goal != key:
                self._goal = key
                self._at_goal = self.link_distances_at(goal)
            extended["goal_link_distances"] = self._at_goal.copy()
        return extended
