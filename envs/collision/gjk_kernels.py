"""Convex shapes in compiled collision checks: bounds of their distance, and GJK.

What the arguments hold: `arm_kernels`.
"""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import (
    BOX,
    CORNERS,
    CYLINDER,
    FAR,
    FRAME,
    HALF,
    LINK,
    ROUNDING,
    ROW,
    SHARP,
    SIMPLEX,
    SPHERE,
)
from roboarm_nmp.utils.numba_cache import compiled, uncounted

BULLET_MARGIN = 0.001
"""m. PyBullet thickens a link's hull by this, and rounds the edges of boxes and cylinders.

Only between two boxes edges are sharp: Bullet has a detector of their contacts alone."""


# Each face of the cube of directions has this many cells squared, see `hulls._cells`.
CELLS = 8
# GJK stops at this precision (m), after 3 to 10 iterations in nearly all cases; EPA at its own.
GJK_TOLERANCE, _MAX_ITERATIONS = 1e-8, 64
# m: more than rounding can change a distance by.
ROUNDING_ERROR = 1e-9
# Bullet makes two boxes overlap by this share of their half edges where two edges meet.
_EDGE_FUDGE = 1e-5


@compiled
def rows_of_primitives(numbers):
    """`hulls.shape_rows` of obstacles as `primitives.to_array`; of hulls, only their poses."""
    rows = np.zeros((numbers.shape[0], ROW))
    half = np.empty(3)
    for i in range(numbers.shape[0]):
        kind = numbers[i, 0]
        x, y, z, w = numbers[i, 4], numbers[i, 5], numbers[i, 6], numbers[i, 7]
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
        for j in range(3):
            half[j] = numbers[i, 8 + j] if kind == SPHERE else numbers[i, 8 + j] / 2.0
        if kind == CYLINDER:
            half[0] = half[1] = numbers[i, 8]
        rounding = half[0] if kind == SPHERE else min(BULLET_MARGIN, half[0], half[1], half[2])
        row = rows[i]
        row[0], row[16] = kind, rounding
        row[4], row[5] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w)
        row[6], row[7] = 2.0 * (x * z + y * w), 2.0 * (x * y + z * w)
        row[8], row[9] = 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)
        row[10], row[11] = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w)
        row[12] = 1.0 - 2.0 * (x * x + y * y)
        for j in range(3):
            row[1 + j] = numbers[i, 1 + j]
            row[13 + j] = half[j] - rounding
    return rows


@uncounted
def sphere_gap(rows, j, centres, k):
    """Squared distance (m^2) of a body's centre from the box around a shape's core."""
    x, y, z = centres[k, 0] - rows[j, 1], centres[k, 1] - rows[j, 2], centres[k, 2] - rows[j, 3]
    u = max(abs(rows[j, 4] * x + rows[j, 7] * y + rows[j, 10] * z) - rows[j, 13], 0.0)
    v = max(abs(rows[j, 5] * x + rows[j, 8] * y + rows[j, 11] * z) - rows[j, 14], 0.0)
    w = max(abs(rows[j, 6] * x + rows[j, 9] * y + rows[j, 12] * z) - rows[j, 15], 0.0)
    return u * u + v * v + w * w


@uncounted
def box_gap(bodies, k, frames, centres, points, j, pose):
    """Distance (m) of a point from the box around a body. Writes its position to `pose`."""
    f = frames[int(bodies[k, FRAME])]
    x = points[j, 0] - centres[k, 0]
    y = points[j, 1] - centres[k, 1]
    z = points[j, 2] - centres[k, 2]
    pose[9] = f[0] * x + f[3] * y + f[6] * z
    pose[10] = f[1] * x + f[4] * y + f[7] * z
    pose[11] = f[2] * x + f[5] * y + f[8] * z
    u = max(abs(pose[9]) - bodies[k, HALF], 0.0)
    v = max(abs(pose[10]) - bodies[k, HALF + 1], 0.0)
    w = max(abs(pose[11]) - bodies[k, HALF + 2], 0.0)
    return math.sqrt(u * u + v * v + w * w)


