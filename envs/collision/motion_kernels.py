"""Compiled collision checks of configurations, one by one, in float64."""

import math

from roboarm_nmp.envs.collision.arm_kernels import (
    FAR,
    FRAME,
    HALF,
    LINK_ROW,
    RADIUS,
    ROUNDING,
    ROW,
    place_arm,
    working_memory,
)
from roboarm_nmp.envs.collision.block_kernels import F32, squared_length
from roboarm_nmp.envs.collision.gjk_kernels import (
    ROUNDING_ERROR,
    begin_gjk,
    box_gap,
    gjk,
    is_apart,
    sphere_gap,
    write_body_row,
)
from roboarm_nmp.envs.collision.lanes_kernels import (
    WIDTH,
    larger,
    less,
    load,
    lowest,
    magnitude,
    spread,
)
from roboarm_nmp.utils.numba_cache import compiled, uncounted

_SLACK = 1e-5  # m: more than rounding to float32 changes


@uncounted
def margin_of(q, rule, endpoint_margins):
    """The margin (m) at a state, as `CollisionChecker.is_free` has it."""
    margin, joints = rule[0], endpoint_margins.shape[1] - 1
    for i in range(endpoint_margins.shape[0]):
        squared = 0.0
        for j in range(joints):
            squared += (q[j] - endpoint_margins[i, j]) ** 2
        margin = min(margin, endpoint_margins[i, joints] + rule[2] * math.sqrt(squared))
    return margin


@uncounted
def is_free(q, rule, endpoint_margins, arm, world, memory):
    """`CollisionChecker.is_free` of one state."""
    chain, bodies, pairs, vertices, cells = arm
    rows, _, groups, ball, _ = world
    frames, centres, pose, s, other = memory
    touching = rows.shape[1] > ROW
    margin, clearance = margin_of(q, rule, endpoint_margins), rule[1]
    place_arm(q, chain, bodies, frames, centres)
    for k in range(bodies.shape[0] - 1, -1, -1):  # the hand first: it moves most
        if bodies[k, LINK_ROW] < 0.0:  # the base stands where it stands
            break
        for j in range(rows.shape[0]):
            if touching and rows[j, ROW + k] != 0.0:
                continue
            gap = margin + clearance + rows[j, 16] + bodies[k, ROUNDING]
            reach = bodies[k, RADIUS] + gap
            if reach > 0.0 and sphere_gap(rows, j, centres, k) >= reach * reach:
                continue
            if not is_apart(bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap):
                return False
    for i in range(pairs.shape[0]):
        a, b = pairs[i, 0], pairs[i, 1]
        gap = margin + (bodies[a, ROUNDING] + bodies[b, ROUNDING])
        reach = bodies[a, RADIUS] + bodies[b, RADIUS] + gap
        x, y = centres[a, 0] - centres[b, 0], centres[a, 1] - centres[b, 1]
        z = centres[a, 2] - centres[b, 2]
        if reach > 0.0 and x * x + y * y + z * z >= reach * reach:
            continue
        write_body_row(bodies, b, frames, centres, other)
        if not is_apart(bodies, vertices, cells, a, other, 0, frames, centres, pose, s, gap):
            return False
    for k in range(bodies.shape[0] - 1 if groups.shape[0] > 0 else -1, -1, -1):
        if bodies[k, LINK_ROW] < 0.0:
            break
        gap = margin + clearance + ball[0, 16] + bodies[k, ROUNDING]
        if not is_apart_from_points(
            bodies, vertices, cells, k, world, frames, centres, pose, s, gap
        ):
            return False
    return True


@uncounted
def is_apart_from_points(bodies, vertices, cells, k, world, frames, centres, pose, s, gap):
    """Whether a body's hull is at least `gap` (m) from all points of the cloud."""
    _, points, _, ball, (balls, columns, begins) = world
    if gap <= 0.0:
        return True
    f = frames[int(bodies[k, FRAME])]
    x, y, z = F32(centres[k, 0]), F32(centres[k, 1]), F32(centres[k, 2])
    xx, xy, xz = F32(f[0]), F32(f[1]), F32(f[2])
    yx, yy, yz = F32(f[3]), F32(f[4]), F32(f[5])
    zx, zy, zz = F32(f[6]), F32(f[7]), F32(f[8])
    half_x, half_y, half_z = (
        F32(bodies[k, HALF]),
        F32(bodies[k, HALF + 1]),
        F32(bodies[k, HALF + 2]),
    )
    reach, within = F32(bodies[k, RADIUS] + gap + _SLACK), F32((gap + _SLACK) ** 2)
    zero = spread(F32(0.0))
    # A plane with the whole hull behind it, of the last point that GJK found apart: it settles most
    # of the others.
    nx = ny = nz = 0.0
    behind = FAR
    for first in range(0, begins.shape[0], WIDTH):
        u = load(balls, 4 * first) - x
        v = load(balls, 4 * first + WIDTH) - y
        w = load(balls, 4 * first + 2 * WIDTH) - z
        reaches = load(balls, 4 * first + 3 * WIDTH) + reach
        near = less(squared_length(u, v, w), reaches * reaches)
        while near != 0:
            block = first + lowest(near)
            near &= near - 1
            u = load(columns, 3 * WIDTH * block) - x
            v = load(columns, 3 * WIDTH * block + WIDTH) - y
            w = load(columns, 3 * WIDTH * block + 2 * WIDTH) - z
            # From the box around the body.
            a = larger(magnitude(u * xx + v * yx + w * zx) - half_x, zero)
            b = larger(magnitude(u * xy + v * yy + w * zy) - half_y, zero)
            c = larger(magnitude(u * xz + v * yz + w * zz) - half_z, zero)
            left = less(squared_length(a, b, c), spread(within))
            while left != 0:
                j = begins[block] + lowest(left)
                left &= left - 1
                if box_gap(bodies, k, frames, centres, points, j, pose) >= gap:
                    continue
                along = nx * pose[9] + ny * pose[10] + nz * pose[11]
                if along >= behind + gap:
                    continue
                begin_gjk(ball, 0, pose, s)
                if gjk(vertices, cells, k, ball, 0, pose, s, gap, gap)[0] < gap:
                    return False
                norm = math.sqrt(s[28] * s[28] + s[29] * s[29] + s[30] * s[30])
                nx, ny, nz = -s[28] / norm, -s[29] / norm, -s[30] / norm
                along = nx * pose[9] + ny * pose[10] + nz * pose[11]
                behind = along - s[31] + ROUNDING_ERROR
    return True


@compiled
def free_batch(states, rule, endpoint_margins, arm, world, free):
    """Write `CollisionChecker.is_free` of states (m, n) to `free` (m,)."""
    memory = working_memory(arm[0], arm[1])
    for i in range(states.shape[0]):
        margins = endpoint_margins[i if endpoint_margins.shape[0] > 1 else 0]
        free[i] = is_free(states[i], rule, margins, arm, world, memory)
