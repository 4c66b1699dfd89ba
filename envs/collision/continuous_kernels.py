"""Compiled continuous checks of straight motions: between states, too, nothing touches.

A motion is cut into short parts. How fast the arm's points move in the middle of a part, and how
much faster they can become, says how far they come in the part at most. What is farther away than
that in the middle does not touch. Spheres settle most of it for 16 parts at once, and GJK the rest:
along its axis, only speeds in that direction count, and parts are halved where that is not enough
(conservative advancement, Mirtich, 1996).
"""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import (
    BODY_COLUMNS,
    FRAME,
    HALF,
    JOINT,
    PARENT,
    PRISMATIC,
    RADIUS,
    ROUNDING,
    SPAN,
    place_arm,
    working_memory,
)
from roboarm_nmp.envs.collision.block_kernels import (
    F32,
    margins_of,
    place_speeds,
    place_states,
    rotation_speeds,
    speeds_of,
    squared_length,
)
from roboarm_nmp.envs.collision.edge_kernels import (
    CLOUD,
    PAIR,
    block_memory,
    lanes_left,
    list_near,
    place_bodies,
)
from roboarm_nmp.envs.collision.gjk_kernels import (
    begin_gjk,
    both_boxes,
    boxes_apart,
    gjk,
    is_apart,
    relative_pose,
    write_body_row,
)
from roboarm_nmp.envs.collision.lanes_kernels import WIDTH, load, lowest, root, store
from roboarm_nmp.envs.collision.motion_kernels import is_apart_from_points, margin_of
from roboarm_nmp.utils.numba_cache import compiled, uncounted

_DEPTH = 24  # halvings of a part at most
_PART = 0.021  # L2, normalised: the longest part that spheres are asked about
# m: what moves less than this in a part of a motion counts as standing still there. Margins are
# larger by as much.
TOLERANCE = 2e-6
_TOUCHES, _UNDECIDED, _APART = 0, 1, 2


@compiled
def continuous_memory(arm, world):
    """Working memory of `is_motion_clear`."""
    num_bodies, num_frames, num_pairs = arm[1].shape[0], arm[0].shape[0], arm[2].shape[0]
    size = num_bodies * (world[0].shape[0] + 1) + num_pairs
    return (
        np.empty((_DEPTH + 2, size, 2), np.int64),  # lists of what may touch, of each depth
        np.empty(_DEPTH + 2, np.int64),  # their lengths
        np.empty((_DEPTH + 2, 2)),  # the parts that are left: their middles, and their depth
        np.empty(num_frames),  # speeds of the joints
        np.empty(num_bodies + num_pairs),  # accelerations
        np.zeros((num_frames, 6)),  # speeds of frames
        np.empty((4, 3)),  # speeds of two bodies
        np.empty(num_frames),  # one state
        working_memory(arm[0], arm[1]),
        np.empty(num_frames, np.float32),  # speeds of the joints
        np.empty(6 * num_frames * WIDTH, np.float32),  # speeds in a block
        np.empty(num_bodies * WIDTH + num_pairs, np.float32),  # moves in a block
    )


@uncounted
def _acceleration(chain, bodies, k, other, rates):
    """Largest acceleration (m per motion^2) of a body's points, in any state of a motion.

    With another body, in the last frame that moves both. The second derivative by two joints is at
    most the outer one's lever if the inner one turns, and otherwise zero.
    """
    most = turned = 0.0
    for f in range(1, chain.shape[0]):
        lever = bodies[k, BODY_COLUMNS + f]
        if lever == 0.0 or (other >= 0 and bodies[other, BODY_COLUMNS + f] != 0.0):
            continue
        rate = abs(rates[f])
        turn = rate if chain[f, PRISMATIC] == 0.0 else 0.0
        most += rate * lever * (2.0 * turned + turn)
        turned += turn
    return most


@uncounted
def _sweep(chain, bodies, k, other, rates):
    """How far (m) points of a body come at most in a whole motion, as `_acceleration`."""
    most = 0.0
    for f in range(1, chain.shape[0]):
        if other < 0 or bodies[other, BODY_COLUMNS + f] == 0.0:
            most += abs(rates[f]) * bodies[k, BODY_COLUMNS + f]
    return most


