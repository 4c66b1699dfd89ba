"""Scenes as plain data: an arm, boxes, cylinders, spheres and convex hulls around it, table, floor.

All lengths in metres, in the world's frame: that of the Panda's base (x forward, y left, z up).
"""

import functools
import hashlib
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.variants import with_attached, with_held
from roboarm_nmp.envs.scenes.motions import Motion, motion_from_numbers, motion_to_numbers, moved
from roboarm_nmp.envs.scenes.numbers import (
    IDENTITY,
    MAX_LENGTH,
    MAX_SCENE_OBSTACLES,
    Quaternion,
    Vector,
    is_number,
    unit_quaternion,
)

MAX_HULL_VERTICES = 256
"""Of a `ConvexHull`."""
MAX_TOUCHING = 200
"""Names of links that one obstacle may touch."""


def _normalise(obstacle: "Obstacle") -> None:
    """Make tuples of lists and arrays, so that obstacles can be compared and hashed."""
    for name in ("position", "size"):
        value = getattr(obstacle, name, ())
        if type(value) is not tuple:
            object.__setattr__(obstacle, name, tuple(value))
    if not isinstance(obstacle, Sphere):
        object.__setattr__(obstacle, "orientation", unit_quaternion(obstacle.orientation))
    if not isinstance(obstacle.motion, Motion | None):
        raise TypeError(
            f"motion must be Oscillation, Waypoints, Presence or None, got {obstacle.motion!r}"
        )
    may_touch = obstacle.may_touch
    if may_touch is not True and may_touch != ():
        object.__setattr__(obstacle, "may_touch", _link_names(may_touch, "may_touch"))


def _link_names(names: Any, what: str) -> tuple[str, ...]:
    """Names of links as a sorted tuple; False is none. Raises ValueError."""
    if names is False:
        return ()
    is_collection = isinstance(names, (tuple, list, set, frozenset))
    if (
        not is_collection
        or len(names) > MAX_TOUCHING
        or not all(isinstance(name, str) for name in names)
    ):
        raise ValueError(f"{what} must be names of up to {MAX_TOUCHING} links, got {names!r}")
    return tuple(sorted(set(names)))


@dataclass(frozen=True)
class Box:
    """A box: centre, full edges, and orientation as a quaternion (x, y, z, w).

    `motion`: how it moves away from this pose (`envs.scenes.motions`); None if it doesn't move.

    `may_touch`: names of the arm's links that may touch this obstacle, with all objects attached to
    them, without a collision; True stands for `Robot.hand_links`. All kinds of obstacles have it.

    The quaternion is normalised. Raises ValueError if its norm differs from 1 by more than 1 %.
    """

    position: Vector
    size: Vector
    orientation: Quaternion = IDENTITY
    motion: Motion | None = None
    may_touch: tuple[str, ...] | bool = field(default=(), kw_only=True)

    __post_init__ = _normalise


@dataclass(frozen=True)
class Cylinder:
    """A cylinder around its local z axis.

    `position` is its centre; `orientation` and `motion` are the same as for a `Box`.
    """

    position: Vector
    radius: float
    length: float
    orientation: Quaternion = IDENTITY
    motion: Motion | None = None
    may_touch: tuple[str, ...] | bool = field(default=(), kw_only=True)

    __post_init__ = _normalise


@dataclass(frozen=True)
class Sphere:
    """A sphere; `position` is its centre, and `motion` is the same as for a `Box`."""

    position: Vector
    radius: float
    motion: Motion | None = None
    may_touch: tuple[str, ...] | bool = field(default=(), kw_only=True)

    __post_init__ = _normalise


@dataclass(frozen=True)
class ConvexHull:
    """The convex hull of points, 4 to `MAX_HULL_VERTICES` of them, not in one plane.

    `convex_hull` makes one of any number of points; `envs.scenes.meshes` of a mesh's file.

    `vertices` are (x, y, z), m, in the hull's own frame, which has its origin at `position`, and
    `orientation` and `motion` as of a `Box`.
    """

    position: Vector
    vertices: tuple[Vector, ...]
    orientation: Quaternion = IDENTITY
    motion: Motion | None = None
    may_touch: tuple[str, ...] | bool = field(default=(), kw_only=True)

    def __post_init__(self):
        _normalise(self)
        object.__setattr__(self, "vertices", tuple(map(tuple, self.vertices)))


