"""The MDP: numbers against independent formulas, exact replay, Gymnasium, bad input."""

import hashlib
import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import psutil
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from paths import ROOT

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.utils.bullet import pybullet as p

HOME = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.8], dtype=np.float32)
NEAR_HOME = HOME + np.float32(0.1)
# Elbow fully bent: the hand is inside the arm.
FOLDED = np.array([0.0, 0.0, 0.0, -3.1, 0.0, 0.0, 0.0], dtype=np.float32)


@pytest.fixture
def env():
    env = envs.make("no_obstacles")
    yield env
    env.close()


# --- Numbers


def test_normalisation_is_the_papers_formula_both_ways():
    rng = np.random.default_rng(0)
    c = rng.uniform(PANDA.lower, PANDA.upper, (50, 7))
    m, M = PANDA.lower, PANDA.upper
    np.testing.assert_allclose(PANDA.normalise(c), (2 * c - (M + m)) / (M - m), atol=1e-12)
    np.testing.assert_allclose(PANDA.denormalise(PANDA.normalise(c)), c, atol=1e-12)
    for one in PANDA.normalise(c):  # the same to the last bit
        assert PANDA.denormalise_one(one.tolist()) == PANDA.denormalise(one).tolist()
    np.testing.assert_allclose(PANDA.normalise(m), -np.ones(7), atol=1e-12)
    np.testing.assert_allclose(PANDA.normalise(M), np.ones(7), atol=1e-12)


@pytest.mark.parametrize("mode", ["relative", "subgoal"])
def test_commanded_displacement_is_clipped_to_max_step(mode, monkeypatch):
    env = envs.make("no_obstacles", action_mode=mode)
    env.reset_specific(HOME, NEAR_HOME)
    s = 2 * (HOME.astype(float) - PANDA.lower) / (PANDA.upper - PANDA.lower) - 1
    commanded = []
    monkeypatch.setattr(env.world.arm, "command", commanded.append)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=7)
    direction /= np.linalg.norm(direction)
    for length, expected in [(0.5, 0.03), (0.031, 0.03), (0.01, 0.01)]:
        env.reset_specific(HOME, NEAR_HOME)
        displacement = direction * length
        env.step((displacement if mode == "relative" else s + displacement).astype(np.float32))
        target = 2 * (np.array(commanded[-1]) - PANDA.lower) / (PANDA.upper - PANDA.lower) - 1
        np.testing.assert_allclose(target - s, direction * expected, atol=1e-6)


def test_the_arm_follows_commands_and_holds_still(env):
    env.reset_specific(HOME, NEAR_HOME)
    before = PANDA.normalise(HOME)
    action = np.zeros(7, np.float32)
    action[0] = 1.0
    observation, *_ = env.step(action)
    moved = observation["observation"][:7] - before
    assert 0.025 < moved[0] < 0.035
    assert np.abs(moved[1:]).max() < 0.006
    env.reset_specific(HOME, NEAR_HOME)
    for _ in range(200):
        observation, *_ = env.step(np.zeros(7, np.float32))
    np.testing.assert_allclose(observation["observation"][:7], before, atol=2e-3)


def test_contacts_do_not_depend_on_where_the_arm_was_before():
    """Bullet's cached contact points, if not dropped, change the result in 5 of these 6,000."""
    goal = load_queries("double_walls", "validation").goal[180]  # 0.3 mm from touching itself
    env, rng = envs.make("double_walls"), np.random.default_rng(0)

    def nearest():
        assert not env.in_collision(goal)
        contacts = p.getContactPoints(bodyA=env.body, physicsClientId=env.client)
        return min(contact[8] for contact in contacts)

    alone = nearest()
    for _ in range(6000):
        near = goal + rng.normal(size=7) * [0.3, 0.3, 0.3, 0.3, 0.01, 0.01, 0.01]
        near = np.clip(near, PANDA.lower, PANDA.upper)
        if env.in_collision(near):
            for _ in range(2):
                p.stepSimulation(physicsClientId=env.client)
            assert nearest() == alone
    env.close()


