"""Policies where obstacles move: the filter's retreat, replanning, plans in space and time."""

import math

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import Query, load_queries
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.following import follow
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.motions import Oscillation, Presence, Waypoints
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.evaluation.rollout import Episode, rollout
from roboarm_nmp.planning import space_time
from roboarm_nmp.planning.planner import PlanningError
from roboarm_nmp.planning.space_time import SpaceTimePlanner
from roboarm_nmp.planning.timed_checker import TimedChecker
from roboarm_nmp.policies.registry import PolicyError, make_policy
from roboarm_nmp.policies.safety_filter import (
    CBF_GAIN,
    MAX_APPROACH,
    RATE_STEPS,
    ApproachRates,
    SafetyFilter,
)

MIDDLE = PANDA.denormalise(np.zeros(7)).astype(np.float32)
SIDE = PANDA.denormalise(np.array([0.5, 0, 0, 0, 0, 0, 0])).astype(np.float32)
OTHER_SIDE = PANDA.denormalise(np.array([-0.5, 0, 0, 0, 0, 0, 0])).astype(np.float32)


def hand_at(configuration):
    return PANDA.forward_kinematics(configuration)


def make_env(scene, source="ground_truth", filtered=True, **options):
    link_distances = {"link_distances": True, "geometry_source": source} if filtered else {}
    return envs.make(scene, goal_type="combined", **link_distances, **options)


def pushing_box():
    """A box that approaches the hand of an arm in `MIDDLE` at 0.25 m/s, from the right."""
    x, y, z = hand_at(MIDDLE)
    motion = Waypoints((0.0, 2.0), ((0, 0, 0), (0, 0.5, 0)))
    return Scene((Box((x, y - 0.45, z), (0.2, 0.2, 0.5), motion=motion),), table=None)


# --- The safety filter


@pytest.mark.parametrize("source", ["ground_truth", "point_cloud"])
def test_standing_arm_retreats_from_an_approaching_obstacle(source):
    env = make_env(pushing_box(), source, horizon=60)
    query = Query(MIDDLE, SIDE, env.unwrapped.scene)
    still = lambda observation: np.zeros(7)  # noqa: E731
    collides = {}
    for lookahead in (None, 0.0, 0.1):
        safety_filter = SafetyFilter(escape=False, lookahead=lookahead)
        policy = make_policy(still, env, safety_filter=safety_filter)(0, query)
        collides[lookahead] = rollout(env, query, policy.act).collides
    env.close()
    assert collides == {None: True, 0.0: False, 0.1: False}


def test_demanded_retreat_is_the_obstacles_approach():
    row = np.zeros((1, 8))
    row[0, :2] = 0.02, 0.5
    # 10 mm above the margin, of which a step may use a fifth; the obstacle takes 5 mm.
    action = SafetyFilter(margin=0.01)(np.zeros(7), row, rates=[-0.005])
    assert action[0] == pytest.approx((0.005 - CBF_GAIN * 0.01) / 0.5)
    assert not action[1:].any()
    assert not SafetyFilter(margin=0.01)(np.zeros(7), row).any()


def test_velocities_change_nothing_in_a_static_scene():
    query = load_queries("random_boxes_hard", "validation")[3]
    actions = []
    for lookahead in (None, 0.0, 0.2):
        env = make_env(query.scene, horizon=80)
        options = {"safety_filter": SafetyFilter(lookahead=lookahead)}
        act = make_policy("go-to-goal", env, **options)(0, query).act
        actions.append(rollout(env, query, act).actions)
        env.close()
    assert len(actions[0]) > 20
    assert all(np.array_equal(actions[0], others) for others in actions[1:])


def test_approach_rates_are_those_of_the_motion():
    env = make_env(pushing_box())
    env.reset_specific(MIDDLE, SIDE)
    rates, state = ApproachRates(env.get_wrapper_attr("current_checker")), np.zeros(7)
    for _ in range(20):  # until the box is nearer than the distances' range
        env.step(np.zeros(7))
    for step in range(RATE_STEPS + 3):
        rates.observe()
        assert rates.any_motion == (step > 0)
        if rates.any_motion:
            distances = env.get_wrapper_attr("link_distances_at")(state)[:, 0]
            assert rates(state, distances).min() == pytest.approx(-0.25 * STEP_SECONDS, rel=0.03)
            assert (rates(state, distances - 1.0) == -MAX_APPROACH).all()
            assert (rates(state, distances + 1.0) == 0.0).all()  # it goes away
        env.step(np.zeros(7))
    env.close()


# --- Paths within a number of checks


def test_path_is_free_and_the_same_for_a_seed():
    query = load_queries("random_boxes_hard", "validation")[0]
    checker, rng = CollisionChecker(query.scene), np.random.default_rng
    start, goal = np.clip(PANDA.normalise([query.start, query.goal]), -1.0, 1.0)
    path, checks = checker.find_path(start, goal, rng(1), max_checks=20_000)
    again, _ = checker.find_path(start, goal, rng(1), max_checks=20_000)
    assert np.array_equal(path, again) and 0 < checks < 25_000
    assert np.array_equal(path[0], start) and np.array_equal(path[-1], goal)
    assert checker.is_motion_free(path[:-1], path[1:], resolution=0.02).all()
    assert checker.find_path(start, goal, rng(1), max_checks=2)[0] is None


