"""Compiled continuous checks of straight motions: between states, too, nothing touches.

A motion is halved again and again. In the middle of a part, what is farther away than it can come
in that part needs no more checks there (conservative advancement, Mirtich, 1996).
"""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import (
    BODY_COLUMNS,
    JOINT,
    LINK_ROW,
    RADIUS,
    ROUNDING,
    ROW,
    SPAN,
    place_arm,
    working_memory,
)
from roboarm_nmp.envs.collision.gjk_kernels import is_apart, sphere_gap, write_body_row
from roboarm_nmp.envs.collision.motion_kernels import is_apart_from_points
from roboarm_nmp.utils.numba_cache import compiled, uncounted

# In a list of what may touch: a body and a shape; or one of these and a pair's index, or a body.
_PAIR, _CLOUD = -1, -2
_DEPTH = 24  # halvings at most
# m: what moves less than this in a part of a motion counts as standing still there. Margins are
# larger by as much.
TOLERANCE = 2e-6


@compiled
def continuous_memory(arm, world):
    """Working memory of `is_motion_clear`."""
    size = arm[1].shape[0] * (world[0].shape[0] + 1) + arm[2].shape[0]
    return (
        np.empty((_DEPTH + 2, size, 2), np.int64),  # lists of what may touch, of each depth
        np.empty(_DEPTH + 2, np.int64),  # their lengths
        np.empty((_DEPTH + 2, 2)),  # the parts that are left: where they begin, and their depth
        np.empty(arm[1].shape[0] + arm[2].shape[0]),  # sweeps
        np.empty(arm[0].shape[0]),  # one state
        working_memory(arm[0], arm[1]),
    )


@uncounted
def _write_sweeps(start, end, chain, bodies, pairs, sweeps):
    """Write how far (m) points move at most in a straight motion, (b + p,).

    Those of each body in the base's frame, and those of each pair of links towards each other.
    """
    sweeps[:] = 0.0
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


@uncounted
def _list_all(bodies, pairs, world, pending):
    """Write all that may touch to a list; returns its length."""
    rows = world[0]
    count = 0
    for k in range(bodies.shape[0] - 1, -1, -1):
        if bodies[k, LINK_ROW] < 0.0:  # the base stands where it stands
            continue
        for j in range(rows.shape[0]):
            if rows.shape[1] > ROW and rows[j, ROW + k] != 0.0:
                continue
            pending[count, 0], pending[count, 1] = k, j
            count += 1
        if world[2].shape[0] > 0:
            pending[count, 0], pending[count, 1] = _CLOUD, k
            count += 1
    for i in range(pairs.shape[0]):
        pending[count, 0], pending[count, 1] = _PAIR, i
        count += 1
    return count


@uncounted
def is_motion_clear(start, end, rule, endpoint_margins, arm, world, memory):
    """Whether a straight motion keeps its margins everywhere, not only at some states.

    Margins are those of `CollisionChecker.is_free`, and `TOLERANCE` more. Where they would be kept
    by less than that, the answer is False.
    """
    chain, bodies, pairs, vertices, cells = arm
    rows = world[0]
    lists, lengths, parts, sweeps, q, single = memory
    frames, centres, pose, s, other = single
    n = start.shape[0]
    _write_sweeps(start, end, chain, bodies, pairs, sweeps)
    squared = 0.0
    for j in range(n):
        squared += (end[j] - start[j]) ** 2
    length = math.sqrt(squared)
    lengths[0] = _list_all(bodies, pairs, world, lists[0])
    parts[0, 0], parts[0, 1] = 0.0, 0.0
    left = 1
    while left > 0:
        left -= 1
        begin, depth = parts[left, 0], int(parts[left, 1])
        half = 0.5 ** (depth + 1)
        for j in range(n):
            q[j] = start[j] + (end[j] - start[j]) * (begin + half)
        margin = rule[0]
        for i in range(endpoint_margins.shape[0]):
            squared = 0.0
            for j in range(n):
                squared += (q[j] - endpoint_margins[i, j]) ** 2
            margin = min(margin, endpoint_margins[i, n] + rule[2] * math.sqrt(squared))
        # How much larger the margin is elsewhere in this part, at most.
        more = min(rule[0] - margin, rule[2] * length * half) + TOLERANCE
        place_arm(q, chain, bodies, frames, centres)
        count = 0
        for i in range(lengths[depth]):
            k, j = lists[depth, i, 0], lists[depth, i, 1]
            if k == _PAIR:
                a, b = pairs[j, 0], pairs[j, 1]
                gap = margin + (bodies[a, ROUNDING] + bodies[b, ROUNDING])
                moved = more + half * sweeps[bodies.shape[0] + j]
                reach = bodies[a, RADIUS] + bodies[b, RADIUS] + gap + moved
                x, y = centres[a, 0] - centres[b, 0], centres[a, 1] - centres[b, 1]
                z = centres[a, 2] - centres[b, 2]
                if x * x + y * y + z * z >= reach * reach:
                    continue
                write_body_row(bodies, b, frames, centres, other)
                if is_apart(
                    bodies, vertices, cells, a, other, 0, frames, centres, pose, s, gap + moved
                ):
                    continue
                apart = is_apart(
                    bodies, vertices, cells, a, other, 0, frames, centres, pose, s, gap
                )
            elif k == _CLOUD:
                gap = margin + rule[1] + world[3][0, 16] + bodies[j, ROUNDING]
                moved = more + half * sweeps[j]
                if is_apart_from_points(
                    bodies, vertices, cells, j, world, frames, centres, pose, s, gap + moved
                ):
                    continue
                apart = is_apart_from_points(
                    bodies, vertices, cells, j, world, frames, centres, pose, s, gap
                )
            else:
                gap = margin + rule[1] + rows[j, 16] + bodies[k, ROUNDING]
                moved = more + half * sweeps[k]
                reach = bodies[k, RADIUS] + gap + moved
                if sphere_gap(rows, j, centres, k) >= reach * reach:
                    continue
                if is_apart(
                    bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap + moved
                ):
                    continue
                apart = is_apart(bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap)
            if not apart:
                return False
            lists[depth + 1, count, 0], lists[depth + 1, count, 1] = k, j
            count += 1
        if count == 0:
            continue
        if depth == _DEPTH - 1:  # nearer than the tolerance
            return False
        lengths[depth + 1] = count
        parts[left, 0], parts[left, 1] = begin + half, depth + 1
        parts[left + 1, 0], parts[left + 1, 1] = begin, depth + 1
        left += 2
    return True


@compiled
def clear_batch(starts, stops, rule, endpoint_margins, arm, world, clear):
    """Write `is_motion_clear` of motions (m, n), (m, n) to `clear` (m,)."""
    memory = continuous_memory(arm, world)
    for i in range(starts.shape[0]):
        margins = endpoint_margins[i if endpoint_margins.shape[0] > 1 else 0]
        clear[i] = is_motion_clear(starts[i], stops[i], rule, margins, arm, world, memory)
