"""The arm in compiled collision checks: where its frames and bodies are.

All compiled functions compute in float64, for an arm of n joints with l links that may collide,
besides the base. Their working memory: `frames` (f, 12), a rotation (row-major) and a position
each; `centres` (b, 3), of the bodies; `pose` (12,), of a shape in a body's frame; `simplex`, see
`gjk_kernels.gjk`; `other` (1, `ROW`), a body as the shape that another one may hit. What `arm` and
`world` hold: `arm_hulls`, `shape_rows` and `group_points` in `hulls`.

Compiled functions stand in files whose names end in `kernels.py`. When one of these files changes,
all functions are compiled again (`utils.numba_cache`).
"""

import math

import numpy as np

from roboarm_nmp.utils.numba_cache import compiled, uncounted

FAR = 1e9  # m: farther than anything
# A row describes a convex shape: kind, centre 3, rotation 9 (row-major), half edges of its core 3,
# rounding, and the body's index if it is a link. The shape is the set of points within `rounding`
# of its core: a box or a cylinder less its rounding, a sphere's centre, or a link's hull. Rows of
# obstacles may have a column more for each body of the arm, which is 1 if that may touch the shape.
# Kinds are those of `envs.scenes.primitives.to_array`, and `LINK`.
BOX, CYLINDER, SPHERE, LINK = 0, 1, 2, 3
ROW = 18
SIMPLEX = 32  # numbers that GJK works with


# Columns of `arm`'s first two arrays, see `hulls.arm_hulls`.
PARENT, JOINT, PRISMATIC, BEGIN, SPAN, POSITION, ROTATION, FRAME_COLUMNS = 0, 1, 2, 3, 4, 5, 8, 17
FRAME, CENTRE, RADIUS, HALF, ROUNDING, LINK_ROW = 0, 1, 4, 5, 8, 9
SHARP, CORNERS, BODY_COLUMNS = 10, 11, 12


@uncounted
def write_row(rows, i, row):
    """`rows[i] = row`, without the code of a wrong shape's message, which takes 2 s to compile."""
    for j in range(row.shape[0]):
        rows[i, j] = row[j]


@compiled
def working_memory(chain, bodies):
    """(frames, centres, pose, simplex, other)"""
    return (
        np.zeros((chain.shape[0], 12)),
        np.empty((bodies.shape[0], 3)),
        np.zeros(12),
        np.empty(SIMPLEX + ROW),
        np.zeros((1, ROW)),
    )


@uncounted
def place_arm(q, chain, bodies, frames, centres):
    """Write the frames and the bodies' centres of a normalised configuration."""
    # Numbers are read one by one, here and in `is_free`: Numba counts references to each row of an
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
        n = ROTATION
        xx, xy, xz = chain[frame, n], chain[frame, n + 1], chain[frame, n + 2]
        yx, yy, yz = chain[frame, n + 3], chain[frame, n + 4], chain[frame, n + 5]
        zx, zy, zz = chain[frame, n + 6], chain[frame, n + 7], chain[frame, n + 8]
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
