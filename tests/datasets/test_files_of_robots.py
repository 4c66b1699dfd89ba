"""Query, demonstration, path and roadmap files of another arm than the Panda: xArm6, 6 joints."""

import shutil

import numpy as np
import pytest
from paths import ROOT

from roboarm_nmp.datasets.__main__ import main
from roboarm_nmp.datasets.demonstrations import demo_path, load_demos, write_demos
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.queries import load_queries, query_path, write_queries
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.scenes.files import save_scene
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.envs.tasks import get_task, is_task, split_robot, task_name

XARM6 = ROOT / "examples" / "robots" / "xarm6.yaml"


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """The file of an xArm6 in a folder of its own. (Each file takes seconds to load.)"""
    return shutil.copy(XARM6, tmp_path_factory.mktemp("robots") / "xarm6.yaml")


def random_configurations(robot, rng, number):
    return robot.denormalise(rng.uniform(-0.9, 0.9, (number, robot.num_joints))).astype(np.float32)


def write_some_queries(path, task):
    """Queries inside the limits, feasible or not, in two scenes each."""
    scene, rng = get_task(task).scene, np.random.default_rng(0)
    splits = {}
    for split in ("test", "validation"):
        ends = (random_configurations(get_task(task).base_scene.robot, rng, 4) for _ in range(2))
        scenes = () if isinstance(scene, Scene) else ([scene.sample(rng), scene.sample(rng)] * 2,)
        splits[split] = *ends, *scenes
    write_queries(path, task, 3, splits, "made by a test", {})
    return splits


def write_some_demos(path, task):
    robot, rng = get_task(task).base_scene.robot, np.random.default_rng(1)
    plans = [random_configurations(robot, rng, number) for number in (2, 3, 4)]
    states = [
        rng.uniform(-0.9, 0.9, (rows, robot.num_joints)).astype(np.float32) for rows in (3, 2, 4)
    ]
    columns = {"plan_seed": [1, 2, 3], "digest": [4, 5, 6], "collided": [0, 1, 0]}
    write_demos(path, task, 0, plans, states, columns, "made by a test", {})
    return plans, states


def test_files_of_a_robot_are_beside_its_file(file, tmp_path):
    task = f"random_boxes_hard@{file}"
    assert query_path(task) == file.parent / "random_boxes_hard@xarm6_queries.h5"
    assert demo_path(task) == file.parent / "random_boxes_hard@xarm6_demos.h5"
    assert query_path("random_boxes_hard@panda") == query_path("random_boxes_hard")
    scene = tmp_path / "shelf.yaml"
    save_scene(Scene((Box((0.6, 0.0, 0.5), (0.1, 0.1, 0.1)),)), scene)
    assert query_path(f"{scene}@{file}") == tmp_path / "shelf@xarm6_queries.h5"


@pytest.mark.parametrize(
    ("text", "task", "robot", "name"),
    [
        ("wall@arms/iiwa.yaml", "wall", "arms/iiwa.yaml", "wall@iiwa"),
        ("me@here/tub.yaml@me@here/ur5.yaml", "me@here/tub.yaml", "me@here/ur5.yaml", "tub@ur5"),
        ("wall@panda", "wall", None, "wall"),
    ],
)
def test_robot_follows_a_task_and_not_a_folder(text, task, robot, name):
    assert split_robot(text) == (task, robot)
    assert task_name(text) == name
    assert is_task(text) and not is_task("wall@iiwa_queries.h5")


@pytest.mark.parametrize("load", [load_queries, load_demos])
def test_file_of_another_robot_is_rejected(load, file, tmp_path):
    task, path = f"no_obstacles@{file}", tmp_path / "file.h5"
    (write_some_demos if load is load_demos else write_some_queries)(path, task)
    robot = load_robot(file)
    named = rf"file.h5: made for the robot 'xarm6' \({robot.fingerprint[:12]}\), not for "
    with pytest.raises(DatasetError, match=f"{named}'panda' .*: name the robot's file, as TASK@"):
        load(path)
    load(path, task=task)
    with pytest.raises(DatasetError, match="for the task 'no_obstacles@xarm6', not 'no_obstacles'"):
        load(path, task="no_obstacles")
    # A file of the same name describes another arm.
    changed = tmp_path / "changed" / "xarm6.yaml"
    changed.parent.mkdir()
    changed.write_text(XARM6.read_text() + "base_position: [0, 0, 0.1]\n")
    with pytest.raises(DatasetError, match=f"{named}'xarm6' .*make the file again"):
        load(path, task=f"no_obstacles@{changed}")


def test_data_command_takes_a_robot(file, capsys):
    task = f"no_obstacles@{file}"
    write_some_queries(query_path(task), task)
    write_some_demos(demo_path(task), task)
    assert main(["validate", task]) == 0
    assert main(["validate", str(query_path(task)), "--task", task]) == 0
    assert main(["describe", task]) == 0
    assert "demonstrations | 3" in capsys.readouterr().out
    for wrong, message in (
        (str(query_path(task)), "name the robot's file, as TASK@FILE"),
        (f"wall@{file}", "wall is the Panda's"),
    ):
        assert main(["validate", wrong]) == 1
        assert message in capsys.readouterr().err
