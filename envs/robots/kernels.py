"""What Numba compiles of inverse kinematics: Levenberg-Marquardt in the box of the joint limits.

States are normalised configurations. `chain`: float64 (f, `CHAIN_COLUMNS`), the base, the frames
from there to the end effector, in this order, and the end effector in the last of them. No joint
moves the first and the last row (joint -1). Columns: joint, whether it is prismatic, the joint's
value at 0 and its change per unit of state, position 3 and rotation 9 (row-major) in the frame
before.
"""

import math

import numpy as np

from roboarm_nmp.utils.numba_cache import compiled

JOINT, PRISMATIC, MIDDLE, SCALE, POSITION, ROTATION, CHAIN_COLUMNS = 0, 1, 2, 3, 4, 7, 16
# An error of 1 rad counts like one of this many metres, about the size of a hand.
METRES_PER_RADIAN = 0.3
# Damping: this share of the squared error, and a constant (Sugihara, 2011).
DAMPING_SHARE, LEAST_DAMPING = 0.3, 1e-8
# A search is given up after so many iterations without an error below this share of the best one.
STALLED, STALLED_SHARE = 8, 0.9


@compiled
def _place(state, chain, rotation, joints):
    """Write the end effector's rotation (9,); per row of `chain`, axis 3 and origin 3 (f, 6).

    Returns the position.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    px, py, pz = 0.0, 0.0, 0.0
    for k in range(chain.shape[0]):
        row = chain[k]
        x, y, z = row[POSITION], row[POSITION + 1], row[POSITION + 2]
        px += r00 * x + r01 * y + r02 * z
        py += r10 * x + r11 * y + r12 * z
        pz += r20 * x + r21 * y + r22 * z
        a, b, c = row[ROTATION], row[ROTATION + 1], row[ROTATION + 2]
        d, e, f = row[ROTATION + 3], row[ROTATION + 4], row[ROTATION + 5]
        g, h, i = row[ROTATION + 6], row[ROTATION + 7], row[ROTATION + 8]
        t00 = r00 * a + r01 * d + r02 * g
        t01 = r00 * b + r01 * e + r02 * h
        t02 = r00 * c + r01 * f + r02 * i
        t10 = r10 * a + r11 * d + r12 * g
        t11 = r10 * b + r11 * e + r12 * h
        t12 = r10 * c + r11 * f + r12 * i
        t20 = r20 * a + r21 * d + r22 * g
        t21 = r20 * b + r21 * e + r22 * h
        t22 = r20 * c + r21 * f + r22 * i
        joint, cosine, sine = int(row[JOINT]), 1.0, 0.0
        if joint >= 0:
            value = row[MIDDLE] + row[SCALE] * state[joint]
            if row[PRISMATIC] == 0.0:
                cosine, sine = math.cos(value), math.sin(value)
            else:
                px, py, pz = px + value * t02, py + value * t12, pz + value * t22
        joints[k, 0], joints[k, 1], joints[k, 2] = t02, t12, t22
        joints[k, 3], joints[k, 4], joints[k, 5] = px, py, pz
        r00, r01, r02 = cosine * t00 + sine * t01, cosine * t01 - sine * t00, t02
        r10, r11, r12 = cosine * t10 + sine * t11, cosine * t11 - sine * t10, t12
        r20, r21, r22 = cosine * t20 + sine * t21, cosine * t21 - sine * t20, t22
    rotation[0], rotation[1], rotation[2] = r00, r01, r02
    rotation[3], rotation[4], rotation[5] = r10, r11, r12
    rotation[6], rotation[7], rotation[8] = r20, r21, r22
    return px, py, pz


@compiled
def _error(state, chain, target, rotation, joints, error):
    """Write the error (6,), m and rad * `METRES_PER_RADIAN`; returns its parts in m and rad.

    `target`: position 3 and rotation 9. The angles are a rotation vector in the world.
    """
    x, y, z = _place(state, chain, rotation, joints)
    error[0], error[1], error[2] = target[0] - x, target[1] - y, target[2] - z
    vx, vy, vz, trace = 0.0, 0.0, 0.0, -1.0
    for i in range(3):  # the rotation from here to the target is the sum of outer products
        a, b, c = rotation[i], rotation[3 + i], rotation[6 + i]
        d, e, f = target[3 + i], target[6 + i], target[9 + i]
        vx, vy, vz = vx + b * f - c * e, vy + c * d - a * f, vz + a * e - b * d
        trace += a * d + b * e + c * f
    sine = math.sqrt(vx * vx + vy * vy + vz * vz)
    angle, scale = math.atan2(sine, trace), METRES_PER_RADIAN
    if sine > 1e-9:
        scale *= angle / sine
    elif trace < 0.0:  # a half turn, about any axis: the next step is about a better one
        vx = math.pi
    error[3], error[4], error[5] = scale * vx, scale * vy, scale * vz
    return math.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2), angle


@compiled
def _jacobian(chain, joints, jacobian):
    """Write the derivative of the pose (6, n), in the error's units, by the state."""
    jacobian[:] = 0.0
    end = joints.shape[0] - 1
    for k in range(1, end):  # neither the base nor the end effector
        joint, scale = int(chain[k, JOINT]), chain[k, SCALE]
        x, y, z = joints[k, 0] * scale, joints[k, 1] * scale, joints[k, 2] * scale
        if chain[k, PRISMATIC] != 0.0:
            jacobian[0, joint] += x
            jacobian[1, joint] += y
            jacobian[2, joint] += z
            continue
        u, v = joints[end, 3] - joints[k, 3], joints[end, 4] - joints[k, 4]
        w = joints[end, 5] - joints[k, 5]
        jacobian[0, joint] += y * w - z * v
        jacobian[1, joint] += z * u - x * w
        jacobian[2, joint] += x * v - y * u
        jacobian[3, joint] += METRES_PER_RADIAN * x
        jacobian[4, joint] += METRES_PER_RADIAN * y
        jacobian[5, joint] += METRES_PER_RADIAN * z


