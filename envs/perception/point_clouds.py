"""The point cloud that four sensors observe of a scene's obstacles.

    points = observed_points(scene)              # float32 (n, 3), m
    tokens = farthest_points(points, 64)         # for a network

The sensors (paper, section 4) label points of the arm, the table and obstacles. The arm's own
configuration, the table and the floor are known, so only points of obstacles are used.
"""

import functools

import numpy as np

from roboarm_nmp.envs.perception.sensors import OBSTACLE, POSE, PointCloud, SensorWorld, cardinal

POINT_CLOUD = "point_cloud"
"""Its name as an encoder and as a geometry source."""
NUM_POINTS = 64
"""Of the encoder `point_cloud`, by default."""
CELL = 0.025
"""m. Of the points in a cube of this size, one is kept: some 1,500 on `random_boxes_hard`."""
POINT_RADIUS = 0.01
"""m. A point stands for what is around it: with this radius there is hardly a hole in a surface."""
_CACHED_SCENES = 500  # about 20 kB each
_kept = {}


@functools.cache
def _world():
    return SensorWorld()


def observed_points(scene):
    """Points of a `Scene`'s obstacles: float32 (n, 3), m, in the base's frame; not to be changed.

    There are none where no obstacle is seen. The last scenes are remembered.
    """
    points = _kept.get(scene)
    return _look(scene) if points is None else points


def remember_points(scene):
    """Keep the observed points of a `Scene`, about 20 kB, as long as the process lives."""
    _kept[scene] = observed_points(scene)


@functools.lru_cache(_CACHED_SCENES)
def _look(scene):
    world = _world()
    world.show(scene, POSE)
    seen = [sensor.observe(world) for sensor in cardinal(PointCloud).values()]
    points = np.concatenate([one["points"][one["labels"] == OBSTACLE] for one in seen])
    _, kept = np.unique(np.floor(points / CELL).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(kept)]


def farthest_points(points, number):
    """`number` points by farthest point sampling (Eldar et al., 1997): float32 (number, 3).

    The first is the one farthest from the base. Where there are fewer points, the rest are zeros:
    the base is there, so an obstacle is not.
    """
    chosen = np.zeros((number, 3), np.float32)
    distance = np.full(len(points), np.inf)
    nearest = np.linalg.norm(points, axis=1)
    for row in chosen[: len(points)]:
        row[:] = points[nearest.argmax()]
        distance = np.minimum(distance, np.linalg.norm(points - row, axis=1))
        nearest = distance
    return chosen
