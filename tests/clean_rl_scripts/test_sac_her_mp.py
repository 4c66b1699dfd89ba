"""sac_her_mp.py: numbers against independent formulas, and runs with flags of its own."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainers import ONE_EVALUATION, PATHS, load, panda_env, run_here, run_script

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import Demos, load_demos
from roboarm_nmp.datasets.episodes import demo_transitions
from roboarm_nmp.datasets.format import QueryScenes
from roboarm_nmp.demo_generation import collect
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.training import cuda_graphs
from roboarm_nmp.training.network_parts import JacobianTranspose

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
        args = sac.Args(goal_type=goal_type, jacobian=jacobian)
        features = sac.Features(args, panda_env(goal_type))
        inputs, added = features(*tensors).numpy(), []
        if jacobian and to_goal:
            given = tensors[0][:, :7], tensors[0][:, 7:], torch.tensor(to_goal[0]).float()
            added = [JacobianTranspose(PANDA)(*given).numpy()]
            added.append(added[0] / np.linalg.norm(added[0], axis=1, keepdims=True))
        assert inputs.shape == (5, features.size)
        numbers = np.hstack([*expected, *to_goal, *added, *to_goal_state])
        np.testing.assert_allclose(inputs, numbers, atol=1e-5)
    plain = sac.Features(sac.Args(goal_type=goal_type, plain_networks=True), panda_env(goal_type))
    np.testing.assert_array_equal(plain(*tensors), torch.cat(tensors, dim=1))


def test_network_inputs_of_goal_poses():
    env = panda_env("pose")
    features = sac.Features(sac.Args(goal_type="pose"), env)
    without = sac.Features(sac.Args(goal_type="pose", jacobian=False), env)
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


def test_relabelled_goals_are_reached_later_in_the_same_episode():
    env = envs.make("no_obstacles")
    buffer = sac.HerReplayBuffer(env, 100, 1.0, np.random.default_rng(0))
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
    # The future strategy: each later step of an episode is equally likely.
    first = goal[now == 100]
    counts = np.bincount((first - 100).astype(int), minlength=6)
    assert abs(counts / len(first) - 1 / 6).max() < 0.06


def test_goals_reached_soon_are_preferred():
    env = envs.make("no_obstacles")
    buffer = sac.HerReplayBuffer(env, 100, 1.0, np.random.default_rng(0), her_exponent=2.0)
    buffer.add_episode(episode(6, 0, env))
    batch = buffer.sample(20_000)
    goal = batch["desired_goal"][batch["next_achieved_goal"][:, 0] == 0, 0].astype(int)
    # The square of a uniform number is below x with probability sqrt(x).
    expected = np.diff(np.sqrt(np.arange(7) / 6))
    np.testing.assert_allclose(np.bincount(goal, minlength=6) / len(goal), expected, atol=0.03)


def test_share_of_relabelled_goals():
    env = envs.make("no_obstacles")
    buffer = sac.HerReplayBuffer(env, 100, 0.8, np.random.default_rng(0))
    buffer.add_episode(episode(20, 0, env))
    goals = buffer.sample(10_000)["desired_goal"][:, 0]
    assert abs((goals != -5).mean() - 0.8) < 0.02


def test_collisions_end_episodes_only_with_stop_on_collision():
    for stop in (False, True):
        env = envs.make("no_obstacles", stop_on_collision=stop)
        buffer = sac.HerReplayBuffer(env, 10, 0.0, np.random.default_rng(0))
        buffer.add_episode(episode(3, 0, env))
        batch = buffer.sample(100)
        collided = batch["next_achieved_goal"][:, 0] == 1
        np.testing.assert_array_equal(batch["terminated"], collided if stop else 0 * collided)
        np.testing.assert_array_equal(batch["reward"], -1)


def test_ring_overwrites_the_oldest_and_keeps_episodes_apart():
    env = envs.make("no_obstacles")
    buffer = sac.HerReplayBuffer(env, 10, 1.0, np.random.default_rng(0))
    for offset in (0, 100, 200):
        buffer.add_episode(episode(4, offset, env))  # the third wraps around over half the first
    assert buffer.size == 10
    batch = buffer.sample(5000)
    now, goal = batch["next_achieved_goal"][:, 0], batch["desired_goal"][:, 0]
    assert set(now.tolist()) == {2, 3, 100, 101, 102, 103, 200, 201, 202, 203}
    assert (now // 100 == goal // 100).all() and (goal >= now).all()


def test_updates_fall_due_evenly_after_learning_starts():
    args = sac.Args(learning_starts=200, updates_per_step=0.3, num_envs=7)
    due = {step: sac.updates_due(step, args) for step in range(7, 7001, 7)}
    assert all(number == 0 for step, number in due.items() if step <= 200)
    assert sum(due.values()) == int((7000 - 200) * 0.3)
    assert set(list(due.values())[30:]) == {2, 3}  # 2.1 per seven steps


# --- Demonstrations


def hand_made_demos(number=3, steps=12, task="no_obstacles"):
    """Straight motions of 0.02 per step, normalised; the arm would follow them without lag."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(number, 7))
    direction *= 0.02 / np.linalg.norm(direction, axis=1, keepdims=True)
    first = rng.uniform(-0.5, 0.5, (number, 7))
    states = first[:, None] + np.arange(steps + 1)[:, None] * direction[:, None]
    actions = np.repeat(direction[:, None], steps + 1, axis=1)
    actions[:, -1] = 0.0
    ends = PANDA.denormalise(states[:, [0, -1]]).astype(np.float32)
    return Demos(
        task=task,
        seed=0,
        start=ends[:, 0],
        goal=ends[:, 1],
        scenes=QueryScenes(envs.TASKS[task].scene),
        states=states.reshape(-1, 7).astype(np.float32),
        actions=actions.reshape(-1, 7).astype(np.float32),
        offsets=np.arange(number + 1) * (steps + 1),
        plan=ends.reshape(-1, 7),
        plan_offsets=np.arange(number + 1) * 2,
        plan_seed=np.arange(number),
        digest=np.zeros(number, np.uint32),
        collided=np.zeros(number, bool),
        made_by="a test",
        parameters={},
    )


