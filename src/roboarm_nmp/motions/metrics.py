"""Metrics of a motion beside success: of an episode, or of a `JointTrajectory`.

    metrics = motion_metrics(trajectory, CollisionChecker(query.scene))
    metrics["duration"], metrics["ee_path_length"], metrics["min_clearance"]

Path lengths of the end effector and the duration are defined as in robometrics (Fishman and
Sundaralingam, 2023: `eef_position_path_length`, `eef_orientation_path_length`, `motion_time`) and,
in Motion Policy Networks (Fishman et al., CoRL 2022), whose smoothness is SPARC (Balasubramanian et
al., Journal of NeuroEngineering and Rehabilitation 12(112), 2015). Planning time (`solve_time`
there) is the caller's to measure; `evaluation.evaluate` has it as `planning_seconds`.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from roboarm_nmp.motions.trajectories import STEP_SECONDS, JointTrajectory, Trajectory

if TYPE_CHECKING:
    from roboarm_nmp.envs.collision.checker import CollisionChecker

# Of SPARC, as in its publication.
PADDING = 4  # zeros after the speeds, so many powers of 2
MAX_FREQUENCY = 10.0  # Hz
THRESHOLD = 0.05  # share of the largest amplitude; weaker frequencies at the end do not count


def motion_metrics(
    trajectory: JointTrajectory | Trajectory,
    checker: "CollisionChecker | Sequence[CollisionChecker] | None" = None,
) -> dict[str, float | None]:
    """Compute the metrics of a motion.

    Args:
        trajectory: a `JointTrajectory`, or an episode, a `Trajectory`, with
            `STEP_SECONDS` between its configurations.
        checker: a `CollisionChecker` of the scene, for `min_clearance`; of an episode with moving
            obstacles a list of them, one for each configuration.

    Returns:
        - `duration`: s;
        - `path_length`: rad, the sum of the L2 distances between configurations;
        - `ee_path_length`: m, likewise of the end effector's positions;
        - `ee_rotation`: degrees, likewise of its angles of rotation;
        - `mean_jerk`: rad/s^3, mean over time of the jerk's L2 norm;
        - `max_jerk`: rad/s^3, the largest of any joint;
        - `sparc`, `ee_sparc`: spectral arc length of the joints' and of the end effector's speed,
          at most 0; nearer to 0 is smoother;
        - `min_clearance`: m, the smallest signed distance of a link from the scene; None without a
          checker.
    """
    robot = trajectory.robot
    configurations = trajectory.configurations
    if isinstance(trajectory, JointTrajectory):
        times = trajectory.times
        duration = trajectory.duration
        even = trajectory.at(np.linspace(times[0], times[-1], len(times)))  # equal intervals
    else:
        duration = len(trajectory) * STEP_SECONDS
        even = configurations
    interval = duration / max(len(even) - 1, 1)
    if isinstance(trajectory, JointTrajectory) and trajectory.accelerations is not None:
        jerk = np.diff(trajectory.accelerations, axis=0) / np.diff(trajectory.times)[:, None]
    else:
        jerk = np.diff(even, n=3, axis=0) / max(interval, 1e-9) ** 3
    positions, rotations = robot.frame_poses(configurations)[robot.end_effector_frame]
    positions = positions + rotations @ np.array(robot.end_effector_position)
    traces = np.einsum("tij,tij->t", rotations[1:], rotations[:-1])
    angles = np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0))
    clearance = None
    if checker is not None:
        states = np.clip(robot.normalise(configurations), -1.0, 1.0)
        if isinstance(checker, Sequence):
            pairs = zip(checker, states, strict=True)
            clearance = min(_clearance(at_state, state) for at_state, state in pairs)
        else:
            clearance = _clearance(checker, states)
    return {
        "duration": float(duration),
        "path_length": path_length(configurations),
        "ee_path_length": path_length(positions),
        "ee_rotation": float(np.degrees(angles.sum())),
        "mean_jerk": float(np.linalg.norm(jerk, axis=1).mean()) if len(jerk) else 0.0,
        "max_jerk": float(np.abs(jerk).max(initial=0.0)),
        "sparc": sparc(speeds(even), interval),
        "ee_sparc": sparc(speeds(robot.forward_kinematics(even)), interval),
        "min_clearance": clearance,
    }


def _clearance(checker, states):
    """The smallest signed distance of a link from the scene, m."""
    return float(checker.signed_distances(states, self_collisions=False).distance.min())


def path_length(points: np.ndarray) -> float:
    """Sum of the L2 distances between successive points (m, n), for example configurations, rad."""
    return float(speeds(points).sum())


def speeds(points: np.ndarray) -> np.ndarray:
    """L2 distances (m - 1,) between successive points (m, n)."""
    return np.linalg.norm(np.diff(points, axis=0), axis=1)


def smoothness(configurations: np.ndarray) -> float:
    """Mean L2 norm of the second differences, rad per step^2, of configurations (T + 1, n), rad.

    Zero for fewer than three configurations.
    """
    if len(configurations) < 3:
        return 0.0
    return float(np.linalg.norm(np.diff(configurations, n=2, axis=0), axis=1).mean())


def sparc(speed: np.ndarray, interval: float) -> float:
    """Spectral arc length of speeds (m,) at equal intervals (s); 0 where there is no motion."""
    if len(speed) == 0 or np.allclose(speed, 0.0):
        return 0.0
    size = 2 ** (int(np.ceil(np.log2(len(speed)))) + PADDING)
    spectrum = np.abs(np.fft.rfft(speed, size))
    frequency = np.arange(len(spectrum)) / (size * interval)
    amplitude = (spectrum / spectrum.max())[frequency <= MAX_FREQUENCY]
    counted = np.flatnonzero(amplitude >= THRESHOLD)
    if len(counted) < 2:
        return 0.0
    amplitude = amplitude[: counted[-1] + 1]
    return -float(np.hypot(1 / (len(amplitude) - 1), np.diff(amplitude)).sum())
