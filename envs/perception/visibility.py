"""Which space the four sensors see: what they do not see may be occupied.

are_seen(scene, points)                # bool (n,)
unseen_points(scene, states)           # on the boundary of what is not seen, for collision checks
unobserved_share(scene, states)        # of a motion
"""

import functools

import numpy as np

from roboarm_nmp.envs.collision.distance_field import DistanceField
from roboarm_nmp.envs.perception.point_clouds import are_near_arm, sensor_images
from roboarm_nmp.envs.perception.ray_kernels import mark_seen, next_to_seen
from roboarm_nmp.envs.perception.sensors import SceneObservation, view_of
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
    for sensor, depth, _ in sensor_images(scene, None):
        view = view_of(sensor, sensor.size)
        mark_seen(points, view, depth, TOLERANCE, seen)
    hidden = ~seen
    seen[hidden] = are_near_arm(points[hidden], scene.robot, _observed(scene), ARM_DISTANCE)
    return seen


def _observed(scene):
    """The normalised configuration of the arm when a scene was observed: (1, n)."""
    of_observation = isinstance(scene, SceneObservation)
    configuration = scene.configuration if of_observation else scene.robot.observed_pose
    return np.clip(scene.robot.normalise([configuration]), -1.0, 1.0)


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
    places, cells, numbers = _places(scene.robot.arm)
    chosen = next_to_seen(are_seen(scene, places), cells, numbers)
    points = places[chosen].astype(np.float32)
    return points[~are_near_arm(points, scene.robot, states, ARM_DISTANCE)]


@functools.lru_cache(8)
def _places(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres of cubes in a robot's reach, m, (k, 3); `places`, `numbers` of `next_to_seen`."""
    scale = scale_of(robot)
    half = int(_REACH / UNSEEN_CELL) + 1  # (a cube farther, so that each place has six around it)
    along = np.arange(-half, half + 1) * UNSEEN_CELL
    places = np.stack(np.meshgrid(along, along, along, indexing="ij"), -1)
    in_reach = np.linalg.norm(places, axis=-1) <= _REACH
    cells = np.argwhere(in_reach)
    numbers = np.full(in_reach.shape, -1, np.int32)
    numbers[in_reach] = np.arange(len(cells))
    places = scale * (places[in_reach] + _SHOULDER) + np.array(robot.base_position)
    return places, cells, numbers


def unobserved_share(scene: Scene, states: np.ndarray) -> float:
    """The share of an arm's motion that passes through space that no sensor sees, in [0, 1].

    It is measured at the centres of the arm's spheres (`envs.collision.distance_field`).

    Args:
        scene: as for `are_seen`.
        states: normalised configurations (m, n).
    """
    centres = DistanceField(scene.robot).centres(states)
    return float(1.0 - are_seen(scene, centres.reshape(-1, 3)).mean())
