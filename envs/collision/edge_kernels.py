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
from roboarm_nmp.envs.collision.gjk_kernels import (
    gap_along,
    relative_pose,
    was_apart,
    write_body_row,
)
from roboarm_nmp.envs.collision.grid_kernels import offsets
from roboarm_nmp.envs.collision.lanes_kernels import (
    WIDTH,
    floor,
    gathered,
    lane,
    larger,
    largest,
    less,
    load,
    lowest,
    root,
    smaller,
    spread,
    store,
)
from roboarm_nmp.envs.collision.motion_kernels import is_apart_from_points, margin_of
from roboarm_nmp.utils.numba_cache import compiled, inlined, uncounted

# What is undecided in a block: a body and a shape; or one of these and a pair's index, or a body.
PAIR, CLOUD = -1, -2
_HIT = -1
_ALL = 2**WIDTH - 1  # lanes


@compiled
def block_memory(arm, arm32, world):
    """Working memory of `check_motion`, for an arm in a world.

    `axes`, for `gjk_kernels.was_apart`, are remembered from motion to motion.
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
        np.zeros(bodies.shape[0] * WIDTH + pairs.shape[0], np.float32),  # moves
        np.empty(arm32[2].shape[0] * 3 * WIDTH, np.float32),  # centres of outer spheres
        np.empty(bodies.shape[0], np.bool_),  # of which bodies they are written
        np.empty(bodies.shape[0] * columns.shape[0] // (ROW * WIDTH), np.int64),  # masks of shapes
    )
    return block, (rounded, columns), working_memory(chain, bodies)


@uncounted
def check_motion(start, end, ends, rule, endpoint_margins, arm, arm32, world, grid, memory):
    """How many states of a straight motion were checked; negative if one is not free.

    With `ends` 1, the start is known to be free; with 0 the end is, too; with 2 neither is. The
    states are those of `CollisionChecker.is_motion_free`, and up to 16 are checked at once.
    """
    block, shapes, single = memory
    states, moves = block[2], block[6]
    n = start.shape[0]
    squared = 0.0
    for j in range(n):
        squared += (end[j] - start[j]) ** 2
    pieces = max(int(math.ceil(math.sqrt(squared) / rule[3])), 1)
    begin, last = 0 if ends == 2 else 1, pieces - 1 if ends == 0 else pieces
    count = last + 1 - begin
    blocks = (count + WIDTH - 1) // WIDTH
    checked = 0
    # Each block has states all along the motion; the end comes in the first one.
    for first in range(begin + blocks - 1, begin - 1, -1):
        place_states(start, end, first, blocks, last, pieces, states)
        checked = min(checked + WIDTH, count)
        margins = margins_of(states, n, rule[0], rule[2], endpoint_margins)
        place_bodies(arm32, block)
        near = list_near(
            margins, rule[0], rule[1], True, moves, arm[2], arm32, world, shapes, grid, block
        )
        if near == _HIT:
            return -checked
        if near > 0:
            lanes = lanes_left(near, margins, rule[1], moves, arm, arm32, world, block, single)
            if lanes != 0 and not _are_apart(
                start, end, first, blocks, last, pieces, near, lanes, rule, endpoint_margins, arm,
                world, block, single,
            ):  # fmt: skip
                return -checked
    return checked


@inlined
def place_bodies(arm32, block):
    """Write the frames and the bodies' centres of a block's states."""
    bodies = arm32[1]
    frames, centres, states = block[0], block[1], block[2]
    place_block(states, arm32[0], frames)
    for k in range(bodies.shape[0]):
        x, y, z = points_of(
            frames,
            int(bodies[k, FRAME]),
            bodies[k, CENTRE],
            bodies[k, CENTRE + 1],
            bodies[k, CENTRE + 2],
        )
        store(centres, 3 * k * WIDTH, x)
        store(centres, (3 * k + 1) * WIDTH, y)
        store(centres, (3 * k + 2) * WIDTH, z)


@inlined
def list_near(margins, most, clearance, hits, moves, pairs, arm32, world, shapes, grid, block):
    """List what spheres do not separate by its margin in the states of `place_bodies`.

    Args:
        margins: lanes, m; `most` is what none of them exceeds.
        clearance: m, from the scene, in addition.
        hits: whether to stop where a sphere in a body is nearer than the margin.
        moves: float32, m: what is added to the margins of each body, 16 numbers each; then those of
            each pair.

    Returns: how many are undecided; -1 where there is a hit.
    """
    block[8][:] = False
    count = _against_shapes(
        margins, F32(most + clearance), F32(clearance), hits, moves, arm32, world[0], shapes, block
    )
    if count == _HIT:
        return count
    count = _against_links(margins, count, moves, pairs, arm32, block)
    if grid[0].shape[0] > 0:
        count = _against_points(margins, count, F32(clearance), moves, arm32, world, grid, block)
    return count


@uncounted
def _place_spheres(k, arm32, block):
    """Write the centres of a body's outer spheres in the states of a block, once."""
    _, bodies, outer, outer_begin, _, _ = arm32
    frames, spheres, are_placed = block[0], block[7], block[8]
    if are_placed[k]:
        return
    are_placed[k] = True
    f = int(bodies[k, FRAME])
    for i in range(outer_begin[k], outer_begin[k + 1]):
        x, y, z = points_of(frames, f, outer[i, 0], outer[i, 1], outer[i, 2])
        store(spheres, 3 * i * WIDTH, x)
        store(spheres, (3 * i + 1) * WIDTH, y)
        store(spheres, (3 * i + 2) * WIDTH, z)


