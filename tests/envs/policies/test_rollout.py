"""Rollouts: a trajectory equals the episode; replays equal the rollout."""

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.envs.datasets.queries import Query, load_queries
from roboarm_nmp.envs.policies.registry import make_policy
from roboarm_nmp.envs.policies.rollout import Episode, render_strip, rollout
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Scene

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


def test_episode_ends_as_soon_as_the_goal_is_reached(env):
    query = Query(BENT, AT_THE_SIDE, Scene())
    trajectory = rollout(env, query, straight(query))
    assert trajectory.success and not trajectory.collides and len(trajectory) > 10
    positions = PANDA.forward_kinematics(trajectory.configurations)
    to_goal = np.linalg.norm(positions - PANDA.forward_kinematics(AT_THE_SIDE), axis=1)
    assert to_goal[-1] <= env.ee_tolerance + 1e-6 and (to_goal[:-1] > env.ee_tolerance).all()


def test_start_at_the_goal_and_a_policy_that_gives_up_make_no_step(env):
    at_goal = rollout(env, Query(BENT, BENT, Scene()), straight)
    gives_up = rollout(env, Query(BENT, AT_THE_SIDE, Scene()), None)
    for trajectory, success in ((at_goal, True), (gives_up, False)):
        assert len(trajectory) == 0 and trajectory.success is success and not trajectory.collides
        assert trajectory.states.shape == (1, 7) and trajectory.actions.shape == (0, 7)


def test_actions_are_copied(env):
    action = np.zeros(7)

    def act(observation):
        action[:] += 1e-3
        return action

    episode = Episode(env, Query(BENT, AT_THE_SIDE, Scene()))
    for _ in range(3):
        episode.step(act(episode.observation))
    assert not episode.ended
    assert np.allclose(episode.trajectory().actions[:, 0], [1e-3, 2e-3, 3e-3])


def test_refused_query_and_refused_action_are_errors(env):
    outside = Query(BENT, np.full(7, 9.0, np.float32), Scene())
    with pytest.raises(ValueError, match="goal is outside the joint limits"):
        rollout(env, outside, straight(outside))
    with pytest.raises(ValueError, match="an action is 7 finite numbers"):
        rollout(env, Query(BENT, AT_THE_SIDE, Scene()), lambda observation: np.full(7, np.nan))


def test_replay_renders_what_the_rollout_went_through():
    env = envs.make("wall", render_mode="rgb_array", render_size=(64, 48))
    query = load_queries("wall", "validation")[1]
    act, plan_found = make_policy("random", env, seed=3)(0, query)
    assert plan_found is None
    images = []

    def rendering(observation):
        images.append(env.render())
        return act(observation)

    trajectory = rollout(env, query, rendering)
    images.append(env.render())
    steps = [0, 7, 7, len(trajectory)]
    strip = render_strip(env, query, trajectory.actions, steps)
    assert np.array_equal(strip, np.concatenate([images[step] for step in steps], axis=1))
    assert not np.array_equal(images[0], images[-1])
    env.close()
