"""All that Numba compiles: collision checks, distances, point clouds, the safety filter, sensors.

One file holds all of it, because Numba's cache on disk does not notice changes in other files.

All functions compute in float64, for an arm of n joints with l links that may collide, besides the
base. Their working memory: `frames` (f, 12), a rotation (row-major) and a position each; `centres`
(b, 3), of the bodies; `pose` (12,), of a shape in a body's frame; `simplex`, see `_gjk`; `other`
(1, `ROW`), a body as the shape that another one may hit. What `arm` and `world` hold: `arm_hulls`,
`shape_rows` and `group_points` in `hulls`.
"""

import math

import numpy as np

from roboarm_nmp.utils.numba_cache import compiled, uncounted

BULLET_MARGIN = 0.001
"""m. PyBullet thickens a link's hull by this, and rounds the edges of boxes and cylinders."""
FAR = 1e9  # m: farther than anything
# A row describes a convex shape: kind, centre 3, rotation 9 (row-major), half edges of its core 3,
# rounding, and the body's index if it is a link. The shape is the set of points within `rounding`
# of its core: a box or a cylinder less its rounding, a sphere's centre, or a link's hull. Rows of
# obstacles may have a column more for each body of the arm, which is 1 if that may touch the shape.
# Kinds are those of `envs.scenes.primitives.to_array`, and `LINK`.
CYLINDER, SPHERE, LINK = 1, 2, 3
ROW = 18
# Each face of the cube of directions has this many cells squared, see `hulls._cells`.
CELLS = 8
# GJK stops at this precision (m), after 3 to 10 iterations in nearly all cases; EPA at its own.
_TOLERANCE, _MAX_ITERATIONS = 1e-8, 64
# m: more than rounding can change a distance by.
_ROUNDING = 1e-9
_EPA_TOLERANCE, _EPA_VERTICES, _EPA_FACES = 1e-7, 128, 768

# Columns of `arm`'s first two arrays, see `hulls.arm_hulls`.
PARENT, JOINT, PRISMATIC, BEGIN, SPAN, POSITION, ROTATION, FRAME_COLUMNS = 0, 1, 2, 3, 4, 5, 8, 17
FRAME, CENTRE, RADIUS, HALF, ROUNDING, LINK_ROW, BODY_COLUMNS = 0, 1, 4, 5, 8, 9, 10


@compiled
def _memory(chain, bodies):
    """(frames, centres, pose, simplex, other)"""
    return (
        np.zeros((chain.shape[0], 12)),
        np.empty((bodies.shape[0], 3)),
        np.zeros(12),
        np.empty(32),
        np.zeros((1, ROW)),
    )