Obstacle = Box | Cylinder | Sphere | ConvexHull


@dataclass(frozen=True)
class Attached:
    """An object that the arm carries, as a part of one of its links; see `envs.robots.variants`.

    Attributes:
        shape: a `Box`, `Cylinder`, `Sphere` or `ConvexHull`, in the frame of the link in the URDF.
        link: the link's name; None: the link with the end effector.
        touch_links: names of links whose contacts with the object are no collisions. Those that
            move with the object never collide with it.

    Raises:
        TypeError: another type.
        ValueError: as of a `Scene`'s obstacles; or the shape has `may_touch` or a motion.
    """

    shape: Obstacle
    link: str | None = None
    touch_links: tuple[str, ...] = ()

    def __post_init__(self):
        if not isinstance(self.shape, Obstacle):
            raise TypeError(
                f"an attached shape must be Box, Cylinder, Sphere or ConvexHull, got {self.shape!r}"
            )
        check_obstacle(self.shape)
        if self.shape.may_touch:
            raise ValueError("an attached shape has no may_touch: give the object touch_links")
        if self.shape.motion is not None:
            raise ValueError("an attached shape has no motion: it moves with its link")
        if self.link is not None and not isinstance(self.link, str):
            raise TypeError(f"link must be the name of a link, or None, got {self.link!r}")
        object.__setattr__(self, "touch_links", _link_names(self.touch_links, "touch_links"))

    @property
    def triangles(self) -> np.ndarray:
        """The triangles of a `ConvexHull`'s surface: `hull_faces`."""
        return hull_faces(self.shape.vertices)  # pyright: ignore[reportAttributeAccessIssue]

    def described(self) -> list[Any]:
        """All of it as lists, for files and fingerprints: row of `to_lists`, link, touch_links."""
        return [to_lists([self.shape])[0], self.link, list(self.touch_links)]


# The arm stands on the table's top (z = 0).
TABLE = Box(position=(0.2, 0.0, -0.02), size=(1.0, 1.0, 0.04))
FLOOR = -0.6
FRICTION = 0.5  # PyBullet's default


@functools.lru_cache(64)
def floor_box(height: float) -> Box:
    """The floor as a `Box`; `height` (m) is that of its surface."""
    return Box((0.0, 0.0, height - 0.05), (6.0, 6.0, 0.1))


@dataclass(frozen=True)
class Scene:
    """An arm and all geometry around it. `table=None` or `floor=None` leave them out.

    `robot` is the arm, and `floor` the height of the floor's surface. `friction` is the obstacles'
    coefficient, which PyBullet multiplies by the arm's, 0.5. You can compare and hash scenes.
    If obstacles move (`envs.scenes.motions`), `at` gives the static scene of a moment.

    Raises:
        TypeError: an obstacle or the table is of another type.
        ValueError: a number is not finite or exceeds its limit, or a size is not positive.
    """

    obstacles: tuple[Obstacle, ...] = ()
    table: Box | None = TABLE
    floor: float | None = FLOOR
    friction: float = FRICTION
    robot: Robot = PANDA

    def __post_init__(self):
        object.__setattr__(self, "obstacles", tuple(self.obstacles))
        for obstacle in self.obstacles:
            if not isinstance(obstacle, Obstacle):
                raise TypeError(
                    f"obstacles must be Box, Cylinder, Sphere or ConvexHull, got {obstacle!r}"
                )
            check_obstacle(obstacle)
            self._check_links(obstacle)
        if len(self.obstacles) > MAX_SCENE_OBSTACLES:
            raise ValueError(f"a scene has at most {MAX_SCENE_OBSTACLES:,} obstacles")
        if self.table is not None:
            if not isinstance(self.table, Box):
                raise TypeError(f"table must be a Box or None, got {self.table!r}")
            check_obstacle(self.table)
            self._check_links(self.table)
            if self.table.motion is not None:
                raise ValueError("the table cannot move: leave it out, and add a box that does")
        if self.floor is not None and not _is_length(self.floor):
            raise ValueError(f"floor must be a height in m or None, got {self.floor!r}")
        if not (is_number(self.friction) and self.friction >= 0):
            raise ValueError(f"friction must be a number, at least 0, got {self.friction!r}")
        if not isinstance(self.robot, Robot):
            raise TypeError(f"robot must be a Robot, got {self.robot!r}")

    def _check_links(self, obstacle: Obstacle) -> None:
        """Raise ValueError if an obstacle may touch a link that the robot does not have."""
        if obstacle.may_touch and isinstance(self.robot, Robot):
            self.robot.links_called(obstacle.may_touch)

    @property
    def is_static(self) -> bool:
        """Whether no obstacle moves, appears or disappears."""
        return all(obstacle.motion is None for obstacle in self.obstacles)

    def at(self, t: float) -> "Scene":
        """The static `Scene` at a time t (s): the obstacles that are present, where they are then.

        A static scene stays the same. Raises ValueError if the time is not finite.
        """
        if self.is_static:
            return self
        if not is_number(t):
            raise ValueError(f"a time is a finite number of seconds, got {t!r}")
        present = [obstacle_at(obstacle, t) for obstacle in self.obstacles]
        return replace(self, obstacles=[obstacle for obstacle in present if obstacle is not None])