@compiled
def box_gaps(bodies, k, frames, centres, points, begin, end, gaps):
    """Write distances (m) of points from the box around a body."""
    f = frames[int(bodies[k, FRAME])]
    xx, xy, xz, yx, yy, yz, zx, zy, zz = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    cx, cy, cz = centres[k, 0], centres[k, 1], centres[k, 2]
    half_x, half_y, half_z = bodies[k, HALF], bodies[k, HALF + 1], bodies[k, HALF + 2]
    for j in range(begin, end):
        x, y, z = points[j, 0] - cx, points[j, 1] - cy, points[j, 2] - cz
        u = max(abs(xx * x + yx * y + zx * z) - half_x, 0.0)
        v = max(abs(xy * x + yy * y + zy * z) - half_y, 0.0)
        w = max(abs(xz * x + yz * y + zz * z) - half_z, 0.0)
        gaps[j] = math.sqrt(u * u + v * v + w * w)


@uncounted
def relative_pose(rows, j, frames, f, centres, k, pose):
    """Write the pose of a shape in a body's frame: rotation (row-major) and position."""
    x, y, z = rows[j, 1] - centres[k, 0], rows[j, 2] - centres[k, 1], rows[j, 3] - centres[k, 2]
    for i in range(3):
        a, b, c = frames[f, i], frames[f, 3 + i], frames[f, 6 + i]
        pose[9 + i] = a * x + b * y + c * z
        for n in range(3):
            pose[3 * i + n] = a * rows[j, 4 + n] + b * rows[j, 7 + n] + c * rows[j, 10 + n]


@uncounted
def boxes_apart(bodies, k, rows, j, pose, gap):
    """Whether a face of the body's box, or of the box around the core, separates them by `gap`."""
    for i in range(3):
        reach = bodies[k, HALF + i]
        for n in range(3):
            reach += abs(pose[3 * i + n]) * rows[j, 13 + n]
        if abs(pose[9 + i]) > reach + gap:
            return True
    for n in range(3):
        reach, along = rows[j, 13 + n], 0.0
        for i in range(3):
            reach += abs(pose[3 * i + n]) * bodies[k, HALF + i]
            along += pose[3 * i + n] * pose[9 + i]
        if abs(along) > reach + gap:
            return True
    return False


@uncounted
def begin_gjk(rows, j, pose, s):
    """Write a vector from a core towards a body to s[28:31], where `gjk` begins."""
    # From the nearest point of the box around the core to the body's centre, in the core's axes.
    u = -(pose[0] * pose[9] + pose[3] * pose[10] + pose[6] * pose[11])
    v = -(pose[1] * pose[9] + pose[4] * pose[10] + pose[7] * pose[11])
    w = -(pose[2] * pose[9] + pose[5] * pose[10] + pose[8] * pose[11])
    u = math.copysign(max(abs(u) - rows[j, 13], 0.0), u)
    v = math.copysign(max(abs(v) - rows[j, 14], 0.0), v)
    w = math.copysign(max(abs(w) - rows[j, 15], 0.0), w)
    if u * u + v * v + w * w > 1e-12:
        for i in range(3):
            s[28 + i] = pose[3 * i] * u + pose[3 * i + 1] * v + pose[3 * i + 2] * w
        return
    s[28], s[29], s[30] = -pose[9], -pose[10], -pose[11]
    if pose[9] * pose[9] + pose[10] * pose[10] + pose[11] * pose[11] < 1e-12:
        s[28] = 1.0