@uncounted
def _place(q, chain, bodies, frames, centres):
    """Write the frames and the bodies' centres of a normalised configuration."""
    # Numbers are read one by one, here and in `_is_free`: Numba counts references to each row of an
    # array that has a name, which takes as long as the arithmetic.
    for i in range(9):
        frames[0, i] = chain[0, ROTATION + i]
    for i in range(3):
        frames[0, 9 + i] = chain[0, POSITION + i]
    for frame in range(1, chain.shape[0]):
        parent = int(chain[frame, PARENT])
        value = chain[frame, BEGIN] + (q[int(chain[frame, JOINT])] + 1.0) * 0.5 * chain[frame, SPAN]
        c, s, slide = 1.0, 0.0, value
        if chain[frame, PRISMATIC] == 0.0:
            c, s, slide = math.cos(value), math.sin(value), 0.0
        x, y, z = chain[frame, POSITION], chain[frame, POSITION + 1], chain[frame, POSITION + 2]
        xx, xy, xz = chain[frame, ROTATION], chain[frame, ROTATION + 1], chain[frame, ROTATION + 2]
        yx, yy, yz = (
            chain[frame, ROTATION + 3],
            chain[frame, ROTATION + 4],
            chain[frame, ROTATION + 5],
        )
        zx, zy, zz = (
            chain[frame, ROTATION + 6],
            chain[frame, ROTATION + 7],
            chain[frame, ROTATION + 8],
        )
        for i in range(0, 9, 3):
            rx, ry, rz = frames[parent, i], frames[parent, i + 1], frames[parent, i + 2]
            # Rotated into the frame, then by the joint about its z.
            tx = rx * xx + ry * yx + rz * zx
            ty = rx * xy + ry * yy + rz * zy
            tz = rx * xz + ry * yz + rz * zz
            frames[frame, 9 + i // 3] = (
                frames[parent, 9 + i // 3] + rx * x + ry * y + rz * z + slide * tz
            )
            frames[frame, i] = c * tx + s * ty
            frames[frame, i + 1] = c * ty - s * tx
            frames[frame, i + 2] = tz
    for body in range(bodies.shape[0]):
        f = int(bodies[body, FRAME])
        x, y, z = bodies[body, CENTRE], bodies[body, CENTRE + 1], bodies[body, CENTRE + 2]
        for i in range(3):
            centres[body, i] = (
                frames[f, 9 + i]
                + frames[f, 3 * i] * x
                + frames[f, 3 * i + 1] * y
                + frames[f, 3 * i + 2] * z
            )


@uncounted
def _sphere_gap(rows, j, centres, k):
    """Squared distance (m^2) of a body's centre from the box around a shape's core."""
    x, y, z = centres[k, 0] - rows[j, 1], centres[k, 1] - rows[j, 2], centres[k, 2] - rows[j, 3]
    u = max(abs(rows[j, 4] * x + rows[j, 7] * y + rows[j, 10] * z) - rows[j, 13], 0.0)
    v = max(abs(rows[j, 5] * x + rows[j, 8] * y + rows[j, 11] * z) - rows[j, 14], 0.0)
    w = max(abs(rows[j, 6] * x + rows[j, 9] * y + rows[j, 12] * z) - rows[j, 15], 0.0)
    return u * u + v * v + w * w


@uncounted
def _box_gap(bodies, k, frames, centres, points, j, pose):
    """Distance (m) of a point from the box around a body. Writes its position to `pose`."""
    f = frames[int(bodies[k, FRAME])]
    x, y, z = (
        points[j, 0] - centres[k, 0],
        points[j, 1] - centres[k, 1],
        points[j, 2] - centres[k, 2],
    )
    pose[9] = f[0] * x + f[3] * y + f[6] * z
    pose[10] = f[1] * x + f[4] * y + f[7] * z
    pose[11] = f[2] * x + f[5] * y + f[8] * z
    u = max(abs(pose[9]) - bodies[k, HALF], 0.0)
    v = max(abs(pose[10]) - bodies[k, HALF + 1], 0.0)
    w = max(abs(pose[11]) - bodies[k, HALF + 2], 0.0)
    return math.sqrt(u * u + v * v + w * w)


@compiled
def _box_gaps(bodies, k, frames, centres, points, begin, end, gaps):
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
def _relative(rows, j, frames, f, centres, k, pose):
    """Write the pose of a shape in a body's frame: rotation (row-major) and position."""
    x, y, z = rows[j, 1] - centres[k, 0], rows[j, 2] - centres[k, 1], rows[j, 3] - centres[k, 2]
    for i in range(3):
        a, b, c = frames[f, i], frames[f, 3 + i], frames[f, 6 + i]
        pose[9 + i] = a * x + b * y + c * z
        for n in range(3):
            pose[3 * i + n] = a * rows[j, 4 + n] + b * rows[j, 7 + n] + c * rows[j, 10 + n]


@uncounted
def _boxes_apart(bodies, k, rows, j, pose, gap):
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
def _begin(rows, j, pose, s):
    """Write a vector from a core towards a body to s[28:31], where `_gjk` begins."""
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
    best, found = -FAR, 0
    for n in range(cells[cell], cells[cell + 1]):
        i = cells[n]
        value = vertices[i, 0] * x + vertices[i, 1] * y + vertices[i, 2] * z
        if value > best:
            best, found = value, i
    return found


@uncounted
def _support(vertices, cells, k, rows, j, pose, x, y, z):
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
def _triangle(s, a, b, c):
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
            squared, x, y, z = _triangle(s, a, b, c)
            if squared < best:
                best, without, u, v, w = squared, face, x, y, z
        if without < 0:
            return 4
        # In the order of `_triangle`: a, b, c are the points after `without`, cyclically.
        if without == 0:
            s[24], s[25], s[26], s[27] = 0.0, u, v, w
        elif without == 1:
            s[24], s[25], s[26], s[27] = w, 0.0, u, v
        elif without == 2:
            s[24], s[25], s[26], s[27] = v, w, 0.0, u
        else:
            s[24], s[25], s[26], s[27] = u, v, w, 0.0
    elif n == 3:
        _, s[24], s[25], s[26] = _triangle(s, 0, 3, 6)
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
def _gjk(vertices, cells, k, rows, j, pose, s, near, far):
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
        px, py, pz, ax, ay, az = _support(vertices, cells, k, rows, j, pose, -x, -y, -z)
        lower = (px * x + py * y + pz * z) / distance
        if lower >= far or bound - lower <= _TOLERANCE:
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
def _as_row(bodies, k, frames, centres, row):
    """Write a body as a shape to `row` (1, `ROW`)."""
    row[0, 0], row[0, 16], row[0, 17] = LINK, bodies[k, ROUNDING], k
    for i in range(3):
        row[0, 1 + i], row[0, 13 + i] = centres[k, i], bodies[k, HALF + i]
    for i in range(9):
        row[0, 4 + i] = frames[int(bodies[k, FRAME]), i]


@uncounted
def _apart_by(bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap, axes, n):
    """`_is_apart`, with a lower bound (m) of the distance, at least `gap`; -`FAR` if it is nearer.

    Row n of `axes` (m, 3) is the axis from the core to the body, in the base's frame, along which
    the two were apart before; zeros at first. It is tried first, and written here. No axis is tried
    where `axes` is empty.
    """
    f = int(bodies[k, FRAME])
    _relative(rows, j, frames, f, centres, k, pose)
    if axes.shape[0] > 0 and (axes[n, 0] != 0.0 or axes[n, 1] != 0.0 or axes[n, 2] != 0.0):
        x = frames[f, 0] * axes[n, 0] + frames[f, 3] * axes[n, 1] + frames[f, 6] * axes[n, 2]
        y = frames[f, 1] * axes[n, 0] + frames[f, 4] * axes[n, 1] + frames[f, 7] * axes[n, 2]
        z = frames[f, 2] * axes[n, 0] + frames[f, 5] * axes[n, 1] + frames[f, 8] * axes[n, 2]
        px, py, pz, _, _, _ = _support(vertices, cells, k, rows, j, pose, -x, -y, -z)
        lower = (px * x + py * y + pz * z) / math.sqrt(x * x + y * y + z * z)
        if lower >= gap + _ROUNDING:
            return lower
    if _boxes_apart(bodies, k, rows, j, pose, gap):
        return gap
    _begin(rows, j, pose, s)
    if _gjk(vertices, cells, k, rows, j, pose, s, gap, gap)[0] < gap:
        return -FAR
    if axes.shape[0] > 0:
        for i in range(3):
            x, y, z = frames[f, 3 * i], frames[f, 3 * i + 1], frames[f, 3 * i + 2]
            axes[n, i] = x * s[28] + y * s[29] + z * s[30]
    return max(s[31], gap)


@uncounted
def _is_free(
    q, rule, endpoint_margins, arm, world, memory, axes, sweeps, share, known, still, place
):
    """`CollisionChecker.is_free` of one state, and what is near in the motion that it is part of.

    A pair is (k, j), body k and shape j, or (-1, i), the links of `pairs[i]`.

    Args:
        axes: for `_apart_by`: a row per body and shape, then per pair of links; or empty.
        sweeps: of the motion, see `_sweeps`.
        share: of the motion, that is still to be checked on each side of this state; or 0.
        known: lists of pairs (m, l, 2), the list of those that may touch here, and its length; a
            length of -1 for all pairs.
        still, place: list `place` of `still` receives the pairs that may touch in that share.

    Returns the length of that list; -1 if the state is not free.
    """
    chain, bodies, pairs, vertices, cells = arm
    rows, points, groups, ball = world
    frames, centres, pose, s, other = memory
    lists, above, given = known
    joints, count, shapes = endpoint_margins.shape[1] - 1, 0, rows.shape[0]
    touching = rows.shape[1] > ROW
    margin, clearance, growth = rule[0], rule[1], rule[2]
    for i in range(endpoint_margins.shape[0]):
        squared = 0.0
        for j in range(joints):
            squared += (q[j] - endpoint_margins[i, j]) ** 2
        margin = min(margin, endpoint_margins[i, joints] + growth * math.sqrt(squared))
    _place(q, chain, bodies, frames, centres)
    k, j = bodies.shape[0] - 1, -1  # the hand first: it moves most
    i = -1
    while True:
        i += 1
        if given >= 0:
            if i == given:
                break
            k, j = lists[above, i, 0], lists[above, i, 1]
        elif k >= 0:
            j += 1
            if j >= shapes:
                k, j = k - 1, 0
            if shapes == 0 or k < 0 or bodies[k, LINK_ROW] < 0.0:  # the base stands where it stands
                k, j = -1, 0
        else:
            j += 1
        if k < 0 and j >= pairs.shape[0]:
            break
        if k >= 0:
            if touching and rows[j, ROW + k] != 0.0:
                continue
            gap = margin + clearance + rows[j, 16] + bodies[k, ROUNDING]
            reach = bodies[k, RADIUS] + gap
            squared = _sphere_gap(rows, j, centres, k)
        else:
            a, b = pairs[j, 0], pairs[j, 1]
            gap = margin + (bodies[a, ROUNDING] + bodies[b, ROUNDING])
            reach = bodies[a, RADIUS] + bodies[b, RADIUS] + gap
            x, y = centres[a, 0] - centres[b, 0], centres[a, 1] - centres[b, 1]
            z = centres[a, 2] - centres[b, 2]
            squared = x * x + y * y + z * z
        swept = 0.0
        if share > 0.0:
            # With the full margin, because that of other states may be larger.
            sweep = sweeps[k if k >= 0 else bodies.shape[0] + j]
            swept = rule[0] - margin + share * sweep + _ROUNDING
            far = reach + swept
            if squared >= far * far and reach > 0.0:
                continue
        if reach <= 0.0 or squared < reach * reach:
            if k >= 0:
                lower = _apart_by(
                    bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap, axes,
                    k * shapes + j,
                )  # fmt: skip
            else:
                _as_row(bodies, b, frames, centres, other)
                lower = _apart_by(
                    bodies, vertices, cells, a, other, 0, frames, centres, pose, s, gap, axes,
                    bodies.shape[0] * shapes + j,
                )  # fmt: skip
            if lower == -FAR:
                return -1
            if share > 0.0 and lower >= gap + swept:
                continue
        if share > 0.0:
            still[place, count, 0], still[place, count, 1] = k, j
            count += 1
    for k in range(bodies.shape[0] - 1 if groups.shape[0] > 0 else -1, -1, -1):
        if bodies[k, LINK_ROW] < 0.0:
            break
        for g in range(groups.shape[0]):
            gap = margin + clearance + ball[0, 16] + bodies[k, ROUNDING]
            if _box_gap(bodies, k, frames, centres, groups, g, pose) >= groups[g, 3] + gap:
                continue
            for j in range(int(groups[g, 4]), int(groups[g, 5])):
                if _box_gap(bodies, k, frames, centres, points, j, pose) >= gap:
                    continue
                _begin(ball, 0, pose, s)
                if _gjk(vertices, cells, k, ball, 0, pose, s, gap, gap)[0] < gap:
                    return -1
    return count


@compiled
def _sweeps(start, end, chain, bodies, pairs):
    """How far (m) points move at most in a straight motion, (b + p,).

    Those of each body in the base's frame, and those of each pair of links towards each other.
    """
    sweeps = np.zeros(bodies.shape[0] + pairs.shape[0])
    for frame in range(1, chain.shape[0]):
        joint = int(chain[frame, JOINT])
        turn = abs((end[joint] - start[joint]) * 0.5 * chain[frame, SPAN])
        for k in range(bodies.shape[0]):
            sweeps[k] += turn * bodies[k, BODY_COLUMNS + frame]
        for i in range(pairs.shape[0]):
            one = bodies[pairs[i, 0], BODY_COLUMNS + frame]
            two = bodies[pairs[i, 1], BODY_COLUMNS + frame]
            if one == 0.0 or two == 0.0:  # a frame that moves both changes nothing
                sweeps[bodies.shape[0] + i] += turn * (one + two)
    return sweeps


@compiled
def free_batch(states, rule, endpoint_margins, arm, world, free):
    """Write `CollisionChecker.is_free` of states (m, n) to `free` (m,)."""
    memory, sweeps = _memory(arm[0], arm[1]), np.empty(0)
    axes, lists = np.empty((0, 3)), np.empty((0, 0, 2), np.int64)
    for i in range(states.shape[0]):
        margins = endpoint_margins[i if endpoint_margins.shape[0] > 1 else 0]
        known = lists, 0, -1
        near = _is_free(
            states[i], rule, margins, arm, world, memory, axes, sweeps, 0.0, known, lists, 0
        )
        free[i] = near >= 0


# Of the states of a motion, the first ones list what is near. The others use those lists.
_LISTS = 32


@compiled
def motion(rule, endpoint_margins, arm, world, end_known, start, end):
    """Number of states of a motion that were checked, without its start; negative: not free."""
    chain, bodies, pairs, _, _ = arm
    joints = len(start)
    memory, q = _memory(chain, bodies), np.empty(joints)
    squared = 0.0
    for j in range(joints):
        squared += (end[j] - start[j]) ** 2
    pieces = int(math.ceil(math.sqrt(squared) / rule[3]))
    axes, sweeps = np.empty((0, 3)), np.empty(0)
    lists, counts = np.empty((0, 0, 2), np.int64), np.empty(0, np.int64)
    checks, parts, part = 0, 1, 1
    if end_known:
        parts = 2
        if pieces < 2:
            return 0
    while True:
        i = part * pieces // parts  # of `pieces`: first the end, then the middle, ...
        # Unless an earlier, coarser round has checked that state.
        before, after = (part - 1) * pieces // parts, (part + 1) * pieces // parts
        if parts == 1 or (i != before and i != after):
            share = i / pieces if pieces > 0 else 1.0
            for j in range(joints):
                q[j] = start[j] + (end[j] - start[j]) * share
            checks += 1
            if parts == 2:  # the end is free, so it is worth while to remember what is near
                size = bodies.shape[0] * world[0].shape[0] + pairs.shape[0]
                axes, sweeps = np.zeros((size, 3)), _sweeps(start, end, chain, bodies, pairs)
                lists = np.empty((min(_LISTS, pieces), size, 2), np.int64)
                counts = np.empty(lists.shape[0], np.int64)
            # The states are a binary tree: below a state are those between it and its neighbours,
            # and below place n are 2 n and 2 n + 1.
            place = parts // 2 + part // 2
            above = place // 2
            while above >= max(lists.shape[0], 1):
                above //= 2
            around = max(i - before, after - i)
            share = around / pieces if 0 < place < lists.shape[0] and around > 1 else 0.0
            known = lists, above, counts[above] if above > 0 else -1
            near = _is_free(
                q, rule, endpoint_margins, arm, world, memory, axes, sweeps, share, known, lists,
                place,
            )  # fmt: skip
            if near < 0:
                return -checks
            if share > 0.0:
                counts[place] = near
        part += 2
        if part > parts:
            if parts >= pieces:
                return checks
            parts, part = 2 * parts, 1


@compiled
def single_motion(
    rule, ends, chain, bodies, pairs, vertices, cells, rows, points, groups, ball, start, end
):
    """`motion` for Python, which takes longer to pass nested tuples than their arrays."""
    arm, world = (chain, bodies, pairs, vertices, cells), (rows, points, groups, ball)
    return motion(rule, ends, arm, world, False, start, end)


@compiled
def motion_batch(starts, stops, rule, endpoint_margins, arm, world, ends_known, checks):
    """Write `CollisionChecker.motion_checks` of motions (m, n), (m, n) to `checks` (m,)."""
    begins = np.ones(starts.shape[0], np.bool_)
    if not ends_known:
        free_batch(starts, rule, endpoint_margins, arm, world, begins)
    for i in range(starts.shape[0]):
        if not begins[i]:
            checks[i] = -1
            continue
        margins = endpoint_margins[i if endpoint_margins.shape[0] > 1 else 0]
        checks[i] = motion(rule, margins, arm, world, ends_known, starts[i], stops[i])
        if not ends_known:
            checks[i] += 1 if checks[i] > 0 else -1


# --- Signed distances


@compiled
def _add_face(s, faces, n, a, b, c):
    """Append a face of EPA's polytope: its points, unit normal, distance from the origin."""
    f = faces[n]
    f[0], f[1], f[2] = a, b, c
    squared = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        f[3 + i] = (s[b, j] - s[a, j]) * (s[c, k] - s[a, k])
        f[3 + i] -= (s[b, k] - s[a, k]) * (s[c, j] - s[a, j])
        squared += f[3 + i] * f[3 + i]
    f[6] = FAR  # of a face without an area, which is never the nearest
    if squared > 1e-30:
        f[3:6] /= math.sqrt(squared)
        f[6] = f[3] * s[a, 0] + f[4] * s[a, 1] + f[5] * s[a, 2]
    return n + 1


@compiled
def _epa(vertices, cells, k, rows, j, pose, s, points, faces, edges):
    """Depth (m) of a body's hull in a shape's core, from a simplex of `_gjk` around the origin.

    Writes the normal, along which the body leaves the core, to s[28:31], and the body's deepest
    point to s[24:27]. Working memory: `points` (`_EPA_VERTICES`, 6), `faces` (`_EPA_FACES`, 7),
    `edges` (`_EPA_FACES`, 2).
    """
    for i in range(4):
        for n in range(3):
            points[i, n], points[i, 3 + n] = s[3 * i + n], s[12 + 3 * i + n]
    num_points, num_faces = 4, 0
    for face in range(4):
        a, b, c = (face + 1) % 4, (face + 2) % 4, (face + 3) % 4
        num_faces = _add_face(points, faces, num_faces, a, b, c)
        if faces[num_faces - 1, 6] < 0.0:  # its normal points inwards
            num_faces = _add_face(points, faces, num_faces - 1, a, c, b)
    while True:
        nearest = 0
        for f in range(1, num_faces):
            if faces[f, 6] < faces[nearest, 6]:
                nearest = f
        face = faces[nearest]
        x, y, z = face[3], face[4], face[5]
        px, py, pz, ax, ay, az = _support(vertices, cells, k, rows, j, pose, x, y, z)
        further = x * px + y * py + z * pz - face[6]
        # (The next round has at most three times as many faces.)
        full = num_points == points.shape[0] or 3 * num_faces > faces.shape[0]
        if further <= _EPA_TOLERANCE or full:
            break
        new = points[num_points]
        new[0], new[1], new[2], new[3], new[4], new[5] = px, py, pz, ax, ay, az
        # Faces visible from the new point are replaced by faces between it and their outline.
        num_edges, f = 0, 0
        while f < num_faces:
            height = faces[f, 3] * px + faces[f, 4] * py + faces[f, 5] * pz - faces[f, 6]
            if height <= 1e-12:
                f += 1
                continue
            for i in range(3):
                a, b = int(faces[f, i]), int(faces[f, (i + 1) % 3])
                for e in range(num_edges):
                    if edges[e, 0] == b and edges[e, 1] == a:  # between two visible faces
                        num_edges -= 1
                        edges[e, 0], edges[e, 1] = edges[num_edges, 0], edges[num_edges, 1]
                        break
                else:
                    edges[num_edges, 0], edges[num_edges, 1] = a, b
                    num_edges += 1
            num_faces -= 1
            faces[f, :] = faces[num_faces, :]
        for e in range(num_edges):
            num_faces = _add_face(points, faces, num_faces, edges[e, 0], edges[e, 1], num_points)
        num_points += 1
    depth = face[6]
    # The origin's projection on that face, as a mean of its corners, so of the body's vertices.
    triangle = np.empty(9)
    for i in range(3):
        for n in range(3):
            triangle[3 * i + n] = points[int(face[i]), n] - depth * face[3 + n]
    _, u, v, w = _triangle(triangle, 0, 3, 6)
    for n in range(3):
        s[24 + n] = (
            u * points[int(face[0]), 3 + n]
            + v * points[int(face[1]), 3 + n]
            + w * points[int(face[2]), 3 + n]
        )
        s[28 + n] = -face[3 + n]
    return depth


@compiled
def _signed_distance(bodies, vertices, cells, k, rows, j, frames, centres, pose, s, far, polytope):
    """Distance (m) of a body's hull from a shape's core, minus the depth where they overlap.

    `FAR` if that is not less than `far`. Otherwise s[28:31] is the normal, along which the body
    moves away, and s[24:27] the witness: the hull's nearest or deepest point, relative to the
    body's centre. Both are in the body's axes.
    """
    squared = _sphere_gap(rows, j, centres, k)
    reach = bodies[k, RADIUS] + far
    # If the centre is outside of the box, the depth is at most the radius less the distance.
    if squared > 0.0 and (reach <= 0.0 or squared >= reach * reach):
        return FAR
    _relative(rows, j, frames, int(bodies[k, FRAME]), centres, k, pose)
    if _boxes_apart(bodies, k, rows, j, pose, far):
        return FAR
    return _core_distance(vertices, cells, k, rows, j, pose, s, far, polytope)


@compiled
def _core_distance(vertices, cells, k, rows, j, pose, s, far, polytope):
    """`_signed_distance` without the bounds that exclude distant shapes; `pose` is the core's."""
    _begin(rows, j, pose, s)
    distance, n = _gjk(vertices, cells, k, rows, j, pose, s, -1.0, far)
    if distance != 0.0 and distance >= far:  # (where they overlap, the depth decides)
        return FAR
    if distance == 0.0:
        if n < 4:  # the origin is on a face or an edge of the simplex: move it off, by 0.1 um
            pose[9] += 3e-8
            pose[10] += 5e-8
            pose[11] += 7e-8
            n = _gjk(vertices, cells, k, rows, j, pose, s, -1.0, FAR)[1]
        if n == 4:
            points, faces, edges = polytope
            return -_epa(vertices, cells, k, rows, j, pose, s, points, faces, edges)
    u, v, w = s[24], s[25] if n > 1 else 0.0, s[26] if n > 2 else 0.0
    norm = math.sqrt(s[28] * s[28] + s[29] * s[29] + s[30] * s[30])
    for i in range(3):
        s[24 + i] = u * s[12 + i]
        if n > 1:
            s[24 + i] += v * s[15 + i]
        if n > 2:
            s[24 + i] += w * s[18 + i]
        s[28 + i] /= norm
    return distance


@compiled
def _gradient(chain, frames, a, b, normal, witness, gradient):
    """Write the speed of a point of frame `a` along a direction per unit of each joint.

    That is relative to frame `b`: joints that move both change nothing.
    """
    gradient[:] = 0.0
    sign = 1.0
    while a != b:
        if a < b:  # parents come first
            a, b, sign = b, a, -sign
        joint, f = int(chain[a, JOINT]), frames[a]
        if chain[a, PRISMATIC] == 0.0:  # the joint turns about its z
            x, y, z = witness[0] - f[9], witness[1] - f[10], witness[2] - f[11]
            speed = (
                normal[0] * (f[5] * z - f[8] * y)
                + normal[1] * (f[8] * x - f[2] * z)
                + normal[2] * (f[2] * y - f[5] * x)
            )
        else:
            speed = normal[0] * f[2] + normal[1] * f[5] + normal[2] * f[8]
        gradient[joint] += sign * (speed * (0.5 * chain[a, SPAN]))
        a = int(chain[a, PARENT])


@compiled
def _to_base(frames, f, centres, k, s, sign, back, normal, witness):
    """Write normal and witness of `_signed_distance` in the base's frame.

    `sign`: of the normal. `back`: m, from the hull's point to the shape's, which is the witness.
    """
    for i in range(3):
        out = at = 0.0
        for n in range(3):
            out += frames[f, 3 * i + n] * s[28 + n]
            at += frames[f, 3 * i + n] * s[24 + n]
        normal[i], witness[i] = sign * out, centres[k, i] + at - back * out


@compiled
def _cloud_distance(
    bodies, vertices, cells, k, world, frames, centres, pose, s, far, polytope, gaps
):
    """`_signed_distance` from the nearest point of the cloud.

    `gaps`: working memory, two arrays for all groups and all points: their distance (m) from the
    box around the body, a lower bound of their distance from its hull.
    """
    _, points, groups, ball = world
    of_groups, of_points = gaps
    _box_gaps(bodies, k, frames, centres, groups, 0, groups.shape[0], of_groups)
    middle = -1
    for g in range(groups.shape[0]):
        of_groups[g] -= groups[g, 3]
        if middle < 0 or of_groups[g] < of_groups[middle]:
            middle = g
    # The point that is probably nearest comes first: it rules out the others.
    first, least = -1, far
    for n in range(groups.shape[0]):
        g = middle if n == 0 else n - 1 if n <= middle else n
        begin, end = int(groups[g, 4]), int(groups[g, 5])
        of_points[begin] = -1.0  # not computed yet
        if of_groups[g] < least:
            _box_gaps(bodies, k, frames, centres, points, begin, end, of_points)
            for j in range(begin, end):
                if of_points[j] < least:
                    first, least = j, of_points[j]
    nearest = FAR
    # Two planes with the whole hull behind them: through the witness of the nearest point so far,
    # and of the last point that turned out to be farther away.
    ax = ay = az = bx = by = bz = 0.0
    a = b = -FAR
    x = y = z = 0.0  # the witness
    for g in range(-1 if first >= 0 else groups.shape[0], groups.shape[0]):
        begin, end = first, first + 1
        if g >= 0:
            begin, end = int(groups[g, 4]), int(groups[g, 5])
            # (Inside of the box, the gap does not bound the depth.)
            if of_groups[g] + groups[g, 3] > 0.0 and of_groups[g] >= far:
                continue
            if of_points[begin] < 0.0:
                _box_gaps(bodies, k, frames, centres, points, begin, end, of_points)
        for j in range(begin, end):
            if (g >= 0 and j == first) or (of_points[j] > 0.0 and of_points[j] >= far):
                continue
            _box_gap(bodies, k, frames, centres, points, j, pose)
            u, v, w = pose[9], pose[10], pose[11]
            if max(a - (ax * u + ay * v + az * w), b - (bx * u + by * v + bz * w)) >= far:
                continue
            core = _core_distance(vertices, cells, k, ball, 0, pose, s, far, polytope)
            if core < far:
                nearest = far = core
                x, y, z, ax, ay, az = s[24], s[25], s[26], s[28], s[29], s[30]
                a = ax * x + ay * y + az * z + _TOLERANCE if core > 0.0 else -FAR
            else:
                norm = math.sqrt(s[28] * s[28] + s[29] * s[29] + s[30] * s[30])
                bx, by, bz = s[28] / norm, s[29] / norm, s[30] / norm
                b = s[31] + bx * u + by * v + bz * w
    s[24], s[25], s[26], s[28], s[29], s[30] = x, y, z, ax, ay, az
    return nearest


@compiled
def signed_distances_batch(
    states,
    self_collisions,
    within,
    arm,
    world,
    distance,
    normal,
    witness,
    gradient,
    geometry,
):
    """Write `CollisionChecker.signed_distances` of states (m, n).

    `geometry`: the index of a row, or the number of rows for another link, one more for a point,
    two more for nothing.
    """
    chain, bodies, pairs, vertices, cells = arm
    rows, points, groups, ball = world
    frames, centres, pose, s, other = _memory(chain, bodies)
    polytope = (
        np.empty((_EPA_VERTICES, 6)),
        np.empty((_EPA_FACES, 7)),
        np.empty((_EPA_FACES, 2), np.int64),
    )
    gaps = np.empty(groups.shape[0]), np.empty(points.shape[0])
    of_arm, touching = rows.shape[0], rows.shape[1] > ROW
    distance[:], normal[:], witness[:], geometry[:] = within, 0.0, 0.0, of_arm + 2
    for i in range(states.shape[0]):
        _place(states[i], chain, bodies, frames, centres)
        for k in range(bodies.shape[0]):
            f, link = int(bodies[k, FRAME]), int(bodies[k, LINK_ROW])
            if link < 0:  # the base
                continue
            # The shape that is probably nearest comes first: it rules out the others.
            first, least = 0, FAR
            for j in range(rows.shape[0]):
                squared = _sphere_gap(rows, j, centres, k)
                if squared < least:
                    first, least = j, squared
            for n in range(rows.shape[0]):
                j = first if n == 0 else n - 1 if n <= first else n
                rounding = rows[j, 16] + bodies[k, ROUNDING]
                far = min(distance[i, link] + rounding, FAR)
                core = _signed_distance(
                    bodies, vertices, cells, k, rows, j, frames, centres, pose, s, far, polytope
                )
                if core < far and not (touching and rows[j, ROW + k] != 0.0):
                    distance[i, link], geometry[i, link] = core - rounding, j
                    _to_base(frames, f, centres, k, s, 1.0, 0.0, normal[i, link], witness[i, link])
            rounding = ball[0, 16] + bodies[k, ROUNDING]
            far = min(distance[i, link] + rounding, FAR)
            core = _cloud_distance(
                bodies, vertices, cells, k, world, frames, centres, pose, s, far, polytope, gaps
            )
            if core < far:
                distance[i, link], geometry[i, link] = core - rounding, of_arm + 1
                _to_base(frames, f, centres, k, s, 1.0, 0.0, normal[i, link], witness[i, link])
            _gradient(chain, frames, f, 0, normal[i, link], witness[i, link], gradient[i, link])
        for j in range(pairs.shape[0] if self_collisions else 0):
            a, b = pairs[j, 0], pairs[j, 1]
            rounding = bodies[a, ROUNDING] + bodies[b, ROUNDING]
            far = -FAR
            for body in (a, b):
                if bodies[body, LINK_ROW] >= 0.0:
                    far = max(far, distance[i, int(bodies[body, LINK_ROW])])
            far = min(far + rounding, FAR)
            _as_row(bodies, b, frames, centres, other)
            core = _signed_distance(
                bodies, vertices, cells, a, other, 0, frames, centres, pose, s, far, polytope
            )
            fa, fb = int(bodies[a, FRAME]), int(bodies[b, FRAME])
            for body, sign, back in ((a, 1.0, 0.0), (b, -1.0, core)):
                link = int(bodies[body, LINK_ROW])
                if link >= 0 and core < FAR and core - rounding < distance[i, link]:
                    distance[i, link], geometry[i, link] = core - rounding, of_arm
                    there, at = normal[i, link], witness[i, link]
                    _to_base(frames, fa, centres, a, s, sign, back, there, at)
                    moved, other_frame = (fa, fb) if body == a else (fb, fa)
                    _gradient(chain, frames, moved, other_frame, there, at, gradient[i, link])
        for link in range(distance.shape[1]):
            if geometry[i, link] == of_arm + 2:
                distance[i, link] = np.inf


@compiled
def link_distances_batch(states, rows, self_collisions, within, arm, world):
    """Write `CollisionChecker.link_distances` of states (m, n) to `rows` (m, l, 1 + n).

    Returns False, and writes nothing, if a state is NaN.
    """
    clipped = np.empty(states.shape)
    for i in range(states.shape[0]):
        for j in range(states.shape[1]):
            if math.isnan(states[i, j]):
                return False
            clipped[i, j] = min(max(states[i, j], -1.0), 1.0)
    batch = rows.shape[0], rows.shape[1]
    distance, geometry = np.empty(batch), np.empty(batch, np.int64)
    normal, witness = np.empty((batch[0], batch[1], 3)), np.empty((batch[0], batch[1], 3))
    gradient = np.empty((batch[0], batch[1], states.shape[1]))
    found = distance, normal, witness, gradient, geometry
    signed_distances_batch(clipped, self_collisions, within, arm, world, *found)
    for i in range(batch[0]):
        for link in range(batch[1]):
            rows[i, link, 0] = min(distance[i, link], within)
            for j in range(states.shape[1]):
                rows[i, link, 1 + j] = gradient[i, link, j]
    return True


# --- Point clouds of a user's own


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
    frames, centres, pose, s, ball = _memory(chain, bodies)
    ball[0, 0] = SPHERE
    num_bodies = 0
    if q.shape[0] > 0:
        num_bodies = bodies.shape[0]
        _place(q, chain, bodies, frames, centres)
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
            if _sphere_gap(rows, i, points, j) < gap * gap:
                labels[j] = KNOWN
                break
        for k in range(num_bodies if labels[j] == OF_OBSTACLE else 0):
            gap = arm_distance + bodies[k, ROUNDING]
            u, v, w = x - centres[k, 0], y - centres[k, 1], z - centres[k, 2]
            reach = bodies[k, RADIUS] + gap
            if u * u + v * v + w * w >= reach * reach:
                continue
            if _box_gap(bodies, k, frames, centres, points, j, pose) >= gap:
                continue
            _begin(ball, 0, pose, s)
            if _gjk(vertices, cells, k, ball, 0, pose, s, gap, gap)[0] < gap:
                labels[j] = OF_ARM
                break


@compiled
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
def first_in_cells(points, cell):
    """The first of the points (n, 3), m, in each cube with edges of `cell`, m, of their type.

    Returns, for the m cubes in the order of their first points: int64 (m,), the index of that
    point; int32 (n,), the cube of each point; int64 (m,), how many points the cube and the 26
    around it have.
    """
    cubes = np.empty(points.shape[0], np.int32)
    table = np.full(1024, -1, np.int64)  # of indices of cubes; twice as many as fit into `cells`
    cells, first, count = (
        np.empty((512, 3), np.int64),
        np.empty(512, np.int64),
        np.zeros(512, np.int64),
    )
    m = 0
    for i in range(points.shape[0]):
        x = int(math.floor(points[i, 0] / cell))
        y = int(math.floor(points[i, 1] / cell))
        z = int(math.floor(points[i, 2] / cell))
        slot = _slot(table, cells, x, y, z)
        if table[slot] < 0:
            if m == first.shape[0]:
                cells = np.concatenate((cells, np.empty_like(cells)))
                first = np.concatenate((first, np.empty_like(first)))
                count = np.concatenate((count, np.zeros_like(count)))
                table = np.full(4 * m, -1, np.int64)
                for n in range(m):
                    table[_slot(table, cells, cells[n, 0], cells[n, 1], cells[n, 2])] = n
                slot = _slot(table, cells, x, y, z)
            cells[m, 0], cells[m, 1], cells[m, 2], first[m] = x, y, z, i
            table[slot] = m
            m += 1
        cubes[i] = table[slot]
        count[cubes[i]] += 1
    around = np.zeros(m, np.int64)
    for n in range(m):
        for i in range(27):
            x, y, z = (
                cells[n, 0] + i // 9 - 1,
                cells[n, 1] + i // 3 % 3 - 1,
                cells[n, 2] + i % 3 - 1,
            )
            found = table[_slot(table, cells, x, y, z)]
            if found >= 0:
                around[n] += count[found]
    return first[:m], cubes, around


@compiled
def farthest(points, chosen):
    """Write the points of `envs.perception.point_clouds.farthest_points` to `chosen` (k, 3).

    `points`: float32 (n, 3), m. Squares are added in NumPy's order, for the same last bits.
    """
    n = points.shape[0]
    nearest = np.empty(n, np.float32)
    for k in range(min(chosen.shape[0], n)):
        best, found = np.float32(-1.0), 0
        for i in range(n):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            if k > 0:
                x, y, z = x - chosen[k - 1, 0], y - chosen[k - 1, 1], z - chosen[k - 1, 2]
            distance = np.sqrt(x * x + y * y + z * z)
            if k < 2 or distance < nearest[i]:
                nearest[i] = distance
            if nearest[i] > best:
                best, found = nearest[i], i
        chosen[k, 0], chosen[k, 1], chosen[k, 2] = (
            points[found, 0],
            points[found, 1],
            points[found, 2],
        )


@compiled
def decompress_lzf(compressed, result):
    """Write the bytes of LZF data (uint8) to `result`; returns how many, -1 if it is damaged."""
    i, n = 0, 0
    while i < compressed.shape[0]:
        control = int(compressed[i])
        i += 1
        if control < 32:  # so many bytes, and one more, as they are
            length = control + 1
            if i + length > compressed.shape[0] or n + length > result.shape[0]:
                return -1
            for _ in range(length):
                result[n] = compressed[i]
                i += 1
                n += 1
            continue
        length = control >> 5  # of a copy of what is already there
        if length == 7:
            if i >= compressed.shape[0]:
                return -1
            length += int(compressed[i])
            i += 1
        if i >= compressed.shape[0]:
            return -1
        begin = n - ((control & 31) << 8) - int(compressed[i]) - 1
        i += 1
        if begin < 0 or n + length + 2 > result.shape[0]:
            return -1
        for _ in range(length + 2):
            result[n] = result[begin]
            begin += 1
            n += 1
    return n


# --- The safety filter


@compiled
def project(
    actions,
    link_distances,
    margins,
    rates,
    max_step,
    cbf_gain,
    activation_distance,
    max_recovery,
    projection_sweeps,
):
    """Change actions (m, n) in place: `policies.safety_filter.SafetyFilter.__call__`.

    Each sweep projects an action onto one link's half-space after the other.
    `link_distances`: (m, l, 1 + n); `margins`: m, (m, l); `rates`: m per step, (m, l).
    """
    for i in range(actions.shape[0]):
        action = actions[i]
        _shorten(action, max_step)
        for _ in range(projection_sweeps):
            for link in range(link_distances.shape[1]):
                row = link_distances[i, link]
                if row[0] >= activation_distance:
                    continue
                squared = along = 0.0
                for j in range(action.shape[0]):
                    squared += row[1 + j] * row[1 + j]
                    along += row[1 + j] * action[j]
                short = min(cbf_gain * (margins[i, link] - row[0]), max_recovery)
                short = short - rates[i, link] - along
                if short > 0.0 and squared > 1e-12:
                    for j in range(action.shape[0]):
                        action[j] += row[1 + j] * short / squared
        _shorten(action, max_step)


@compiled
def _shorten(action, max_step):
    """Scale an action to a norm of at most `max_step`, in place."""
    squared = 0.0
    for j in range(action.shape[0]):
        squared += action[j] * action[j]
    if squared > max_step * max_step:
        for j in range(action.shape[0]):
            action[j] *= max_step / np.sqrt(squared)


# --- Moving obstacles
# `motions` is a tuple of float64 arrays, see `envs.collision.moving.motion_arrays`:
# - a row of `OWN_COLUMNS` per obstacle: its own pose (position 3, quaternion 4); of an oscillation
#   amplitude 3, angular frequency (rad/s), phase, axis 3, angle (zeros without one); the first of
#   its waypoints and the one after the last, and how they repeat; the same of its intervals (none:
#   it is always there);
# - waypoints (w, 8): time (s), displacement 3, quaternion 4; intervals (i, 2), s.
AMPLITUDE, FREQUENCY, PHASE, AXIS, ANGLE, WAYPOINTS, REPEAT, INTERVALS = (
    7,
    10,
    11,
    12,
    15,
    16,
    18,
    19,
)
OWN_COLUMNS = 21
# m. An obstacle that is not there is moved by this much along z where rows cannot be left out.
ABSENT = 1e6


@compiled
def obstacle_states(motions, times, present, poses, velocities):
    """Write where obstacles are: `envs.collision.moving.MovingObstacles.at`.

    `times`: (t,), s. `present`: bool (t, n). `poses`: (t, n, 7), position and quaternion.
    `velocities`: (t, n, 6), linear and angular.
    """
    for k in range(times.shape[0]):
        for i in range(motions[0].shape[0]):
            present[k, i] = _is_present(motions, i, times[k])
            obstacle_state(motions, i, times[k], poses[k, i], velocities[k, i])


@compiled
def moved_rows(motions, centres, shapes, t, rows):
    """Write `shape_rows` of n moving obstacles at a time (s) to `rows[:n]`.

    `shapes`: (n, `ROW` or more), the rows at their own poses. `centres`: m, (n, 3), of the shapes
    in the obstacles' own frames (zeros but for convex hulls). Absent obstacles are `ABSENT` away.
    """
    pose, velocity = np.empty(7), np.empty(6)
    for i in range(shapes.shape[0]):
        obstacle_state(motions, i, t, pose, velocity)
        row = rows[i]
        row[:] = shapes[i]
        x, y, z, w = pose[3], pose[4], pose[5], pose[6]
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
        row[4], row[5], row[6] = (
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - z * w),
            2.0 * (x * z + y * w),
        )
        row[7], row[8], row[9] = (
            2.0 * (x * y + z * w),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - x * w),
        )
        row[10], row[11], row[12] = (
            2.0 * (x * z - y * w),
            2.0 * (y * z + x * w),
            1.0 - 2.0 * (x * x + y * y),
        )
        a, b, c = centres[i, 0], centres[i, 1], centres[i, 2]
        for j in range(3):
            row[1 + j] = pose[j] + row[4 + 3 * j] * a + row[5 + 3 * j] * b + row[6 + 3 * j] * c
        if not _is_present(motions, i, t):
            row[3] += ABSENT


