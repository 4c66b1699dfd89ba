"""Wide scenes: families of places, starts and goals in them, and their query files."""

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.demo_generation.make_queries import make_queries
from roboarm_nmp.demo_generation.roadmaps import random_paths_of_scene
from roboarm_nmp.envs.collision.query_ends import random_ends
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.wide_scenes.distribution import SITES, WideScene, WideScenes
from roboarm_nmp.envs.scenes.wide_scenes.names import FAMILIES, HELD_OUT, TRAINING
from roboarm_nmp.envs.scenes.wide_scenes.site import Site, turned
from roboarm_nmp.utils.bullet import pybullet as p


@pytest.fixture(scope="module")
def env():
    env = envs.make("wide_scenes")
    yield env
    env.close()


def test_held_out_families_are_those_drawn_first_and_no_task_mixes_them():
    assert HELD_OUT == ("bottle_rack", "conveyor", "pipes", "rubble")
    assert sorted(TRAINING + HELD_OUT) == sorted(FAMILIES) == sorted(SITES)
    assert not set(TRAINING) & set(HELD_OUT)
    assert envs.get_task("wide_scenes").scene == WideScenes(TRAINING)
    task = envs.get_task("wide_scenes_held_out")
    assert task.scene == WideScenes(HELD_OUT) and not task.trainable


@pytest.mark.parametrize("family", FAMILIES)
def test_starts_and_goals_of_a_family_are_free_in_pybullet_and_grasps_are_near(family, env):
    scenes, near = WideScenes((family,)), 0
    for seed in range(2):
        scene = scenes.sample(np.random.default_rng([seed, 1]))
        assert scene == scenes.sample(np.random.default_rng([seed, 1]))
        assert scene != scenes.sample(np.random.default_rng([seed, 2])) and scene.places
        ends = random_ends(scene, scene.places, np.random.default_rng(seed), 6)
        env.set_scene(scene)
        for end in ends:
            assert env.is_feasible(end)
            near += any(
                p.getClosestPoints(env.body, body, 0.031, physicsClientId=env.client)
                for body in env.world._bodies
            )
    assert near  # about half are grasps


def test_mirrored_turned_and_moved_site_is_the_same_site(env):
    gaps = []
    turn = turned(0.4, 1.1, -0.7)
    for rotation, offset, mirrored in ((np.eye(3), 0.0, False), (turn, 0.3, True)):
        site = Site(np.random.default_rng(0))
        for name in ("greenhouse", "desk"):
            SITES[name](site)
        obstacles, places = site.placed(rotation, np.full(3, offset), 1.0, mirrored)
        env.set_scene(WideScene(tuple(obstacles), None, None))
        bodies = env.world._bodies
        closest = [
            p.getClosestPoints(bodies[0], b, 9.0, physicsClientId=env.client) for b in bodies[1:]
        ]
        to_places = [np.linalg.norm(place.centre - obstacles[0].position) for place in places]
        gaps.append([*(points[0][8] for points in closest), *to_places])
        for place in places:
            across = np.zeros(3) if place.across is None else place.across
            assert abs(place.approach @ across) < 1.0 and np.linalg.det(place.rotation) > 0.99
    np.testing.assert_allclose(gaps[0], gaps[1], atol=1e-3)


def test_queries_are_stored_as_seeds_and_share_scenes_and_starts(tmp_path, env):
    path = tmp_path / "queries.h5"
    make_queries(path, "wide_scenes", 3, 6, 2, queries_per_scene=3, plannable=True, progress=False)
    queries = load_queries(path)
    assert path.stat().st_size < 20_000 and len(queries) == 6
    assert len({query.scene for query in queries}) == 2
    for start, goal, scene in queries:
        env.set_scene(scene)
        assert env.is_feasible(start) and env.is_feasible(goal)
    np.testing.assert_allclose(
        queries.goal_position, PANDA.forward_kinematics(queries.goal), atol=1e-6
    )
    assert len(np.unique(queries.start, axis=0)) == 2 and len(np.unique(queries.goal, axis=0)) == 6


def test_resets_and_roadmaps_draw_new_wide_scenes(env):
    env.reset(seed=0)
    first = env.scene
    env.reset()
    assert first != env.scene and env.scene.places
    scene, paths = random_paths_of_scene(0, "wide_scenes", 0, 4, num_nodes=200)
    assert scene.obstacles and paths
