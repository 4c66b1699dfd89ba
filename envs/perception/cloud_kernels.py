"""Point clouds, compiled: which points to leave out, and which to choose."""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import (
    RADIUS,
    ROUNDING,
    SPHERE,
    place_arm,
    working_memory,
)
from roboarm_nmp.envs.collision.gjk_kernels import begin_gjk, box_gap, gjk, sphere_gap
from roboarm_nmp.utils.numba_cache import compiled

NOT_FINITE, OUTSIDE, KNOWN, OF_ARM, OF_OBSTACLE = range(5)
"""Labels of points, in the order in which they are tried."""


@compiled
def label_points(points, low, high, rows, known_distance, q, arm_distance, arm, labels):
    """Write the labels of points (n, 3), m, to `labels` (n,).

    `low`, `high` (3,): the workspace. `rows`: shapes, of which points less than `known_distance`
    (m) away are `KNOWN`. Those less than `arm_distance` (m) from the arm, its base included, in the
    normalised configuration `q` are `OF_ARM`; if `q` is empty, there is no arm.
    """
    chain, bodies, _, vertices, cells = arm
    frames, centres, pose, s, ball = working_memory(chain, bodies)
    ball[0, 0] = SPHERE
    num_bodies = 0
    if q.shape[0] > 0:
        num_bodies = bodies.shape[0]
        place_arm(q, chain, bodies, frames, centres)
    for j in range(points.shape[0]):
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            labels[j] = NOT_FINITE
            continue
        if (x < low[0] or y < low[1] or z < low[2]) or (x > high[0] or y > high[1] or z > high[2]):
            labels[j] = OUTSIDE
            continue
        labels[j] = OF_OBSTACLE
        for i in range(rows.shape[0]):
            gap = known_distance + rows[i, 16]
            if sphere_gap(rows, i, points, j) < gap * gap:
                labels[j] = KNOWN
                break
        for k in range(num_bodies if labels[j] == OF_OBSTACLE else 0):
            gap = arm_distance + bodies[k, ROUNDING]
            u, v, w = x - centres[k, 0], y - centres[k, 1], z - centres[k, 2]
            reach = bodies[k, RADIUS] + gap
            if u * u + v * v + w * w >= reach * reach:
                continue
            if box_gap(bodies, k, frames, centres, points, j, pose) >= gap:
                continue
            begin_gjk(ball, 0, pose, s)
            if gjk(vertices, cells, k, ball, 0, pose, s, gap, gap)[0] < gap:
                labels[j] = OF_ARM
                break


@compiled
def farthest(points, chosen):
    """Write the points of `envs.perception.point_clouds.farthest_points` to `chosen` (k, 3).

    `points`: float32 (n, 3), m. Squares are added in NumPy's order, for the same last bits.
    """
    n = points.shape[0]
    nearest = np.empty(n, np.float32)
    for k in range(min(chosen.shape[0], n)):
        most, best = np.float32(-1.0), 0
        for i in range(n):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            if k > 0:
                x, y, z = x - chosen[k - 1, 0], y - chosen[k - 1, 1], z - chosen[k - 1, 2]
            distance = np.sqrt(x * x + y * y + z * z)
            if k < 2 or distance < nearest[i]:
                nearest[i] = distance
            if nearest[i] > most:
                most, best = nearest[i], i
        for j in range(3):
            chosen[k, j] = points[best, j]
