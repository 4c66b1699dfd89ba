"""RoboArmEnv: motion planning for an arm as a goal-conditioned MDP.

Paper: sections 2 and 4, appendix "Extended NMP goal-conditioned MDP description".
"""

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from roboarm_nmp.envs.goals import GOAL_TYPES, GoalTypeName, Tolerances
from roboarm_nmp.envs.point_images import OBSERVED_COLOUR, point_image
from roboarm_nmp.envs.robots.control import SUBSTEPS, TIME_STEP
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.rotations import rotation_angle, signed
from roboarm_nmp.envs.scenes.primitives import ObservedScene, Scene, SceneDistribution, is_number
from roboarm_nmp.envs.scenes.wide_scenes.distribution import WideScene
from roboarm_nmp.envs.subgoals import MAX_STEP
from roboarm_nmp.envs.world import HOLD_STEPS, MAX_EDGE, World, image_array, why_no_window
from roboarm_nmp.utils.bullet import pybullet as p

# rad. Turned by this much, the Panda's hand, 0.21 m from flange to fingertips, is 0.02 m away.
ANGLE_TOLERANCE = 0.1
MAX_MOTION_TRIES = 1_000
HORIZON = 400
STANDARD_RULES = {"max_step": MAX_STEP, "horizon": HORIZON, "stop_on_collision": False}
"""Results under other rules are not comparable."""

Observation = dict[str, np.ndarray]


