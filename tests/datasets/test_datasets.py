"""Query files: exact, reproducible, written atomically; errors of bad files name them."""

import dataclasses
import fcntl
import json
import subprocess
import sys

import h5py
import numpy as np
import pybullet_data
import pytest
from paths import ROOT

from roboarm_nmp import envs
from roboarm_nmp.datasets.__main__ import main as data_command
from roboarm_nmp.datasets.format import SPLITS, DatasetError
from roboarm_nmp.datasets.queries import load_queries, query_path, validate, write_queries
from roboarm_nmp.demo_generation import make_queries
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.utils.bullet import pybullet as p


def random_splits():
    """Queries inside the joint limits, feasible or not."""
    rng = np.random.default_rng(0)
    return {
        split: tuple(
            (PANDA.lower + (PANDA.upper - PANDA.lower) * rng.uniform(0.01, 0.99, (n, 7))).astype(
                np.float32
            )
            for _ in range(2)
        )
        for split, n in (("test", 30), ("validation", 10))
    }


def write(path, splits=None, task="wall"):
    write_queries(path, task, 3, splits or random_splits(), "made by a test", {"hold_steps": 24})
    return path


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "queries.h5")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small file made by the generator in this process."""
    path = tmp_path_factory.mktemp("made") / "wall.h5"
    make_queries.make_queries(path, "wall", 0, 30, 10, progress=False)
    return path


# --- Reading and writing


def test_round_trip_is_exact(tmp_path):
    splits = random_splits()
    path = write(tmp_path / "queries.h5", splits)
    for split, (start, goal) in splits.items():
        queries = load_queries(path, split)
        assert (queries.task, queries.split, queries.seed) == ("wall", split, 3)
        assert len(queries) == len(start)
        for array, expected in (
            (queries.start, start),
            (queries.goal, goal),
            (queries.goal_position, PANDA.forward_kinematics(goal).astype(np.float32)),
        ):
            assert array.dtype == np.float32
            np.testing.assert_array_equal(array, expected)
    assert set(validate(path, "wall")) == {"test", "validation"}


def test_interrupted_command_continues_to_the_same_bytes(made, tmp_path, monkeypatch):
    again = tmp_path / "again.h5"
    numbers = []
    append = make_queries.Journal.append

    def append_or_die(journal, entry):
        if len(numbers) == 17:
            raise OSError("the disk is full")
        numbers.append(entry["index"])
        append(journal, entry)

    monkeypatch.setattr(make_queries.Journal, "append", append_or_die)
    with pytest.raises(OSError, match="disk is full"):
        make_queries.make_queries(again, "wall", 0, 30, 10, progress=False)
    with pytest.raises(ValueError, match="seed 0, not 1"):
        make_queries.make_queries(again, "wall", 1, 30, 10, progress=False)
    first = list(numbers)
    numbers.clear()
    monkeypatch.setattr(
        make_queries.Journal,
        "append",
        lambda journal, entry: numbers.append(entry["index"]) or append(journal, entry),
    )
    make_queries.make_queries(again, "wall", 0, 30, 10, progress=False)
    assert len(numbers) == 40 - 17 and not set(numbers) & set(first)
    assert again.read_bytes() == made.read_bytes()
    assert list(tmp_path.iterdir()) == [again]


def test_made_queries_are_feasible_and_not_those_of_a_reset(made):
    splits = validate(made, "wall", simulate=True)
    env = envs.make("wall")
    env.reset(seed=0)
    for queries in splits.values():
        assert not (queries.start == env.start_configuration).all(axis=1).any()
    env.close()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda start, goal: (start[:, :6], goal), r"\(n, 7\)"),
        (lambda start, goal: (start + np.float32(10), goal), "joint limits"),
        (
            lambda start, goal: [one[4:6] for one in random_splits()["test"]],
            "2 queries are in both",
        ),
    ],
)
def test_bad_arrays_are_not_written(path, change, complaint):
    before = path.read_bytes()
    splits = random_splits()
    splits["validation"] = change(*splits["validation"])
    with pytest.raises(DatasetError, match=complaint):
        write(path, splits)
    assert path.read_bytes() == before


def test_bad_arguments_are_rejected(path):
    with pytest.raises(ValueError, match="unknown task 'wal'"):
        write(path, task="wal")
    with pytest.raises(ValueError, match="unknown task 'wal'"):
        query_path("wal")
    with pytest.raises(ValueError, match="unknown split 'train': one of test, validation"):
        load_queries(path, "train")


# --- Bad files


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def flip_stored_bytes(path):
    with h5py.File(path) as file:
        chunk = file["test/goal"].id.get_chunk_info(0)
    contents = bytearray(path.read_bytes())
    middle = chunk.byte_offset + chunk.size // 2
    for i in range(middle, middle + 4):
        contents[i] ^= 0xFF
    path.write_bytes(contents)


def change_one_number(path):
    with h5py.File(path, "r+") as file:
        file["validation/start"][2, 3] -= np.float32(1e-6)


def elsewhere(path):
    with h5py.File(path, "r+") as file:
        del file["test/goal"]
        shape, where = (30, 7), [("/dev/zero", 0, h5py.h5f.UNLIMITED)]
        file.create_dataset("test/goal", shape, np.float32, external=where)


def test_file_that_another_program_writes_is_in_use(path):
    truncate(path)
    with open(path, "ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # as HDF5 does
        with pytest.raises(DatasetError, match=f"{path}: another program has it open for writing"):
            load_queries(path)


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (truncate, "truncated"),
        (flip_stored_bytes, "corrupt"),
        (change_one_number, "checksum"),
        (elsewhere, "/test/goal is not an array in this file"),
    ],
)
def test_bad_file_is_rejected_by_name(path, damage, complaint):
    damage(path)
    with pytest.raises(DatasetError) as caught:
        load_queries(path)
    assert str(path) in str(caught.value) and complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_file_for_another_task_is_rejected(path, monkeypatch):
    with pytest.raises(DatasetError, match="for the task 'wall', not 'no_obstacles'"):
        validate(path, "no_obstacles")
    monkeypatch.setattr("roboarm_nmp.datasets.queries.query_path", lambda task: path)
    assert load_queries("wall").task == "wall"
    with pytest.raises(DatasetError, match="for the task 'wall', not 'no_obstacles'"):
        load_queries("no_obstacles")


def test_file_for_an_old_scene_is_rejected(path, monkeypatch):
    scene = dataclasses.replace(envs.TASKS["wall"].scene, table=None)
    task = dataclasses.replace(envs.TASKS["wall"], scene=scene)
    monkeypatch.setitem(envs.TASKS, "wall", task)
    with pytest.raises(DatasetError, match="out of date.*made by a test") as caught:
        load_queries(path)
    assert str(path) in str(caught.value)


def test_simulation_finds_infeasible_queries(made, tmp_path):
    folded = np.zeros(7, np.float32)  # inside the limits; elbow and wrist straight and folded
    folded[3], folded[5] = -3.1, 3.8
    env = envs.make("wall")
    assert not env.is_feasible(folded)
    env.close()
    queries = validate(made)
    splits = {split: (queries[split].start, queries[split].goal) for split in queries}
    splits["validation"][1][7] = folded
    path = write(tmp_path / "infeasible.h5", splits)
    validate(path)
    with pytest.raises(DatasetError, match=r"infeasible.h5: validation/goal\[7\] is not feasible"):
        validate(path, simulate=True)


# --- Commands


def test_validate_command_names_bad_files(made, path, capsys):
    truncate(path)
    assert data_command(["validate", str(made), "--task", "wall", "--simulate"]) == 0
    assert "30 test and 10 validation queries for wall, seed 0" in capsys.readouterr().out
    assert data_command(["validate", str(path), str(made)]) == 1
    output = capsys.readouterr()
    [error] = [line for line in output.err.splitlines() if str(path) in line]
    assert "truncated" in error and str(made) in output.out


def test_command_replaces_a_file_with_two_workers_and_says_how_it_was_made(made, tmp_path):
    path = tmp_path / "wall.h5"
    made_by = "roboarm queries --task wall --seed 0 --num-test 30 --num-validation 10"
    path.write_bytes(b"old")
    command = [sys.executable, "-m", "roboarm_nmp", *made_by.split()[1:]]
    command += ["--output", path, "--workers", "2", "--overwrite"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    with h5py.File(path) as file:
        assert file.attrs["made_by"].decode() == made_by
        assert json.loads(file.attrs["parameters"].decode())["hold_steps"] == 24
    assert path.read_bytes() == made.read_bytes() and list(tmp_path.iterdir()) == [path]


def test_goals_are_in_the_goal_region_inside_a_shelf(tmp_path):
    path, region = tmp_path / "in_the_shelf.h5", (0.4, 0.65, -0.4, 0.4, 0.24, 0.46)
    make_queries.make_queries(path, "three_shelves", 0, 6, 2, progress=False, goal_region=region)
    splits = validate(path, "three_shelves", simulate=True)
    low, high = np.array(region[::2]), np.array(region[1::2])
    for queries in splits.values():
        goals = PANDA.forward_kinematics(queries.goal)
        assert (low <= goals).all() and (goals <= high).all()
        starts = PANDA.forward_kinematics(queries.start)
        assert not ((low <= starts) & (starts <= high)).all()  # only goals are restricted
    with h5py.File(path) as file:
        assert json.loads(file.attrs["parameters"])["goal_region"] == list(region)
        assert "--goal-region 0.4 0.65 -0.4 0.4 0.24 0.46" in file.attrs["made_by"].decode()


def test_queries_inside_the_limits_of_the_datasheet_are_a_share_of_all(tmp_path):
    path = tmp_path / "queries.h5"
    rejected = make_queries.make_queries(
        path, "no_obstacles", 0, 12, 2, progress=False, limits="datasheet"
    )
    queries = load_queries(path, "test", "no_obstacles")
    ends = np.concatenate([queries.start, queries.goal])
    assert PANDA.is_within(ends, "datasheet").all() and rejected["outside"] > 0
    with h5py.File(path) as file:
        assert json.loads(file.attrs["parameters"])["limits"] == "datasheet"
        assert b"--limits datasheet" in file.attrs["made_by"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--task", "wall", "wal"], "unknown task 'wal'"),
        (["--task", "wall"], "wall.h5 exists; --overwrite replaces it"),
        (
            ["--task", "wall", "--goal-region", "1", "0", "0", "1", "0", "1"],
            "each minimum below its maximum, got 1.0 0.0 0.0",
        ),
    ],
)
def test_make_queries_rejects_bad_flags_before_any_work(arguments, complaint):
    with pytest.raises(SystemExit) as ended:
        make_queries.main(make_queries.flags.parse(make_queries.Args, arguments))
    assert complaint in str(ended.value)


# --- Files of the project


@pytest.mark.parametrize("task", envs.TASKS)
def test_queries_of_the_project_are_feasible_and_have_their_positions(task):
    env = envs.make(task)
    client = p.connect(p.DIRECT)
    robot = p.loadURDF(
        pybullet_data.getDataPath() + "/franka_panda/panda.urdf",
        useFixedBase=True,
        physicsClientId=client,
    )
    for split in SPLITS:
        queries = load_queries(task, split)
        validation = 500 if task.startswith("wide") else 200
        assert len(queries) == {"test": 10_000, "validation": validation}[split]
        chosen = np.random.default_rng(0).choice(len(queries), 8, replace=False)
        for start, goal, scene in queries[chosen]:
            env.set_scene(scene)
            assert env.is_feasible(start)
            assert not scene.is_static or env.is_feasible(goal)
        for goal, position in zip(queries.goal[chosen], queries.goal_position[chosen], strict=True):
            for joint, angle in enumerate(goal):
                p.resetJointState(robot, joint, angle, physicsClientId=client)
            link = p.getLinkState(robot, 11, computeForwardKinematics=1, physicsClientId=client)
            np.testing.assert_allclose(position, link[4], rtol=0, atol=1e-6)
    p.disconnect(physicsClientId=client)
    env.close()
