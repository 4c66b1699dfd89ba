"""Point clouds for collision checks: cubes, groups, and a grid of lower bounds of the distance."""

import math

import numpy as np

from roboarm_nmp.envs.collision.lanes_kernels import (
    WIDTH,
    load,
    nearest_int,
    root,
    smaller,
    spread,
    store,
)
from roboarm_nmp.utils.numba_cache import compiled, uncounted

_CELL = 0.03  # m
_NOWHERE = np.float32(1e9)  # m
_MAX_CELLS = 1_000_000  # of a cloud that is spread out, cells are larger


@compiled
def first_in_cells(points, cell, count_around):
    """The first of the points (n, 3), m, in each cube with edges of `cell`, m, of their type.

    Returns, for the m cubes in the order of their first points: int64 (m,), the index of that
    point; int32 (n,), the cube of each point; int64 (m,), how many points the cube and, with
    `count_around`, the 26 around it have.
    """
    n, size = points.shape[0], 1024
    while size < 2 * n:
        size *= 2
    table = np.full(size, -1, np.int32)  # a hash table of indices of cubes
    cells, cubes = np.empty((n, 3), np.int64), np.empty(n, np.int32)
    first, count = np.empty(n, np.int64), np.zeros(n, np.int64)
    m = _find_cells(points, cell, table, cells, cubes, first, count)
    if not count_around:
        return first[:m], cubes, count[:m]
    around = np.zeros(m, np.int64)
    for n in range(m):
        for i in range(27):
            x = cells[n, 0] + i // 9 - 1
            y = cells[n, 1] + i // 3 % 3 - 1
            z = cells[n, 2] + i % 3 - 1
            neighbour = table[_slot(table, cells, x, y, z)]
            if neighbour >= 0:
                around[n] += count[neighbour]
    return first[:m], cubes, around


@uncounted
def _find_cells(points, cell, table, cells, cubes, first, count):
    m = 0
    for i in range(points.shape[0]):
        x = int(math.floor(points[i, 0] / cell))
        y = int(math.floor(points[i, 1] / cell))
        z = int(math.floor(points[i, 2] / cell))
        # The point before is often in the same cell.
        k = cubes[i - 1] if i > 0 else -1
        if k < 0 or cells[k, 0] != x or cells[k, 1] != y or cells[k, 2] != z:
            slot = _slot(table, cells, x, y, z)
            k = table[slot]
            if k < 0:
                cells[m, 0], cells[m, 1], cells[m, 2], first[m] = x, y, z, i
                table[slot] = k = m
                m += 1
        cubes[i] = k
        count[k] += 1
    return m


@uncounted
def _slot(table, cells, x, y, z):
    """Where a cell is in a hash table, or the empty place where it belongs."""
    mixed = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    mixed *= 0x1E3779B97F4A7C15
    slot = (mixed ^ (mixed >> 29)) & (table.shape[0] - 1)
    while True:
        n = table[slot]
        if n < 0 or (cells[n, 0] == x and cells[n, 1] == y and cells[n, 2] == z):
            return slot
        slot = (slot + 1) & (table.shape[0] - 1)


@compiled
def group_cubes(points, cubes, order, count, group):
    """Points in groups of cubes, as `hulls.group_points` returns them.

    Args:
        points: float64 (n, 3), m.
        cubes: int32 (n,), the cube of each point.
        order: int64 (m,), the cubes in the order in which their points are wanted.
        count: int64 (m,), how many points each cube has.
        group: int64 (m,), the group of each cube, ascending along `order`.
    """
    m = order.shape[0]
    begins, arranged = np.empty(m, np.int64), np.empty((points.shape[0], 4))
    groups = np.empty((group[order[m - 1]] + 1 if m else 0, 6))
    _arrange(points, cubes, order, count, begins, arranged)
    first = 0
    for i in range(1, m + 1):
        if i == m or group[order[i]] != group[order[first]]:
            last = order[i - 1]
            begin, end = begins[order[first]], begins[last] + count[last]
            _write_group(arranged, begin, end, groups, group[last])
            first = i
    return arranged, groups


@uncounted
def _arrange(points, cubes, order, count, begins, arranged):
    n = 0
    for i in range(order.shape[0]):
        begins[order[i]] = n
        n += count[order[i]]
    for i in range(points.shape[0]):
        j = begins[cubes[i]]
        begins[cubes[i]] += 1
        for axis in range(3):
            arranged[j, axis] = points[i, axis]
        arranged[j, 3] = j + 1
    for i in range(order.shape[0]):
        begins[i] -= count[i]
        arranged[begins[i], 3] = begins[i] + count[i]


@uncounted
def _squared(rows, i, others, j):
    x, y, z = rows[i, 0] - others[j, 0], rows[i, 1] - others[j, 1], rows[i, 2] - others[j, 2]
    return x * x + y * y + z * z


@uncounted
def _write_group(points, begin, end, groups, g):
    x, y, z = points[begin, 0], points[begin, 1], points[begin, 2]
    u, v, w = x, y, z
    for i in range(begin + 1, end):
        x, u = min(x, points[i, 0]), max(u, points[i, 0])
        y, v = min(y, points[i, 1]), max(v, points[i, 1])
        z, w = min(z, points[i, 2]), max(w, points[i, 2])
    groups[g, 0], groups[g, 1], groups[g, 2] = (x + u) / 2.0, (y + v) / 2.0, (z + w) / 2.0
    farthest = 0.0
    for i in range(begin, end):
        farthest = max(farthest, _squared(points, i, groups, g))
    groups[g, 3], groups[g, 4], groups[g, 5] = math.sqrt(farthest), begin, end


