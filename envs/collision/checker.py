"""Compiled collision checks and signed distances: hundreds of thousands of configurations a second.

    from roboarm_nmp.envs.collision.checker import CollisionChecker

    checker = CollisionChecker(scene)
    checker.is_free(states)                  # normalised (m, n) -> bool (m,)
    checker.is_motion_free(starts, ends)     # straight motions, checked every `RESOLUTION`
    checker.signed_distances(states)         # `SignedDistances`, a row per link
    checker.link_distances(states)           # as in observations, and faster

The shapes are PyBullet's, so the answers are those of `RoboArmEnv.in_collision`, without a PyBullet
world. The shapes are: the convex hulls of the links' collision meshes, and of obstacles,
`BULLET_MARGIN` thicker on all sides; boxes and cylinders, with edges rounded by as much, but sharp
between two boxes; spheres; the table and the floor. Of links, the robot's `self_collision_pairs`
are checked. As in PyBullet, the base collides only with the arm itself. An obstacle is not there
for links in its `may_touch`. Objects attached to the arm belong to the links that carry them, with
self-collision pairs of their own. How often the two disagree: docs/benchmark/performance.md.

Two shapes are compared in three stages, each only if the one before could not separate them: the
link's bounding sphere against the box around the obstacle; the link's bounding box against that
box, by their faces; then GJK (Gilbert, Johnson, Keerthi, 1988) on the shapes themselves, which
stops as soon as their distance is certain to be above or below the margin. Where shapes overlap,
`signed_distances` needs the depth, which EPA (van den Bergen, 2001) computes.

Numba compiles the functions in files called `…_kernels` at their first call, once per machine
(docs/guide/environment.md, "Collision checks"). They compute in float64, and an answer does not
depend on the batch around it.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from roboarm_nmp.envs.collision.continuous_kernels import clear_batch
from roboarm_nmp.envs.collision.distance_kernels import (
    end_distances,
    link_distances_batch,
    signed_distances_batch,
)
from roboarm_nmp.envs.collision.edge_kernels import first_free, motion_batch, single_motion
from roboarm_nmp.envs.collision.grid_kernels import distance_grid
from roboarm_nmp.envs.collision.hulls import MAX_MARGIN, group_points, world_shapes
from roboarm_nmp.envs.collision.motion_kernels import free_batch
from roboarm_nmp.envs.collision.search_kernels import plan_path
from roboarm_nmp.envs.collision.spheres import block_arm, grid_reach
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes import primitives
from roboarm_nmp.envs.scenes.primitives import POINT_RADIUS, Box, ObservedScene, Scene, floor_box

RESOLUTION = 0.021
"""Motions are checked at points at most this far apart, L2 in the normalised space: less than one
step of the arm (0.03)."""
REACH = 0.6
"""L2, normalised: the longest edge of `CollisionChecker.find_path`'s trees."""
LINK_DISTANCE_RANGE = 0.3
"""m. Observed link distances are clipped to this, and beyond it their gradient is zero."""
NOTHING, TABLE, FLOOR, ARM, POINT = -1, -2, -3, -4, -5
"""Values of `SignedDistances.geometry` that are not the index of an obstacle."""
NO_GRID = np.empty(0, np.float32), np.zeros(3, np.int64), np.zeros(4, np.float32)
EndpointMargins = tuple[ArrayLike, ArrayLike, float]
"""Smaller margins around endpoints: see `CollisionChecker.is_free`."""


class SignedDistances(NamedTuple):
    """Signed distances of each of a robot's `collision_links`, for configurations of shape (...).

    The l links of a configuration have a row each; the Panda has 10. Where nothing is in range, the
    distance is infinite, and normal, witness and gradient are zeros.

    Attributes:
        distance: m, (..., l), from the nearest geometry; in a collision, minus the depth.
        normal: unit vectors (..., l, 3), in the base's frame, along which the link moves away.
        witness: m, (..., l, 3), in the base's frame: the nearest or deepest point of the link's
            hull.
        gradient: m per unit of normalised configuration, (..., l, n): the derivative of `distance`
            with respect to each joint.
        geometry: int64 (..., l): the index of an obstacle, or `TABLE`, `FLOOR`, `ARM` (another
            link), `POINT` (one of the points), `NOTHING`.
    """

    distance: np.ndarray
    normal: np.ndarray
    witness: np.ndarray
    gradient: np.ndarray
    geometry: np.ndarray


