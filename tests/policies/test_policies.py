"""Policies by name: baselines, pretrained policies, and what importing them needs."""

import subprocess
import sys
from pathlib import Path

import pytest
from paths import LIBRARY, ROOT

from roboarm_nmp import envs
from roboarm_nmp.networks.export import to_float16
from roboarm_nmp.policies.registry import (
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
    path, arguments = find_policy("dagger-combined-point_cloud-random_boxes_hard-s1")
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
