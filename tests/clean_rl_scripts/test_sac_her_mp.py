"""sac_her_mp.py: numbers against independent formulas, and runs with flags of its own."""

import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv
from scipy.spatial.transform import Rotation
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainers import ONE_EVALUATION, PATHS, load, panda_env, run_here, run_script

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.episodes import DemoQueriesWrapper, demo_transitions, transition
from roboarm_nmp.demo_generation import collect
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.training import cuda_graphs
from roboarm_nmp.training.network_parts import GoalFeatures, JacobianTranspose
from roboarm_nmp.training.vector_envs import async_envs

sac = load("sac_her_mp")


# --- Numbers


@pytest.mark.parametrize("goal_type", ["ee", "config", "combined"])
def test_network_inputs(goal_type):
    rng = np.random.default_rng(0)
    c = rng.uniform(PANDA.lower, PANDA.upper, (5, 7))
    state, goal_state = PANDA.normalise(c), rng.uniform(-1, 1, (5, 7))
    position, goal_position = rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    goal = {"ee": goal_position, "config": goal_state}.get(
        goal_type, np.hstack([goal_state, goal_position])
    )
    expected = [state, position, goal, np.sin(c), np.cos(c)]
    to_goal = [5 * (goal_position - position)] * (goal_type != "config")
    to_goal_state = [5 * (goal_state - state)] * (goal_type != "ee")
    observation = np.hstack([state, position])
    tensors = torch.tensor(observation).float(), torch.tensor(goal).float()
    for jacobian in (True, False):
        features = GoalFeatures(panda_env(goal_type), jacobian=jacobian)
        inputs, added = features(*tensors).numpy(), []
        if jacobian and to_goal:
            given = tensors[0][:, :7], tensors[0][:, 7:], torch.tensor(to_goal[0]).float()
            added = [JacobianTranspose(PANDA)(*given).numpy()]
            added.append(added[0] / np.linalg.norm(added[0], axis=1, keepdims=True))
        assert inputs.shape == (5, features.size)
        numbers = np.hstack([*expected, *to_goal, *added, *to_goal_state])
        np.testing.assert_allclose(inputs, numbers, atol=1e-5)
    plain = GoalFeatures(panda_env(goal_type), plain=True)
    np.testing.assert_array_equal(plain(*tensors), torch.cat(tensors, dim=1))


def test_network_inputs_of_goal_poses():
    env = panda_env("pose")
    features, without = GoalFeatures(env), GoalFeatures(env, jacobian=False)
    configurations = np.random.default_rng(0).uniform(PANDA.lower, PANDA.upper, (2, 7))
    here, there = PANDA.end_effector_pose(configurations)
    observation = np.hstack([PANDA.normalise(configurations[0]), here])
    given = torch.tensor(observation).float()[None], torch.tensor(there).float()[None]
    inputs = features(*given)[0].numpy()
    assert features.size == without.size + 14
    np.testing.assert_allclose(inputs[:-14], without(*given)[0], atol=1e-6)
    difference = torch.tensor(inputs[-20:-14])[None]
    towards = JacobianTranspose(PANDA, rotates=True)(given[0][:, :7], given[0][:, 7:10], difference)
    np.testing.assert_allclose(inputs[-14:-7], towards[0], atol=1e-5)
    np.testing.assert_allclose(inputs[-7:], towards[0] / towards.norm(), atol=1e-5)
    inputs = inputs[:-14]
    turn = Rotation.from_quat(there[3:]) * Rotation.from_quat(here[3:]).inv()
    axis = turn.as_rotvec() / turn.magnitude()
    expected = [there[:3] - here[:3], axis * np.sin(turn.magnitude() / 2)]
    np.testing.assert_allclose(inputs[-6:], 5 * np.hstack(expected), atol=1e-5)
    np.testing.assert_allclose(inputs[:21], np.hstack([observation, there]), atol=1e-6)


def episode(length, offset, env):
    """Transition t of a made-up episode arrives at the position (offset + t, 0, 0)."""
    return [
        {
            "observation": np.full(10, offset + t, np.float32),
            "action": np.full(7, 0.01 * t, np.float32),
            "next_observation": np.full(10, offset + t + 1, np.float32),
            "next_achieved_goal": np.array([offset + t, 0, 0], np.float32),
            "desired_goal": np.array([-5, 0, 0], np.float32),
            "collision": t == 1,
        }
        for t in range(length)
    ]


def make_buffer(env, capacity, her_probability, her_exponent=1.0):
    args = sac.Args(her_probability=her_probability, her_exponent=her_exponent)
    return sac.HerReplayBuffer(env, capacity, args, np.random.default_rng(0))


