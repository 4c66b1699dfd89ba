"""The arm in 16 states at once: where its frames are, and bounds of its distance from shapes.

A number of 16 states is a row of 16 in a flat float32 array: row i of `states`, joint i; rows
12 f to 12 f + 11 of `frames`, rotation (row-major) and position of frame f. Rounding to float32
moves a point of the arm by less than `spheres.SLACK`, by which outer spheres are larger, and inner
ones smaller. What `arm32` holds: `spheres.block_arm`.
"""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import (
    BEGIN,
    CYLINDER,
    JOINT,
    PARENT,
    POSITION,
    PRISMATIC,
    ROTATION,
    ROW,
    SPAN,
)
from roboarm_nmp.envs.collision.lanes_kernels import (
    WIDTH,
    fused,
    larger,
    less,
    load,
    magnitude,
    nearest_int,
    root,
    smaller,
    spread,
    store,
)
from roboarm_nmp.utils.numba_cache import compiled, inlined, uncounted

F32 = np.float32


@inlined
def place_states(start, end, first, step, last, pieces, states):
    """Write states of a motion: number `first`, `first + step`, ..., at most `last`, of `pieces`.

    Their shares of the motion are in the row after those of the joints.
    """
    n = start.shape[0]
    for i in range(WIDTH):
        states[n * WIDTH + i] = F32(min(first + i * step, last)) / F32(pieces)
    share = load(states, n * WIDTH)
    for j in range(n):
        store(
            states, j * WIDTH, fused(share, spread(F32(end[j] - start[j])), spread(F32(start[j])))
        )


@inlined
def margins_of(states, n, margin, growth, endpoint_margins):
    """The margin (m) of each state of a block, as `CollisionChecker.is_free` has them."""
    margins = spread(F32(margin))
    for i in range(endpoint_margins.shape[0]):
        squared = spread(F32(0.0))
        for j in range(n):
            away = load(states, j * WIDTH) - F32(endpoint_margins[i, j])
            squared = fused(away, away, squared)
        near = root(squared) * F32(growth) + F32(endpoint_margins[i, n])
        margins = smaller(margins, near)
    return margins


@inlined
def place_block(states, chain, frames):
    """Write the frames of 16 normalised states. `chain`: that of `arm_hulls`, float32."""
    for i in range(9):
        store(frames, i * WIDTH, spread(chain[0, ROTATION + i]))
    for i in range(3):
        store(frames, (9 + i) * WIDTH, spread(chain[0, POSITION + i]))
    for f in range(1, chain.shape[0]):
        parent, here = 12 * WIDTH * int(chain[f, PARENT]), 12 * WIDTH * f
        state = load(states, int(chain[f, JOINT]) * WIDTH)
        value = (state + F32(1.0)) * (F32(0.5) * chain[f, SPAN]) + chain[f, BEGIN]
        slides = chain[f, PRISMATIC] != F32(0.0)
        if slides:
            cosine, sine = spread(F32(1.0)), spread(F32(0.0))
        else:
            cosine, sine = _cosine_sine(value)
        x, y, z = chain[f, POSITION], chain[f, POSITION + 1], chain[f, POSITION + 2]
        n = ROTATION
        xx, xy, xz = chain[f, n], chain[f, n + 1], chain[f, n + 2]
        yx, yy, yz = chain[f, n + 3], chain[f, n + 4], chain[f, n + 5]
        zx, zy, zz = chain[f, n + 6], chain[f, n + 7], chain[f, n + 8]
        for i in range(3):
            row = parent + 3 * i * WIDTH
            rx, ry, rz = load(frames, row), load(frames, row + WIDTH), load(frames, row + 2 * WIDTH)
            # Rotated into the frame, then by the joint about its z.
            tx = _combined(rx, ry, rz, xx, yx, zx)
            ty = _combined(rx, ry, rz, xy, yy, zy)
            tz = _combined(rx, ry, rz, xz, yz, zz)
            position = load(frames, parent + (9 + i) * WIDTH) + _combined(rx, ry, rz, x, y, z)
            if slides:
                position = fused(value, tz, position)
            store(frames, here + (9 + i) * WIDTH, position)
            row = here + 3 * i * WIDTH
            store(frames, row, fused(cosine, tx, sine * ty))
            store(frames, row + WIDTH, cosine * ty - sine * tx)
            store(frames, row + 2 * WIDTH, tz)


