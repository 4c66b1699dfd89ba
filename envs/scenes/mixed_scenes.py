"""Training scenes of several kinds: random boxes, walls with gaps, and racks of shelves.

For policies and encoders that have to generalise to all of them. Sizes and positions are uniform
in the ranges below, which were fixed before the first training. None of the scenes is one of the
tasks' own, except for the random boxes (docs/guide/tasks.md).
"""

import math
from dataclasses import dataclass, replace

from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.scenes.numbers import Vector
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Obstacle, Scene
from roboarm_nmp.envs.scenes.random_boxes import FRICTION, TURN, RandomBoxes, Rng, rounded

FEWEST = 2
MOST_BOXES = 8
# m. Walls stand on the table, edge-on to the robot. In two of three scenes the second wall is
# opposite the first, with the robot in the gap.
WALL = {"near": (0.14, 0.35), "length": (0.4, 0.8), "thickness": (0.03, 0.06), "height": (0.4, 1.0)}
WALLS = 3
OPPOSITE = 2 / 3
TURNED = math.radians(15)
# m. Racks of boards that face the robot: with sides, with poles, or with neither. Objects stand on
# the boards of half of the racks.
RACK = {
    "near": (0.3, 0.75),
    "width": (0.3, 1.2),
    "depth": (0.2, 1.2),
    "lowest": (0.05, 0.35),
    "spacing": (0.18, 0.4),
}
RACKS = 4
BOARDS = 6
TOP = 1.1  # m, of the highest board
BOARD = 0.03  # m, thickness of boards and sides
POLE = 0.04  # m, thickness
UPRIGHTS = (2, 4, 0)  # two sides, four poles, or neither
OBJECTS = 12  # most cylinders in a rack
RADIUS = (0.02, 0.05)  # m
LENGTH = (0.08, 0.2)  # m
MOST = 32  # obstacles, the capacity of the encoder `oracle`


@dataclass(frozen=True)
class MixedScenes:
    """A third of the scenes are random boxes, a third walls, a third racks of shelves.

    Attributes:
        base: the `Scene` without obstacles.
    """

    base: Scene = Scene(friction=FRICTION)

    def sample(self, rng: Rng) -> Scene:
        """A `Scene` drawn with a NumPy Generator."""
        kind = rng.integers(3)
        if kind == 0:
            obstacles = RandomBoxes(FEWEST, MOST_BOXES, self.base).sample(rng).obstacles
        else:
            scale = scale_of(self.base.robot)
            obstacles = _walls(rng, scale) if kind == 1 else _racks(rng, scale)
        return replace(self.base, obstacles=tuple(obstacles))


def _walls(rng: Rng, scale: float) -> list[Obstacle]:
    count = int(rng.integers(1, WALLS + 1))
    azimuth = rng.uniform(-math.pi, math.pi)
    opposite = rng.random() < OPPOSITE
    walls = []
    for number in range(count):
        shape = {name: rng.uniform(*limits) for name, limits in WALL.items()}
        centre = (shape["near"] + shape["length"] / 2, 0.0, shape["height"] / 2)
        size = (shape["length"], shape["thickness"], shape["height"])
        turned = rng.uniform(-TURNED, TURNED)
        walls.append(_placed(centre, size, azimuth + turned, scale))
        # The next wall is opposite this one, or at least a sixth of a turn from it. A third wall
        # may be near the first.
        between = math.pi if number == 0 and opposite else rng.uniform(math.pi / 3, math.pi * 5 / 6)
        azimuth += between
    return walls


def _racks(rng: Rng, scale: float) -> list[Obstacle]:
    count = int(rng.integers(1, RACKS + 1))
    first = rng.uniform(-math.pi, math.pi)
    parts = []
    for quarter in rng.permutation(4)[:count]:
        shape = {name: rng.uniform(*limits) for name, limits in RACK.items()}
        near = shape["near"]
        depth = shape["depth"]
        width = min(shape["width"], 2.0 * near)  # neighbouring racks do not intersect
        uprights = int(rng.choice(UPRIGHTS))
        most = 1 + int((TOP - shape["lowest"]) / shape["spacing"])
        boards = int(rng.integers(2, min(BOARDS, most, MOST // count - uprights) + 1))
        heights = [shape["lowest"] + i * shape["spacing"] for i in range(boards)]
        top = heights[-1] + BOARD / 2
        rack: list[tuple[Vector, tuple[float, ...]]] = []
        for z in heights:
            rack.append(((near + depth / 2, 0.0, z), (depth, width, BOARD)))
        if uprights == 2:
            y = (width - BOARD) / 2
            rack.append(((near + depth / 2, y, top / 2), (depth, BOARD, top)))
            rack.append(((near + depth / 2, -y, top / 2), (depth, BOARD, top)))
        elif uprights == 4:
            y = (width - POLE) / 2
            for x in (near + POLE / 2, near + depth - POLE / 2):
                rack.append(((x, y, top / 2), (POLE, POLE, top)))
                rack.append(((x, -y, top / 2), (POLE, POLE, top)))
        objects = int(rng.integers(min(OBJECTS, MOST // count - len(rack)) + 1))
        if not rng.integers(2):
            objects = 0
        for _ in range(objects):
            radius = rng.uniform(*RADIUS)
            length = rng.uniform(*LENGTH)
            aside = width / 2 - BOARD - radius
            x = rng.uniform(near + radius, near + depth - radius)
            y = rng.uniform(-aside, aside)
            z = heights[rng.integers(boards)] + (BOARD + length) / 2
            rack.append(((x, y, z), (radius, length)))
        azimuth = first + quarter * math.pi / 2
        parts += [_placed(centre, size, azimuth, scale) for centre, size in rack]
    return parts


def _placed(centre: Vector, size: tuple[float, ...], azimuth: float, scale: float) -> Obstacle:
    """An obstacle described in front of the robot, turned about the robot's axis.

    A box with three sizes, or an upright cylinder with its radius and length. Both are scaled.
    """
    half = round(azimuth / TURN) * TURN / 2
    cos = math.cos(2 * half)
    sin = math.sin(2 * half)
    x, y, z = [scale * length for length in centre]
    position = rounded(cos * x - sin * y, sin * x + cos * y, z)
    lengths = rounded(*[scale * length for length in size])
    if len(lengths) == 2:
        return Cylinder(position, *lengths)
    return Box(position, lengths, (0.0, 0.0, math.sin(half), math.cos(half)))