@uncounted
def _write_bounds(start, end, arm, rates, accelerations):
    """Write speeds of joints, m or rad per motion, and `_acceleration`s of bodies and pairs."""
    chain, bodies, pairs, _, _ = arm
    rates[0] = 0.0
    for f in range(1, chain.shape[0]):
        joint = int(chain[f, JOINT])
        rates[f] = (end[joint] - start[joint]) * 0.5 * chain[f, SPAN]
    for k in range(bodies.shape[0]):
        accelerations[k] = _acceleration(chain, bodies, k, -1, rates)
    for i in range(pairs.shape[0]):
        a, b = pairs[i, 0], pairs[i, 1]
        accelerations[bodies.shape[0] + i] = _acceleration(
            chain, bodies, a, b, rates
        ) + _acceleration(chain, bodies, b, a, rates)


@uncounted
def _write_moves(half, more, arm, arm32, block, memory):
    """Write how far (m) points may come in parts of a length of twice `half`, and `more`.

    Those of bodies, from the speeds in the middle of each part, and those of pairs.
    """
    chain, bodies, pairs, _, _ = arm
    frames, centres = block[0], block[1]
    rates, accelerations, rates32, speeds, moves = (
        memory[3],
        memory[4],
        memory[9],
        memory[10],
        memory[11],
    )
    for f in range(chain.shape[0]):
        rates32[f] = rates[f]
    place_speeds(rates32, arm32[0], frames, speeds)
    # (A hair more, because of rounding.)
    share = F32(half * (1.0 + 1e-5))
    for k in range(bodies.shape[0]):
        f = int(bodies[k, FRAME])
        x, y, z = (
            load(centres, 3 * k * WIDTH),
            load(centres, (3 * k + 1) * WIDTH),
            load(centres, (3 * k + 2) * WIDTH),
        )
        u, v, w = speeds_of(frames, speeds, f, x, y, z)
        a, b, c = rotation_speeds(speeds, f)
        speed = root(squared_length(u, v, w)) + root(squared_length(a, b, c)) * F32(
            bodies[k, RADIUS]
        )
        bend = 0.5 * accelerations[k] * half * half + more
        store(moves, k * WIDTH, speed * share + F32(bend * (1.0 + 1e-5)))
    for i in range(pairs.shape[0]):
        a, b = pairs[i, 0], pairs[i, 1]
        sweep = _sweep(chain, bodies, a, b, rates) + _sweep(chain, bodies, b, a, rates)
        moves[bodies.shape[0] * WIDTH + i] = (half * sweep + more) * (1.0 + 1e-5)


@uncounted
def _place_speeds(rates, chain, frames, speeds):
    """Write the speeds of frames: of their origin, then of their rotation."""
    for f in range(1, chain.shape[0]):
        parent = int(chain[f, PARENT])
        _write_speed(frames, speeds, parent, frames[f, 9], frames[f, 10], frames[f, 11], speeds, f)
        first = 0 if chain[f, PRISMATIC] != 0.0 else 3
        for i in range(3):
            speeds[f, 3 + i] = speeds[parent, 3 + i]
        for i in range(3):
            speeds[f, first + i] += rates[f] * frames[f, 2 + 3 * i]


@uncounted
def _write_speed(frames, speeds, f, x, y, z, out, row):
    """Write to a row how fast a point at (x, y, z), in the base's frame, moves with frame f."""
    x, y, z = x - frames[f, 9], y - frames[f, 10], z - frames[f, 11]
    out[row, 0] = speeds[f, 0] + speeds[f, 4] * z - speeds[f, 5] * y
    out[row, 1] = speeds[f, 1] + speeds[f, 5] * x - speeds[f, 3] * z
    out[row, 2] = speeds[f, 2] + speeds[f, 3] * y - speeds[f, 4] * x


@uncounted
def _write_body_speed(bodies, k, relative_to, frames, centres, speeds, own, row):
    """Write how a body moves seen from a frame: its centre's speed to `own[row]`, its rotation's
    to the next row. Returns what no point of it exceeds.
    """
    f = int(bodies[k, FRAME])
    x, y, z = centres[k, 0], centres[k, 1], centres[k, 2]
    _write_speed(frames, speeds, relative_to, x, y, z, own, row + 1)
    _write_speed(frames, speeds, f, x, y, z, own, row)
    speed = turn = 0.0
    for i in range(3):
        own[row, i] -= own[row + 1, i]
        own[row + 1, i] = speeds[f, 3 + i] - speeds[relative_to, 3 + i]
        speed += own[row, i] ** 2
        turn += own[row + 1, i] ** 2
    return math.sqrt(speed) + math.sqrt(turn) * bodies[k, RADIUS]