@compiled
def _is_present(motions, i, t):
    """Whether obstacle i is there at a time (s)."""
    own, intervals = motions[0][i], motions[2]
    begin, end = int(own[INTERVALS]), int(own[INTERVALS + 1])
    for k in range(begin, end):
        if intervals[k, 0] <= t < intervals[k, 1]:
            return True
    return begin == end


@compiled
def obstacle_state(motions, i, t, pose, velocity):
    """Write pose (7,) and velocity (6,), linear and angular, of obstacle i at a time (s)."""
    own, waypoints = motions[0][i], motions[1]
    a, b, c, d = 0.0, 0.0, 0.0, 1.0  # the rotation away from its own orientation
    phase = own[FREQUENCY] * t + own[PHASE]
    share, rate = math.sin(phase), own[FREQUENCY] * math.cos(phase)
    for j in range(3):
        pose[j] = own[j] + own[AMPLITUDE + j] * share
        velocity[j] = own[AMPLITUDE + j] * rate
        velocity[3 + j] = own[AXIS + j] * own[ANGLE] * rate
    if own[ANGLE] != 0.0:
        half = 0.5 * own[ANGLE] * share
        sine, d = math.sin(half), math.cos(half)
        a, b, c = own[AXIS] * sine, own[AXIS + 1] * sine, own[AXIS + 2] * sine
    first, last = int(own[WAYPOINTS]), int(own[WAYPOINTS + 1]) - 1
    if last >= first:
        begin, end, direction = waypoints[first, 0], waypoints[last, 0], 1.0
        span = end - begin
        if own[REPEAT] != 0.0 and t > begin:
            t -= begin
            if own[REPEAT] == 2.0:
                t -= span * math.floor(t / span)
            else:
                t -= 2.0 * span * math.floor(t / (2.0 * span))
                if t >= span:
                    t, direction = 2.0 * span - t, -1.0
            t += begin
        low, high = first, last  # the waypoint before this time, and the one after it
        while high - low > 1:
            middle = (low + high) // 2
            later = waypoints[middle, 0] > t or (direction < 0.0 and waypoints[middle, 0] == t)
            if later:
                high = middle
            else:
                low = middle
        before, after, share, rate = waypoints[low], waypoints[high], 0.0, 0.0
        if last > first:
            seconds = after[0] - before[0]
            share = min(max((t - before[0]) / seconds, 0.0), 1.0)
            if own[REPEAT] != 0.0 and t >= begin or begin <= t < end:
                rate = direction / seconds
        for j in range(3):
            pose[j] += before[1 + j] + share * (after[1 + j] - before[1 + j])
            velocity[j] += (after[1 + j] - before[1 + j]) * rate
        a, b, c, d = _between(before, after, share, rate, velocity)
    x, y, z, w = own[3], own[4], own[5], own[6]
    pose[3] = d * x + a * w + b * z - c * y
    pose[4] = d * y - a * z + b * w + c * x
    pose[5] = d * z + a * y - b * x + c * w
    pose[6] = d * w - a * x - b * y - c * z


