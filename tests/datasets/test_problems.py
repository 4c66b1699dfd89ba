"""Problems: read from other programs' files as they are there, and written without a change."""

import pickle
from dataclasses import replace

import h5py
import numpy as np
import pytest
from problem_files import (
    GOALS,
    MOVEIT_REQUEST,
    MOVEIT_SCENE,
    OPENING,
    ROBOMETRICS,
    START,
    VAMP,
    write_file,
    write_folder,
)

from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.problems import load_problems, write_problems
from roboarm_nmp.datasets.queries import load_queries, query_path
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.formats import load_world
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene, Sphere
from roboarm_nmp.envs.world import World
from roboarm_nmp.utils.bullet import pybullet as p


def opening(problem):
    assert problem.scene.robot.same_arm(PANDA)
    return list(problem.scene.robot.held.values())


def test_motionbenchmaker_folder(tmp_path):
    write_folder(tmp_path / "shelf")
    write_folder(tmp_path / "shelf", "0002")
    (tmp_path / "shelf" / "config.yaml").write_text("not: read")
    problems = load_problems(tmp_path / "shelf")
    assert problems.names == ("shelf/0001", "shelf/0002") and not problems.rejected
    problem = problems[0]
    assert problem.start.tolist() == START and problem.goals.tolist() == GOALS[:1]
    assert problem.goal_pose is None and opening(problem) == [OPENING] * 2
    world = load_world(tmp_path / "shelf" / "scene0001.yaml")
    assert replace(problem.scene, robot=PANDA) == world


def test_robometrics_file(tmp_path):
    problems = load_problems(write_file(tmp_path / "set.yaml", ROBOMETRICS))
    assert problems.names == ("shelf/0",)
    problem = problems[0]
    assert problem.start.tolist() == START and problem.goals.tolist() == GOALS
    assert opening(problem) == [0.025] * 2
    board = Box((0.5, -0.5, 0.2), (0.3, 0.04, 0.5), (0.0, 0.0, 0.6, 0.8))
    assert problem.scene.obstacles == (board, Cylinder((0.6, 0.5, 0.07), 0.03, 0.14))
    assert problem.scene.table is None and problem.scene.floor is None


def test_goal_pose_of_the_hand_is_that_of_the_end_effector(tmp_path):
    world = World(Scene(robot=PANDA), drawn=False)
    world.place(GOALS[0])
    hand, tip = (
        p.getLinkState(world.body, link, computeForwardKinematics=1, physicsClientId=world.client)
        for link in (8, PANDA.end_effector_link)
    )
    world.close()
    (x, y, z, w), position = hand[5], list(hand[4])
    text = ROBOMETRICS.replace("[0.4, 0.2, 0.5]", str(position))
    text = text.replace("[0.0, 0.6, 0.8, 0.0]", str([w, x, y, z]))
    pose = load_problems(write_file(tmp_path / "set.yaml", text))[0].goal_pose
    np.testing.assert_allclose(pose[:3], tip[4], atol=1e-6)
    np.testing.assert_allclose(pose[:3], PANDA.forward_kinematics(GOALS[0]), atol=1e-6)
    assert abs(pose[3:] @ np.array(tip[5])) == pytest.approx(1, abs=1e-6)


def test_vamp_file_has_half_extents_and_euler_angles(tmp_path):
    problems = load_problems(write_file(tmp_path / "vamp.json", VAMP))
    assert problems.names == ("box/7",)
    problem = problems[0]
    assert problem.goals.tolist() == GOALS and opening(problem) == [0.065] * 2
    box, can, ball = problem.scene.obstacles
    assert (box.size, can.length, ball) == ((0.3, 0.04, 0.5), 0.14, Sphere((0, 0.6, 0.5), 0.1))
    # Turns about the fixed x, y and z axis, as PyBullet's Euler angles are.
    np.testing.assert_allclose(box.orientation, p.getQuaternionFromEuler((0.1, 0.2, 0.3)))


def test_json_with_full_edges_and_fingers(tmp_path):
    box = {"position": [0.5, 0, 0.2], "quat_xyzw": [0, 0, 0.6, 0.8], "size": [0.3, 0.04, 0.5]}
    problem = {"start": START, "goals": GOALS[:1], "fingers": [0.01, 0.02]}
    problem["obstacles"] = {"box": [box], "cylinder": []}
    [found] = load_problems(write_file(tmp_path / "set.json", {"problems": [problem]}))
    assert found.name == "set/0" and opening(found) == [0.01, 0.02]
    assert found.scene.obstacles == (Box((0.5, 0, 0.2), (0.3, 0.04, 0.5), (0, 0, 0.6, 0.8)),)


def test_query_file_gives_problems():
    problems = load_problems(query_path("wall"))
    queries = load_queries("wall", "validation")
    problem = problems[10_000]
    assert (len(problems), problem.name) == (10_200, "validation/0")
    query = problems.query(10_000)
    assert (query.start == queries.start[0]).all() and (query.goal == queries.goal[0]).all()
    assert query.scene == queries[0].scene


def everything(folder):
    sets = [
        load_problems(write_folder(folder / "shelf")),
        load_problems(write_file(folder / "set.yaml", ROBOMETRICS)),
        load_problems(write_file(folder / "vamp.json", VAMP)),
    ]
    return [problem for problems in sets for problem in problems]