class SceneDistribution(Protocol):
    """Scenes drawn at random.

    `base` is the `Scene` without the obstacles that vary, and `sample` draws a scene with a NumPy
    Generator.
    """

    @property
    def base(self) -> Scene: ...

    def sample(self, rng: np.random.Generator) -> Scene: ...


def pose_at(obstacle: Obstacle, t: float) -> tuple[Vector, Quaternion] | None:
    """Position (3), m, and orientation (4) of an obstacle at a time (s); None: it is absent."""
    orientation = IDENTITY if isinstance(obstacle, Sphere) else obstacle.orientation
    if obstacle.motion is None:
        return obstacle.position, orientation
    if not obstacle.motion.is_present(t):
        return None
    return moved(obstacle.position, orientation, *obstacle.motion.pose(t))


def obstacle_at(obstacle: Obstacle, t: float) -> Obstacle | None:
    """An obstacle as it is at a time (s), without its motion; None: it is absent."""
    if obstacle.motion is None:
        return obstacle
    pose = pose_at(obstacle, t)
    if pose is None:
        return None
    position, orientation = pose
    if isinstance(obstacle, Sphere):
        return replace(obstacle, position=position, motion=None)
    return replace(obstacle, position=position, orientation=orientation, motion=None)


POINT_RADIUS = 0.01
"""m, of the ball around a point in collision checks. With one point per 2.5 cm, surfaces have
hardly a hole."""


@dataclass(frozen=True)
class ObservedScene(Scene):
    """A scene that you have as a point cloud, for example from a real camera.

    Collision checks, encoders and geometry sources take each point as a ball of `point_radius`, an
    obstacle besides possible `obstacles`. In the simulator the points touch nothing, and scene
    files can't have them.

    Attributes:
        points: float32 (n, 3), m, in the base's frame; a read-only copy.
        point_radius: m.
        digest: a hash of the points, so that scenes with other points differ.

    Raises ValueError: the points are not finite or of another shape, or the radius is negative.
    """

    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)), compare=False, repr=False)
    point_radius: float = POINT_RADIUS
    digest: str = field(init=False)

    def __post_init__(self):
        super().__post_init__()
        points = np.array(self.points, dtype=np.float32)
        if not points.size:
            points = points.reshape(0, 3)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"points must be finite, of shape (n, 3), got {points.shape}")
        if not (_is_length(self.point_radius) and self.point_radius >= 0):
            raise ValueError(f"point_radius must be at least 0 m, got {self.point_radius!r}")
        points.flags.writeable = False
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "digest", hashlib.sha256(points.tobytes()).hexdigest())


def _is_length(value: Any) -> bool:
    return is_number(value) and abs(value) <= MAX_LENGTH


def check_obstacle(obstacle: Obstacle) -> None:
    """Raise ValueError unless an obstacle's numbers are finite, its sizes positive, in bounds."""
    if isinstance(obstacle, ConvexHull):
        _check_hull(obstacle)
        return
    if isinstance(obstacle, Box):
        sizes = tuple(obstacle.size)
    elif isinstance(obstacle, Cylinder):
        sizes = (obstacle.radius, obstacle.length)
    else:
        sizes = (obstacle.radius,)
    if not (
        len(obstacle.position) == 3
        and (len(sizes) == 3 or not isinstance(obstacle, Box))
        and all(map(_is_length, (*obstacle.position, *sizes)))
        and min(sizes) > 0
    ):
        raise ValueError(
            f"an obstacle needs finite numbers and positive sizes, up to {MAX_LENGTH:.0f} m: "
            f"{obstacle}"
        )


