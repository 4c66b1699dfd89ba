"""Compiled checks of straight motions, 16 states at a time.

In a block of 16 states, spheres settle most of what is near: those inside a link's hull are certain
hits, and what is outside the spheres around it is certainly apart. GJK decides the rest, state by
state in float64, so the answers are those of `motion_kernels.is_free`.
"""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import (
    CENTRE,
    FRAME,
    LINK,
    LINK_ROW,
    RADIUS,
    ROUNDING,
    ROW,
    place_arm,
    working_memory,
)
from roboarm_nmp.envs.collision.block_kernels import (
    F32,
    margins_of,
    place_block,
    place_states,
    points_of,
    rows_near,
    rows_of_block,
    squared_gaps,
    squared_length,
)
from roboarm_nmp.envs.collision.gjk_kernels import was_apart, write_body_row
from roboarm_nmp.envs.collision.lanes_kernels import (
    WIDTH,
    lane,
    larger,
    largest,
    less,
    load,
    lowest,
    spread,
    store,
)
from roboarm_nmp.envs.collision.motion_kernels import free_batch, is_apart_from_points
from roboarm_nmp.utils.numba_cache import compiled, uncounted

# What is undecided in a block: a body and a shape; or one of these and a pair's index, or a body.
_PAIR, _CLOUD = -1, -2
_HIT = -1


@compiled
def block_memory(arm, world):
    """Working memory of `check_motion`, for an arm in a world.

    `axes`, for `gjk_kernels.apart_by`, are remembered from motion to motion.
    """
    chain, bodies, pairs, _, _ = arm
    rows = world[0]
    rounded, columns = rows_of_block(rows)
    size = bodies.shape[0] * (rows.shape[0] + 1) + pairs.shape[0]
    block = (
        np.empty(chain.shape[0] * 12 * WIDTH, np.float32),  # frames
        np.empty(bodies.shape[0] * 3 * WIDTH, np.float32),  # centres
        np.empty((chain.shape[0] + 4) * WIDTH, np.float32),  # states
        np.empty((size, 3), np.int64),  # undecided
        np.zeros((size, 3)),  # axes
        np.empty(chain.shape[0]),  # one state
    )
    return block, (rounded, columns), working_memory(chain, bodies)


@uncounted
def check_motion(start, end, ends_known, rule, endpoint_margins, arm, arm32, world, grid, memory):
    """How many states of a straight motion were checked; negative if one is not free.

    The start is known to be free, and with `ends_known` the end is, too. The states are those of
    `CollisionChecker.is_motion_free`, and up to 16 are checked at once.
    """
    block, shapes, single = memory
    chain32, bodies32 = arm32[0], arm32[1]
    frames, centres, states, undecided, _, _ = block
    n = start.shape[0]
    squared = 0.0
    for j in range(n):
        squared += (end[j] - start[j]) ** 2
    pieces = max(int(math.ceil(math.sqrt(squared) / rule[3])), 1)
    last = pieces - 1 if ends_known else pieces
    blocks = (last + WIDTH - 1) // WIDTH
    checked = 0
    # Each block has states all along the motion; the end comes in the first one.
    for first in range(blocks, 0, -1):
        place_states(start, end, first, blocks, last, pieces, states)
        checked = min(checked + WIDTH, last)
        margins = margins_of(states, n, rule[0], rule[2], endpoint_margins)
        place_block(states, chain32, frames)
        for k in range(bodies32.shape[0]):
            x, y, z = points_of(
                frames,
                int(bodies32[k, FRAME]),
                bodies32[k, CENTRE],
                bodies32[k, CENTRE + 1],
                bodies32[k, CENTRE + 2],
            )
            store(centres, 3 * k * WIDTH, x)
            store(centres, (3 * k + 1) * WIDTH, y)
            store(centres, (3 * k + 2) * WIDTH, z)
        count = _against_shapes(margins, rule, arm32, world[0], shapes, block)
        if count == _HIT:
            return -checked
        count = _against_links(margins, count, arm[2], arm32, block)
        if grid[0].shape[0] > 0:
            count = _against_points(margins, count, rule, arm32, world, grid, block)
        if count > 0 and not _are_apart(
            start, end, first, blocks, last, pieces, count, rule, endpoint_margins, arm, world,
            block, single,
        ):  # fmt: skip
            return -checked
    return checked


