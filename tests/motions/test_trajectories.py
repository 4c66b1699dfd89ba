"""Files of joint paths: they are read as they were written; bad files are named."""

import csv

import numpy as np
import pytest

from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.motions.trajectories import (
    STEP_SECONDS,
    JointTrajectory,
    Trajectory,
    load_joint_path,
    load_trajectory,
    save_joint_path,
    save_trajectory,
    timed,
)

PATH = np.array([[0, -0.3, 0, -1.8, 0, 1.6, 0], [0.5, -0.3, 0, -1.8, 0, 1.6, 0.1]])
Q = ",".join(f"q{i}" for i in range(1, 8))


FORMATS = ["a.csv", "a.npz", "a.json", "a.yaml"]
TIMES = np.array([0, 10_000_000, 1_070_000_000]) / 1e9


def random_trajectory():
    rng = np.random.default_rng(0)
    positions = np.array(PANDA.contact_free) + rng.normal(size=(3, 7)) * [[1e-6], [1e-1], [1]] * 0.1
    velocities, accelerations = rng.normal(size=(2, 3, 7)) * [[1e-20], [1.0], [1e3]]
    return JointTrajectory(TIMES, positions, velocities, accelerations, PANDA)


@pytest.mark.parametrize("name", FORMATS)
def test_joint_trajectory_is_read_exactly_as_it_was_written(name, tmp_path):
    written = random_trajectory()
    save_trajectory(tmp_path / name, written)
    read = load_trajectory(tmp_path / name, PANDA)
    for field in ("times", "positions", "velocities", "accelerations"):
        np.testing.assert_array_equal(getattr(read, field), getattr(written, field))
    assert read.robot == PANDA and read.duration == 1.07


ROS1 = """
header: {seq: 0, stamp: {secs: 0, nsecs: 0}, frame_id: ''}
joint_names: [panda_joint7, panda_joint6, panda_joint5, panda_joint4, panda_joint3, panda_joint2,
  panda_joint1]
points:
- positions: [0.7, 1.6, 0.5, -1.8, 0.3, 0.2, 0.1]
  velocities: []
  accelerations: []
  effort: []
  time_from_start: {secs: 1, nsecs: 500000000}
"""