# --- Replanning


def wall_in_the_way(appears):
    """A thin wall between `OTHER_SIDE` and `SIDE`, from a time (s) on."""
    x, _, z = hand_at(MIDDLE)
    motion = Presence(((appears, math.inf),))
    return Scene((Box((x, 0.0, z), (0.3, 0.02, 0.3), motion=motion),), table=None)


def test_replanning_goes_around_an_obstacle_that_appears():
    source = "point_cloud"
    env = make_env(wall_in_the_way(0.2), source)
    query = Query(OTHER_SIDE, SIDE, env.unwrapped.scene)
    plan_once = make_policy("planner", env, geometry_source=source)(0, query)
    assert rollout(env, query, plan_once.act).collides
    begin = make_policy("replanning", env, geometry_source=source, safety_filter=SafetyFilter())
    trajectory = rollout(env, query, begin(0, query).act)
    again = rollout(env, query, begin(0, query).act)
    env.close()
    assert trajectory.success and not trajectory.collides
    assert np.array_equal(trajectory.actions, again.actions)


def test_replanning_waits_near_an_occupied_goal_and_goes_there_when_it_is_free():
    x, y, z = hand_at(SIDE)
    motion = Presence(((0.0, 3.0),))
    scene = Scene((Box((x, y, z), (0.15, 0.15, 0.15), motion=motion),), table=None)
    env = make_env(scene)
    query = Query(OTHER_SIDE, SIDE, scene)
    episode = Episode(env, query)
    act = make_policy("replanning", env, safety_filter=SafetyFilter())(0, query).act
    near = None
    while not episode.ended:
        episode.step(act(episode.observation))
        if near is None and env.unwrapped.time > 2.5:
            near = episode.info["config_distance"]
    env.close()
    trajectory = episode.trajectory()
    assert trajectory.success and not trajectory.collides
    assert near < 0.6  # of 1.0 at the start
    assert 3.0 < len(trajectory) * STEP_SECONDS < 5.0


def test_stuck_policy_follows_a_plan():
    query = load_queries("random_boxes_hard", "validation")[4]
    env, success = make_env(query.scene, horizon=250), {}
    for replan in (False, True):
        options = {"safety_filter": SafetyFilter(escape=False), "replan": replan}
        trajectory = rollout(env, query, make_policy("go-to-goal", env, **options)(0, query).act)
        success[replan] = trajectory.success and not trajectory.collides
    env.close()
    assert success == {False: False, True: True}


# --- Space and time


def test_space_time_plan_is_followed_without_contact_among_moving_boxes():
    query = load_queries("moving_boxes_medium", "validation")[0]
    env = envs.make("moving_boxes_medium", goal_type="combined")
    path = SpaceTimePlanner(env).plan(*query, seed=0)
    execution = follow(env, path, query.scene)
    env.close()
    assert execution.reached and not execution.collided
    states = PANDA.normalise(path)
    assert np.linalg.norm(np.diff(states, axis=0), axis=1).max() < 0.03
    for step in range(0, len(path), 5):
        now = CollisionChecker(query.scene.at(step * STEP_SECONDS))
        assert now.is_free(np.clip(states[step], -1.0, 1.0))


def test_space_time_planner_gives_up_where_the_goal_is_never_free(monkeypatch):
    monkeypatch.setattr(space_time, "ATTEMPTS", space_time.ATTEMPTS[:1])
    x, y, z = hand_at(SIDE)
    motion = Oscillation((0.0, 0.0, 0.001), period=1.0)
    scene = Scene((Box((x, y, z), (0.15, 0.15, 0.15), motion=motion),), table=None)
    env = envs.make(scene)
    with pytest.raises(PlanningError, match="can be followed without contact"):
        SpaceTimePlanner(env).plan(OTHER_SIDE, SIDE, seed=0)
    with pytest.raises(PolicyError, match="space-time plans with the ground truth"):
        make_policy("space-time", env, geometry_source="point_cloud")
    assert make_policy("space-time", env)(0, Query(OTHER_SIDE, SIDE, scene)).act is None
    env.close()


def test_timed_checks_are_those_of_the_scene_at_each_time():
    scene, rng = load_queries("moving_boxes_hard", "validation")[0].scene, np.random.default_rng(0)
    timed = TimedChecker(scene, 50, STEP_SECONDS, margin=0.004)
    states, steps = rng.uniform(-1.0, 1.0, (300, 7)), rng.integers(0, 50, 300)
    free = timed.is_free(states, steps)
    checkers = [CollisionChecker(scene.at(step * STEP_SECONDS)) for step in range(51)]
    for state, step, one in zip(states, steps, free, strict=True):
        assert one == all(checkers[s].is_free(state, margin=0.004) for s in (step, step + 1))
    assert 0.1 < free.mean() < 0.9
