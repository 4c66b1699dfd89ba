"""Random scenes whose obstacles move, appear, or stand where the goal is.

A scene is drawn in two steps. `sample` draws boxes at rest (`envs.scenes.random_boxes`); start and
goal of an episode are drawn among them. `animate` then draws motions for this start and goal, and
`accepts` says whether they make sense: the start is free in the first second, and the goal when it
has to be.

Times and positions are multiples of `envs.scenes.random_boxes.GRID`: on every machine the scenes of
a seed are the same.

The paper proposes policies for scenes with changing obstacles (section 1), and has no such task.
The ranges were fixed before any policy was measured. For an arm other than the Panda, lengths and
speeds are multiplied by the ratio of their reaches.
"""

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.motions import CYCLIC, Oscillation, Presence, Waypoints
from roboarm_nmp.envs.scenes.numbers import Vector
from roboarm_nmp.envs.scenes.primitives import Box, Obstacle, Scene
from roboarm_nmp.envs.scenes.random_boxes import (
    FRICTION,
    KEEP_CLEAR,
    RandomBoxes,
    Rng,
    distance_to_robot,
    rounded,
)

DURATION = 400 * STEP_SECONDS
"""s, of the longest episode (paper: 400 steps)."""
START_FREE = 1.0
"""s: until then the start is free."""
SPEED = 0.03 / STEP_SECONDS  # of the arm, normalised, per second (paper: 0.03 per step)

# Boxes oscillate, mostly horizontally.
AMPLITUDE = (0.1, 0.3)  # m
RISE = 0.3  # share of upward amplitudes
# Boxes appear, nowhere near an arm on the straight way to its goal: then, and until `AHEAD` (s)
# later, its joints and the middles between them are at least `ROOM` (m) away.
APPEARING = 0.5  # share of the boxes
APPEARS = (0.3, 3.0)  # s
AHEAD = (0.0, 0.25, 0.5)
ROOM = 0.15
# A visitor is a box at the goal.
VISITOR = (0.08, 0.16)  # m, edges
OFF_CENTRE = 0.02  # m, from the goal
VISITOR_SPEED = (0.15, 0.35)  # m/s
WAY = (0.5, 0.7)  # m, how far it goes, outwards and upwards
# Of `BlockedGoals`, s.
LEAVES = (2.0, 6.0)
FREE_FROM = 8.0
# Of `ChasedGoals`, s.
STAYS = (0.5, 1.5)
STAYS_AWAY = (2.0, 4.0)
FREE_SHARE = 0.4  # of the time, at least
BLOCKED_FOR = 5.0  # s without a break, at most
TRIES = 50


@dataclass(frozen=True)
class MovingScenes(abc.ABC):
    """What the distributions of this file share.

    Attributes:
        base: the `Scene` without the obstacles that vary.
        boxes: (fewest, most) boxes around the arm.
        check_times: s, (t,), at which `accepts` needs to know whether start and goal are free.
    """

    base: Scene = Scene(friction=FRICTION)
    boxes: tuple[int, int] = (4, 8)  # as in `random_boxes_hard`
    check_times = np.arange(0.0, DURATION, 0.1)

    def sample(self, rng: Rng) -> Scene:
        """A `Scene` at rest, drawn with a NumPy Generator."""
        return RandomBoxes(*self.boxes, self.base).sample(rng)

    @abc.abstractmethod
    def animate(self, scene: Scene, start: np.ndarray, goal: np.ndarray, rng: Rng) -> Scene:
        """The scene with motions, drawn for a start and a goal (n,), rad."""

    def accepts(self, start_free: np.ndarray, goal_free: np.ndarray) -> bool:
        """Whether start and goal are free when they have to be: bool (t,), at `check_times`."""
        return self._starts(start_free) and bool(goal_free.all())

    def _starts(self, start_free: np.ndarray) -> bool:
        return bool(start_free[self.check_times <= START_FREE].all())


@dataclass(frozen=True)
class MovingBoxes(MovingScenes):
    """A share of the boxes oscillates. The goal is free at all times.

    Attributes:
        share: of the boxes, rounded to a whole number of them.
        periods: s, (shortest, longest).
    """

    share: float = 0.5
    periods: tuple[float, float] = (3.0, 8.0)

    def animate(self, scene: Scene, start: np.ndarray, goal: np.ndarray, rng: Rng) -> Scene:
        boxes = list(scene.obstacles)
        scale = scale_of(scene.robot)
        for i in _choose(boxes, self.share, rng):
            for _ in range(TRIES):
                motion = self._oscillation(rng, scale)
                if _stays_clear(boxes[i], motion, scale):
                    boxes[i] = replace(boxes[i], motion=motion)
                    break
        return replace(scene, obstacles=boxes)

    def _oscillation(self, rng: Rng, scale: float) -> Oscillation:
        direction = rng.normal(size=3) * (1.0, 1.0, RISE)
        length = scale * rng.uniform(*AMPLITUDE) / np.linalg.norm(direction)
        amplitude = rounded(*(length * direction))
        period = rng.uniform(*self.periods)
        phase = rng.uniform(0.0, 2 * math.pi)
        return Oscillation(amplitude, *rounded(period, phase))


