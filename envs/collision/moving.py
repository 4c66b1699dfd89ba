"""Moving obstacles as arrays: where they are at any time, and how fast they move. Compiled.

    from roboarm_nmp.envs.collision.moving import MovingObstacles

    moving = MovingObstacles(env.unwrapped.scene)
    now = moving.at(env.unwrapped.time)               # `ObstacleStates`, a row per obstacle
    soon = moving.at(env.unwrapped.time + np.arange(30) / 30)   # of 30 times, (30, n, ...)

Row i is `scene.obstacles[i]`, present or not. The obstacles of `scene.at(t)` are the present ones:
number j there is row `np.flatnonzero(now.present)[j]`.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from roboarm_nmp.envs.collision.hulls import (
    group_points,
    shape_centres,
    shape_rows,
    world_shapes,
)
from roboarm_nmp.envs.collision.motion_kernels import free_batch
from roboarm_nmp.envs.collision.moving_kernels import (
    AMPLITUDE,
    ANGLE,
    AXIS,
    FREQUENCY,
    INTERVALS,
    OWN_COLUMNS,
    PHASE,
    REPEAT,
    WAYPOINTS,
    moved_rows,
    obstacle_states,
)
from roboarm_nmp.envs.scenes.motions import REPEATS, Oscillation, Presence, Waypoints
from roboarm_nmp.envs.scenes.numbers import IDENTITY
from roboarm_nmp.envs.scenes.primitives import Scene, to_array


class ObstacleStates(NamedTuple):
    """The n obstacles of a scene at times of shape (...).

    Attributes:
        present: bool (..., n).
        position: m, (..., n, 3).
        orientation: quaternions (..., n, 4), x, y, z, w.
        velocity: m/s, (..., n, 3), of the position. A point at an offset r from it moves at
            `velocity + np.cross(angular_velocity, r)`.
        angular_velocity: rad/s, (..., n, 3), in the base's frame.
    """

    present: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray


class MovingObstacles:
    """The obstacles of a `Scene` over time; those without a motion stand still.

    Attributes:
        motions, centres, shapes: the arrays that `moving_kernels.moved_rows` takes, for checks in a
            loop over time. (`hulls.world_shapes` has convex hulls' bodies, and who may touch what.)
    """

    def __init__(self, scene: Scene):
        self.motions = motion_arrays(scene.obstacles)
        self.centres = shape_centres(scene.obstacles)
        self.shapes = shape_rows(scene.obstacles)

    def at(self, times: ArrayLike) -> ObstacleStates:
        """`ObstacleStates` at times (s), a number or an array. Raises ValueError: not finite."""
        times = np.asarray(times, dtype=np.float64)
        if not np.isfinite(times).all():
            raise ValueError("times must be finite numbers of seconds")
        shape = *times.shape, len(self.motions[0])
        flat = np.ascontiguousarray(times.reshape(-1))
        present = np.empty(shape, np.bool_)
        poses = np.empty((*shape, 7))
        velocities = np.empty((*shape, 6))
        obstacle_states(
            self.motions,
            flat,
            present.reshape(len(flat), -1),
            poses.reshape(len(flat), -1, 7),
            velocities.reshape(len(flat), -1, 6),
        )
        return ObstacleStates(
            present, poses[..., :3], poses[..., 3:], velocities[..., :3], velocities[..., 3:]
        )


def motion_arrays(obstacles: Sequence) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The motions of n obstacles as the compiled functions take them (`moving_kernels`).

    Returns: float64 (n, `OWN_COLUMNS`), waypoints (w, 8), intervals (i, 2).
    """
    rows = np.zeros((len(obstacles), OWN_COLUMNS))
    waypoints, intervals = [], []
    for row, numbers, obstacle in zip(rows, to_array(obstacles), obstacles, strict=True):
        row[:AMPLITUDE] = numbers[1:8]
        motion = obstacle.motion
        row[INTERVALS] = len(intervals)
        if isinstance(motion, Presence):
            intervals += motion.intervals
            motion = motion.motion
        row[INTERVALS + 1] = len(intervals)
        row[WAYPOINTS] = len(waypoints)
        if isinstance(motion, Oscillation):
            row[AMPLITUDE:FREQUENCY] = motion.amplitude
            row[FREQUENCY] = 2 * math.pi / motion.period
            row[PHASE] = motion.phase
            row[AXIS:ANGLE] = motion.axis
            row[ANGLE] = motion.angle
        elif isinstance(motion, Waypoints):
            rotations = motion.rotations or (IDENTITY,) * len(motion.times)
            for waypoint in zip(motion.times, motion.displacements, rotations, strict=True):
                time, displacement, rotation = waypoint
                waypoints.append((time, *displacement, *rotation))
            row[REPEAT] = REPEATS.index(motion.repeat)
        row[WAYPOINTS + 1] = len(waypoints)
    return rows, np.reshape(waypoints, (-1, 8)), np.reshape(intervals, (-1, 2))


def free_over_time(scene: Scene, states: ArrayLike, times: Sequence[float]) -> np.ndarray:
    """Whether configurations are free of a scene's moving obstacles.

    Args:
        scene: a `Scene`. Its table, its floor and obstacles without a motion do not count.
        states: normalised configurations (m, n).
        times: s, (t,).

    Returns:
        bool (m, t).
    """
    moving = replace(scene, obstacles=[o for o in scene.obstacles if o.motion is not None])
    rows, arm = world_shapes(moving.obstacles, scene.robot)
    obstacles, shapes = MovingObstacles(moving), rows.copy()
    world = rows, *group_points((), 0.0)
    rule, no_endpoints = np.zeros(4), np.empty((1, 0, scene.robot.num_joints + 1))
    states = np.ascontiguousarray(states, float)
    free = np.empty((len(times), len(states)), bool)
    for t, answers in zip(times, free, strict=True):
        moved_rows(obstacles.motions, obstacles.centres, shapes, t, rows)
        free_batch(states, rule, no_endpoints, arm, world, answers)
    return free.T
