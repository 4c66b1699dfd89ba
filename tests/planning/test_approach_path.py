"""Approach paths: out of a start, and into a goal, near obstacles."""

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.inverse_kinematics import inverse_kinematics
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.rotations import matrix
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.planning.approach_path import (
    GIVE_UP,
    GOAL_CLEARANCE,
    RETREAT,
    RETREAT_CLEARANCE,
    START_CLEARANCE,
    STEP,
    approach_path,
    retreat_path,
)
from roboarm_nmp.policies.registry import make_policy
from roboarm_nmp.policies.safety_filter import SafetyFilter

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


def open_box():
    """A box around the hand of `IN_BOX`, 30 cm wide inside, whose walls are 25 cm high."""
    walls = [Box((0.55 + x, 0.0, 0.125), (0.02, 0.34, 0.25)) for x in (-0.16, 0.16)]
    walls += [Box((0.55, y, 0.125), (0.3, 0.02, 0.25)) for y in (-0.16, 0.16)]
    return Scene(tuple(walls), table=None, floor=None)


DOWN = [0.55, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0]
IN_BOX = inverse_kinematics(PANDA, DOWN, checker=CollisionChecker(open_box()), near=FREE)[0]


def test_retreat_goes_straight_back_out_of_a_box():
    checker, state = CollisionChecker(open_box()), PANDA.normalise(IN_BOX)
    path = retreat_path(PANDA, state, PANDA.normalise(FREE), checker.link_distances)
    assert np.array_equal(path[0], state) and np.abs(path).max() <= 1.0
    assert np.allclose(np.linalg.norm(np.diff(path, axis=0), axis=1), STEP, rtol=0.3)
    poses = np.array([PANDA.end_effector_pose(PANDA.denormalise(one)) for one in path])
    back = poses[:, :3] - poses[0, :3]
    assert np.abs(back[:, :2]).max() < 0.02 and RETREAT <= back[-1, 2] < RETREAT + 0.01
    axes = np.array([matrix(pose[3:])[:, 2] for pose in poses])
    assert axes @ axes[0] == pytest.approx(1.0, abs=0.005)
    distances = checker.link_distances(path)[..., 0]
    assert (distances >= np.minimum(distances[0], RETREAT_CLEARANCE) - 0.001).all()
    assert checker.is_free(path).all()


def observed_goals(steps):
    """The goals that a policy observes, in steps in which the arm does not move, (steps, 7)."""
    env = envs.make("no_obstacles", goal_type="config", **WITH_DISTANCES)
    observation, _ = env.reset_specific(FREE, IN_BOX.astype(np.float32), open_box())
    asked = []

    def act(observation):
        asked.append(observation["desired_goal"])
        return np.zeros(7)

    safety_filter = SafetyFilter(escape=False, approach=True)
    act_safely = safety_filter.filter_policy(act, env, np.random.default_rng(0))
    for _ in range(steps):
        act_safely(observation)
    env.close()
    return np.array(asked)


def test_goal_in_a_box_is_approached_from_outside_until_that_takes_too_long():
    goals, goal = observed_goals(GIVE_UP + 2), PANDA.normalise(IN_BOX)
    heights = [PANDA.forward_kinematics(PANDA.denormalise(one))[2] for one in goals]
    assert np.allclose(heights[:GIVE_UP], heights[0], atol=1e-6)
    assert heights[0] > 0.1 + 0.9 * RETREAT
    at = CollisionChecker(open_box()).link_distances
    free_end = approach_path(PANDA, goal, at)[-1]
    assert np.allclose(goals[GIVE_UP:], free_end, atol=1e-5)
