"""Point clouds: of a scene's obstacles as four sensors observe them, and of your own.

    points = observed_points(scene)              # float32 (n, 3), m
    tokens = farthest_points(points, 64)         # for a network

    points, removed = prepare_cloud(load_cloud("table.ply"), configuration=configuration)
    scene = ObservedScene(points=points)         # for environments, policies and planners

The sensors (paper, section 4) label points of the arm, the table and obstacles. The arm's own
configuration, the table and the floor are known, so only points of obstacles are used. Of a cloud
without labels, `prepare_cloud` removes the others by their distance.
"""

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from roboarm_nmp.envs.collision.checker import LINK_DISTANCE_RANGE
from roboarm_nmp.envs.collision.grid_kernels import first_in_cells
from roboarm_nmp.envs.collision.hulls import MAX_MARGIN, arm_hulls, shape_rows
from roboarm_nmp.envs.perception.cloud_kernels import (
    OF_ARM,
    OF_OBSTACLE,
    farthest,
    label_points,
)
from roboarm_nmp.envs.perception.sensors import (
    OBSTACLE,
    PointCloud,
    SceneObservation,
    cardinal,
    world_of,
)
from roboarm_nmp.envs.robots.panda import PANDA, scale_of
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import (
    FLOOR,
    TABLE,
    Box,
    ObservedScene,
    Obstacle,
    Scene,
    floor_box,
)

POINT_CLOUD = "point_cloud"
"""Its name as an encoder and as a geometry source."""
NUM_POINTS = 64
"""Of the encoder `point_cloud`, by default."""
CELL = 0.025
"""m. One point of each cube of this size is used: about 1,500 on `random_boxes_hard`. For an arm of
another reach than the Panda's, it is scaled, and so is `POINT_RADIUS`."""
FINE_CELL = 0.006
FINE_POINT_RADIUS = 0.005
"""m. The same as `CELL` and `POINT_RADIUS` for approach paths, which lead closer to surfaces."""
DENSE_RAYS = 40_000
"""Of each sensor, where a whole path is verified: with 10,000, they miss rods of 2 cm."""
KNOWN_DISTANCE = 0.01
"""m. Points nearer to the table or the floor than this are theirs."""
ARM_DISTANCE = 0.02
"""m. Points nearer to the arm than this are its own."""
MIN_POINTS = 3
"""Points that a cube of `CELL` and the 26 around it need, or they are outliers."""
STEPS: tuple[str, ...] = ("not finite", "outside the workspace", "of table or floor", "of the arm")
"""What `prepare_cloud` removes before outliers, in its order."""
_AS_COMPILED = ("C", "W")  # contiguous and writeable, or Numba compiles once more
CACHED_SCENES = 500  # about 20 kB each
_remembered = {}  # scene -> points
_dense = {}  # the last scene of which `DENSE_RAYS` were cast, without noise -> its images


def observed_points(scene: Scene) -> np.ndarray:
    """Points of a `Scene`'s obstacles: float32 (n, 3), m, in the base's frame; not to be changed.

    One per cube of `CELL`; none, (0, 3), where no obstacle is visible. The last scenes are cached.
    Those of an `ObservedScene` are its own. A `SceneObservation` says where the arm is, and which
    noise there is; with noise, outliers are removed as by `prepare_cloud`.
    """
    if isinstance(scene, ObservedScene):
        return scene.points
    points = _remembered.get(scene)
    return _observe(scene) if points is None else points


def remember_points(scene: Scene) -> None:
    """Keep the observed points of a `Scene` in memory, about 20 kB, until the process ends."""
    _remembered[scene] = observed_points(scene)


def fine_observed_points(scene: Scene, num_rays: int | None = None) -> np.ndarray:
    """As `observed_points`, one per cube of `FINE_CELL`; with `num_rays`, one per ray that hits.

    `num_rays`: as of `sensor_images`.
    """
    return _thin(scene, FINE_CELL if num_rays is None else None, num_rays)


@functools.lru_cache(CACHED_SCENES)
def _observe(scene: Scene) -> np.ndarray:
    return _thin(scene, CELL)


def _thin(scene: Scene, cell: float | None, num_rays: int | None = None) -> np.ndarray:
    points = _clouds(scene, num_rays)
    scale = scale_of(scene.robot)
    if isinstance(scene, SceneObservation) and scene.noise.changes_images:
        points = without_outliers(points, scale * CELL, MIN_POINTS)
    return points if cell is None else one_per_cell(points, scale * cell)


