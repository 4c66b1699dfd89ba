"""Approach paths: out of a start, and into a goal, near obstacles."""

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.datasets.queries import Query
from roboarm_nmp.envs.policies.approach_path import (
    GOAL_CLEARANCE,
    START_CLEARANCE,
    STEP,
    approach_path,
)
from roboarm_nmp.envs.policies.registry import make_policy
from roboarm_nmp.envs.policies.rollout import rollout
from roboarm_nmp.envs.policies.safety_filter import SafetyFilter
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Box, Scene

FREE = np.float32([0.9, 0.1, 0.0, -1.8, 0.0, 2.2, 0.8])
IN_SHELF = np.float32([0.0, 0.75, 0.0, -1.6, 0.0, 2.35, 0.8])
HAND = PANDA.forward_kinematics(IN_SHELF.astype(np.float64))
WITH_DISTANCES = {"link_distances": True, "geometry_source": "ground_truth"}


def shelf(gap, height=0.15):
    """A board about `gap` m below the fingertips of `IN_SHELF`, and another one `height` m above.

    The second one is 5 mm from the wrist, by default.
    """
    x, y, z = HAND
    boards = [
        Box((x + 0.08, y, z - 0.01 - gap), (0.3, 0.6, 0.02)),
        Box((x + 0.2, y, z + height), (0.3, 0.6, 0.02)),
    ]
    return Scene(tuple(boards), table=None, floor=None)


def smallest(checker, states):
    return checker.link_distances(states)[..., 0].min(-1)


def test_path_leaves_a_tight_place_without_coming_nearer_to_anything():
    checker = CollisionChecker(shelf(gap=0.02))
    state = PANDA.normalise(IN_SHELF)
    path = approach_path(PANDA, state, checker.link_distances)
    distances = smallest(checker, path)
    assert 0.0 < distances[0] < 0.015 and distances[-1] >= GOAL_CLEARANCE
    assert distances.min() > distances[0] - 0.0005
    assert np.allclose(path[0], state) and np.abs(path).max() <= 1.0
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= STEP + 1e-9
    assert checker.is_free(path).all()  # of itself, too


def test_path_from_a_free_place_is_that_place():
    checker = CollisionChecker(Scene())
    path = approach_path(PANDA, PANDA.normalise(FREE), checker.link_distances)
    assert len(path) == 1
    checker = CollisionChecker(shelf(gap=0.04, height=0.4))  # 3 cm below the fingers
    state = PANDA.normalise(IN_SHELF)
    assert len(approach_path(PANDA, state, checker.link_distances, 0.02)) == 1
    assert len(approach_path(PANDA, state, checker.link_distances, 0.04)) > 1


def episode(query, approach, goal_type="config"):
    env = envs.make("no_obstacles", goal_type=goal_type, **WITH_DISTANCES)
    safety_filter = SafetyFilter(margin=0.02, escape=False, approach=approach)
    act = make_policy("go-to-goal", env, safety_filter=safety_filter)(0, query).act
    try:
        return rollout(env, query, act)
    finally:
        env.close()


@pytest.mark.parametrize("goal_type", ["config", "combined"])
def test_goal_nearer_than_the_margin_is_reached_from_its_free_end(goal_type):
    scene, goal = shelf(gap=0.015), PANDA.normalise(IN_SHELF)
    at = CollisionChecker(scene).link_distances
    free_end, farther = (approach_path(PANDA, goal, at, end)[-1] for end in (GOAL_CLEARANCE, 0.08))
    query = Query(PANDA.denormalise(farther).astype(np.float32), IN_SHELF, scene)
    nearest = {}
    for approach in (True, False):
        trajectory = episode(query, approach, goal_type)
        assert trajectory.success and not trajectory.collides
        nearest[approach] = np.linalg.norm(trajectory.states - free_end, axis=1).min()
    assert nearest[True] < 0.02 < nearest[False]


def test_start_nearer_than_the_margin_is_left():
    query = Query(IN_SHELF, FREE, shelf(gap=0.015))
    checker = CollisionChecker(query.scene)
    trajectory = episode(query, True)
    assert trajectory.success and not trajectory.collides
    states = np.clip(trajectory.states.astype(np.float64), -1.0, 1.0)
    nearest = smallest(checker, states)
    first = np.argmax(nearest >= START_CLEARANCE)
    assert 0 < first < 60 and nearest[:first].min() > nearest[0] - 0.003


def test_free_start_and_goal_change_nothing():
    query = Query(FREE, FREE + np.float32(0.3), Scene())
    with_paths, without = (episode(query, approach) for approach in (True, False))
    assert np.array_equal(with_paths.actions, without.actions)


def test_goal_that_is_a_position_has_no_path():
    query = Query(FREE, IN_SHELF, shelf(gap=0.03))
    with_paths, without = (episode(query, approach, "ee") for approach in (True, False))
    assert np.array_equal(with_paths.actions, without.actions)


def test_goal_and_scene_may_change_during_an_episode():
    env = envs.make("no_obstacles", goal_type="config", **WITH_DISTANCES)
    observation, _ = env.reset_specific(FREE, IN_SHELF, shelf(gap=0.015))
    asked = []

    def act(observation):
        asked.append(observation["desired_goal"])
        return np.zeros(7)

    act_safely = SafetyFilter(approach=True).filter_policy(act, env, np.random.default_rng(0))
    act_safely(observation)
    other = PANDA.normalise(FREE + np.float32(0.2)).astype(np.float32)
    act_safely(observation | {"desired_goal": other})
    env.close()
    assert np.abs(asked[0] - PANDA.normalise(IN_SHELF)).max() > 0.01
    assert np.array_equal(asked[1], other)