@compiled
def _between(before, after, share, rate, velocity):
    """The rotation between two waypoints; writes the angular velocity of `rate` ways per second."""
    a, b, c, d = before[4], before[5], before[6], before[7]
    e, f, g, h = after[4], after[5], after[6], after[7]
    if a * e + b * f + c * g + d * h < 0.0:
        e, f, g, h = -e, -f, -g, -h
    apart = math.sqrt((a - e) ** 2 + (b - f) ** 2 + (c - g) ** 2 + (d - h) ** 2)
    together = math.sqrt((a + e) ** 2 + (b + f) ** 2 + (c + g) ** 2 + (d + h) ** 2)
    angle = 2.0 * math.atan2(apart, together)  # half of that between the orientations
    sine = math.sin(angle)
    if sine <= 1e-9:
        return a, b, c, d
    speed = 2.0 * angle * rate / sine  # about the vector part of after * inverse(before)
    velocity[3] += speed * (d * e - h * a + b * g - c * f)
    velocity[4] += speed * (d * f - h * b + c * e - a * g)
    velocity[5] += speed * (d * g - h * c + a * f - b * e)
    first, second = math.sin((1.0 - share) * angle) / sine, math.sin(share * angle) / sine
    return (
        first * a + second * e,
        first * b + second * f,
        first * c + second * g,
        first * d + second * h,
    )


