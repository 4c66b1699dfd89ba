"""Training scenes with places for the hand: open boxes, shelves, cluttered tables.

    scene, places = Containers().sample_with_places(rng)

For policies that reach into containers. Sizes, heights and positions are uniform in the ranges
below. There is neither the standard table nor the floor, so places may be below the robot's base.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.scenes.numbers import Vector
from roboarm_nmp.envs.scenes.places import Place
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene
from roboarm_nmp.envs.scenes.random_boxes import (
    FRICTION,
    KEEP_CLEAR,
    TURN,
    Rng,
    distance_to_robot,
    rounded,
)

# m. All stand on `base`, the height of their undersides; `near` is the distance of their fronts
# from the robot's axis. Boxes are open at the top, two of three with a lid that is open, too.
OPEN_BOX = {
    "near": (0.1, 0.35),
    "base": (-0.65, -0.05),
    "depth": (0.4, 0.8),
    "width": (0.4, 0.8),
    "height": (0.35, 0.8),
    "thickness": (0.01, 0.04),
}
FRONT = (0.75, 1.0)  # height of the front wall, as a share of the others'
LID = (math.radians(30), math.radians(100))  # how far it is open
LIDS = 2 / 3
DEEP = 0.5  # share of an open box's height that is its place
SHELF = {
    "near": (0.3, 0.75),
    "base": (-0.6, 0.3),
    "depth": (0.2, 1.1),
    "width": (0.4, 1.2),
    "spacing": (0.2, 0.45),
    "thickness": (0.02, 0.04),
}
BOARDS = (2, 6)  # fewest, most
DIVIDED = 0.4  # share of the levels
BACK = 0.3  # share of the shelves
SIDES = 0.7  # share of the shelves
TABLE = {
    "near": (0.2, 0.5),
    "base": (-0.35, 0.4),
    "depth": (0.4, 1.2),
    "width": (0.6, 2.0),
    "thickness": (0.02, 0.05),
}
OBJECTS = {"radius": (0.02, 0.06), "length": (0.08, 0.35)}
PANELS = {"length": (0.1, 0.25), "thickness": (0.02, 0.25), "height": (0.1, 0.4)}
# Objects: fewest, most + 1.
ON_TABLE = (2, 9)
IN_BOX = (0, 4)
IN_SHELF = (0, 8)
OVER_TABLE = 0.2  # m, the height of the place above a table
TURNED = math.radians(35)  # furniture is turned by at most this from facing the robot
INSET = 0.015  # m between a place and the boards around it
MOST = 32  # obstacles, the capacity of the encoder `oracle`


@dataclass(frozen=True)
class Containers:
    """One or two of open boxes (one half), shelves and tables (a quarter each) around the robot.

    Attributes:
        base: the `Scene` without obstacles.
    """

    base: Scene = Scene(friction=FRICTION, table=None, floor=None)

    def sample(self, rng: Rng) -> Scene:
        """A `Scene` drawn with a NumPy Generator."""
        return self.sample_with_places(rng)[0]

    def sample_with_places(self, rng: Rng) -> tuple[Scene, list[Place]]:
        """The same, and a list of its `Place`s."""
        scale = scale_of(self.base.robot)
        obstacles = []
        places = []
        azimuth = rng.uniform(-math.pi, math.pi)
        count = int(rng.integers(1, 3))
        while count:
            parts, regions, near, depth = _KINDS[rng.integers(len(_KINDS))](rng)
            yaw = round((azimuth + rng.uniform(-TURNED, TURNED)) / TURN) * TURN
            distance = near + depth / 2
            origin = (distance * math.cos(azimuth), distance * math.sin(azimuth))
            placed = [_placed(part, origin, yaw, scale) for part in parts[: MOST // 2]]
            upright = [o for o in placed if isinstance(o, Box) and o.orientation[:2] == (0, 0)]
            if min(distance_to_robot(box, scale) for box in upright) < KEEP_CLEAR * scale:
                continue
            obstacles += placed
            cos = math.cos(yaw)
            sin = math.sin(yaw)
            turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
            for centre, size, approach in regions:
                centre = scale * (turn @ centre + [*origin, 0.0])
                places.append(Place(centre, scale * np.array(size), turn, turn @ approach))
            azimuth += rng.uniform(math.pi * 2 / 3, math.pi * 4 / 3)
            count -= 1
        return replace(self.base, obstacles=tuple(obstacles)), places


# Furniture, centred at the origin of x and y, facing -x. Each function returns its parts, its
# places as (centre, size, approach), and its `near` and `depth`. A part is (centre, size) of a box,
# (centre, (radius, length)) of an upright cylinder, or (centre, size, pitch).
Furniture = tuple[list[tuple[Any, ...]], list[tuple[Vector, Vector, Vector]], float, float]


def _open_box(rng: Rng) -> Furniture:
    near, base, depth, width, height, thickness = _drawn(rng, OPEN_BOX)
    front = height * rng.uniform(*FRONT)
    middle = base + height / 2
    x = (depth - thickness) / 2
    y = (width - thickness) / 2
    parts: list[tuple[Any, ...]] = [
        ((0.0, 0.0, base + thickness / 2), (depth, width, thickness)),
        ((x, 0.0, middle), (thickness, width, height)),
        ((-x, 0.0, base + front / 2), (thickness, width, front)),
        ((0.0, y, middle), (depth, thickness, height)),
        ((0.0, -y, middle), (depth, thickness, height)),
    ]
    if rng.random() < LIDS:
        opening = rng.uniform(*LID)
        length = rng.uniform(0.5, 1.0) * depth
        centre = (
            depth / 2 - length / 2 * math.cos(opening),
            0.0,
            base + height + thickness + length / 2 * math.sin(opening),
        )
        parts.append((centre, (length, width, thickness), math.pi + opening))
    inside = (depth - 2 * thickness, width - 2 * thickness)
    parts += _objects(rng, int(rng.integers(*IN_BOX)), (0.0, 0.0), inside, base + thickness)
    low = base + thickness + INSET
    high = base + DEEP * height
    size = (inside[0] - 2 * INSET, inside[1] - 2 * INSET, high - low)
    place = ((0.0, 0.0, (low + high) / 2), size, (0.0, 0.0, -1.0))
    return parts, [place], near, depth


def _shelf(rng: Rng) -> Furniture:
    near, base, depth, width, spacing, thickness = _drawn(rng, SHELF)
    boards = int(rng.integers(BOARDS[0], BOARDS[1] + 1))
    heights = [base + thickness / 2 + level * spacing for level in range(boards)]
    parts = [((0.0, 0.0, z), (depth, width, thickness)) for z in heights]
    top = heights[-1] - heights[0] + thickness
    middle = (heights[0] + heights[-1]) / 2
    if rng.random() < SIDES:
        parts += [
            ((0.0, side * (width + thickness) / 2, middle), (depth, thickness, top))
            for side in (1, -1)
        ]
    if rng.random() < BACK:
        parts.append((((depth + thickness) / 2, 0.0, middle), (thickness, width, top)))
    places = []
    for z in heights[:-1]:
        free = spacing - thickness
        middle = z + spacing / 2
        cuts = [-width / 2, width / 2]
        if rng.random() < DIVIDED:
            cuts.insert(1, rng.uniform(-0.25, 0.25) * width)
            parts.append(((0.0, cuts[1], middle), (depth, thickness, free)))
        for left, right in zip(cuts[:-1], cuts[1:], strict=True):
            size = (depth, right - left - thickness - 2 * INSET, free - 2 * INSET)
            places.append(((0.0, (left + right) / 2, middle), size, (1.0, 0.0, 0.0)))
    for _ in range(int(rng.integers(*IN_SHELF))):
        z = heights[rng.integers(boards - 1)] + thickness / 2
        parts += _objects(rng, 1, (0.0, 0.0), (depth, width), z, 0.7 * (spacing - thickness))
    return parts, places, near, depth


def _table(rng: Rng) -> Furniture:
    near, base, depth, width, thickness = _drawn(rng, TABLE)
    parts = [((0.0, 0.0, base), (depth, width, thickness))]
    top = base + thickness / 2
    # Objects within reach.
    reach = (min(depth, 0.7), min(width, 1.2))
    x = (reach[0] - depth) / 2
    parts += _objects(rng, int(rng.integers(*ON_TABLE)), (x, 0.0), reach, top)
    size = (*reach, OVER_TABLE)
    centre = (x, 0.0, top + INSET + OVER_TABLE / 2)
    places = [(centre, size, (0.0, 0.0, -1.0)), (centre, size, (0.8, 0.0, -0.6))]
    return parts, places, near, depth


_KINDS = (_open_box, _open_box, _shelf, _table)


def _drawn(rng: Rng, ranges: dict[str, tuple[float, float]]) -> list[float]:
    return [rng.uniform(*limits) for limits in ranges.values()]


def _objects(
    rng: Rng,
    count: int,
    centre: tuple[float, float],
    area: tuple[float, float],
    z: float,
    highest: float = 1.0,
) -> list[tuple[Any, ...]]:
    """Parts that stand at the height z on an area (x, y) around a centre."""
    parts = []
    for _ in range(count):
        x = centre[0] + rng.uniform(-0.45, 0.45) * area[0]
        y = centre[1] + rng.uniform(-0.45, 0.45) * area[1]
        if rng.random() < 0.6:
            radius, length = _drawn(rng, OBJECTS)
            length = min(length, highest)
            parts.append(((x, y, z + length / 2), (radius, length)))
        else:
            length, thickness, height = _drawn(rng, PANELS)
            size = (length, thickness) if rng.random() < 0.5 else (thickness, length)
            height = min(height, highest)
            parts.append(((x, y, z + height / 2), (*size, height)))
    return parts


def _placed(
    part: tuple[Any, ...], origin: tuple[float, float], yaw: float, scale: float
) -> Box | Cylinder:
    """The obstacle of a part, at the origin (x, y) and turned about it by the yaw."""
    (x, y, z), size, *pitch = part
    cos = math.cos(yaw)
    sin = math.sin(yaw)
    position = (origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y, z)
    position = rounded(*[scale * length for length in position])
    size = rounded(*[scale * length for length in size])
    if len(size) == 2:
        return Cylinder(position, *size)
    half_pitch = pitch[0] / 2 if pitch else 0.0
    u = math.sin(half_pitch)
    v = math.cos(half_pitch)
    cos = math.cos(yaw / 2)
    sin = math.sin(yaw / 2)
    return Box(position, size, (-sin * u, cos * u, sin * v, cos * v))
