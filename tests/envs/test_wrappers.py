"""Wrappers: options, copies of attributes, and what hindsight relabelling does to observations."""

import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from paths import ROOT
from stable_baselines3 import SAC, HerReplayBuffer

from roboarm_nmp import envs
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.encoders import OracleEncoder
from roboarm_nmp.envs.perception.geometry_source import ground_truth_checker
from roboarm_nmp.envs.perception.sensors import Camera
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.envs.wrappers import LinkDistancesWrapper, SceneEncodingWrapper, SensorWrapper

HOME = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.8], dtype=np.float32)
NEAR_HOME = HOME + np.float32(0.1)
SHELF = Scene((Box((0.6, 0.0, 0.9), (0.3, 0.3, 0.03)),))
CAMERA = {"camera": Camera((1.6, 0.0, 0.8), size=(8, 8))}
DISTANCES = {"link_distances": True, "geometry_source": "ground_truth", "goal_type": "combined"}


def all_wrappers():
    """This package's wrappers around one of Gymnasium's, a time limit."""
    env = gym.wrappers.TimeLimit(envs.make("no_obstacles", goal_type="combined"), 8)
    env = LinkDistancesWrapper(SceneEncodingWrapper(env, OracleEncoder()), ground_truth_checker)
    return SensorWrapper(env, CAMERA)


def test_options_and_reset_specific_pass_through_all_wrappers():
    expected = CollisionChecker(SHELF).link_distances(PANDA.normalise(HOME))
    for begin in (
        lambda env: env.reset(options={"start": HOME, "goal": NEAR_HOME, "scene": SHELF}),
        lambda env: env.reset_specific(HOME, NEAR_HOME, SHELF),
    ):
        env = all_wrappers()
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.zeros(7))
        observation, info = begin(env)
        assert info["elapsed_steps"] == 0 and env.unwrapped.scene == SHELF
        np.testing.assert_allclose(observation["link_distances"], expected, atol=1e-5)
        assert observation["observation"][10] == 1.0  # the shelf, of the oracle
        assert observation["sensors"]["camera"]["rgb"].std() > 0
        truncated = [env.step(np.zeros(7))[3] for _ in range(8)]
        assert truncated == [False] * 7 + [True]
        with pytest.raises(ValueError, match=r"unknown options \['stat'\]"):
            env.reset(options={"stat": HOME, "goal": NEAR_HOME})
        env.close()


def test_wrappers_have_the_attributes_of_the_environment_and_no_others():
    env = envs.make("wall", encoder="oracle", **DISTANCES)
    assert env.goal_type == "combined" and env.encoder.name == "oracle" and env.horizon == 400
    assert env.client == env.unwrapped.client
    with pytest.raises(AttributeError):
        env.no_such_attribute  # noqa: B018
    assert not hasattr(env, "__no_such_method__")
    env.close()


def test_link_distances_have_a_row_per_link():
    env = envs.make("wall", append_link_distances=True, **DISTANCES)
    shape = (len(PANDA.collision_links), 1 + PANDA.num_joints)
    assert shape == PANDA.link_distances_shape == (10, 8)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert observation["link_distances"].shape == shape
    assert observation["observation"].shape == (10 + 80,)
    np.testing.assert_array_equal(
        observation["observation"][10:], observation["link_distances"].ravel()
    )
    expected = CollisionChecker(env.scene).link_distances(PANDA.normalise(env.goal_configuration))
    np.testing.assert_allclose(observation["goal_link_distances"], expected, atol=1e-4)
    env.close()


# --- Hindsight relabelling


def shares_of_wrong_samples(env, replay_buffer_class):
    """Of relabelled and other samples, those whose `goal_link_distances` are of another goal."""
    kind = {"replay_buffer_class": replay_buffer_class, "learning_starts": 200, "seed": 0}
    model = SAC("MultiInputPolicy", env, **kind)
    model.learn(150)
    sample = model.replay_buffer.sample(200)
    shares = []
    for observations in (sample.observations, sample.next_observations):
        keys = {key: value.numpy() for key, value in observations.items()}
        truth = env.get_wrapper_attr("link_distances_at")(keys["desired_goal"][:, :7])
        wrong = np.abs(truth - keys["goal_link_distances"].reshape(truth.shape)) > 1e-4
        shares.append(wrong.any((1, 2)).mean())
    return shares


def make_env(**arguments):
    return gym.make("RoboArmNMP/Wall-v0", horizon=20, **DISTANCES, **arguments)


def documented_buffer():
    """The class in docs/guide/environment.md."""
    text = (ROOT / "docs/guide/environment.md").read_text()
    code = re.search(r"```python\n(import warnings\n.*?)```", text, re.S)[1]
    namespace = {"HerReplayBuffer": HerReplayBuffer}
    exec(code, namespace)
    return namespace["LinkDistancesHerReplayBuffer"]


def test_relabelling_without_a_remedy_warns_because_goal_link_distances_are_wrong():
    with pytest.warns(UserWarning, match="goal_link_distances belong to another goal"):
        shares = shares_of_wrong_samples(make_env(), HerReplayBuffer)
    assert min(shares) > 0.5


def test_documented_replay_buffer_has_no_wrong_sample():
    with warnings.catch_warnings():
        buffer = documented_buffer()
        assert shares_of_wrong_samples(make_env(), buffer) == [0.0, 0.0]


def test_relabelling_without_goal_link_distances_is_right_and_does_not_warn():
    env = make_env(goal_link_distances=False)
    assert "goal_link_distances" not in env.observation_space.spaces
    assert "link_distances" in env.observation_space.spaces
    model = SAC(
        "MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, learning_starts=200, seed=0
    )
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*goal_link_distances")
        model.learn(50)
        observations = model.replay_buffer.sample(50).observations
    states = observations["observation"][:, :7].numpy()
    truth = env.link_distances_at(states).reshape(50, -1)
    np.testing.assert_allclose(observations["link_distances"].reshape(50, -1), truth, atol=1e-4)
