"""Which space the four sensors see: what they do not see may be occupied.

are_seen(scene, points)                # bool (n,)
unseen_points(scene, states)           # on the boundary of what is not seen, for collision checks
unobserved_share(scene, states)        # of a motion
"""

import functools
from typing import NamedTuple

import numpy as np

from roboarm_nmp.envs.collision.distance_field import DistanceField
from roboarm_nmp.envs.perception.point_clouds import are_near_arm, sensor_images
from roboarm_nmp.envs.perception.ray_kernels import mark_seen, next_to_seen, pixels_of_points
from roboarm_nmp.envs.perception.sensors import (
    PointCloud,
    SceneObservation,
    cardinal,
    view_of,
)
from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import ObservedScene, Scene

TOLERANCE = 0.02
"""m: a point so far behind a visible surface counts as seen."""
UNSEEN_CELL = 0.03
"""m, for the Panda: one point of each cube of this size stands for space that is not seen."""
_SHOULDER, _REACH = np.array([0.0, 0.0, 0.333]), 0.95  # m, of the Panda; they scale with the arm
ARM_DISTANCE = 0.03
"""m: so much around an arm that is known to have room counts as seen."""


def are_seen(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Whether one of the four sensors of a `Scene` sees each point: bool (n,).

    Args:
        scene: what is observed, once, with the arm in its `observed_pose` (or, of a
            `SceneObservation`, where it is).
        points: m, (n, 3), in the base's frame.
    """
    points = np.require(points, np.float64, ("C", "W"))
    seen = np.zeros(len(points), np.bool_)
    _mark_seen(scene, *_sights(scene.robot, points), seen)
    hidden = ~seen
    of_observation = isinstance(scene, SceneObservation)
    configuration = scene.configuration if of_observation else scene.robot.observed_pose
    seen[hidden] = _are_near(points[hidden], scene.robot, configuration)
    return seen


def _mark_seen(scene, pixels, ahead, seen):
    """Mark which points a sensor of a `Scene` sees, from their `_sights`."""
    for i, (_, depth, _) in enumerate(sensor_images(scene, None)):
        mark_seen(pixels[i], ahead[i], depth.ravel(), TOLERANCE, seen)


def _sights(robot, points):
    """`pixels` and `ahead` of `pixels_of_points`, of each sensor: (4, n)."""
    sensors = cardinal(PointCloud, robot).values()
    pixels = np.empty((len(sensors), len(points)), np.int32)
    ahead = np.empty(pixels.shape)
    for i, sensor in enumerate(sensors):
        width, height = sensor.size
        view = view_of(sensor, sensor.size)
        pixels_of_points(points, view, width, height, pixels[i], ahead[i])
    return pixels, ahead


def _are_near(points, robot, configuration):
    """Which points (n, 3), m, are in or around the arm at joint angles (n, rad): bool (n,)."""
    state = np.clip(robot.normalise([configuration]), -1.0, 1.0)
    return are_near_arm(points, robot, state, ARM_DISTANCE)


def unseen_points(scene: Scene, states: np.ndarray) -> np.ndarray:
    """Points on the boundary of the space that no sensor sees: float32 (n, 3), m.

    There is one in each cube of `UNSEEN_CELL` in the arm's reach that is not seen, if a neighbour
    is. Of an `ObservedScene`, nothing is known of what was seen: none.

    Args:
        scene: as for `are_seen`.
        states: normalised configurations (m, n), for example start and goal, in which the arm has
            room: there are no points within `ARM_DISTANCE` of it.
    """
    if isinstance(scene, ObservedScene):
        return np.empty((0, 3), np.float32)
    places = _places(scene.robot)
    if isinstance(scene, SceneObservation):
        seen = are_seen(scene, places.centres)
    else:
        seen = places.are_near.copy()
        _mark_seen(scene, places.pixels, places.ahead, seen)
    chosen = next_to_seen(seen, places.cells, places.sizes)
    points = places.centres[chosen].astype(np.float32)
    return points[~are_near_arm(points, scene.robot, states, ARM_DISTANCE)]


class _Places(NamedTuple):
    """Cubes in a robot's reach, and what is the same in every scene.

    centres: float64 (k, 3), m.
    cells, sizes: of `next_to_seen`.
    pixels, ahead: of `_sights`.
    are_near: bool (k,), of the arm in its `observed_pose`.
    """

    centres: np.ndarray
    cells: np.ndarray
    sizes: tuple[int, ...]
    pixels: np.ndarray
    ahead: np.ndarray
    are_near: np.ndarray


@functools.lru_cache(2)  # 10 MB each
def _places(robot: Robot) -> _Places:
    scale = scale_of(robot)
    half = int(_REACH / UNSEEN_CELL) + 1  # (a cube farther, so that each place has six around it)
    along = np.arange(-half, half + 1) * UNSEEN_CELL
    places = np.stack(np.meshgrid(along, along, along, indexing="ij"), -1)
    in_reach = np.linalg.norm(places, axis=-1) <= _REACH
    centres = scale * (places[in_reach] + _SHOULDER) + np.array(robot.base_position)
    are_near = _are_near(centres, robot, robot.observed_pose)
    cells = np.flatnonzero(in_reach).astype(np.int32)
    return _Places(centres, cells, in_reach.shape, *_sights(robot, centres), are_near)


def unobserved_share(scene: Scene, states: np.ndarray) -> float:
    """The share of an arm's motion that passes through space that no sensor sees, in [0, 1].

    It is measured at the centres of the arm's spheres (`envs.collision.distance_field`).

    Args:
        scene: as for `are_seen`.
        states: normalised configurations (m, n).
    """
    centres = DistanceField(scene.robot).centres(states)
    return float(1.0 - are_seen(scene, centres.reshape(-1, 3)).mean())
