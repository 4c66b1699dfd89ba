"""Collision checks and distances, compiled: hundreds of thousands of configurations a second.

    from roboarm_nmp.envs.collision.checker import CollisionChecker

    checker = CollisionChecker(scene)
    checker.is_free(states)                  # normalised (n, 7) -> bool (n,)
    checker.is_motion_free(starts, ends)     # straight motions, checked every `RESOLUTION`
    checker.signed_distances(states)                  # per link: how far, which way is out, from what
    checker.link_distances(states)                # the same as observations have it, and quicker

The shapes are PyBullet's, so the answers are those of `RoboArmEnv.in_collision`, but no PyBullet
world is moved. They are: the convex hulls of the links' collision meshes, `BULLET_MARGIN` thicker
on all sides; boxes and cylinders, with edges rounded by as much; spheres; the table and the floor;
and `panda.SELF_COLLISION_PAIRS`. As in PyBullet, the base touches nothing but the arm itself. How
often the two disagree: docs/benchmarks.md.

Two shapes are looked at in three stages, each only if the one before could not tell them apart: the
link's bounding sphere against the box around the obstacle; the link's bounding box against that
box, by their faces; then GJK (Gilbert, Johnson, Keerthi, 1988) on the shapes themselves, which
stops as soon as it knows on which side of the margin their distance is. Where shapes overlap,
`nearest` needs the depth, which EPA (van den Bergen, 2001) finds.

The functions below are compiled by Numba when they are first called, once per machine
(docs/environment.md, "Collision checks"). They compute in float64, and an answer does not depend on
the batch in which it was asked for.
"""

import functools
import math
from typing import NamedTuple

import numpy as np

from roboarm_nmp.envs import panda
from roboarm_nmp.envs.collision.hulls import MAX_MARGIN, arm_hulls, group_points, shape_rows
from roboarm_nmp.envs.collision.kernels import (
    free_batch,
    link_distances_batch,
    motion,
    motion_batch,
    signed_distances_batch,
)
from roboarm_nmp.envs.scenes.primitives import Scene, floor_box

NUM_LINKS = len(panda.COLLISION_LINKS)
RESOLUTION = 0.021
"""Motions are checked at points at most this far apart, L2 in the normalised space: less than one
step of the arm (0.03)."""
LINK_DISTANCE_RANGE = 0.3
"""m. In observations, things farther away than that are as good as none."""
NOTHING, TABLE, FLOOR, ARM, POINT = -1, -2, -3, -4, -5
"""What `SignedDistances.geometry` says where it is not the index of an obstacle."""


class SignedDistances(NamedTuple):
    """How near each of `panda.COLLISION_LINKS` is to something, for a batch of configurations of shape (...).

    Attributes:
        distance: m, (..., 10); negative in a collision: minus the way that the link, or what it
            hits, has to be moved. Infinite where there is nothing.
        direction: unit vectors (..., 10, 3), in the base's frame: which way is out, the way to move
            the link to get away. Zeros where there is nothing.
        point: m, (..., 10, 3), in the base's frame: the point of the link's hull that is nearest,
            or deepest. Zeros where there is nothing.
        gradient: m per unit of normalised configuration, (..., 10, 7): how `distance` changes with
            each joint. Zeros where there is nothing.
        thing: (..., 10): the index of an obstacle, or `TABLE`, `FLOOR`, `ARM` (another link),
            `POINT` (one of the points), `NOTHING`.
    """

    distance: np.ndarray
    direction: np.ndarray
    point: np.ndarray
    gradient: np.ndarray
    thing: np.ndarray