@pytest.mark.parametrize("goal_type, size", [("ee", 3), ("config", 7), ("combined", 10)])
def test_goal_types_rewards_and_termination_on_batches(goal_type, size):
    env = envs.make("no_obstacles", goal_type=goal_type)
    observation, info = env.reset_specific(HOME, NEAR_HOME)
    expected = {
        "ee": PANDA.forward_kinematics(NEAR_HOME),
        "config": PANDA.normalise(NEAR_HOME),
        "combined": np.r_[PANDA.normalise(NEAR_HOME), PANDA.forward_kinematics(NEAR_HOME)],
    }[goal_type]
    np.testing.assert_allclose(observation["desired_goal"], expected, atol=1e-6)
    assert observation["achieved_goal"].shape == (size,)
    np.testing.assert_allclose(
        info["ee_distance"],
        np.linalg.norm(PANDA.forward_kinematics(HOME) - PANDA.forward_kinematics(NEAR_HOME)),
        atol=1e-6,
    )

    tolerance = 0.05 if goal_type == "config" else 0.02
    goal = np.tile(observation["desired_goal"], (2, 3, 1))
    achieved = goal.copy()
    axis = size - 1  # the last number counts for every goal type
    achieved[0, :, axis] += tolerance * np.array([0.0, 0.99, -0.99])
    achieved[1, :, axis] += tolerance * np.array([1.01, -1.01, 2.0])
    if goal_type == "combined":
        achieved[0, :, :7] += 1.0  # the configuration does not count
    reward = env.compute_reward(achieved, goal, {})
    np.testing.assert_array_equal(reward, [[0, 0, 0], [-1, -1, -1]])
    np.testing.assert_array_equal(env.compute_terminated(achieved, goal, {}), reward == 0)
    late = {"elapsed_steps": np.full((2, 3), 400)}
    np.testing.assert_array_equal(env.compute_truncated(achieved, goal, late), reward != 0)


def test_step_agrees_with_the_batch_functions_and_stops_at_the_goal(env):
    observation, _ = env.reset_specific(HOME, NEAR_HOME)
    goal = PANDA.normalise(NEAR_HOME)
    steps, terminated = 0, False
    while not terminated:
        action = (goal - observation["observation"][:7]).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        steps += 1
        pair = observation["achieved_goal"], observation["desired_goal"]
        assert reward == env.compute_reward(*pair, info) == (0 if terminated else -1)
        assert terminated == info["is_success"] == env.compute_terminated(*pair, info)
        assert not truncated and steps < 20
    assert np.linalg.norm(pair[0] - pair[1]) <= 0.02
    assert info["elapsed_steps"] == steps and not info["collision_so_far"]


def test_dense_reward_is_minus_the_distance():
    env = envs.make("no_obstacles", reward="dense")
    env.reset_specific(HOME, NEAR_HOME)
    observation, reward, *_ = env.step(np.zeros(7, np.float32))
    distance = np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"])
    assert reward == pytest.approx(-distance)


def test_velocities_in_the_observation():
    env = envs.make("no_obstacles", velocities=True)
    env.reset_specific(HOME, NEAR_HOME)
    action = np.zeros(7, np.float32)
    action[2] = 1.0
    observation, *_ = env.step(action)
    speeds = [p.getJointState(env.body, j, physicsClientId=env.client)[1] for j in range(7)]
    expected = 2 * np.array(speeds) / (PANDA.upper - PANDA.lower)
    np.testing.assert_allclose(observation["observation"][7:14], expected, rtol=1e-5)
    assert observation["observation"].shape == (17,) and expected[2] > 0


# --- Collisions

# A thin board that the forearm sweeps into when joint 1 turns left.
BOARD = Scene((Box((0.35, 0.25, 0.4), (0.6, 0.04, 0.8)),))
TURN_LEFT = np.eye(1, 7, dtype=np.float32)[0]


def test_collision_is_reported_while_it_lasts_and_so_far():
    env = envs.RoboArmEnv(BOARD)
    env.reset_specific(HOME, HOME - np.float32(0.5) * TURN_LEFT)
    free = env.step(TURN_LEFT)[4]
    assert not free["collision"] and not free["collision_so_far"]
    for _ in range(30):
        info = env.step(TURN_LEFT)[4]
    assert info["collision"] and info["collision_so_far"]
    for _ in range(5):
        info = env.step(-TURN_LEFT)[4]
    assert not info["collision"] and info["collision_so_far"]
    assert not env.reset_specific(HOME, NEAR_HOME)[1]["collision_so_far"]


