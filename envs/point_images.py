"""Images of point clouds, to be laid over those of PyBullet's cameras."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

OBSERVED_COLOUR, LEFT_OUT_COLOUR = (255, 140, 0), (165, 165, 165)
LARGEST, SMALLEST = 40.0, 0.7  # pixels: radii of the balls
DARKEST = 0.55  # share of the colour at a ball's edge
_NOTHING = np.iinfo(np.uint64).max


class PointImage(NamedTuple):
    """Balls as a camera sees them.

    colour: uint8 (height, width, 3). depth: float32 (height, width), as PyBullet's: 0 to 1, and
    infinite where there is no ball.
    """

    colour: np.ndarray
    depth: np.ndarray

    def over(self, colour: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """An image (height, width, 3) and its depths with those balls that are in front."""
        in_front = self.depth < depth
        mixed = np.where(in_front[..., None], self.colour, colour).astype(colour.dtype)
        return mixed, np.where(in_front, self.depth, depth)


def point_image(
    clouds: Sequence[tuple[np.ndarray, float, tuple[int, int, int]]],
    view: Sequence[float],
    projection: Sequence[float],
    size: tuple[int, int],
) -> PointImage:
    """Draw each point as a shaded ball.

    Args:
        clouds: points (n, 3), m, the radius (m) of a ball, and its colour (red, green, blue).
        view, projection: PyBullet's matrices of the camera, 16 numbers each.
        size: (width, height) in pixels.
    """
    width, height = size
    from_world = np.reshape(view, (4, 4)).T
    to_image = np.reshape(projection, (4, 4)).T
    # Of each pixel: the depth of the nearest ball, as the bits of a float32, and its colour.
    nearest = np.full(width * height, _NOTHING, np.uint64)
    for points, radius, colour in clouds:
        eye = np.reshape(points, (-1, 3)) @ from_world[:3, :3].T + from_world[:3, 3]
        eye = eye[-eye[:, 2] > 0.1 + radius]
        if not len(eye):
            continue
        away = -eye[:, 2]
        x = (to_image[0, 0] * eye[:, 0] / away + 1) * width / 2
        y = (1 - to_image[1, 1] * eye[:, 1] / away) * height / 2
        pixels = np.clip(radius * to_image[1, 1] * height / 2 / away, SMALLEST, LARGEST)
        reach = math.ceil(pixels.max())
        for down in range(-reach, reach + 1):
            for right in range(-reach, reach + 1):
                column, row = np.floor(x) + right, np.floor(y) + down
                squared = ((column + 0.5 - x) ** 2 + (row + 0.5 - y) ** 2) / pixels**2
                hit = (squared < 1) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
                bulge = np.sqrt(1 - squared[hit])
                z = radius * bulge - away[hit]
                depth = 0.5 - (to_image[2, 2] + to_image[2, 3] / z) / 2
                shades = DARKEST + (1 - DARKEST) * bulge
                red, green, blue = ((part * shades).astype(np.uint64) for part in colour)
                key = depth.astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)
                key |= red << np.uint64(16) | green << np.uint64(8) | blue
                np.minimum.at(nearest, (row[hit] * width + column[hit]).astype(np.int64), key)
    empty = nearest == _NOTHING
    depth = (nearest >> np.uint64(32)).astype(np.uint32).view(np.float32).copy()
    depth[empty], nearest[empty] = np.inf, 0
    colours = [(nearest >> np.uint64(shift)).astype(np.uint8) for shift in (16, 8, 0)]
    colour = np.stack(colours, axis=-1)
    return PointImage(colour.reshape(height, width, 3), depth.reshape(height, width))
