"""`roboarm export`: Minari's episodes are those of the environment; LeRobot's are the motions."""

import dataclasses
import functools
import json

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.episodes import demo_episode
from roboarm_nmp.datasets.format import DatasetError, QueryScenes
from roboarm_nmp.datasets.import_problems import Args as ImportArgs
from roboarm_nmp.datasets.import_problems import main as import_main
from roboarm_nmp.datasets.lerobot import JointNames, load_joint_names, read_lerobot, write_lerobot
from roboarm_nmp.demo_generation import collect, export
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.files import save_scene
from roboarm_nmp.envs.scenes.primitives import to_array

minari = pytest.importorskip("minari")


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "wall.h5"
    options = collect.options_of(collect.Args("wall", seed=5))
    collect.collect(path, 2, options, progress=False)
    return path


@pytest.fixture
def demos(path):
    return load_demos(path)


@pytest.fixture(autouse=True)
def storage(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


def test_episodes_are_the_demonstrations_up_to_the_goal(demos):
    dataset_id, steps = export.export(demos, "combined", progress=False)
    assert dataset_id == "roboarm-nmp/wall/combined-v0"
    dataset = minari.load_dataset(dataset_id)
    assert len(dataset) == len(demos) and dataset.total_steps == steps
    env = envs.make("wall", goal_type="combined")
    for demo, episode in zip(demos, dataset, strict=True):
        expected = demo_episode(demo, env)  # its contents: test_episodes.py
        length = len(expected.action)
        for name in ("observation", "achieved_goal"):
            np.testing.assert_array_equal(episode.observations[name], getattr(expected, name))
        desired = np.tile(expected.desired_goal, (length + 1, 1))
        np.testing.assert_array_equal(episode.observations["desired_goal"], desired)
        np.testing.assert_array_equal(episode.actions, expected.action)
        assert episode.rewards.tolist() == [-1.0] * (length - 1) + [0.0]
        assert episode.terminations.tolist() == [False] * (length - 1) + [True]
        assert not episode.truncations.any()
        assert episode.infos["is_success"].tolist() == [False] * length + [True]


def test_exact_actions_repeat_the_episode(demos):
    dataset_id, _ = export.export(demos, "ee", "replay/exact-v0", exact=True, progress=False)
    dataset = minari.load_dataset(dataset_id)
    env = dataset.recover_environment()
    assert dataset.action_space == env.action_space
    assert "Plans of compiled" in dataset.storage.metadata["algorithm_name"]
    env = env.unwrapped
    assert env.scene == envs.TASKS["wall"].scene and env.goal_type == "ee"
    for demo, episode in zip(demos, dataset, strict=True):
        env.reset_specific(demo.start, demo.goal)
        for step, action in enumerate(episode.actions):
            observation, reward, terminated, _, info = env.step(action)
            for name, value in observation.items():
                recorded = episode.observations[name][step + 1]
                np.testing.assert_allclose(value, recorded, atol=1e-3)
            assert (reward, terminated) == (episode.rewards[step], episode.terminations[step])
        assert info["is_success"] and not info["collision_so_far"]


def test_other_executions_and_scenes_that_vary_are_rejected(demos, storage):
    scene = envs.TASKS["wall"].scene
    index, offsets = np.zeros(len(demos), int), np.array([0, len(scene.obstacles)])
    varied = QueryScenes(scene, index, offsets, to_array(scene.obstacles))
    with pytest.raises(ValueError, match="^the scenes of wall vary, and a Minari episode"):
        export.export(dataclasses.replace(demos, scenes=varied))
    with pytest.raises(ValueError, match="^the scenes of wall vary, and a LeRobot dataset"):
        write_lerobot(storage / "lerobot", dataclasses.replace(demos, scenes=varied))
    demos.digest[1] += 1
    with pytest.raises(ValueError, match="verify FILE --repair"):
        export.export(demos, exact=True, progress=False)
    assert list(storage.iterdir()) == []


def test_scene_file_is_exported_with_its_path(demos, storage, tmp_path_factory):
    path = tmp_path_factory.mktemp("own") / "mine.yaml"
    save_scene(envs.TASKS["wall"].scene, path)
    mine = dataclasses.replace(demos, task="mine")
    with pytest.raises(ValueError, match="task 'mine' is not in envs.TASKS: .* --task"):
        export.export(mine, progress=False)
    dataset_id, _ = export.export(mine, progress=False, task=str(path))
    env = minari.load_dataset(dataset_id).recover_environment()
    assert env.unwrapped.scene == envs.TASKS["wall"].scene


def test_existing_dataset_is_replaced_only_on_demand_and_as_a_whole(demos, storage, monkeypatch):
    dataset_id, steps = export.export(demos, progress=False)
    with pytest.raises(ValueError, match=r"roboarm-nmp/wall/ee-v0 exists .*--overwrite"):
        export.export(demos, progress=False)

    def fail(demo, env):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(export, "episode", fail)
        with pytest.raises(OSError, match="No space"):
            export.export(demos, overwrite=True, progress=False)
    assert minari.load_dataset(dataset_id).total_steps == steps
    assert [entry.name for entry in storage.iterdir()] == ["roboarm-nmp"]


def test_errors_are_one_line(path, monkeypatch):
    def error(**flags):
        with pytest.raises(SystemExit) as caught:
            export.main(export.Args(**{"format": "minari"} | flags))
        assert "\n" not in caught.value.code
        return caught.value.code

    assert "give --task, or the --file of a named task of the Panda" in error()
    assert "unknown task 'nope'" in error(task="nope")
    assert "no such file" in error(file=path.with_name("none.h5"))
    assert "bad dataset id '../up-v0'" in error(file=path, dataset_id="../up-v0")
    monkeypatch.setattr(export.importlib.util, "find_spec", lambda name: None)
    assert 'pip install -e ".[minari]"' in error(file=path)


def test_lerobot_dataset_has_the_motions_and_is_read_again(
    demos, path, tmp_path, capsys, monkeypatch
):
    make = functools.partial(envs.make, render_size=(48, 36))
    monkeypatch.setattr(export.envs, "make", make)
    folder, task = tmp_path / "wall_lerobot", "wall"
    export.main(export.Args("lerobot", file=path, output=folder, images=True))
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 30
    assert info["total_episodes"] == 2 and info["total_frames"] == len(demos.states)
    assert info["features"]["observation.images.camera"]["shape"] == [36, 48, 3]
    recordings = read_lerobot(folder, PANDA, JointNames(action="action"))
    for recording, demo in zip(recordings, demos, strict=True):
        np.testing.assert_allclose(recording.positions, demo.configurations, atol=1e-6)
        commanded = PANDA.denormalise(demo.states[:-1] + demo.actions)
        np.testing.assert_allclose(recording.actions[:-1], commanded, atol=1e-6)
        np.testing.assert_allclose(np.diff(recording.times), 1 / 30, atol=1e-6)
    with pytest.raises(SystemExit, match="--overwrite replaces it"):
        export.main(export.Args("lerobot", file=path, output=folder))
    capsys.readouterr()
    import_main(ImportArgs((folder,), "lerobot", tmp_path / "again.h5", task=task, workers=1))
    assert capsys.readouterr().out.startswith("imported 2 of 2 motions\n")
    again = load_demos(tmp_path / "again.h5", task)
    assert again.made_by.startswith("roboarm import --format lerobot")
    np.testing.assert_allclose(again.start, demos.start, atol=2e-3)


def test_joints_of_a_dataset_have_other_names_and_units(demos, tmp_path):
    write_lerobot(tmp_path / "theirs", demos)
    path = tmp_path / "theirs" / "meta" / "info.json"
    info = json.loads(path.read_text())
    feature = info["features"]["observation.state"]
    feature["names"] = {"motors": [f"j{i}.pos" for i in range(1, 8)]}
    path.write_text(json.dumps(info))
    with pytest.raises(DatasetError, match="has no 'panda_joint1'.*j7.pos. Name .* --joints"):
        read_lerobot(tmp_path / "theirs", PANDA)
    names = tmp_path / "names.yaml"
    lines = [f"  panda_joint{i}: j{i}.pos" for i in range(1, 8)]
    names.write_text("\n".join(["degrees: true", "joints:", *lines]))
    recording = read_lerobot(tmp_path / "theirs", PANDA, load_joint_names(names))[1]
    expected = np.radians(demos[1].configurations)
    np.testing.assert_allclose(recording.positions, expected, atol=1e-6)
    names.write_text("degrees: 1")
    with pytest.raises(ValueError, match="names.yaml:1: degrees must be true or false"):
        load_joint_names(names)
    path.write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    with pytest.raises(DatasetError, match="'v2.1', this code reads v3"):
        read_lerobot(tmp_path / "theirs", PANDA)
