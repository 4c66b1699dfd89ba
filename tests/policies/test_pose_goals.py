"""The goal type `pose`, against SciPy's rotations; policies and evaluations with it."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import roboarm_nmp
from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.episodes import demo_episode
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.robots.inverse_kinematics import inverse_kinematics
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.policies.registry import PolicyError, make_policy, policy_file
from roboarm_nmp.training.network_parts import pose_difference

HOME = np.array([0.0, -0.5, 0.0, -1.8, 0.0, 1.5, 0.8], np.float32)
NEAR_HOME = HOME + np.float32(0.05)


@pytest.fixture(scope="module")
def env():
    env = envs.make("no_obstacles", goal_type="pose", velocities=True)
    yield env
    env.close()


def turned(pose, rotation):
    return np.r_[pose[:3], (rotation * Rotation.from_quat(pose[3:])).as_quat()]


def test_observations_have_the_pose_of_the_end_effector(env):
    observation, info = env.reset_specific(HOME, NEAR_HOME)
    assert observation["observation"].shape == env.observation_space["observation"].shape == (21,)
    for key, configuration in (("achieved_goal", HOME), ("desired_goal", NEAR_HOME)):
        expected = PANDA.end_effector_pose(configuration)
        np.testing.assert_allclose(observation[key], expected, atol=1e-6)
    np.testing.assert_array_equal(observation["observation"][-7:], observation["achieved_goal"])
    here, there = (Rotation.from_quat(PANDA.end_effector_pose(c)[3:]) for c in (HOME, NEAR_HOME))
    assert info["ee_angle"] == pytest.approx((here * there.inv()).magnitude(), abs=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_goal_is_reached_within_a_distance_and_an_angle(env, sign):
    goal = PANDA.end_effector_pose(HOME)
    turns = Rotation.random(6, random_state=1).as_rotvec()
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    achieved = np.array(
        [
            turned(goal, Rotation.from_rotvec(angle * axis))
            for angle, axis in zip((0.0, 0.099, 0.101, 3.0, 0.05, 0.05), turns, strict=True)
        ]
    )
    achieved[4:, 0] += 0.019, 0.021
    achieved[:, 3:] *= sign  # the same rotations
    goals = np.tile(goal, (3, 2, 1)).astype(np.float32)
    achieved = achieved.reshape(3, 2, 7).astype(np.float32)
    expected = [[True, True], [False, False], [True, False]]
    info = {"elapsed_steps": np.full((3, 2), 400)}
    np.testing.assert_array_equal(env.compute_reward(achieved, goals, {}), np.float32(expected) - 1)
    np.testing.assert_array_equal(env.compute_terminated(achieved, goals, {}), expected)
    np.testing.assert_array_equal(env.compute_truncated(achieved, goals, info), ~np.array(expected))
    assert isinstance(env.compute_reward(achieved[0, 0], goals[0, 0], {}), np.floating)


def test_episode_of_a_goal_pose_ends_there():
    env = roboarm_nmp.make("no_obstacles", goal_type="pose")
    pose = PANDA.end_effector_pose(NEAR_HOME)
    given = {"start": HOME, "goal_pose": np.r_[pose[:3], -3.0 * pose[3:]]}
    observation, info = env.reset(options=given)
    np.testing.assert_allclose(observation["desired_goal"], pose, atol=1e-6)
    assert env.goal_configuration is None and np.isnan(info["config_distance"])
    goal = PANDA.normalise(inverse_kinematics(PANDA, pose, near=HOME)[0])
    terminated = False
    while not terminated:
        observation, reward, terminated, truncated, info = env.step(
            goal - observation["observation"][:7]
        )
        pair = observation["achieved_goal"], observation["desired_goal"]
        assert reward == env.compute_reward(*pair, info) and not truncated
        assert terminated == info["is_success"] == env.compute_terminated(*pair, info)
        assert info["is_success"] == (info["ee_distance"] <= 0.02 and info["ee_angle"] <= 0.1)
    env.close()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"goal_pose": np.ones(6)}, "goal_pose must have 7 numbers"),
        ({"goal_pose": [0.4, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0]}, "its quaternion is zero"),
        ({"goal_pose": np.ones(7), "goal": HOME}, "either goal or goal_pose"),
    ],
)
def test_bad_goal_pose_is_rejected_and_the_episode_goes_on(env, given, message):
    env.reset_specific(HOME, NEAR_HOME)
    with pytest.raises(ValueError, match=message):
        env.reset_specific(**{"start": HOME} | given)
    assert env.step(np.zeros(7))[-1]["elapsed_steps"] == 1


def test_goal_pose_reaches_the_environment_through_wrappers_copies_and_vector_environments():
    pose = PANDA.end_effector_pose(NEAR_HOME)
    arguments = {"geometry_source": "ground_truth", "link_distances": True, "encoder": "oracle"}
    env = envs.make("random_boxes_easy", goal_type="pose", **arguments)
    scene = env.unwrapped.scene
    observation, _ = env.reset_specific(HOME, scene=scene, goal_pose=pose)
    np.testing.assert_allclose(observation["desired_goal"], pose, atol=1e-6)
    assert "goal_link_distances" not in observation
    other = copy.deepcopy(env)
    for _ in range(3):
        results = [one.step(np.full(7, 0.01)) for one in (env, other)]
        np.testing.assert_array_equal(*(result[0]["observation"] for result in results))
        assert results[0][4]["ee_angle"] == results[1][4]["ee_angle"]
    env.close()
    vector = gym.make_vec(
        "RoboArmNMP/NoObstacles-v0", 2, vectorization_mode="sync", goal_type="pose"
    )
    observations, _ = vector.reset(options={"start": HOME, "goal_pose": pose})
    np.testing.assert_allclose(observations["desired_goal"], [pose, pose], atol=1e-6)
    vector.close()


def test_demonstration_is_an_episode_of_goal_poses():
    demo = load_demos("wall")[0]
    env = envs.make("wall", goal_type="pose")
    episode = demo_episode(demo, env)
    observation, _ = env.reset_specific(demo.start, demo.goal)
    np.testing.assert_allclose(episode.desired_goal, observation["desired_goal"], atol=1e-5)
    np.testing.assert_allclose(episode.observation[0], observation["observation"], atol=1e-5)
    assert episode.reached[-1] and not episode.reached[:-1].any()
    env.close()


def test_pose_difference_is_that_of_scipy():
    here, there = (Rotation.random(200, random_state=seed) for seed in (1, 2))
    positions = np.random.default_rng(0).normal(size=(2, 200, 3))
    poses = [
        torch.tensor(np.hstack([position, sign * rotation.as_quat()]))
        for position, rotation, sign in zip(positions, (here, there), (1.0, -1.0), strict=True)
    ]
    vectors = (there * here.inv()).as_rotvec()
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    expected = np.hstack([positions[1] - positions[0], vectors / angles * np.sin(angles / 2)])
    np.testing.assert_allclose(pose_difference(*poses).numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("policy", ["go-to-goal", "via-points", "planner"])
def test_baseline_reaches_goal_poses(policy):
    if policy == "planner":
        pytest.importorskip("ompl")
    env = envs.make("wall", goal_type="pose")
    begin, reached = make_policy(policy, env), 0
    for number, query in enumerate(load_queries("wall", "validation")[:3]):
        act, plan_found, _ = begin(number, query)
        trajectory = rollout(env, query, act)
        reached += trajectory.success
        if policy == "planner":
            assert plan_found and trajectory.success and not trajectory.collides
    assert reached >= 2
    env.close()


def test_policy_for_configurations_reaches_goal_poses():
    options = {"goal_type": "pose", "split": "validation", "num_queries": 6}
    result = roboarm_nmp.evaluate("bc-combined-no_obstacles-s1", "no_obstacles", **options)
    assert result["goal_type"] == "pose" and result["success_rate"] > 0.5


def test_policy_for_positions_is_rejected_for_goal_poses():
    with pytest.raises(ValueError, match="trained with the goal type 'ee'"):
        roboarm_nmp.evaluate("sac-ee-wall-p1-s1", "wall", goal_type="pose", num_queries=1)
    env = envs.make("wall", goal_type="pose")
    with pytest.raises(PolicyError, match="sac-ee-wall-p1-s1"):
        make_policy(policy_file("sac-ee-wall-p1-s1"), env)
    env.close()
