"""Scenes as plain data: boxes and cylinders around the arm, a table and a floor.

All lengths in metres, in the frame of the robot's base (x forward, y left, z up).
"""

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


# The arm stands on the table's top (z = 0).
TABLE = Box(position=(0.2, 0.0, -0.02), size=(1.0, 1.0, 0.04))
FLOOR = -0.6


@dataclass(frozen=True)
class Scene:
    """Everything the arm can hit apart from itself. `table=None` or `floor=None` leave them out.

    `floor` is the height of the floor's surface. Values, not code: two equal scenes are equal.
    """

    obstacles: tuple[Box | Cylinder, ...] = ()
    table: Box | None = TABLE
    floor: float | None = FLOOR

    def __post_init__(self):
        for obstacle in self.obstacles:
            if not isinstance(obstacle, (Box, Cylinder)):
                raise TypeError(f"obstacles must be Box or Cylinder, got {obstacle!r}")


_BOX, _CYLINDER = 0.0, 1.0
ROW = 11  # numbers per obstacle: kind, position 3, orientation 4, size 3


def to_array(obstacles):
    """Obstacles -> float64 array (n, 11): kind (0 box, 1 cylinder), position, quaternion, size.

    A box's size is its three edges; a cylinder's is (radius, radius, length).
    """
    rows = np.zeros((len(obstacles), ROW))
    for row, obstacle in zip(rows, obstacles, strict=True):
        if isinstance(obstacle, Box):
            size = obstacle.size
        else:
            size = (obstacle.radius, obstacle.radius, obstacle.length)
        row[0] = _BOX if isinstance(obstacle, Box) else _CYLINDER
        row[1:4], row[4:8], row[8:11] = obstacle.position, obstacle.orientation, size
    return rows


def from_array(rows):
    """The inverse of `to_array`. Raises ValueError for another shape or an unknown kind."""
    rows = np.asarray(rows, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != ROW:
        raise ValueError(f"an obstacle array has shape (n, {ROW}), got {rows.shape}")
    obstacles = []
    for row in rows.tolist():
        position, orientation = tuple(row[1:4]), tuple(row[4:8])
        if row[0] == _BOX:
            obstacles.append(Box(position, tuple(row[8:11]), orientation))
        elif row[0] == _CYLINDER:
            obstacles.append(Cylinder(position, row[8], row[10], orientation))
        else:
            raise ValueError(f"unknown kind of obstacle {row[0]}: 0 is a box, 1 a cylinder")
    return tuple(obstacles)
