"""The point cloud that four sensors observe of a scene's obstacles.

    points = observed_points(scene)              # float32 (n, 3), m
    tokens = farthest_points(points, 64)         # for a network

The sensors (paper, section 4) label points of the arm, the table and obstacles. The arm's own
configuration, the table and the floor are known, so only points of obstacles are used.
"""

import functools

import numpy as np

from roboarm_nmp.envs.perception.sensors import OBSTACLE, PointCloud, cardinal, observe_scene
from roboarm_nmp.envs.robots.panda import scale_of

POINT_CLOUD = "point_cloud"
"""Its name as an encoder and as a geometry source."""
NUM_POINTS = 64
"""Of the encoder `point_cloud`, by default."""
CELL = 0.025
"""m. One point of each cube of this size is used: about 1,500 on `random_boxes_hard`. For an arm of
another reach than the Panda's, it is scaled, and so is `POINT_RADIUS`."""
POINT_RADIUS = 0.01
"""m. The ball around a point in collision checks: with this radius surfaces have hardly a hole."""
FINE_CELL, FINE_POINT_RADIUS = 0.006, 0.005
"""The same for approach paths, which lead closer to surfaces: more points, smaller balls."""
CACHED_SCENES = 500  # about 20 kB each
_remembered = {}  # scene -> points


def observed_points(scene):
    """Points of a `Scene`'s obstacles: float32 (n, 3), m, in the base's frame; not to be changed.

    One per cube of `CELL`; none, (0, 3), where no obstacle is visible. The last scenes are cached.
    """
    points = _remembered.get(scene)
    return _observe(scene) if points is None else points


def remember_points(scene):
    """Keep the observed points of a `Scene` in memory, about 20 kB, until the process ends."""
    _remembered[scene] = observed_points(scene)


def fine_observed_points(scene):
    """As `observed_points`, one per cube of `FINE_CELL`."""
    return one_per_cell(_clouds(scene), scale_of(scene.robot) * FINE_CELL)


@functools.lru_cache(CACHED_SCENES)
def _observe(scene):
    return one_per_cell(_clouds(scene), scale_of(scene.robot) * CELL)


@functools.lru_cache(1)  # 500 kB; the coarse and the fine points of a scene are needed together
def _clouds(scene):
    clouds = observe_scene(scene, cardinal(PointCloud, scene.robot)).values()
    return np.concatenate([one["points"][one["labels"] == OBSTACLE] for one in clouds])


def one_per_cell(points, cell=CELL):
    """The first of the points (n, 3), m, in each cube with edges of `cell`, m, in their order.

    Use it with points of your own: the pretrained policies were trained with such clouds.
    """
    _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def farthest_points(points, number):
    """`number` points by farthest point sampling (Eldar et al., 1997): float32 (number, 3).

    The first is the one farthest from the base. Where there are fewer points, the rest are zeros:
    no obstacle can be where the base is.
    """
    chosen = np.zeros((number, 3), np.float32)
    distance = np.full(len(points), np.inf)
    nearest = np.linalg.norm(points, axis=1)
    for row in chosen[: len(points)]:
        row[:] = points[nearest.argmax()]
        distance = np.minimum(distance, np.linalg.norm(points - row, axis=1))
        nearest = distance
    return chosen
