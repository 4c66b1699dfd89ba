"""training/protocol.py: results and rules of evaluations. (Whole runs: test_trainers.py.)"""

import json
import signal
import sys
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.networks.export import save_network
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.policies.registry import OUTPUTS, PolicyError, make_policy
from roboarm_nmp.policies.safety_filter import SafetyFilter
from roboarm_nmp.training import protocol
from roboarm_nmp.utils import flags

HARD = "random_boxes_hard"
DISTANCES = {"link_distances": True, "geometry_source": "ground_truth"}


@dataclass
class Flags(protocol.PolicyFlags):
    goal_type: str = "config"


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    """What a run sets for its process."""
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


def a_run(folder, env_arguments, eval_envs, task="no_obstacles", validation=()):
    """A `PolicyRun` without anything to train."""
    args = Flags(task=task, runs_dir=folder / "runs")
    return protocol.PolicyRun(args, {}, "cpu", env_arguments, eval_envs, validation)


class Toward(torch.nn.Module):
    """Straight to the goal configuration, in steps of `size` (L2)."""

    def __init__(self, size):
        super().__init__()
        self.size = size

    def forward(self, observation, achieved_goal, desired_goal):
        apart = desired_goal - observation[:, :7]
        return self.size * apart / torch.linalg.vector_norm(apart, dim=1, keepdim=True)


def test_results_do_not_depend_on_the_number_of_environments():
    queries = load_queries("wall", "validation")[:6]
    policy = Toward(0.03)
    found = protocol.evaluate(
        policy, protocol.make_envs("wall", 3, goal_type="config"), queries, "cpu"
    )
    env, outcomes = envs.make("wall", goal_type="config"), []
    for query in queries:
        observation, _ = env.reset_specific(*query)
        over = False
        while not over:
            batch = {name: torch.tensor(value[None]) for name, value in observation.items()}
            observation, _, terminated, truncated, info = env.step(policy(**batch)[0].numpy())
            over = terminated or truncated
        outcomes.append((info["is_success"], info["collision_so_far"], info["elapsed_steps"]))
    assert len({outcome[:2] for outcome in outcomes}) > 1  # some collide or fail, others do not
    success, collides, steps = np.array(outcomes).T
    assert found == {
        "success_rate": success.mean(),
        "collision_free_success_rate": (success * (1 - collides)).mean(),
        "collision_rate": collides.mean(),
        "episode_length": steps.mean(),
    }


def test_safety_filter_has_its_own_state_in_every_episode():
    queries = load_queries(HARD, "validation")[:7]
    straight, safety_filter = Toward(0.03), SafetyFilter(0.012)

    def policy(observation, achieved_goal, desired_goal, **_):
        return straight(observation, achieved_goal, desired_goal)

    several, one = (
        protocol.make_envs(HARD, number, goal_type="config", **DISTANCES) for number in (3, 1)
    )
    found, outcomes = protocol.evaluate(policy, several, queries, "cpu", safety_filter), []
    for i, query in enumerate(queries):

        def act(observation):
            return policy(**protocol.stack([observation], "cpu"))[0].numpy()

        act = safety_filter.filter_policy(act, one[0], np.random.default_rng([0, i]))
        observation, _ = one[0].reset_specific(*query)
        over = False
        while not over:
            observation, _, terminated, truncated, info = one[0].step(act(observation))
            over = terminated or truncated
        outcomes.append((info["is_success"], info["elapsed_steps"]))
    success, steps = np.mean(outcomes, axis=0)
    assert found["success_rate"] == success and found["episode_length"] == steps
    bare = protocol.evaluate(policy, several, queries, "cpu")
    assert found["collision_rate"] < bare["collision_rate"]


class Hesitant(torch.nn.Module):
    """Toward the goal, alternately fast and slow: the recurrent state has the steps and moves."""

    recurrent_size = 8

    def forward(self, observation, achieved_goal, desired_goal, recurrent_state):
        steps, moved = recurrent_state[:, :1], recurrent_state[:, 1:]
        speed = 0.03 + 0.02 * torch.sin(steps) - 0.002 * torch.abs(moved)
        action = speed * torch.tanh(10 * (desired_goal - observation[:, :7]))
        return action, torch.cat([steps + 1, moved + action], dim=1)