@uncounted
def _against_shapes(margins, rule, arm32, rows, shapes, block):
    """List the bodies and shapes that spheres do not settle; their number, or `_HIT`."""
    _, bodies, outer, outer_begin, inner, inner_begin = arm32
    rounded, columns = shapes
    frames, centres, _, undecided, _, _ = block
    capacity = columns.shape[0] // ROW
    touching = rows.shape[1] > ROW
    margins = margins + F32(rule[1])
    count = 0
    for k in range(bodies.shape[0] - 1, -1, -1):  # the hand first: it moves most
        if bodies[k, LINK_ROW] < F32(0.0):  # the base stands where it stands
            continue
        f = int(bodies[k, FRAME])
        cx, cy = load(centres, 3 * k * WIDTH), load(centres, (3 * k + 1) * WIDTH)
        cz = load(centres, (3 * k + 2) * WIDTH)
        # A ball around the body in all 16 states.
        mx, my, mz = lane(cx, WIDTH // 2), lane(cy, WIDTH // 2), lane(cz, WIDTH // 2)
        moved = largest(squared_length(cx - mx, cy - my, cz - mz))
        reach = F32(rule[0] + rule[1]) + bodies[k, ROUNDING] + bodies[k, RADIUS]
        reach += F32(math.sqrt(moved)) + F32(1e-6)
        for begin in range(0, capacity, WIDTH):
            near = rows_near(columns, capacity, begin, mx, my, mz, reach)
            while near != 0:
                j = begin + lowest(near)
                near &= near - 1
                if touching and rows[j, ROW + k] != 0.0:
                    continue
                slack = rounded[j, 17]
                gaps = margins + (rounded[j, 16] + bodies[k, ROUNDING])
                reaches = gaps + (bodies[k, RADIUS] + slack)
                left = less(squared_gaps(rounded, j, cx, cy, cz), reaches * reaches)
                if left == 0:
                    continue
                if rounded[j, 0] != F32(LINK):
                    possible = left & less(spread(F32(0.0)), gaps)
                    for i in range(inner_begin[k], inner_begin[k + 1]):
                        x, y, z = points_of(frames, f, inner[i, 0], inner[i, 1], inner[i, 2])
                        within = larger(gaps + (inner[i, 3] - slack), spread(F32(0.0)))
                        hits = less(squared_gaps(rounded, j, x, y, z), within * within)
                        if hits & possible != 0:
                            return _HIT
                close = 0
                for i in range(outer_begin[k], outer_begin[k + 1]):
                    x, y, z = points_of(frames, f, outer[i, 0], outer[i, 1], outer[i, 2])
                    within = gaps + (outer[i, 3] + slack)
                    close |= less(squared_gaps(rounded, j, x, y, z), within * within)
                left &= close
                if left != 0:
                    undecided[count, 0], undecided[count, 1], undecided[count, 2] = k, j, left
                    count += 1
    return count


@uncounted
def _against_links(margins, count, pairs, arm32, block):
    """Add the pairs of links that spheres do not settle to the list of `count`; its length."""
    _, bodies, outer, outer_begin, _, _ = arm32
    frames, centres, _, undecided, _, _ = block
    for p in range(pairs.shape[0]):
        a, b = pairs[p, 0], pairs[p, 1]
        ax, ay = load(centres, 3 * a * WIDTH), load(centres, (3 * a + 1) * WIDTH)
        az = load(centres, (3 * a + 2) * WIDTH)
        bx, by = load(centres, 3 * b * WIDTH), load(centres, (3 * b + 1) * WIDTH)
        bz = load(centres, (3 * b + 2) * WIDTH)
        gaps = margins + (bodies[a, ROUNDING] + bodies[b, ROUNDING])
        reaches = gaps + (bodies[a, RADIUS] + bodies[b, RADIUS])
        left = less(squared_length(ax - bx, ay - by, az - bz), reaches * reaches)
        if left == 0:
            continue
        fa, fb = int(bodies[a, FRAME]), int(bodies[b, FRAME])
        close = 0
        for i in range(outer_begin[b], outer_begin[b + 1]):
            x, y, z = points_of(frames, fb, outer[i, 0], outer[i, 1], outer[i, 2])
            reaches = gaps + (outer[i, 3] + bodies[a, RADIUS])
            if less(squared_length(x - ax, y - ay, z - az), reaches * reaches) & left == 0:
                continue
            for n in range(outer_begin[a], outer_begin[a + 1]):
                u, v, w = points_of(frames, fa, outer[n, 0], outer[n, 1], outer[n, 2])
                reaches = gaps + (outer[i, 3] + outer[n, 3])
                close |= less(squared_length(u - x, v - y, w - z), reaches * reaches)
        left &= close
        if left != 0:
            undecided[count, 0], undecided[count, 1], undecided[count, 2] = _PAIR, p, left
            count += 1
    return count


@uncounted
def _against_points(margins, count, rule, arm32, world, grid, block):
    """Add the bodies that may be near a point of the cloud to the list of `count`; its length."""
    _, bodies, outer, outer_begin, _, _ = arm32
    frames, _, states, undecided, _, _ = block
    near, numbers, place = grid
    ball = world[3]
    nx, ny, nz = numbers[0], numbers[1], numbers[2]
    own = states[states.shape[0] - 3 * WIDTH :]
    margins = margins + F32(rule[1] + ball[0, 16])
    for k in range(bodies.shape[0] - 1, -1, -1):
        if bodies[k, LINK_ROW] < F32(0.0):
            continue
        left = 0
        for i in range(outer_begin[k], outer_begin[k + 1]):
            x, y, z = points_of(
                frames, int(bodies[k, FRAME]), outer[i, 0], outer[i, 1], outer[i, 2]
            )
            store(own, 0, (x - place[0]) * place[3])
            store(own, WIDTH, (y - place[1]) * place[3])
            store(own, 2 * WIDTH, (z - place[2]) * place[3])
            reaches = margins + (bodies[k, ROUNDING] + outer[i, 3])
            for n in range(WIDTH):
                u, v, w = own[n], own[WIDTH + n], own[2 * WIDTH + n]
                distance = place[4]  # outside of the grid
                if u >= 0.0 and v >= 0.0 and w >= 0.0 and u < nx and v < ny and w < nz:
                    distance = near[(int(u) * ny + int(v)) * nz + int(w)]
                own[n] = distance
            left |= less(load(own, 0), reaches)
        if left != 0:
            undecided[count, 0], undecided[count, 1], undecided[count, 2] = _CLOUD, k, left
            count += 1
    return count


@uncounted
def _are_apart(
    start, end, first, step, last, pieces, count, rule, endpoint_margins, arm, world, block, single
):
    """Whether all that is undecided in a block is apart, by GJK, in float64."""
    chain, bodies, pairs, vertices, cells = arm
    rows = world[0]
    frames, centres, pose, s, other = single
    _, _, _, undecided, axes, q = block
    n, shapes = start.shape[0], rows.shape[0]
    lanes = 0
    for i in range(count):
        lanes |= undecided[i, 2]
    before = -1
    while lanes != 0:
        here = lowest(lanes)
        lanes &= lanes - 1
        number = min(first + here * step, last)
        if number == before:  # the last lanes may be the same state
            break
        before = number
        share = number / pieces
        for j in range(n):
            q[j] = start[j] + (end[j] - start[j]) * share
        margin = rule[0]
        for i in range(endpoint_margins.shape[0]):
            squared = 0.0
            for j in range(n):
                squared += (q[j] - endpoint_margins[i, j]) ** 2
            margin = min(margin, endpoint_margins[i, n] + rule[2] * math.sqrt(squared))
        place_arm(q, chain, bodies, frames, centres)
        for i in range(count):
            if (undecided[i, 2] >> here) & 1 == 0:
                continue
            k, j = undecided[i, 0], undecided[i, 1]
            if k == _PAIR:
                a, b = pairs[j, 0], pairs[j, 1]
                gap = margin + (bodies[a, ROUNDING] + bodies[b, ROUNDING])
                write_body_row(bodies, b, frames, centres, other)
                axis = bodies.shape[0] * shapes + j
                apart = was_apart(
                    bodies, vertices, cells, a, other, 0, frames, centres, pose, s, gap, axes, axis
                )
            elif k == _CLOUD:
                gap = margin + rule[1] + world[3][0, 16] + bodies[j, ROUNDING]
                apart = is_apart_from_points(
                    bodies, vertices, cells, j, world, frames, centres, pose, s, gap
                )
            else:
                gap = margin + rule[1] + rows[j, 16] + bodies[k, ROUNDING]
                axis = k * shapes + j
                apart = was_apart(
                    bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap, axes, axis
                )
            if not apart:
                return False
    return True


@compiled
def motion_batch(
    starts, stops, rule, endpoint_margins, arm, arm32, world, grid, ends_known, checks
):
    """Write `CollisionChecker.motion_checks` of motions (m, n), (m, n) to `checks` (m,)."""
    begins = np.ones(starts.shape[0], np.bool_)
    if not ends_known:
        free_batch(starts, rule, endpoint_margins, arm, world, begins)
    memory = block_memory(arm, world)
    axes = memory[0][4]
    for i in range(starts.shape[0]):
        if not begins[i]:
            checks[i] = -1
            continue
        # An answer must not depend on the motions before.
        axes[:] = 0.0
        margins = endpoint_margins[i if endpoint_margins.shape[0] > 1 else 0]
        checks[i] = check_motion(
            starts[i], stops[i], ends_known, rule, margins, arm, arm32, world, grid, memory
        )
        if not ends_known:
            checks[i] += 1 if checks[i] > 0 else -1


@compiled
def single_motion(
    rule, ends, chain, bodies, pairs, vertices, cells, arm32, rows, points, groups, ball, grid,
    start, end,
):  # fmt: skip
    """`check_motion` for Python, which takes longer to pass nested tuples than their arrays."""
    arm, world = (chain, bodies, pairs, vertices, cells), (rows, points, groups, ball)
    q, stop = np.array(start), np.array(end)
    memory = block_memory(arm, world)
    return check_motion(q, stop, False, rule, ends, arm, arm32, world, grid, memory)