def test_stop_on_collision_terminates_and_relabels():
    env = envs.RoboArmEnv(BOARD, stop_on_collision=True)
    env.reset_specific(HOME, HOME - np.float32(0.5) * TURN_LEFT)
    terminated = False
    while not terminated:
        observation, reward, terminated, truncated, info = env.step(TURN_LEFT)
    assert info["collision"] and not info["is_success"] and reward == -1
    far = observation["achieved_goal"][None] + 1.0
    batch = observation["achieved_goal"][None]
    assert env.compute_terminated(batch, far, [info])[0]
    assert not env.compute_terminated(batch, far, [{"collision": False}])[0]


@pytest.mark.parametrize("ending", ["goal", "collision"])
def test_sink_state_absorbs_until_the_horizon(ending):
    env = envs.RoboArmEnv(BOARD, sink_state=True, stop_on_collision=True, horizon=60)
    if ending == "goal":
        observation, _ = env.reset_specific(HOME, HOME - np.float32(0.2) * TURN_LEFT)
        actions, first = -TURN_LEFT, 0.0
    else:
        observation, _ = env.reset_specific(HOME, HOME - np.float32(0.5) * TURN_LEFT)
        actions, first = TURN_LEFT, -1.0
    ended = False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(actions)
        assert not terminated
        ended = info["is_success"] or info["collision"]
    assert reward == first
    while not truncated:
        later, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert reward == 0.0 and not terminated
        np.testing.assert_array_equal(later["observation"], observation["observation"])
        assert info["is_success"] == (ending == "goal")
    assert info["elapsed_steps"] == 60


def test_feasible_means_free_and_inside_the_limits(env):
    assert env.is_feasible(HOME)
    assert not env.is_feasible(FOLDED)
    assert not env.is_feasible(PANDA.upper + 0.01)
    through_the_table = np.array([0, 1.8, 0, -0.5, 0, 1.0, 0], dtype=np.float32)
    assert not env.is_feasible(through_the_table)
    assert envs.RoboArmEnv(Scene(table=None, floor=None)).is_feasible(through_the_table)
    assert not envs.RoboArmEnv(Scene((Box((0.0, 0, 0.9), (1, 1, 0.1)),))).is_feasible(HOME * 0)


# --- Exact replay


def run_episode(env, seed):
    """A hash over everything an episode returned, bit for bit."""
    rng = np.random.default_rng(seed)
    start, goal = env.sample_query(rng)
    digest = hashlib.sha256()
    observation, _ = env.reset_specific(start, goal)
    for action in rng.uniform(-1, 1, (8, 7)).astype(np.float32).repeat(10, axis=0):
        observation, reward, terminated, truncated, info = env.step(action)
        digest.update(observation["observation"].tobytes())
        digest.update(repr((reward, terminated, truncated, info)).encode())
    return digest.hexdigest()


def test_replay_is_bit_identical_in_any_order_and_any_process():
    env = envs.make("double_walls")
    first = {seed: run_episode(env, seed) for seed in range(12)}
    order = np.random.default_rng(0).permutation(12).tolist()
    again = {seed: run_episode(env, seed) for seed in order}
    assert again == first
    code = (
        "from roboarm_nmp import envs; from test_arm_env import run_episode;"
        "env = envs.make('double_walls');"
        "print(*[run_episode(env, seed) for seed in (9, 3, 11)])"
    )
    output = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT / "tests" / "envs",
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert output.split()[-3:] == [first[9], first[3], first[11]]


def test_an_episode_is_the_same_with_and_without_rendering():
    task = "random_boxes_hard"
    query = load_queries(task)[5]
    hashes = set()
    for arguments in ({}, {"render_mode": "rgb_array", "render_size": (32, 24)}, {"draw": True}):
        late = arguments.pop("draw", False)
        env = envs.make(task, **arguments)
        if late:
            env.world.draw()
        rng, moved = np.random.default_rng(0), hashlib.sha256()
        env.reset_specific(query.start, query.goal, query.scene)
        for _ in range(60):
            observation = env.step(rng.uniform(-0.03, 0.03, 7))[0]
            moved.update(observation["observation"].tobytes())
            if env.render_mode is not None:
                env.render()
        hashes.add(moved.hexdigest())
        env.close()
    assert len(hashes) == 1


def test_a_seed_fixes_the_episode():
    a, b = envs.make("boxes"), envs.make("boxes")
    for name, value in a.reset(seed=7)[0].items():
        np.testing.assert_array_equal(value, b.reset(seed=7)[0][name])
        assert not np.array_equal(b.reset(seed=8)[0]["observation"], a.reset()[0]["observation"])