@uncounted
def _speed_along(bodies, k, frames, own, row, x, y, z):
    """Speed of a body's centre along a unit vector, and what its points have more at most."""
    f = int(bodies[k, FRAME])
    along = own[row, 0] * x + own[row, 1] * y + own[row, 2] * z
    a, b, c = own[row + 1, 0], own[row + 1, 1], own[row + 1, 2]
    u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
    beyond = 0.0
    for i in range(3):
        beyond += bodies[k, HALF + i] * abs(
            frames[f, i] * u + frames[f, 3 + i] * v + frames[f, 6 + i] * w
        )
    return along, beyond


@uncounted
def _state_of(arm, k, other, rows, j, frames, centres, pose, s, gap, move, half, bend, own):
    """Whether a body and a shape touch in the middle of a part, or are apart in all of it.

    Args:
        other: the body that the shape is, or -1.
        gap: m, nearer than which they touch.
        move: m, how much nearer they come at most; `bend` of it is what accelerations add.
    """
    _, bodies, _, vertices, cells = arm
    if both_boxes(bodies, k, rows, j):
        if is_apart(bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap + move):
            return _APART
        apart = is_apart(bodies, vertices, cells, k, rows, j, frames, centres, pose, s, gap)
        return _UNDECIDED if apart else _TOUCHES
    f = int(bodies[k, FRAME])
    relative_pose(rows, j, frames, f, centres, k, pose)
    if boxes_apart(bodies, k, rows, j, pose, gap + move):
        return _APART
    begin_gjk(rows, j, pose, s)
    distance = gjk(vertices, cells, k, rows, j, pose, s, gap, gap + move)[0]
    if distance >= gap + move:
        return _APART
    if distance < gap:
        return _TOUCHES
    # The plane that separates them stands still, and both move only as far along its normal.
    x = frames[f, 0] * s[28] + frames[f, 1] * s[29] + frames[f, 2] * s[30]
    y = frames[f, 3] * s[28] + frames[f, 4] * s[29] + frames[f, 5] * s[30]
    z = frames[f, 6] * s[28] + frames[f, 7] * s[29] + frames[f, 8] * s[30]
    norm = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / norm, y / norm, z / norm
    along, beyond = _speed_along(bodies, k, frames, own, 0, x, y, z)
    if other >= 0:
        towards, more = _speed_along(bodies, other, frames, own, 2, x, y, z)
        along -= towards
        beyond += more
    return _APART if s[31] >= gap + bend + half * (abs(along) + beyond) else _UNDECIDED


@uncounted
def _is_part_clear(start, end, middle, half, growth, rule, endpoint_margins, arm, world, memory):
    """Whether what is in the first list keeps its margins in a part of a motion.

    `middle`, `half`: of the part, as shares of the motion. `growth`: of margins, m per motion.
    """
    chain, bodies, pairs, vertices, cells = arm
    rows = world[0]
    lists, lengths, parts, rates, accelerations, speeds, own, q, single = memory[:9]
    frames, centres, pose, s, other = single
    n = start.shape[0]
    parts[0, 0], parts[0, 1] = middle, 0.0
    left = 1
    while left > 0:
        left -= 1
        at, depth = parts[left, 0], int(parts[left, 1])
        size = half * 0.5**depth
        for j in range(n):
            q[j] = start[j] + (end[j] - start[j]) * at
        margin = margin_of(q, rule, endpoint_margins)
        # How much larger the margin is elsewhere in this part, at most.
        more = min(rule[0] - margin, growth * size) + TOLERANCE
        place_arm(q, chain, bodies, frames, centres)
        _place_speeds(rates, chain, frames, speeds)
        count = 0
        for i in range(lengths[depth]):
            k, j = lists[depth, i, 0], lists[depth, i, 1]
            if k == PAIR:
                a, b = pairs[j, 0], pairs[j, 1]
                fa, fb = int(bodies[a, FRAME]), int(bodies[b, FRAME])
                while fa != fb:  # parents come first
                    if fa > fb:
                        fa = int(chain[fa, PARENT])
                    else:
                        fb = int(chain[fb, PARENT])
                speed = _write_body_speed(bodies, a, fa, frames, centres, speeds, own, 0)
                speed += _write_body_speed(bodies, b, fa, frames, centres, speeds, own, 2)
                bend = 0.5 * accelerations[bodies.shape[0] + j] * size * size + more
                gap = margin + (bodies[a, ROUNDING] + bodies[b, ROUNDING])
                write_body_row(bodies, b, frames, centres, other)
                state = _state_of(
                    arm, a, b, other, 0, frames, centres, pose, s, gap, size * speed + bend, size,
                    bend, own,
                )  # fmt: skip
            else:
                body = j if k == CLOUD else k
                speed = _write_body_speed(bodies, body, 0, frames, centres, speeds, own, 0)
                bend = 0.5 * accelerations[body] * size * size + more
                move = size * speed + bend
                gap = margin + rule[1] + bodies[body, ROUNDING]
                if k == CLOUD:
                    gap += world[3][0, 16]
                    state = _TOUCHES
                    if is_apart_from_points(
                        bodies, vertices, cells, j, world, frames, centres, pose, s, gap + move
                    ):
                        state = _APART
                    elif is_apart_from_points(
                        bodies, vertices, cells, j, world, frames, centres, pose, s, gap
                    ):
                        state = _UNDECIDED
                else:
                    gap += rows[j, 16]
                    state = _state_of(
                        arm, k, -1, rows, j, frames, centres, pose, s, gap, move, size, bend, own
                    )
            if state == _TOUCHES:
                return False
            if state == _UNDECIDED:
                lists[depth + 1, count, 0], lists[depth + 1, count, 1] = k, j
                count += 1
        if count == 0:
            continue
        if depth == _DEPTH - 1:  # nearer than the tolerance
            return False
        lengths[depth + 1] = count
        parts[left, 0], parts[left, 1] = at + 0.5 * size, depth + 1
        parts[left + 1, 0], parts[left + 1, 1] = at - 0.5 * size, depth + 1
        left += 2
    return True