@uncounted
def _farthest(vertices, cells, k, x, y, z):
    """Index of the vertex of a body that is farthest along (x, y, z)."""
    u, v, w = abs(x), abs(y), abs(z)
    if u >= v and u >= w:
        face, size, u, v = 0 if x > 0.0 else 1, u, y, z
    elif v >= w:
        face, size, u, v = 2 if y > 0.0 else 3, v, z, x
    else:
        face, size, u, v = 4 if z > 0.0 else 5, w, x, y
    cell = 0
    if size > 0.0:
        i = min(int((u / size + 1.0) * (0.5 * CELLS)), CELLS - 1)
        j = min(int((v / size + 1.0) * (0.5 * CELLS)), CELLS - 1)
        cell = ((k * 6 + face) * CELLS + i) * CELLS + j
    most, farthest = -FAR, 0
    for n in range(cells[cell], cells[cell + 1]):
        i = cells[n]
        value = vertices[i, 0] * x + vertices[i, 1] * y + vertices[i, 2] * z
        if value > most:
            most, farthest = value, i
    return farthest


@uncounted
def support(vertices, cells, k, rows, j, pose, x, y, z):
    """The point of body minus core that is farthest along (x, y, z), and the body's vertex."""
    i = _farthest(vertices, cells, k, x, y, z)
    # The core's point that is farthest the other way, in its own axes.
    u = -(pose[0] * x + pose[3] * y + pose[6] * z)
    v = -(pose[1] * x + pose[4] * y + pose[7] * z)
    w = -(pose[2] * x + pose[5] * y + pose[8] * z)
    if rows[j, 0] == LINK:
        n = _farthest(vertices, cells, int(rows[j, 17]), u, v, w)
        u, v, w = vertices[n, 0], vertices[n, 1], vertices[n, 2]
    elif rows[j, 0] == CYLINDER:
        across = math.sqrt(u * u + v * v)
        scale = rows[j, 13] / across if across > 0.0 else 0.0
        u, v, w = u * scale, v * scale, math.copysign(rows[j, 15], w)
    else:  # a box, or a sphere, whose core has no size
        u = math.copysign(rows[j, 13], u)
        v = math.copysign(rows[j, 14], v)
        w = math.copysign(rows[j, 15], w)
    ax, ay, az = vertices[i, 0], vertices[i, 1], vertices[i, 2]
    return (
        ax - (pose[9] + pose[0] * u + pose[1] * v + pose[2] * w),
        ay - (pose[10] + pose[3] * u + pose[4] * v + pose[5] * w),
        az - (pose[11] + pose[6] * u + pose[7] * v + pose[8] * w),
        ax,
        ay,
        az,
    )


@uncounted
def nearest_in_triangle(s, a, b, c):
    """The triangle of the points at s[a], s[b], s[c]: its point nearest to the origin.

    Returns its squared distance and its barycentric coordinates (Ericson, Real-Time Collision
    Detection, 2005, section 5.1.5).
    """
    abx, aby, abz = s[b] - s[a], s[b + 1] - s[a + 1], s[b + 2] - s[a + 2]
    acx, acy, acz = s[c] - s[a], s[c + 1] - s[a + 1], s[c + 2] - s[a + 2]
    d1 = -(abx * s[a] + aby * s[a + 1] + abz * s[a + 2])
    d2 = -(acx * s[a] + acy * s[a + 1] + acz * s[a + 2])
    d3 = -(abx * s[b] + aby * s[b + 1] + abz * s[b + 2])
    d4 = -(acx * s[b] + acy * s[b + 1] + acz * s[b + 2])
    d5 = -(abx * s[c] + aby * s[c + 1] + abz * s[c + 2])
    d6 = -(acx * s[c] + acy * s[c + 1] + acz * s[c + 2])
    in_a, in_b, in_c = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        u, v, w = 1.0, 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        u, v, w = 0.0, 1.0, 0.0
    elif in_c <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        u, w = 1.0 - v, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        u, v, w = 0.0, 0.0, 1.0
    elif in_b <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        u, v = 1.0 - w, 0.0
    elif in_a <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / (d4 - d3 + d5 - d6)
        u, v = 0.0, 1.0 - w
    else:
        total = in_a + in_b + in_c
        v, w = in_b / total, in_c / total
        u = 1.0 - v - w
    squared = 0.0
    for i in range(3):
        x = u * s[a + i] + v * s[b + i] + w * s[c + i]
        squared += x * x
    return squared, u, v, w