@functools.lru_cache(1)  # the coarse and the fine points of a scene are needed together
def _clouds(scene: Scene, num_rays: int | None = None) -> np.ndarray:
    clouds = [np.empty((0, 3), np.float32)]
    for sensor, depth, classes in sensor_images(scene, num_rays):
        clouds.append(sensor.points_of_class(depth, classes, OBSTACLE))
    return np.concatenate(clouds)


@functools.lru_cache(2)
def sensor_images(
    scene: Scene, num_rays: int | None
) -> list[tuple[PointCloud, np.ndarray, np.ndarray]]:
    """What the four sensors of a `Scene` see: each with its depth and classes (`cast`).

    `num_rays`: of each sensor, a square number; None: as many as it has. These are every second one
    of `DENSE_RAYS` in each direction, and not cast again after those.
    """
    sensors = list(cardinal(PointCloud, scene.robot).values())
    dense = _dense.get(scene)  # once: another thread may clear it
    if num_rays is None and dense is not None:
        images = [[image[1::2, ::2].copy() for image in pair] for _, *pair in dense]
        return [(sensor, *pair) for sensor, pair in zip(sensors, images, strict=True)]
    if num_rays is not None:
        sensors = [replace(sensor, num_samples=num_rays) for sensor in sensors]
    world = world_of(scene, len(sensors))
    images = [(sensor, *world.cast(sensor, sensor.size)) for sensor in sensors]
    if num_rays == DENSE_RAYS and not world.noise.changes_images:
        _dense.clear()
        _dense[scene] = images
    return images


def one_per_cell(points: np.ndarray, cell: float = CELL) -> np.ndarray:
    """The first of the points (n, 3), m, in each cube with edges of `cell`, m, in their order.

    Use it with points of your own: the pretrained policies were trained with such clouds.
    """
    kind = points.dtype if points.dtype in (np.float32, np.float64) else np.float64
    numbers = np.require(points, kind, _AS_COMPILED)
    return points[first_in_cells(numbers, numbers.dtype.type(cell), False)[0]]


def without_known(
    points: np.ndarray, obstacles: Sequence[Obstacle], distance: float = KNOWN_DISTANCE
) -> np.ndarray:
    """The points (n, 3), m, that are not within a distance (m) of the boxes around obstacles."""
    points = np.require(points, np.float32, _AS_COMPILED)
    everywhere = np.array([[-np.inf] * 3, [np.inf] * 3])
    labels = _labels(points, everywhere, shape_rows(obstacles), distance)
    return points[labels == OF_OBSTACLE]


def are_near_arm(
    points: np.ndarray, robot: Robot, states: np.ndarray, distance: float
) -> np.ndarray:
    """Which points (n, 3), m, are within a distance (m) of an arm in one of its states: bool (n,).

    `states`: normalised configurations (m, j).
    """
    points = np.require(points, np.float32, _AS_COMPILED)
    everywhere = np.array([[-np.inf] * 3, [np.inf] * 3])
    near = np.zeros(len(points), np.bool_)
    for state in np.asarray(states, np.float64):
        labels = _labels(points, everywhere, shape_rows(()), 0.0, robot, state, distance)
        near |= labels == OF_ARM
    return near


def _labels(
    points: np.ndarray,
    workspace: np.ndarray,
    shapes: np.ndarray,
    distance: float,
    robot: Robot = PANDA,
    state: np.ndarray | None = None,
    arm_distance: float = 0.0,
) -> np.ndarray:
    """What each point belongs to, uint8 (n,): an index into `STEPS`, or `OF_OBSTACLE`.

    `state`: the arm's, normalised; None: the points have none of the arm.
    """
    lower, upper = workspace
    state = np.empty(0) if state is None else state
    labels = np.empty(len(points), np.uint8)
    arm = arm_hulls(robot)
    label_points(points, lower, upper, shapes, distance, state, arm_distance, arm, labels)
    return labels


def without_outliers(points: np.ndarray, cell: float, min_points: int) -> np.ndarray:
    """Those of float32 points (n, 3), m, that have enough points around them, themselves included.

    Their cube with edges of `cell` (m) and the 26 around it have at least `min_points`.
    """
    _, cubes, around = first_in_cells(points, np.float32(cell), True)
    return points[(around >= min_points)[cubes]]