class CollisionChecker:
    """Collisions of the arm with a scene and with itself.

    States are normalised configurations, shape (..., 7), floats in [-1, 1]; an answer has the
    batch's shape, (...), and is empty for an empty batch. Safe to use from several threads.

    Args:
        scene: a `Scene`.
        points: m, (n, 3), in the base's frame: balls that are there, too, such as the points of
            obstacles that a sensor saw.
        point_radius: m, theirs, in [0, `MAX_MARGIN`).

    Raises:
        TypeError: the scene is none.
        ValueError: an obstacle, the table or the floor has a size that is not positive, or numbers
            that are not finite; so with the points. Of all methods: states of another shape, not
            finite, or outside the limits; a margin out of its range.
    """

    def __init__(self, scene, points=(), point_radius=0.0):
        if not isinstance(scene, Scene):
            raise TypeError(
                f"a scene must be an roboarm_nmp.envs.scenes.primitives.Scene, got {scene!r}"
            )
        self.scene = scene
        shapes, things = list(scene.obstacles), list(range(len(scene.obstacles)))
        if scene.table is not None:
            shapes.append(scene.table)
            things.append(TABLE)
        if scene.floor is not None:
            shapes.append(floor_box(scene.floor))
            things.append(FLOOR)
        self._things = np.array([*things, ARM, POINT, NOTHING])
        self._world = shape_rows(shapes), *group_points(points, point_radius)

    def is_free(self, states, margin=0.0, clearance=0.0, endpoint_margins=None):
        """Whether the arm is at least `margin` away from everything: bool (...).

        Without a margin, it is free where `RoboArmEnv.in_collision` says that it does not collide.

        Args:
            states: (..., 7), normalised.
            margin: m, in [0, `MAX_MARGIN`): from the scene, and between the links.
            clearance: m, in [0, `MAX_MARGIN`): from the scene, in addition.
            endpoint_margins: None, or `(states (k, 7), distances (k,), growth)`. Near these states the
                margin is smaller: `distance + growth * d` at most, where d is how far away they are
                (L2, normalised). For queries that begin or end nearer to something than `margin`.
                Each configuration, or motion, may have its own: (..., k, 7) and (..., k).
        """
        states = _states("states", states)
        free = np.empty(states.shape[:-1], dtype=np.bool_)
        rule = _rule(margin, clearance, endpoint_margins, batch=states.shape[:-1])
        free_batch(states.reshape(-1, 7), *rule, arm_hulls(), self._world, free.reshape(-1))
        return free

    def is_motion_free(
        self,
        starts,
        ends,
        margin=0.0,
        clearance=0.0,
        endpoint_margins=None,
        resolution=RESOLUTION,
        ends_known=False,
    ):
        """Whether straight motions are free: bool (...).

        Checked are both ends, then points between them that are no more than `resolution` apart:
        first in the middle, then in the middle of each half, and so on, until one is not free.

        Args:
            starts, ends: (..., 7), normalised; one may be broadcast to the other.
            margin, clearance, endpoint_margins: as for `is_free`.
            resolution: L2, normalised, > 0.
            ends_known: both ends are known to be free, and not looked at.
        """
        arguments = starts, ends, margin, clearance, endpoint_margins, resolution, ends_known
        return self.motion_checks(*arguments) >= 0

    def motion_checks(
        self,
        starts,
        ends,
        margin=0.0,
        clearance=0.0,
        endpoint_margins=None,
        resolution=RESOLUTION,
        ends_known=False,
    ):
        """How many configurations `is_motion_free` looks at, int64 (...); negative: not free."""
        starts, ends = np.broadcast_arrays(_states("starts", starts), _states("ends", ends))
        rule = _rule(margin, clearance, endpoint_margins, resolution, batch=starts.shape[:-1])
        checks = np.empty(starts.shape[:-1], dtype=np.int64)
        flat = [np.ascontiguousarray(x.reshape(-1, 7)) for x in (starts, ends)]
        motion_batch(*flat, *rule, arm_hulls(), self._world, ends_known, checks.reshape(-1))
        return checks

    def motion_checker(
        self, margin=0.0, clearance=0.0, endpoint_margins=None, resolution=RESOLUTION
    ):
        """For planners, which ask for one motion at a time: a function of two tuples of 7 floats.

        It is `motion_checks` for one motion from a start that is known to be free, which is not
        looked at again; and it does not look at its arguments.
        """
        rule, endpoint_margins = _rule(margin, clearance, endpoint_margins, resolution)
        return functools.partial(motion, rule, endpoint_margins[0], arm_hulls(), self._world, False)

    def signed_distances(self, states, self_collisions=True, within=math.inf):
        """How far each of `panda.COLLISION_LINKS` is from the nearest thing, and which way is out: a `SignedDistances`.

        Args:
            states: (..., 7), normalised.
            self_collisions: whether other links are things, too (`panda.SELF_COLLISION_PAIRS`).
            within: m; nothing is said of what is farther away than that.
        """
        states = _states("states", states)
        batch = (*states.shape[:-1], NUM_LINKS)
        distance, which = np.empty(batch), np.empty(batch, dtype=np.int64)
        direction, point = np.empty((*batch, 3)), np.empty((*batch, 3))
        gradient = np.empty((*batch, panda.NUM_JOINTS))
        signed_distances_batch(
            states.reshape(-1, 7),
            bool(self_collisions),
            float(within),
            arm_hulls(),
            self._world,
            distance.reshape(-1, NUM_LINKS),
            direction.reshape(-1, NUM_LINKS, 3),
            point.reshape(-1, NUM_LINKS, 3),
            gradient.reshape(-1, NUM_LINKS, panda.NUM_JOINTS),
            which.reshape(-1, NUM_LINKS),
        )
        return SignedDistances(distance, direction, point, gradient, self._things[which])

    def link_distances(self, states, self_collisions=False, within=LINK_DISTANCE_RANGE):
        """`link_distances` as `envs.wrappers.LinkDistancesWrapper` has it: float32 (..., 10, 8).

        A row per one of `panda.COLLISION_LINKS`: `SignedDistances.distance` in m, clipped to `within`, and
        `SignedDistances.gradient`, in m per unit of normalised configuration.

        Args:
            states: (..., 7), normalised; beyond the limits, which an arm may be a little, it is
                that of the limits.
            self_collisions, within: as for `nearest`.
        """
        states = _numbers("states", states)
        rows = np.empty((*states.shape[:-1], NUM_LINKS, 8), dtype=np.float32)
        flat = states.reshape(-1, 7), rows.reshape(-1, NUM_LINKS, 8)
        if not link_distances_batch(
            *flat, bool(self_collisions), float(within), arm_hulls(), self._world
        ):
            raise ValueError("states must be normalised configurations, not NaN")
        return rows