def test_recurrent_state_starts_at_zero_in_every_episode(tmp_path):
    arguments, queries = {"goal_type": "config"}, load_queries("wall", "validation")[:5]
    several = protocol.make_eval_envs("wall", 3, **arguments)
    found, policy, outcomes = protocol.evaluate(Hesitant(), several, queries, "cpu"), Hesitant(), []
    env = envs.make("wall", **arguments)
    for query in queries:
        observation, _ = env.reset_specific(*query)
        over, state = False, torch.zeros(1, 8)
        while not over:
            action, state = policy(**protocol.stack([observation], "cpu"), recurrent_state=state)
            observation, _, terminated, truncated, info = env.step(action[0].numpy())
            over = terminated or truncated
        assert state[0, 0] == info["elapsed_steps"]
        outcomes.append((info["is_success"], info["elapsed_steps"]))
    assert len({steps for _, steps in outcomes}) == 5
    success, steps = np.mean(outcomes, axis=0)
    assert found["success_rate"] == success and found["episode_length"] == steps

    run = a_run(tmp_path, arguments, several, task="wall")
    run.save_policy(policy)
    saved = load_network(run.folder / "policy.onnx")
    assert saved.metadata["recurrent_size"] == 8 and "recurrent_state" in saved.inputs
    assert protocol.evaluate(saved, several, queries, "cpu") == found
    result = evaluate(run.folder, "wall", split="validation", num_queries=5)
    assert result["success_rate"] == success
    reached = [steps for success, steps in outcomes if success]
    assert result["mean_steps"] == pytest.approx(np.mean(reached))


def test_recurrent_state_of_another_size_than_the_metadata_is_rejected(tmp_path):
    env = envs.make("wall", goal_type="config")
    example = protocol.stack([env.reset(seed=0)[0]] * 2, "cpu")
    metadata = {"kind": "policy", "env": {"goal_type": "config"}}
    path = tmp_path / "policy.onnx"
    save_network(path, Toward(0.05), example, metadata | {"recurrent_size": 8}, ["action"])
    with pytest.raises(PolicyError, match="it has 1 outputs, not 2"):
        make_policy(path, env)
    example["recurrent_state"] = torch.zeros(2, 8)
    sizes = ((0, "needs recurrent_state"), (7, "recurrent_state"), (9, "recurrent_state"))
    for size, message in sizes:
        save_network(path, Hesitant(), example, metadata | {"recurrent_size": size}, OUTPUTS)
        with pytest.raises(PolicyError, match=message):
            make_policy(path, env)


def result_of(tmp_path, capsys, num_queries=3, **env_arguments):
    """`result.json` and the printed lines for a policy that needs more than 50 steps."""
    env_arguments |= {"goal_type": "config"}
    made = protocol.make_eval_envs("no_obstacles", 3, **env_arguments)
    run = a_run(tmp_path, env_arguments, made)
    run.start(10, "step")
    run.advance(7)
    run.is_best(0.5)
    run.save_policy(Toward(0.01))
    run.advance(3)
    run._bar.start_t -= 1000.0  # as if training had taken so long
    run.checkpoint()
    run.final_test(load_queries("no_obstacles", "test")[:num_queries])
    return json.loads((run.folder / "result.json").read_text()), capsys.readouterr().out


def test_final_test_is_run_under_the_standard_rules(tmp_path, capsys):
    standard, line = result_of(tmp_path, capsys)
    assert standard["success_rate"] > 0.5 and standard["episode_length"] > 50
    assert standard["rules"] == standard["rules_in_training"]
    assert (standard["policy_step"], standard["steps"]) == (7, 10)
    assert 1000 <= standard["seconds"] < 1100
    assert standard["validation_success_rate"] == 0.5
    assert "trained with" not in line and "3 test queries: success" in line
    assert standard["deviations"] == {} and "not comparable" not in line
    assert standard["privileged"] is False and "privileged" not in line
    for other in ({"horizon": 50}, {"stop_on_collision": True}):
        result, lines = result_of(tmp_path, capsys, **other)
        assert result["rules"] == {"horizon": 400, "stop_on_collision": False}
        assert result["rules_in_training"] == result["rules"] | other
        assert result["success_rate"] == standard["success_rate"]
        assert result["episode_length"] == standard["episode_length"]
        assert "tested under the standard rules, 400 steps, contacts allowed:" in lines
    result, lines = result_of(tmp_path, capsys, max_step=0.02, encoder="oracle")
    assert result["deviations"] == {"max_step": 0.02}
    assert "not comparable: max_step is 0.02, not 0.03" in lines
    assert result["privileged"] and "test queries, privileged: success" in lines


def test_run_without_test_queries_has_no_figures_of_a_test(tmp_path, capsys):
    flags.check(Flags(test_queries=0))
    result, lines = result_of(tmp_path, capsys, num_queries=0)
    assert result["num_queries"] == 0 and not any("collision" in name for name in result)
    assert "success_rate" not in result and result["validation_success_rate"] == 0.5
    assert "no test, --test-queries 0; validation success 0.500 at 7" in lines
