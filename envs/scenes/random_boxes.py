"""Random scenes: shelves, poles and walls around the arm (paper, section 4).

The paper gives the kinds of obstacles and their numbers. The distribution is calibrated to
go-to-goal's success rate in the paper (docs/guide/tasks.md). For an arm other than the Panda, all
lengths are multiplied by the ratio of their reaches.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.scenes.primitives import Box, Scene

Rng = np.random.Generator
# Positions and sizes are multiples of this (m), about a millimetre, and yaws of a 256th of a turn,
# so that files are small.
GRID = 2.0**-10
TURN = 2 * math.pi / 256
SHELVES = 0.33  # share of the obstacles
POLES = 0.57  # the rest are walls
# Uniform ranges, m: distance of the near side (of a pole's centre) from the robot's axis, and
# sizes. A shelf is a board, wider than deep; walls and poles stand on the table.
SHELF = {"near": (0.28, 0.42), "depth": (0.15, 0.3), "width": (0.3, 0.5), "thickness": (0.02, 0.04)}
SHELF_HEIGHT = (0.3, 0.9)
POLE = {"centre": (0.26, 0.45), "thickness": (0.02, 0.04), "height": (1.2, 1.5)}
WALL = {"near": (0.26, 0.4), "length": (0.1, 0.25), "thickness": (0.01, 0.03), "height": (1.2, 1.5)}
# Obstacles are rough, because the arm slides along smooth ones to its goal.
FRICTION = 2.45
# The least distance (m) of obstacles from the robot's axis, below the shoulder's top (m).
KEEP_CLEAR = 0.14
SHOULDER = 0.45


@dataclass(frozen=True)
class RandomBoxes:
    """Scenes of `fewest` to `most` boxes, all numbers equally likely."""

    fewest: int
    most: int
    base: Scene = Scene(friction=FRICTION)

    def sample(self, rng: Rng) -> Scene:
        """A `Scene` drawn with a NumPy Generator."""
        count = int(rng.integers(self.fewest, self.most + 1))
        scale = scale_of(self.base.robot)
        first = rng.uniform(-math.pi, math.pi)
        sector = 2 * math.pi / count
        boxes = []
        while len(boxes) < count:
            # Each box has a sector of its own, so that they stand all around the robot.
            azimuth = first + sector * (len(boxes) + rng.uniform(-0.5, 0.5))
            box = _sample_box(rng, azimuth, scale)
            if distance_to_robot(box, scale) >= KEEP_CLEAR * scale:
                boxes.append(box)
        return replace(self.base, obstacles=tuple(boxes))


def _sample_box(rng: Rng, azimuth: float, scale: float) -> Box:
    def shape_of(ranges: dict[str, tuple[float, float]]) -> dict[str, float]:
        return {name: scale * rng.uniform(*limits) for name, limits in ranges.items()}

    kind = rng.random()
    if kind < SHELVES:
        shape = shape_of(SHELF)
        size = (shape["depth"], shape["width"], shape["thickness"])
        distance = shape["near"] + shape["depth"] / 2
        height = scale * rng.uniform(*SHELF_HEIGHT)
    elif kind < SHELVES + POLES:
        shape = shape_of(POLE)
        size = (shape["thickness"], scale * rng.uniform(*POLE["thickness"]), shape["height"])
        distance = shape["centre"]
        height = shape["height"] / 2
    else:
        shape = shape_of(WALL)
        size = (shape["length"], shape["thickness"], shape["height"])
        distance = shape["near"] + shape["length"] / 2
        height = shape["height"] / 2
    yaw = azimuth + rng.uniform(-math.pi / 2, math.pi / 2)
    half = round(yaw / TURN) * TURN / 2
    return Box(
        rounded(distance * math.cos(azimuth), distance * math.sin(azimuth), height),
        rounded(*size),
        (0.0, 0.0, math.sin(half), math.cos(half)),
    )


def rounded(*lengths: float) -> tuple[Any, ...]:
    """Lengths (m), as multiples of `GRID`."""
    return tuple(round(length / GRID) * GRID for length in lengths)


def distance_to_robot(box: Box, scale: float) -> float:
    """Distance (m) of an upright box from the part of the robot's axis below its shoulder's top."""
    sin = 2 * box.orientation[2] * box.orientation[3]
    cos = 1 - 2 * box.orientation[2] ** 2
    x, y, z = box.position
    # The axis in the box's frame.
    along_x = abs(cos * x + sin * y) - box.size[0] / 2
    along_y = abs(cos * y - sin * x) - box.size[1] / 2
    below = z - box.size[2] / 2 - SHOULDER * scale
    above = -(z + box.size[2] / 2)
    return math.hypot(max(along_x, 0.0), max(along_y, 0.0), max(below, above, 0.0))
