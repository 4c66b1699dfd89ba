"""The environment with moving obstacles: poses, contacts, time, replays and copies."""

import copy
import math
import pickle

import numpy as np
import pytest

from roboarm_nmp.envs import RoboArmEnv, make
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.geometry_source import ground_truth_checker
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.scenes.motions import Oscillation, Presence, Waypoints
from roboarm_nmp.envs.scenes.primitives import Box, Scene, Sphere
from roboarm_nmp.envs.wrappers import LinkDistancesWrapper
from roboarm_nmp.utils.bullet import pybullet as p

START = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], np.float32)  # the hand ahead
GOAL = np.array([1.2, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], np.float32)
HAND = (0.3, 0.0, 0.55)
ACROSS = Waypoints((0.2, 1.0), ((0, 0, 0), (0, 0.4, 0)))  # 0.5 m/s, through the hand
PUSHING = Box((0.307, -0.3, 0.55), (0.1, 0.1, 0.1), motion=ACROSS)
SWINGING = Box(
    (0.6, 0.3, 0.6), (0.1, 0.3, 0.05), motion=Oscillation((0.0, 0.3, 0.1), 1.5, angle=0.6)
)
LATE = Sphere((-0.4, 0.3, 0.5), 0.1, Presence(((0.5, 1.0),)))
SCENE = Scene((PUSHING, SWINGING, LATE, Box((-0.5, 0, 0.3), (0.1, 0.1, 0.6))))


def poses(env):
    """Position and orientation of the obstacles' bodies in PyBullet."""
    count = len(env.scene.obstacles)
    return [
        p.getBasePositionAndOrientation(body, physicsClientId=env.client)
        for body in env.world._bodies[-count:]
    ]


def states_of(env, actions):
    """The arm's normalised configurations, with contacts, of an episode from its start."""
    found = []
    for action in actions:
        observation, *_, info = env.step(action)
        found.append((*observation["observation"], info["collision"]))
    return np.array(found)


def test_bodies_are_where_the_scene_says_at_every_step():
    env = RoboArmEnv(SCENE)
    env.reset_specific(START, GOAL)
    for step in range(45):
        assert env.time == step * STEP_SECONDS
        assert env.current_scene == SCENE.at(env.time)
        found = poses(env)
        if not SCENE.obstacles[2].motion.is_present(env.time):
            assert found.pop(2)[0][2] < -1000
        for (position, orientation), obstacle in zip(
            found, env.current_scene.obstacles, strict=True
        ):
            np.testing.assert_allclose(position, obstacle.position, atol=1e-9)
            if isinstance(obstacle, Box):
                np.testing.assert_allclose(orientation, obstacle.orientation, atol=1e-9)
        env.step(np.zeros(7))
    env.reset_specific(START, GOAL)
    assert env.time == 0
    np.testing.assert_allclose(poses(env)[0][0], PUSHING.position)


def test_moving_obstacle_pushes_the_arm():
    """Without a velocity in its contacts, it would enter the arm by several centimetres."""
    env = RoboArmEnv(Scene((PUSHING,)))
    env.reset_specific(START, GOAL)
    collisions, depth = [], 0.0
    for _ in range(40):
        observation, *_, info = env.step(np.zeros(7))
        collisions.append(info["collision"])
        contacts = p.getContactPoints(env.body, env.world._bodies[-1], physicsClientId=env.client)
        depth = min([depth, *(contact[8] for contact in contacts)])
    assert not any(collisions[:5]) and any(collisions)
    assert observation["observation"][8] > 0.1  # the end effector's y, 0 at first
    assert depth > -0.005


def test_replays_and_copies_are_exact():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (60, 7))
    env = RoboArmEnv(SCENE)
    env.reset_specific(START, GOAL)
    first = states_of(env, actions)
    assert first[:, -1].any()
    env.reset(seed=3)
    states_of(env, actions[:10])
    env.reset_specific(START, GOAL)
    half = states_of(env, actions[:25])
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for one in (env, *copies):
        assert one.time == 25 * STEP_SECONDS
        assert one.current_scene == SCENE.at(one.time)
        np.testing.assert_array_equal(np.concatenate([half, states_of(one, actions[25:])]), first)
        one.close()
    other = RoboArmEnv(SCENE)
    other.reset_specific(START, GOAL)
    np.testing.assert_array_equal(states_of(other, actions), first)


def test_obstacle_in_the_arm_at_the_start_is_rejected():
    on_hand = Box(HAND, (0.1, 0.1, 0.1), motion=Oscillation((0, 0.3, 0), 2.0))
    env = RoboArmEnv(Scene((SWINGING, on_hand)))
    with pytest.raises(ValueError, match="start is in collision: the arm with obstacle 1"):
        env.reset_specific(START, GOAL)
    later = Box(HAND, (0.1, 0.1, 0.1), motion=Presence(((1.0, 2.0),)))
    RoboArmEnv(Scene((later,))).reset_specific(START, GOAL)


def test_goal_may_be_occupied_by_what_moves():
    at_goal = env_goal_position()
    moving = Box(at_goal, (0.1, 0.1, 0.1), motion=Presence(((0.0, 1.0),)))
    env = RoboArmEnv(Scene((moving,)), goal_type="combined")
    env.reset_specific(START, GOAL)
    assert env.in_collision(GOAL) and not env.in_collision(GOAL, time=1.0)
    assert not env.in_collision(GOAL, moving=False)
    with pytest.raises(ValueError, match="goal is in collision: the arm with obstacle 0"):
        env.reset_specific(START, GOAL, Scene((Box(at_goal, (0.1, 0.1, 0.1)),)))


def env_goal_position():
    env = RoboArmEnv()
    return tuple(env.robot.forward_kinematics(GOAL).tolist())


def test_link_distances_are_those_of_the_moment():
    env = LinkDistancesWrapper(RoboArmEnv(SCENE, goal_type="combined"), ground_truth_checker)
    observation, _ = env.reset_specific(START, GOAL)
    seen = []
    for _ in range(30):
        checker = CollisionChecker(SCENE.at(env.unwrapped.time))
        state = observation["observation"][:7]
        np.testing.assert_array_equal(observation["link_distances"], checker.link_distances(state))
        at_goal = checker.link_distances(observation["desired_goal"][:7])
        np.testing.assert_array_equal(observation["goal_link_distances"], at_goal)
        seen.append(at_goal)
        observation, *_ = env.step(np.zeros(7))
    assert not np.array_equal(seen[0], seen[-1])


def test_checker_of_a_moving_scene_is_rejected():
    with pytest.raises(ValueError, match=r"scene\.at\(t\)"):
        CollisionChecker(SCENE)


def test_static_environments_have_a_time_too():
    env = make("wall")
    env.reset(seed=0)
    env.step(np.zeros(7))
    assert env.time == STEP_SECONDS and env.current_scene is env.scene
    assert math.isclose(STEP_SECONDS, 1 / env.metadata["render_fps"])