# --- Replanning: RRT-Connect and shortcuts, within a number of checks


@compiled
def _nearest_node(nodes, count, q):
    """Index of the nearest of the first `count` nodes (L2), and its distance."""
    least, found = FAR, 0
    for i in range(count):
        squared = 0.0
        for j in range(q.shape[0]):
            squared += (nodes[i, j] - q[j]) ** 2
        if squared < least:
            least, found = squared, i
    return found, math.sqrt(least)


@compiled
def _towards(start, end, reach, distance, new):
    """Write the state at most `reach` from `start` towards `end`. Returns whether it is `end`."""
    if distance <= reach:
        new[:] = end
        return True
    for j in range(start.shape[0]):
        new[j] = start[j] + (end[j] - start[j]) * reach / distance
    return False


@compiled
def rrt_connect(start, goals, samples, reach, max_checks, rule, endpoint_margins, arm, world):
    """A path from `start` (n,) to one of `goals` (m, n) by RRT-Connect (Kuffner and LaValle, 2000).

    `samples`: (s, n), the random states towards which the trees grow, after the goals themselves.
    `reach`: L2, the longest edge. `rule`, `endpoint_margins`: as for `motion`.

    Returns the path (k, n), (0, n) if there is none within `samples` and about `max_checks`, and
    the number of checks.
    """
    n, m = start.shape[0], goals.shape[0]
    capacity = max_checks + m + samples.shape[0] + 2  # an edge takes at least one check
    nodes, parents = np.empty((2, capacity, n)), np.full((2, capacity), -1)
    size = np.array([1, m])
    nodes[0, 0], nodes[1, :m] = start, goals
    new, checks, tree = np.empty(n), 0, 0
    for i in range(m + samples.shape[0]):
        if checks >= max_checks:
            break
        if i < m:
            tree, target = 0, goals[i]
        else:
            target = samples[i - m]
        near, distance = _nearest_node(nodes[tree], size[tree], target)
        other = 1 - tree
        _towards(nodes[tree, near], target, reach, distance, new)
        more = motion(rule, endpoint_margins, arm, world, False, nodes[tree, near], new)
        checks += abs(more)
        if more > 0:
            a = size[tree]
            nodes[tree, a], parents[tree, a] = new, near
            size[tree] += 1
            # The other tree grows to the new node, as far as it can.
            b, distance = _nearest_node(nodes[other], size[other], nodes[tree, a])
            arrived = distance < 1e-9
            while not arrived and checks < max_checks:
                arrived = _towards(nodes[other, b], nodes[tree, a], reach, distance, new)
                more = motion(rule, endpoint_margins, arm, world, False, nodes[other, b], new)
                checks += abs(more)
                if more <= 0:
                    arrived = False
                    break
                nodes[other, size[other]], parents[other, size[other]] = new, b
                b = size[other]
                size[other] += 1
                distance -= reach
            if arrived:
                if tree == 1:
                    a, b = b, a
                return _joined_path(nodes, parents, a, b), checks
        tree = other
    return np.empty((0, n)), checks


