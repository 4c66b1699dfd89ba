"""Obstacles that links may touch: contacts, checks, distances, planning and files agree."""

from dataclasses import replace

import numpy as np
import pytest

from roboarm_nmp.datasets.queries import load_queries, write_queries
from roboarm_nmp.envs import RoboArmEnv
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.collision.moving import free_over_time
from roboarm_nmp.envs.following import follow
from roboarm_nmp.envs.perception.geometry_source import find_geometry_source
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.variants import with_attached
from roboarm_nmp.envs.scenes.files import load_scene, save_scene
from roboarm_nmp.envs.scenes.motions import Oscillation, Presence
from roboarm_nmp.envs.scenes.primitives import (
    Attached,
    Box,
    Cylinder,
    Scene,
    Sphere,
    convex_hull,
    from_lists,
    scene_from_json,
    scene_to_json,
    to_lists,
)
from roboarm_nmp.envs.scenes.random_boxes import RandomBoxes
from roboarm_nmp.envs.tasks import get_task
from roboarm_nmp.envs.world import World
from roboarm_nmp.planning.planner import Planner
from roboarm_nmp.planning.timed_checker import TimedChecker
from roboarm_nmp.utils.documents import DocumentError

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8], np.float32)
GOAL = np.array([0.3, 0.3, 0.1, -1.9, 0.1, 2.1, 0.8], np.float32)
TIP = tuple(PANDA.forward_kinematics(GOAL).tolist())
CAN = Cylinder(TIP, 0.03, 0.16, may_touch=True)  # where the fingertips are at the goal


def test_true_means_the_hand_and_its_fingers():
    assert PANDA.hand_links == ("panda_hand", "panda_leftfinger", "panda_rightfinger")
    assert PANDA.links_called(True) == {8, 9, 10}
    assert PANDA.links_called(("panda_link3",)) == {2}


def test_compiled_checks_agree_with_pybullet_in_one_scene_after_another():
    rng, free, robot = np.random.default_rng(0), 0, PANDA
    rod = with_attached(PANDA, [Attached(Box((0, 0, 0.1), (0.05, 0.05, 0.3)))])
    world, choices = World(drawn=False), [(), True, ("panda_link5", "panda_link6"), ()]
    for i in range(4):
        robot = rod if i > 1 else PANDA
        boxes = RandomBoxes(4, 6).sample(rng).obstacles
        obstacles = [replace(one, may_touch=choices[(i + j) % 4]) for j, one in enumerate(boxes)]
        scene = Scene(tuple(obstacles), robot=robot)
        world.set_scene(scene)
        states = rng.uniform(-1, 1, (60, 7))
        expected = [not world.in_collision(robot.denormalise(s).tolist()) for s in states]
        checker = CollisionChecker(scene)
        np.testing.assert_array_equal(checker.is_free(states), expected)
        distance = checker.signed_distances(states).distance.min(-1)
        np.testing.assert_array_equal(distance > 0, expected)
        free += sum(expected)
    world.close()
    assert 30 < free < 210


def test_object_is_grasped_and_not_hit_by_other_links():
    scene, solid = Scene((CAN,)), Scene((replace(CAN, may_touch=()),))
    env = RoboArmEnv(solid)
    with pytest.raises(ValueError, match="goal is in collision: the arm with obstacle 0"):
        env.reset_specific(START, GOAL)
    path = Planner(env).plan(START, GOAL, scene, seed=0)
    run = follow(env, path, scene)
    assert run.reached and not run.collided
    # The forearm in the same place is in collision.
    elbow = Scene((Sphere(tuple(PANDA.frame_poses(START)[3][0].tolist()), 0.05, may_touch=True),))
    with pytest.raises(ValueError, match="start is in collision"):
        env.reset_specific(START, GOAL, elbow)
    env.close()


@pytest.mark.parametrize("source", ["ground_truth", "point_cloud"])
def test_link_distances_leave_the_object_out_for_the_hand_alone(source):
    scene = Scene((CAN, Box((0.5, 0.6, 0.3), (0.1, 0.1, 0.6))))
    state = PANDA.normalise(GOAL.astype(np.float64))
    for margin_free, robot_scene in ((True, scene), (False, replace(scene, obstacles=(
            replace(CAN, may_touch=()), scene.obstacles[1])))):  # fmt: skip
        checker = find_geometry_source(source)(robot_scene)
        distances = checker.link_distances(state)[:, 0]
        assert (distances[7:] > 0.005).all() == margin_free
        assert checker.is_free(state) == margin_free


