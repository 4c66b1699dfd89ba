"""Which space the four sensors see: what they do not see may be occupied.

are_seen(scene, points)                # bool (n,)
unobserved_share(scene, states)        # of a motion
"""

import math

import numpy as np

from roboarm_nmp.envs.collision.distance_field import DistanceField
from roboarm_nmp.envs.perception.ray_casting import ROBOT
from roboarm_nmp.envs.perception.ray_kernels import AXES
from roboarm_nmp.envs.perception.sensors import PointCloud, cardinal, view_of, world_of
from roboarm_nmp.envs.scenes.primitives import Scene

TOLERANCE = 0.02
"""m: a point so far behind a visible surface counts as seen."""
ARM_THICKNESS = 0.2
"""m: behind the arm's visible surface, so much is the arm itself, whose place is known."""


def are_seen(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Whether one of the four sensors of a `Scene` sees each point: bool (n,).

    Args:
        scene: what is observed, once, with the arm in its `observed_pose` (or, of a
            `SceneObservation`, where it is).
        points: m, (n, 3), in the base's frame.
    """
    sensors = cardinal(PointCloud, scene.robot).values()
    world = world_of(scene, len(sensors))
    seen = np.zeros(len(points), np.bool_)
    for sensor in sensors:
        depth, classes = world.cast(sensor, sensor.size)
        width, height = sensor.size
        right, up, forward = view_of(sensor, sensor.size)[AXES : AXES + 9].reshape(3, 3)
        half = math.tan(math.radians(sensor.field_of_view) / 2)
        away = points - np.array(sensor.eye)
        ahead = away @ forward
        in_front = ahead > sensor.near
        scaled = 1.0 / (np.where(in_front, ahead, 1.0) * half)
        column = np.floor((1.0 + away @ right * scaled * height / width) / 2 * width).astype(int)
        row = np.floor((1.0 - away @ up * scaled) / 2 * height).astype(int)
        inside = in_front & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        row, column = row[inside], column[inside]
        behind = np.where(classes[row, column] == ROBOT, ARM_THICKNESS, TOLERANCE)
        seen[inside] |= ahead[inside] <= depth[row, column] + behind
    return seen


def unobserved_share(scene: Scene, states: np.ndarray) -> float:
    """The share of an arm's motion that passes through space that no sensor sees, in [0, 1].

    It is measured at the centres of the arm's spheres (`envs.collision.distance_field`).

    Args:
        scene: as for `are_seen`.
        states: normalised configurations (m, n).
    """
    centres = DistanceField(scene.robot).centres(states)
    return float(1.0 - are_seen(scene, centres.reshape(-1, 3).astype(np.float64)).mean())