def test_relabelled_goals_are_reached_later_in_the_same_episode():
    env = envs.make("no_obstacles")
    buffer = make_buffer(env, 100, 1.0)
    buffer.add_episode(episode(4, 0, env))
    buffer.add_episode(episode(6, 100, env))
    batch = buffer.sample(4000)
    now, goal = batch["next_achieved_goal"][:, 0], batch["desired_goal"][:, 0]
    assert set(zip(now.tolist(), goal.tolist(), strict=True)) == {
        (start + t, start + k)
        for start, n in ((0, 4), (100, 6))
        for t in range(n)
        for k in range(t, n)
    }
    # Positions are a metre apart: a goal is reached only at its own position.
    np.testing.assert_array_equal(batch["reward"], np.where(now == goal, 0.0, -1.0))
    np.testing.assert_array_equal(batch["terminated"], now == goal)
    # The rest of a transition stays together.
    np.testing.assert_array_equal(batch["observation"][:, 0], now)
    np.testing.assert_array_equal(batch["next_observation"][:, 3], now + 1)


@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_a_share_is_relabelled_and_goals_reached_soon_are_preferred(exponent):
    env = envs.make("no_obstacles")
    buffer = make_buffer(env, 100, 0.8, exponent)
    buffer.add_episode(episode(6, 0, env))
    batch = buffer.sample(50_000)
    goal = batch["desired_goal"][batch["next_achieved_goal"][:, 0] == 0, 0].astype(int)
    goal, share = goal[goal != -5], (goal != -5).mean()
    # The square of a uniform number is below x with probability sqrt(x).
    expected = np.diff((np.arange(7) / 6) ** (1 / exponent))
    np.testing.assert_allclose(np.bincount(goal, minlength=6) / len(goal), expected, atol=0.03)
    assert share == pytest.approx(0.8, abs=0.03)


def test_collisions_end_episodes_only_with_stop_on_collision_and_cost_what_they_should():
    for stop, cost in ((False, 0.0), (True, 0.5)):
        env = envs.make("no_obstacles", stop_on_collision=stop, contact_cost=cost)
        buffer = make_buffer(env, 10, 0.0)
        buffer.add_episode(episode(3, 0, env))
        batch = buffer.sample(100)
        collided = batch["next_achieved_goal"][:, 0] == 1
        np.testing.assert_array_equal(batch["terminated"], collided if stop else 0 * collided)
        np.testing.assert_array_equal(batch["reward"], -1 - cost * collided)


