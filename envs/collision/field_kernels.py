"""Compiled distances of an arm's spheres from points, looked up in a grid: microseconds each."""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import (
    FRAME,
    JOINT,
    PARENT,
    PRISMATIC,
    RADIUS,
    SPAN,
    place_arm,
)
from roboarm_nmp.envs.collision.block_kernels import F32, place_block, points_of
from roboarm_nmp.envs.collision.lanes_kernels import (
    WIDTH,
    larger,
    less,
    load,
    smaller,
    spread,
    store,
)
from roboarm_nmp.utils.numba_cache import compiled, uncounted

LOWEST, HIGHEST = -0.05, 0.2  # m: distances in a field are clipped to these
STEP = (HIGHEST - LOWEST) / 255.0  # m: they are stored as uint8


@compiled
def fill_field(points, known, low, cell):
    """The distances of a grid's places from points (n, 3), m, and what is known: uint8 (x, y, z).

    `known`: another field (x, y, z). The first place is at `low` (3,), the others follow every
    `cell` m.
    """
    nx, ny, nz = known.shape
    farthest = np.float32(HIGHEST * HIGHEST)
    field = np.full(nx * ny * nz, farthest)
    along = np.empty(WIDTH, np.float32)  # squared distances in a row
    steps = int(math.ceil(HIGHEST / cell))
    for n in range(points.shape[0]):
        u = (points[n, 0] - low[0]) / cell
        v = (points[n, 1] - low[1]) / cell
        w = (points[n, 2] - low[2]) / cell
        low_a, high_a = max(int(u) - steps, 0), min(int(u) + steps + 2, nx)
        low_b, high_b = max(int(v) - steps, 0), min(int(v) + steps + 2, ny)
        for first in range(max(int(w) - steps, 0), min(int(w) + steps + 2, nz), WIDTH):
            first = min(first, nz - WIDTH)
            for i in range(WIDTH):
                along[i] = ((first + i - w) * cell) ** 2
            for a in range(low_a, high_a):
                for b in range(low_b, high_b):
                    across = np.float32(((a - u) ** 2 + (b - v) ** 2) * cell * cell)
                    if across < farthest:
                        _lower(field, (a * ny + b) * nz + first, across, along)
    numbers = known.copy().reshape(field.shape[0])
    for i in range(field.shape[0]):
        if field[i] < farthest:
            numbers[i] = min(numbers[i], _number(math.sqrt(field[i])))
    return numbers.reshape((nx, ny, nz))


@compiled
def box_field(boxes, low, cell, sizes):
    """As `fill_field`, from boxes (b, 2, 3), m: each is its lower and upper corner.

    Inside of a box, the distance is minus the depth.
    """
    numbers = np.full(sizes, _number(HIGHEST), np.uint8)
    for i in range(boxes.shape[0]):
        _lower_to_box(numbers, boxes[i], low, cell)
    return numbers


@compiled
def _number(distance):
    return int((min(max(distance, LOWEST), HIGHEST) - LOWEST) / STEP + 0.5)


@compiled
def _lower_to_box(numbers, box, low, cell):
    """Lower the numbers of a field to those of the distances from one box."""
    away = np.empty((3, max(numbers.shape)))  # along each axis; negative inside
    for axis in range(3):
        for i in range(numbers.shape[axis]):
            place = low[axis] + cell * i
            away[axis, i] = max(box[0, axis] - place, place - box[1, axis])
    for a in range(numbers.shape[0]):
        for b in range(numbers.shape[1]):
            if max(away[0, a], away[1, b]) >= HIGHEST:
                continue
            for c in range(numbers.shape[2]):
                inside, outside = -1e9, 0.0
                if away[2, c] >= HIGHEST:
                    continue
                for one in (away[0, a], away[1, b], away[2, c]):
                    inside = max(inside, one)
                    outside += max(one, 0.0) ** 2
                distance = inside if inside < 0.0 else math.sqrt(outside)
                numbers[a, b, c] = min(numbers[a, b, c], _number(distance))


@uncounted
def _lower(field, begin, across, along):
    """Lower `WIDTH` squared distances in a row to those from one point."""
    squared = load(along, 0) + spread(across)
    store(field, begin, smaller(squared, load(field, begin)))


@compiled
def sphere_distances(states, rows, fields, low, cell, chain, spheres, hinge, distances, uphill):
    """Distances of the arm's spheres, and the way out, of 16 states at a time.

    Args:
        states: float32 (m, n), normalised.
        rows: int64 (m,): the field of each state.
        fields: uint8 (f, x, y, z), of `fill_field`.
        low, cell: float32, m, as of `fill_field`.
        chain: of `hulls.arm_hulls`, float32.
        spheres: float32 (s, 5): frame, centre there, radius.
        hinge: float32, m.
        distances: float32 (m, s), m; is written.
        uphill: float32 (m, n), m per unit of normalised configuration; is written. The gradient of
            the sum of all distances that are below `hinge`.
    """
    n = states.shape[1]
    block, slopes = np.empty((n + 1) * WIDTH, np.float32), np.empty(n * WIDTH, np.float32)
    frames = np.empty(chain.shape[0] * 12 * WIDTH, np.float32)
    memory = np.empty(13 * WIDTH, np.float32)
    for first in range(0, states.shape[0], WIDTH):
        last = min(first + WIDTH, states.shape[0])
        for i in range(WIDTH):
            for j in range(n):
                number = states[min(first + i, last - 1), j]
                block[j * WIDTH + i] = min(max(number, F32(-1.0)), F32(1.0))
        slopes[:] = 0.0
        place_block(block, chain, frames)
        for s in range(spheres.shape[0]):
            _distances_of_sphere(
                spheres, s, frames, chain, rows, first, last, fields, low, cell, hinge,
                memory, distances, slopes,
            )  # fmt: skip
        for i in range(first, last):
            for j in range(n):
                uphill[i, j] = slopes[j * WIDTH + i - first]


