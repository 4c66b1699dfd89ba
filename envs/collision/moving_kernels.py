"""Where moving obstacles are at a time, compiled.

`motions` is a tuple of float64 arrays, see `envs.collision.moving.motion_arrays`:
- a row of `OWN_COLUMNS` per obstacle: its own pose (position 3, quaternion 4); of an oscillation
  amplitude 3, angular frequency (rad/s), phase, axis 3, angle (zeros without one); the first of
  its waypoints and the one after the last, and how they repeat; the same of its intervals (none:
  it is always there);
- waypoints (w, 8): time (s), displacement 3, quaternion 4; intervals (i, 2), s.
"""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import write_row
from roboarm_nmp.utils.numba_cache import compiled

AMPLITUDE, FREQUENCY, PHASE, AXIS, ANGLE = 7, 10, 11, 12, 15
WAYPOINTS, REPEAT, INTERVALS = 16, 18, 19
OWN_COLUMNS = 21
# m. An obstacle that is not there is moved by this much along z where rows cannot be left out.
ABSENT = 1e6


@compiled
def obstacle_states(motions, times, present, poses, velocities):
    """Write where obstacles are: `envs.collision.moving.MovingObstacles.at`.

    `times`: (t,), s. `present`: bool (t, n). `poses`: (t, n, 7), position and quaternion.
    `velocities`: (t, n, 6), linear and angular.
    """
    for k in range(times.shape[0]):
        for i in range(motions[0].shape[0]):
            present[k, i] = _is_present(motions, i, times[k])
            obstacle_state(motions, i, times[k], poses[k, i], velocities[k, i])


@compiled
def moved_rows(motions, centres, shapes, t, rows):
    """Write `shape_rows` of n moving obstacles at a time (s) to `rows[:n]`.

    `shapes`: (n, `ROW` or more), the rows at their own poses. `centres`: m, (n, 3), of the shapes
    in the obstacles' own frames (zeros but for convex hulls). Absent obstacles are `ABSENT` away.
    """
    pose, velocity = np.empty(7), np.empty(6)
    for i in range(shapes.shape[0]):
        obstacle_state(motions, i, t, pose, velocity)
        row = rows[i]
        write_row(rows, i, shapes[i])
        x, y, z, w = pose[3], pose[4], pose[5], pose[6]
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
        row[4] = 1.0 - 2.0 * (y * y + z * z)
        row[5] = 2.0 * (x * y - z * w)
        row[6] = 2.0 * (x * z + y * w)
        row[7] = 2.0 * (x * y + z * w)
        row[8] = 1.0 - 2.0 * (x * x + z * z)
        row[9] = 2.0 * (y * z - x * w)
        row[10] = 2.0 * (x * z - y * w)
        row[11] = 2.0 * (y * z + x * w)
        row[12] = 1.0 - 2.0 * (x * x + y * y)
        a, b, c = centres[i, 0], centres[i, 1], centres[i, 2]
        for j in range(3):
            row[1 + j] = pose[j] + row[4 + 3 * j] * a + row[5 + 3 * j] * b + row[6 + 3 * j] * c
        if not _is_present(motions, i, t):
            row[3] += ABSENT


@compiled
def _is_present(motions, i, t):
    """Whether obstacle i is there at a time (s)."""
    own, intervals = motions[0][i], motions[2]
    begin, end = int(own[INTERVALS]), int(own[INTERVALS + 1])
    for k in range(begin, end):
        if intervals[k, 0] <= t < intervals[k, 1]:
            return True
    return begin == end


@compiled
def obstacle_state(motions, i, t, pose, velocity):
    """Write pose (7,) and velocity (6,), linear and angular, of obstacle i at a time (s)."""
    own, waypoints = motions[0][i], motions[1]
    a, b, c, d = 0.0, 0.0, 0.0, 1.0  # the rotation away from its own orientation
    phase = own[FREQUENCY] * t + own[PHASE]
    share, rate = math.sin(phase), own[FREQUENCY] * math.cos(phase)
    for j in range(3):
        pose[j] = own[j] + own[AMPLITUDE + j] * share
        velocity[j] = own[AMPLITUDE + j] * rate
        velocity[3 + j] = own[AXIS + j] * own[ANGLE] * rate
    if own[ANGLE] != 0.0:
        half = 0.5 * own[ANGLE] * share
        sine, d = math.sin(half), math.cos(half)
        a, b, c = own[AXIS] * sine, own[AXIS + 1] * sine, own[AXIS + 2] * sine
    first, last = int(own[WAYPOINTS]), int(own[WAYPOINTS + 1]) - 1
    if last >= first:
        begin, end, direction = waypoints[first, 0], waypoints[last, 0], 1.0
        span = end - begin
        if own[REPEAT] != 0.0 and t > begin:
            t -= begin
            if own[REPEAT] == 2.0:
                t -= span * math.floor(t / span)
            else:
                t -= 2.0 * span * math.floor(t / (2.0 * span))
                if t >= span:
                    t, direction = 2.0 * span - t, -1.0
            t += begin
        low, high = first, last  # the waypoint before this time, and the one after it
        while high - low > 1:
            middle = (low + high) // 2
            later = waypoints[middle, 0] > t or (direction < 0.0 and waypoints[middle, 0] == t)
            if later:
                high = middle
            else:
                low = middle
        before, after, share, rate = waypoints[low], waypoints[high], 0.0, 0.0
        if last > first:
            seconds = after[0] - before[0]
            share = min(max((t - before[0]) / seconds, 0.0), 1.0)
            if own[REPEAT] != 0.0 and t >= begin or begin <= t < end:
                rate = direction / seconds
        for j in range(3):
            pose[j] += before[1 + j] + share * (after[1 + j] - before[1 + j])
            velocity[j] += (after[1 + j] - before[1 + j]) * rate
        a, b, c, d = _between(before, after, share, rate, velocity)
    x, y, z, w = own[3], own[4], own[5], own[6]
    pose[3] = d * x + a * w + b * z - c * y
    pose[4] = d * y - a * z + b * w + c * x
    pose[5] = d * z + a * y - b * x + c * w
    pose[6] = d * w - a * x - b * y - c * z


@compiled
def _between(before, after, share, rate, velocity):
    """The rotation between two waypoints; writes the angular velocity of `rate` ways per second."""
    a, b, c, d = before[4], before[5], before[6], before[7]
    e, f, g, h = after[4], after[5], after[6], after[7]
    if a * e + b * f + c * g + d * h < 0.0:
        e, f, g, h = -e, -f, -g, -h
    apart = math.sqrt((a - e) ** 2 + (b - f) ** 2 + (c - g) ** 2 + (d - h) ** 2)
    together = math.sqrt((a + e) ** 2 + (b + f) ** 2 + (c + g) ** 2 + (d + h) ** 2)
    angle = 2.0 * math.atan2(apart, together)  # half of that between the orientations
    sine = math.sin(angle)
    if sine <= 1e-9:
        return a, b, c, d
    speed = 2.0 * angle * rate / sine  # about the vector part of after * inverse(before)
    velocity[3] += speed * (d * e - h * a + b * g - c * f)
    velocity[4] += speed * (d * f - h * b + c * e - a * g)
    velocity[5] += speed * (d * g - h * c + a * f - b * e)
    first, second = math.sin((1.0 - share) * angle) / sine, math.sin(share * angle) / sine
    return (
        first * a + second * e,
        first * b + second * f,
        first * c + second * g,
        first * d + second * h,
    )