def test_ring_overwrites_the_oldest_and_keeps_episodes_apart():
    env = envs.make("no_obstacles")
    buffer = make_buffer(env, 10, 1.0)
    for offset in (0, 100, 200):
        buffer.add_episode(episode(4, offset, env))  # the third wraps around over half the first
    assert buffer.size == 10
    batch = buffer.sample(5000)
    now, goal = batch["next_achieved_goal"][:, 0], batch["desired_goal"][:, 0]
    assert set(now.tolist()) == {2, 3, 100, 101, 102, 103, 200, 201, 202, 203}
    assert (now // 100 == goal // 100).all() and (goal >= now).all()


# --- Demonstrations


@pytest.mark.parametrize("goal_type", ["ee", "config", "combined"])
def test_demonstration_as_transitions_by_hand(goal_type):
    demo = load_demos("no_obstacles")[1]
    env = envs.make("no_obstacles", goal_type=goal_type)
    episode = demo_transitions(demo, env)
    angles = PANDA.denormalise(demo.states.astype(np.float64))
    positions = PANDA.forward_kinematics(angles)
    goal_position = PANDA.forward_kinematics(demo.goal)
    if goal_type == "config":
        reached = np.linalg.norm(demo.states - PANDA.normalise(demo.goal), axis=1) <= 0.05
    else:
        reached = np.linalg.norm(positions - goal_position, axis=1) <= 0.02
    assert len(episode) == np.argmax(reached) <= len(demo.actions)  # cut where the goal is reached
    for t, entry in enumerate(episode):
        observation = np.concatenate([demo.states[t], positions[t]])
        np.testing.assert_allclose(entry["observation"], observation, atol=1e-6)
        observation = np.concatenate([demo.states[t + 1], positions[t + 1]])
        np.testing.assert_allclose(entry["next_observation"], observation, atol=1e-6)
        np.testing.assert_array_equal(entry["action"], demo.actions[t])
        assert not entry["collision"]
        goal = {
            "ee": goal_position,
            "config": PANDA.normalise(demo.goal),
            "combined": np.concatenate([PANDA.normalise(demo.goal), goal_position]),
        }[goal_type]
        np.testing.assert_allclose(entry["desired_goal"], goal, atol=1e-6)
    env.action_mode = "subgoal"
    sub_goals = demo_transitions(demo, env)
    np.testing.assert_allclose(sub_goals[3]["action"], demo.states[3] + demo.actions[3], atol=1e-6)
    env.close()


@pytest.fixture(scope="module")
def demo_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "demos.h5"
    options = collect.options_of(collect.Args("no_obstacles"))
    collect.collect(path, 4, options, progress=False)
    return path


ASYNC = pytest.param(lambda makers, **_: async_envs(makers), marks=pytest.mark.slow, id="async")


@pytest.mark.parametrize("vector_env", [SyncVectorEnv, ASYNC])
def test_transitions_are_those_of_single_environments_and_failures_inject_demonstrations(
    tmp_path, demo_file, vector_env, monkeypatch, short_episodes
):
    """Also at an evaluation, where all episodes end: every 60 steps, 20 of each environment."""
    taken = []

    def make_envs(makers, **options):
        made = vector_env(makers, **options)
        step = made.step
        made.step = lambda actions: taken.append(actions) or step(actions)
        return made

    monkeypatch.setattr("gymnasium.vector.SyncVectorEnv", make_envs)
    flags = "--total-timesteps 120 --eval-every 60 --horizon 8 --updates-per-step 0"
    flags += " --demo-prob 0.4 --goal-type combined --her-probability 0"
    run = run_script("sac_her_mp", tmp_path, *flags.split(), "--demos", str(demo_file))
    state = torch.load(run / "checkpoint.pt", weights_only=True)

    demos, rng = load_demos(demo_file), np.random.default_rng(1)
    env = envs.make("no_obstacles", goal_type="combined")
    expected, number_ended, injected = make_buffer(env, 1000, 0.0), 0, 0
    single = [envs.make("no_obstacles", goal_type="combined", horizon=8) for _ in range(3)]
    single = [DemoQueriesWrapper(one, demos) for one in single]
    for first in (0, 20):
        seeds = sac.reset_seeds(sac.Args(num_envs=3), 3 * first)
        now = [one.reset(seed=seed) for one, seed in zip(single, seeds, strict=True)]
        episodes = [[], [], []]
        for actions in taken[first : first + 20]:
            ended = []
            for i, one in enumerate(single):
                observation, info = now[i]
                after, _, _, truncated, later = one.step(actions[i])
                entry = transition(observation, actions[i], after, later["collision"])
                episodes[i].append(entry)
                now[i] = after, info
                if truncated:
                    expected.add_episode(episodes[i])
                    episodes[i], now[i] = [], one.reset()
                    ended.append(demos[info["demo"]])
            for demo in ended:
                number_ended += 1
                if rng.random() < 0.4:
                    injected += 1
                    expected.add_episode(demo_transitions(demo, env))
        for episode in episodes:
            expected.add_episode(episode)
    assert len(taken) == 40 and 0 < injected < number_ended == 12
    assert state["progress"]["demos_injected"] == injected
    arrays = expected.state_dict()["arrays"]
    assert arrays.keys() == state["buffer"]["arrays"].keys()
    for name, array in arrays.items():
        assert torch.equal(array, state["buffer"]["arrays"][name]), name
    events = EventAccumulator(str(run)).Reload().Scalars("charts/episodic_return")
    assert [event.value for event in events] == [-8] * 12


CLONING = ["--goal-type", "config", "--demo-prob", "1", "--bc-weight", "5"]


def test_cloning_adds_demonstrated_transitions_to_every_batch(
    tmp_path, demo_file, monkeypatch, short_episodes
):
    calls = {"explore": [], "update_critics": [], "update_actor": []}

    def recorded(function, device):
        def call(data):
            calls[function.__name__].append(data)
            return function(data)

        return call

    monkeypatch.setattr(cuda_graphs, "graphed", recorded)
    # A goal is reached where it is the last of its episode: none is relabelled.
    flags = [*CLONING, "--demos", str(demo_file), "--her-probability", "0", *ONE_EVALUATION]
    run_script("sac_her_mp", tmp_path, *flags)
    env, demos = panda_env("config"), load_demos(demo_file)
    episodes = [demo_transitions(demo, env) for demo in demos]
    entries = [(transition, episode[-1]) for episode in episodes for transition in episode]
    seen, names = set(), ("observation", "action", "next_observation", "desired_goal")
    stacked = {name: np.float32([one[name] for one, _ in entries]) for name in names}
    assert len(calls["update_critics"]) == 40 and len(calls["update_actor"]) == 20
    for batch in calls["update_critics"][::10]:
        assert all(len(value) == 16 + 128 for value in batch.values())
        rows = {name: value[-128:].numpy() for name, value in batch.items()}
        for i in range(128):
            alike = [(stacked[name] == rows[name][i]).all(1) for name in names]
            (which,) = np.flatnonzero(np.all(alike, axis=0))
            seen.add(which)
            one, last = entries[which]
            assert rows["terminated"][i] == (one is last) and rows["reward"][i] == (one is last) - 1
    assert len(seen) > 0.5 * min(len(entries), 4 * 128)  # all of them, not the first alone


def test_resumed_run_with_cloning_is_the_same(tmp_path, demo_file, short_episodes):
    # Two files, as one and in parts.
    flags = [*CLONING, "--demos", str(demo_file), str(demo_file)]
    flags += ["--eval-queries", "1", "--test-queries", "0", "--learning-starts", "100"]
    flags += ["--eval-every", "150", "--total-timesteps", "300"]
    whole = run_script("td3_her_mp", tmp_path / "whole", *flags)
    parts = run_script("td3_her_mp", tmp_path / "parts", *flags, "--total-timesteps", "150")
    run_here(PATHS["td3_her_mp"], "--resume", parts, "--total-timesteps", "300")
    one, other = (torch.load(run / "checkpoint.pt", weights_only=True) for run in (whole, parts))
    for key, tensor in one["agent"].items():
        assert torch.equal(tensor, other["agent"][key]), key