def test_moving_obstacles_keep_the_links():
    rng, names = np.random.default_rng(0), ("panda_link5", "panda_link6")
    robot = with_attached(PANDA, [Attached(Box((0, 0, 0.1), (0.05, 0.05, 0.3)))])
    boxes, choices = RandomBoxes(8, 8).sample(rng).obstacles, [True, names, (), True]
    obstacles = [
        replace(one, may_touch=choices[i % 4], motion=Oscillation((0.1, 0, 0.05), 3.0, i))
        for i, one in enumerate(boxes)
    ]
    scene = Scene((*obstacles, replace(boxes[0], may_touch=True)), robot=robot)
    assert [one.may_touch for one in scene.at(1.0).obstacles] == [*choices, *choices, True]
    states, world, differ = rng.uniform(-1, 1, (60, 7)), World(scene, drawn=False), 0
    timed = TimedChecker(scene, 40, 1 / 30)
    for step in (0, 30):
        t = step / 30
        checkers = [CollisionChecker(scene.at((step + i) / 30)) for i in range(2)]
        free = [one.is_free(states) for one in checkers]
        angles = [robot.denormalise(state).tolist() for state in states]
        assert [not world.in_collision(q, t) for q in angles] == free[0].tolist()
        np.testing.assert_array_equal(timed.is_free(states, np.full(60, step)), free[0] & free[1])
        moving = Scene(scene.at(t).obstacles[:8], None, None, robot=robot)
        itself = CollisionChecker(Scene((), None, None, robot=robot)).is_free(states)
        found = free_over_time(scene, states, [t])[:, 0]
        np.testing.assert_array_equal(found & itself, CollisionChecker(moving).is_free(states))
        solid = [replace(one, may_touch=()) for one in scene.at(t).obstacles]
        differ += (
            CollisionChecker(replace(scene, obstacles=solid)).is_free(states) != free[0]
        ).sum()
    world.close()
    assert differ > 3


def test_files_keep_the_links(tmp_path):
    hull = convex_hull(np.random.default_rng(0).uniform(-0.1, 0.1, (8, 3)), (0.5, 0, 0.2))
    names = ("panda_hand", "panda_link5")
    motion = Presence(((1.0, 2.0),), Oscillation((0.1, 0, 0)))
    obstacles = (CAN, replace(hull, may_touch=names), Sphere((0, 0.6, 0.5), 0.1))
    obstacles += replace(CAN, motion=motion), replace(obstacles[1], motion=motion)
    obstacles += (replace(hull, motion=motion),)
    table = replace(Scene().table, may_touch=("panda_hand",))
    scene = Scene(obstacles, table)
    save_scene(scene, tmp_path / "a.yaml")
    assert load_scene(tmp_path / "a.yaml") == scene
    assert scene_from_json(scene_to_json(scene)) == scene
    assert from_lists(to_lists(obstacles)) == obstacles
    plain = Scene(tuple(replace(one, may_touch=()) for one in obstacles))
    assert plain != scene and "true" not in scene_to_json(plain)
    assert Scene((replace(hull, may_touch=names[::-1]),)) == Scene(obstacles[1:2])


def test_query_file_of_varying_scenes_keeps_the_links(tmp_path):
    ends, base = np.array([START, GOAL], np.float32), get_task("random_boxes_easy").base_scene
    for touching in (True, False):
        path = tmp_path / f"{touching}.h5"
        can = replace(CAN, may_touch=touching)
        moving = replace(can, motion=Oscillation((0, 0.3, 0)))
        found = [replace(base, obstacles=(can, moving)), replace(base, obstacles=(can,))]
        splits = {"test": (ends, ends[::-1], found)}
        splits["validation"] = ends + np.float32(0.01), ends[::-1], found
        write_queries(path, "random_boxes_easy", 0, splits, "", {})
        queries = load_queries(path, "test")
        assert [queries[i].scene for i in range(2)] == found


def test_links_that_cannot_be_are_rejected(tmp_path):
    with pytest.raises(ValueError, match="panda has no link 'thumb'"):
        Scene((replace(CAN, may_touch=["thumb"]),))
    with pytest.raises(ValueError, match="may_touch must be names of up to 200 links"):
        replace(CAN, may_touch="panda_hand")
    path = tmp_path / "a.yaml"
    path.write_text("obstacles:\n- sphere: {position: [0, 0, 0.5], radius: 0.1, may_touch: 1}\n")
    with pytest.raises(DocumentError, match="a.yaml:2: may_touch must be a list of links"):
        load_scene(path)
