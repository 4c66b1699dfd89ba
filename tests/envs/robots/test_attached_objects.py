"""Objects attached to the arm: body, checks, distances, planning and files have them as links."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.problem_formats import Problem
from roboarm_nmp.datasets.problems import load_problems, write_problems
from roboarm_nmp.envs.collision.checker import ARM, CollisionChecker
from roboarm_nmp.envs.following import follow
from roboarm_nmp.envs.perception.sensors import OBSTACLE, ROBOT, Camera, PointCloud, SensorWorld
from roboarm_nmp.envs.robots.metadata import check_robot
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.variants import with_attached, with_held
from roboarm_nmp.envs.scenes.files import load_scene, save_scene
from roboarm_nmp.envs.scenes.motions import Oscillation
from roboarm_nmp.envs.scenes.primitives import (
    Attached,
    Box,
    Cylinder,
    Scene,
    Sphere,
    convex_hull,
    scene_from_json,
    scene_to_json,
)
from roboarm_nmp.envs.scenes.random_boxes import RandomBoxes
from roboarm_nmp.envs.world import World
from roboarm_nmp.planning.planner import Planner
from roboarm_nmp.utils.documents import DocumentError

TURN = (0.3, -0.1, 0.4, np.sqrt(0.74))
BOARD = Attached(Box((0.0, 0.0, 0.05), (0.06, 0.1, 0.2), TURN))
POINTS = np.random.default_rng(1).uniform(-0.06, 0.06, (30, 3))
ROCK = Attached(convex_hull(POINTS, (0.02, 0.01, 0.12), TURN), "panda_hand")
# A box, a hull, a cylinder and a sphere, on links before and behind others in PyBullet's order.
MANY = (
    Attached(Box((0.1, 0.0, -0.1), (0.1, 0.1, 0.1), TURN), "panda_link5"),
    Attached(Sphere((0.0, 0.0, 0.08), 0.05), "panda_leftfinger"),
    Attached(Cylinder((0.0, 0.05, 0.1), 0.03, 0.3, TURN)),
    ROCK,
)
START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8], np.float32)
GOAL = np.array([0.6, -0.3, 0.1, -1.8, 0.1, 1.5, 0.6], np.float32)


def test_arm_without_objects_is_the_same_object_and_keeps_its_fingerprint():
    carrying = with_attached(PANDA, [BOARD])
    assert with_attached(PANDA, []) is PANDA and with_attached(carrying, ()) is PANDA
    assert PANDA.fingerprint.startswith("026faa3f2a77")
    assert carrying != PANDA and carrying.same_arm(PANDA) and carrying.arm is PANDA
    assert carrying == with_attached(PANDA, [BOARD]) == pickle.loads(pickle.dumps(carrying))
    assert carrying != with_attached(PANDA, [ROCK])
    assert carrying.collision_links == PANDA.collision_links
    check_robot("policy.onnx", {}, carrying)


def test_objects_stay_when_the_gripper_is_held_elsewhere():
    robot = with_held(with_attached(PANDA, [BOARD]), {"panda_finger_joint1": 0.01})
    assert robot.attached == with_attached(PANDA, [BOARD]).attached
    assert list(robot.held.values()) == [0.01] * 2
    assert robot == with_attached(with_held(PANDA, {"panda_finger_joint1": 0.01}), [BOARD])


def test_compiled_checks_agree_with_pybullet():
    robot, rng, free = with_attached(PANDA, MANY), np.random.default_rng(0), 0
    for i in range(3):
        scene = replace(RandomBoxes(2, 4).sample(rng), robot=robot)
        if i == 0:
            world = World(scene, drawn=False)
        world.set_scene(scene)
        states = rng.uniform(-1, 1, (100, 7))
        expected = [not world.in_collision(robot.denormalise(s).tolist()) for s in states]
        checker = CollisionChecker(scene)
        np.testing.assert_array_equal(checker.is_free(states), expected)
        distance = checker.signed_distances(states).distance.min(-1)
        np.testing.assert_array_equal(distance > 0, expected)
        free += sum(expected)
    world.close()
    assert 30 < free < 270


def test_distances_of_an_object_are_in_the_row_of_the_link_that_carries_it():
    position, rotation = PANDA.frame_poses(START)[6]
    below = position + 0.5 * rotation[:, 2]  # the fingertips are 0.21 m beyond joint 7
    ball = Sphere(tuple(below.tolist()), 0.02)
    rod = with_attached(PANDA, [Attached(Cylinder((0, 0, 0.1), 0.01, 0.2), "panda_hand")])
    state = PANDA.normalise(START.astype(np.float64))
    plain, carrying = (
        CollisionChecker(Scene((ball,), None, None, robot=robot)) for robot in (PANDA, rod)
    )
    before, after = (one.signed_distances(state, False) for one in (plain, carrying))
    hand = PANDA.collision_links.index(8)
    # The rod ends 0.107 + 0.2 m beyond joint 7, and is rounded by 1 mm.
    assert after.distance[hand] == pytest.approx(0.5 - 0.307 - 0.02 - 0.001, abs=2e-3)
    assert after.distance[hand] < before.distance[hand] - 0.05
    others = np.arange(10) != hand
    np.testing.assert_array_equal(after.distance[others], before.distance[others])
    for joint in range(7):
        step = np.eye(7)[joint] * 1e-5
        there, back = (
            carrying.signed_distances(state + s, False).distance[hand] for s in (step, -step)
        )
        assert after.gradient[hand, joint] == pytest.approx((there - back) / 2e-5, abs=1e-4)


def test_object_collides_with_links_that_move_against_it_except_touch_links():
    long = Box((0.0, 0.0, 0.2), (0.05, 0.05, 0.6))
    states = np.random.default_rng(0).uniform(-1, 1, (500, 7))

    def collisions(robot):
        return ~CollisionChecker(Scene(table=None, floor=None, robot=robot)).is_free(states)

    alone, names = collisions(PANDA), PANDA.link_names.values()
    carrying = collisions(with_attached(PANDA, [Attached(long)]))
    assert carrying[alone].all() and carrying.sum() > alone.sum() + 3
    touching = with_attached(PANDA, [Attached(long, touch_links=tuple(names))])
    np.testing.assert_array_equal(collisions(touching), alone)
    checker = CollisionChecker(Scene((), None, None, robot=with_attached(PANDA, [Attached(long)])))
    assert ARM in checker.signed_distances(states[carrying & ~alone][0]).geometry


def test_sensors_see_an_object_as_the_arm_and_no_points_of_it():
    position, rotation = PANDA.frame_poses(START)[6]
    place = position + 0.5 * rotation[:, 2]  # behind the fingertips
    camera = Camera(tuple(place + [0.0, 0.5, 0.1]), tuple(place), size=(64, 64))
    wall = Box((0.4, -0.5, 0.4), (1.0, 0.1, 0.8))  # behind the object
    seen, world = [], SensorWorld()
    for robot in (PANDA, with_attached(PANDA, [Attached(Box((0, 0, 0.3), (0.05, 0.05, 0.2)))])):
        world.show(Scene((wall,), robot=robot), START)
        depth, classes = world.cast(camera, camera.size)
        seen.append((classes[32, 32], depth[32, 32] < 0.5))
        sensor = PointCloud(camera.eye, camera.target)
        points = sensor.points_of_class(*world.cast(sensor, sensor.size), OBSTACLE)
        assert len(points) > 1000 and points[:, 1].max() < -0.449
    assert seen == [(OBSTACLE, False), (ROBOT, True)]
    world.close()


def test_plan_with_an_object_is_followed_without_contact():
    env = envs.make("wall")
    robot = with_attached(PANDA, [Attached(Box((0.0, 0.0, 0.15), (0.03, 0.2, 0.3)))])
    scene = replace(env.unwrapped.scene, robot=robot)
    start = np.array([1.2, -0.5, 0.0, -1.8, 0.0, 1.5, 0.0], np.float32)
    goal = np.array([-1.2, -0.3, 0.0, -1.8, 0.0, 1.7, 0.0], np.float32)
    path = Planner(env.unwrapped).plan(start, goal, scene, seed=0)
    run = follow(env.unwrapped, path, scene)
    assert run.reached and not run.collided and env.unwrapped.robot == robot
    env.close()


def test_files_keep_objects(tmp_path):
    held = with_held(PANDA, {"panda_finger_joint1": 0.02})
    for robot in (with_attached(PANDA, MANY), with_attached(held, [BOARD])):
        scene = Scene((Box((0.5, 0, 0.3), (0.1, 0.1, 0.1)),), robot=robot)
        save_scene(scene, tmp_path / "a.yaml")
        assert load_scene(tmp_path / "a.yaml") == scene
        assert scene_from_json(scene_to_json(scene)) == scene
        problem = Problem("a", START.astype(float), GOAL[None].astype(float), None, scene)
        write_problems(tmp_path / "problems.h5", [problem])
        assert load_problems(tmp_path / "problems.h5")[0].scene == scene
    assert "attached" not in scene_to_json(Scene()) and "held" in scene_to_json(scene)
    text = "attached:\n- box: {position: [0, 0, 0.1], size: [0.1, 0.1, 0.1], link: panda_hand}\n"
    (tmp_path / "b.yaml").write_text(text)
    expected = Attached(Box((0, 0, 0.1), (0.1, 0.1, 0.1)), "panda_hand")
    assert load_scene(tmp_path / "b.yaml").robot == with_attached(PANDA, [expected])


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ("link: thumb", "2: panda has no link 'thumb'"),
        ("link: panda_link0", "2: panda: 'panda_link0' does not move"),
        ("touch_links: 1", "2: touch_links must be a list of links' names, got 1"),
        ("may_touch: true", "2: unknown key may_touch in sphere"),
    ],
)
def test_mistake_in_a_file_is_rejected_with_its_line(fields, reason, tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(f"attached:\n- sphere: {{position: [0, 0, 0], radius: 0.1, {fields}}}\n")
    with pytest.raises(DocumentError) as error:
        load_scene(path)
    line, _, rest = reason.partition(": ")
    assert str(error.value).startswith(f"{path}:{line}: {rest}")


def test_objects_that_cannot_be_are_rejected():
    with pytest.raises(ValueError, match="at most 100 attached objects"):
        with_attached(PANDA, [BOARD] * 101)
    with pytest.raises(TypeError, match="an attached shape must be Box"):
        Attached("box")
    with pytest.raises(ValueError, match="an attached shape has no motion"):
        Attached(Sphere((0, 0, 0), 0.1, Oscillation((0.1, 0, 0))))
    with pytest.raises(ValueError, match="the arm collides with itself in each of"):
        with_attached(PANDA, [Attached(Sphere((0, 0, 0), 3.0))])