@dataclass(frozen=True)
class AppearingBoxes(MovingScenes):
    """Half of the boxes appear in the first seconds. The goal is free at all times."""

    def animate(self, scene: Scene, start: np.ndarray, goal: np.ndarray, rng: Rng) -> Scene:
        boxes = list(scene.obstacles)
        robot = scene.robot
        first, last = robot.normalise(np.array([start, goal]))
        duration = np.linalg.norm(last - first) / SPEED

        def arm_points(times: np.ndarray) -> np.ndarray:
            """The joints, the end effector, and the middles between them: (n, 3), m."""
            shares = np.minimum(times / duration, 1.0)[:, None]
            configurations = robot.denormalise(first + shares * (last - first))
            points = [position for position, _ in robot.frame_poses(configurations)]
            points = np.array([*points, robot.forward_kinematics(configurations)])
            return np.concatenate([*points, *(points[1:] + points[:-1]) / 2])

        for i in _choose(boxes, APPEARING, rng):
            for _ in range(TRIES):
                (appears,) = rounded(rng.uniform(*APPEARS))
                apart = _distances(boxes[i], arm_points(appears + np.array(AHEAD)))
                if apart.min() >= ROOM * scale_of(robot):
                    boxes[i] = replace(boxes[i], motion=Presence(((appears, math.inf),)))
                    break
        return replace(scene, obstacles=boxes)


@dataclass(frozen=True)
class BlockedGoals(MovingScenes):
    """A box stands at the goal, and leaves after some seconds. The goal is free from then on."""

    boxes: tuple[int, int] = (3, 6)  # as in `random_boxes_medium`

    def animate(self, scene: Scene, start: np.ndarray, goal: np.ndarray, rng: Rng) -> Scene:
        box, away, duration = _visitor(scene.robot, goal, rng)
        (leaves,) = rounded(rng.uniform(*LEAVES))
        motion = Waypoints((leaves, leaves + duration), ((0.0, 0.0, 0.0), away))
        return replace(scene, obstacles=(*scene.obstacles, replace(box, motion=motion)))

    def accepts(self, start_free: np.ndarray, goal_free: np.ndarray) -> bool:
        later = goal_free[self.check_times >= FREE_FROM]
        return self._starts(start_free) and bool(not goal_free[0] and later.all())


@dataclass(frozen=True)
class ChasedGoals(MovingScenes):
    """One or two boxes visit the goal again and again."""

    boxes: tuple[int, int] = (3, 6)

    def animate(self, scene: Scene, start: np.ndarray, goal: np.ndarray, rng: Rng) -> Scene:
        visitors = []
        for _ in range(rng.integers(1, 3)):
            box, away, duration = _visitor(scene.robot, goal, rng)
            first, stays, stays_away = rounded(
                rng.uniform(0.0, STAYS_AWAY[1]), rng.uniform(*STAYS), rng.uniform(*STAYS_AWAY)
            )
            times = np.cumsum([first, duration, stays, duration, stays_away])
            here = (0.0, 0.0, 0.0)
            motion = Waypoints(tuple(times), (away, here, here, away, away), repeat=CYCLIC)
            visitors.append(replace(box, motion=motion))
        return replace(scene, obstacles=(*scene.obstacles, *visitors))

    def accepts(self, start_free: np.ndarray, goal_free: np.ndarray) -> bool:
        changes = np.flatnonzero(np.diff(np.concatenate([[True], goal_free, [True]])))
        longest = np.diff(changes)[::2].max(initial=0) * self.check_times[1]
        often = FREE_SHARE <= goal_free.mean() < 1.0 and longest <= BLOCKED_FOR
        return self._starts(start_free) and bool(often)


def _choose(boxes: Sequence[Obstacle], share: float, rng: Rng) -> np.ndarray:
    """The indices of a share of the boxes, at random."""
    return rng.permutation(len(boxes))[: round(share * len(boxes))]


def _stays_clear(box: Box, motion: Oscillation, scale: float) -> bool:
    """Whether an oscillating box stays away from the robot's base."""
    for share in np.linspace(-1.0, 1.0, 9):
        position = tuple(np.add(box.position, share * np.array(motion.amplitude)))
        if distance_to_robot(replace(box, position=position), scale) < KEEP_CLEAR * scale:
            return False
    return True


def _distances(box: Box, points: np.ndarray) -> np.ndarray:
    """Distances (m) of points (n, 3) from an upright box."""
    sin = 2 * box.orientation[2] * box.orientation[3]
    cos = 1 - 2 * box.orientation[2] ** 2
    apart = points - box.position
    local = apart @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return np.linalg.norm(np.maximum(np.abs(local) - np.divide(box.size, 2), 0.0), axis=1)


def _visitor(robot: Robot, goal: np.ndarray, rng: Rng) -> tuple[Box, Vector, float]:
    """A box at the goal, how it goes away (m, and the time it takes, s)."""
    scale = scale_of(robot)
    position = robot.forward_kinematics(goal)
    size = rounded(*(scale * rng.uniform(*VISITOR, 3)))
    centre = rounded(*(position + scale * rng.uniform(-OFF_CENTRE, OFF_CENTRE, 3)))
    # Away from the robot's axis, within 60 degrees, and up to 45 degrees upwards.
    azimuth = math.atan2(position[1], position[0]) + rng.uniform(-1.0, 1.0) * math.pi / 3
    elevation = rng.uniform(0.0, math.pi / 4)
    way = scale * rng.uniform(*WAY)
    level = way * math.cos(elevation)
    away = rounded(level * math.cos(azimuth), level * math.sin(azimuth), way * math.sin(elevation))
    (duration,) = rounded(way / (scale * rng.uniform(*VISITOR_SPEED)))
    return Box(centre, size), away, duration
