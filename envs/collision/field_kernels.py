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
from roboarm_nmp.envs.collision.lanes_kernels import WIDTH, load, smaller, spread, store
from roboarm_nmp.utils.numba_cache import compiled, uncounted

LOWEST, HIGHEST = -0.05, 0.2  # m: distances in a field are clipped to these
STEP = (HIGHEST - LOWEST) / 255.0  # m: they are stored as uint8


@compiled
def fill_field(points, boxes, low, cell, sizes):
    """The distances of a grid's places from points (n, 3) and boxes (b, 2, 3), m: uint8 (x, y, z).

    A box is its lower and upper corner; inside of it, the distance is minus the depth. The first
    place is at `low` (3,), the others follow every `cell` m.
    """
    nx, ny, nz = sizes
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
    numbers = np.empty((nx, ny, nz), np.uint8)
    for a in range(nx):
        for b in range(ny):
            for c in range(nz):
                numbers[a, b, c] = _number(math.sqrt(field[(a * ny + b) * nz + c]))
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
    """Distances of the arm's spheres, and the way out.

    Args:
        states: float32 (m, n), normalised.
        rows: int64 (m,): the field of each state.
        fields: uint8 (f, x, y, z), of `fill_field`.
        low, cell: m, as of `fill_field`.
        chain: of `hulls.arm_hulls`.
        spheres: float64 (s, 5): frame, centre there, radius.
        hinge: m.
        distances: float32 (m, s), m; is written.
        uphill: float32 (m, n), m per unit of normalised configuration; is written. The gradient of
            the sum of all distances that are below `hinge`.
    """
    sizes = fields.shape[1:]
    frames = np.zeros((chain.shape[0], 12))
    centres = np.empty((spheres.shape[0], 3))
    state = np.empty(states.shape[1])
    base = np.empty(3, np.int64)
    share = np.empty(3)
    gradient = np.empty(3)
    corner = np.empty(8)
    edge = np.empty(4)
    for m in range(states.shape[0]):
        for j in range(states.shape[1]):
            state[j] = min(max(states[m, j], -1.0), 1.0)
            uphill[m, j] = 0.0
        place_arm(state, chain, spheres, frames, centres)
        for s in range(spheres.shape[0]):
            for axis in range(3):
                place = (centres[s, axis] - low[axis]) / cell
                place = min(max(place, 0.0), sizes[axis] - 1.001)
                base[axis] = int(place)
                share[axis] = place - base[axis]
            a, b, c = base[0], base[1], base[2]
            for i in range(8):
                corner[i] = fields[rows[m], a + (i >> 2), b + ((i >> 1) & 1), c + (i & 1)]
            x, y, z = share[0], share[1], share[2]
            for i in range(4):  # along z, then y, then x
                edge[i] = corner[2 * i] + (corner[2 * i + 1] - corner[2 * i]) * z
            left = edge[0] + (edge[1] - edge[0]) * y
            right = edge[2] + (edge[3] - edge[2]) * y
            distance = LOWEST + STEP * (left + (right - left) * x) - spheres[s, RADIUS]
            distances[m, s] = distance
            if distance >= hinge:
                continue
            scale = STEP / cell
            gradient[0] = (right - left) * scale
            gradient[1] = ((edge[1] - edge[0]) * (1.0 - x) + (edge[3] - edge[2]) * x) * scale
            left = (corner[1] - corner[0]) * (1.0 - y) + (corner[3] - corner[2]) * y
            right = (corner[5] - corner[4]) * (1.0 - y) + (corner[7] - corner[6]) * y
            gradient[2] = (left * (1.0 - x) + right * x) * scale
            f = int(spheres[s, FRAME])
            while f > 0:
                ax, ay, az = frames[f, 2], frames[f, 5], frames[f, 8]
                if chain[f, PRISMATIC] == 0.0:
                    px = centres[s, 0] - frames[f, 9]
                    py = centres[s, 1] - frames[f, 10]
                    pz = centres[s, 2] - frames[f, 11]
                    ax, ay, az = ay * pz - az * py, az * px - ax * pz, ax * py - ay * px
                slope = gradient[0] * ax + gradient[1] * ay + gradient[2] * az
                uphill[m, int(chain[f, JOINT])] += slope * 0.5 * chain[f, SPAN]
                f = int(chain[f, PARENT])


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