@pytest.mark.parametrize("goal_type", ["ee", "config", "combined"])
def test_demonstration_as_transitions_by_hand(goal_type):
    demo = hand_made_demos()[1]
    env = envs.make("no_obstacles", goal_type=goal_type)
    episode = demo_transitions(demo, env)
    angles = PANDA.denormalise(demo.states.astype(np.float64))
    positions = PANDA.forward_kinematics(angles)
    goal_position = PANDA.forward_kinematics(demo.goal)
    if goal_type == "config":
        reached = np.linalg.norm(demo.states - PANDA.normalise(demo.goal), axis=1) <= 0.05
    else:
        reached = np.linalg.norm(positions - goal_position, axis=1) <= 0.02
    assert len(episode) == np.argmax(reached) < len(demo.actions)  # cut where the goal is reached
    for t, transition in enumerate(episode):
        observation = np.concatenate([demo.states[t], positions[t]])
        np.testing.assert_allclose(transition["observation"], observation, atol=1e-6)
        observation = np.concatenate([demo.states[t + 1], positions[t + 1]])
        np.testing.assert_allclose(transition["next_observation"], observation, atol=1e-6)
        np.testing.assert_array_equal(transition["action"], demo.actions[t])
        assert not transition["collision"]
        goal = {
            "ee": goal_position,
            "config": PANDA.normalise(demo.goal),
            "combined": np.concatenate([PANDA.normalise(demo.goal), goal_position]),
        }[goal_type]
        np.testing.assert_allclose(transition["desired_goal"], goal, atol=1e-6)
    env.action_mode = "subgoal"
    sub_goals = demo_transitions(demo, env)
    np.testing.assert_allclose(sub_goals[3]["action"], demo.states[4], atol=1e-6)
    env.close()


@pytest.fixture(scope="module")
def demo_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "demos.h5"
    options = collect.options_of(collect.Args("no_obstacles"))
    collect.collect(path, 4, options, progress=False)
    return path