@inlined
def place_speeds(rates, chain, frames, speeds):
    """Write how fast the frames of `place_block` move: rows 6 f to 6 f + 5, of origin and rotation.

    `rates`: float32 (f,), m or rad per unit of time of each frame's joint.
    """
    for i in range(6):
        store(speeds, i * WIDTH, spread(F32(0.0)))
    for f in range(1, chain.shape[0]):
        parent = int(chain[f, PARENT])
        row, here = 6 * WIDTH * f, 12 * WIDTH * f
        x, y, z = rotation_speeds(speeds, parent)
        # Along the joint's axis, or about it.
        ax = load(frames, here + 2 * WIDTH) * rates[f]
        ay = load(frames, here + 5 * WIDTH) * rates[f]
        az = load(frames, here + 8 * WIDTH) * rates[f]
        px, py = load(frames, here + 9 * WIDTH), load(frames, here + 10 * WIDTH)
        pz = load(frames, here + 11 * WIDTH)
        u, v, w = speeds_of(frames, speeds, parent, px, py, pz)
        if chain[f, PRISMATIC] != F32(0.0):
            u, v, w = u + ax, v + ay, w + az
        else:
            x, y, z = x + ax, y + ay, z + az
        store(speeds, row, u)
        store(speeds, row + WIDTH, v)
        store(speeds, row + 2 * WIDTH, w)
        store(speeds, row + 3 * WIDTH, x)
        store(speeds, row + 4 * WIDTH, y)
        store(speeds, row + 5 * WIDTH, z)


@uncounted
def rotation_speeds(speeds, f):
    row = 6 * WIDTH * f
    return (
        load(speeds, row + 3 * WIDTH),
        load(speeds, row + 4 * WIDTH),
        load(speeds, row + 5 * WIDTH),
    )


@uncounted
def speeds_of(frames, speeds, f, x, y, z):
    """How fast a point at (x, y, z), in the base's frame, moves with frame f."""
    here, row = 12 * WIDTH * f, 6 * WIDTH * f
    x = x - load(frames, here + 9 * WIDTH)
    y = y - load(frames, here + 10 * WIDTH)
    z = z - load(frames, here + 11 * WIDTH)
    a, b, c = rotation_speeds(speeds, f)
    u = fused(b, z, load(speeds, row)) - c * y
    v = fused(c, x, load(speeds, row + WIDTH)) - a * z
    w = fused(a, y, load(speeds, row + 2 * WIDTH)) - b * x
    return u, v, w


@uncounted
def _combined(rx, ry, rz, x, y, z):
    return fused(rx, spread(x), fused(ry, spread(y), rz * z))


@uncounted
def _cosine_sine(value):
    """Cosine and sine of angles (rad), to about 1e-7, for angles of a few turns."""
    half_turns = nearest_int(value * F32(1.0 / math.pi))
    # (pi in two parts, of which the first has few digits.)
    rest = fused(half_turns, spread(F32(-3.140625)), value)
    rest = fused(half_turns, spread(F32(-9.67653589793e-4)), rest)
    half = half_turns * F32(0.5)
    sign = spread(F32(1.0)) - magnitude(half - nearest_int(half)) * F32(4.0)
    x = rest * rest  # at most (pi / 2)^2
    sine = fused(x, spread(F32(2.6083159809786593e-6)), spread(F32(-1.9810690719e-4)))
    sine = fused(x, sine, spread(F32(8.3330785483e-3)))
    sine = fused(x, sine, spread(F32(-1.6666659712e-1)))
    sine = rest * fused(x, sine, spread(F32(1.0)))
    cosine = fused(x, spread(F32(-2.6051615464e-7)), spread(F32(2.4760495088e-5)))
    cosine = fused(x, cosine, spread(F32(-1.3888377460e-3)))
    cosine = fused(x, cosine, spread(F32(4.1666638200e-2)))
    cosine = fused(x, cosine, spread(F32(-0.5)))
    cosine = fused(x, cosine, spread(F32(1.0)))
    return cosine * sign, sine * sign


