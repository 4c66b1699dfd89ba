"""Policies that observe an encoded scene: buffer, demonstrations, training, evaluation."""

import numpy as np
import pytest
from trainers import load, run_script

import roboarm_nmp
from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.episodes import demo_transitions, load_demos_for
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.envs.perception.encoders import make_encoder
from roboarm_nmp.envs.scenes.motions import Oscillation
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.networks.network_file import load_network

HARD = "random_boxes_hard"
MOVING = Scene((Box((0.5, 0.2, 0.3), (0.1, 0.1, 0.6), motion=Oscillation((0, 0.3, 0), 1.0)),))
oracle = make_encoder("oracle")


@pytest.fixture
def env():
    env = envs.make(HARD, encoder="oracle")
    yield env
    env.close()


def steps(env, length):
    """An episode of random steps as transitions."""
    observation, _ = env.reset()
    transitions = []
    for _ in range(length):
        action = env.action_space.sample()
        following = env.step(action)[0]
        transitions.append(
            {
                "observation": observation["observation"],
                "action": action,
                "next_observation": following["observation"],
                "next_achieved_goal": following["achieved_goal"],
                "desired_goal": following["desired_goal"],
                "collision": False,
            }
        )
        observation = following
    return transitions


def test_buffer_samples_have_the_latent_codes_of_moving_obstacles():
    env = envs.make(MOVING, encoder="oracle")
    env.reset(seed=0)
    sac = load("sac_her_mp")
    buffer = sac.HerReplayBuffer(env, 60, sac.Args(her_probability=0.0), np.random.default_rng(0))
    stored = {}
    for _ in range(8):
        episode = steps(env, 10)
        stored |= {t["observation"][:10].tobytes(): t for t in episode}
        buffer.add_episode(episode)
    env.close()
    assert len({t["observation"][10:].tobytes() for t in episode}) > 5
    copy = sac.HerReplayBuffer(env, 60, sac.Args(her_probability=0.0), np.random.default_rng(0))
    copy.load_state_dict(buffer.state_dict())
    for one in (buffer, copy):
        batch = one.sample(200)
        for row, following in zip(batch["observation"], batch["next_observation"], strict=True):
            transition = stored[row[:10].tobytes()]
            np.testing.assert_array_equal(row, transition["observation"])
            np.testing.assert_array_equal(following, transition["next_observation"])


def test_demonstrations_among_moving_obstacles_cannot_have_observations_of_the_scene():
    class Demos(list):
        scenes, task = [MOVING], "a task"

    for options in (
        {"encoder": "oracle"},
        {"append_link_distances": True, "link_distances": True, "geometry_source": "ground_truth"},
    ):
        env = envs.make(MOVING, **options)
        with pytest.raises(DatasetError, match="among moving obstacles"):
            load_demos_for(env, (), "wall")
        env.close()
    with pytest.raises(ValueError, match="among moving obstacles"):
        oracle.encode_demos(Demos([None]))


def test_appended_link_distances_in_observations_buffer_and_demonstrations():
    arguments = {"encoder": "oracle", "append_link_distances": True}
    env = envs.make(HARD, **arguments, link_distances=True, geometry_source="ground_truth")
    env.reset(seed=0)
    sac = load("sac_her_mp")
    buffer = sac.HerReplayBuffer(env, 60, sac.Args(her_probability=0.0), np.random.default_rng(0))
    episode = steps(env, 10)
    buffer.add_episode(episode)
    observations = np.stack([one["observation"] for one in episode])
    near = env.link_distances_at(observations[:, :7])
    np.testing.assert_array_equal(observations[:, 10:90], near.reshape(10, 80))
    np.testing.assert_array_equal(observations[0, 90:], oracle(env.unwrapped.scene))
    rows = {row.tobytes() for row in observations}
    assert {row.tobytes() for row in buffer.sample(100)["observation"]} == rows
    demo = load_demos(HARD)[7]  # in another scene than the environment's
    transitions = demo_transitions(demo, env)
    env.reset_specific(demo.start, demo.goal, demo.scene)
    for i, one in enumerate(transitions):
        near = env.link_distances_at(demo.states[i]).ravel()
        np.testing.assert_allclose(one["observation"][10:90], near, atol=1e-6)
        np.testing.assert_array_equal(one["observation"][90:], oracle(demo.scene))
    env.close()


@pytest.mark.parametrize("trainer", ["sac_her_mp", "bc"])
def test_policy_with_an_encoder_is_trained_and_evaluated(
    trainer, tmp_path, short_episodes, few_demos
):
    flags = ["--task", HARD, "--encoder", "oracle", "--num-hidden-layers", "4"]
    flags += ["--goal-type", "combined", "--demos", few_demos, "--eval-queries", "1"]
    if trainer == "sac_her_mp":
        flags += ["--demo-prob", "1", "--geometry-source", "ground_truth", "--link-distances"]
        flags += ["--learning-starts", "60", "--eval-every", "150", "--total-timesteps", "150"]
    run = run_script(trainer, tmp_path, *flags)
    trained = load_network(run / "policy.onnx").metadata["env"]
    assert trained["encoder"] == "oracle"
    result = roboarm_nmp.evaluate(run, HARD, num_queries=2)
    assert result["goal_type"] == "combined" and result["privileged"]
    assert trained.get("append_link_distances", False) == (trainer != "bc")