def assert_equal(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert one.name == other.name and one.scene == other.scene
        for name in ("start", "goals"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert (one.goal_pose is None) == (other.goal_pose is None)
        if one.goal_pose is not None:
            np.testing.assert_array_equal(one.goal_pose, other.goal_pose)


def test_written_problems_are_read_as_they_were(tmp_path):
    problems = everything(tmp_path)
    problems.append(problems[1]._replace(name="pose only", goals=np.empty((0, 7))))
    path = tmp_path / "problems.h5"
    write_problems(path, problems, "a test")
    found = load_problems(path)
    assert_equal(found, problems)
    assert_equal(pickle.loads(pickle.dumps(found[1:])), problems[1:])
    write_problems(tmp_path / "again.h5", found, "a test")
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()
    assert found.digest == load_problems(path).digest and len(found.digest) == 64
    with pytest.raises(ValueError, match="pose only: its goal is a pose"):
        found.query(3)


def test_file_of_another_arm_is_rejected(tmp_path):
    write_problems(tmp_path / "a.h5", load_problems(write_file(tmp_path / "vamp.json", VAMP)))
    with pytest.raises(DatasetError, match="a.h5: made for the robot 'panda'"):
        load_problems(tmp_path / "a.h5", replace(PANDA, name="other"))


def test_damaged_hdf5_is_rejected(tmp_path):
    path = tmp_path / "a.h5"
    write_problems(path, everything(tmp_path))
    with h5py.File(path, "r+") as file:
        file["goals"][0, 0] = 0.25
    with pytest.raises(DatasetError, match="a.h5: corrupt"):
        load_problems(path)
    path.write_bytes(b"no HDF5")
    with pytest.raises(DatasetError, match="a.h5: not an HDF5 file"):
        load_problems(path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"goals": np.empty((0, 7))}, "a problem has no goal"),
        ({"goal_pose": np.ones(7)}, "must have norm 1"),
    ],
)
def test_problems_that_cannot_be_are_not_written(change, reason, tmp_path):
    problems = [problem._replace(**change) for problem in everything(tmp_path)[:1]]
    with pytest.raises(ValueError, match=reason):
        write_problems(tmp_path / "a.h5", problems)
    assert not (tmp_path / "a.h5").exists()


def edited(text, old, new):
    assert old in text
    return text.replace(old, new, 1)


REQUESTS = [
    (edited(MOVEIT_REQUEST, "      - {joint_name: panda_joint6, position: 1.7}\n", ""), 3,
     "the goal lacks panda_joint6"),
    (edited(MOVEIT_REQUEST, "panda_finger_joint2", "thumb"), 13, "panda has no joint 'thumb'"),
    (edited(MOVEIT_REQUEST, "group_name: panda_arm", "path_constraints: {name: upright}"), 1,
     "path_constraints are not supported"),
    ("group_name: !!python/object/apply:os.system ['touch hacked']\n", 1,
     "a request lacks start_state"),
    ("a: [1\n", 2, "while parsing a flow sequence"),
]  # fmt: skip


@pytest.mark.parametrize(("request_text", "line", "reason"), REQUESTS)
def test_unusable_request_is_reported(request_text, line, reason, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_folder(tmp_path / "shelf", "0001", request=request_text)
    problems = load_problems(write_folder(tmp_path / "shelf", "0002"))
    assert problems.names == ("shelf/0002",)  # the others are not lost
    [rejected] = problems.rejected
    where = f"{tmp_path / 'shelf' / 'request0001.yaml'}:{line}: "
    assert rejected.name == "shelf/0001" and rejected.reason.startswith(where + reason)
    assert not (tmp_path / "hacked").exists()


def test_scene_of_a_folder_that_cannot_be_used_is_reported(tmp_path):
    text = edited(MOVEIT_SCENE, "type: cylinder", "type: cone")
    folder = write_folder(tmp_path / "shelf", scene=text)
    (folder / "request0002.yaml").write_text(MOVEIT_REQUEST)
    one, two = load_problems(folder).rejected
    assert one.reason == f"{folder / 'scene0001.yaml'}:15: cones are not supported (cone)"
    assert two.reason == f"{folder / 'request0002.yaml'}: there is no scene0002.yaml"


def test_problems_of_robometrics_that_cannot_be_used_are_reported(tmp_path):
    bad = edited(ROBOMETRICS.partition("\n")[2], "dims: [0.3,", "dims: [0,")
    for old, new, line, reason in (
        ("", "", 31, "dims of cuboid board must be positive"),
        ("frame: panda_hand", "frame: thumb", 25, "panda has no link 'thumb'"),
        ("panda_hand", "panda_link3", 25, "'panda_link3' does not move with the end effector"),
        ("panda_link0", "odom", 39, "the frame 'odom' is neither panda_link0"),
    ):
        path = write_file(tmp_path / "set.yaml", ROBOMETRICS + bad.replace(old, new))
        problems = load_problems(path)
        [rejected] = problems.rejected
        assert len(problems) == 1 and rejected.name == "shelf/1"
        assert rejected.reason.startswith(f"{path}:{line}: "), rejected.reason
        assert reason in rejected.reason


FILES = [
    ("a.yaml", MOVEIT_SCENE, "a.yaml:1: a world without starts and goals"),
    ("a.json", {"problems": 3}, "a.json:1: problems must be a list, got 3"),
    ("a.pkl", "", "a.pkl: problems are in .yaml, .json and .h5 files"),
]


@pytest.mark.parametrize(("name", "content", "reason"), FILES)
def test_file_without_problems_is_rejected(name, content, reason, tmp_path):
    path = write_file(tmp_path / name, content)
    with pytest.raises(ValueError) as caught:
        load_problems(path)
    assert str(caught.value).startswith(f"{tmp_path}/{reason}")
    assert "\n" not in str(caught.value)


def test_missing_files_are_named(tmp_path):
    for name in ("no.yaml", "no.json", "no.h5", "no"):
        with pytest.raises(ValueError, match=rf"{name}: [nN]o such file"):
            load_problems(tmp_path / name)
    with pytest.raises(ValueError, match="no request####.yaml"):
        load_problems(tmp_path)