@uncounted
def is_motion_clear(
    start, end, rule, endpoint_margins, arm, arm32, world, grid, block_memory, memory
):
    """Whether a straight motion keeps its margins everywhere, not only at some states.

    Margins are those of `CollisionChecker.is_free`, and `TOLERANCE` more. Where they would be kept
    by less than that, the answer is False.
    """
    block, shapes, single = block_memory
    states, undecided = block[2], block[3]
    lists, lengths, moves = memory[0], memory[1], memory[11]
    n = start.shape[0]
    squared = 0.0
    for j in range(n):
        squared += (end[j] - start[j]) ** 2
    length = math.sqrt(squared)
    growth = rule[2] * length
    blocks = max(int(math.ceil(length / (_PART * WIDTH))), 1)
    pieces = 2 * WIDTH * blocks  # halves of parts
    half = 1.0 / pieces
    _write_bounds(start, end, arm, memory[3], memory[4])
    for block_number in range(blocks):
        first = 2 * WIDTH * block_number + 1
        place_states(start, end, first, 2, pieces, pieces, states)
        margins = margins_of(states, n, rule[0], rule[2], endpoint_margins)
        place_bodies(arm32, block)
        more = min(rule[0], growth * half) + TOLERANCE
        _write_moves(half, more, arm, arm32, block, memory)
        count = list_near(
            margins, rule[0], rule[1], False, moves, arm[2], arm32, world, shapes, grid, block
        )
        lanes = lanes_left(count, margins, rule[1], moves, arm, arm32, world, block, single)
        while lanes != 0:
            here = lowest(lanes)
            lanes &= lanes - 1
            lengths[0] = 0
            for i in range(count):
                if (undecided[i, 2] >> here) & 1 != 0:
                    lists[0, lengths[0], 0] = undecided[i, 0]
                    lists[0, lengths[0], 1] = undecided[i, 1]
                    lengths[0] += 1
            middle = (first + 2 * here) * half
            if not _is_part_clear(
                start, end, middle, half, growth, rule, endpoint_margins, arm, world, memory
            ):
                return False
    return True


@compiled
def clear_batch(starts, stops, rule, endpoint_margins, arm, arm32, world, grid, clear):
    """Write `is_motion_clear` of motions (m, n), (m, n) to `clear` (m,)."""
    blocks, memory = block_memory(arm, arm32, world), continuous_memory(arm, world)
    for i in range(starts.shape[0]):
        margins = endpoint_margins[i if endpoint_margins.shape[0] > 1 else 0]
        clear[i] = is_motion_clear(
            starts[i], stops[i], rule, margins, arm, arm32, world, grid, blocks, memory
        )
