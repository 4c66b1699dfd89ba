"""Trajectories keep their limits at every time, stay near their path, and avoid collisions."""

import sys

import numpy as np
import pytest

from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Scene, Sphere
from roboarm_nmp.motions import retime
from roboarm_nmp.motions.time_parameterisation import time_parameterise
from roboarm_nmp.motions.trajectories import load_trajectory, save_joint_path
from roboarm_nmp.utils.signals import error_line

START = np.array([0.0, -0.5, 0.0, -1.5, 0.0, 1.0, 0.8])
LIMITS = (PANDA.velocity, PANDA.acceleration, PANDA.jerk)


def random_paths(number=4):
    rng = np.random.default_rng(0)
    for _ in range(number):
        yield rng.uniform(PANDA.lower, PANDA.upper, (rng.integers(2, 8), 7))


def moved(**joints):
    """`START` with other angles (rad): q1=0.5."""
    configuration = START.copy()
    for joint, angle in joints.items():
        configuration[int(joint[1:]) - 1] = angle
    return configuration


def derivatives(trajectory, step=0.0005):
    """Velocities, accelerations and jerks (rad) by differences, at any times, of the cubics."""
    times = np.arange(0, trajectory.duration, step)
    positions = trajectory.at(times)
    return [np.diff(positions, order, axis=0) / step**order for order in (1, 2)]


def distances(points, path):
    """L2 distance of each point from a path."""
    starts, moves = path[:-1], np.diff(path, axis=0)
    share = np.einsum("mkn,kn->mk", points[:, None] - starts, moves) / (moves**2).sum(1)
    nearest = starts + np.clip(share, 0, 1)[..., None] * moves
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(1)


@pytest.mark.parametrize("step", [0.004, 0.03])
def test_limits_hold_at_and_between_samples(step):
    for path in random_paths():
        trajectory = time_parameterise(path, PANDA, step=step)
        jerks = np.diff(trajectory.accelerations, axis=0) / step
        values = trajectory.velocities, trajectory.accelerations, jerks
        for found, limit in zip(values, LIMITS, strict=True):
            assert (np.abs(found) <= limit * (1 + 1e-9)).all()
        for found, limit in zip(derivatives(trajectory), LIMITS[:2], strict=True):
            assert (np.abs(found) <= limit * (1 + 1e-5)).all()
        assert (trajectory.positions >= PANDA.lower).all()
        assert (trajectory.positions <= PANDA.upper).all()
        np.testing.assert_array_equal(trajectory.positions[[0, -1]], path[[0, -1]])  # at rest
        assert not trajectory.velocities[[0, -1]].any()
        assert np.abs(trajectory.velocities / PANDA.velocity).max() > 0.9  # and it is not slow


def test_velocities_and_accelerations_are_those_of_the_positions():
    trajectory = time_parameterise(next(random_paths()), PANDA)
    velocities, accelerations = derivatives(trajectory)
    middle = (trajectory.velocities[1:] + trajectory.velocities[:-1]) / 2  # of half samples
    found = velocities[np.round(trajectory.times[:-1] / 0.0005).astype(int) + 10]
    np.testing.assert_allclose(found, middle, atol=0.05)
    found = accelerations[np.round(trajectory.times[:-2] / 0.0005).astype(int) + 19]
    np.testing.assert_allclose(found, trajectory.accelerations[1:-1], atol=1.0)


def test_straight_motion_takes_the_time_worked_out_by_hand():
    path = np.array([START, moved(q1=1.5)])
    v, a = PANDA.velocity[0], PANDA.acceleration[0]
    optimum = 1.5 / v + v / a
    trajectory = time_parameterise(path, PANDA)
    assert optimum <= trajectory.duration <= optimum + 0.04
    slow = time_parameterise(path, PANDA, velocity=0.5, acceleration=1.0)
    assert 3.5 <= slow.duration <= 3.54  # 1.5 / 0.5 + 0.5 / 1


def test_jerk_of_a_low_limit_is_kept():
    path = np.array([START, moved(q1=1.0, q2=0.0), moved(q1=0.5, q2=0.8)])
    trajectory = time_parameterise(path, PANDA, jerk=20.0)
    assert np.abs(np.diff(trajectory.accelerations, axis=0) / 0.01).max() <= 20 * (1 + 1e-9)
    np.testing.assert_array_equal(trajectory.positions[-1], path[-1])


@pytest.mark.parametrize("deviation", [0.0, 0.3])
def test_corners_are_rounded_by_the_deviation_at_most(deviation):
    for path in random_paths(2):
        trajectory = time_parameterise(path, PANDA, deviation=deviation)
        found = distances(trajectory.positions, path).max()
        assert found <= deviation + 2e-4
        assert deviation == 0.0 or found > 0.3 * deviation


@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-3])
def test_dense_waypoints_and_noise_do_not_slow_the_arm_down(noise):
    ends = np.array([START, moved(q1=1.0), moved(q1=1.0, q2=0.5)])
    dense = np.concatenate([np.linspace(a, b, 1500) for a, b in zip(ends, ends[1:], strict=False)])
    dense += noise * np.random.default_rng(0).normal(size=dense.shape)
    sparse, dense = (time_parameterise(path, PANDA) for path in (ends, dense))
    assert dense.duration == pytest.approx(sparse.duration, rel=0.02)
    assert distances(dense.positions, ends).max() < 0.1