@compiled
def _joined_path(nodes, parents, a, b):
    """The path from the first tree's root to its node a, then from node b to the other's root.

    Both nodes are the same state.
    """
    length, node = 0, parents[0, a]
    while node >= 0:
        length, node = length + 1, parents[0, node]
    before, node = length, b
    while node >= 0:
        length, node = length + 1, parents[1, node]
    path, node = np.empty((length, nodes.shape[2])), parents[0, a]
    for i in range(before - 1, -1, -1):
        path[i] = nodes[0, node]
        node = parents[0, node]
    node = b
    for i in range(before, length):
        path[i] = nodes[1, node]
        node = parents[1, node]
    return path


@compiled
def shortcut(path, chords, rule, endpoint_margins, arm, world):
    """Shorten a path (k, n) by straight motions between two of its points, where they are free.

    `chords`: (c, 2), shares of the path's length at which a shortcut begins and ends, in any order.
    Returns the path and the number of checks.
    """
    checks, n = 0, path.shape[1]
    for c in range(chords.shape[0]):
        k = path.shape[0]
        length = np.zeros(k)
        for i in range(1, k):
            length[i] = length[i - 1] + math.sqrt(np.sum((path[i] - path[i - 1]) ** 2))
        ends, edges = np.empty((2, n)), np.zeros(2, np.int64)
        for end in range(2):
            share = min(chords[c]) if end == 0 else max(chords[c])
            along = share * length[-1]
            edge = 0
            while edge < k - 2 and length[edge + 1] <= along:
                edge += 1
            part = (along - length[edge]) / max(length[edge + 1] - length[edge], 1e-12)
            ends[end] = path[edge] + (path[edge + 1] - path[edge]) * part
            edges[end] = edge
        if edges[0] == edges[1]:
            continue
        more = motion(rule, endpoint_margins, arm, world, False, ends[0], ends[1])
        checks += abs(more)
        if more > 0:
            path = np.concatenate((path[: edges[0] + 1], ends, path[edges[1] + 1 :]))
    return path, checks


