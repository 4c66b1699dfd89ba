"""Files of joint paths: they are read as they were written; bad files are named."""

import csv

import numpy as np
import pytest

from roboarm_nmp.envs.datasets.format import DatasetError
from roboarm_nmp.envs.datasets.trajectories import (
    STEP_SECONDS,
    load_joint_path,
    save_joint_path,
    save_trajectory,
    timed,
)
from roboarm_nmp.envs.policies.rollout import Trajectory
from roboarm_nmp.envs.robots.panda import PANDA

PATH = np.array([[0, -0.3, 0, -1.8, 0, 1.6, 0], [0.5, -0.3, 0, -1.8, 0, 1.6, 0.1]])
Q = ",".join(f"q{i}" for i in range(1, 8))


@pytest.mark.parametrize("name", ["a.csv", "a.npz", "a.CSV"])
def test_joint_path_is_read_as_it_was_written(name, tmp_path):
    save_joint_path(tmp_path / name, PATH, [0.5, 2.0])
    times, configurations = load_joint_path(tmp_path / name, PANDA)
    assert times.tolist() == [0.5, 2.0]
    np.testing.assert_array_equal(configurations, PATH)


@pytest.mark.parametrize("name", ["a.csv", "a.npz"])
def test_file_of_an_episode_has_its_states_actions_contacts_and_times(name, tmp_path):
    states = PANDA.normalise(PATH).astype(np.float32)
    action = np.linspace(-0.01, 0.02, 7)[None]
    episode = Trajectory(states, action, np.array([True]), np.array([0.25]), success=False)
    save_trajectory(tmp_path / name, episode)
    times, configurations = load_joint_path(tmp_path / name, PANDA)
    np.testing.assert_allclose(times, [0, 1 / 30])
    np.testing.assert_allclose(configurations, PATH, atol=1e-6)
    if name == "a.npz":
        with np.load(tmp_path / name) as file:
            assert set(file) == {
                *("times", "configurations", "states", "actions", "contacts"),
                *("policy_seconds", "success"),
            }
            np.testing.assert_array_equal(file["states"], states)
            np.testing.assert_array_equal(file["actions"], action)
            assert file["contacts"].tolist() == [True] and not file["success"]
        return
    with open(tmp_path / name, newline="") as file:
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
        ("", "no column q1"),
        ("time,q1,q2\n0,1,2\n", "no column q3; the header names q1 to q7, rad"),
        (f"{Q}\n", "configurations must be"),
        (f"{Q}\n0,0,0,-1,0,1,x\n", "line 2: not a number"),
        (f"{Q}\n0,0,0,-1,0,1\n", "line 2: not a number"),
        (f"{Q}\n0,0,0,-1,0,1,nan\n", "not finite"),
        (f"{Q}\n0,0,0,-90,0,90,0\n", "q4 exceeds its limits by 86.86 rad .are the angles in rad"),
        (f"time,{Q}\n0,0,0,0,-1,0,1,0\n0,0,0,0,-1,0,1,0\n", "times do not increase"),
        (f"time,{Q}\ninf,0,0,0,-1,0,1,0\n", "one finite time per configuration"),
    ],
)
def test_bad_csv_file_is_named_with_the_reason(text, message, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DatasetError, match=f"a.csv: .*{message}"):
        load_joint_path(tmp_path / "a.csv", PANDA)


def test_bad_npz_file_is_named_with_the_reason(tmp_path):
    path = tmp_path / "a.npz"
    for arrays, message in (
        ({"path": PATH}, "no array configurations, but path"),
        ({"configurations": PATH[:, :6]}, "must be .n, 7., are .2, 6."),
        ({"configurations": PATH, "times": [0.0]}, "one finite time per configuration"),
        ({"configurations": np.array([["a"] * 7])}, "something other than numbers"),
        ({"configurations": np.array([[object()] * 7])}, "not a joint path"),
    ):
        np.savez(path, **arrays)
        with pytest.raises(DatasetError, match=f"a.npz: .*{message}"):
            load_joint_path(path, PANDA)
    whole = path.read_bytes()
    for contents in (b"", b"PK", whole[: len(whole) // 2]):
        path.write_bytes(contents)
        with pytest.raises(DatasetError, match="a.npz: not a joint path"):
            load_joint_path(path, PANDA)


def test_shapes_and_endings_are_checked_before_writing(tmp_path):
    with pytest.raises(ValueError, match="configurations must be"):
        save_joint_path(tmp_path / "a.csv", PATH, [0.0])
    with pytest.raises(ValueError, match="must end in .csv or .npz"):
        save_joint_path(tmp_path / "a.txt", PATH, [0.0, 1.0])
    assert not list(tmp_path.iterdir())