def test_waypoints_near_the_lines_between_others_stay_where_these_collide():
    path = np.array([START, moved(q1=0.5, q4=-1.491), moved(q1=1.0)])
    x, y, z = PANDA.forward_kinematics(moved(q1=0.5))
    scene = Scene((Sphere((x, y, z - 0.012), 0.005),), table=None, floor=None)
    trajectory = time_parameterise(path, PANDA, checker=CollisionChecker(scene))
    assert distances(path[1:2], trajectory.positions).max() < 3e-3
    with pytest.raises(ValueError, match="the path itself collides"):
        time_parameterise(path[[0, 2]], PANDA, checker=CollisionChecker(scene))


@pytest.mark.parametrize("scale", [1e-7, 1e-2])
def test_tiny_and_repeated_motions_are_possible(scale):
    rng = np.random.default_rng(1)
    path = START + scale * np.cumsum(rng.normal(size=(30, 7)), axis=0)
    path = np.repeat(path, 2, axis=0)
    trajectory = time_parameterise(path, PANDA)
    assert (np.abs(trajectory.accelerations) <= PANDA.acceleration * (1 + 1e-9)).all()
    rest = time_parameterise(path[:1], PANDA)
    assert len(rest) == 2 and (rest.positions == path[0]).all()


def test_corner_whose_rounding_collides_is_rounded_less():
    path = np.array([START, moved(q1=1.0), moved(q1=1.0, q2=0.6)])
    scene = Scene((Sphere((0.283, 0.234, 0.819), 0.02),), table=None, floor=None)
    checker, ends = CollisionChecker(scene), PANDA.normalise(path)
    free = time_parameterise(path, PANDA, deviation=0.3)
    assert checker.is_motion_free(ends[:-1], ends[1:], resolution=0.002).all()
    assert not checker.is_free(PANDA.normalise(free.positions)).all()
    trajectory = time_parameterise(path, PANDA, deviation=0.3, checker=checker)
    fine = trajectory.at(np.arange(0, trajectory.duration, 0.001))
    assert checker.is_free(PANDA.normalise(fine)).all()
    stop = time_parameterise(path, PANDA, deviation=0.0)
    assert free.duration < trajectory.duration < stop.duration
    again = time_parameterise(path, PANDA, deviation=0.3, checker=checker)
    np.testing.assert_array_equal(trajectory.positions, again.positions)


def test_path_outside_the_datasheet_limits_is_rejected_only_for_them():
    path = np.array([START, moved(q4=-0.05)])  # the datasheet allows -0.0698, the URDF 0
    assert time_parameterise(path, PANDA).positions[-1, 3] == -0.05
    message = "waypoint 1 .* outside the datasheet position limits: panda_joint4 is -0.0500"
    with pytest.raises(ValueError, match=message):
        time_parameterise(path, PANDA, limits="datasheet")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"path": START}, r"a path has shape \(k, 7\)"),
        ({"path": [moved(q4=0.5)]}, "outside the urdf position limits"),
        ({"velocity": 0.0}, "velocity must be positive"),
        ({"velocity": 1e-9}, "more than 1,000,000 samples"),
    ],
)
def test_arguments_that_cannot_be_used_are_named(arguments, message):
    path = arguments.pop("path", [START, moved(q1=1.0)])
    with pytest.raises(ValueError, match=message):
        time_parameterise(path, PANDA, **arguments)


def test_command_writes_a_trajectory_that_is_checked_in_a_scene(tmp_path, capsys):
    path = np.array([START, moved(q1=0.3), moved(q1=0.3, q4=-2.0)])
    save_joint_path(tmp_path / "path.csv", path, [0.0, 1.0, 2.0])
    source, output = str(tmp_path / "path.csv"), str(tmp_path / "motion.yaml")
    task = ["--task", "no_obstacles", "--velocity-scale", "0.5"]
    assert retime.main([source, "--output", output, *task]) == 0
    assert "motion.yaml: written" in capsys.readouterr().out
    trajectory = load_trajectory(output, PANDA)
    assert np.abs(trajectory.velocities / PANDA.velocity).max() <= 0.5 * (1 + 1e-9)
    np.testing.assert_array_equal(trajectory.positions[[0, -1]], path[[0, -1]])


def test_command_names_the_file_and_the_reason_in_one_line(tmp_path, capsys, monkeypatch):
    path, output = tmp_path / "path.csv", tmp_path / "motion.csv"
    save_joint_path(path, np.array([START, moved(q4=-0.05)]), [0.0, 1.0])
    arguments = [str(path), "--output", str(output)]
    assert retime.main([*arguments, "--limits", "datasheet"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(error_line(f"{path}: waypoint 1")) and error.count("\n") == 1
    assert retime.main([*arguments, "--task", "moving_boxes_easy"]) == 2
    assert "--task: obstacles of moving_boxes_easy move" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "toppra", None)  # not installed
    assert retime.main(arguments) == 1
    assert "pip install 'roboarm-nmp[trajectories]'" in capsys.readouterr().err
    assert not output.exists()
