"""The Minari export: its episodes are those of the environment, and replay in it."""

import dataclasses
import shutil

import numpy as np
import pytest
from paths import ROOT

pytest.importorskip("minari")

import minari  # noqa: E402

from roboarm_nmp import envs  # noqa: E402
from roboarm_nmp.datasets.demonstrations import demo_path, load_demos, write_demos  # noqa: E402
from roboarm_nmp.datasets.format import QueryScenes  # noqa: E402
from roboarm_nmp.demo_generation import collect, export_minari  # noqa: E402
from roboarm_nmp.envs.robots.files import load_robot  # noqa: E402
from roboarm_nmp.envs.robots.panda import PANDA  # noqa: E402
from roboarm_nmp.envs.scenes.files import save_scene  # noqa: E402
from roboarm_nmp.envs.scenes.primitives import to_array  # noqa: E402

OPTIONS = {
    "task": "wall",
    "seed": 5,
    "planner": "RRTConnect",
    "max_checks": 100_000,
    "clearance": 0.005,
    "planner_range": 0.3,
    "simplify": 1,
    "attempts": 3,
    "allow_collisions": False,
}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "wall.h5"
    collect.collect(path, 3, OPTIONS, progress=False)
    return path


@pytest.fixture
def demos(path):
    return load_demos(path)


