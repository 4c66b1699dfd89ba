"""Scenes as plain data: boxes, cylinders and spheres around the arm, a table and a floor.

All lengths in metres, in the frame of the robot's base (x forward, y left, z up).
"""

import json
from dataclasses import dataclass

import numpy as np

IDENTITY = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Box:
    """A box: centre, full edges, and orientation as a quaternion (x, y, z, w)."""

    position: tuple[float, float, float]
    size: tuple[float, float, float]
    orientation: tuple[float, float, float, float] = IDENTITY


@dataclass(frozen=True)
class Cylinder:
    """A cylinder around its local z axis. `position` is its centre."""

    position: tuple[float, float, float]
    radius: float
    length: float
    orientation: tuple[float, float, float, float] = IDENTITY


@dataclass(frozen=True)
class Sphere:
    """A sphere; `position` is its centre."""

    position: tuple[float, float, float]
    radius: float


Obstacle = Box | Cylinder | Sphere

# The arm stands on the table's top (z = 0).
TABLE = Box(position=(0.2, 0.0, -0.02), size=(1.0, 1.0, 0.04))
FLOOR = -0.6
FRICTION = 0.5  # PyBullet's default


def floor_box(height):
    """The floor as a `Box`; `height` (m) is that of its surface."""
    return Box((0.0, 0.0, height - 0.05), (6.0, 6.0, 0.1))


@dataclass(frozen=True)
class Scene:
    """Everything the arm can hit apart from itself. `table=None` or `floor=None` leave them out.

    `floor` is the height of the floor's surface. `friction` is the obstacles' coefficient; PyBullet
    multiplies it by the arm's, 0.5. Values, not code: two equal scenes are equal.
    """

    obstacles: tuple[Obstacle, ...] = ()
    table: Box | None = TABLE
    floor: float | None = FLOOR
    friction: float = FRICTION

    def __post_init__(self):
        for obstacle in self.obstacles:
            if not isinstance(obstacle, Obstacle):
                raise TypeError(f"obstacles must be Box, Cylinder or Sphere, got {obstacle!r}")


_KINDS = (Box, Cylinder, Sphere)
ROW = 11  # numbers per obstacle: kind, position 3, orientation 4, size 3


def to_array(obstacles):
    """Obstacles -> float64 array (n, 11): kind, position, quaternion, size.

    Kinds: 0 box, 1 cylinder, 2 sphere. Sizes: a box's three edges; (radius, radius, length) of a
    cylinder; three times the radius of a sphere.
    """
    rows = np.zeros((len(obstacles), ROW))
    for row, obstacle in zip(rows, obstacles, strict=True):
        row[0], row[1:4] = _KINDS.index(type(obstacle)), obstacle.position
        if isinstance(obstacle, Sphere):
            row[4:8], row[8:11] = IDENTITY, obstacle.radius
            continue
        row[4:8] = obstacle.orientation
        if isinstance(obstacle, Box):
            row[8:11] = obstacle.size
        else:
            row[8:11] = obstacle.radius, obstacle.radius, obstacle.length
    return rows


def from_array(rows):
    """The inverse of `to_array`. Raises ValueError for another shape or an unknown kind."""
    rows = np.asarray(rows, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != ROW:
        raise ValueError(f"an obstacle array has shape (n, {ROW}), got {rows.shape}")
    obstacles = []
    for kind, *numbers in rows.tolist():
        position, orientation, size = tuple(numbers[:3]), tuple(numbers[3:7]), tuple(numbers[7:])
        if kind == 0:
            obstacles.append(Box(position, size, orientation))
        elif kind == 1:
            obstacles.append(Cylinder(position, size[0], size[2], orientation))
        elif kind == 2:
            obstacles.append(Sphere(position, size[0]))
        else:
            raise ValueError(f"unknown kind of obstacle {kind}: 0 box, 1 cylinder, 2 sphere")
    return tuple(obstacles)


def scene_to_json(scene):
    """A `Scene` as text; equal scenes give equal texts."""
    fields = {
        "obstacles": to_array(scene.obstacles).tolist(),
        "table": None if scene.table is None else to_array([scene.table])[0].tolist(),
        "floor": scene.floor,
    }
    if scene.friction != FRICTION:
        fields["friction"] = scene.friction
    return json.dumps(fields, sort_keys=True)


def scene_from_json(text):
    """The inverse of `scene_to_json`."""
    fields = json.loads(text)
    table = fields["table"] and from_array([fields["table"]])[0]
    rows = np.array(fields["obstacles"]).reshape(-1, ROW)
    friction = fields.get("friction", FRICTION)
    return Scene(from_array(rows), table, fields["floor"], friction)