class Rules(NamedTuple):
    """What paths keep clear, for `CollisionChecker.search`: r rules, each from some check on.

    begins: int64 (r,): the numbers of checks from which on they hold; the first is 0.
    numbers: float64 (r, 4): margin and clearance (m), growth of the endpoint margins, resolution.
    endpoints: float64 (r, k, n + 1): endpoint margins: states, normalised, and distances, m.
    """

    begins: np.ndarray
    numbers: np.ndarray
    endpoints: np.ndarray


class CollisionChecker:
    """Checks the arm for collisions with a scene and with itself.

    States are normalised configurations, shape (..., n), floats in [-1, 1]. An answer has the
    batch's shape, (...). You can use one checker from several threads.

    Args:
        scene: a static `Scene`, whose robot has n joints.
        points: m, (n, 3), in the base's frame: the centres of additional balls, for example of an
            observed point cloud. An `ObservedScene` brings its own points and radius.
        point_radius: m, of the balls, in [0, `MAX_MARGIN`).

    Raises:
        TypeError: `scene` is not a `Scene`.
        ValueError: an obstacle has a motion; an obstacle, the table, the floor or a point has
            numbers that are not finite, or a size that is not positive. From all methods: states of
            another shape, not finite, or outside the limits; a margin out of its range.
    """

    def __init__(self, scene: Scene, points: ArrayLike = (), point_radius: float = 0.0):
        if not isinstance(scene, Scene):
            raise TypeError(
                f"a scene must be a roboarm_nmp.envs.scenes.primitives.Scene, got {scene!r}"
            )
        if not scene.is_static:
            raise ValueError("obstacles of this scene move: check scene.at(t), at a time t")
        self.scene = scene
        self.robot = scene.robot
        if isinstance(scene, ObservedScene):
            points, point_radius = scene.points, scene.point_radius
        shapes = list(scene.obstacles)
        if scene.table is not None:
            shapes.append(scene.table)
        if scene.floor is not None:
            shapes.append(floor_box(scene.floor))
        rows, self._arm = world_shapes(shapes, scene.robot)
        self._world = rows, *group_points(points, point_radius)

    @functools.cached_property
    def _geometries(self):
        """What `SignedDistances.geometry` calls the shapes, by row."""
        geometries = list(range(len(self.scene.obstacles)))
        if self.scene.table is not None:
            geometries.append(TABLE)
        if self.scene.floor is not None:
            geometries.append(FLOOR)
        return np.array([*geometries, ARM, POINT, NOTHING])

    @functools.cached_property
    def _blocks(self):
        """For checks of motions: the arm's spheres, and a grid around the points."""
        points = self._world[1]
        if not len(points):
            return block_arm(self.robot), NO_GRID
        radius = float(self._world[3][0, 16])
        return block_arm(self.robot), distance_grid(points, *grid_reach(self.robot, radius))

    @classmethod
    def from_points(
        cls,
        points: ArrayLike,
        radius: float = POINT_RADIUS,
        robot: Robot = PANDA,
        table: Box | None = primitives.TABLE,
        floor: float | None = primitives.FLOOR,
    ) -> "CollisionChecker":
        """Make the checker of a point cloud that `envs.perception.point_clouds.prepare_cloud` made.

        Args:
            points: m, (n, 3), in the base's frame.
            radius: m, of the ball around each point.
            robot: the `Robot`.
            table, floor: as in a `Scene`; None if there are only the points.

        Raises ValueError: as the class does.
        """
        return cls(Scene(table=table, floor=floor, robot=robot), points, radius)

    def is_free(
        self,
        states: ArrayLike,
        margin: float = 0.0,
        clearance: float = 0.0,
        endpoint_margins: EndpointMargins | None = None,
    ) -> np.ndarray:
        """Whether the arm keeps a margin from the scene and from itself: bool (...).

        Without a margin, the answer is the same as `not RoboArmEnv.in_collision(...)`.

        Args:
            states: (..., n), normalised.
            margin: m, in [0, `MAX_MARGIN`): from the scene, and between the links.
            clearance: m, in [0, `MAX_MARGIN`): from the scene, in addition.
            endpoint_margins: None, or `(states (k, n), distances (k,), growth)`. This allows
                smaller margins around endpoints that are nearer to geometry than `margin`: at L2
                distance d (normalised) from one of the states, at most `distance + growth * d`.
                Each configuration, or motion, may have its own: (..., k, n) and (..., k).
        """
        states = self._states("states", states)
        batch = states.shape[:-1]
        rule, endpoints = self._rule(margin, clearance, endpoint_margins, batch=batch)
        free = np.empty(batch, dtype=np.bool_)
        flat = states.reshape(-1, self.robot.num_joints)
        free_batch(flat, rule, endpoints, self._arm, self._world, free.reshape(-1))
        return free

    def is_motion_free(
        self,
        starts: ArrayLike,
        ends: ArrayLike,
        margin: float = 0.0,
        clearance: float = 0.0,
        endpoint_margins: EndpointMargins | None = None,
        resolution: float = RESOLUTION,
        ends_known: bool = False,
        continuous: bool = False,
    ) -> np.ndarray:
        """Whether straight motions are free: bool (...).

        It checks their ends, and points between them that are at most `resolution` apart. With
        `continuous` it also covers everything between these points: a motion that comes nearer
        than the margin plus 2 um anywhere is not free.

        Args:
            starts, ends: (..., n), normalised; one may be broadcast to the other.
            margin, clearance, endpoint_margins: as for `is_free`.
            resolution: L2, normalised, > 0.
            ends_known: don't check the ends, because they are known to be free.
            continuous: check whole motions. `resolution` and `ends_known` don't matter then.
        """
        if continuous:
            return self._are_motions_clear(starts, ends, margin, clearance, endpoint_margins)
        checks = self.motion_checks(
            starts, ends, margin, clearance, endpoint_margins, resolution, ends_known
        )
        return checks >= 0

    def _are_motions_clear(self, starts, ends, margin, clearance, endpoint_margins):
        starts, ends = np.broadcast_arrays(
            self._states("starts", starts), self._states("ends", ends)
        )
        batch = starts.shape[:-1]
        rule, endpoints = self._rule(margin, clearance, endpoint_margins, batch=batch)
        clear = np.empty(batch, dtype=np.bool_)
        starts = np.ascontiguousarray(starts.reshape(-1, self.robot.num_joints))
        ends = np.ascontiguousarray(ends.reshape(-1, self.robot.num_joints))
        arm32, grid = self._blocks
        clear_batch(
            starts, ends, rule, endpoints, self._arm, arm32, self._world, grid, clear.reshape(-1)
        )
        return clear

    def motion_checks(
        self,
        starts: ArrayLike,
        ends: ArrayLike,
        margin: float = 0.0,
        clearance: float = 0.0,
        endpoint_margins: EndpointMargins | None = None,
        resolution: float = RESOLUTION,
        ends_known: bool = False,
    ) -> np.ndarray:
        """How many configurations `is_motion_free` checks, int64 (...); negative: not free."""
        starts, ends = np.broadcast_arrays(
            self._states("starts", starts), self._states("ends", ends)
        )
        batch = starts.shape[:-1]
        rule, endpoints = self._rule(margin, clearance, endpoint_margins, resolution, batch)
        checks = np.empty(batch, dtype=np.int64)
        motion_batch(
            np.ascontiguousarray(starts.reshape(-1, self.robot.num_joints)),
            np.ascontiguousarray(ends.reshape(-1, self.robot.num_joints)),
            rule,
            endpoints,
            self._arm,
            self._blocks[0],
            self._world,
            self._blocks[1],
            0 if ends_known else 2,
            checks.reshape(-1),
        )
        return checks

    def first_free_path(
        self,
        paths: np.ndarray,
        orders: np.ndarray,
        margin: float = 0.0,
        endpoint_margins: EndpointMargins | None = None,
    ) -> int:
        """The index of the first of paths (m, k, n) whose motions are free, or m.

        Args:
            paths: normalised; their first states are known to be free.
            orders: int64 (m, k - 1): in which order the motions of each path are checked.
            margin, endpoint_margins: as for `is_motion_free`.
        """
        paths = self._states("paths", paths)
        rule, endpoints = self._rule(margin, 0.0, endpoint_margins)
        arm32, grid = self._blocks
        orders = np.ascontiguousarray(orders, np.int64)
        return first_free(paths, orders, rule, endpoints[0], self._arm, arm32, self._world, grid)

    def motion_checker(
        self,
        margin: float = 0.0,
        clearance: float = 0.0,
        endpoint_margins: EndpointMargins | None = None,
        resolution: float = RESOLUTION,
    ) -> Callable[[tuple, tuple], int]:
        """`motion_checks` of one motion, for planners: a function of two tuples of n floats.

        The function assumes that the start is free, and does not validate its arguments.
        """
        rule, endpoints = self._rule(margin, clearance, endpoint_margins, resolution)
        arm32, grid = self._blocks
        return functools.partial(
            single_motion, rule, endpoints[0], *self._arm, arm32, *self._world, grid
        )

    def find_path(
        self,
        start: ArrayLike,
        goals: ArrayLike,
        rng: np.random.Generator,
        margin: float = 0.0,
        clearance: float = 0.0,
        endpoint_margins: EndpointMargins | None = None,
        reach: float = REACH,
        max_checks: int = 4_000,
        chords: int = 20,
    ) -> tuple[np.ndarray | None, int]:
        """Find a path by RRT-Connect within about `max_checks` checks, which takes milliseconds.

        The same arguments and generator give the same path. Use it to plan again in each step;
        `planning.planner` plans more thoroughly.

        Args:
            start: (n,), normalised; it is not checked.
            goals: (m, n), normalised, or one goal (n,); they are not checked.
            rng: a NumPy Generator.
            margin, clearance, endpoint_margins: as for `is_free`.
            reach: L2, normalised, of the longest edge of a tree.
            max_checks: configurations to check, >= 1. Shortcuts may take a few more.
            chords: random shortcuts to try, and three times as many past single vertices.

        Returns:
            The path, float64 (k, n), or None if none was found; and the number of checks.
        """
        start = self._states("start", start)
        goals = np.atleast_2d(self._states("goals", goals))
        rule, endpoints = self._rule(margin, clearance, endpoint_margins)
        path, checks = self.search(
            start,
            goals,
            Rules(np.zeros(1, np.int64), rule[None], endpoints),
            int(rng.integers(2**63)),
            reach=reach,
            max_checks=max_checks,
            chords=chords,
        )
        return path, checks

    def search(
        self,
        start: np.ndarray,
        goals: np.ndarray,
        rules: Rules,
        seed: int,
        *,
        bounds: np.ndarray | None = None,
        reach: float = REACH,
        checks: int = 0,
        max_checks: float = math.inf,
        chords: int = 20,
        found: np.ndarray | None = None,
    ) -> tuple[np.ndarray | None, int]:
        """`find_path` for planners, with rules that change during the search.

        Args:
            start, goals: float64 (n,) and (m, n), normalised; they are not checked.
            rules: `Rules`.
            bounds: (2, n), between which random states are; by default -1 and 1.
            checks: how many there were before.
            max_checks: about the number of checks at which the search ends.
            reach, chords: as for `find_path`.
            found: (k, n), a path by another planner, which is only shortened. The answer is None if
                it touches something between its states.
        """
        if bounds is None:
            bounds = np.array([[-1.0], [1.0]]) * np.ones(len(start))
        if found is None:
            found = np.empty((0, len(start)))
        arm32, grid = self._blocks
        problem = tuple(rules), self._arm, arm32, self._world, grid
        path, checks = plan_path(
            found,
            np.ascontiguousarray(start),
            np.ascontiguousarray(goals),
            np.uint64(seed % 2**64),
            bounds,
            float(reach),
            chords,
            checks,
            int(min(max_checks, 2**62)),
            problem,
        )
        return (path if len(path) else None), checks

    def end_distances(self, states: np.ndarray, within: float) -> np.ndarray:
        """Distances (m) of states (m, n) from everything, and from the scene alone: (2, m).

        They are infinite where nothing is `within` (m).
        """
        links = len(self.robot.collision_links)
        return end_distances(states, float(within), links, self._arm, self._world)

    def signed_distances(
        self, states: ArrayLike, self_collisions: bool = True, within: float = math.inf
    ) -> SignedDistances:
        """The `SignedDistances` of the robot's `collision_links` from the nearest geometry.

        Args:
            states: (..., n), normalised.
            self_collisions: whether other links count (the robot's `self_collision_pairs`).
            within: m; geometry farther away counts as `NOTHING`.
        """
        states = self._states("states", states)
        links, joints = len(self.robot.collision_links), self.robot.num_joints
        batch = (*states.shape[:-1], links)
        distance, geometry = np.empty(batch), np.empty(batch, dtype=np.int64)
        normal, witness = np.empty((*batch, 3)), np.empty((*batch, 3))
        gradient = np.empty((*batch, joints))
        signed_distances_batch(
            states.reshape(-1, joints),
            bool(self_collisions),
            float(within),
            self._arm,
            self._world,
            distance.reshape(-1, links),
            normal.reshape(-1, links, 3),
            witness.reshape(-1, links, 3),
            gradient.reshape(-1, links, joints),
            geometry.reshape(-1, links),
        )
        return SignedDistances(distance, normal, witness, gradient, self._geometries[geometry])

    def link_distances(
        self,
        states: ArrayLike,
        self_collisions: bool = False,
        within: float = LINK_DISTANCE_RANGE,
    ) -> np.ndarray:
        """The observation of `envs.wrappers.LinkDistancesWrapper`: float32 (..., l, 1 + n).

        Each of the robot's `collision_links` has a row: `SignedDistances.distance` in m, clipped to
        `within`, and `SignedDistances.gradient`, in m per unit of normalised configuration.

        Args:
            states: (..., n), normalised. An arm may exceed its limits a little: such states are
                clipped to the limits.
            self_collisions, within: as for `signed_distances`.
        """
        states = self._numbers("states", states)
        shape = self.robot.link_distances_shape
        rows = np.empty((*states.shape[:-1], *shape), dtype=np.float32)
        are_numbers = link_distances_batch(
            states.reshape(-1, self.robot.num_joints),
            rows.reshape(-1, *shape),
            bool(self_collisions),
            float(within),
            self._arm,
            self._world,
        )
        if not are_numbers:
            raise ValueError("states must be normalised configurations, not NaN")
        return rows

    def _numbers(self, name, states):
        """Configurations as a contiguous float64 array. Raises ValueError."""
        joints = self.robot.num_joints
        try:
            states = np.asarray(states)
        except ValueError as error:  # lists of different lengths
            raise ValueError(f"{name} must be numbers of shape (..., {joints})") from error
        if states.dtype.kind not in "fiu" or states.shape[-1:] != (joints,):
            raise ValueError(
                f"{name} must be numbers of shape (..., {joints}), got {states.dtype} of shape "
                f"{states.shape}"
            )
        return np.ascontiguousarray(states, dtype=np.float64)

    def _states(self, name, states):
        """Normalised configurations as a contiguous float64 array. Raises ValueError."""
        states = self._numbers(name, states)
        # float32 may round a limit to just beyond it. (A comparison with NaN is false.)
        if states.size and not np.abs(states).max() <= 1.0 + 1e-6:
            raise ValueError(f"{name} must be normalised configurations: finite, in [-1, 1]")
        return states

    def _rule(self, margin, clearance, endpoint_margins, resolution=RESOLUTION, batch=()):
        """The arguments of `is_free` and `is_motion_free` as arrays. Raises ValueError.

        Returns float64 (4,): margin, clearance, growth, resolution; and the endpoints' states and
        distances, (m, k, n + 1), with m = 1 if they hold for the whole batch.
        """
        for name, value in (("margin", margin), ("clearance", clearance)):
            if not 0 <= value < MAX_MARGIN:
                raise ValueError(f"{name} must be in [0, {MAX_MARGIN}) m, got {value!r}")
        if not 0 < resolution < math.inf:
            raise ValueError(f"resolution must be positive, got {resolution!r}")
        if endpoint_margins is None:
            no_endpoints = np.empty((1, 0, 1 + self.robot.num_joints))
            return np.array([margin, clearance, 0.0, resolution]), no_endpoints
        states, distances, growth = endpoint_margins
        states = self._states("endpoint_margins states", states)
        distances = np.asarray(distances, dtype=np.float64)
        fits = states.ndim == 2 or (states.ndim > 2 and states.shape[:-2] == batch)
        if not fits or distances.shape != states.shape[:-1] or np.isnan(distances).any():
            raise ValueError(
                f"endpoint_margins: {states.shape} states and {distances.shape} distances"
            )
        if not 0 <= growth < math.inf:
            raise ValueError(
                f"endpoint_margins: growth must be finite and not negative, got {growth!r}"
            )
        endpoints = np.concatenate([states, distances[..., None]], axis=-1)
        endpoints = endpoints.reshape(-1 if states.ndim > 2 else 1, *endpoints.shape[-2:])
        return np.array([margin, clearance, growth, resolution]), endpoints


def self_distances(robot: Robot, states: ArrayLike, within: float) -> np.ndarray:
    """Link distances of a `Robot` from its other links: float32 (..., l, 1 + n).

    `states`: (..., n), normalised. `within`: m, as for `CollisionChecker.link_distances`.
    """
    return _arm_alone(robot).link_distances(states, self_collisions=True, within=within)


@functools.lru_cache(64)
def _arm_alone(robot):
    return CollisionChecker(Scene(table=None, floor=None, robot=robot))
