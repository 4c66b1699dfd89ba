"""bc.py: likelihood against torch.distributions, data by hand, overfitting five demonstrations."""

import json

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal
from trainers import PATHS, load, panda_env, run_here, run_script

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import demo_path, load_demos
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.policies.registry import make_policy

bc = load("bc")


@pytest.mark.parametrize("num_modes", [1, 3])
def test_log_likelihood_is_that_of_torch_distributions(num_modes):
    torch.manual_seed(0)
    actor = bc.Actor(bc.Args(goal_type="ee", num_modes=num_modes), panda_env()).eval()
    observation, goal, action = torch.randn(32, 10), torch.randn(32, 3), torch.randn(32, 7)
    outputs = actor.mlp(actor.features(observation, goal)).reshape(32, num_modes, 15).double()
    std = (-5 + 3.5 * (torch.tanh(outputs[..., 7:14]) + 1)).exp()
    components = Independent(Normal(outputs[..., :7], std), 1)
    if num_modes == 1:
        expected = Independent(Normal(outputs[:, 0, :7], std[:, 0]), 1).log_prob(action.double())
    else:
        mixture = MixtureSameFamily(Categorical(logits=outputs[..., 14]), components)
        expected = mixture.log_prob(action.double())
    found = actor.log_likelihood(observation, goal, action)
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-4)


def test_action_is_the_most_likely_modes_mean():
    torch.manual_seed(0)
    actor = bc.Actor(bc.Args(goal_type="ee", num_modes=3), panda_env()).eval()
    observation, goal = torch.randn(64, 10), torch.randn(64, 3)
    mean, _, log_weight = actor.modes(observation, goal)
    chosen = [mean[i, int(log_weight[i].argmax())] for i in range(64)]
    assert len(set(log_weight.argmax(1).tolist())) > 1
    torch.testing.assert_close(actor(observation, None, goal), 0.03 * torch.stack(chosen))


@pytest.mark.parametrize("goal_type", ["ee", "config", "combined"])
def test_transitions_of_demonstrations_by_hand(goal_type):
    demos = load_demos("wall")[:3]
    observations, goals, actions, demo_index = bc.transitions(demos, goal_type)
    assert demo_index.tolist() == [i for i in range(3) for _ in range(len(demos[i].actions))]
    expected = []
    for i in range(3):
        demo = demos[i]
        goal_position, goal_state = PANDA.forward_kinematics(demo.goal), PANDA.normalise(demo.goal)
        goal = {"ee": [goal_position], "config": [goal_state]}.get(
            goal_type, [goal_state, goal_position]
        )
        for state, action in zip(demo.states[:-1], demo.actions, strict=True):
            position = PANDA.forward_kinematics(PANDA.denormalise(state))
            expected.append(np.concatenate([state, position, *goal, action / 0.03]))
    found = np.hstack([observations, goals, actions])
    np.testing.assert_allclose(found, np.array(expected), atol=1e-5)


def test_policy_overfits_five_demonstrations_and_follows_them(tmp_path, short_episodes):
    flags = (
        "--num-demos 5 --hidden-size 128 --batch-size 128 --total-updates 2000 --eval-every 2000"
    )
    flags += " --task no_obstacles --goal-type combined --learning-rate 3e-3 --policy-average 0.01"
    run = run_script("bc", tmp_path, *flags.split())
    env, demos = envs.make("no_obstacles", goal_type="combined"), load_demos("no_obstacles")
    act, *_ = make_policy(run / "policy.onnx", env)(0, None)
    for i in range(5):
        observation, _ = env.reset_specific(demos.start[i], demos.goal[i])
        over = False
        while not over:
            observation, _, terminated, truncated, info = env.step(act(observation))
            over = terminated or truncated
        assert info["is_success"]
        assert info["elapsed_steps"] < 1.3 * len(demos[i].states)
    env.close()


def test_longer_run_continues_with_a_mixture_from_two_files(tmp_path, short_episodes):
    path = str(demo_path("no_obstacles"))
    flags = ["--num-modes", "2", "--goal-type", "config", "--demos", path, path]
    flags += ["--total-updates", "100", "--eval-every", "100", "--eval-queries", "1"]
    run = run_script("bc", tmp_path, *flags)
    assert json.loads((run / "args.json").read_text())["demos"] == [path, path]
    run_here(PATHS["bc"], "--resume", run, "--total-updates", "200")
    assert json.loads((run / "result.json").read_text())["steps"] == 200
    rates = EventAccumulator(str(run)).Reload().Scalars("charts/learning_rate")
    assert [event.step for event in rates] == [1, 101]  # then every ten seconds
    assert rates[-1].value == pytest.approx(1e-3 * (1 - 100 / 200))