# --- The Gymnasium interface


@pytest.mark.parametrize(
    "task, goal_type",
    [
        ("wall", "ee"),
        ("random_boxes_hard", "combined"),
        ("benchmaker_bookshelf_thin", "config"),
        ("moving_boxes_medium", "pose"),
    ],
)
def test_check_env(task, goal_type):
    check_env(gym.make(envs.gymnasium_id(task), goal_type=goal_type).unwrapped)


def test_ids_are_registered():
    assert envs.gymnasium_id("double_walls_wide_gap") == "RoboArmNMP/DoubleWallsWideGap-v0"
    env = gym.make("RoboArmNMP/DoubleWalls-v0", goal_type="config", max_step=0.05)
    assert env.unwrapped.scene == envs.TASKS["double_walls"].scene
    assert env.unwrapped.goal_type == "config" and env.unwrapped.max_step == 0.05


@pytest.mark.parametrize("vector_env", [gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv])
def test_vector_envs(vector_env):
    make = [lambda: gym.make("RoboArmNMP/Wall-v0", horizon=5)] * 2
    vector = vector_env(make, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)
    observation, _ = vector.reset(seed=0)
    assert observation["observation"].shape == (2, 10)
    for step in range(5):
        *_, truncated, infos = vector.step(np.zeros((2, 7), np.float32))
        assert truncated.all() == (step == 4)
    assert infos["final_obs"][1]["desired_goal"].shape == (3,)
    vector.close()


def test_episodes_leave_no_memory_behind(env):
    env.reset(seed=0)
    resident = psutil.Process().memory_info().rss
    for _ in range(300):
        env.reset()
        env.step(env.action_space.sample())
    # 20,000 episodes: docs/lab_notebook.md, "Memory over many episodes".
    assert psutil.Process().memory_info().rss - resident < 2e6


def test_closing_frees_the_connection():
    env = envs.make("no_obstacles")
    connection = env.client
    env.close()
    env.close()
    for _ in range(5):  # a leaked connection would not be given out again
        env = envs.make("no_obstacles")
        assert env.client == connection
        del env


# --- Queries as options of `reset`

QUERY = {"start": HOME, "goal": NEAR_HOME}
SHELF = Scene((Box((0.6, 0.0, 0.9), (0.3, 0.3, 0.03)),))


def test_reset_with_options_starts_the_episode_of_reset_specific():
    a, b = envs.make("no_obstacles"), envs.make("no_obstacles")
    for scene in (None, SHELF):
        first, info = a.reset_specific(HOME, NEAR_HOME, scene)
        again, same_info = b.reset(options=QUERY | ({} if scene is None else {"scene": scene}))
        for name in first:
            np.testing.assert_array_equal(first[name], again[name])
        assert info == same_info and a.scene == b.scene
    a.reset(seed=5)
    b.reset(seed=5, options=QUERY)
    # The seed is used, and the query draws nothing.
    assert a.np_random.bit_generator.state != b.np_random.bit_generator.state
    assert b.np_random.bit_generator.state == np.random.default_rng(5).bit_generator.state


@pytest.mark.parametrize(
    "options, message",
    [
        (QUERY | {"sceen": SHELF}, r"unknown options \['sceen'\]: known are 'start', 'goal', 'sc"),
        ({"start": HOME}, "must have both 'start' and 'goal'"),
        ({"start": FOLDED, "goal": HOME}, "start is in collision"),
        ("start", "options must be a dict"),
    ],
)
def test_wrong_options_are_rejected_and_the_episode_goes_on(env, options, message):
    env.reset_specific(HOME, NEAR_HOME)
    env.step(np.zeros(7))
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    assert env.step(np.zeros(7))[4]["elapsed_steps"] == 2


# --- Closed environments


def test_closed_environment_says_so(env):
    calls = [
        lambda env: env.reset(options=QUERY),
        lambda env: env.step(np.zeros(7)),
        lambda env: env.render(),
        lambda env: env.in_collision(HOME),
        lambda env: env.sample_query(np.random.default_rng(0)),
        lambda env: env.set_scene(SHELF),
        lambda env: env.world.simulate(),
    ]
    env.reset_specific(HOME, NEAR_HOME)
    env.close()
    for call in calls:
        with pytest.raises(RuntimeError, match="is closed"):
            call(env)


# --- Bad input: a clear error, and the env goes on


