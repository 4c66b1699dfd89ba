"""Compiled planning: RRT-Connect (Kuffner and LaValle, 2000) with restarts.

What stays the same during a search is a `problem`: `(rules, arm, arm32, world, grid)`. The rules
are those of `checker.Rules`.
"""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import write_row
from roboarm_nmp.envs.collision.continuous_kernels import continuous_memory, is_motion_clear
from roboarm_nmp.envs.collision.edge_kernels import block_memory, check_motion
from roboarm_nmp.envs.collision.lanes_kernels import (
    WIDTH,
    fused,
    largest,
    less,
    load,
    lowest,
    spread,
)
from roboarm_nmp.envs.collision.shortening_kernels import (
    is_path_clear,
    random_share,
    shortened,
)
from roboarm_nmp.utils.numba_cache import compiled, uncounted

F32 = np.float32
CLEAR = 5e-6
"""m: what finished paths keep clear everywhere, so that rounding to float32 changes nothing."""
# Nodes of a tree at most. Checks of the first two tries; then each second one may take twice as
# many, up to the last.
_CAPACITY, _FIRST_TRY, _LAST_TRY = 8192, 20_000, 160_000


@uncounted
def _nearest(nodes, columns, tree, count, q):
    """Index of the nearest (L2) of the first `count` nodes of a tree, and its distance."""
    n, capacity = q.shape[0], nodes.shape[1]
    least, nearest = np.inf, 0
    for begin in range(0, count, WIDTH):
        # In float32 those that may be nearer, then exactly.
        squared = spread(F32(0.0))
        for j in range(n):
            away = load(columns, (tree * capacity + begin) * n + j * WIDTH) - F32(q[j])
            squared = fused(away, away, squared)
        nearer = less(squared, spread(F32(least * (1.0 + 1e-5) + 1e-12)))
        if nearer != 0 and begin + WIDTH <= count:
            of_these = -largest(spread(F32(0.0)) - squared)
            nearer &= less(squared, spread(F32(of_these * (1.0 + 1e-5) + 1e-12)))
        while nearer != 0:
            i = begin + lowest(nearer)
            nearer &= nearer - 1
            exact = 0.0
            for j in range(n):
                exact += (nodes[tree, i, j] - q[j]) ** 2
            if i < count and exact < least:
                least, nearest = exact, i
    return nearest, math.sqrt(least)


@uncounted
def _add(nodes, columns, parents, tree, i, q, parent):
    """Make a state node i of a tree."""
    n, lane = q.shape[0], i % WIDTH
    parents[tree, i] = parent
    block = (tree * nodes.shape[1] + i - lane) * n
    for j in range(n):
        nodes[tree, i, j] = q[j]
        columns[block + j * WIDTH + lane] = q[j]


@uncounted
def _towards(start, end, reach, distance, new):
    """Write the state at most `reach` from `start` towards `end`. Returns whether it is `end`."""
    arrives = distance <= reach
    for j in range(start.shape[0]):
        new[j] = end[j] if arrives else start[j] + (end[j] - start[j]) * (reach / distance)
    return arrives


@compiled
def _search(
    start, goals, bounds, reach, checks, max_checks, certain, random, problem, trees, memories
):
    """One try: the path (k, n), (0, n) if there is none, and the number of checks so far.

    `certain`: nothing touches between the states of its motions either.
    """
    (begins, numbers, endpoints), arm, arm32, world, grid = problem
    memory, continuous, clear_rule = memories
    nodes, columns, parents = trees
    n, m, capacity = start.shape[0], goals.shape[0], nodes.shape[1]
    size = np.array([1, m])
    _add(nodes, columns, parents, 0, 0, start, -1)
    for i in range(m):
        _add(nodes, columns, parents, 1, i, goals[i], -1)
    new, target = np.empty(n), np.empty(n)
    phase = tree = samples = 0
    while checks < max_checks and size[0] < capacity - WIDTH and size[1] < capacity - WIDTH:
        while phase + 1 < begins.shape[0] and checks >= begins[phase + 1]:
            phase += 1
        rule, margins = numbers[phase], endpoints[phase]
        if samples < m:  # first the goals themselves
            for j in range(n):
                target[j] = goals[samples, j]
            tree = 0
        else:
            for j in range(n):
                share = random_share(random)
                target[j] = bounds[0, j] + (bounds[1, j] - bounds[0, j]) * share
        samples += 1
        near, distance = _nearest(nodes, columns, tree, size[tree], target)
        if distance < 1e-9:
            tree = 1 - tree
            continue
        _towards(nodes[tree, near], target, reach, distance, new)
        more = check_motion(
            nodes[tree, near], new, 1, rule, margins, arm, arm32, world, grid, memory
        )
        checks += abs(more)
        if (
            more > 0
            and certain
            and not is_motion_clear(
                nodes[tree, near],
                new,
                clear_rule,
                margins,
                arm,
                arm32,
                world,
                grid,
                memory,
                continuous,
            )
        ):
            more = -more
        other = 1 - tree
        if more > 0:
            a = size[tree]
            _add(nodes, columns, parents, tree, a, new, near)
            size[tree] += 1
            # The other tree grows to the new node, as far as it can.
            b, distance = _nearest(nodes, columns, other, size[other], nodes[tree, a])
            arrived = distance < 1e-9
            while not arrived and size[other] < capacity - WIDTH:
                arrived = _towards(nodes[other, b], nodes[tree, a], reach, distance, new)
                more = check_motion(
                    nodes[other, b], new, 1, rule, margins, arm, arm32, world, grid, memory
                )
                checks += abs(more)
                if more <= 0 or certain and not is_motion_clear(
                    nodes[other, b], new, clear_rule, margins, arm, arm32, world, grid, memory,
                    continuous,
                ):  # fmt: skip
                    arrived = False
                    break
                _add(nodes, columns, parents, other, size[other], new, b)
                b = size[other]
                size[other] += 1
                distance -= reach
            if arrived:
                if tree == 1:
                    a, b = b, a
                return _joined_path(nodes, parents, a, b), checks
        if size[tree] >= size[other]:  # the smaller tree grows
            tree = other
    return np.empty((0, n)), checks