def test_joints_of_a_ros_message_are_read_in_any_order(tmp_path):
    (tmp_path / "a.yaml").write_text(ROS1)
    read = load_trajectory(tmp_path / "a.yaml", PANDA)
    assert read.times.tolist() == [1.5] and read.velocities is None
    assert read.positions.tolist() == [[0.1, 0.2, 0.3, -1.8, 0.5, 1.6, 0.7]]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", "a: [", "line 2: .*did not find expected"),
        ("a.yaml", "!!python/object/apply:os.system ['touch made']", "tags"),
        ("a.yaml", ROS1.replace("panda_joint7", "iiwa_joint7"), "its joints are .*iiwa_joint7"),
        ("a.yaml", ROS1.replace("-1.8", "-90.0"), "q4 exceeds its limits"),
        ("a.json", "{", "not a joint path"),
    ],
)
def test_bad_text_file_is_named_with_the_reason(name, text, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(DatasetError, match=f"^.*{name}: .*{message}") as caught:
        load_trajectory(tmp_path / name, PANDA)
    assert "\n" not in str(caught.value) and not (tmp_path / "made").exists()


def test_positions_between_samples_are_those_of_cubic_polynomials():
    times = np.array([0.0, 0.5, 2.0])
    polynomial = np.polynomial.Polynomial([0.1, -0.4, 0.3, 0.05])
    rows = [f(times)[:, None] * np.ones(7) for f in (polynomial, polynomial.deriv())]
    trajectory = JointTrajectory(times, *rows, None, PANDA)
    between = np.linspace(0, 2, 17)
    np.testing.assert_allclose(trajectory.at(between)[:, 3], polynomial(between), atol=1e-12)
    np.testing.assert_allclose(trajectory.at([-1.0, 5.0]), rows[0][[0, 2]])
    straight = JointTrajectory(times, rows[0], None, None, PANDA)
    np.testing.assert_allclose(straight.at([0.25])[0], rows[0][:2].mean(0))
    assert len(trajectory.frames()) == 61


@pytest.mark.parametrize("name", ["a.CSV", "a.npz", "a.json", "a.yaml"])
def test_joint_path_is_read_as_it_was_written(name, tmp_path):
    save_joint_path(tmp_path / name, PATH, [0.5, 2.0])
    times, configurations = load_joint_path(tmp_path / name, PANDA)
    assert times.tolist() == [0.5, 2.0]
    np.testing.assert_array_equal(configurations, PATH)


def test_file_of_an_episode_has_its_states_actions_contacts_and_times(tmp_path):
    states = PANDA.normalise(PATH).astype(np.float32)
    action = np.linspace(-0.01, 0.02, 7)[None]
    episode = Trajectory(states, action, np.array([True]), np.array([0.25]), success=False)
    for name in ("a.csv", "a.npz"):
        save_trajectory(tmp_path / name, episode)
        times, configurations = load_joint_path(tmp_path / name, PANDA)
        np.testing.assert_allclose(times, [0, 1 / 30])
        np.testing.assert_allclose(configurations, PATH, atol=1e-6)
    with np.load(tmp_path / "a.npz") as file:
        np.testing.assert_array_equal(file["states"], states)
        np.testing.assert_array_equal(file["actions"], action)
        assert file["contacts"].tolist() == [True] and not file["success"]
    with open(tmp_path / "a.csv", newline="") as file:
        first, last = csv.DictReader(file)
    names = [*("time", *Q.split(",")), *(f"action{i}" for i in range(1, 8))]
    assert list(first) == [*names, "contact", "policy_seconds"]
    np.testing.assert_array_equal([float(first[f"action{i}"]) for i in range(1, 8)], action[0])
    assert first["contact"] == "1" and first["policy_seconds"] == "0.25"
    assert last["contact"] == last["action1"] == last["policy_seconds"] == ""


def test_waypoints_without_times_are_passed_at_the_speed_of_the_environment(tmp_path):
    np.savez(tmp_path / "a.npz", configurations=PATH.astype(np.float32))
    times, configurations = load_joint_path(tmp_path / "a.npz", PANDA)
    steps = np.linalg.norm(np.diff(PANDA.normalise(configurations), axis=0), axis=1)
    assert steps.max() <= 0.03 < 2 * steps.min()
    np.testing.assert_allclose(times, np.arange(len(steps) + 1) * STEP_SECONDS)
    np.testing.assert_allclose(configurations[[0, -1]], PATH, atol=1e-6)
    for one, other in zip(timed(PATH, PANDA), (times, configurations), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,q1,q2\n0,1,2\n", "no column q3; the header names q1 to q7, rad"),
        (f"{Q}\n0,0,0,-1,0,1,x\n", "line 2: not a number"),
        (f"{Q}\n0,0,0,-90,0,90,0\n", "q4 exceeds its limits by 86.86 rad .are the angles in rad"),
    ],
)
def test_bad_csv_file_is_named_with_the_reason(text, message, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DatasetError, match=f"a.csv: .*{message}"):
        load_joint_path(tmp_path / "a.csv", PANDA)


def test_bad_npz_file_is_named_with_the_reason(tmp_path):
    path = tmp_path / "a.npz"
    for arrays, message in (
        ({"configurations": PATH[:, :6]}, "must be .n, 7., are .2, 6."),
        ({"configurations": np.array([[object()] * 7])}, "not a joint path"),
    ):
        np.savez(path, **arrays)
        with pytest.raises(DatasetError, match=f"a.npz: .*{message}"):
            load_joint_path(path, PANDA)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DatasetError, match="a.npz: not a joint path"):
        load_joint_path(path, PANDA)
