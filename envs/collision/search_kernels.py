"""Compiled planning within a number of checks: RRT-Connect and shortcuts."""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import FAR
from roboarm_nmp.envs.collision.motion_kernels import motion
from roboarm_nmp.utils.numba_cache import compiled


@compiled
def _nearest_node(nodes, count, q):
    """Index of the nearest of the first `count` nodes (L2), and its distance."""
    least, nearest = FAR, 0
    for i in range(count):
        squared = 0.0
        for j in range(q.shape[0]):
            squared += (nodes[i, j] - q[j]) ** 2
        if squared < least:
            least, nearest = squared, i
    return nearest, math.sqrt(least)


@compiled
def _towards(start, end, reach, distance, new):
    """Write the state at most `reach` from `start` towards `end`. Returns whether it is `end`."""
    if distance <= reach:
        new[:] = end
        return True
    for j in range(start.shape[0]):
        new[j] = start[j] + (end[j] - start[j]) * reach / distance
    return False


@compiled
def rrt_connect(start, goals, samples, reach, max_checks, rule, endpoint_margins, arm, world):
    """A path from `start` (n,) to one of `goals` (m, n) by RRT-Connect (Kuffner and LaValle, 2000).

    `samples`: (s, n), the random states towards which the trees grow, after the goals themselves.
    `reach`: L2, the longest edge. `rule`, `endpoint_margins`: as for `motion`.

    Returns the path (k, n), (0, n) if there is none within `samples` and about `max_checks`, and
    the number of checks.
    """
    n, m = start.shape[0], goals.shape[0]
    capacity = max_checks + m + samples.shape[0] + 2  # an edge takes at least one check
    nodes, parents = np.empty((2, capacity, n)), np.full((2, capacity), -1)
    size = np.array([1, m])
    nodes[0, 0], nodes[1, :m] = start, goals
    new = np.empty(n)
    checks = tree = 0
    for i in range(m + samples.shape[0]):
        if checks >= max_checks:
            break
        if i < m:
            tree, target = 0, goals[i]
        else:
            target = samples[i - m]
        near, distance = _nearest_node(nodes[tree], size[tree], target)
        other = 1 - tree
        _towards(nodes[tree, near], target, reach, distance, new)
        more = motion(rule, endpoint_margins, arm, world, False, nodes[tree, near], new)
        checks += abs(more)
        if more > 0:
            a = size[tree]
            nodes[tree, a], parents[tree, a] = new, near
            size[tree] += 1
            # The other tree grows to the new node, as far as it can.
            b, distance = _nearest_node(nodes[other], size[other], nodes[tree, a])
            arrived = distance < 1e-9
            while not arrived and checks < max_checks:
                arrived = _towards(nodes[other, b], nodes[tree, a], reach, distance, new)
                more = motion(rule, endpoint_margins, arm, world, False, nodes[other, b], new)
                checks += abs(more)
                if more <= 0:
                    arrived = False
                    break
                nodes[other, size[other]], parents[other, size[other]] = new, b
                b = size[other]
                size[other] += 1
                distance -= reach
            if arrived:
                if tree == 1:
                    a, b = b, a
                return _joined_path(nodes, parents, a, b), checks
        tree = other
    return np.empty((0, n)), checks


@compiled
def _joined_path(nodes, parents, a, b):
    """The path from the first tree's root to its node a, then from node b to the other's root.

    Both nodes are the same state.
    """
    length = 0
    node = parents[0, a]
    while node >= 0:
        length += 1
        node = parents[0, node]
    before, node = length, b
    while node >= 0:
        length += 1
        node = parents[1, node]
    path = np.empty((length, nodes.shape[2]))
    node = parents[0, a]
    for i in range(before - 1, -1, -1):
        path[i] = nodes[0, node]
        node = parents[0, node]
    node = b
    for i in range(before, length):
        path[i] = nodes[1, node]
        node = parents[1, node]
    return path


@compiled
def shortcut(path, chords, rule, endpoint_margins, arm, world):
    """Shorten a path (k, n) by straight motions between two of its points, where they are free.

    `chords`: (c, 2), shares of the path's length at which a shortcut begins and ends, in any order.
    Returns the path and the number of checks.
    """
    checks, n = 0, path.shape[1]
    for c in range(chords.shape[0]):
        k = path.shape[0]
        length = np.zeros(k)
        for i in range(1, k):
            length[i] = length[i - 1] + math.sqrt(np.sum((path[i] - path[i - 1]) ** 2))
        ends, edges = np.empty((2, n)), np.zeros(2, np.int64)
        for end in range(2):
            share = min(chords[c]) if end == 0 else max(chords[c])
            along = share * length[-1]
            edge = 0
            while edge < k - 2 and length[edge + 1] <= along:
                edge += 1
            part = (along - length[edge]) / max(length[edge + 1] - length[edge], 1e-12)
            ends[end] = path[edge] + (path[edge + 1] - path[edge]) * part
            edges[end] = edge
        if edges[0] == edges[1]:
            continue
        more = motion(rule, endpoint_margins, arm, world, False, ends[0], ends[1])
        checks += abs(more)
        if more > 0:
            path = np.concatenate((path[: edges[0] + 1], ends, path[edges[1] + 1 :]))
    return path, checks