@uncounted
def _reduce(s, n):
    """Reduce a simplex of `n` points to those that span its point nearest to the origin.

    Their weights go to s[24:28]. Returns their number; 4 if the origin is inside.
    """
    if n == 4:
        best, without = FAR, -1
        u = v = w = 0.0
        for face in range(4):  # the one without point `face`
            a, b, c, d = 3 * ((face + 1) % 4), 3 * ((face + 2) % 4), 3 * ((face + 3) % 4), 3 * face
            origin, point = 0.0, 0.0
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                normal = (s[b + j] - s[a + j]) * (s[c + k] - s[a + k])
                normal -= (s[b + k] - s[a + k]) * (s[c + j] - s[a + j])
                origin -= normal * s[a + i]
                point += normal * (s[d + i] - s[a + i])
            if origin * point > 0.0:
                continue  # both are on one side
            squared, x, y, z = nearest_in_triangle(s, a, b, c)
            if squared < best:
                best, without, u, v, w = squared, face, x, y, z
        if without < 0:
            return 4
        # In the order of `nearest_in_triangle`: a, b, c are the points after `without`, cyclically.
        if without == 0:
            s[24], s[25], s[26], s[27] = 0.0, u, v, w
        elif without == 1:
            s[24], s[25], s[26], s[27] = w, 0.0, u, v
        elif without == 2:
            s[24], s[25], s[26], s[27] = v, w, 0.0, u
        else:
            s[24], s[25], s[26], s[27] = u, v, w, 0.0
    elif n == 3:
        _, s[24], s[25], s[26] = nearest_in_triangle(s, 0, 3, 6)
    elif n == 2:
        along = squared = 0.0
        for i in range(3):
            edge = s[3 + i] - s[i]
            along -= edge * s[i]
            squared += edge * edge
        s[25] = min(max(along / squared, 0.0), 1.0) if squared > 0.0 else 0.0
        s[24] = 1.0 - s[25]
    else:
        s[24] = 1.0
    left = 0
    for i in range(n):
        if s[24 + i] > 0.0:
            for k in range(3):
                s[3 * left + k], s[12 + 3 * left + k] = s[3 * i + k], s[12 + 3 * i + k]
            s[24 + left] = s[24 + i]
            left += 1
    return left


@uncounted
def gjk(vertices, cells, k, rows, j, pose, s, near, far):
    """Distance (m) of a body's hull from a shape's core; 0 where they overlap.

    It stops early, and returns the bound, where a lower bound of the distance is at least `far` or
    an upper bound is below `near`. Writes to `s`: the simplex's points (3 x 4) of body minus core,
    the body's vertices that they come from (3 x 4), weights (4), the vector from the core to the
    hull (3), and a lower bound of the distance along that vector (or -`FAR`). On entry, the vector
    is any initial one. `pose` is the core's.

    Returns the distance and the number of points in the simplex.
    """
    x, y, z = s[28], s[29], s[30]
    distance, bound, n, s[31] = math.sqrt(x * x + y * y + z * z), FAR, 0, -FAR
    for _ in range(_MAX_ITERATIONS):
        px, py, pz, ax, ay, az = support(vertices, cells, k, rows, j, pose, -x, -y, -z)
        lower = (px * x + py * y + pz * z) / distance
        if lower >= far or bound - lower <= GJK_TOLERANCE:
            s[31] = lower
            return lower if lower >= far else bound, n
        i = 3 * n
        s[i], s[i + 1], s[i + 2], s[12 + i], s[13 + i], s[14 + i] = px, py, pz, ax, ay, az
        n = _reduce(s, n + 1)
        if n == 4:
            return 0.0, n
        x = y = z = 0.0
        for i in range(n):
            x += s[24 + i] * s[3 * i]
            y += s[24 + i] * s[3 * i + 1]
            z += s[24 + i] * s[3 * i + 2]
        distance = math.sqrt(x * x + y * y + z * z)
        if distance < 1e-9:  # contact: the vector has no direction
            return 0.0, n
        s[28], s[29], s[30] = x, y, z
        if distance < near or distance >= bound:
            return min(distance, bound), n
        bound = distance
    return bound, n


