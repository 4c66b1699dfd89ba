"""Distributions of scenes with moving and appearing boxes, their tasks and query files."""

from dataclasses import replace

import numpy as np
import pytest

import roboarm_nmp
from roboarm_nmp import envs
from roboarm_nmp.datasets.format import OutOfDateError
from roboarm_nmp.datasets.queries import load_queries, query_path
from roboarm_nmp.demo_generation.make_queries import make_queries
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.collision.moving import free_over_time
from roboarm_nmp.envs.scenes import moving_boxes
from roboarm_nmp.envs.scenes.motions import Oscillation, Presence, Waypoints
from roboarm_nmp.envs.tasks import TASKS

MOVING = [name for name, task in TASKS.items() if hasattr(task.scene, "animate")]
KINDS = {"moving": Oscillation, "appearing": Presence, "blocked": Waypoints, "chased": Waypoints}


@pytest.fixture(scope="module")
def queries():
    """The first queries of each task, with their scenes."""
    return {task: [load_queries(task)[i] for i in range(6)] for task in MOVING}


def goal_is_free(query, times):
    """By single checks of the static scenes, independent of `free_over_time`."""
    state = np.clip(query.scene.robot.normalise(query.goal), -1.0, 1.0)
    return np.array([CollisionChecker(query.scene.at(t)).is_free(state) for t in times])


@pytest.mark.parametrize("task", MOVING)
def test_obstacles_of_a_task_move_in_its_way(task, queries):
    for query in queries[task]:
        motions = [o.motion for o in query.scene.obstacles if o.motion is not None]
        assert motions and all(isinstance(m, KINDS[task.split("_")[0]]) for m in motions)
        assert len(motions) < len(query.scene.obstacles) or task == "moving_boxes_hard"


@pytest.mark.parametrize("task", MOVING)
def test_start_is_free_in_the_first_second_and_goal_when_it_has_to_be(task, queries):
    for query in queries[task][:3]:
        state = np.clip(query.scene.robot.normalise(query.start), -1.0, 1.0)
        times = np.arange(0.0, 1.05, 0.1)
        assert all(CollisionChecker(query.scene.at(t)).is_free(state) for t in times)
        free = goal_is_free(query, np.arange(0.0, 13.3, 0.2))
        if task == "blocked_goals":
            assert not free[0] and free[41:].all()  # from 8.2 s on
        elif task == "chased_goals":
            assert 0.35 < free.mean() < 1.0
        else:
            assert free.all()


def test_free_over_time_is_that_of_the_static_scenes(queries):
    for task in MOVING:
        query = queries[task][0]
        states = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 7))
        times = np.linspace(0.0, 9.0, 8)
        only_moving = [o for o in query.scene.obstacles if o.motion is not None]
        scene = envs.Scene(only_moving, table=None, floor=None)
        alone = [CollisionChecker(scene.at(t)).is_free(states) for t in times]
        assert (free_over_time(query.scene, states, times) == np.transpose(alone)).all()


def test_boxes_do_not_appear_near_an_arm_on_the_straight_way(queries):
    for query in queries["appearing_boxes"]:
        robot, scene = query.scene.robot, query.scene
        first, last = robot.normalise([query.start, query.goal])
        duration = np.linalg.norm(last - first) / 0.9  # 0.03 a step, 30 steps a second
        for obstacle in scene.obstacles:
            if obstacle.motion is None:
                continue
            ((appears, _),) = obstacle.motion.intervals
            assert 0.3 <= appears <= 3.0
            way = first + min(appears / duration, 1.0) * (last - first)
            alone = envs.Scene([replace(obstacle, motion=None)], table=None, floor=None)
            distances = CollisionChecker(alone).signed_distances(way, self_collisions=False)
            assert distances.distance.min() > 0.02


def test_environment_draws_motions_for_each_episode_and_repeats_them_for_a_seed():
    env = roboarm_nmp.make("chased_goals")
    scenes = []
    for seed in (1, None, 1):
        env.reset(seed=seed)
        scenes.append(env.unwrapped.scene)
    assert scenes[0] == scenes[2] != scenes[1]
    assert not scenes[1].is_static
    env.close()


def test_file_of_another_version_of_the_distribution_is_out_of_date(monkeypatch):
    load_queries("moving_boxes_hard")
    monkeypatch.setattr(moving_boxes, "AMPLITUDE", (0.1, 0.31))
    path = query_path("moving_boxes_hard").name
    with pytest.raises(OutOfDateError, match=f"{path}: out of date.*moving_boxes_hard"):
        load_queries("moving_boxes_hard")


def test_query_file_repeats_the_tasks_own(tmp_path):
    task, path = "moving_boxes_easy", tmp_path / "1.h5"
    make_queries(path, task, 0, 2, 1, num_workers=1, progress=False)
    queries = load_queries(path, task=task)
    assert queries[1].scene == queries[:2][1].scene != queries[0].scene
    stored = load_queries(task)
    assert (queries.start[0] == stored.start[0]).all() and (queries.goal[0] == stored.goal[0]).all()
    assert queries[0].scene == stored[0].scene