@pytest.mark.parametrize(
    "action, reason",
    [
        (np.full(7, np.nan), "nan"),
        (np.zeros((1, 7)), r"got shape \(1, 7\)"),
        (np.ma.masked_array(np.zeros(7), mask=[1, 0, 0, 0, 0, 0, 0]), "got a masked array"),
    ],
)
def test_bad_action_is_rejected_with_the_reason_and_nothing_moves(env, action, reason):
    observation, _ = env.reset_specific(HOME, NEAR_HOME)
    with pytest.raises(ValueError, match=f"7 finite numbers.*{reason}"):
        env.step(action)
    after, *_, info = env.step(np.zeros(7, np.float32))
    assert info["elapsed_steps"] == 1
    np.testing.assert_allclose(after["observation"], observation["observation"], atol=1e-3)


def test_tensor_action_moves_like_an_array(env):
    states = []
    number = np.float32(0.01)
    tensors = torch.full((7,), 0.01), torch.full((7,), 0.01, requires_grad=True)
    for action in (np.full(7, number), [number] * 7, *tensors):
        env.reset_specific(HOME, NEAR_HOME)
        states.append(env.step(action)[0]["observation"])
    for state in states[1:]:
        np.testing.assert_array_equal(states[0], state)


@pytest.mark.parametrize(
    "start, goal, message",
    [
        (FOLDED, HOME, "start is in collision: the arm with itself"),
        (HOME + 4, HOME, "start is outside the joint limits: joint 1"),
        (HOME, HOME[:4], "goal must have 7 or 3 numbers"),
    ],
)
def test_bad_query_is_rejected_and_the_episode_goes_on(env, start, goal, message):
    env.reset_specific(HOME, NEAR_HOME)
    with pytest.raises(ValueError, match=message):
        env.reset_specific(start, goal)
    observation, *_, info = env.step(np.zeros(7, np.float32))
    assert info["elapsed_steps"] == 1
    np.testing.assert_allclose(observation["observation"][:7], PANDA.normalise(HOME), atol=1e-3)


def test_episode_in_contact_goes_on_bit_for_bit_after_refused_queries():
    runs = []
    for refused in (False, True):
        env, rng, states = envs.make("random_boxes_hard"), np.random.default_rng(0), []
        for seed in range(4):
            env.reset(seed=seed)
            for direction in rng.normal(size=(6, 7)).repeat(10, axis=0):
                observation, *_, info = env.step(direction)
                states.append(observation["observation"])
                if refused and info["collision"]:
                    with pytest.raises(ValueError, match="start is in collision"):
                        env.reset_specific(FOLDED, [0.4, 0.1, 0.5])
        env.close()
        runs.append(np.stack(states))
    np.testing.assert_array_equal(*runs)


def test_position_goals_are_for_goal_type_ee():
    env = envs.make("no_obstacles", goal_type="combined")
    with pytest.raises(ValueError, match="goal must have 7 numbers"):
        env.reset_specific(HOME, np.zeros(3))
    env = envs.make("no_obstacles")
    observation, info = env.reset_specific(HOME, [0.4, 0.1, 0.5])
    np.testing.assert_allclose(observation["desired_goal"], [0.4, 0.1, 0.5])
    assert np.isnan(info["config_distance"]) and env.goal_configuration is None


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"goal_type": "poses"}, "goal_type must be one of 'ee', 'config', 'combined', 'pose'"),
        ({"ee_tolerance": 3.0}, "ee_tolerance must be at most 1.0"),  # it would never reset
        ({"contact_cost": -1}, "contact_cost must be a finite number, at least 0"),
        ({"episodes_per_scene": 1.5}, "episodes_per_scene must be a whole number"),
        ({"render_size": (70_000, 70_000)}, "render_size must be from 1 to 4096"),
    ],
)
def test_bad_argument_is_rejected_with_its_range(arguments, message):
    with pytest.raises(ValueError, match=message):
        envs.make("no_obstacles", **arguments)


def test_unknown_task_missing_reset_and_wrong_scene_are_rejected():
    with pytest.raises(ValueError, match="unknown task 'walls': did you mean wall?"):
        envs.make("walls")
    with pytest.raises(RuntimeError, match="call reset"):
        envs.make("no_obstacles").step(np.zeros(7))
    with pytest.raises(TypeError, match="must be a roboarm_nmp.envs.scenes.primitives.Scene"):
        envs.RoboArmEnv("wall")