@compiled
def blocks_of_points(points, groups):
    """The points of `group_cubes`, 16 neighbours at a time, in float32, m.

    Returns:
        `balls`: of 16 blocks at a time, the x, y and z of the centres of balls around the points,
        and the radii; `columns`: of each block, the points' x, y and z; `begins`, int64: the index
        of a block's first point. What is missing is `_NOWHERE`.
    """
    number = 0
    for g in range(groups.shape[0]):
        number += (int(groups[g, 5] - groups[g, 4]) + WIDTH - 1) // WIDTH
    begins = np.empty(number, np.int64)
    balls = np.full((number + WIDTH - 1) // WIDTH * 4 * WIDTH, _NOWHERE)
    columns = np.full(number * 3 * WIDTH, _NOWHERE)
    ball = np.empty((1, 6))
    block = 0
    for g in range(groups.shape[0]):
        for begin in range(int(groups[g, 4]), int(groups[g, 5]), WIDTH):
            end = min(begin + WIDTH, int(groups[g, 5]))
            begins[block] = begin
            for i in range(begin, end):
                for axis in range(3):
                    columns[(3 * block + axis) * WIDTH + i - begin] = points[i, axis]
            _write_group(points, begin, end, ball, 0)
            place = block // WIDTH * 4 * WIDTH + block % WIDTH
            for i in range(4):
                balls[place + i * WIDTH] = ball[0, i]
            block += 1
    return balls, columns, begins


@compiled
def distance_grid(points, farthest, within):
    """Lower bounds of the distance of cells' centres from points.

    Args:
        points: float64 (n, 4), of `group_cubes`: the bounds are those of the boxes around cubes.
        farthest: m; points farther from the origin do not count.
        within: m; bounds matter up to this.

    Returns:
        `near`, float32, the square of each cell's bound, row-major; `numbers`, int64 (3,), of cells
        along x, y, z; `place`, float32 (4,): where the first cell begins, and cells per m. Without
        points there are no cells.
    """
    boxes = np.empty((points.shape[0], 6))
    number = _write_boxes(points, farthest, boxes)
    numbers, place = np.zeros(3, np.int64), np.zeros(4, np.float32)
    if number == 0:
        return np.empty(0, np.float32), numbers, place
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(number):
        for axis in range(3):
            low[axis] = min(low[axis], boxes[i, axis])
            high[axis] = max(high[axis], boxes[i, 3 + axis])
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
    place[3] = 1.0 / cell
    near = np.full(numbers[0] * numbers[1] * numbers[2], np.float32(reach * reach))
    across, along = np.empty(numbers[1]), np.empty(numbers[2] + WIDTH, np.float32)
    for i in range(number):
        _lower(boxes[i], low, cell, reach, numbers, across, along, near)
    return near, numbers, place


@uncounted
def _write_boxes(points, farthest, boxes):
    """Write the lower and upper corners of cubes' points; returns their number."""
    number = i = 0
    while i < points.shape[0]:
        end, any_near = int(points[i, 3]), False
        for axis in range(3):
            boxes[number, axis], boxes[number, 3 + axis] = np.inf, -np.inf
        for k in range(i, end):
            x, y, z = points[k, 0], points[k, 1], points[k, 2]
            if x * x + y * y + z * z < farthest * farthest:
                any_near = True
                for axis in range(3):
                    boxes[number, axis] = min(boxes[number, axis], points[k, axis])
                    boxes[number, 3 + axis] = max(boxes[number, 3 + axis], points[k, axis])
        number += any_near
        i = end
    return number


@uncounted
def _lower(box, low, cell, reach, numbers, across, along, near):
    """Lower squared distances of cells' centres to those from a box."""
    ny, nz = numbers[1], numbers[2]
    begin_a, end_a = _cells_near(box, low, cell, reach, numbers, 0)
    begin_b, end_b = _cells_near(box, low, cell, reach, numbers, 1)
    begin_c, end_c = _cells_near(box, low, cell, reach, numbers, 2)
    begin_c = min(begin_c, nz - WIDTH)
    for c in range(begin_c, end_c + WIDTH):
        along[c] = _squared_gap(box, low, cell, 2, c)
    for b in range(begin_b, end_b):
        across[b] = _squared_gap(box, low, cell, 1, b)
    for a in range(begin_a, end_a):
        away = _squared_gap(box, low, cell, 0, a)
        for b in range(begin_b, end_b):
            squared = away + across[b]
            if squared >= reach * reach:
                continue
            row = (a * ny + b) * nz
            for c in range(begin_c, end_c, WIDTH):
                c = min(c, nz - WIDTH)
                lowered = load(along, c) + spread(np.float32(squared))
                store(near, row + c, smaller(lowered, load(near, row + c)))


@uncounted
def _cells_near(box, low, cell, reach, numbers, axis):
    begin = int((box[axis] - low[axis] - reach) / cell)
    end = int((box[3 + axis] - low[axis] + reach) / cell) + 1
    return max(begin, 0), min(end, numbers[axis])


@uncounted
def _squared_gap(box, low, cell, axis, i):
    at = low[axis] + (i + 0.5) * cell
    gap = max(box[axis] - at, at - box[3 + axis], 0.0)
    return gap * gap


@uncounted
def offsets(u, v, w, place):
    """How far (m) places are from the centres of their cells; u, v, w: in cells, from the first."""
    u, v, w = u - np.float32(0.5), v - np.float32(0.5), w - np.float32(0.5)
    u, v, w = u - nearest_int(u), v - nearest_int(v), w - nearest_int(w)
    return root(u * u + v * v + w * w) * (np.float32(1.0) / place[3])
