"""Rollouts: a trajectory equals the episode; replays equal the rollout."""

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import Query, load_queries
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.evaluation import rollout as module
from roboarm_nmp.evaluation.rollout import render_steps, rollout
from roboarm_nmp.policies.registry import make_policy

BENT = np.array([0.0, -0.3, 0.0, -1.8, 0.0, 1.6, 0.0], np.float32)
AT_THE_SIDE = np.array([1.5, 0.6, 0.0, -1.8, 0.0, 1.6, 0.0], np.float32)


@pytest.fixture(scope="module")
def env():
    env = envs.make("wall", render_mode="rgb_array", render_size=(64, 48))
    yield env
    env.close()


def straight(query):
    goal = PANDA.normalise(query.goal)
    return lambda observation: goal - observation["observation"][:7]


def test_trajectory_equals_the_steps_of_the_environment(env):
    outcomes = set()
    for query in load_queries("wall", "validation")[:6]:
        trajectory = rollout(env, query, straight(query))
        observation, info = env.reset_specific(*query)
        states, actions, contacts = [observation["observation"][:7]], [], []
        over = info["is_success"]
        while not over:
            actions.append(straight(query)(observation))
            observation, _, terminated, truncated, info = env.step(actions[-1])
            states.append(observation["observation"][:7])
            contacts.append(info["collision"])
            over = terminated or truncated
        assert len(trajectory) == info["elapsed_steps"] == len(trajectory.times)
        assert trajectory.states.dtype == np.float32
        assert np.array_equal(trajectory.states, states)
        assert np.array_equal(trajectory.actions, actions)
        assert np.array_equal(trajectory.contacts, contacts)
        assert trajectory.success == info["is_success"]
        assert trajectory.collides == info["collision_so_far"]
        assert (trajectory.times >= 0).all()
        assert np.allclose(trajectory.configurations[0], query.start, atol=1e-6)
        outcomes.add((trajectory.success, trajectory.collides))
    assert len(outcomes) > 1


def test_start_at_the_goal_and_a_policy_that_gives_up_make_no_step(env):
    at_goal = rollout(env, Query(BENT, BENT, Scene()), straight)
    gives_up = rollout(env, Query(BENT, AT_THE_SIDE, Scene()), None)
    for trajectory, success in ((at_goal, True), (gives_up, False)):
        assert len(trajectory) == 0 and trajectory.success is success and not trajectory.collides
        assert trajectory.states.shape == (1, 7) and trajectory.actions.shape == (0, 7)


def test_replay_renders_what_the_rollout_went_through():
    env = envs.make("wall", horizon=20, render_mode="rgb_array", render_size=(64, 48))
    query = load_queries("wall", "validation")[1]
    act, plan_found, _ = make_policy("random", env, seed=3)(0, query)
    assert plan_found is None
    images = []

    def rendering(observation):
        images.append(env.render())
        return act(observation)

    trajectory = rollout(env, query, rendering)
    images.append(env.render())
    steps = [0, 7, 7, len(trajectory)]
    rendered = render_steps(env, query, trajectory.actions, steps)
    assert np.array_equal(rendered, [images[step] for step in steps])
    assert not np.array_equal(images[0], images[-1])
    env.close()


def test_delayed_action_takes_effect_some_steps_later():
    """Meanwhile the arm makes the step before it, then holds; the policy observes nothing."""
    env, query = envs.RoboArmEnv(), Query(BENT, AT_THE_SIDE, Scene())
    observed = []

    def act(observation):
        observed.append(observation["observation"][:7])
        return np.full(7, len(observed), np.float32) / 1000

    trajectory = rollout(env, query, act, delay=3)
    commands = (trajectory.actions[:, 0] * 1000).round().astype(int)
    assert commands[:12].tolist() == [0, 0, 0, 1, 0, 0, 2, 0, 0, 3, 0, 0]
    assert np.array_equal(observed[:4], trajectory.states[:12:3])
    assert len(trajectory) == env.horizon
    assert len(rollout(env, query, act, delay=1).actions) == env.horizon


def test_real_time_delays_by_the_time_that_an_action_takes(monkeypatch):
    env, query, clock = envs.RoboArmEnv(), Query(BENT, AT_THE_SIDE, Scene()), [0.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: clock[0])

    def act(observation):
        clock[0] += 0.070  # s, which are three steps of 1/30 s
        return np.full(7, 0.001, np.float32)

    plain = rollout(env, query, act, "real_time")
    assert (plain.actions[:9, 0] > 0).tolist() == [False] * 3 + [True, False, False] * 2
    late = rollout(env, query, act, "real_time", planning_seconds=0.1)
    assert (late.actions[:9, 0] > 0).tolist() == [False] * 6 + [True, False, False]
    assert plain.times.sum() == pytest.approx(0.070 * np.ceil(env.horizon / 3))