@uncounted
def points_of(frames, f, x, y, z):
    """Where a point (m) of frame f is, in the base's frame: x, y, z of 16 states."""
    row = 12 * WIDTH * f
    return (
        _moved(frames, row, row + 9 * WIDTH, x, y, z),
        _moved(frames, row + 3 * WIDTH, row + 10 * WIDTH, x, y, z),
        _moved(frames, row + 6 * WIDTH, row + 11 * WIDTH, x, y, z),
    )


@uncounted
def _moved(frames, row, position, x, y, z):
    there = fused(load(frames, row), spread(x), load(frames, position))
    there = fused(load(frames, row + WIDTH), spread(y), there)
    return fused(load(frames, row + 2 * WIDTH), spread(z), there)


@uncounted
def squared_length(x, y, z):
    return fused(x, x, fused(y, y, z * z))


@uncounted
def squared_gaps(rows, j, x, y, z):
    """Squared distances (m^2) of points from a shape's core; of a hull, from the box around it.

    `rows`: `shape_rows`, float32.
    """
    x, y, z = x - rows[j, 1], y - rows[j, 2], z - rows[j, 3]
    zero = spread(F32(0.0))
    a = _combined(x, y, z, rows[j, 4], rows[j, 7], rows[j, 10])
    b = _combined(x, y, z, rows[j, 5], rows[j, 8], rows[j, 11])
    c = _combined(x, y, z, rows[j, 6], rows[j, 9], rows[j, 12])
    w = larger(magnitude(c) - rows[j, 15], zero)
    if rows[j, 0] == F32(CYLINDER):
        u = larger(root(fused(a, a, b * b)) - rows[j, 13], zero)
        return fused(u, u, w * w)
    u = larger(magnitude(a) - rows[j, 13], zero)
    v = larger(magnitude(b) - rows[j, 14], zero)
    return squared_length(u, v, w)


@compiled
def rows_of_block(rows):
    """Rows of shapes as float32, row by row and column by column.

    The last number of a row is how far (m) rounding may have moved the shape. Columns are padded to
    a multiple of 16, with shapes that are a million m away.

    Returns: (n, `ROW`), (`ROW` * capacity,).
    """
    n = rows.shape[0]
    capacity = (n + WIDTH - 1) // WIDTH * WIDTH
    rounded, columns = np.empty((n, ROW), np.float32), np.zeros(ROW * capacity, np.float32)
    columns[capacity : 2 * capacity] = 1e6
    columns[4 * capacity : 5 * capacity] = 1.0  # their first axis is x
    for j in range(n):
        size = 0.0
        for i in range(3):
            size += abs(rows[j, 1 + i]) + rows[j, 13 + i]
        for i in range(ROW):
            rounded[j, i] = rows[j, i]
        rounded[j, 17] = 4e-7 * size
        for i in range(ROW):
            columns[i * capacity + j] = rounded[j, i]
    return rounded, columns


@uncounted
def row_gaps(columns, capacity, x, y, z, gaps):
    """Write squared distances (m^2) of a point from the boxes around all shapes' cores."""
    for j in range(0, capacity, WIDTH):
        store(gaps, j, _squared_gaps_of_rows(columns, capacity, j, x, y, z))


@uncounted
def rows_near(columns, capacity, j, x, y, z, reach):
    """The mask of those of 16 shapes from row j on that may be within `reach` (m) of a point."""
    within = spread(reach) + load(columns, 16 * capacity + j) + load(columns, 17 * capacity + j)
    return less(_squared_gaps_of_rows(columns, capacity, j, x, y, z), within * within)


@uncounted
def _squared_gaps_of_rows(columns, capacity, j, x, y, z):
    x = spread(x) - load(columns, capacity + j)
    y = spread(y) - load(columns, 2 * capacity + j)
    z = spread(z) - load(columns, 3 * capacity + j)
    u = _beyond(columns, capacity, j, 4, 13, x, y, z)
    v = _beyond(columns, capacity, j, 5, 14, x, y, z)
    w = _beyond(columns, capacity, j, 6, 15, x, y, z)
    return squared_length(u, v, w)


@uncounted
def _beyond(columns, capacity, j, axis, half, x, y, z):
    """How far points are beyond boxes' faces along one of their axes."""
    along = x * load(columns, axis * capacity + j)
    along = fused(y, load(columns, (axis + 3) * capacity + j), along)
    along = fused(z, load(columns, (axis + 6) * capacity + j), along)
    return larger(magnitude(along) - load(columns, half * capacity + j), spread(F32(0.0)))