# --- Planning in time: obstacles whose motion is known


@compiled
def rows_in_time(motions, centres, shapes, times, rows):
    """Write the rows of all shapes at times (t,), s, to `rows` (t, r, `ROW` or more).

    `shapes`: (r, `ROW`), of which the first ones have `motions` and `centres`, as of `moved_rows`.
    """
    moving = centres.shape[0]
    for k in range(times.shape[0]):
        rows[k] = shapes
        moved_rows(motions, centres, shapes[:moving], times[k], rows[k])


@compiled
def free_in_time(states, steps, rule, endpoint_margins, arm, rows, cloud, free):
    """Write whether states (m, n) are free at `steps` (m,) and one step later to `free` (m,).

    `rows`: (t, r, `ROW` or more), of each step. `cloud`: points, groups and ball of `world`.
    """
    memory, last = _memory(arm[0], arm[1]), rows.shape[0] - 1
    points, groups, ball = cloud
    axes, sweeps, lists = np.empty((0, 3)), np.empty(0), np.empty((0, 0, 2), np.int64)
    known = lists, 0, -1
    for i in range(states.shape[0]):
        free[i] = True
        for step in range(steps[i], steps[i] + 2):
            world = rows[min(step, last)], points, groups, ball
            near = _is_free(
                states[i], rule, endpoint_margins, arm, world, memory, axes, sweeps, 0.0, known,
                lists, 0,
            )  # fmt: skip
            if near < 0:
                free[i] = False
                break


@compiled
def first_departure(start, end, length, first, last, rule, endpoint_margins, arm, rows, cloud):
    """The first step from `first` to `last` at which a motion may begin; -1 if there is none.

    The motion takes `length` steps of equal size. Its states are checked as by `free_in_time`.
    """
    n = start.shape[0]
    state, step, free = np.empty((1, n)), np.empty(1, np.int64), np.empty(1, np.bool_)
    departure = first
    while departure <= last:
        blocked = False
        for i in range(1, length + 1):
            for j in range(n):
                state[0, j] = start[j] + (end[j] - start[j]) * i / length
            step[0] = departure + i
            free_in_time(state, step, rule, endpoint_margins, arm, rows, cloud, free)
            if not free[0]:
                blocked = True
                break
        if not blocked:
            return departure
        departure += 1
    return -1


# --- Ray casting for sensors (`envs.perception.ray_casting`)

# Columns of a surface: its shape, the frame that moves it (-1: none), its position there 3, its
# rotation 9 (row-major), its size 3, the polyhedron, the class that its pixels get. A polyhedron is
# scaled by the size. A cylinder's size is (radius, radius, half length); a sphere's, its radius.
POLYHEDRON, ROUND, BALL = range(3)
SHAPE, MOVED_BY, PLACE, TURN, SIZE, MESH, CLASS, SURFACE_COLUMNS = 0, 1, 2, 5, 14, 17, 18, 19
# Numbers of a view: eye 3, right 3, up 3, forward 3, the tangents of half the angles across and
# upwards, nearest and farthest visible distance along the viewing direction (m).
EYE, AXES, ACROSS, UPWARDS, NEAREST, FARTHEST, VIEW = 0, 3, 12, 13, 14, 15, 16
_ON_EDGE = 1e-9  # pixels: a ray on the edge of two faces hits at least one of them


@compiled
def cast_rays(view, q, chain, bodies, surfaces, polyhedra, inverse, classes):
    """Write a sensor's depth image, as 1 / depth (1/m), and the classes of its pixels.

    The result is that of one ray per pixel. As each surface is convex, its faces that are turned to
    the eye are filled row by row instead: along a row, 1 / depth of a plane is linear.

    Args:
        view: float64 (`VIEW`,).
        q: normalised configuration (n,).
        chain, bodies: as in `_place`; `bodies` may be empty.
        surfaces: float64 (s, `SURFACE_COLUMNS`).
        polyhedra: `vertices` float64 (v, 3), m; `vertex_ends` int64 (p + 1,), where the vertices of
            each begin; `face_ends` int64 (p + 1,), likewise; `corners` int64 (f, 4), of each face,
            counterclockwise from outside; three of them where the last is -1.
        inverse: float64 (height, width): 1 / depth; of a ray without a hit, 1 / farthest.
        classes: uint8 (height, width), unchanged where a ray hits nothing.
    """
    vertices, vertex_ends, face_ends, corners = polyhedra
    frames, centres = np.empty((chain.shape[0], 12)), np.empty((bodies.shape[0], 3))
    _place(q, chain, bodies, frames, centres)
    most = 0
    for i in range(vertex_ends.shape[0] - 1):
        most = max(most, vertex_ends[i + 1] - vertex_ends[i])
    # A vertex: its position along right, up and forward (m), its column and row.
    seen, polygon, pose = np.empty((max(most, 8), 5)), np.empty((2, 8, 5)), np.empty(12)
    height, width = inverse.shape
    inverse[:] = 1.0 / view[FARTHEST]
    for s in range(surfaces.shape[0]):
        surface = surfaces[s]
        _pose_in_view(view, surface, frames, pose)
        kind, label = int(surface[SHAPE]), np.uint8(surface[CLASS])
        if kind != POLYHEDRON:
            area = _pixels_around(view, surface, pose, seen, height, width)
            if kind == BALL:
                _draw_ball(view, surface[SIZE], pose, area, label, inverse, classes)
            else:
                _draw_cylinder(view, surface, pose, area, label, inverse, classes)
            continue
        mesh = int(surface[MESH])
        first, behind, outside = vertex_ends[mesh], 0, 0
        number = vertex_ends[mesh + 1] - first
        for i in range(number):
            x = vertices[first + i, 0] * surface[SIZE]
            y = vertices[first + i, 1] * surface[SIZE + 1]
            z = vertices[first + i, 2] * surface[SIZE + 2]
            for j in range(3):
                seen[i, j] = pose[9 + j] + pose[3 * j] * x + pose[3 * j + 1] * y
                seen[i, j] += pose[3 * j + 2] * z
            behind += seen[i, 2] < view[NEAREST]
            _project(view, height, width, seen[i])
        if behind == number:
            continue
        if behind == 0:
            left = top = FAR
            right = bottom = -FAR
            for i in range(number):
                left, right = min(left, seen[i, 3]), max(right, seen[i, 3])
                top, bottom = min(top, seen[i, 4]), max(bottom, seen[i, 4])
            outside = right < 0.0 or left > width - 1 or bottom < 0.0 or top > height - 1
        if outside:
            continue
        for face in range(face_ends[mesh], face_ends[mesh + 1]):
            a, b, c = seen[corners[face, 0]], seen[corners[face, 1]], seen[corners[face, 2]]
            ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            away = nx * a[0] + ny * a[1] + nz * a[2]
            if away <= 0.0:  # turned away from the eye (right, up, forward are left-handed)
                continue
            n = 0
            for i in range(4):
                if corners[face, i] >= 0:
                    polygon[0, n] = seen[corners[face, i]]
                    n += 1
            outline = polygon[0]
            if behind > 0:
                n = _clip(view, height, width, polygon, n)
                outline = polygon[1]
            plane = nx / away, ny / away, nz / away
            _fill(view, outline, n, plane, label, inverse, classes)


@compiled
def _pose_in_view(view, surface, frames, pose):
    """Write a surface's rotation (row-major) and position along right, up and forward to `pose`."""
    frame = int(surface[MOVED_BY])
    for i in range(3):
        a, b, c = view[AXES + 3 * i], view[AXES + 3 * i + 1], view[AXES + 3 * i + 2]
        place = -(a * view[EYE] + b * view[EYE + 1] + c * view[EYE + 2])
        if frame >= 0:
            f = frames[frame]
            place += a * f[9] + b * f[10] + c * f[11]
            a, b, c = (
                a * f[0] + b * f[3] + c * f[6],
                a * f[1] + b * f[4] + c * f[7],
                a * f[2] + b * f[5] + c * f[8],
            )
        pose[9 + i] = place + a * surface[PLACE] + b * surface[PLACE + 1] + c * surface[PLACE + 2]
        for j in range(3):
            pose[3 * i + j] = a * surface[TURN + j] + b * surface[TURN + 3 + j]
            pose[3 * i + j] += c * surface[TURN + 6 + j]