@uncounted
def write_body_row(bodies, k, frames, centres, row):
    """Write a body as a shape to `row` (1, `ROW`)."""
    row[0, 0], row[0, 16], row[0, 17] = LINK, bodies[k, ROUNDING], k
    for i in range(3):
        row[0, 1 + i], row[0, 13 + i] = centres[k, i], bodies[k, HALF + i]
    for i in range(9):
        row[0, 4 + i] = frames[int(bodies[k, FRAME]), i]


@uncounted
def both_boxes(bodies, k, rows, j):
    """Whether a body and a shape are boxes."""
    if bodies[k, CORNERS] < 0.0:
        return False
    if rows[j, 0] != LINK:
        return rows[j, 0] == BOX
    other = int(rows[j, 17])  # or a convex hull's, which is none of the arm's
    return other < bodies.shape[0] and bodies[other, CORNERS] >= 0.0


@uncounted
def write_sharp_row(bodies, rows, j, sharp):
    """Write a box, a row of `rows`, without its rounding to `sharp` (1, `ROW`)."""
    for i in range(ROW):
        sharp[0, i] = rows[j, i]
    for i in range(3):
        sharp[0, 13 + i] += rows[j, 16]
    sharp[0, 16] = 0.0
    if rows[j, 0] == LINK:
        sharp[0, 17] = bodies[int(rows[j, 17]), SHARP]


@uncounted
def _write_box(vertices, corners, s, n):
    """Write a box's axes, in its frame, to s[n:n+9], and its half edges (m) to s[n+9:n+12]."""
    for axis in range(3):
        squared = 0.0
        for i in range(3):
            # Corners are in the order of binary numbers, with x the most significant.
            edge = (vertices[corners + (4 >> axis), i] - vertices[corners, i]) / 2
            s[n + 3 * axis + i] = edge
            squared += edge * edge
        s[n + 9 + axis] = math.sqrt(squared)
        for i in range(3):
            s[n + 3 * axis + i] /= s[n + 9 + axis]


@uncounted
def _box_reach(s, n, x, y, z):
    """How far (m) the box at s[n:n+12] reaches along (x, y, z) from its centre."""
    reach = 0.0
    for axis in range(3):
        i = n + 3 * axis
        reach += s[n + 9 + axis] * abs(s[i] * x + s[i + 1] * y + s[i + 2] * z)
    return reach


@uncounted
def _boxes_separated(bodies, vertices, k, rows, j, pose, s, gap):
    """Whether two boxes are more than `gap` (m, at most 0) apart, as Bullet's `dBoxBox2` says.

    The 15 axes that can separate them are the normals of faces, and those of pairs of edges.
    """
    _write_box(vertices, int(bodies[k, CORNERS]), s, 0)
    if rows[j, 0] == LINK:
        _write_box(vertices, int(bodies[int(rows[j, 17]), CORNERS]), s, 12)
    else:
        for n in range(3):
            s[21 + n] = rows[j, 13 + n] + rows[j, 16]
            for i in range(3):
                s[12 + 3 * n + i] = 1.0 if i == n else 0.0
    for n in range(12, 21, 3):  # into the body's frame
        x, y, z = s[n], s[n + 1], s[n + 2]
        for i in range(3):
            s[n + i] = pose[3 * i] * x + pose[3 * i + 1] * y + pose[3 * i + 2] * z
    halves = s[9] + s[10] + s[11] + s[21] + s[22] + s[23]
    for n in range(15):
        fudge = 0.0
        if n < 6:
            i = 3 * n if n < 3 else 3 * n + 3
            x, y, z = s[i], s[i + 1], s[i + 2]
        else:
            a, b = (n - 6) // 3, (n - 6) % 3
            i, m = 3 * a, 12 + 3 * b
            x = s[i + 1] * s[m + 2] - s[i + 2] * s[m + 1]
            y = s[i + 2] * s[m] - s[i] * s[m + 2]
            z = s[i] * s[m + 1] - s[i + 1] * s[m]
            fudge = _EDGE_FUDGE * (halves - s[9 + a] - s[21 + b])
        reach = _box_reach(s, 0, x, y, z) + _box_reach(s, 12, x, y, z) + fudge
        away = abs(pose[9] * x + pose[10] * y + pose[11] * z)
        if away - reach > gap * math.sqrt(x * x + y * y + z * z):
            return True
    return False