@uncounted
def _distances_of_sphere(
    spheres, s, frames, chain, rows, first, last, fields, low, cell, hinge, memory, distances,
    slopes,
):  # fmt: skip
    """Write the distances of one sphere in a block of states, and add to the block's `slopes`."""
    f = int(spheres[s, FRAME])
    x, y, z = points_of(frames, f, spheres[s, 1], spheres[s, 2], spheres[s, 3])
    per_cell = F32(1.0) / cell
    store(memory, 0, _within((x - low[0]) * per_cell, fields.shape[1]))
    store(memory, WIDTH, _within((y - low[1]) * per_cell, fields.shape[2]))
    store(memory, 2 * WIDTH, _within((z - low[2]) * per_cell, fields.shape[3]))
    for i in range(WIDTH):
        row = rows[min(first + i, last - 1)]
        a, b, c = int(memory[i]), int(memory[WIDTH + i]), int(memory[2 * WIDTH + i])
        memory[i] -= a
        memory[WIDTH + i] -= b
        memory[2 * WIDTH + i] -= c
        for corner in range(8):
            number = fields[row, a + (corner >> 2), b + ((corner >> 1) & 1), c + (corner & 1)]
            memory[(3 + corner) * WIDTH + i] = number
    u, v, w = load(memory, 0), load(memory, WIDTH), load(memory, 2 * WIDTH)
    # Along z, then y, then x.
    low_low, low_high = _between(memory, 3, 4, w), _between(memory, 5, 6, w)
    high_low, high_high = _between(memory, 7, 8, w), _between(memory, 9, 10, w)
    left = low_low + (low_high - low_low) * v
    right = high_low + (high_high - high_low) * v
    distance = (left + (right - left) * u) * F32(STEP) + (F32(LOWEST) - spheres[s, RADIUS])
    store(memory, 11 * WIDTH, distance)
    for i in range(first, last):
        distances[i, s] = memory[11 * WIDTH + i - first]
    if less(distance, spread(hinge)) == 0:
        return
    for i in range(WIDTH):
        near = memory[11 * WIDTH + i] < hinge
        memory[12 * WIDTH + i] = F32(STEP) * per_cell if near else F32(0.0)
    scale = load(memory, 12 * WIDTH)
    slope_x = (right - left) * scale
    near_y, far_y = low_high - low_low, high_high - high_low
    slope_y = (near_y + (far_y - near_y) * u) * scale
    near_z = _mixed(memory, 3, 4, 5, 6, v)
    far_z = _mixed(memory, 7, 8, 9, 10, v)
    slope_z = (near_z + (far_z - near_z) * u) * scale
    while f > 0:
        row = 12 * WIDTH * f
        ax, ay = load(frames, row + 2 * WIDTH), load(frames, row + 5 * WIDTH)
        az = load(frames, row + 8 * WIDTH)
        if chain[f, PRISMATIC] == F32(0.0):
            px = x - load(frames, row + 9 * WIDTH)
            py = y - load(frames, row + 10 * WIDTH)
            pz = z - load(frames, row + 11 * WIDTH)
            ax, ay, az = ay * pz - az * py, az * px - ax * pz, ax * py - ay * px
        slope = slope_x * ax + slope_y * ay + slope_z * az
        j = int(chain[f, JOINT]) * WIDTH
        store(slopes, j, load(slopes, j) + slope * (F32(0.5) * chain[f, SPAN]))
        f = int(chain[f, PARENT])


@uncounted
def _within(place, size):
    return smaller(larger(place, spread(F32(0.0))), spread(F32(size - 1.001)))


@uncounted
def _between(memory, one, other, share):
    number = load(memory, one * WIDTH)
    return number + (load(memory, other * WIDTH) - number) * share


@uncounted
def _mixed(memory, one, other, third, fourth, share):
    """The slope along z of a face's lower edge and of its upper one, mixed."""
    lower = load(memory, other * WIDTH) - load(memory, one * WIDTH)
    upper = load(memory, fourth * WIDTH) - load(memory, third * WIDTH)
    return lower + (upper - lower) * share


@compiled
def sphere_centres(states, chain, spheres, centres):
    """Write the centres of the arm's spheres, m: float32 (m, s, 3)."""
    frames = np.zeros((chain.shape[0], 12))
    here = np.empty((spheres.shape[0], 3))
    state = np.empty(states.shape[1])
    for m in range(states.shape[0]):
        for j in range(states.shape[1]):
            state[j] = states[m, j]
        place_arm(state, chain, spheres, frames, here)
        for s in range(spheres.shape[0]):
            for axis in range(3):
                centres[m, s, axis] = here[s, axis]
