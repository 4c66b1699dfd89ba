"""A grid of lower bounds of the distance from a point cloud, for checks of motions."""

import math

import numpy as np

from roboarm_nmp.envs.collision.lanes_kernels import WIDTH, load, smaller, store
from roboarm_nmp.utils.numba_cache import compiled, uncounted

_CELL = 0.03  # m
_MAX_CELLS = 1_000_000  # of a cloud that is spread out, cells are larger


@compiled
def distance_grid(points, farthest, within):
    """Lower bounds of the distance of places from the nearest of points (n, 3), m.

    Args:
        farthest: m; points farther from the origin do not count.
        within: m; the bounds are at most this.

    Returns:
        `near`, float32, the bound of each cell, row-major; `numbers`, int64 (3,), of cells along x,
        y, z; `place`, float32 (5,): where the first cell begins, cells per m, and the bound outside
        of the grid. Without points there are no cells.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if x * x + y * y + z * z < farthest * farthest:
            for axis in range(3):
                low[axis] = min(low[axis], points[i, axis])
                high[axis] = max(high[axis], points[i, axis])
    numbers, place = np.zeros(3, np.int64), np.zeros(5, np.float32)
    if high[0] < low[0]:
        return np.empty(0, np.float32), numbers, place
    volume = 1.0
    for axis in range(3):
        volume *= high[axis] - low[axis] + 2.0 * within
    cell = max(_CELL, (volume / _MAX_CELLS) ** (1.0 / 3.0))
    reach = within + cell  # so that cells at the grid's border are far from all points, too
    for axis in range(3):
        low[axis] -= reach
        numbers[axis] = int((high[axis] + reach - low[axis]) / cell) + 1
        place[axis] = low[axis]
    numbers[2] = max(numbers[2], WIDTH)
    place[3], place[4] = 1.0 / cell, within
    nx, ny, nz = numbers[0], numbers[1], numbers[2]
    # Squared distances of the cells' centres.
    near = np.full(nx * ny * nz, np.float32((within + cell) ** 2))
    steps = int(reach / cell) + 1
    ramp = np.arange(WIDTH).astype(np.float32)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if x * x + y * y + z * z >= farthest * farthest:
            continue
        u, v, w = (x - low[0]) / cell, (y - low[1]) / cell, (z - low[2]) / cell
        first, last = max(int(w) - steps, 0), min(int(w) + steps + 1, nz)
        for a in range(max(int(u) - steps, 0), min(int(u) + steps + 1, nx)):
            for b in range(max(int(v) - steps, 0), min(int(v) + steps + 1, ny)):
                across = ((a + 0.5 - u) ** 2 + (b + 0.5 - v) ** 2) * cell * cell
                if across >= reach * reach:
                    continue
                row = (a * ny + b) * nz
                for c in range(first, last, WIDTH):
                    c = min(c, nz - WIDTH)
                    _lower(near, row + c, across, c + 0.5 - w, cell, ramp)
    # A place is at most half a cell's diagonal from its centre. (And 1 um for rounding.)
    half = 0.5 * math.sqrt(3.0) * cell + 1e-6
    for i in range(near.shape[0]):
        near[i] = min(math.sqrt(near[i]) - half, within)
    return near, numbers, place


@uncounted
def _lower(near, begin, across, along, cell, ramp):
    """Lower squared distances in a row of `WIDTH` cells to those from one point."""
    there = (load(ramp, 0) + np.float32(along)) * np.float32(cell)
    squared = there * there + np.float32(across)
    store(near, begin, smaller(squared, load(near, begin)))
