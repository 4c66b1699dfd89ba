"""Policies by name, and the commands of an installed package."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import envs
from envs.exported_networks import halve_network
from envs.last_layer import LastLayer
from envs.policies import (
    PolicyError,
    find_policy,
    make_policy,
    own_layer,
    policy_file,
    shipped_policies,
)

ROOT = Path(__file__).resolve().parents[1]


def test_shipped_policies_are_found_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = {path.stem: path for path in ROOT.glob("*/policies/*.pt")}
    assert len(kept) > 10 and shipped_policies() == kept
    assert policy_file("bc-config-double_walls-s1").samefile(
        ROOT / "bc_script/policies/bc-config-double_walls-s1.pt"
    )
    path, arguments = find_policy("sac-ee-wall-p1-s1")
    assert path == kept["sac-ee-wall-p1-s1"] and arguments["goal_type"] == "ee"
    # A file or folder of that name comes first.
    (tmp_path / "sac-ee-wall-p1-s1").mkdir()
    names = ", ".join(sorted(kept))
    with pytest.raises(PolicyError, match=f"no such policy.*or a name: {names}"):
        policy_file("sac-ee-wall-p1-s2")
    (tmp_path / "sac-ee-wall-p1-s1" / "policy.pt").write_bytes(b"")
    assert policy_file("sac-ee-wall-p1-s1") == Path("sac-ee-wall-p1-s1/policy.pt")


@pytest.mark.parametrize("name", shipped_policies())
def test_shipped_policies_are_in_half_precision(name, tmp_path):
    path = shipped_policies()[name]
    halve_network(path, tmp_path / "policy.pt")
    assert (tmp_path / "policy.pt").read_bytes() == path.read_bytes()


def test_a_policy_in_an_environment_without_what_it_sees():
    path, arguments = find_policy("bc-combined-oracle-random_boxes_hard-s1")
    assert arguments["encoder"] == "oracle"
    del arguments["encoder"]
    env = envs.make("random_boxes_hard", **arguments)
    with pytest.raises(PolicyError, match="bc-combined-oracle-random_boxes_hard-s1.pt"):
        make_policy(path, env)
    env.close()


def test_a_policy_whose_actions_mean_something_else():
    env = envs.make("wall", action_mode="subgoal")
    trained = find_policy("sac-ee-wall-p1-s1")[0]
    for policy in ("go-to-goal", "via-points", "planner", trained):
        with pytest.raises(PolicyError, match="of mode"):
            make_policy(policy, env)
    make_policy("random", env)
    env.close()


def test_a_shipped_policy_brings_what_it_sees_and_its_last_layer():
    path, arguments = find_policy("dagger-combined-points-random_boxes_hard-s1")
    assert arguments == {"goal_type": "combined", "encoder": "points:32", "proximity": "points"}
    assert own_layer(path) == LastLayer(keep=0.01, way_out=True)
    assert own_layer(policy_file("bc-config-double_walls-s1")) is None


def test_envs_needs_neither_the_planner_nor_the_trainers():
    code = "import sys, envs.policies, envs.show, envs.datasets, envs.world; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    modules = set(run.stdout.split())
    others = ("demo_generation", "clean_rl_scripts", "bc_script", "ompl", "torch", "numba")
    assert "envs.show" in modules and not modules & set(others)


def test_the_commands_of_an_installed_package_exist():
    text = (ROOT / "pyproject.toml").read_text().split("[project.scripts]")[1].split("[")[0]
    commands = dict(re.findall(r'^([\w-]+) = "([\w.:]+)"', text, re.MULTILINE))
    assert {"roboarm-evaluate", "roboarm-show", "roboarm-train-sac"} <= set(commands)
    for target in commands.values():
        module, function = target.split(":")
        assert callable(getattr(importlib.import_module(module), function))


def test_a_trainer_as_a_command():
    code = "import sys; from clean_rl_scripts.commands import train_sac; train_sac()"
    run = subprocess.run(
        [sys.executable, "-c", code, "--help"], cwd=ROOT, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert "--total-timesteps" in run.stdout and "--goal-type" in run.stdout