def deviations(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Those of `RoboArmEnv`'s `arguments`, a dict, that differ from `STANDARD_RULES`."""
    return {
        name: arguments[name]
        for name, rule in STANDARD_RULES.items()
        if arguments.get(name, rule) != rule
    }


def unbounded_box(*shape: int) -> gym.spaces.Box:
    """The space of float32 arrays of a shape."""
    return gym.spaces.Box(-np.inf, np.inf, shape, np.float32)


# --- What the arguments of `RoboArmEnv` may be


def _one_of(*allowed):
    def check(name, value):
        if not isinstance(value, (str, type(None))) or value not in allowed:
            words = ", ".join(map(repr, allowed))
            raise ValueError(f"{name} must be one of {words}, got {value!r}")

    return check


def check_bool(name: str, value: object) -> None:
    """Raise ValueError, with the name of the argument, unless it is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be a bool, got {value!r}")


def _positive(most=math.inf, whole=False):
    def check(name, value):
        if not (is_number(value) and value > 0):
            raise ValueError(f"{name} must be a positive number, got {value!r}")
        if value > most:
            raise ValueError(f"{name} must be at most {most}, got {value!r}")
        if whole and int(value) != value:
            raise ValueError(f"{name} must be a whole number, got {value!r}")

    return check


def _check_cost(name, value):
    if not (is_number(value) and 0 <= value < math.inf):
        raise ValueError(f"{name} must be a finite number, at least 0, got {value!r}")


def _check_image_size(name, value):
    is_pair = isinstance(value, (tuple, list, np.ndarray)) and np.shape(value) == (2,)
    if not is_pair or not all(isinstance(side, (int, np.integer)) for side in value):
        raise ValueError(f"{name} must be two numbers of pixels, got {value!r}")
    if not all(1 <= side <= MAX_EDGE for side in value):
        raise ValueError(f"{name} must be from 1 to {MAX_EDGE}, got {value!r}")


_CHECKS = {
    "goal_type": _one_of(*GOAL_TYPES),
    "action_mode": _one_of("relative", "subgoal"),
    "reward": _one_of("sparse", "dense"),
    "render_mode": _one_of(None, "rgb_array", "human"),
    "stop_on_collision": check_bool,
    "contact_cost": _check_cost,
    "sink_state": check_bool,
    "velocities": check_bool,
    # m, and L2 in the normalised space. Hardly any start is farther from its goal than these, so a
    # larger tolerance would leave no query.
    "ee_tolerance": _positive(most=1.0),
    "config_tolerance": _positive(most=2.0),
    "angle_tolerance": _positive(most=math.pi),
    "max_step": _positive(),
    "horizon": _positive(whole=True),
    "episodes_per_scene": _positive(whole=True),
    "render_size": _check_image_size,
}


class RoboArmEnv(gym.Env):
    """An arm that has to reach a goal without contact: by default the Franka Panda, n = 7 joints.

    Observations are a dict (the GoalEnv interface of Gymnasium-Robotics), all float32:

    - `observation`: normalised configuration (n), then joint velocities in normalised units per
      second (n, only with `velocities=True`), then the end-effector position in metres (3), and,
      with the goal type `pose`, its quaternion (4);
    - `achieved_goal`, `desired_goal`: `ee` the end-effector position (3, metres), `config` the
      normalised configuration (n), `combined` both, configuration first (n + 3), `pose` the
      end effector's position and quaternion (7, metres and xyzw, `Robot.end_effector_pose`).

    Actions are float32 in [-1, 1]^n: `relative`, a displacement of the normalised configuration, or
    `subgoal`, the next normalised configuration itself. Either way the displacement is clipped to
    the L2 norm `max_step`, so every longer action only says the direction.

    `info` carries `is_success`, `collision` (the arm was in contact in this step),
    `collision_so_far` (in this episode), `ee_distance` (m) and `config_distance` (normalised; NaN
    if the goal was given as a position or a pose), and `elapsed_steps`; with the goal type `pose`
    also `ee_angle` (rad, to the goal's rotation).

    Copies (`copy.deepcopy`, pickle) are independent environments in the same state: the episode
    goes on in the same way, bit for bit, and so do later ones. A copy has no window.

    Args:
        scene: a `Scene`, or a distribution of scenes: an object with `base`, the `Scene` without
            the obstacles that vary, and `sample(rng)`, which draws a `Scene` with a NumPy
            Generator (`envs.scenes.random_boxes.RandomBoxes` is one). `reset` then draws a new one.
            With `animate`, `accepts` and `check_times` (`envs.scenes.moving_boxes.MovingScenes`) it
            draws the obstacles' motions, too, for each start and goal.
        episodes_per_scene: number of resets until another scene is drawn; a reset with a seed
            always draws one.
        goal_type: `ee`, `config`, `combined` (reached like `ee`) or `pose`.
        ee_tolerance: goal radius in metres (paper: 0.02).
        angle_tolerance: rad, from the goal's rotation, for `pose`. Turning the Panda's hand, which
            is 0.21 m long, by 0.1 rad moves its fingertips by about `ee_tolerance`. (Motion Policy
            Networks, Fishman et al., 2022, use 0.26 rad and 0.01 m.)
        config_tolerance: goal radius in the normalised configuration space (paper: 0.05).
        action_mode: `relative` or `subgoal`.
        max_step: longest displacement per step, L2 in the normalised space (paper: 0.03).
        horizon: steps after which an episode is truncated (paper: 400).
        stop_on_collision: end the episode at the first contact (paper: False).
        reward: `sparse`, -1 per step and 0 on reaching the goal, or `dense`, minus the distance
            to the goal in the goal's own metric (metres for `ee` and `combined`). For `pose` that
            is the distance in metres, plus the angle times `ee_tolerance / angle_tolerance`.
        contact_cost: subtracted from the reward of each step with a contact.
        sink_state: don't terminate, but stay where the episode would have ended, with reward 0 for
            every action, until the horizon.
        velocities: add joint velocities to `observation`.
        render_mode: None, `rgb_array`, or `human` (opens PyBullet's window). With None, bodies have
            no visual shapes, which saves 50 MB: call `env.world.draw()` before you render
            `env.client` yourself.
        render_size: (width, height) of `rgb_array` images in pixels.

    Raises:
        ValueError: an argument is out of its range; the message gives the range.
        RuntimeError: a method that needs the simulator is called after `close`.
    """

    metadata = {
        "render_modes": ["rgb_array", "human"],
        "render_fps": round(1 / TIME_STEP / SUBSTEPS),
    }
    observation_space: gym.spaces.Dict

    def __init__(
        self,
        scene: Scene | SceneDistribution | None = None,
        episodes_per_scene: int = 1,
        goal_type: GoalTypeName = "ee",
        ee_tolerance: float = 0.02,
        config_tolerance: float = 0.05,
        angle_tolerance: float = ANGLE_TOLERANCE,
        action_mode: Literal["relative", "subgoal"] = "relative",
        max_step: float = MAX_STEP,
        horizon: int = HORIZON,
        stop_on_collision: bool = False,
        reward: Literal["sparse", "dense"] = "sparse",
        contact_cost: float = 0.0,
        sink_state: bool = False,
        velocities: bool = False,
        render_mode: Literal["rgb_array", "human"] | None = None,
        render_size: tuple[int, int] = (480, 360),
    ) -> None:
        arguments = locals()
        for name, check in _CHECKS.items():
            check(name, arguments[name])
        self.scene_distribution: Any = scene if hasattr(scene, "sample") else None
        """The `SceneDistribution` that scenes are drawn from; None if the scene is fixed."""
        self.episodes_per_scene = int(episodes_per_scene)
        self._episodes_in_scene = self.episodes_per_scene
        fixed: Any = scene if self.scene_distribution is None else self.scene_distribution.base
        self.is_animated = hasattr(self.scene_distribution, "animate")
        self.scene_at_rest = fixed
        """The scene that was drawn last, without motions; the task's, if it is fixed."""
        self.goal_type = goal_type
        self._goal_type = GOAL_TYPES[goal_type]
        self._tolerances = Tolerances(ee_tolerance, config_tolerance, angle_tolerance)
        self.ee_tolerance = ee_tolerance
        self.config_tolerance = config_tolerance
        self.angle_tolerance = angle_tolerance
        self.action_mode = action_mode
        self.max_step = max_step
        self.horizon = int(horizon)
        self.stop_on_collision = stop_on_collision
        self.reward = reward
        self.contact_cost = float(contact_cost)
        self.sink_state = sink_state
        self.velocities = velocities
        self.render_mode = render_mode
        self.render_size = render_size

        window = render_mode == "human"
        if window and (problem := why_no_window()):
            gym.logger.warn(f"render_mode='human' needs a display ({problem}): no window")
            window = False
        self.world = World(fixed, window, drawn=render_mode is not None)
        """The simulated `World`. Change its scene by `set_scene` of the environment."""

        joints = self.robot.num_joints
        size = self._goal_type.size(joints)
        self.observation_size = joints + self._goal_type.end_effector_size
        """Numbers in `observation`, without what wrappers append."""
        if velocities:
            self.observation_size += joints
        self.observation_space = gym.spaces.Dict(
            {
                "observation": unbounded_box(self.observation_size),
                "achieved_goal": unbounded_box(size),
                "desired_goal": unbounded_box(size),
            }
        )
        self.action_space = gym.spaces.Box(-1.0, 1.0, (joints,), np.float32)

        self.start_configuration: np.ndarray | None = None
        """Start of this episode, float32 (n,), rad; None before the first reset."""
        self.goal_configuration: np.ndarray | None = None
        """Goal of this episode, float32 (n,), rad; None if it was given as a position or pose."""

    def __getstate__(self):
        # Generators are made at their first use: here at the latest, so that copies share them.
        _ = self.np_random, self.action_space.np_random
        return vars(self).copy()

    @property
    def unwrapped(self) -> "RoboArmEnv":
        """This environment, without wrappers."""
        return self

    # --- The world

    @property
    def client(self) -> int | None:
        """PyBullet's client id of the physics engine; None after `close`."""
        return self.world.client

    @property
    def robot(self) -> Robot:
        """The scene's `Robot`."""
        return self.world.robot

    @property
    def body(self) -> int:
        """PyBullet's id of the arm's body."""
        return self.world.body

    @property
    def scene(self) -> Scene:
        """The `Scene` around the arm, with the motions of its obstacles."""
        return self.world.scene

    @property
    def time(self) -> float:
        """Seconds since the reset, of simulated time: each step is `STEP_SECONDS`, 1/30 s."""
        return self.world.time

    @property
    def current_scene(self) -> Scene:
        """The static `Scene` at this time: `scene.at(time)`."""
        return self.world.current_scene

    def set_scene(self, scene: Scene) -> None:
        """Put the arm into another `Scene`, which ends the episode. An equal scene changes nothing.

        The scene may hold the arm's other joints, such as the gripper's, elsewhere.

        Raises ValueError: the scene has another arm.
        """
        if isinstance(scene, Scene) and not scene.robot.same_arm(self.robot):
            raise ValueError(f"the scene's robot is {scene.robot.name!r}, not {self.robot.name!r}")
        if self.world.set_scene(scene):
            self.start_configuration = None

    def in_collision(
        self, configuration: np.ndarray | Sequence[float], time: float = 0.0, moving: bool = True
    ) -> bool:
        """Like `World.in_collision`. It moves the arm, so continue with a reset."""
        return self.world.in_collision(configuration, time, moving)

    def is_feasible(self, configuration: np.ndarray, hold_steps: int = HOLD_STEPS) -> bool:
        """Like `World.is_feasible`. It moves the arm, so continue with a reset."""
        return self.world.is_feasible(configuration, hold_steps)

    def sample_feasible(self, rng: np.random.Generator) -> np.ndarray:
        """Like `World.sample_feasible`. It moves the arm, so continue with a reset."""
        return self.world.sample_feasible(rng)

    def sample_query(
        self, rng: np.random.Generator, start: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw a start and a goal that is not reached there: two float32 (n,), rad.

        With `start`, only the goal is drawn.
        """
        if start is None:
            start = self.sample_end(rng)
        while True:
            goal = self.sample_end(rng)
            pair = np.stack([start, goal])
            end_effectors = self._goal_type.end_effector(self.robot, pair)
            achieved = self._goal_type.achieved(self.robot.normalise(pair), end_effectors)
            if not self._compare(*achieved)[1]:
                return start, goal

    def sample_end(self, rng: np.random.Generator) -> np.ndarray:
        """Draw a start or a goal: feasible joint angles, float32 (n,).

        It's a random configuration, or in wide scenes mostly a grasp (`envs.collision.query_ends`).
        """
        if not isinstance(self.scene, WideScene) or not self.scene.places:
            return self.sample_feasible(rng)
        # Here, because Numba takes a while to import.
        from roboarm_nmp.envs.collision.query_ends import random_ends

        while True:
            [end] = random_ends(self.scene, self.scene.places, rng, 1)
            if self.is_feasible(end):
                return end

    # --- Episodes

    def sample_scene(self, rng: np.random.Generator) -> None:
        """Draw a scene from the task's distribution, and change to it. A fixed scene stays."""
        if self.scene_distribution is not None:
            self.scene_at_rest = self.scene_distribution.sample(rng)
            self.set_scene(self.scene_at_rest)

    def sample_motions(self, start: np.ndarray, goal: np.ndarray, rng: np.random.Generator) -> bool:
        """Draw motions for the obstacles of the sampled scene, where its distribution has some.

        Args:
            start, goal: the query they are for, joint angles (n, rad).
            rng: a NumPy Generator.

        Returns:
            Whether start and goal are free when they have to be. If not, the obstacles don't move.
        """
        if not self.is_animated:
            return True
        distribution = self.scene_distribution
        # Here, because Numba takes a while to import.
        from roboarm_nmp.envs.collision.moving import free_over_time

        scene = distribution.animate(self.scene_at_rest, start, goal, rng)
        states = self.robot.normalise(np.array([start, goal]))
        if not distribution.accepts(*free_over_time(scene, states, distribution.check_times)):
            return False
        self.set_scene(scene)
        return True

    def sample_moving_query(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Like `sample_query`, with motions of the obstacles if the scene's distribution has some.

        Raises RuntimeError: the distribution accepts none of many motions.
        """
        for _ in range(MAX_MOTION_TRIES):
            if self.is_animated:
                self.set_scene(self.scene_at_rest)
            start, goal = self.sample_query(rng)
            if self.sample_motions(start, goal, rng):
                return start, goal
        raise RuntimeError(f"no motions were accepted for {MAX_MOTION_TRIES} queries")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode from a random feasible start to a random feasible goal.

        If scenes are random, a new one is drawn after `episodes_per_scene` episodes.

        Args:
            seed: an int seeds the generator of scenes and queries.
            options: with a dict of `start`, `goal` (or `goal_pose`) and possibly `scene`, the
                episode starts as with `reset_specific`, also in wrappers and vector environments.

        Raises:
            ValueError: an unknown option, one of start and goal without the other, or as for
                `reset_specific`.
        """
        self.world.check_open()
        query = _query_of(options)
        super().reset(seed=seed)
        if query is not None:
            return self.reset_specific(**query)
        if seed is not None or self._episodes_in_scene >= self.episodes_per_scene:
            self.sample_scene(self.np_random)
            self._episodes_in_scene = 0
        self._episodes_in_scene += 1
        return self._begin(*self.sample_moving_query(self.np_random))

    def reset_specific(
        self,
        start: ArrayLike,
        goal: ArrayLike | None = None,
        scene: Scene | None = None,
        goal_pose: ArrayLike | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode on a given query.

        Wrappers around this environment, such as Gymnasium's `TimeLimit`, do not notice this call.
        If you have some, use `reset(options={"start": start, "goal": goal, "scene": scene})`.

        Args:
            start: joint angles (n, rad).
            goal: joint angles (n, rad); or, with goal type `ee`, an end-effector position (3, m).
                The goal type `pose` has the pose of these joint angles as its goal.
            scene: a `Scene` to change to first.
            goal_pose: instead of `goal`, with goal type `pose`: position and quaternion (7, m and
                xyzw) of the end effector. The quaternion is normalised. There is no check
                that the arm can reach the pose.

        Raises:
            ValueError: wrong size, not finite, outside the joint limits or in collision (moving
                obstacles count at time 0, and only for the start); a quaternion of zeros; both or
                none of `goal` and `goal_pose`. A running episode then goes on (unless the scene was
                changed).
        """
        self.world.check_open()
        joints = self.robot.num_joints
        start = _vector("start", start, (joints,))
        if (goal is None) == (goal_pose is None):
            raise ValueError("either goal or goal_pose is needed, and not both")
        ends = {"start": start}
        end_effector = None  # of a goal without a configuration
        if goal_pose is not None:
            if not self._goal_type.has_rotation:
                raise ValueError(f"goal_pose is for the goal type 'pose', not {self.goal_type!r}")
            end_effector = _pose(goal_pose)
        else:
            vector = _vector("goal", goal, (joints, 3) if self.goal_type == "ee" else (joints,))
            if vector.size == joints:
                ends = {"goal": vector, "start": start}
            else:
                end_effector = vector.astype(np.float64)
        _check_limits(self.robot, "start", start)
        if "goal" in ends:
            _check_limits(self.robot, "goal", ends["goal"])
        if scene is not None:
            self.set_scene(scene)
        self.world.check_free(["goal"], **ends)  # from which obstacles may move away
        return self._begin(start, ends.get("goal"), end_effector)

    def _begin(
        self, start: np.ndarray, goal: np.ndarray | None, end_effector: Any = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode with a goal's configuration, or with its `end_effector` alone."""
        self.world.place(start)
        self.world.command(start.tolist())
        self.start_configuration = start
        self.goal_configuration = goal
        if goal is not None:
            self._goal_state = self.robot.normalise(goal)
            self._goal_end_effector = self._goal_type.end_effector(self.robot, goal)
        else:
            self._goal_state = np.full(self.robot.num_joints, np.nan)
            self._goal_end_effector = end_effector
        self._goal_position = self._goal_end_effector[:3]
        desired = self._goal_type.achieved(self._goal_state, self._goal_end_effector)
        self._desired_goal = desired.astype(np.float32)
        self._steps = 0
        self._collision_so_far = False
        self._in_sink = False
        self._read_arm()
        if self.render_mode is not None:
            self.world.mark_goal(self._goal_position, self.ee_tolerance)
        observation = self._observation()
        _, self._is_success = self._compare(observation["achieved_goal"], self._desired_goal)
        self._is_success = bool(self._is_success)
        return observation, self._info(False, self._is_success)

    def _read_arm(self):
        self._state, self._velocity, self._end_effector = self.world.read_arm(
            self.velocities, pose=self._goal_type.has_rotation
        )

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Make one step. Returns `(observation, reward, terminated, truncated, info)`.

        Raises:
            ValueError: the action is not n finite numbers. Nothing moves then.
            RuntimeError: `reset` was never called, or the environment is closed.
        """
        self.world.check_open()
        if self.start_configuration is None:
            raise RuntimeError("no episode: call reset() or reset_specific() before step()")
        action = _action(action, self.robot.num_joints)
        self._steps += 1
        if self._in_sink:
            info = self._info(False, self._is_success)
            return self._observation(), 0.0, False, self._steps >= self.horizon, info

        delta = action if self.action_mode == "relative" else action - self._state
        length = math.sqrt(delta.dot(delta))
        if length > self.max_step:
            delta = delta * (self.max_step / length)
        state = _clipped((self._state + delta).tolist())
        self.world.command(self.robot.denormalise_one(state))
        collision = self.world.simulate()
        if self.world.has_window:
            time.sleep(TIME_STEP * SUBSTEPS)  # as long as the simulated time
        self._collision_so_far = self._collision_so_far or collision
        self._read_arm()

        observation = self._observation()
        goals = observation["achieved_goal"], self._desired_goal
        self._is_success = bool(self._compare(*goals)[1])
        info = self._info(collision, self._is_success)
        reward = float(self.compute_reward(*goals, info))
        ended = self._is_success or (self.stop_on_collision and collision)
        self._in_sink = self.sink_state and ended
        terminated = ended and not self.sink_state
        return observation, reward, terminated, self._steps >= self.horizon and not terminated, info

    def _observation(self):
        observation = np.empty(self.observation_size, np.float32)
        joints = len(self._state)
        observation[:joints] = self._state
        observation[-len(self._end_effector) :] = self._end_effector
        if self.velocities:
            observation[joints : 2 * joints] = self._velocity
        achieved = self._goal_type.achieved(self._state, self._end_effector)
        return {
            "observation": observation,
            "achieved_goal": achieved.astype(np.float32),
            "desired_goal": self._desired_goal.copy(),
        }

    def _info(self, collision, is_success):
        to_goal = self._end_effector[:3] - self._goal_position
        to_goal_state = self._state - self._goal_state
        info = {
            "is_success": is_success,
            "collision": collision,
            "collision_so_far": self._collision_so_far,
            "ee_distance": math.sqrt(to_goal.dot(to_goal)),
            "config_distance": math.sqrt(to_goal_state.dot(to_goal_state)),
            "elapsed_steps": self._steps,
        }
        if self._goal_type.has_rotation:
            angle = rotation_angle(self._end_effector[3:], self._goal_end_effector[3:])
            info["ee_angle"] = float(angle)
        return info

    # --- The goal-conditioned MDP on batches (for relabelling)

    def _compare(self, achieved_goal, desired_goal):
        """The distance between goals in their own metric, and whether one reaches the other."""
        goals = np.asarray(achieved_goal), np.asarray(desired_goal)
        return self._goal_type.compare(*goals, self._tolerances)

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> np.ndarray:
        """Reward of arriving at `achieved_goal` (..., d) when the goal is `desired_goal` (..., d).

        Returns an array of the batch shape, or a NumPy scalar for single goals. With `contact_cost`
        it reads `collision` in `info`, as `compute_terminated` does. `step` uses it, too.
        """
        distance, reached = self._compare(achieved_goal, desired_goal)
        reward = -distance if self.reward == "dense" else reached.astype(np.float32) - np.float32(1)
        if self.contact_cost > 0:
            reward = reward - np.float32(self.contact_cost) * _entry(info, "collision", bool)
        return reward

    def compute_terminated(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> np.ndarray:
        """Whether an episode ends there: bool, of the batch shape; a NumPy scalar for single goals.

        `info` is one info dict (entries may be arrays), or a sequence of them as long as the
        batch. With `stop_on_collision`, its `collision` also ends the episode; where it is missing,
        it counts as False.
        """
        _, ended = self._compare(achieved_goal, desired_goal)
        if self.stop_on_collision:
            ended = ended | _entry(info, "collision", bool)
        return ended & (not self.sink_state)

    def compute_truncated(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> np.ndarray:
        """Whether the horizon truncates the episode there: as `compute_terminated`.

        It also reads `elapsed_steps` in `info`; where it is missing, it counts as 0.
        """
        late = _entry(info, "elapsed_steps", int) >= self.horizon
        return late & ~self.compute_terminated(achieved_goal, desired_goal, info)

    # --- Images

    def render(self) -> np.ndarray | None:
        """Render arm, scene and goal: with `rgb_array`, a uint8 image (height, width, 3).

        Points of an `ObservedScene` are orange.
        """
        self.world.check_open()
        if self.render_mode != "rgb_array":
            return None
        width, height = self.render_size
        view = p.computeViewMatrixFromYawPitchRoll((0.15, 0.0, 0.3), 2.1, 55, -28, 0, 2)
        projection = p.computeProjectionMatrixFOV(50, width / height, 0.1, 10.0)
        _, _, pixels, depth, _ = p.getCameraImage(
            width,
            height,
            view,
            projection,
            lightDirection=(1.0, 1.0, 2.5),
            renderer=p.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        image = image_array(pixels, width, height)
        if isinstance(self.scene, ObservedScene):
            cloud = self.scene.points, self.scene.point_radius, OBSERVED_COLOUR
            points = point_image([cloud], view, projection, self.render_size)
            image, _ = points.over(image, np.reshape(depth, (height, width)))
        return image

    def close(self) -> None:
        """Disconnect from PyBullet. Closing twice is allowed."""
        self.world.close()


def _query_of(options):
    """The arguments of `reset_specific` in `reset`'s options; None if there are none."""
    if options is None:
        return None
    if not isinstance(options, dict):
        raise ValueError(f"options must be a dict, got {options!r}")
    if not options:
        return None
    if unknown := options.keys() - {"start", "goal", "scene", "goal_pose"}:
        raise ValueError(
            f"unknown options {sorted(unknown)}: known are 'start', 'goal', 'scene' and 'goal_pose'"
        )
    if "start" not in options or not {"goal", "goal_pose"} & options.keys():
        raise ValueError(f"options must have both 'start' and 'goal', got {list(options)}")
    return options


def _action(action, num_joints):
    """An action as float64 (n,), clipped. Raises ValueError, with the reason, if it is none."""
    try:
        array = np.asarray(action)
    except (TypeError, ValueError, RuntimeError) as error:  # a list in a list, a tensor
        if hasattr(action, "detach"):  # a tensor with a gradient, or on a GPU
            return _action(action.detach().cpu().numpy(), num_joints)
        reason = f"{action!r}, no NumPy array: {error}"
        raise _no_action(num_joints, reason) from error
    if np.ma.isMaskedArray(action):
        raise _no_action(num_joints, f"a masked array: {action!r}")
    if array.dtype.kind not in "fiub":
        raise _no_action(num_joints, f"dtype {array.dtype}: {action!r}")
    if array.shape != (num_joints,):
        raise _no_action(num_joints, f"shape {array.shape}: {action!r}")
    numbers = array.tolist()
    if not math.isfinite(sum(numbers)) and not np.isfinite(array).all():  # a sum may overflow
        raise _no_action(num_joints, repr(action))
    return np.array(_clipped(numbers), dtype=np.float64)


def _no_action(num_joints, reason):
    return ValueError(f"an action is {num_joints} finite numbers in [-1, 1], got {reason}")


def _clipped(numbers):
    """A list of a few numbers, each clipped to [-1, 1]: several times as fast as `np.clip`."""
    if max(numbers) <= 1.0 and min(numbers) >= -1.0:
        return numbers
    return [min(max(number, -1.0), 1.0) for number in numbers]


def checked_configuration(robot: Robot, name: str, configuration: ArrayLike) -> np.ndarray:
    """Joint angles as float32 (n,), rad.

    Raises ValueError, with the name: wrong size, not finite, or outside the joint limits.
    """
    configuration = _vector(name, configuration, (robot.num_joints,))
    _check_limits(robot, name, configuration)
    return configuration


def _check_limits(robot, name, configuration):
    # float32 may round a limit to just beyond it.
    distances = [abs(number) for number in robot.normalise(configuration).tolist()]
    if max(distances) > 1.0 + 1e-6:
        joint = next(joint for joint, value in enumerate(distances) if value > 1.0 + 1e-6)
        raise ValueError(
            f"{name} is outside the joint limits: joint {joint + 1} is "
            f"{configuration[joint]:.4f} rad, limits {robot.lower[joint]} to "
            f"{robot.upper[joint]}"
        )


_LARGEST = float(np.finfo(np.float32).max)


def _vector(name, value, sizes):
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers, got {value!r}: {error}") from error
    if vector.ndim != 1 or vector.size not in sizes:
        expected = " or ".join(str(size) for size in sizes)
        raise ValueError(f"{name} must have {expected} numbers, got shape {vector.shape}")
    # (Lists of a few numbers are quicker than NumPy.) 1e200 is infinite as float32.
    if not sum(map(abs, vector.tolist())) <= _LARGEST:
        raise ValueError(f"{name} must be finite, got {vector}")
    return vector.astype(np.float32)


def _pose(value):
    """A pose as float64 (7,), its quaternion normalised, its largest component positive."""
    pose = _vector("goal_pose", value, (7,)).astype(np.float64)
    norm = np.linalg.norm(pose[3:])
    if norm < 1e-6:
        raise ValueError(f"goal_pose: its quaternion is zero, got {value!r}")
    return np.concatenate([pose[:3], signed(pose[3:] / norm)])


def _entry(info, key, dtype):
    """One entry of an info dict, or of a sequence of info dicts, as an array."""
    if isinstance(info, dict):
        return np.asarray(info.get(key, 0), dtype=dtype)
    return np.array([each.get(key, 0) for each in info], dtype=dtype)