@uncounted
def _are_boxes_apart(bodies, vertices, cells, k, rows, j, pose, s, gap):
    """`is_apart` of two boxes. `gap` includes their rounding, which they do not have here."""
    margin = gap - (bodies[k, ROUNDING] + rows[j, 16])
    if abs(margin) < ROUNDING_ERROR:
        margin = 0.0
    if not _boxes_separated(bodies, vertices, k, rows, j, pose, s, min(margin, 0.0)):
        return False
    if margin <= 0.0:
        return True
    sharp = s[None, SIMPLEX:]
    write_sharp_row(bodies, rows, j, sharp)
    begin_gjk(sharp, 0, pose, s)
    return (
        gjk(vertices, cells, int(bodies[k, SHARP]), sharp, 0, pose, s, margin, margin)[0] >= margin
    )


@uncounted
def is_apart(bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap):
    """Whether a body's hull is at least `gap` (m) from a shape's core."""
    relative_pose(rows, j, frames, int(bodies[k, FRAME]), centres, k, pose)
    if both_boxes(bodies, k, rows, j):
        return _are_boxes_apart(bodies, vertices, cells, k, rows, j, pose, s, gap)
    if boxes_apart(bodies, k, rows, j, pose, gap):
        return True
    begin_gjk(rows, j, pose, s)
    return gjk(vertices, cells, k, rows, j, pose, s, gap, gap)[0] >= gap


@uncounted
def gap_along(vertices, cells, k, rows, j, frames, f, pose, axes, n):
    """A lower bound of the distance (m) of a body's hull from a shape's core, along an axis.

    Row n of `axes` (m, 3) is the axis from the core to the body, in the base's frame. NaN for one
    of zeros.
    """
    x = frames[f, 0] * axes[n, 0] + frames[f, 3] * axes[n, 1] + frames[f, 6] * axes[n, 2]
    y = frames[f, 1] * axes[n, 0] + frames[f, 4] * axes[n, 1] + frames[f, 7] * axes[n, 2]
    z = frames[f, 2] * axes[n, 0] + frames[f, 5] * axes[n, 1] + frames[f, 8] * axes[n, 2]
    px, py, pz, _, _, _ = support(vertices, cells, k, rows, j, pose, -x, -y, -z)
    return (px * x + py * y + pz * z) / math.sqrt(x * x + y * y + z * z)


@uncounted
def was_apart(bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap, axes, n):
    """`is_apart` for many similar states of the arm, which is faster.

    Row n of `axes` is the axis of `gap_along` along which the two were apart before; zeros at
    first. It is tried first, and written here.
    """
    f = int(bodies[k, FRAME])
    relative_pose(rows, j, frames, f, centres, k, pose)
    if both_boxes(bodies, k, rows, j):
        return _are_boxes_apart(bodies, vertices, cells, k, rows, j, pose, s, gap)
    along = gap_along(vertices, cells, k, rows, j, frames, f, pose, axes, n)
    if along >= gap + ROUNDING_ERROR or boxes_apart(bodies, k, rows, j, pose, gap):
        return True
    begin_gjk(rows, j, pose, s)
    if gjk(vertices, cells, k, rows, j, pose, s, gap, gap)[0] < gap:
        return False
    for i in range(3):
        x, y, z = frames[f, 3 * i], frames[f, 3 * i + 1], frames[f, 3 * i + 2]
        axes[n, i] = x * s[28] + y * s[29] + z * s[30]
    return True
