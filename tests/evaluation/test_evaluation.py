"""Evaluation: metrics, baselines, safety filters, ground truth, the command and its errors."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from paths import ROOT
from straight_policy import save

from roboarm_nmp import envs
from roboarm_nmp.clean_rl_scripts import evaluate as command
from roboarm_nmp.datasets.queries import load_queries, write_queries
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.following import follow
from roboarm_nmp.envs.perception.noise import SensorNoise
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.files import save_scene
from roboarm_nmp.envs.scenes.motions import Waypoints
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.evaluation import evaluate as evaluation
from roboarm_nmp.evaluation.evaluate import EvaluationError, evaluate
from roboarm_nmp.evaluation.report import report
from roboarm_nmp.planning.planner import Planner
from roboarm_nmp.policies.safety_filter import VERSION, SafetyFilter
from roboarm_nmp.utils.signals import error_line

SCRIPT = ROOT / "clean_rl_scripts" / "evaluate.py"
HARD = "random_boxes_hard"
POLICY = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"


@pytest.fixture(scope="module")
def queries():
    env, rng = envs.make("no_obstacles"), np.random.default_rng(0)
    pairs = [env.sample_query(rng) for _ in range(40)]
    env.close()
    return SimpleNamespace(
        start=np.array([pair[0] for pair in pairs]), goal=np.array([pair[1] for pair in pairs])
    )


@pytest.fixture(scope="module")
def query_file(queries, tmp_path_factory):
    path = tmp_path_factory.mktemp("queries") / "queries.h5"
    splits = {
        "test": (queries.start[:30], queries.goal[:30]),
        "validation": (queries.start[30:], queries.goal[30:]),
    }
    write_queries(path, "no_obstacles", 0, splits, "a test", {})
    return path


def _numbers(result):
    """The numbers that must not depend on how an evaluation is run."""
    times = ("ms_per_action", "planning_seconds", "planning_seconds_solved")
    return {name: value for name, value in result.items() if name not in times}


# --- Metrics


def test_wilson_interval_equals_values_by_hand():
    # p = 0.8, n = 10, z^2 = 3.84146: centre (0.8 + 0.192073) / 1.384146, half width
    # 1.959964 * sqrt(0.016 + 0.0096036) / 1.384146
    low, high = evaluation.wilson_interval(8, 10)
    assert low == pytest.approx(0.490162, abs=1e-5)
    assert high == pytest.approx(0.943318, abs=1e-5)
    assert evaluation.wilson_interval(0, 10) == pytest.approx((0.0, 0.277533), abs=1e-5)
    assert evaluation.wilson_interval(10, 10) == pytest.approx((0.722467, 1.0), abs=1e-5)


def test_path_length_and_smoothness_equal_values_by_hand():
    configurations = np.zeros((4, 7))
    configurations[:, 0] = [0.0, 3.0, 3.0, 3.0]
    configurations[:, 1] = [0.0, 4.0, 4.0, 6.0]
    # steps (3, 4), (0, 0), (0, 2); their differences (-3, -4), (0, 2)
    assert evaluation.path_length(configurations) == pytest.approx(5 + 0 + 2)
    assert evaluation.smoothness(configurations) == pytest.approx((5 + 2) / 2)
    assert evaluation.path_length(configurations[:1]) == 0.0
    assert evaluation.smoothness(configurations[:2]) == 0.0


def test_metrics_of_an_evaluation_equal_those_of_its_episodes(queries):
    result = evaluate("go-to-goal", "no_obstacles", queries=queries)
    env, rows = envs.make("no_obstacles"), []
    for start, goal in zip(queries.start, queries.goal, strict=True):
        observation, info = env.reset_specific(start, goal)
        path, ended, contacts = [start.astype(float)], False, 0
        while not ended:
            action = PANDA.normalise(goal) - observation["observation"][:7]
            observation, _, terminated, truncated, info = env.step(action)
            path.append(PANDA.denormalise(observation["observation"][:7]))
            contacts += info["collision"]
            ended = terminated or truncated
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        touched = info["collision_so_far"]
        rows.append((info["is_success"], touched, contacts, len(path) - 1, length))
    env.close()
    success, collides, contacts, steps, lengths = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    assert result["num_queries"] == 40
    assert result["success_rate"] == success.mean() > 0.9
    assert result["collision_free_success_rate"] == (success & ~collides).mean()
    assert result["collision_rate"] == collides.mean()
    assert result["contact_share"] == contacts.sum() / steps.sum() > 0
    assert 0 < result["collision_free_success_rate"] < result["success_rate"]
    assert result["mean_steps"] == pytest.approx(steps[success].mean())
    assert result["path_length"] == pytest.approx(lengths[success].mean(), abs=1e-5)
    assert 0 < result["smoothness"] < 0.1 and result["ms_per_action"] > 0
    low, high = result["collision_free_success_rate_interval"]
    assert low < result["collision_free_success_rate"] < high
    assert json.loads(json.dumps(result)) == result


def test_stop_on_collision_leaves_collision_free_successes_only(queries):
    few = {"queries": queries, "num_queries": 20}
    free = evaluate("go-to-goal", "no_obstacles", **few)
    stopped = evaluate("go-to-goal", "no_obstacles", **few, stop_on_collision=True)
    assert free["collision_rate"] > 0
    assert (
        stopped["success_rate"]
        == stopped["collision_free_success_rate"]
        == free["collision_free_success_rate"]
    )
    assert stopped["collision_rate"] == free["collision_rate"]


# --- Reproducibility


def test_network_function_and_baseline_with_the_same_actions_agree(queries, tmp_path):
    def straight(observation):
        return observation["desired_goal"] - observation["observation"][:7]

    few = {"queries": queries, "num_queries": 5}
    threads = torch.get_num_threads()
    baseline = evaluate("go-to-goal", "no_obstacles", goal_type="config", **few)
    function = evaluate(straight, "no_obstacles", goal_type="config", **few)
    network = evaluate(save(tmp_path / "policy.onnx"), "no_obstacles", **few)
    folder = evaluate(str(tmp_path), "no_obstacles", **few)
    assert torch.get_num_threads() == threads
    assert _numbers(network) == _numbers(folder)
    assert function["policy"] == "straight"
    assert network["goal_type"] == "config" and network["policy"] == str(tmp_path / "policy.onnx")
    for result in (function, network):
        assert result["success_rate"] == baseline["success_rate"] > 0.8
        assert result["path_length"] == pytest.approx(baseline["path_length"], rel=1e-3)


def test_network_brings_its_environment_but_not_the_rules(queries, tmp_path):
    class Still(torch.nn.Module):
        def forward(self, observation, achieved_goal, desired_goal):
            return observation[:, :7] + 0 * observation[:, 14:].sum(1, keepdim=True)

    env = {"goal_type": "ee", "action_mode": "subgoal", "max_step": 0.05, "velocities": True}
    cheat = {"ee_tolerance": 10.0, "horizon": 10_000, "render_mode": "human"}
    path = save(tmp_path / "still.onnx", Still(), 3, 17, env=env | cheat)
    result = evaluate(path, "no_obstacles", queries=queries, num_queries=2)
    assert result["env"] == env | {"stop_on_collision": False}
    assert result["success_rate"] == 0.0


# --- Baselines that look for a motion

# `wall` is the box from x 0.25 to 0.95, z up to 0.775, at y = 0, 0.04 thick. Stretched out to the
# front, left and right of it: halfway between the two the hand is at (0.57, 0, 0.25), inside it.
LEFT = np.array([0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 0.8], np.float32)
RIGHT = np.array([-0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 0.8], np.float32)
HIGHER = np.array([0.8, 0.0, 0.0, -1.8, 0.0, 2.3, 0.8], np.float32)


def _queries(*pairs, **more):
    start, goal = (np.array(column) for column in zip(*pairs, strict=True))
    return SimpleNamespace(start=start, goal=goal, **more)


def test_via_points_go_around_the_wall():
    x, y, z = PANDA.forward_kinematics((LEFT + RIGHT) / 2)
    assert 0.25 < x < 0.95 and abs(y) < 0.02 and 0 < z < 0.775
    behind = _queries((LEFT, RIGHT))
    straight = evaluate("go-to-goal", "wall", queries=behind)
    assert straight["collision_free_success_rate"] == 0 and straight["collision_rate"] == 1
    assert straight["free_motion_rate"] is None and straight["planning_seconds"] is None
    result = evaluate("via-points", "wall", queries=behind, tries=200)
    assert result["collision_free_success_rate"] == 1 and result["free_motion_rate"] == 1
    assert result["planning_seconds"] == result["planning_seconds_solved"] > 0
    assert (result["tries"], result["time_limit"]) == (200, None)


def test_planner_solves_double_walls_and_follows_its_plan():
    queries = load_queries("double_walls", "validation")[:4]
    straight = evaluate("go-to-goal", "double_walls", queries=queries)
    assert straight["collision_free_success_rate"] < 0.6
    options = {"seed": 2, "time_limit": 60.0}  # so long that it does not matter
    result = evaluate("planner", "double_walls", queries=queries, **options)
    assert result["collision_free_success_rate"] == 1
    assert 0 < result["planning_seconds"] == result["planning_seconds_solved"] < 60
    assert result["free_motion_rate"] is None and result["time_limit"] == 60.0
    assert "ompl" in result["versions"] and "ompl" not in straight["versions"]

    env, rows = envs.make("double_walls"), []
    planner = Planner(env)
    for index, query in enumerate(queries):
        path = planner.plan(*query, seed=[2, index], time_limit=60.0)
        states = PANDA.denormalise(follow(env, path).states)
        to_goal = PANDA.forward_kinematics(states) - PANDA.forward_kinematics(query.goal)
        steps = int(np.argmax(np.linalg.norm(to_goal, axis=1) <= env.ee_tolerance))
        rows.append((steps, evaluation.path_length(states[: steps + 1])))
    env.close()
    steps, lengths = np.mean(rows, axis=0)
    assert result["mean_steps"] == steps
    assert result["path_length"] == pytest.approx(lengths)


def test_safety_filter_lowers_collisions_and_escapes_raise_success(tmp_path):
    results = {}
    for name, flags in {
        "bare": ["--safety-margin", "0"],
        "filter": ["--safety-margin", "0.01", "--no-escape"],
        "escape": ["--safety-margin", "0.01"],
    }.items():
        arguments = ["--policy", "go-to-goal", "--task", HARD, "--num-queries", "8"]
        arguments += ["--split", "validation", "--goal-type", "combined"]
        assert command.main([*arguments, *flags, "--json", str(tmp_path / "result.json")]) == 0
        results[name] = json.loads((tmp_path / "result.json").read_text())
    assert results["bare"]["collision_rate"] > 0.5
    filters = {name: result["safety_filter"] for name, result in results.items()}
    assert filters["bare"] is None
    assert filters["filter"] == {"margin": 0.01, "escape": False, "version": VERSION}
    assert filters["escape"] == {"margin": 0.01, "escape": True, "version": VERSION}
    for name in ("filter", "escape"):
        assert results[name]["collision_rate"] < 0.6 * results["bare"]["collision_rate"]
    rates = {name: result["success_rate"] for name, result in results.items()}
    assert rates["bare"] < rates["filter"] < rates["escape"]
    assert results["escape"]["seed"] == 0 and results["bare"]["seed"] is None


def test_flags_change_the_filter_that_a_policy_includes(tmp_path, capsys):
    arguments = ["--policy", POLICY, "--task", "wall", "--num-queries", "1"]
    arguments += ["--approach", "--no-escape", "--no-obstacle-velocities"]
    assert command.main([*arguments, "--json", str(tmp_path / "result.json")]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    changed = {"margin": 0.01, "escape": False, "approach": True, "lookahead": None}
    assert result["safety_filter"] == changed | {"version": VERSION}
    words = "margin 0.01 m, no escape, approach paths, no obstacle velocities\n"
    assert words in capsys.readouterr().out


# --- Ground truth

FILTER = SafetyFilter(margin=0.01)


@pytest.mark.parametrize(
    ("policy", "options", "source", "privileged"),
    [
        ("go-to-goal", {}, None, False),
        ("bc-combined-oracle-random_boxes_hard-s1", {}, None, True),
        (POLICY, {}, "point_cloud", False),
        (POLICY, {"geometry_source": "ground_truth"}, "ground_truth", True),
        ("planner", {}, "ground_truth", True),
        # A filter without a geometry source of its own takes the ground truth.
        ("go-to-goal", {"safety_filter": FILTER}, "ground_truth", True),
    ],
)
def test_result_and_header_say_whether_ground_truth_was_used(policy, options, source, privileged):
    result = evaluate(policy, "wall", num_queries=1, **options)
    assert (result["geometry_source"], result["privileged"]) == (source, privileged)
    header = report(result)
    assert re.search(rf"^ *geometry source +{source or 'none'}$", header, re.M)
    assert bool(re.search("^ *privileged +yes$", header, re.M)) == privileged


def test_task_defaults_to_that_of_the_policy(tmp_path):
    (tmp_path / "run").mkdir()
    path = save(tmp_path / "run" / "policy.onnx", task="boxes")
    for policy, task in (("sac-ee-wall-p1-s1", "wall"), (path, "boxes"), (path.parent, "boxes")):
        assert evaluate(str(policy), num_queries=1)["task"] == task
    assert evaluate(str(path), "wall", num_queries=1)["task"] == "wall"
    with pytest.raises(EvaluationError, match="has no task of its own"):
        evaluate("go-to-goal")


def test_planner_without_time_gives_up():
    both = _queries((LEFT, RIGHT), (RIGHT, LEFT))
    result = evaluate("planner", "wall", queries=both, time_limit=1e-6)
    assert result["success_rate"] == result["collision_rate"] == 0
    assert result["mean_steps"] is None and result["ms_per_action"] is None
    assert result["planning_seconds"] > 0 and result["planning_seconds_solved"] is None


def test_policy_with_longer_steps_is_not_comparable(query_file, tmp_path, capsys):
    def run(policy, *flags):
        arguments = ["--task", "no_obstacles", "--queries", query_file, "--num-queries", "3"]
        arguments += ["--policy", policy, "--json", tmp_path / "out.json", *flags]
        assert command.main([str(argument) for argument in arguments]) == 0
        return json.loads((tmp_path / "out.json").read_text()), capsys.readouterr().out

    usual = save(tmp_path / "usual.onnx", env={"goal_type": "config", "max_step": 0.03})
    longer = save(tmp_path / "longer.onnx", env={"goal_type": "config", "max_step": 0.06})
    standard, table = run(usual)
    assert standard["deviations"] == {} and "not comparable" not in table
    faster, table = run(longer)
    assert faster["mean_steps"] < 0.7 * standard["mean_steps"]
    assert faster["deviations"] == {"max_step": 0.06}
    assert "not comparable: max_step is 0.06, not 0.03" in table
    stopped, table = run("go-to-goal", "--stop-on-collision")
    assert stopped["deviations"] == {"stop_on_collision": True}
    assert "not comparable: stop_on_collision is True, not False" in table


# --- Scenes

BLOCKED = Scene((Box((0.6, 0.0, 0.3875), (0.7, 0.04, 0.775)),))


def _write_scenes(folder, base, scenes):
    """A scene file with queries beside it: LEFT to RIGHT in the given scenes, and two others."""
    task, path = folder / "mine.yaml", folder / "mine_queries.h5"
    save_scene(base, task)
    # A little more each, since no two queries may be the same.
    start = np.array([LEFT + np.float32(1e-6) * i for i in range(len(scenes))])
    splits = {
        "test": (start, np.array([RIGHT] * len(scenes)), scenes),
        "validation": (np.array([RIGHT]), np.array([LEFT])),
        "original": (np.array([LEFT]), np.array([HIGHER])),
    }
    write_queries(path, task, 0, splits, "a test", {})
    return str(task), path


@pytest.mark.parametrize("policy", ["via-points", "planner"])
def test_each_query_is_in_its_own_scene(policy, tmp_path):
    task, path = _write_scenes(tmp_path, Scene(), [Scene(), BLOCKED, Scene(), BLOCKED])
    result = evaluate(policy, task, tries=1, time_limit=60.0)
    assert result["collision_free_success_rate"] == (1.0 if policy == "planner" else 0.5)
    assert result["collision_rate"] == (0.0 if policy == "planner" else 0.5)
    assert result["free_motion_rate"] == (0.5 if policy == "via-points" else None)
    assert (result["task"], result["num_queries"]) == (task, 4)
    queries = load_queries(path)
    alone = SimpleNamespace(start=queries.start, goal=queries.goal)
    assert evaluate(policy, task, queries=alone, tries=1)["collision_free_success_rate"] == 1.0


def test_queries_of_another_scene_file_are_refused(tmp_path):
    task, path = _write_scenes(tmp_path, Scene(), [Scene(), BLOCKED])
    assert evaluate("go-to-goal", task, split="original", queries=path)["mean_steps"] < 30
    (tmp_path / "other.yaml").write_text(Path(task).read_text())
    for queries, message in (
        (path, "is for the task 'mine', not 'other'"),
        (None, "other_queries.h5: no such file"),
    ):
        with pytest.raises(EvaluationError, match=message):
            evaluate("go-to-goal", str(tmp_path / "other.yaml"), queries=queries)
    save_scene(BLOCKED, task)  # after the queries were made
    with pytest.raises(EvaluationError, match="out of date: made for another"):
        evaluate("go-to-goal", task)


# --- The command


def test_command_runs_in_any_folder_with_the_same_result_for_two_workers(tmp_path):
    arguments = ["--policy", "via-points", "--task", "wall", "--split", "validation"]
    arguments += ["--num-queries", "8", "--seed", "5", "--workers", "2"]
    arguments += ["--json", tmp_path / "out.json", "--image", tmp_path / "out.png"]
    run = subprocess.run(
        [sys.executable, SCRIPT, *arguments], cwd=tmp_path, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert "via-points on wall: 8 validation queries" in run.stdout
    result = json.loads((tmp_path / "out.json").read_text())
    assert f"success {result['success_rate']:>25.4f}" in run.stdout
    options = {"split": "validation", "num_queries": 8, "seed": 5}
    assert _numbers(result) == _numbers(evaluate("via-points", "wall", **options))
    assert set(result["versions"]) == {"python", "pybullet", "onnxruntime", "torch", "numpy"}
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(os.listdir(tmp_path)) == ["out.json", "out.png"]


def test_errors_of_the_command_are_one_line_before_any_work(
    query_file, tmp_path, capsys, monkeypatch
):
    def never(job, progress):
        raise AssertionError("work was done")

    monkeypatch.setattr(evaluation, "_run", never)
    policy = str(save(tmp_path / "policy.onnx"))
    encoder = str(save(tmp_path / "encoder.onnx", kind="encoder"))
    unfit = str(save(tmp_path / "unfit.onnx", env={"goal_type": "ee"}))
    cases = [
        ({"policy": "go-to-gaol"}, "no such policy: go-to-gaol: did you mean go-to-goal?"),
        ({"policy": encoder}, "encoder.onnx: a network, but not a policy"),
        ({"policy": unfit}, "unfit.onnx: its input achieved_goal has the shape"),
        ({"policy": policy, "goal-type": "ee"}, "trained with the goal type 'config'"),
        ({"task": "wal"}, "unknown task 'wal': did you mean wall?"),
        ({"task": "wall"}, "this file is for the task 'no_obstacles', not 'wall'"),
        ({"geometry-source": "point_cloud"}, "geometry_source is for via-points, planner, a safe"),
        ({"policy": "planner", "tries": "3"}, "--tries is for via-points"),
        ({"workers": "0"}, "--workers must be in [1, 256]"),
        ({"json": str(tmp_path)}, "is a directory, not a file"),
    ]
    good = {"policy": "go-to-goal", "task": "no_obstacles", "queries": str(query_file)}
    for change, message in cases:
        flags = good | change
        arguments = [part for name, value in flags.items() for part in (f"--{name}", value) if part]
        assert command.main(arguments) == 2, change
        output = capsys.readouterr()
        assert output.out == "" and message in output.err
        assert output.err.startswith(error_line("")) and output.err.count("\n") == 1


def test_refused_query_and_refused_action_are_errors(queries):
    goal = queries.goal.copy()
    goal[3] = 7.0
    broken = SimpleNamespace(start=queries.start, goal=goal)
    with pytest.raises(EvaluationError, match="query 3: goal is outside the joint"):
        evaluate("go-to-goal", "no_obstacles", queries=broken)
    with pytest.raises(EvaluationError, match="query 0: an action is 7 finite numbers"):
        evaluate(lambda observation: np.full(7, np.nan), "no_obstacles", queries=queries)


def test_moving_obstacles_are_evaluated_and_a_delay_is_noted(tmp_path, capsys):
    """A box that comes to the arm's place after 1 s: who waits for 60 steps is hit by it."""
    here = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], np.float32)
    there = here + np.float32([1.5, 0, 0, 0, 0, 0, 0])
    coming = Waypoints((1.0, 2.0), ((0.0, 0.0, 0.0), (0.0, 0.4, 0.0)))
    scene = Scene((Box((0.307, -0.4, 0.5), (0.1, 0.1, 0.1), motion=coming),))
    queries = SimpleNamespace(start=here[None], goal=there[None], scenes=[scene])
    options = {"queries": queries, "goal_type": "config", "measure_clearance": True}
    found = evaluate("go-to-goal", "no_obstacles", **options)
    assert found["collision_free_success_rate"] == 1 and found["action_delay"] == 0
    checkers = [CollisionChecker(scene.at(t)) for t in (0.0, found["mean_steps"] / 30)]
    states = PANDA.normalise([here, there])
    ends = [
        c.signed_distances(q, False).distance.min() for c, q in zip(checkers, states, strict=True)
    ]
    assert 0 < found["min_clearance"] <= min(ends) + 1e-6
    late = evaluate("go-to-goal", "no_obstacles", action_delay=60, **options)
    assert late["collision_rate"] == 1 and late["action_delay"] == 60
    real = evaluate("go-to-goal", "no_obstacles", real_time=True, **options)
    assert real["action_delay"] == "real_time"
    for result, words in ((late, "60 steps"), (real, "real time"), (found, None)):
        text = report(result)
        assert (f"action delay            {words}" in text) == (words is not None)
    assert "action delay" not in report(found)


def test_sensors_of_a_policy_that_observes_no_scene_are_refused():
    for policy, options in (
        ("go-to-goal", {"observe_every": 5}),
        ("space-time", {"sensor_noise": SensorNoise(latency=2)}),
    ):
        with pytest.raises(EvaluationError, match="observes nothing of the scene"):
            evaluate(policy, "moving_boxes_easy", **options)


FORK = """
import multiprocessing

import roboarm_nmp


def success(seed):
    result = roboarm_nmp.evaluate("sac-ee-wall-p1-s1", num_queries=3, seed=seed)
    return result["success_rate"]


expected = success(0)
with multiprocessing.get_context("fork").Pool(2) as pool:
    assert pool.map_async(success, [0, 0]).get(timeout=60) == [expected, expected]
"""


def test_processes_forked_after_an_evaluation_evaluate(tmp_path):
    subprocess.run([sys.executable, "-c", FORK], check=True, cwd=tmp_path, timeout=120)