class PreparedCloud(NamedTuple):
    """What `prepare_cloud` returns.

    points: float32 (n, 3), m.
    removed: dict from a step's name to the number of points that it removed.
    """

    points: np.ndarray
    removed: dict[str, int]


def prepare_cloud(
    points: np.ndarray,
    robot: Robot = PANDA,
    configuration: np.ndarray | None = None,
    *,
    workspace: np.ndarray | None = None,
    table: Box | None = TABLE,
    floor: float | None = FLOOR,
    cell: float | None = None,
    min_points: int = MIN_POINTS,
    arm_distance: float = ARM_DISTANCE,
) -> PreparedCloud:
    """The points of obstacles in a cloud, as collision checks and policies take them.

    In this order, points are removed that

    - are not finite;
    - are outside the workspace;
    - are less than `KNOWN_DISTANCE` from table or floor, or inside them, as both are known;
    - are less than `arm_distance` from the arm, whose convex hulls collision checks use, too;
    - are outliers: with the 26 cubes around it, their cube of `CELL` has less than `min_points`;
    - are not the first of their cube of `cell`.

    The same points in the same order give the same result.

    Args:
        points: m, (n, 3), in the base's frame.
        robot: the `Robot`.
        configuration: the arm's when the cloud was recorded, rad, (n,); None: it has no points of
            the arm.
        workspace: corners (2, 3), m: lower and upper. By default a cube around the base, from where
            no point can change a link distance.
        table, floor: as of a `Scene`; None if unknown: then their points stay, as obstacles.
        cell: m, `CELL` by default, scaled with the robot's reach.
        min_points: 0 to keep outliers.
        arm_distance: m.

    Raises ValueError: an argument is out of its range, or of another shape.
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise ValueError(f"points must be numbers of shape (n, 3), got {points.shape}")
    cell = scale_of(robot) * CELL if cell is None else cell
    if not 1e-4 <= cell <= 1.0:
        raise ValueError(f"cell must be in [0.0001, 1] m, got {cell!r}")
    if not 0 <= arm_distance < MAX_MARGIN:
        raise ValueError(f"arm_distance must be in [0, {MAX_MARGIN}) m, got {arm_distance!r}")
    if workspace is None:
        reach = robot.reach + LINK_DISTANCE_RANGE
        workspace = np.add(np.array(robot.base_position), [[-reach] * 3, [reach] * 3])
    workspace = np.array(workspace, dtype=np.float64)
    if workspace.shape != (2, 3):
        raise ValueError(f"workspace must be two corners, (2, 3), got {workspace.shape}")
    known = []
    if table is not None:
        known.append(table)
    if floor is not None:
        known.append(floor_box(floor))
    state = None
    if configuration is not None:
        if np.shape(configuration) != (robot.num_joints,):
            raise ValueError(f"configuration must be {robot.num_joints} joint angles")
        state = np.clip(robot.normalise(configuration), -1.0, 1.0)
    with np.errstate(over="ignore"):
        points = np.require(points, np.float32, _AS_COMPILED)
    shapes = shape_rows(known)
    labels = _labels(points, workspace, shapes, KNOWN_DISTANCE, robot, state, arm_distance)
    counts = np.bincount(labels, minlength=OF_OBSTACLE + 1).tolist()
    removed = dict(zip(STEPS, counts, strict=False))
    points = points[labels == OF_OBSTACLE]
    # Not the cubes of `cell`: of a fine one, most points of a surface would be alone.
    dense = without_outliers(points, scale_of(robot) * CELL, min_points)
    thin = one_per_cell(dense, cell)
    removed["outliers"] = len(points) - len(dense)
    removed["thinned out"] = len(dense) - len(thin)
    return PreparedCloud(thin, removed)


def farthest_points(points: np.ndarray, number: int) -> np.ndarray:
    """`number` points by farthest point sampling (Eldar et al., 1997): float32 (number, 3).

    The first is the one farthest from the base. Where there are fewer points, the rest are zeros:
    no obstacle can be where the base is.
    """
    chosen = np.zeros((number, 3), np.float32)
    farthest(np.require(points, np.float32, _AS_COMPILED), chosen)
    return chosen
