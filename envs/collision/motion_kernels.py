"""Compiled collision checks of configurations and of straight motions between them."""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import (
    BODY_COLUMNS,
    FAR,
    JOINT,
    LINK_ROW,
    RADIUS,
    ROUNDING,
    ROW,
    SPAN,
    place_arm,
    working_memory,
)
from roboarm_nmp.envs.collision.gjk_kernels import (
    ROUNDING_ERROR,
    apart_by,
    begin_gjk,
    box_gap,
    gjk,
    sphere_gap,
    write_body_row,
)
from roboarm_nmp.utils.numba_cache import compiled, uncounted


@uncounted
def is_free(
    q, rule, endpoint_margins, arm, world, memory, axes, sweeps, share, known, still, place
):
    """`CollisionChecker.is_free` of one state, and what is near in the motion that it is part of.

    A pair is (k, j), body k and shape j, or (-1, i), the links of `pairs[i]`.

    Args:
        axes: for `apart_by`: a row per body and shape, then per pair of links; or empty.
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
    lists, above, num_known = known
    joints, shapes, count = endpoint_margins.shape[1] - 1, rows.shape[0], 0
    touching = rows.shape[1] > ROW
    margin, clearance, growth = rule[0], rule[1], rule[2]
    for i in range(endpoint_margins.shape[0]):
        squared = 0.0
        for j in range(joints):
            squared += (q[j] - endpoint_margins[i, j]) ** 2
        margin = min(margin, endpoint_margins[i, joints] + growth * math.sqrt(squared))
    place_arm(q, chain, bodies, frames, centres)
    k, j = bodies.shape[0] - 1, -1  # the hand first: it moves most
    i = -1
    while True:
        i += 1
        if num_known >= 0:
            if i == num_known:
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
            squared = sphere_gap(rows, j, centres, k)
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
            swept = rule[0] - margin + share * sweep + ROUNDING_ERROR
            far = reach + swept
            if squared >= far * far and reach > 0.0:
                continue
        if reach <= 0.0 or squared < reach * reach:
            if k >= 0:
                lower = apart_by(
                    bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap, axes,
                    k * shapes + j,
                )  # fmt: skip
            else:
                write_body_row(bodies, b, frames, centres, other)
                lower = apart_by(
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
            if box_gap(bodies, k, frames, centres, groups, g, pose) >= groups[g, 3] + gap:
                continue
            for j in range(int(groups[g, 4]), int(groups[g, 5])):
                if box_gap(bodies, k, frames, centres, points, j, pose) >= gap:
                    continue
                begin_gjk(ball, 0, pose, s)
                if gjk(vertices, cells, k, ball, 0, pose, s, gap, gap)[0] < gap:
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
    memory = working_memory(arm[0], arm[1])
    axes, sweeps, lists = np.empty((0, 3)), np.empty(0), np.empty((0, 0, 2), np.int64)
    for i in range(states.shape[0]):
        margins = endpoint_margins[i if endpoint_margins.shape[0] > 1 else 0]
        known = lists, 0, -1
        near = is_free(
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
    memory = working_memory(chain, bodies)
    q = np.empty(joints)
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
            near = is_free(
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