def _numbers(name, states):
    """Configurations as a contiguous float64 array. Raises ValueError."""
    try:
        states = np.asarray(states)
        if states.dtype.kind not in "fiu":
            raise TypeError(f"they are of type {states.dtype}")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers of shape (..., 7)") from error
    if states.shape[-1:] != (panda.NUM_JOINTS,):
        raise ValueError(f"{name} must have shape (..., 7), got {states.shape}")
    return np.ascontiguousarray(states, dtype=np.float64)


def _states(name, states):
    """Normalised configurations as a contiguous float64 array. Raises ValueError."""
    states = _numbers(name, states)
    # float32 may round a limit to just beyond it. NaN is not at most anything.
    if states.size and not np.abs(states).max() <= 1.0 + 1e-6:
        raise ValueError(f"{name} must be normalised configurations: finite, in [-1, 1]")
    return states


def _rule(margin, clearance, endpoint_margins, resolution=RESOLUTION, batch=()):
    """What is asked for, as the compiled functions take it. Raises ValueError.

    Returns float64 (4,): margin, clearance, growth, resolution; and (n, k, 8): states and distances
    for each of a batch, or n = 1 for all of it.
    """
    for name, value in (("margin", margin), ("clearance", clearance)):
        if not 0 <= value < MAX_MARGIN:
            raise ValueError(f"{name} must be in [0, {MAX_MARGIN}) m, got {value!r}")
    if not 0 < resolution < math.inf:
        raise ValueError(f"resolution must be positive, got {resolution!r}")
    if endpoint_margins is None:
        return np.array([margin, clearance, 0.0, resolution]), np.empty((1, 0, 8))
    states, distances, growth = endpoint_margins
    states = _states("endpoint_margins states", states)
    distances = np.asarray(distances, dtype=np.float64)
    fits = states.ndim == 2 or (states.ndim > 2 and states.shape[:-2] == batch)
    if not fits or distances.shape != states.shape[:-1] or np.isnan(distances).any():
        raise ValueError(f"endpoint_margins: {states.shape} states and {distances.shape} distances")
    if not 0 <= growth < math.inf:
        raise ValueError(
            f"endpoint_margins: growth must be finite and not negative, got {growth!r}"
        )
    endpoint_margins = np.concatenate([states, distances[..., None]], axis=-1)
    endpoint_margins = endpoint_margins.reshape(
        -1 if states.ndim > 2 else 1, *endpoint_margins.shape[-2:]
    )
    return np.array([margin, clearance, growth, resolution]), endpoint_margins