@uncounted
def _place_of(points, i):
    """Where point i is in the states of a block."""
    row = 3 * i * WIDTH
    return load(points, row), load(points, row + WIDTH), load(points, row + 2 * WIDTH)


@inlined
def _against_shapes(margins, most, clearance, hits, moves, arm32, rows, shapes, block):
    """List the bodies and shapes that spheres do not settle; their number, or `_HIT`."""
    _, bodies, outer, outer_begin, inner, inner_begin = arm32
    rounded, columns = shapes
    frames, centres, _, undecided, _, _, _, spheres, _, masks = block
    capacity = columns.shape[0] // ROW
    touching = rows.shape[1] > ROW
    # Shapes near a ball around each body in all 16 states; first of all, as no branch waits for it.
    for k in range(bodies.shape[0]):
        cx, cy, cz = _place_of(centres, k)
        mx, my, mz = lane(cx, WIDTH // 2), lane(cy, WIDTH // 2), lane(cz, WIDTH // 2)
        move = load(moves, k * WIDTH)
        moved = largest(root(squared_length(cx - mx, cy - my, cz - mz)) + move)
        reach = most + bodies[k, ROUNDING] + bodies[k, RADIUS] + moved + F32(1e-6)
        for begin in range(0, capacity, WIDTH):
            near = rows_near(columns, capacity, begin, mx, my, mz, reach)
            masks[(k * capacity + begin) // WIDTH] = near
    count = 0
    for k in range(bodies.shape[0] - 1, -1, -1):  # the hand first: it moves most
        if bodies[k, LINK_ROW] < F32(0.0):  # the base stands where it stands
            continue
        f = int(bodies[k, FRAME])
        cx, cy, cz = _place_of(centres, k)
        of_body = margins + load(moves, k * WIDTH) + (clearance + bodies[k, ROUNDING])
        for begin in range(0, capacity, WIDTH):
            near = masks[(k * capacity + begin) // WIDTH]
            while near != 0:
                j = begin + lowest(near)
                near &= near - 1
                if touching and rows[j, ROW + k] != 0.0:
                    continue
                slack = rounded[j, 17]
                gaps = of_body + rounded[j, 16]
                reaches = gaps + (bodies[k, RADIUS] + slack)
                left = less(squared_gaps(rounded, j, cx, cy, cz), reaches * reaches)
                if left == 0:
                    continue
                _place_spheres(k, arm32, block)
                close = 0
                for i in range(outer_begin[k], outer_begin[k + 1]):
                    x, y, z = _place_of(spheres, i)
                    within = gaps + (outer[i, 3] + slack)
                    close |= less(squared_gaps(rounded, j, x, y, z), within * within)
                    if left & ~close == 0:
                        break
                left &= close
                if left == 0:
                    continue
                if hits and rounded[j, 0] != F32(LINK):
                    possible = left & less(spread(F32(0.0)), gaps)
                    for i in range(inner_begin[k], inner_begin[k + 1]):
                        x, y, z = points_of(frames, f, inner[i, 0], inner[i, 1], inner[i, 2])
                        within = larger(gaps + (inner[i, 3] - slack), spread(F32(0.0)))
                        if possible & less(squared_gaps(rounded, j, x, y, z), within * within) != 0:
                            return _HIT
                undecided[count, 0], undecided[count, 1], undecided[count, 2] = k, j, left
                count += 1
    return count


@inlined
def _against_links(margins, count, moves, pairs, arm32, block):
    """Add the pairs of links that spheres do not settle to the list of `count`; its length."""
    _, bodies, outer, outer_begin, _, _ = arm32
    _, centres, _, undecided, _, _, _, spheres, _, _ = block
    of_pairs = bodies.shape[0] * WIDTH
    for p in range(pairs.shape[0]):
        a, b = pairs[p, 0], pairs[p, 1]
        ax, ay, az = _place_of(centres, a)
        bx, by, bz = _place_of(centres, b)
        gaps = margins + (bodies[a, ROUNDING] + bodies[b, ROUNDING] + moves[of_pairs + p])
        reaches = gaps + (bodies[a, RADIUS] + bodies[b, RADIUS])
        left = less(squared_length(ax - bx, ay - by, az - bz), reaches * reaches)
        if left == 0:
            continue
        _place_spheres(a, arm32, block)
        _place_spheres(b, arm32, block)
        close = 0
        for i in range(outer_begin[b], outer_begin[b + 1]):
            x, y, z = _place_of(spheres, i)
            reaches = gaps + (outer[i, 3] + bodies[a, RADIUS])
            near = less(squared_length(x - ax, y - ay, z - az), reaches * reaches)
            if near & left & ~close == 0:
                continue
            for n in range(outer_begin[a], outer_begin[a + 1]):
                u, v, w = _place_of(spheres, n)
                reaches = gaps + (outer[i, 3] + outer[n, 3])
                close |= less(squared_length(u - x, v - y, w - z), reaches * reaches)
        left &= close
        if left != 0:
            undecided[count, 0], undecided[count, 1], undecided[count, 2] = PAIR, p, left
            count += 1
    return count


@uncounted
def _against_points(margins, count, clearance, moves, arm32, world, grid, block):
    """Add the bodies that may be near a point of the cloud to the list of `count`; its length."""
    _, bodies, outer, outer_begin, _, _ = arm32
    _, _, _, undecided, _, _, _, spheres, _, _ = block
    near, numbers, place = grid
    ball, nothing = world[3], spread(F32(0.0))
    last_x = spread(F32(numbers[0]) - F32(0.5))
    last_y = spread(F32(numbers[1]) - F32(0.5))
    last_z = spread(F32(numbers[2]) - F32(0.5))
    margins = margins + (clearance + F32(ball[0, 16]))
    for k in range(bodies.shape[0] - 1, -1, -1):
        if bodies[k, LINK_ROW] < F32(0.0):
            continue
        gaps = margins + load(moves, k * WIDTH) + bodies[k, ROUNDING]
        _place_spheres(k, arm32, block)
        left = 0
        for i in range(outer_begin[k], outer_begin[k + 1]):
            x, y, z = _place_of(spheres, i)
            # (Outside of the grid, the nearest place in it is not farther from any point.)
            x = smaller(larger((x - place[0]) * place[3], nothing), last_x)
            y = smaller(larger((y - place[1]) * place[3], nothing), last_y)
            z = smaller(larger((z - place[2]) * place[3], nothing), last_z)
            # (1 um for rounding)
            reaches = gaps + (outer[i, 3] + F32(1e-6)) + offsets(x, y, z, place)
            cell = (floor(x) * F32(numbers[1]) + floor(y)) * F32(numbers[2]) + floor(z)
            left |= less(gathered(near, cell), reaches * reaches)
            if left == _ALL:
                break
        if left != 0:
            undecided[count, 0], undecided[count, 1], undecided[count, 2] = CLOUD, k, left
            count += 1
    return count


@uncounted
def lanes_left(count, margins, clearance, moves, arm, arm32, world, block, single):
    """Take from the list what remembered axes separate; returns the lanes that are left in it.

    Frames in float32 do for that: rounding moves bodies by less than their spheres are larger.
    """
    _, bodies, pairs, vertices, cells = arm
    rows = world[0]
    _, _, states, undecided, axes, _, _, _, _, _ = block
    frames, centres, pose, _, other = single
    slack, of_pairs = arm32[1][0, RADIUS] - bodies[0, RADIUS], bodies.shape[0] * WIDTH
    own = states[states.shape[0] - WIDTH :]
    store(own, 0, margins)
    lanes = 0
    for i in range(count):
        k, j, left = undecided[i, 0], undecided[i, 1], undecided[i, 2]
        axis = bodies.shape[0] * rows.shape[0] + j if k == PAIR else k * rows.shape[0] + j
        if k == CLOUD or not _is_axis(axes, axis):
            lanes |= left
            continue
        a = pairs[j, 0] if k == PAIR else k
        f, keep = int(bodies[a, FRAME]), 0
        while left != 0:
            here = lowest(left)
            left &= left - 1
            _write_pose(bodies, a, here, block, frames, centres)
            gap = own[here] + bodies[a, ROUNDING] + 2.0 * slack
            if k == PAIR:
                b = pairs[j, 1]
                _write_pose(bodies, b, here, block, frames, centres)
                write_body_row(bodies, b, frames, centres, other)
                relative_pose(other, 0, frames, f, centres, a, pose)
                along = gap_along(vertices, cells, a, other, 0, frames, f, pose, axes, axis)
                gap += bodies[b, ROUNDING] + moves[of_pairs + j]
            else:
                relative_pose(rows, j, frames, f, centres, k, pose)
                along = gap_along(vertices, cells, k, rows, j, frames, f, pose, axes, axis)
                gap += clearance + rows[j, 16] + moves[k * WIDTH + here]
            if along < gap:
                keep |= 1 << here
        undecided[i, 2] = keep
        lanes |= keep
    return lanes


@uncounted
def _is_axis(axes, n):
    return axes[n, 0] != 0.0 or axes[n, 1] != 0.0 or axes[n, 2] != 0.0


@uncounted
def _write_pose(bodies, k, here, block, frames, centres):
    """Write a body's frame and centre in one state of a block."""
    f = int(bodies[k, FRAME])
    for i in range(9):  # `relative_pose` needs no position
        frames[f, i] = block[0][(12 * f + i) * WIDTH + here]
    for i in range(3):
        centres[k, i] = block[1][(3 * k + i) * WIDTH + here]


@uncounted
def _most_undecided(undecided, count):
    """The lane in which most is undecided: probably, something touches there."""
    most = best = 0
    for here in range(WIDTH):
        number = 0
        for i in range(count):
            number += (undecided[i, 2] >> here) & 1
        if number > most:
            most, best = number, here
    return best


@uncounted
def _are_apart(
    start, end, first, step, last, pieces, count, lanes, rule, endpoint_margins, arm, world, block,
    single,
):  # fmt: skip
    """Whether all that is undecided in a block is apart, by GJK, in float64."""
    chain, bodies, pairs, vertices, cells = arm
    rows = world[0]
    frames, centres, pose, s, other = single
    _, _, _, undecided, axes, q, _, _, _, _ = block
    n, shapes = start.shape[0], rows.shape[0]
    before = -1
    here = _most_undecided(undecided, count)
    while lanes != 0:
        if (lanes >> here) & 1 == 0:
            here = lowest(lanes)
        lanes &= ~(1 << here)
        number = min(first + here * step, last)
        if number == before:  # the last lanes may be the same state
            break
        before = number
        share = number / pieces
        for j in range(n):
            q[j] = start[j] + (end[j] - start[j]) * share
        margin = margin_of(q, rule, endpoint_margins)
        place_arm(q, chain, bodies, frames, centres)
        for i in range(count):
            if (undecided[i, 2] >> here) & 1 == 0:
                continue
            k, j = undecided[i, 0], undecided[i, 1]
            if k == PAIR:
                a, b = pairs[j, 0], pairs[j, 1]
                gap = margin + (bodies[a, ROUNDING] + bodies[b, ROUNDING])
                write_body_row(bodies, b, frames, centres, other)
                axis = bodies.shape[0] * shapes + j
                apart = was_apart(
                    bodies, vertices, cells, a, other, 0, frames, centres, pose, s, gap, axes, axis
                )
            elif k == CLOUD:
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
def motion_batch(starts, stops, rule, endpoint_margins, arm, arm32, world, grid, ends, checks):
    """Write `CollisionChecker.motion_checks` of motions (m, n), (m, n) to `checks` (m,)."""
    memory = block_memory(arm, arm32, world)
    axes = memory[0][4]
    for i in range(starts.shape[0]):
        # An answer must not depend on the motions before.
        axes[:] = 0.0
        margins = endpoint_margins[i if endpoint_margins.shape[0] > 1 else 0]
        checks[i] = check_motion(
            starts[i], stops[i], ends, rule, margins, arm, arm32, world, grid, memory
        )


@compiled
def first_free(paths, orders, rule, endpoint_margins, arm, arm32, world, grid):
    """`CollisionChecker.first_free_path` of paths (m, k, n)."""
    memory = block_memory(arm, arm32, world)
    axes = memory[0][4]
    for i in range(paths.shape[0]):
        for step in orders[i]:
            axes[:] = 0.0  # an answer must not depend on the motions before
            start, end = paths[i, step], paths[i, step + 1]
            checks = check_motion(
                start, end, 1, rule, endpoint_margins, arm, arm32, world, grid, memory
            )
            if checks <= 0:
                break
        else:
            return i
    return paths.shape[0]


@compiled
def single_motion(
    rule, ends, chain, bodies, pairs, vertices, cells, arm32, rows, points, groups, ball, blocks,
    grid, start, end,
):  # fmt: skip
    """`check_motion` for Python, which takes longer to pass nested tuples than their arrays."""
    arm, world = (chain, bodies, pairs, vertices, cells), (rows, points, groups, ball, blocks)
    q, stop = np.array(start), np.array(end)
    memory = block_memory(arm, arm32, world)
    return check_motion(q, stop, 1, rule, ends, arm, arm32, world, grid, memory)