@pytest.fixture(autouse=True)
def storage(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


def test_episodes_are_the_demonstrations_up_to_the_goal(demos):
    dataset_id, steps = export_minari.export(demos, "combined", progress=False)
    assert dataset_id == "roboarm-nmp/wall/combined-v0"
    dataset = minari.load_dataset(dataset_id)
    assert len(dataset) == len(demos) and dataset.total_steps == steps
    for demo, episode in zip(demos, dataset, strict=True):
        states = demo.states.astype(float)
        positions = PANDA.forward_kinematics(PANDA.denormalise(states))
        goal_state, goal_position = PANDA.normalise(demo.goal), PANDA.forward_kinematics(demo.goal)
        ee_distance = np.linalg.norm(positions - goal_position, axis=1)
        inside = ee_distance < 0.02
        length = 1 + int(np.argmax(inside[1:]))  # steps until it is inside for the first time
        assert inside[length]

        observation = episode.observations["observation"]
        assert observation.dtype == np.float32 and observation.shape == (length + 1, 10)
        np.testing.assert_array_equal(observation[:, :7], demo.states[: length + 1])
        np.testing.assert_allclose(observation[:, 7:], positions[: length + 1], atol=1e-6)
        achieved = np.hstack([states, positions])
        desired = np.concatenate([goal_state, goal_position])
        for name, expected in (
            ("achieved_goal", achieved[: length + 1]),
            ("desired_goal", np.tile(desired, (length + 1, 1))),
        ):
            assert episode.observations[name].dtype == np.float32
            np.testing.assert_allclose(episode.observations[name], expected, atol=1e-6)
        assert episode.actions.dtype == np.float32
        np.testing.assert_array_equal(episode.actions, demo.actions[:length])
        assert episode.rewards.tolist() == [-1.0] * (length - 1) + [0.0]
        assert episode.terminations.tolist() == [False] * (length - 1) + [True]
        assert episode.truncations.tolist() == [False] * length
        assert episode.infos["is_success"].tolist() == [False] * length + [True]


def test_spaces_and_environment_are_recovered(demos):
    dataset_id, _ = export_minari.export(demos, "config", "mine/reach-v7", progress=False)
    dataset = minari.load_dataset(dataset_id)
    env = dataset.recover_environment()
    assert env.unwrapped.scene == envs.TASKS["wall"].scene
    assert env.unwrapped.goal_type == "config"
    assert dataset.observation_space == env.observation_space
    assert dataset.action_space == env.action_space
    for episode in dataset:
        first = {name: values[0] for name, values in episode.observations.items()}
        assert env.observation_space.contains(first)
        assert all(env.action_space.contains(action) for action in episode.actions)
    metadata = dataset.storage.metadata
    assert "RRTConnect" in metadata["algorithm_name"] and "--seed 5" in metadata["description"]
    assert list(minari.list_local_datasets()) == ["mine/reach-v7"]


def test_replayed_actions_repeat_the_episode(demos):
    """Exact ones repeat the episode; rounded ones end near the goal."""
    for exact, tolerance in ((True, 1e-3), (False, 0.02)):
        dataset_id, _ = export_minari.export(
            demos, "ee", f"replay/exact{exact}-v0", exact, progress=False
        )
        dataset = minari.load_dataset(dataset_id)
        env = dataset.recover_environment().unwrapped
        for demo, episode in zip(demos, dataset, strict=True):
            env.reset_specific(demo.start, demo.goal)
            for step, action in enumerate(episode.actions):
                observation, reward, terminated, _, info = env.step(action)
                for name, value in observation.items():
                    recorded = episode.observations[name][step + 1]
                    np.testing.assert_allclose(value, recorded, atol=tolerance)
                if exact:
                    assert reward == episode.rewards[step]
                    assert terminated == episode.terminations[step]
            assert not info["collision_so_far"]
            assert not exact or info["is_success"]


def test_episode_that_misses_its_goal_is_truncated(demos):
    env = envs.make("wall")
    short = demos[0]
    short = dataclasses.replace(short, states=short.states[:5], actions=short.actions[:4])
    episode = export_minari.episode(short, env)
    assert episode["truncations"].tolist() == [False, False, False, True]
    assert not episode["terminations"].any() and (episode["rewards"] == -1.0).all()


def test_exact_export_rejects_other_executions(demos, storage):
    demos.digest[1] += 1
    with pytest.raises(ValueError, match="verify FILE --repair"):
        export_minari.export(demos, exact=True, progress=False)
    assert list(storage.iterdir()) == []


def test_scenes_that_vary_are_rejected(demos, storage):
    scene = envs.TASKS["wall"].scene
    index, offsets = np.zeros(len(demos), int), np.array([0, len(scene.obstacles)])
    varied = QueryScenes(scene, index, offsets, to_array(scene.obstacles))
    with pytest.raises(ValueError, match="^the scenes of wall vary, and a Minari episode"):
        export_minari.export(dataclasses.replace(demos, scenes=varied))
    assert list(storage.iterdir()) == []


def test_scene_file_is_exported_with_its_path(demos, storage, tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    save_scene(envs.TASKS["wall"].scene, folder / "mine.yaml")
    columns = {name: getattr(demos, name) for name in ("plan_seed", "digest", "collided")}
    plans, states = zip(*((demo.plan, demo.states) for demo in demos), strict=True)
    file = folder / "mine_demos.h5"
    write_demos(file, str(folder / "mine.yaml"), 5, plans, states, columns, "a test", {})
    with pytest.raises(SystemExit, match="task 'mine' is not in envs.TASKS: .* --task"):
        export_minari.main(export_minari.Args(file=file))
    assert list(storage.iterdir()) == []
    export_minari.main(export_minari.Args(task=str(folder / "mine.yaml")))
    dataset = minari.load_dataset("roboarm-nmp/mine/ee-v0")
    assert dataset.recover_environment().unwrapped.scene == envs.TASKS["wall"].scene


def test_another_arm_is_exported_with_its_file(storage, tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    robot = shutil.copy(ROOT / "examples" / "robots" / "xarm6.yaml", folder)
    task = f"no_obstacles@{robot}"
    collect.collect(demo_path(task), 2, OPTIONS | {"task": task}, progress=False)
    export_minari.main(export_minari.Args(task=task))
    dataset = minari.load_dataset("roboarm-nmp/no_obstacles-xarm6/ee-v0")
    env = dataset.recover_environment()
    assert env.unwrapped.robot == load_robot(robot) and env.action_space == dataset.action_space
    assert dataset[0].actions.shape[1] == 6


def test_existing_dataset_is_replaced_only_on_demand_and_as_a_whole(demos, storage, monkeypatch):
    dataset_id, steps = export_minari.export(demos, progress=False)
    with pytest.raises(ValueError, match=r"roboarm-nmp/wall/ee-v0 exists .*--overwrite"):
        export_minari.export(demos, progress=False)

    def fail(demo, env):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(export_minari, "episode", fail)
        with pytest.raises(OSError, match="No space"):
            export_minari.export(demos, overwrite=True, progress=False)
    assert minari.load_dataset(dataset_id).total_steps == steps
    export_minari.export(demos, exact=True, overwrite=True, progress=False)
    first = minari.load_dataset(dataset_id)[0].observations["observation"][1, :7]
    assert 0 < np.abs(first - demos[0].states[1]).max() <= 1.1e-4  # the rounding
    assert [entry.name for entry in storage.iterdir()] == ["roboarm-nmp"]


def test_errors_are_one_line(path, tmp_path, monkeypatch):
    def error(**flags):
        with pytest.raises(SystemExit) as caught:
            export_minari.main(export_minari.Args(**flags))
        assert "\n" not in caught.value.code
        return caught.value.code

    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(path.read_bytes()[:3000])
    assert "give --task, or the --file of a named task of the Panda" in error()
    assert "unknown task 'nope'" in error(task="nope")
    assert "no such file" in error(file=path.with_name("none.h5"))
    assert f"{damaged}: truncated or corrupt" in error(file=damaged)
    assert "bad dataset id '../up-v0'" in error(file=path, dataset_id="../up-v0")
    monkeypatch.setattr(export_minari.importlib.util, "find_spec", lambda name: None)
    assert 'pip install -e ".[minari]"' in error(file=path)