@compiled
def _joined_path(nodes, parents, a, b):
    """The path from the first tree's root to its node a, then from node b to the other's root.

    Both nodes are the same state, which the path has once.
    """
    length, node = 0, a
    while node >= 0:
        length += 1
        node = parents[0, node]
    before, node = length, parents[1, b]
    while node >= 0:
        length += 1
        node = parents[1, node]
    path = np.empty((length, nodes.shape[2]))
    node = a
    for i in range(before - 1, -1, -1):
        write_row(path, i, nodes[0, node])
        node = parents[0, node]
    node = parents[1, b]
    for i in range(before, length):
        write_row(path, i, nodes[1, node])
        node = parents[1, node]
    return path


@compiled
def plan_path(found, start, goals, seed, bounds, reach, chords, checks, max_checks, problem):
    """A path from `start` (n,) to one of `goals` (m, n), shortened. Nothing touches on it.

    Args:
        found: (k, n), the path of another planner, which is only shortened; (0, n): none.
        seed: uint64.
        bounds: (2, n), between which random states are.
        reach: L2, the longest edge of a tree.
        chords: how many shortcuts are tried; 0: the path is not shortened.
        checks: how many there were before this search.
        max_checks: about the number at which it ends.
        problem: see the top of this file.

    Returns: the path (k, n), (0, n) if there is none; the number of checks.
    """
    (_, numbers, _), arm, arm32, world, _ = problem
    n = start.shape[0]
    memory = block_memory(arm, arm32, world)
    random = np.array([seed], np.uint64)
    memories = memory, continuous_memory(arm, world), np.array([CLEAR, 0.0, numbers[0, 2], 0.0])
    if found.shape[0] > 0:
        path, more = finished(found, chords, random, problem, memories)
        return path, checks + more
    trees = (
        np.empty((2, _CAPACITY, n)),
        np.empty(2 * n * _CAPACITY, np.float32),
        np.empty((2, _CAPACITY), np.int64),
    )
    tries, budget, certain = 0, _FIRST_TRY, False
    while checks < max_checks:
        limit = min(checks + budget, max_checks)
        path, checks = _search(
            start, goals, bounds, reach, checks, limit, certain, random, problem, trees, memories
        )
        tries += 1
        if tries % 2 == 0:
            budget = min(2 * budget, _LAST_TRY)
        if path.shape[0] == 0:
            continue
        path, more = finished(path, chords, random, problem, memories)
        checks += more
        if path.shape[0] > 0:
            return path, checks
        # It touches something between its states: the next ones may do so at the same place.
        certain = True
    return np.empty((0, n)), checks


@compiled
def finished(path, chords, random, problem, memories):
    """A path (k, n) shortened, and the number of checks. Nothing touches anywhere on it.

    (0, n) if `path` itself touches something between its states.
    """
    (_, numbers, endpoints), arm, arm32, world, grid = problem
    # With the full margins again, whatever the search has come down to.
    rule, margins = numbers[0], endpoints[0]
    short, checks = path, 0
    if chords > 0 and path.shape[0] > 2:
        short, checks = shortened(
            path, chords, random, False, rule, margins, arm, arm32, world, grid, memories
        )
    if is_path_clear(short, margins, arm, arm32, world, grid, memories):
        return short, checks
    if not is_path_clear(path, margins, arm, arm32, world, grid, memories):
        return np.empty((0, path.shape[1])), checks
    short, more = shortened(
        path, chords, random, True, rule, margins, arm, arm32, world, grid, memories
    )
    return short, checks + more