@compiled
def _solve(matrix, vector):
    """Solve a symmetric positive definite system (6, 6) in place, by Cholesky's factors."""
    for i in range(6):
        for j in range(i):
            matrix[i, i] -= matrix[i, j] * matrix[i, j]
        matrix[i, i] = math.sqrt(matrix[i, i])
        for k in range(i + 1, 6):
            for j in range(i):
                matrix[k, i] -= matrix[k, j] * matrix[i, j]
            matrix[k, i] /= matrix[i, i]
    for i in range(6):
        for j in range(i):
            vector[i] -= matrix[i, j] * vector[j]
        vector[i] /= matrix[i, i]
    for i in range(5, -1, -1):
        for j in range(i + 1, 6):
            vector[i] -= matrix[j, i] * vector[j]
        vector[i] /= matrix[i, i]


@compiled
def _step(state, jacobian, error, damping, free, matrix, vector):
    """Move a state (n,) by a damped step, in the box [-1, 1]^n.

    A joint that a step would move beyond its limit is left out, and the step is computed again.
    """
    free[:] = True
    for _ in range(state.shape[0]):
        for i in range(6):
            vector[i] = error[i]
            for j in range(i + 1):
                total = damping if i == j else 0.0
                for k in range(state.shape[0]):
                    if free[k]:
                        total += jacobian[i, k] * jacobian[j, k]
                matrix[i, j] = total
        _solve(matrix, vector)
        blocked = False
        for k in range(state.shape[0]):
            if free[k]:
                change = 0.0
                for i in range(6):
                    change += jacobian[i, k] * vector[i]
                if (state[k] >= 1.0 and change > 0.0) or (state[k] <= -1.0 and change < 0.0):
                    free[k], blocked = False, True
        if not blocked:
            break
    for k in range(state.shape[0]):
        if free[k]:
            change = 0.0
            for i in range(6):
                change += jacobian[i, k] * vector[i]
            state[k] = min(max(state[k] + change, -1.0), 1.0)


@compiled
def solve_batch(states, chain, targets, max_distance, max_angle, iterations, solved):
    """Inverse kinematics from many states.

    Args:
        states: float64 (m, s, n), s states for each of m poses, which become the solutions.
        chain: see above.
        targets: float64 (m, 12): position and rotation.
        max_distance, max_angle: m and rad, of a solution's errors.
        iterations: at most, from one state.
        solved: bool (m, s), written.
    """
    rotation, joints = np.empty(9), np.empty((chain.shape[0], 6))
    error, jacobian = np.empty(6), np.empty((6, states.shape[2]))
    matrix, vector = np.empty((6, 6)), np.empty(6)
    free = np.empty(states.shape[2], dtype=np.bool_)
    for m in range(states.shape[0]):
        for s in range(states.shape[1]):
            state, best, since = states[m, s], np.inf, 0
            solved[m, s] = False
            for _ in range(iterations):
                distance, angle = _error(state, chain, targets[m], rotation, joints, error)
                if distance <= max_distance and angle <= max_angle:
                    solved[m, s] = True
                    break
                square = distance**2 + (METRES_PER_RADIAN * angle) ** 2
                since += 1
                if square < STALLED_SHARE * best:
                    best, since = square, 0
                elif since > STALLED:
                    break
                _jacobian(chain, joints, jacobian)
                damping = DAMPING_SHARE * square + LEAST_DAMPING
                _step(state, jacobian, error, damping, free, matrix, vector)


@compiled
def move_back(state, chain):
    """Move a state (n,) so that the end effector goes back along its axis z, and does not turn.

    By 1 mm, or less at joint limits and near singularities. Returns the position before.
    """
    rotation, joints = np.empty(9), np.empty((chain.shape[0], 6))
    error, jacobian = np.zeros(6), np.empty((6, state.shape[0]))
    position = _place(state, chain, rotation, joints)
    for i in range(3):
        error[i] = -0.001 * rotation[3 * i + 2]
    _jacobian(chain, joints, jacobian)
    free, matrix, vector = np.empty(state.shape[0], dtype=np.bool_), np.empty((6, 6)), np.empty(6)
    _step(state, jacobian, error, 1e-4, free, matrix, vector)
    return position