@compiled
def _project(view, height, width, point):
    """Write a point's column and row behind its position. PyBullet's pixels: see `deproject`."""
    point[3] = (point[0] / (point[2] * view[ACROSS]) + 1.0) * (0.5 * width)
    point[4] = (1.0 - point[1] / (point[2] * view[UPWARDS])) * (0.5 * height) - 1.0


@compiled
def _clip(view, height, width, polygon, n):
    """Write the part of `polygon[0]`, n corners, that is not too near to `polygon[1]`."""
    given, left, count = polygon[0], polygon[1], 0
    for i in range(n):
        one, other = given[i], given[(i + 1) % n]
        if one[2] >= view[NEAREST]:
            left[count] = one
            count += 1
        if (one[2] >= view[NEAREST]) != (other[2] >= view[NEAREST]):
            share = (view[NEAREST] - one[2]) / (other[2] - one[2])
            for j in range(3):
                left[count, j] = one[j] + share * (other[j] - one[j])
            left[count, 2] = view[NEAREST]
            _project(view, height, width, left[count])
            count += 1
    return count


@compiled
def _fill(view, outline, n, plane, label, inverse, classes):
    """Draw a convex polygon of n corners in a plane, of which `plane` is 1 / depth per ray."""
    height, width = inverse.shape
    top, bottom = FAR, -FAR
    for i in range(n):
        top, bottom = min(top, outline[i, 4]), max(bottom, outline[i, 4])
    begin = int(math.ceil(max(top - _ON_EDGE, 0.0)))
    end = int(math.floor(min(bottom + _ON_EDGE, height - 1.0))) + 1
    along = plane[0] * view[ACROSS] * (2.0 / width)
    for row in range(begin, end):
        y, left, right = float(row), FAR, -FAR
        for i in range(n):
            j = i + 1 if i + 1 < n else 0
            if outline[i, 4] > outline[j, 4]:
                i, j = j, i  # the same numbers for the face on the other side
            ya, yb = outline[i, 4], outline[j, 4]
            if y < ya - _ON_EDGE or y > yb + _ON_EDGE:
                continue
            xa, xb = outline[i, 3], outline[j, 3]
            if yb - ya < _ON_EDGE:
                left, right = min(left, xa, xb), max(right, xa, xb)
            else:
                x = xa + (y - ya) * ((xb - xa) / (yb - ya))
                left, right = min(left, x), max(right, x)
        first = int(math.ceil(max(left - _ON_EDGE, 0.0)))
        last = int(math.floor(min(right + _ON_EDGE, width - 1.0)))
        upward = (1.0 - 2.0 * (row + 1) / height) * view[UPWARDS]
        start = plane[1] * upward + plane[2] - plane[0] * view[ACROSS]
        for column in range(first, last + 1):
            value = start + along * column
            if value > inverse[row, column]:
                inverse[row, column], classes[row, column] = value, label


@compiled
def _pixels_around(view, surface, pose, seen, height, width):
    """Rows and columns that a ball or cylinder may cover: first row, end, first column, end."""
    left = top = FAR
    right = bottom = -FAR
    half = surface[SIZE : SIZE + 3]
    for i in range(8):
        x = half[0] if i & 1 else -half[0]
        y = half[1] if i & 2 else -half[1]
        z = half[2] if i & 4 else -half[2]
        for j in range(3):
            seen[i, j] = pose[9 + j] + pose[3 * j] * x + pose[3 * j + 1] * y + pose[3 * j + 2] * z
        if seen[i, 2] < view[NEAREST]:
            return 0, height, 0, width
        _project(view, height, width, seen[i])
        left, right = min(left, seen[i, 3]), max(right, seen[i, 3])
        top, bottom = min(top, seen[i, 4]), max(bottom, seen[i, 4])
    return (
        int(math.ceil(min(max(top, 0.0), float(height)))),
        int(math.floor(min(max(bottom, -1.0), height - 1.0))) + 1,
        int(math.ceil(min(max(left, 0.0), float(width)))),
        int(math.floor(min(max(right, -1.0), width - 1.0))) + 1,
    )


@compiled
def _draw_ball(view, radius, pose, area, label, inverse, classes):
    height, width = inverse.shape
    x, y, z = pose[9], pose[10], pose[11]
    beyond = x * x + y * y + z * z - radius * radius
    for row in range(area[0], area[1]):
        v = (1.0 - 2.0 * (row + 1) / height) * view[UPWARDS]
        for column in range(area[2], area[3]):
            u = (2.0 * column / width - 1.0) * view[ACROSS]
            square, along = u * u + v * v + 1.0, u * x + v * y + z
            under = along * along - square * beyond
            if under < 0.0:
                continue
            depth = (along - math.sqrt(under)) / square
            if depth >= view[NEAREST] and depth * inverse[row, column] < 1.0:
                inverse[row, column], classes[row, column] = 1.0 / depth, label


@compiled
def _draw_cylinder(view, surface, pose, area, label, inverse, classes):
    height, width = inverse.shape
    radius, half = surface[SIZE], surface[SIZE + 2]
    # The eye in the cylinder's own axes.
    ox = -(pose[0] * pose[9] + pose[3] * pose[10] + pose[6] * pose[11])
    oy = -(pose[1] * pose[9] + pose[4] * pose[10] + pose[7] * pose[11])
    oz = -(pose[2] * pose[9] + pose[5] * pose[10] + pose[8] * pose[11])
    beyond = ox * ox + oy * oy - radius * radius
    for row in range(area[0], area[1]):
        v = (1.0 - 2.0 * (row + 1) / height) * view[UPWARDS]
        for column in range(area[2], area[3]):
            u = (2.0 * column / width - 1.0) * view[ACROSS]
            dx = pose[0] * u + pose[3] * v + pose[6]
            dy = pose[1] * u + pose[4] * v + pose[7]
            dz = pose[2] * u + pose[5] * v + pose[8]
            enter, leave = -FAR, FAR
            square, along = dx * dx + dy * dy, ox * dx + oy * dy
            under = along * along - square * beyond
            if under < 0.0 or (square == 0.0 and beyond > 0.0):
                continue
            if square > 0.0:
                root = math.sqrt(under)
                enter, leave = (-along - root) / square, (root - along) / square
            if dz != 0.0:
                one, other = (-half - oz) / dz, (half - oz) / dz
                enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
            elif abs(oz) > half:
                continue
            if view[NEAREST] <= enter <= leave and enter * inverse[row, column] < 1.0:
                inverse[row, column], classes[row, column] = 1.0 / enter, label


@compiled
def points_of_pixels(view, depth, classes, only, nothing, points, labels):
    """Write the points (m) and classes of pixels that hit something, row by row from upper left.

    Args:
        view: float64 (`VIEW`,).
        depth: float32 (height, width), m.
        classes: uint8 (height, width).
        only: the class of which points are written; negative: all but `nothing`.
        nothing: the class of pixels without a hit.
        points, labels: float32 (n, 3) and uint8 (n,), to write to.

    Returns the number of points.
    """
    height, width = depth.shape
    n = 0
    for row in range(height):
        upward = (1 - 2 * (row + 1) / height) * view[UPWARDS]
        for column in range(width):
            label = classes[row, column]
            if label != only if only >= 0 else label == nothing:
                continue
            across = (2 * column / width - 1) * view[ACROSS]
            for i in range(3):
                ray = across * view[AXES + i] + upward * view[AXES + 3 + i] + view[AXES + 6 + i]
                points[n, i] = view[EYE + i] + depth[row, column] * ray
            labels[n] = label
            n += 1
    return n


@compiled
def edge_pixels(depth, classes, nothing, edge):
    """Of pixels at edges, the least and the largest depth of the pixel and its four neighbours.

    At an edge they are more than `edge` (m) apart; neighbours of the class `nothing` do not count.

    Returns two arrays, float32 (height, width), m; zeros where there is no edge.
    """
    height, width = depth.shape
    front, back = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            if classes[row, column] == nothing:
                continue
            least = most = depth[row, column]
            for i in range(4):
                r, c = row + (i == 0) - (i == 1), column + (i == 2) - (i == 3)
                if 0 <= r < height and 0 <= c < width and classes[r, c] != nothing:
                    least, most = min(least, depth[r, c]), max(most, depth[r, c])
            if most - least > edge:
                front[row, column], back[row, column] = least, most
    return front, back


@compiled
def pixels_with_neighbours(depth, hit, distance, least):
    """Which pixels that hit have at least so many of their eight neighbours near: bool, as `hit`.

    A neighbour is near if it hits, too, and its depth (m) is at most `distance` away.
    """
    height, width = depth.shape
    kept = np.zeros((height, width), np.bool_)
    for row in range(height):
        for column in range(width):
            near = -1  # the pixel itself
            for r in range(max(row - 1, 0), min(row + 2, height)):
                for c in range(max(column - 1, 0), min(column + 2, width)):
                    near += hit[r, c] and abs(depth[r, c] - depth[row, column]) <= distance
            kept[row, column] = hit[row, column] and near >= least
    return kept
