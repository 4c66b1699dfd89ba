"""Inverse kinematics: configurations of an arm whose end effector has a pose.

    from roboarm_nmp.envs.robots.inverse_kinematics import inverse_kinematics

    pose = PANDA.end_effector_pose(configuration)            # position and quaternion, 7 numbers
    inverse_kinematics(PANDA, pose, checker=checker, near=start)     # (k, n), rad, nearest first

Levenberg-Marquardt steps, damped by the squared error (Sugihara, 2011), from many random states.
Libraries lack what is needed here: analytical solvers (EAIK, IK-Geo) do not know the Panda's
wrist, and those with iterations (Robotics Toolbox, TRAC-IK) return one solution, and do not know
joints that mimic another one. Speed and success: docs/benchmark/performance.md.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from roboarm_nmp.envs.robots.kernels import CHAIN_COLUMNS, POSITION, ROTATION, solve_batch
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.rotations import matrix

MAX_DISTANCE, MAX_ANGLE = 1e-4, 1e-3
"""m and rad: errors of a solution are at most these."""
NUM_SEEDS = 32
ITERATIONS = 50
# Iterations stop at this share of the allowed errors, so that float32 angles satisfy them, too.
_STOP = 0.1
# Solutions nearer to each other (L2, normalised) are the same one.
_SAME = 1e-2


def inverse_kinematics(
    robot: Robot,
    pose: ArrayLike,
    seed: int | Sequence[int] = 0,
    num_seeds: int = NUM_SEEDS,
    checker=None,
    margin: float = 0.0,
    near: ArrayLike | None = None,
) -> np.ndarray | list[np.ndarray]:
    """Configurations whose end effector has a pose, within `MAX_DISTANCE` and `MAX_ANGLE`.

    They are inside the joint limits, and at least 0.01 apart (L2, normalised). Arms with more than
    six joints reach most poses in infinitely many ways, of which these are a sample.

    Args:
        robot: a `Robot` with n joints.
        pose: position (m) and quaternion (xyzw) of the end effector in the world, (7,), or a batch
            of them, (m, 7). What the end effector is: `Robot.end_effector_pose`.
        seed: of the random states where the searches begin; int or sequence of ints.
        num_seeds: searches, >= 1. Not all of them find a solution. The first begins at `near`.
        checker: an `envs.collision.checker.CollisionChecker`; solutions are then free.
        margin: m, that they keep from the checker's scene and between the links.
        near: joint angles (n,) or (m, n), rad: solutions are sorted by their normalised distance
            from these; by default from the middle of the limits.

    Returns:
        float64 (k, n), rad, k >= 0; for a batch, a list of m such arrays. A pose's solutions do not
        depend on the batch around it.

    Raises:
        ValueError: `pose` or `near` has another shape or is not finite, a quaternion is zero, or
            `num_seeds` is not positive.
    """
    poses, joints = np.asarray(pose, dtype=np.float64), robot.num_joints
    if poses.ndim not in (1, 2) or poses.shape[-1] != 7:
        raise ValueError(f"a pose is 7 numbers, position and quaternion, got shape {poses.shape}")
    is_single = poses.ndim == 1
    poses = poses.reshape(-1, 7)
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    if not np.isfinite(poses).all() or not (norms > 1e-6).all():
        raise ValueError(f"a pose must be finite, with a quaternion that is not zero, got {pose}")
    if not num_seeds >= 1:
        raise ValueError(f"num_seeds must be at least 1, got {num_seeds!r}")
    states = np.zeros((len(poses), int(num_seeds), joints))
    states[:, 1:] = np.random.default_rng(seed).uniform(-1.0, 1.0, states.shape[1:])[1:]
    if near is not None:
        near = np.asarray(near, dtype=np.float64)
        if near.shape[-1:] != (joints,) or not np.isfinite(near).all():
            raise ValueError(f"near must be {joints} finite numbers, got {near}")
        states[:, 0] = np.clip(robot.normalise(near), -1.0, 1.0)
    origins = states[:, 0].copy()
    rotations = [matrix(quaternion) for quaternion in poses[:, 3:] / norms[:, None]]
    targets = np.hstack([poses[:, :3], np.reshape(rotations, (-1, 9))])
    solved = np.empty(states.shape[:2], dtype=np.bool_)
    solve_batch(
        states,
        kinematic_chain(robot),
        targets,
        _STOP * MAX_DISTANCE,
        _STOP * MAX_ANGLE,
        ITERATIONS,
        solved,
    )
    solutions = []
    for is_solved, of_pose, origin in zip(solved, states, origins, strict=True):
        of_pose = of_pose[is_solved]
        if checker is not None and len(of_pose):
            of_pose = of_pose[checker.is_free(of_pose, margin=margin)]
        order = np.argsort(np.linalg.norm(of_pose - origin, axis=1), kind="stable")
        solutions.append(robot.denormalise(_distinct(of_pose[order])))
    return solutions[0] if is_single else solutions


def _distinct(states):
    """The states (k, n) that are not near an earlier one."""
    distinct = []
    for state in states:
        if all(np.linalg.norm(state - other) > _SAME for other in distinct):
            distinct.append(state)
    return np.reshape(distinct, (-1, states.shape[1]))


def kinematic_chain(robot: Robot) -> np.ndarray:
    """The frames between base and end effector, as `kernels` has them."""
    frames, index = [], robot.end_effector_frame
    while index >= 0:
        frames.append(robot.frames[index])
        index = frames[-1].parent
    frames.reverse()
    middle, half = (robot.upper + robot.lower) / 2, (robot.upper - robot.lower) / 2
    chain = np.zeros((len(frames) + 2, CHAIN_COLUMNS))
    chain[(0, -1), 0] = -1.0  # base and end effector do not move
    chain[0, POSITION:ROTATION] = robot.base_position
    chain[0, ROTATION:] = matrix(robot.base_orientation).ravel()
    for row, frame in zip(chain[1:-1], frames, strict=True):
        joint, scale = frame.joint, frame.multiplier
        value = scale * middle[joint] + frame.offset
        row[:POSITION] = joint, frame.is_prismatic, value, scale * half[joint]
        row[POSITION:ROTATION] = frame.position
        row[ROTATION:] = frame.rotation
    chain[-1, POSITION:ROTATION] = robot.end_effector_position
    chain[-1, ROTATION:] = robot.end_effector_rotation.ravel()
    return chain
