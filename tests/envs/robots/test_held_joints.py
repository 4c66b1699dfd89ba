"""Held joints, such as the gripper's, elsewhere: body, checks, episodes and files follow."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from roboarm_nmp.envs import RoboArmEnv
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.metadata import check_robot
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.variants import with_held
from roboarm_nmp.envs.scenes.files import load_scene, save_scene
from roboarm_nmp.envs.scenes.primitives import Box, Scene, scene_from_json, scene_to_json
from roboarm_nmp.envs.scenes.random_boxes import RandomBoxes
from roboarm_nmp.envs.world import World
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.utils.documents import DocumentError

FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
OPEN = with_held(PANDA, dict.fromkeys(FINGERS, 0.065))  # wider than the URDF's limit, 0.04
START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8])
GOAL = np.array([0.6, -0.3, 0.1, -1.8, 0.1, 1.5, 0.6])


def test_arm_as_described_is_the_same_object_and_keeps_its_fingerprint():
    assert with_held(PANDA, {}) is PANDA and with_held(OPEN, PANDA.held) is PANDA
    assert PANDA.held == dict.fromkeys(FINGERS, 0.04)
    assert PANDA.fingerprint.startswith("026faa3f2a77")
    assert OPEN != PANDA and OPEN.same_arm(PANDA) and PANDA.same_arm(OPEN)
    check_robot("policy.onnx", {}, OPEN)


def test_joint_that_mimics_another_one_follows_it_unless_it_is_named():
    assert with_held(PANDA, {FINGERS[0]: 0.065}) == OPEN
    one = with_held(PANDA, {FINGERS[0]: 0.03, FINGERS[1]: 0.01})
    assert one.held == {FINGERS[0]: 0.03, FINGERS[1]: 0.01}


@pytest.mark.parametrize("opening", [0.065, 0.0])
def test_compiled_checks_agree_with_pybullet(opening):
    robot, rng, free = with_held(PANDA, {FINGERS[0]: opening}), np.random.default_rng(0), 0
    for _ in range(2):
        scene = replace(RandomBoxes(4, 8).sample(rng), robot=robot)
        world, states = World(scene, drawn=False), rng.uniform(-1, 1, (100, 7))
        expected = [not world.in_collision(robot.denormalise(s).tolist()) for s in states]
        np.testing.assert_array_equal(CollisionChecker(scene).is_free(states), expected)
        free += sum(expected)
        world.close()
    assert 25 < free < 175


def test_fingers_are_held_beyond_their_limit_while_the_arm_moves():
    world = World(Scene(robot=OPEN), drawn=False)
    world.place(START)
    for share in np.linspace(0, 1, 40):
        world.command((START + share * (GOAL - START)).tolist())
        world.simulate()
    fingers = p.getJointStates(world.body, OPEN.held_indices, physicsClientId=world.client)
    np.testing.assert_allclose([finger[0] for finger in fingers], 0.065, atol=5e-4)
    world.close()


def episode(env, scene):
    observation, _ = env.reset_specific(START, GOAL, scene)
    states = [observation["observation"]]
    for _ in range(30):
        action = PANDA.normalise(GOAL) - states[-1][:7]
        states.append(env.step(action)[0]["observation"])
    return np.array(states)


def test_episode_after_a_change_of_the_gripper_is_that_of_a_new_environment():
    narrow, wide = Scene(), Scene((Box((0.5, 0.5, 0.3), (0.1, 0.1, 0.1)),), robot=OPEN)
    fresh, env = RoboArmEnv(wide), RoboArmEnv(narrow)
    expected, before = episode(fresh, wide), episode(env, narrow)
    for _ in range(2):
        np.testing.assert_array_equal(episode(env, wide), expected)
        assert env.robot == OPEN
        np.testing.assert_array_equal(episode(env, narrow), before)
    assert not np.array_equal(before, expected)
    env.reset_specific(START, GOAL, wide)
    other = copy.deepcopy(env)
    assert other.robot == OPEN
    action = np.full(7, 0.01)
    for _ in range(5):
        one, two = env.step(action)[0], other.step(action)[0]
        np.testing.assert_array_equal(one["observation"], two["observation"])


def test_scene_of_another_arm_is_rejected():
    other = replace(PANDA, name="other")
    env = RoboArmEnv()
    with pytest.raises(ValueError, match="the scene's robot is 'other', not 'panda'"):
        env.set_scene(Scene(robot=other))


def test_scene_files_keep_the_opening(tmp_path):
    scene = Scene((Box((0.5, 0, 0.3), (0.1, 0.1, 0.1)),), robot=OPEN)
    save_scene(scene, tmp_path / "a.yaml")
    assert load_scene(tmp_path / "a.yaml") == scene
    assert scene_from_json(scene_to_json(scene)) == scene
    assert "held" not in scene_to_json(Scene())
    (tmp_path / "b.yaml").write_text("held: {panda_finger_joint1: 0.065}")
    assert load_scene(tmp_path / "b.yaml").robot == OPEN
    (tmp_path / "c.yaml").write_text("floor: 0\nheld: {thumb: 0.065}")
    with pytest.raises(DocumentError, match="c.yaml:2: unknown key thumb in held"):
        load_scene(tmp_path / "c.yaml")


@pytest.mark.parametrize(
    ("positions", "reason"),
    [
        ({"thumb": 0.1}, "'thumb' is no held joint; those are panda_finger_joint1, panda_finger_j"),
        ({FINGERS[0]: float("nan")}, "panda_finger_joint1 cannot be held at nan"),
    ],
)
def test_positions_that_cannot_be_are_rejected(positions, reason):
    with pytest.raises(ValueError, match=reason):
        with_held(PANDA, positions)
