"""Compiled collision checks of configurations, one by one, in float64."""

import math

from roboarm_nmp.envs.collision.arm_kernels import (
    LINK_ROW,
    RADIUS,
    ROUNDING,
    ROW,
    place_arm,
    working_memory,
)
from roboarm_nmp.envs.collision.gjk_kernels import (
    begin_gjk,
    box_gap,
    gjk,
    is_apart,
    sphere_gap,
    write_body_row,
)
from roboarm_nmp.utils.numba_cache import compiled, uncounted


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
    rows, _, groups, ball = world
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
    _, points, groups, ball = world
    for g in range(groups.shape[0]):
        x, y, z = (
            groups[g, 0] - centres[k, 0],
            groups[g, 1] - centres[k, 1],
            groups[g, 2] - centres[k, 2],
        )
        reach = bodies[k, RADIUS] + groups[g, 3] + gap
        if x * x + y * y + z * z >= reach * reach:
            continue
        if box_gap(bodies, k, frames, centres, groups, g, pose) >= groups[g, 3] + gap:
            continue
        j = int(groups[g, 4])
        while j < groups[g, 5]:
            away = box_gap(bodies, k, frames, centres, points, j, pose)
            if away < gap:
                begin_gjk(ball, 0, pose, s)
                if gjk(vertices, cells, k, ball, 0, pose, s, gap, gap)[0] < gap:
                    return False
            # The points of its cube are in a ball around it.
            j = j + 1 if away < gap + points[j, 3] else int(points[j, 4])
    return True


@compiled
def free_batch(states, rule, endpoint_margins, arm, world, free):
    """Write `CollisionChecker.is_free` of states (m, n) to `free` (m,)."""
    memory = working_memory(arm[0], arm[1])
    for i in range(states.shape[0]):
        margins = endpoint_margins[i if endpoint_margins.shape[0] > 1 else 0]
        free[i] = is_free(states[i], rule, margins, arm, world, memory)