def test_failed_episodes_on_the_demonstrations_queries_inject_these(tmp_path, demo_file):
    demos = load_demos(demo_file)
    flags = ["--demo-prob", "0.4", "--demos", str(demo_file)]
    run = run_script("sac_her_mp", tmp_path, *flags)
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    arrays = {name: array.numpy() for name, array in state["buffer"]["arrays"].items()}
    events = EventAccumulator(str(run)).Reload()
    first = np.concatenate([[True], arrays["remaining"][:-1] == 0])
    observation, goal = arrays["observation"][first], arrays["desired_goal"][first]
    starts = PANDA.normalise(demos.start)
    query = np.array([np.abs(starts - row[:7]).max(1).argmin() for row in observation])
    assert np.abs(starts[query] - observation[:, :7]).max() < 1e-3  # all on the demos' queries
    np.testing.assert_allclose(goal, PANDA.forward_kinematics(demos.goal)[query], atol=1e-6)
    injected = [
        np.abs(action - demos[q].actions[0]).max() < 1e-6
        for q, action in zip(query, arrays["action"][first], strict=True)
    ]
    failures = len(events.Scalars("charts/episodic_length"))  # so short a run never succeeds
    assert events.Scalars("charts/success")[-1].value == 0
    assert sum(injected) == events.Scalars("charts/demos_injected")[-1].value
    assert 0 < sum(injected) < failures


CLONING = ["--demo-prob", "1", "--bc-weight", "5", "--demo-batch-size", "6"]


def test_cloning_adds_demonstrated_transitions_to_every_batch(tmp_path, demo_file, monkeypatch):
    batches, graphed = [], cuda_graphs.graphed

    def recorded(function, args, device):
        def call(data, *options):
            batches.append(data)
            return function(data, *options)

        is_update = function.__name__ == "update"
        return call if is_update else graphed(function, args, device)

    monkeypatch.setattr(cuda_graphs, "graphed", recorded)
    # A goal is reached where it is the last of its episode: none is relabelled.
    flags = [*CLONING, "--demos", str(demo_file), "--her-probability", "0", *ONE_EVALUATION]
    run_script("sac_her_mp", tmp_path, *flags)
    env, demos = panda_env(), load_demos(demo_file)
    episodes = [demo_transitions(demo, env) for demo in demos]
    entries = [(transition, episode[-1]) for episode in episodes for transition in episode]
    seen, names = set(), ("observation", "action", "next_observation", "desired_goal")
    stacked = {name: np.float32([one[name] for one, _ in entries]) for name in names}
    assert len(batches) == 40
    for batch in batches:
        assert all(len(value) == 16 + 6 for value in batch.values())
        rows = {name: value[-6:].numpy() for name, value in batch.items()}
        for i in range(6):
            alike = [(stacked[name] == rows[name][i]).all(1) for name in names]
            (which,) = np.flatnonzero(np.all(alike, axis=0))
            seen.add(which)
            one, last = entries[which]
            assert rows["terminated"][i] == (one is last) and rows["reward"][i] == (one is last) - 1
    assert len(seen) > 0.5 * min(len(entries), 240)  # all of them, not the first alone


def test_resumed_run_with_cloning_is_the_same(tmp_path, demo_file):
    # Two files, as one and in parts.
    flags = [*CLONING, "--demos", str(demo_file), str(demo_file)]
    flags += ["--eval-queries", "1", "--test-queries", "0"]
    whole = run_script("td3_her_mp", tmp_path / "whole", *flags)
    parts = run_script("td3_her_mp", tmp_path / "parts", *flags, "--total-timesteps", "300")
    run_here(PATHS["td3_her_mp"], "--resume", parts, "--total-timesteps", "600")
    one, other = (torch.load(run / "checkpoint.pt", weights_only=True) for run in (whole, parts))
    for name in ("actor", "actor_average", "critics"):
        for key, tensor in one[name].items():
            assert torch.equal(tensor, other[name][key]), (name, key)