def _check_hull(hull: ConvexHull) -> None:
    if not 4 <= len(hull.vertices) <= MAX_HULL_VERTICES:
        raise ValueError(
            f"a convex hull has 4 to {MAX_HULL_VERTICES} vertices, got {len(hull.vertices)}: "
            f"`convex_hull` reduces them"
        )
    for point in (hull.position, *hull.vertices):
        if len(point) != 3 or not all(map(_is_length, point)):
            raise ValueError(
                f"a convex hull needs finite numbers, up to {MAX_LENGTH:.0f} m, three per vertex"
            )
    hull_faces(hull.vertices)


@functools.lru_cache(maxsize=1024)
def hull_faces(vertices: tuple[Vector, ...]) -> np.ndarray:
    """The triangles of a `ConvexHull`'s surface: int64 (f, 3), counterclockwise from outside.

    Raises ValueError: the vertices are in one plane.
    """
    points = np.array(vertices, dtype=np.float64)
    hull = _qhull(points)
    faces = hull.simplices.astype(np.int64)
    a = points[faces[:, 0]]
    b = points[faces[:, 1]]
    c = points[faces[:, 2]]
    inwards = np.einsum("fi,fi->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    faces.flags.writeable = False  # the next caller gets the same array
    return faces


def _qhull(points: np.ndarray):
    from scipy import spatial  # here, because it takes a while to import

    try:
        return spatial.ConvexHull(points)
    except (spatial.QhullError, ValueError) as error:
        raise ValueError("the vertices of a convex hull are in one plane, or too close") from error


def convex_hull(
    points: np.ndarray | Sequence[Sequence[float]],
    position: Vector = (0.0, 0.0, 0.0),
    orientation: Quaternion = IDENTITY,
) -> ConvexHull:
    """The `ConvexHull` of points (n, 3), m, in its own frame; interior points are dropped.

    If more than `MAX_HULL_VERTICES` remain, those that are farthest along as many directions are
    kept, and moved away from their mean by one factor, so that the hull contains all points.

    Raises ValueError: the points are in one plane, not finite, or of another shape.
    """
    corners = np.array(points, dtype=np.float64)
    if corners.ndim != 2 or corners.shape[1] != 3 or not np.isfinite(corners).all():
        raise ValueError(f"points must be finite, of shape (n, 3), got {corners.shape}")
    if len(corners) < 4:
        raise ValueError(f"a convex hull needs at least 4 points, got {len(corners)}")
    corners = corners[np.sort(_qhull(corners).vertices)]
    if len(corners) > MAX_HULL_VERTICES:
        # Evenly spread over the sphere (Gonzalez, 2010), of a box around the corners as a cube.
        i = np.arange(MAX_HULL_VERTICES) + 0.5
        z = 1 - 2 * i / MAX_HULL_VERTICES
        angle = i * math.pi * (3 - math.sqrt(5))
        across = np.sqrt(1 - z * z)
        directions = np.stack([across * np.cos(angle), across * np.sin(angle), z])
        farthest = np.unique((corners / np.ptp(corners, axis=0) @ directions).argmax(axis=0))
        inner = _qhull(corners[farthest])
        kept = corners[farthest][np.sort(inner.vertices)]
        centre = kept.mean(axis=0)
        normals = inner.equations[:, :3]
        reach = ((corners - centre) @ normals.T).max(axis=0)
        grown = (reach / -(inner.equations[:, 3] + normals @ centre)).max()
        corners = centre + grown * (kept - centre)
    return ConvexHull(position, tuple(map(tuple, corners.tolist())), orientation)


_KINDS = (Box, Cylinder, Sphere, ConvexHull)
ROW = 11  # numbers per obstacle: kind, position 3, orientation 4, size 3
HULL = 3
"""Kind of a `ConvexHull` in `to_array`."""


def to_array(obstacles: Sequence[Obstacle]) -> np.ndarray:
    """Obstacles -> float64 array (n, 11): kind, position, quaternion, size.

    Kinds: 0 box, 1 cylinder, 2 sphere, 3 convex hull. Sizes: a box's three edges; (radius, radius,
    length) of a cylinder; three times the radius of a sphere; three times the number of a hull's
    vertices, which are in `hull_vertices`. A motion has no place in a row (`motion_numbers`).
    """
    rows = []
    for obstacle in obstacles:
        orientation = IDENTITY
        if isinstance(obstacle, Sphere):
            size = (obstacle.radius,) * 3
        else:
            orientation = obstacle.orientation
            if isinstance(obstacle, Box):
                size = obstacle.size
            elif isinstance(obstacle, ConvexHull):
                size = (len(obstacle.vertices),) * 3
            else:
                size = (obstacle.radius, obstacle.radius, obstacle.length)
        rows += (_KINDS.index(type(obstacle)), *obstacle.position, *orientation, *size)
    return np.array(rows, np.float64).reshape(-1, ROW)


def hull_vertices(obstacles: Iterable[Obstacle]) -> np.ndarray:
    """The vertices of all `ConvexHull`s among obstacles, one after another: float64 (v, 3), m."""
    hulls = [obstacle for obstacle in obstacles if isinstance(obstacle, ConvexHull)]
    return np.array([vertex for hull in hulls for vertex in hull.vertices]).reshape(-1, 3)


def motion_numbers(obstacles: Iterable[Obstacle]) -> tuple[np.ndarray, np.ndarray]:
    """The motions of obstacles as numbers, one after another, and how many numbers each has.

    Returns: float64 (m,) and uint32 (n,); see `envs.scenes.motions.motion_to_numbers`.
    """
    numbers = [motion_to_numbers(obstacle.motion) for obstacle in obstacles]
    flat = [number for motion in numbers for number in motion]
    return np.array(flat, np.float64), np.array([len(motion) for motion in numbers], np.uint32)


def with_motion(obstacle: Obstacle, numbers: Iterable[float]) -> Obstacle:
    """An obstacle with the motion that numbers describe. Raises ValueError: there is none."""
    motion = motion_from_numbers(numbers)
    return obstacle if motion is None else replace(obstacle, motion=motion)


def vertex_counts(rows: np.ndarray) -> np.ndarray:
    """How many of `hull_vertices` each row of `to_array` has: int64 (n,). Raises ValueError."""
    counts = np.where(rows[:, 0] == HULL, rows[:, 8], 0)
    if not (np.isfinite(counts).all() and (counts >= 0).all() and (counts == counts.round()).all()):
        raise ValueError("the number of vertices of a convex hull must be a whole number")
    return counts.astype(np.int64)


def padded_rows(obstacles: Sequence[Obstacle], number: int) -> np.ndarray:
    """Obstacles -> float32 array (number, 12): 1 and a row of `to_array`, then rows of zeros.

    Raises ValueError: a `ConvexHull`, whose vertices a row cannot have, or a motion.
    """
    if any(obstacle.motion is not None for obstacle in obstacles):
        raise ValueError("obstacles of this scene move: describe scene.at(t), at a time t")
    if any(isinstance(obstacle, ConvexHull) for obstacle in obstacles):
        raise ValueError("convex hulls cannot be described by rows of 12 numbers: use a sensor")
    rows = np.zeros((number, 1 + ROW), np.float32)
    rows[: len(obstacles), 0] = 1.0
    rows[: len(obstacles), 1:] = to_array(obstacles)
    return rows


def from_array(rows: np.ndarray, vertices: Any = ()) -> tuple[Obstacle, ...]:
    """The inverse of `to_array`, and of `hull_vertices`.

    Raises ValueError: another shape, an unknown kind, no unit quaternion, or another number of
    vertices.
    """
    rows = np.asarray(rows, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != ROW:
        raise ValueError(f"an obstacle array has shape (n, {ROW}), got {rows.shape}")
    counts = vertex_counts(rows)
    points = [tuple(vertex) for vertex in np.array(vertices).reshape(-1, 3).tolist()]
    if counts.sum() != len(points):
        raise ValueError(f"convex hulls of {counts.sum()} vertices have {len(points)}")
    used = 0
    obstacles = []
    for kind, *numbers in rows.tolist():
        position = tuple(numbers[:3])
        orientation = tuple(numbers[3:7])
        size = tuple(numbers[7:])
        if kind == 0:
            obstacles.append(Box(position, size, orientation))
        elif kind == 1:
            obstacles.append(Cylinder(position, size[0], size[2], orientation))
        elif kind == 2:
            obstacles.append(Sphere(position, size[0]))
        elif kind == HULL:
            end = used + int(size[0])
            obstacles.append(ConvexHull(position, tuple(points[used:end]), orientation))
            used = end
        else:
            raise ValueError(
                f"unknown kind of obstacle {kind}: 0 box, 1 cylinder, 2 sphere, 3 convex hull"
            )
    return tuple(obstacles)


def to_lists(obstacles: Sequence[Obstacle]) -> list[list[Any]]:
    """Obstacles as JSON's lists: rows of `to_array`, a hull's followed by its vertices' numbers.

    Two more entries follow, where there are any: the numbers of its motion, a list; `may_touch`,
    true or a list of names.
    """
    rows: list[list[Any]] = to_array(obstacles).tolist()
    for row, obstacle in zip(rows, obstacles, strict=True):
        if isinstance(obstacle, ConvexHull):
            row += [float(number) for vertex in obstacle.vertices for number in vertex]
        if obstacle.motion is not None:
            row.append(motion_to_numbers(obstacle.motion))
        if obstacle.may_touch:
            row.append(obstacle.may_touch if obstacle.may_touch is True else [*obstacle.may_touch])
    return rows


def from_lists(rows: Iterable[list[Any]]) -> tuple[Obstacle, ...]:
    """The inverse of `to_lists`. Raises ValueError, TypeError: as `from_array`."""
    obstacles = []
    for row in rows:
        numbers = list(row)
        motion = None
        may_touch = ()
        if numbers and (isinstance(numbers[-1], bool) or _is_list_of(str, numbers[-1])):
            may_touch = numbers.pop()
        if numbers and isinstance(numbers[-1], list):
            motion = motion_from_numbers(numbers.pop())
        [obstacle] = from_array(np.array([numbers[:ROW]]), numbers[ROW:])
        obstacles.append(replace(obstacle, motion=motion, may_touch=may_touch))
    return tuple(obstacles)


def _is_list_of(kind: type, value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, kind) for item in value)


def scene_to_json(scene: Scene) -> str:
    """A `Scene` as text; equal scenes give equal texts. Raises ValueError: it has points."""
    if isinstance(scene, ObservedScene):
        raise ValueError("a scene with points cannot be written: save the points as .npy instead")
    fields: dict[str, Any] = {
        "obstacles": to_lists(scene.obstacles),
        "table": None if scene.table is None else to_lists([scene.table])[0],
        "floor": scene.floor,
    }
    if scene.friction != FRICTION:
        fields["friction"] = scene.friction
    robot = scene.robot
    if robot.arm != PANDA:
        fields["robot"] = (robot.arm.name, robot.arm.fingerprint)
    if robot.held_positions != robot.arm.held_positions:
        fields["held"] = robot.held
    if robot.attached:
        fields["attached"] = [attached.described() for attached in robot.attached]
    return json.dumps(fields, sort_keys=True)


def scene_from_json(text: str, robot: Robot = PANDA) -> Scene:
    """The inverse of `scene_to_json`.

    `robot` is the scene's arm: the text has only its fingerprint, and where joints are held.
    """
    fields = json.loads(text)
    table: Any = fields["table"] and from_lists([fields["table"]])[0]
    robot = with_held(robot.arm, fields["held"]) if "held" in fields else robot.arm
    attached = []
    for row, link, touch_links in fields.get("attached", ()):
        [shape] = from_lists([row])
        attached.append(Attached(shape, link, touch_links))
    return Scene(
        from_lists(fields["obstacles"]),
        table,
        fields["floor"],
        fields.get("friction", FRICTION),
        with_attached(robot, attached),
    )


def with_may_touch(
    obstacles: Iterable[Obstacle], touching: Iterable[tuple[str, ...] | bool]
) -> tuple[Obstacle, ...]:
    """Obstacles, each with its `may_touch`, a tuple. Raises ValueError: of another number."""
    pairs = zip(obstacles, touching, strict=True)
    return tuple(replace(obstacle, may_touch=links) for obstacle, links in pairs)
