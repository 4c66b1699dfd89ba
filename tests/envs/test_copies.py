"""Copies of environments, wrappers and planners: independent, with the same future."""

import copy
import gc
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.envs.perception.sensors import Camera, PointCloud
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.wrappers import SensorWrapper
from roboarm_nmp.planning.planner import Planner
from roboarm_nmp.utils.bullet import pybullet as p

HOME = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.8], dtype=np.float32)


def make_copy(env):
    return pickle.loads(pickle.dumps(env))


def leaves(value):
    """All arrays of an observation as bytes, keys included."""
    if isinstance(value, dict):
        return [(name, leaves(part)) for name, part in value.items()]
    return value.tobytes()


def contacts(env):
    """Links, points, distances and forces of the arm's contacts; not the numbers of the bodies."""
    env = env.unwrapped
    points = p.getContactPoints(bodyA=env.body, physicsClientId=env.client)
    return [point[3:] for point in points]


def play(env, steps, seed):
    """Everything that steps return, bit for bit, over the ends of episodes."""
    rng, record = np.random.default_rng(seed), []
    for step in range(steps):
        if step % 15 == 0:
            direction = rng.normal(size=7)
        observation, reward, terminated, truncated, info = env.step(direction)
        record.append((leaves(observation), reward, terminated, truncated, info, contacts(env)))
        if terminated or truncated:
            record.append(leaves(env.reset()[0]))
    return record


@pytest.mark.parametrize(
    "copied, task, arguments",
    [
        (copy.deepcopy, "random_boxes_hard", {"render_mode": "rgb_array"}),
        (make_copy, "wall", {"stop_on_collision": True, "sink_state": True}),
        (
            make_copy,
            "random_boxes_easy",
            {"link_distances": True, "geometry_source": "ground_truth", "goal_type": "combined"},
        ),
    ],
)
def test_copy_in_an_episode_has_the_same_future_bit_for_bit(copied, task, arguments):
    """Also in contact, after other scenes, over the episode's end, and of a copy."""
    in_contact = 0
    for seed in range(2):
        env = envs.make(task, horizon=100, **arguments)
        env.reset(seed=seed)
        env.reset()
        direction = np.random.default_rng(seed).normal(size=7)
        for _ in range(80):
            env.step(direction)
            if contacts(env):
                break
        in_contact += len(contacts(env))
        twin = copied(env)
        triplet = copied(twin)
        assert contacts(twin) == contacts(env)
        expected = play(env, 90, seed + 10)
        assert play(twin, 90, seed + 10) == expected
        if "render_mode" in arguments:
            np.testing.assert_array_equal(twin.render(), env.render())
        del twin
        gc.collect()
        assert play(triplet, 90, seed + 10) == expected
        triplet.close()
        env.step(np.zeros(7))  # still open
        env.close()
    assert in_contact


def test_copy_and_original_do_not_move_each_other():
    env = envs.make("wall")
    env.reset(seed=0)
    twin = make_copy(env)
    before = env.world.read_arm()[0]
    for _ in range(5):
        twin.step(np.ones(7))
    np.testing.assert_array_equal(env.world.read_arm()[0], before)
    assert env.client != twin.client
    twin.set_scene(Scene())
    assert env.scene == envs.TASKS["wall"].scene
    env.close()
    assert twin.reset(seed=1)[0]["observation"].shape == (10,)
    twin.close()


def test_copy_of_a_fresh_environment_resets_the_same():
    env = envs.make("random_boxes_medium")
    twin = make_copy(env)
    with pytest.raises(RuntimeError, match="no episode"):
        twin.step(np.zeros(7))
    for _ in range(2):  # although neither was seeded
        assert leaves(twin.reset()[0]) == leaves(env.reset()[0])
        np.testing.assert_array_equal(twin.action_space.sample(), env.action_space.sample())


def test_unpickled_environment_in_another_process_has_its_own_world(tmp_path):
    """Not the world that happens to have the same number there."""
    env = envs.make("double_walls")
    env.reset(seed=3)
    play(env, 30, 0)
    (tmp_path / "env.pickle").write_bytes(pickle.dumps(env))
    code = (
        "import pickle, sys; import numpy as np; from roboarm_nmp import envs\n"
        "others = [envs.make('narrow_shelves') for _ in range(3)]\n"
        "for other in others: other.reset(seed=0)\n"
        "env = pickle.load(open(sys.argv[1], 'rb'))\n"
        "print(env.step(np.ones(7))[0]['observation'].tobytes().hex())\n"
        "print([other.client for other in others].count(env.client))"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "env.pickle")]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert output[-2:] == [env.step(np.ones(7))[0]["observation"].tobytes().hex(), "0"]


@pytest.mark.parametrize("every_step", [False, True])
def test_sensor_wrapper_and_its_copy_observe_the_same(every_step):
    sensors = {
        "camera": Camera((1.6, 0.0, 0.8), size=(16, 16)),
        "cloud": PointCloud((0.0, 1.6, 0.8), num_samples=64),
    }
    env = SensorWrapper(
        envs.make("random_boxes_hard", horizon=20), sensors, 1 if every_step else None
    )
    env.reset(seed=0)
    play(env, 10, 0)
    twin = make_copy(env)
    assert play(twin, 25, 1) == play(env, 25, 1)
    env.close()
    twin.step(np.zeros(7))
    twin.close()


def test_gymnasiums_wrappers_and_vector_envs_are_copied():
    env = gym.make("RoboArmNMP/Wall-v0", max_episode_steps=20)
    env.reset(seed=0)
    play(env, 15, 0)
    twin = make_copy(env)
    assert play(twin, 25, 1) == play(env, 25, 1)
    vector = gym.vector.SyncVectorEnv([lambda: gym.make("RoboArmNMP/Boxes-v0")] * 2)
    vector.reset(seed=0)
    twins, actions = copy.deepcopy(vector), np.ones((2, 7), np.float32)
    for _ in range(5):
        assert leaves(vector.step(actions)[0]) == leaves(twins.step(actions)[0])


def test_planner_and_its_copy_plan_the_same():
    env = envs.make("double_walls")
    start, goal = env.sample_query(np.random.default_rng(0))
    planner = Planner(env)
    twin = make_copy(planner)
    path = planner.plan(start, goal, seed=3)
    env.close()
    np.testing.assert_array_equal(twin.plan(start, goal, seed=3), path)
    assert twin.env is not env
