"""Policies by name: baselines, pretrained policies, and what importing them needs."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from paths import LIBRARY, ROOT

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.networks.export import save_network, to_float16
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.policies.export import save_policy
from roboarm_nmp.policies.registry import (
    OUTPUTS,
    PolicyError,
    find_policy,
    make_policy,
    own_safety_filter,
    policy_file,
    pretrained_policies,
)
from roboarm_nmp.policies.safety_filter import SafetyFilter


def test_pretrained_policies_are_found_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = {path.stem: path for path in (LIBRARY / "policies" / "pretrained").glob("*.onnx")}
    found = {name: path.resolve() for name, path in pretrained_policies().items()}
    assert len(files) > 10 and found == files
    assert policy_file("bc-config-double_walls-s1").samefile(
        ROOT / "src/roboarm_nmp/policies/pretrained/bc-config-double_walls-s1.onnx"
    )
    path, arguments = find_policy("sac-ee-wall-p1-s1")
    assert path.samefile(files["sac-ee-wall-p1-s1"]) and arguments["goal_type"] == "ee"
    # A file or folder of that name takes precedence.
    (tmp_path / "sac-ee-wall-p1-s1").mkdir()
    with pytest.raises(
        PolicyError, match="no such policy: sac-ee-wall-p1-s2: did you mean sac-ee-w"
    ):
        policy_file("sac-ee-wall-p1-s2")
    with pytest.raises(
        PolicyError, match="no such policy: x: expected go-to-goal, .*`roboarm polic"
    ):
        policy_file("x")
    (tmp_path / "sac-ee-wall-p1-s1" / "policy.onnx").write_bytes(b"")
    assert policy_file("sac-ee-wall-p1-s1") == Path("sac-ee-wall-p1-s1/policy.onnx")


@pytest.mark.parametrize("name", pretrained_policies())
def test_pretrained_policies_are_stored_in_float16(name, tmp_path):
    path = pretrained_policies()[name]
    to_float16(path, tmp_path / "policy.onnx")
    assert (tmp_path / "policy.onnx").read_bytes() == path.read_bytes()


def test_policy_without_its_encoder_in_the_environment_is_rejected():
    path, arguments = find_policy("bc-combined-oracle-random_boxes_hard-s1")
    assert arguments["encoder"] == "oracle"
    del arguments["encoder"]
    env = envs.make("random_boxes_hard", **arguments)
    with pytest.raises(PolicyError, match="bc-combined-oracle-random_boxes_hard-s1.onnx"):
        make_policy(path, env)
    env.close()


def test_policy_with_actions_of_another_mode_is_rejected():
    env = envs.make("wall", action_mode="subgoal")
    trained = find_policy("sac-ee-wall-p1-s1")[0]
    for policy in ("go-to-goal", "via-points", "planner", trained):
        with pytest.raises(PolicyError, match="of mode"):
            make_policy(policy, env)
    make_policy("random", env)
    env.close()


def test_pretrained_policy_brings_its_observations_and_its_safety_filter():
    path, arguments = find_policy("roadmap-bc-combined-point_cloud-random_boxes_hard-s1")
    assert arguments == {
        "goal_type": "combined",
        "encoder": "point_cloud",
        "num_points": 32,
        "geometry_source": "point_cloud",
        "link_distances": True,
    }
    assert own_safety_filter(path) == SafetyFilter(margin=0.01, escape=True)
    assert own_safety_filter(policy_file("bc-config-double_walls-s1")) is None
    assert own_safety_filter("planner") is None


def test_policies_are_listed_without_what_takes_long_to_import():
    code = "import sys, roboarm_nmp.policies.registry; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    modules = set(run.stdout.split())
    folders = ("demo_generation", "clean_rl_scripts", "bc_script")
    others = (*(f"roboarm_nmp.{folder}" for folder in folders), "ompl", "torch", "numba")
    assert "roboarm_nmp.policies.registry" in modules and not modules & set(others)


class Hesitant(torch.nn.Module):
    """Toward the goal, alternately fast and slow: the recurrent state has the steps and moves."""

    recurrent_size = 8

    def forward(self, observation, achieved_goal, desired_goal, recurrent_state):
        steps, moved = recurrent_state[:, :1], recurrent_state[:, 1:]
        speed = 0.03 + 0.02 * torch.sin(steps) - 0.002 * torch.abs(moved)
        action = speed * torch.tanh(10 * (desired_goal - observation[:, :7]))
        return action, torch.cat([steps + 1, moved + action], dim=1)


def tensors(*observations):
    """Observations as a batch."""
    names = observations[0]
    return {name: torch.tensor(np.stack([one[name] for one in observations])) for name in names}


def test_recurrent_state_starts_at_zero_in_every_episode(tmp_path):
    path, outcomes = tmp_path / "policy.onnx", []
    save_policy(path, Hesitant(), "wall", goal_type="config")
    saved = load_network(path)
    assert saved.metadata["recurrent_size"] == 8 and "recurrent_state" in saved.inputs
    env = envs.make("wall", goal_type="config")
    for query in load_queries("wall", "validation")[:5]:
        observation, info = env.reset_specific(*query)
        over, state = False, torch.zeros(1, 8)
        while not over:
            action, state = Hesitant()(**tensors(observation), recurrent_state=state)
            observation, _, terminated, truncated, info = env.step(action[0].numpy())
            over = terminated or truncated
        assert state[0, 0] == info["elapsed_steps"]
        outcomes.append((info["is_success"], info["elapsed_steps"]))
    reached = [steps for success, steps in outcomes if success]
    assert len(set(reached)) > 1
    result = evaluate(path, "wall", split="validation", num_queries=5)
    assert result["success_rate"] == len(reached) / 5
    assert result["mean_steps"] == pytest.approx(np.mean(reached))


def test_recurrent_state_of_another_size_than_the_metadata_is_rejected(tmp_path):
    class Still(torch.nn.Module):
        def forward(self, observation, achieved_goal, desired_goal):
            return 0.0 * (observation[:, :7] + achieved_goal + desired_goal)

    env = envs.make("wall", goal_type="config")
    example = tensors(*[env.reset(seed=0)[0]] * 2)
    metadata = {"kind": "policy", "env": {"goal_type": "config"}}
    path = tmp_path / "policy.onnx"
    save_network(path, Still(), example, metadata | {"recurrent_size": 8}, ["action"])
    with pytest.raises(PolicyError, match="it has 1 outputs, not 2"):
        make_policy(path, env)
    example["recurrent_state"] = torch.zeros(2, 8)
    sizes = ((0, "needs recurrent_state"), (7, "recurrent_state"), (9, "recurrent_state"))
    for size, message in sizes:
        save_network(path, Hesitant(), example, metadata | {"recurrent_size": size}, OUTPUTS)
        with pytest.raises(PolicyError, match=message):
            make_policy(path, env)
