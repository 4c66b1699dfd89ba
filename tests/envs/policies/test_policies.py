"""Policies by name, and the commands of an installed package."""

import subprocess
import sys
from pathlib import Path

import pytest
from paths import ROOT

from roboarm_nmp import envs
from roboarm_nmp.envs.networks.exported_networks import to_float16
from roboarm_nmp.envs.policies.registry import (
    PolicyError,
    find_policy,
    make_policy,
    own_safety_filter,
    policy_file,
    pretrained_policies,
)
from roboarm_nmp.envs.policies.safety_filter import SafetyFilter


def test_pretrained_policies_are_found_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = {path.stem: path for path in (ROOT / "envs/policies/pretrained").glob("*.pt")}
    assert len(kept) > 10 and pretrained_policies() == kept
    assert policy_file("bc-config-double_walls-s1").samefile(
        ROOT / "envs/policies/pretrained/bc-config-double_walls-s1.pt"
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


@pytest.mark.parametrize("name", pretrained_policies())
def test_pretrained_policies_are_in_half_precision(name, tmp_path):
    path = pretrained_policies()[name]
    to_float16(path, tmp_path / "policy.pt")
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


def test_a_pretrained_policy_brings_what_it_sees_and_its_safety_filter():
    path, arguments = find_policy("dagger-combined-point_cloud-random_boxes_hard-s1")
    assert arguments == {
        "goal_type": "combined",
        "encoder": "points:32",
        "link_distances": "points",
    }
    assert own_safety_filter(path) == SafetyFilter(keep=0.01, escape=True)
    assert own_safety_filter(policy_file("bc-config-double_walls-s1")) is None


def test_envs_needs_neither_the_planner_nor_the_trainers():
    names = ("policies.registry", "show", "datasets.queries", "world")
    imports = "; ".join(f"import roboarm_nmp.envs.{name}" for name in names)
    code = f"import sys; {imports}; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    modules = set(run.stdout.split())
    folders = ("demo_generation", "clean_rl_scripts", "bc_script")
    others = (*(f"roboarm_nmp.{folder}" for folder in folders), "ompl", "torch", "numba")
    assert "roboarm_nmp.envs.show" in modules and not modules & set(others)
