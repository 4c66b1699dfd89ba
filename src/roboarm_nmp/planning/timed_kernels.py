"""Compiled collision checks in time, with obstacles whose motions are known."""

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import working_memory
from roboarm_nmp.envs.collision.motion_kernels import is_free
from roboarm_nmp.envs.collision.moving_kernels import moved_rows
from roboarm_nmp.utils.numba_cache import compiled


@compiled
def rows_in_time(motions, centres, shapes, times, rows):
    """Write the rows of all shapes at times (t,), s, to `rows` (t, r, `ROW` or more).

    `shapes`: (r, `ROW`), of which the first ones have `motions` and `centres`, as of `moved_rows`.
    """
    moving = centres.shape[0]
    for k in range(times.shape[0]):
        rows[k] = shapes
        moved_rows(motions, centres, shapes[:moving], times[k], rows[k])


@compiled
def free_in_time(states, steps, rule, endpoint_margins, arm, rows, cloud, free):
    """Write whether states (m, n) are free at `steps` (m,) and one step later to `free` (m,).

    `rows`: (t, r, `ROW` or more), of each step. `cloud`: all of `world` but the rows.
    """
    memory, last = working_memory(arm[0], arm[1]), rows.shape[0] - 1
    points, groups, ball, blocks = cloud
    for i in range(states.shape[0]):
        free[i] = True
        for step in range(steps[i], steps[i] + 2):
            world = rows[min(step, last)], points, groups, ball, blocks
            if not is_free(states[i], rule, endpoint_margins, arm, world, memory):
                free[i] = False
                break


@compiled
def first_departure(start, end, length, first, last, rule, endpoint_margins, arm, rows, cloud):
    """The first step from `first` to `last` at which a motion may begin; -1 if there is none.

    The motion takes `length` steps of equal size. Its states are checked as by `free_in_time`.
    """
    n = start.shape[0]
    state, step, free = np.empty((1, n)), np.empty(1, np.int64), np.empty(1, np.bool_)
    departure = first
    while departure <= last:
        blocked = False
        for i in range(1, length + 1):
            for j in range(n):
                state[0, j] = start[j] + (end[j] - start[j]) * i / length
            step[0] = departure + i
            free_in_time(state, step, rule, endpoint_margins, arm, rows, cloud, free)
            if not free[0]:
                blocked = True
                break
        if not blocked:
            return departure
        departure += 1
    return -1
