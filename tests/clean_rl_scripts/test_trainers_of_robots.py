"""Trainers, policies and evaluations of another arm than the Panda: xArm6, 6 joints."""

import json
import shutil

import numpy as np
import onnx
import pytest
import torch
from paths import ROOT
from trainers import PATHS, load, panda_env, refusal, run_here, run_script

from roboarm_nmp import envs
from roboarm_nmp.clean_rl_scripts import evaluate as evaluate_command
from roboarm_nmp.datasets.demonstrations import demo_path
from roboarm_nmp.datasets.queries import query_path
from roboarm_nmp.demo_generation import collect, make_queries, roadmaps
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.evaluation.evaluate import EvaluationError, evaluate
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.policies.export import save_policy
from roboarm_nmp.policies.registry import PolicyError, find_policy, make_policy

EXAMPLE = ROOT / "examples" / "robots" / "xarm6.yaml"
PANDAS = "sac-ee-wall-p1-s1"  # a pretrained policy
SHORT = {
    "td3_her_mp": ["--geometry-source", "ground_truth", "--link-distances"],
    "bc": ["--num-modes", "2", "--eval-every", "600"],
    "roadmap_bc": ["--encoder", "point_cloud", "--eval-every", "40"],
    "flow": ["--eval-every", "40"],
}
SHORT["td3_her_mp"] += ["--demo-prob", "1", "--bc-weight", "2", "--learning-starts", "60"]
SHORT["td3_her_mp"] += ["--eval-every", "150", "--total-timesteps", "150"]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """The arm's file. Beside it are queries, demonstrations, and roadmap paths in two scenes."""
    folder = tmp_path_factory.mktemp("xarm6")
    file = shutil.copy(EXAMPLE, folder / "xarm6.yaml")
    task = f"no_obstacles@{file}"
    make_queries.make_queries(query_path(task), task, 0, 4, 3, progress=False)
    options = collect.options_of(collect.Args(task))
    collect.collect(demo_path(task), 3, options, progress=False)
    sizes = {"scenes": 2, "paths_per_scene": 6, "num_nodes": 150, "workers": 1}
    roadmaps.collect(
        roadmaps.Args(folder / "roadmaps", task=f"random_boxes_hard@{file}", **sizes),
        progress=False,
    )
    return file


@pytest.mark.parametrize("trainer", SHORT)
def test_trainer_trains_another_arm(trainer, file, tmp_path, monkeypatch, short_episodes):
    monkeypatch.chdir(file.parent)
    flags = ["--task", "no_obstacles@xarm6.yaml", *SHORT[trainer]]
    run = run_script(trainer, tmp_path, *flags)
    args, result = (json.loads((run / f"{one}.json").read_text()) for one in ("args", "result"))
    assert args["task"] == result["task"] == "no_obstacles@xarm6.yaml"
    assert result["robot"] == "xarm6" and run.name.startswith("no_obstacles@xarm6__")
    robot = load_robot(file)
    metadata = load_network(run / "policy.onnx").metadata
    assert metadata["robot"] == ["xarm6", robot.fingerprint]
    # On its own task, and resumed, also from another folder.
    assert evaluate(run, num_queries=2)["robot"] == "xarm6"
    monkeypatch.chdir(ROOT)
    run_here(PATHS[trainer], "--resume", run, "--test-queries", "1")
    with pytest.raises(EvaluationError, match="trained for the robot 'xarm6' .*, not for 'panda'"):
        evaluate(run, "no_obstacles", num_queries=2)


def test_policy_of_the_panda_is_rejected_for_another_arm(file):
    task = f"no_obstacles@{file}"
    with pytest.raises(EvaluationError, match="trained for the robot 'panda' .*, not for 'xarm6'"):
        evaluate(PANDAS, task)
    policy, arguments = find_policy(PANDAS)
    with pytest.raises(PolicyError, match=f"{PANDAS}.*'panda' .*, not for 'xarm6'"):
        make_policy(policy, envs.make(task, **arguments))
    assert "robot" not in load_network(policy).metadata


def test_exported_policy_names_its_arm(file, tmp_path):
    class GoToGoal(torch.nn.Module):
        def forward(self, observation, achieved_goal, desired_goal):
            return (desired_goal - observation[:, : desired_goal.shape[1]]).clamp(-1.0, 1.0)

    task, path = f"no_obstacles@{file}", tmp_path / "policy.onnx"
    save_policy(path, GoToGoal(), task, goal_type="config")
    assert load_network(path).metadata["robot"] == ["xarm6", load_robot(file).fingerprint]
    assert evaluate(path)["success_rate"] == evaluate("go-to-goal", task)["success_rate"]
    model = onnx.load(path)
    [entry] = [entry for entry in model.metadata_props if entry.key == "robot"]
    entry.value = "7"
    onnx.save(model, tmp_path / "bad.onnx")
    with pytest.raises(EvaluationError, match="bad.onnx: it was trained for the robot 7"):
        evaluate(tmp_path / "bad.onnx")


def test_discount_factor_and_target_entropy_depend_on_the_joints(file):
    sac = load("sac_her_mp")
    xarm6 = envs.make(f"no_obstacles@{file}")  # its first joint turns all the way round
    for given, of_panda, of_xarm6 in (("auto", -7.0, -6.0), (-14.0, -14.0, -14.0), (None,) * 3):
        args = sac.Args(target_entropy=given, hidden_size=16)
        for env, entropy, gamma in ((panda_env(), of_panda, 0.95), (xarm6, of_xarm6, 0.98)):
            agent = sac.SAC(args, env, torch.device("cpu"))
            assert (agent.target_entropy, agent.gamma) == (entropy, gamma)


def test_evaluate_command_takes_a_robot(file, capsys):
    flags = ["--policy", "go-to-goal", "--task", f"no_obstacles@{file}", "--workers", "1"]
    path = file.parent / "result.json"
    assert evaluate_command.main([*flags, "--json", str(path), "--safety-margin", "0.01"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["robot", "xarm6"] in lines
    assert json.loads(path.read_text())["robot"] == "xarm6"
    assert evaluate_command.main(["--policy", "random", "--task", f"wall@{file}"]) == 2
    assert "wall is the Panda's" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("policy", "source"), [("via-points", "point_cloud"), ("planner", "ground_truth")]
)
def test_baselines_move_another_arm(policy, source, file):
    task, rng = f"random_boxes_hard@{file}", np.random.default_rng(0)
    scene = envs.get_task(task).scene.sample(rng)
    env = envs.make(task)
    env.set_scene(scene)
    start, goal = np.stack([env.sample_query(rng) for _ in range(3)], axis=1)
    queries = type("Queries", (), {"start": start, "goal": goal, "scenes": [scene] * 3})
    result = evaluate(policy, task, queries=queries, geometry_source=source)
    assert result["num_queries"] == 3 and result["robot"] == "xarm6"
    if source == "ground_truth":
        assert result["collision_free_success_rate"] == 1.0


def test_robot_that_cannot_be_used_is_rejected(file, capsys, tmp_path):
    message = refusal("sac_her_mp", capsys, tmp_path, "--task", "no_obstacles@nothing.yaml")
    assert "--task: nothing.yaml: No such file" in message
    message = refusal("bc", capsys, tmp_path, "--task", f"boxes@{file}")
    assert "is the Panda's" in message
    message = refusal("roadmap_bc", capsys, tmp_path, "--paths", str(file.parent / "roadmaps"))
    assert "--paths: " in message and "made for the robot 'xarm6' " in message
