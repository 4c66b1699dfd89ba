"""Metrics of motions equal values worked out by hand."""

import numpy as np
import pytest

import roboarm_nmp
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Scene, Sphere
from roboarm_nmp.motions.metrics import motion_metrics, sparc
from roboarm_nmp.motions.trajectories import JointTrajectory, Trajectory

REST = np.array([0.0, -0.5, 0.0, -1.5, 0.0, 1.0, 0.8])


def turn_of_joint_1(angles):
    configurations = np.repeat(REST[None], len(angles), axis=0)
    configurations[:, 0] = angles
    return configurations


def test_turn_of_the_first_joint_moves_the_end_effector_on_a_circle():
    times = np.linspace(0.0, 2.0, 201)
    turns = turn_of_joint_1(0.25 * times)
    accelerations = np.zeros_like(turns)
    accelerations[::2, 0] = 0.5  # jerks of 50 rad/s^3
    trajectory = JointTrajectory(times, turns, None, accelerations, PANDA)
    position = PANDA.forward_kinematics(REST)
    scene = Scene((Sphere((0.0, 0.0, 2.0), 0.1),), table=None, floor=None)
    metrics = motion_metrics(trajectory, CollisionChecker(scene))
    assert metrics["duration"] == 2.0
    assert metrics["path_length"] == pytest.approx(0.5)
    assert metrics["ee_path_length"] == pytest.approx(0.5 * np.hypot(*position[:2]), rel=1e-4)
    assert metrics["ee_rotation"] == pytest.approx(np.degrees(0.5), rel=1e-4)
    assert metrics["mean_jerk"] == pytest.approx(50) and metrics["max_jerk"] == pytest.approx(50)
    state = PANDA.normalise(REST)
    lowest = CollisionChecker(scene).signed_distances(state, self_collisions=False).distance.min()
    assert metrics["min_clearance"] == pytest.approx(lowest, abs=0.05) and lowest > 0
    assert motion_metrics(trajectory)["min_clearance"] is None


def test_metrics_of_an_episode_are_those_at_30_configurations_a_second():
    seconds = np.arange(61) / 30
    states = PANDA.normalise(turn_of_joint_1(0.1 * seconds**3))  # a jerk of 0.6 rad/s^3
    empty = np.zeros((60, 7)), np.zeros(60, dtype=bool), np.zeros(60)
    metrics = motion_metrics(Trajectory(states, *empty, success=True))
    assert metrics["duration"] == pytest.approx(2.0)
    assert metrics["path_length"] == pytest.approx(0.8)
    assert metrics["mean_jerk"] == pytest.approx(0.6, rel=1e-6)
    assert metrics["max_jerk"] == pytest.approx(0.6, rel=1e-6)
    standing = Trajectory(states[:1], *(array[:0] for array in empty), success=True)
    assert set(motion_metrics(standing).values()) == {0.0, None}


def test_sparc_is_that_of_its_publication():
    times = np.arange(-1, 1, 0.01)
    # The example in the code of Balasubramanian et al.
    assert sparc(np.exp(-5 * times**2), 0.01) == pytest.approx(-1.41403, abs=1e-5)
    jerky = np.exp(-5 * times**2) * (1 + np.sin(40 * times))
    assert sparc(jerky, 0.01) < -1.6 and sparc(np.zeros(5), 0.01) == 0.0


def test_evaluation_reports_the_metrics_of_its_episodes():
    options = {"goal_type": "config", "num_queries": 3}
    result = roboarm_nmp.evaluate("go-to-goal", "no_obstacles", measure_clearance=True, **options)
    assert result["duration"] == pytest.approx(result["mean_steps"] / 30)
    assert 0 < result["ee_path_length"] < 5 and result["sparc"] < -1 and result["ee_sparc"] < -1
    assert result["max_jerk"] > result["mean_jerk"] / np.sqrt(7) > 0
    assert result["ee_rotation"] > 0 and result["min_clearance"] is not None
    without = roboarm_nmp.evaluate("go-to-goal", "no_obstacles", **options)
    assert without["min_clearance"] is None
    assert without["ee_path_length"] == result["ee_path_length"]
