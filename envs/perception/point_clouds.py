"""What four point clouds see of a scene's obstacles, and collision checks against that alone.

    points = seen_points(scene)                  # float32 (n, 3), m
    checker = seen_checker(scene)                # a CollisionChecker that knows nothing else
    tokens = farthest_points(points, 64)         # for a network

The sensors (paper, section 4) tell the arm, the table and obstacles apart. The arm knows where it
is itself, and table and floor are where they always are; so only what is left is taken from them.
"""

import functools
from dataclasses import replace

import numpy as np

from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.sensors import OBSTACLE, POSE, PointCloud, SensorWorld, cardinal

CELL = 0.025
"""m. Of the points in a cube of this size, one is kept: some 1,500 on `random_boxes_hard`."""
POINT_RADIUS = 0.01
"""m. A point stands for what is around it: with this radius there is hardly a hole in a surface."""
_CACHED_SCENES, _CACHED_CHECKERS = 500, 64  # some 20 and 60 kB each
_kept = {}


@functools.cache
def _world():
    return SensorWorld()


def seen_points(scene):
    """Points of a `Scene`'s obstacles: float32 (n, 3), m, in the base's frame; not to be changed.

    There are none where no obstacle is seen. The last scenes are remembered.
    """
    points = _kept.get(scene)
    return _look(scene) if points is None else points


def keep_points(scene):
    """Remember what is seen of a `Scene`, some 20 kB, for good: it is seen again and again."""
    _kept[scene] = seen_points(scene)


@functools.lru_cache(_CACHED_SCENES)
def _look(scene):
    world = _world()
    world.show(scene, POSE)
    seen = [sensor.observe(world) for sensor in cardinal(PointCloud).values()]
    points = np.concatenate([one["points"][one["labels"] == OBSTACLE] for one in seen])
    _, kept = np.unique(np.floor(points / CELL).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(kept)]


@functools.lru_cache(_CACHED_CHECKERS)
def seen_checker(scene):
    """A `CollisionChecker` of table, floor, and what is seen of a `Scene`'s obstacles."""
    return CollisionChecker(replace(scene, obstacles=()), seen_points(scene), POINT_RADIUS)


@functools.lru_cache(_CACHED_CHECKERS)
def true_checker(scene):
    """The `CollisionChecker` of a `Scene`."""
    return CollisionChecker(scene)


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


def checker_of(source):
    """What is known of scenes: a function from a `Scene` to a `CollisionChecker`.

    Args:
        source: `obstacles`, the true ones; `points`, what four sensors see of them; or the name or
            path of an encoder with a decoder, which tells of them in z_E (`envs.perception.encoders`).

    Raises:
        ValueError: it is none of these.
    """
    if source == "obstacles":
        return true_checker
    if source == "points":
        return seen_checker
    from roboarm_nmp.envs.perception import (
        encoders,  # here, because PyTorch takes a while to import
    )

    try:
        encoders.scene_encoder(source).decoder  # noqa: B018 (or it raises)
    except ValueError as error:
        message = "what is known must be 'obstacles', 'points' or an encoder with a decoder"
        raise ValueError(f"{message}: {error}") from error
    return functools.partial(encoders.told_checker, name=source)
