"""Training scenes of several kinds: random boxes, walls with gaps, and racks of shelves.

For policies and encoders that have to generalise to all of them. Sizes and positions are uniform
in the ranges below, which were fixed before the first training. None of the scenes is one of the
tasks' own, except for the random boxes (docs/guide/tasks.md).
"""

import math
from dataclasses import dataclass, replace

from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene
from roboarm_nmp.envs.scenes.random_boxes import FRICTION, TURN, RandomBoxes, rounded

FEWEST, MOST_BOXES = 2, 8
# m. Walls stand on the table, edge-on to the robot. In two of three scenes the second wall is
# opposite the first, with the robot in the gap.
WALL = {
    "near": (0.14, 0.35),
    "length": (0.4, 0.8),
    "thickness": (0.03, 0.06),
    "height": (0.4, 1.0),
}
WALLS, OPPOSITE, TURNED = 3, 2 / 3, math.radians(15)
# m. Racks of boards that face the robot: with sides, with poles, or with neither. Objects stand on
# the boards of half of the racks.
RACK = {
    "near": (0.3, 0.75),
    "width": (0.3, 1.2),
    "depth": (0.2, 1.2),
    "lowest": (0.05, 0.35),
    "spacing": (0.18, 0.4),
}
RACKS, BOARDS, TOP, BOARD, POLE = 4, 6, 1.1, 0.03, 0.04
UPRIGHTS = 2, 4, 0  # two sides, four poles, or neither
OBJECTS, RADIUS, LENGTH = 12, (0.02, 0.05), (0.08, 0.2)  # most cylinders in a rack; m
MOST = 32  # obstacles, the capacity of the encoder `oracle`


@dataclass(frozen=True)
class MixedScenes:
    """A third of the scenes are random boxes, a third walls, a third racks of shelves.

    Attributes:
        base: the `Scene` without obstacles.
    """

    base: Scene = Scene(friction=FRICTION)

    def sample(self, rng):
        """A `Scene` drawn with a NumPy Generator."""
        kind = rng.integers(3)
        if kind == 0:
            obstacles = RandomBoxes(FEWEST, MOST_BOXES, self.base).sample(rng).obstacles
        else:
            scale = scale_of(self.base.robot)
            obstacles = _walls(rng, scale) if kind == 1 else _racks(rng, scale)
        return replace(self.base, obstacles=tuple(obstacles))


def _walls(rng, scale):
    count = int(rng.integers(1, WALLS + 1))
    azimuth = rng.uniform(-math.pi, math.pi)
    opposite = rng.random() < OPPOSITE
    walls = []
    for number in range(count):
        shape = {name: rng.uniform(*limits) for name, limits in WALL.items()}
        centre = shape["near"] + shape["length"] / 2, 0.0, shape["height"] / 2
        size = shape["length"], shape["thickness"], shape["height"]
        turned = rng.uniform(-TURNED, TURNED)
        walls.append(_placed(centre, size, azimuth + turned, scale))
        # The next wall is opposite this one, or at least a sixth of a turn from it. A third wall
        # may be near the first.
        between = math.pi if number == 0 and opposite else rng.uniform(math.pi / 3, math.pi * 5 / 6)
        azimuth += between
    return walls


def _racks(rng, scale):
    count = int(rng.integers(1, RACKS + 1))
    first = rng.uniform(-math.pi, math.pi)
    parts = []
    for quarter in rng.permutation(4)[:count]:
        shape = {name: rng.uniform(*limits) for name, limits in RACK.items()}
        near, depth, width = shape["near"], shape["depth"], shape["width"]
        width = min(width, 2.0 * near)  # neighbouring racks do not intersect
        uprights = int(rng.choice(UPRIGHTS))
        most = 1 + int((TOP - shape["lowest"]) / shape["spacing"])
        boards = int(rng.integers(2, min(BOARDS, most, MOST // count - uprights) + 1))
        heights = [shape["lowest"] + i * shape["spacing"] for i in range(boards)]
        top = heights[-1] + BOARD / 2
        size = (depth, BOARD, top) if uprights == 2 else (POLE, POLE, top)
        xs = {2: (near + depth / 2,), 4: (near + POLE / 2, near + depth - POLE / 2), 0: ()}
        y = (width - size[1]) / 2
        of_rack = [((near + depth / 2, 0.0, z), (depth, width, BOARD)) for z in heights]
        of_rack += [((x, side, top / 2), size) for x in xs[uprights] for side in (y, -y)]
        objects = int(rng.integers(min(OBJECTS, MOST // count - len(of_rack)) + 1))
        for _ in range(objects * int(rng.integers(2))):
            radius, length = rng.uniform(*RADIUS), rng.uniform(*LENGTH)
            aside = width / 2 - BOARD - radius
            place = rng.uniform(near + radius, near + depth - radius), rng.uniform(-aside, aside)
            z = heights[rng.integers(boards)] + (BOARD + length) / 2
            of_rack.append(((*place, z), (radius, length)))
        azimuth = first + quarter * math.pi / 2
        parts += [_placed(*part, azimuth, scale) for part in of_rack]
    return parts


def _placed(centre, size, azimuth, scale):
    """An obstacle described in front of the robot, turned about the robot's axis.

    A box with three sizes, or an upright cylinder with its radius and length. Both are scaled.
    """
    half = round(azimuth / TURN) * TURN / 2
    cos, sin = math.cos(2 * half), math.sin(2 * half)
    (x, y, z), size = (scale * length for length in centre), [scale * edge for edge in size]
    place = rounded(cos * x - sin * y, sin * x + cos * y, z)
    if len(size) == 2:
        return Cylinder(place, *rounded(*size))
    return Box(place, rounded(*size), (0.0, 0.0, math.sin(half), math.cos(half)))
