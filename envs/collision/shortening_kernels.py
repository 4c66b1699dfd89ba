"""Compiled shortening of paths: vertices are left out, and corners are cut."""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import write_row
from roboarm_nmp.envs.collision.continuous_kernels import is_motion_clear
from roboarm_nmp.envs.collision.edge_kernels import check_motion
from roboarm_nmp.utils.numba_cache import compiled, uncounted

# For each chord, so many corners are cut. L2, normalised: what a shortcut saves at least.
_CORNERS, _GAIN = 3, 0.02


@uncounted
def random_share(random):
    """A random number in [0, 1) by SplitMix64 (Steele et al., 2014). `random`: its state (1,)."""
    random[0] += np.uint64(0x9E3779B97F4A7C15)
    z = random[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@uncounted
def _move(rows, begin, end, to):
    """Move the rows from `begin` to `end` - 1, to row `to` and on."""
    for i in range(end - begin):
        k = i if to < begin else end - begin - 1 - i  # none is overwritten before it is moved
        write_row(rows, to + k, rows[begin + k])


@uncounted
def _distance(a, b):
    squared = 0.0
    for j in range(a.shape[0]):
        squared += (a[j] - b[j]) ** 2
    return math.sqrt(squared)


@uncounted
def _is_free(start, end, certain, rule, margins, arm, arm32, world, grid, memories):
    """Number of checks of a motion, negative if it is not free; `certain`: between states, too."""
    memory, continuous, clear_rule = memories
    checks = check_motion(start, end, 1, rule, margins, arm, arm32, world, grid, memory)
    if checks <= 0 or not certain:
        return checks
    is_clear = is_motion_clear(
        start, end, clear_rule, margins, arm, arm32, world, grid, memory, continuous
    )
    return checks if is_clear else -checks


@compiled
def is_path_clear(path, margins, arm, arm32, world, grid, memories):
    """Whether nothing touches anywhere on a path (k, n)."""
    memory, continuous, clear_rule = memories
    for i in range(path.shape[0] - 1):
        if not is_motion_clear(
            path[i], path[i + 1], clear_rule, margins, arm, arm32, world, grid, memory, continuous
        ):
            return False
    return True


@compiled
def shortened(path, chords, random, certain, rule, margins, arm, arm32, world, grid, memories):
    """A path (k, n) with fewer vertices and shorter, and the number of checks.

    First, from each vertex, the straight motion to a vertex far behind it, found by bisection. Then
    `chords` straight motions between random points of the path, and `_CORNERS` times as many past
    random vertices, where they are free and save at least `_GAIN`. With `certain`, they are checked
    between states, too.
    """
    n, count, checks = path.shape[1], path.shape[0], 0
    tries = (1 + _CORNERS) * chords
    points, along = np.empty((count + tries, n)), np.zeros(count + tries)
    for i in range(count):
        write_row(points, i, path[i])
    i = 0
    while i < count - 2:
        free, hit, j = i + 1, count, count - 1
        while hit - free > 1:
            more = _is_free(
                points[i], points[j], certain, rule, margins, arm, arm32, world, grid, memories
            )
            checks += abs(more)
            if more > 0:
                free = j
            else:
                hit = j
            j = (free + hit) // 2
        _move(points, free, count, i + 1)
        count -= free - i - 1
        i += 1
    _measure(points, along, count)
    begin, end = np.empty(n), np.empty(n)
    for number in range(tries):
        if count < 3:
            break
        one, other = random_share(random), random_share(random)
        if number < chords:
            low, high = min(one, other) * along[count - 1], max(one, other) * along[count - 1]
        else:
            i = 1 + int(random_share(random) * (count - 2))
            low = along[i] - one * (along[i] - along[i - 1])
            high = along[i] + other * (along[i + 1] - along[i])
        first = _at(points, along, count, low, begin)
        last = _at(points, along, count, high, end)
        if first == last or high - low - _distance(begin, end) < _GAIN:
            continue
        more = _is_free(begin, end, certain, rule, margins, arm, arm32, world, grid, memories)
        checks += abs(more)
        if more > 0:
            # The vertices up to `first`, the chord's ends, the vertices from `last` + 1 on.
            _move(points, last + 1, count, first + 3)
            write_row(points, first + 1, begin)
            write_row(points, first + 2, end)
            count += 2 - (last - first)
            _measure(points, along, count)
    return points[:count].copy(), checks


@uncounted
def _measure(points, along, count):
    """Write the path's length up to each of its vertices."""
    for i in range(1, count):
        along[i] = along[i - 1] + _distance(points[i - 1], points[i])


@uncounted
def _at(points, along, count, length, point):
    """Write the path's point at a length; returns the index of the vertex before it."""
    edge = 0
    while edge < count - 2 and along[edge + 1] <= length:
        edge += 1
    part = (length - along[edge]) / max(along[edge + 1] - along[edge], 1e-12)
    for j in range(point.shape[0]):
        point[j] = points[edge, j] + (points[edge + 1, j] - points[edge, j]) * part
    return edge
