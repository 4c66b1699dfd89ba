"""docs/customise/{robot,point_cloud,problems,sensor,encoder,reward}.md: their code is executed."""

import re
import shlex

import numpy as np
import pytest
from docs_scripts import code_of, names_of
from paths import ROOT
from problem_files import write_folder
from trainers import PATHS, load

from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.problems import load_problems
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.demo_generation import plan
from roboarm_nmp.scene_embedding_train import collect
from roboarm_nmp.utils import flags


def test_plan_of_the_page_about_robots_is_followed_without_contact(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)  # the page's paths are relative to it
    names = names_of("customise/robot.md")
    assert capsys.readouterr().out.endswith("True False\n")
    assert names["env"].robot.name == "iiwa" and names["path"].shape[1] == 7


def test_motions_of_the_page_about_point_clouds_avoid_the_points(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = names_of("customise/point_cloud.md")
    assert names["trajectory"].success and len(names["points"]) < 2000
    states = np.clip(names["trajectory"].states, -1, 1)
    assert names["checker"].is_free(states).all()
    page = (ROOT / "docs/customise/point_cloud.md").read_text().replace(" \\\n   ", "")
    commands = re.findall(r"^roboarm plan --cloud table.npy (.*)$", page, re.M)
    assert len(commands) == 4
    for command in commands:
        with pytest.raises(SystemExit) as end:
            plan.main(flags.parse(plan.Args, ["--cloud", "table.npy", *shlex.split(command)]))
        assert end.value.code == 0
        assert "minimum clearance" in capsys.readouterr().out
    assert (tmp_path / "path.csv").exists() and (tmp_path / "motion.yaml").exists()


def test_problems_of_the_page_are_read_and_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_folder(tmp_path / "bookshelf_tall_panda")
    names = names_of("customise/problems.md")
    assert len(load_problems("problems.h5")) == 1 and names["env"].robot == names["wide"]
    assert "True" in capsys.readouterr().out


def test_recordings_of_the_page_are_demonstrations(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert names_of("customise/motions.md")["refused"] == []
    assert len(load_demos("teleop.h5")) == 10


def test_sensor_of_the_page_observes_heights_of_obstacles():
    names = names_of("customise/sensor.md")
    heights, space = names["heights"], names["env"].observation_space["sensors"]["heights"]
    assert heights.shape == (20, 20) and 0.25 < heights.max() < 1.6
    assert space["heights"].contains(heights)


def test_encoder_of_the_page_encodes_scenes_with_unit_variance(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    collect.collect(
        collect.Args(num=70, sensors="images", image_size=16, shard_size=50, workers=1), False
    )
    names = names_of("customise/encoder.md")
    z = names["z"]
    assert z.shape == (64,) and np.isfinite(z).all() and z.std() > 0
    encoded = names["PrincipalComponents"](names["images"])(**names["images"])
    np.testing.assert_allclose(encoded.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(encoded.std(0), 1, atol=0.05)


def test_reward_of_the_page_is_that_of_steps_and_of_batches():
    names = {}
    exec(code_of("customise/reward.md")[0], names)
    env = names["env"]
    observation, _ = env.reset_specific(*load_queries("double_walls", "validation")[0])
    achieved, desired, rewards = [], [], []
    for _ in range(5):
        observation, reward, *_ = env.step(env.action_space.sample())
        achieved.append(observation["achieved_goal"])
        desired.append(observation["desired_goal"])
        rewards.append(reward)
    distance = np.linalg.norm(np.subtract(achieved, desired), axis=1)
    np.testing.assert_allclose(rewards, -1 - 2 * distance, rtol=1e-6)
    batch = env.compute_reward(np.array(achieved), np.array(desired), {})
    np.testing.assert_array_equal(batch, rewards)


def test_replay_buffer_honours_the_reward_of_a_wrapper(tmp_path, monkeypatch):
    _, wrapper, before, after = code_of("customise/reward.md")
    names = {"np": np}
    exec(wrapper, names)
    sources = [PATHS[name].read_text() for name in ("sac_her_mp", "td3_her_mp")]
    assert all(source.count(before) == 1 for source in sources)
    script = tmp_path / "changed.py"
    script.write_text(sources[0].replace(before, after))
    monkeypatch.setitem(PATHS, "changed", script)
    changed = load("changed")
    changed.DistanceCost = names["DistanceCost"]
    args = changed.Args(her_probability=0.0)
    env = changed.make_env(args)
    buffer = changed.HerReplayBuffer(env, 100, args, np.random.default_rng(0))
    step = {name: np.zeros(10) for name in ("observation", "next_observation")}
    step |= {"action": np.zeros(7), "desired_goal": np.zeros(3), "collision": False}
    buffer.add_episode([step | {"next_achieved_goal": [0.5 * k, 0, 0]} for k in range(3)])
    assert set(buffer.sample(200)["reward"].tolist()) == {0.0, -2.0, -3.0}
    env.close()
