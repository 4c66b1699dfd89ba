"""evaluate.py: its metrics, its policies, the same numbers however it is run, and its errors."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from paths import ROOT
from torch import nn

from roboarm_nmp import demo_generation, envs
from roboarm_nmp.demo_generation.following import follow
from roboarm_nmp.demo_generation.planning import Planner
from roboarm_nmp.envs import panda
from roboarm_nmp.envs.datasets.queries import load_queries, write_queries
from roboarm_nmp.envs.networks.exported_networks import save_network
from roboarm_nmp.envs.policies.registry import make_policy
from roboarm_nmp.envs.policies.safety_filter import VERSION, SafetyFilter
from roboarm_nmp.envs.scenes.files import save_scene
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.envs.tasks import Task

SCRIPT = ROOT / "clean_rl_scripts" / "evaluate.py"
sys.path.append(str(SCRIPT.parent))
evaluation = importlib.import_module("evaluate")
evaluate = evaluation.evaluate


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


class Straight(nn.Module):
    """The go-to-goal policy as a network, for goals that are configurations."""

    def forward(self, observation, achieved_goal, desired_goal):
        return torch.clamp(desired_goal - observation[:, :7], -1, 1)


def _save(path, module=None, goal_size=7, observation_size=10, **metadata):
    inputs = {
        "observation": torch.zeros(1, observation_size),
        "achieved_goal": torch.zeros(1, goal_size),
        "desired_goal": torch.zeros(1, goal_size),
    }
    metadata = {"kind": "policy", "task": "wall", "env": {"goal_type": "config"}} | metadata
    save_network(path, module or Straight(), inputs, metadata)
    return path


def _numbers(result):
    """What must not depend on how an evaluation is run."""
    times = ("ms_per_action", "planning_seconds", "planning_seconds_solved")
    return {name: value for name, value in result.items() if name not in times}


# --- Metrics


def test_wilson_interval():
    # p = 0.8, n = 10, z^2 = 3.84146: centre (0.8 + 0.192073) / 1.384146, half width
    # 1.959964 * sqrt(0.016 + 0.0096036) / 1.384146
    low, high = evaluation.wilson_interval(8, 10)
    assert low == pytest.approx(0.490162, abs=1e-5)
    assert high == pytest.approx(0.943318, abs=1e-5)
    assert evaluation.wilson_interval(0, 10) == pytest.approx((0.0, 0.277533), abs=1e-5)
    assert evaluation.wilson_interval(10, 10) == pytest.approx((0.722467, 1.0), abs=1e-5)


def test_path_length_and_smoothness():
    configurations = np.zeros((4, 7))
    configurations[:, 0] = [0.0, 3.0, 3.0, 3.0]
    configurations[:, 1] = [0.0, 4.0, 4.0, 6.0]
    # steps (3, 4), (0, 0), (0, 2); their differences (-3, -4), (0, 2)
    assert evaluation.path_length(configurations) == pytest.approx(5 + 0 + 2)
    assert evaluation.smoothness(configurations) == pytest.approx((5 + 2) / 2)
    straight = np.linspace(np.zeros(7), np.ones(7), 11)
    assert evaluation.path_length(straight) == pytest.approx(np.sqrt(7))
    assert evaluation.smoothness(straight) == pytest.approx(0.0, abs=1e-12)
    assert evaluation.path_length(straight[:1]) == evaluation.smoothness(straight[:2]) == 0.0


def test_metrics_of_an_evaluation_are_those_of_its_episodes(queries):
    result = evaluate("go-to-goal", "no_obstacles", queries=queries)
    env, rows = envs.make("no_obstacles"), []
    for start, goal in zip(queries.start, queries.goal, strict=True):
        observation, info = env.reset_specific(start, goal)
        path, ended = [start.astype(float)], False
        while not ended:
            action = panda.normalise(goal) - observation["observation"][:7]
            observation, _, terminated, truncated, info = env.step(action)
            path.append(panda.denormalise(observation["observation"][:7]))
            ended = terminated or truncated
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        rows.append((info["is_success"], info["collision_so_far"], len(path) - 1, length))
    env.close()
    success, touched, steps, lengths = (np.array(column) for column in zip(*rows, strict=True))
    assert result["num_queries"] == 40
    assert result["success_rate"] == success.mean() > 0.9
    assert result["collision_free_success_rate"] == (success & ~touched).mean()
    assert result["collision_rate"] == touched.mean()
    assert 0 < result["collision_free_success_rate"] < result["success_rate"]
    assert result["mean_steps"] == pytest.approx(steps[success].mean())
    assert result["path_length"] == pytest.approx(lengths[success].mean(), abs=1e-5)
    assert 0 < result["smoothness"] < 0.1 and result["ms_per_action"] > 0
    low, high = result["collision_free_success_rate_interval"]
    assert low < result["collision_free_success_rate"] < high
    assert json.loads(json.dumps(result)) == result


def test_a_start_at_the_goal_is_a_success_of_no_steps():
    start = np.array([[0.0, -0.3, 0.0, -1.8, 0.0, 1.6, 0.0]], np.float32)
    result = evaluate(
        "go-to-goal", "no_obstacles", queries=SimpleNamespace(start=start, goal=start)
    )
    assert result["success_rate"] == 1.0
    assert result["mean_steps"] == result["path_length"] == result["smoothness"] == 0.0
    assert result["ms_per_action"] is None


def test_stopping_on_collision_leaves_clean_successes_only(queries):
    free = evaluate("go-to-goal", "no_obstacles", queries=queries)
    stopped = evaluate("go-to-goal", "no_obstacles", queries=queries, stop_on_collision=True)
    assert (
        stopped["success_rate"]
        == stopped["collision_free_success_rate"]
        == free["collision_free_success_rate"]
    )
    assert stopped["collision_rate"] == free["collision_rate"]


# --- The same numbers however it is run


def test_workers_do_not_change_the_result(queries):
    alone = evaluate("random", "no_obstacles", queries=queries, num_queries=12, seed=3)
    assert alone["success_rate"] == 0 and alone["mean_steps"] is None
    options = {"split": "validation", "num_queries": 30, "seed": 5}
    alone = evaluate("via-points", "wall", **options)
    shared = evaluate("via-points", "wall", **options, workers=2)
    assert _numbers(alone) == _numbers(shared)


def test_random_actions_depend_on_seed_and_query_only():
    def actions(seed, index):
        act, _ = make_policy("random", None, seed)(index, None)
        return np.array([act({}) for _ in range(5)])

    assert np.array_equal(actions(1, 4), actions(1, 4))
    assert not np.array_equal(actions(1, 4), actions(1, 5))
    assert not np.array_equal(actions(1, 4), actions(2, 4))
    assert np.abs(actions(1, 4)).max() <= 1


def test_a_network_a_function_and_the_baseline_agree(queries, tmp_path):
    def straight(observation):
        return observation["desired_goal"] - observation["observation"][:7]

    few = {"queries": queries, "num_queries": 15}
    threads = torch.get_num_threads()
    baseline = evaluate("go-to-goal", "no_obstacles", "config", **few)
    function = evaluate(straight, "no_obstacles", "config", **few)
    network = evaluate(_save(tmp_path / "policy.pt"), "no_obstacles", **few)
    folder = evaluate(str(tmp_path), "no_obstacles", **few, workers=2)
    assert torch.get_num_threads() == threads
    assert _numbers(network) == _numbers(folder)
    assert function["policy"] == "straight"
    assert network["goal_type"] == "config" and network["policy"] == str(tmp_path / "policy.pt")
    for result in (function, network):
        assert result["success_rate"] == baseline["success_rate"] > 0.8
        assert result["path_length"] == pytest.approx(baseline["path_length"], rel=1e-3)


def test_a_network_brings_its_environment_but_not_the_rules(queries, tmp_path):
    class Still(Straight):
        def forward(self, observation, achieved_goal, desired_goal):
            return observation[:, :7] + 0 * observation[:, 14:].sum(1, keepdim=True)

    env = {"goal_type": "ee", "action_mode": "subgoal", "max_step": 0.05, "velocities": True}
    cheat = {"ee_tolerance": 10.0, "horizon": 10_000, "render_mode": "human"}
    path = _save(tmp_path / "still.pt", Still(), 3, 17, env=env | cheat)
    result = evaluate(path, "no_obstacles", queries=queries, num_queries=2)
    assert result["env"] == env | {"stop_on_collision": False}
    assert result["success_rate"] == 0.0


# --- Policies that look before they move

# `wall` is the box from x 0.25 to 0.95, z up to 0.775, at y = 0, 0.04 thick. Stretched out to the
# front, left and right of it: halfway between the two the hand is at (0.57, 0, 0.25), inside it.
LEFT = np.array([0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 0.8], np.float32)
RIGHT = np.array([-0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 0.8], np.float32)
HIGHER = np.array([0.8, 0.0, 0.0, -1.8, 0.0, 2.3, 0.8], np.float32)


def _queries(*pairs, **more):
    start, goal = (np.array(column) for column in zip(*pairs, strict=True))
    return SimpleNamespace(start=start, goal=goal, **more)


def test_via_points_go_round_the_wall():
    x, y, z = panda.forward_kinematics((LEFT + RIGHT) / 2)
    assert 0.25 < x < 0.95 and abs(y) < 0.02 and 0 < z < 0.775
    behind = _queries((LEFT, RIGHT))
    straight = evaluate("go-to-goal", "wall", queries=behind)
    assert straight["collision_free_success_rate"] == 0 and straight["collision_rate"] == 1
    assert straight["free_motion_rate"] is None and straight["planning_seconds"] is None
    result = evaluate("via-points", "wall", queries=behind, tries=200)
    assert result["collision_free_success_rate"] == 1 and result["free_motion_rate"] == 1
    assert result["planning_seconds"] == result["planning_seconds_solved"] > 0
    assert (result["tries"], result["time_limit"]) == (200, None)


def test_via_points_go_straight_where_that_is_free_or_nothing_is_found():
    both = _queries((LEFT, HIGHER), (LEFT, RIGHT))
    straight = evaluate("go-to-goal", "wall", queries=both)
    # The one random configuration of this seed is no way to the second goal.
    result = evaluate("via-points", "wall", queries=both, tries=1)
    assert result["free_motion_rate"] == 0.5 and result["collision_free_success_rate"] == 0.5
    for name in ("success_rate", "collision_rate", "mean_steps", "path_length"):
        assert result[name] == straight[name]
    assert 0 < result["planning_seconds_solved"] != result["planning_seconds"]


def test_the_planner_solves_double_walls_and_follows_its_plan():
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
        states = panda.denormalise(follow(env, path).states)
        to_goal = panda.forward_kinematics(states) - panda.forward_kinematics(query.goal)
        steps = int(np.argmax(np.linalg.norm(to_goal, axis=1) <= env.ee_tolerance))
        rows.append((steps, evaluation.path_length(states[: steps + 1])))
    env.close()
    steps, lengths = np.mean(rows, axis=0)
    assert result["mean_steps"] == steps
    assert result["path_length"] == pytest.approx(lengths)


def test_a_safety_filter_around_a_policy(tmp_path):
    """`--safety-margin`: fewer touches, and with the way out of dead ends more is reached."""
    found = {}
    for name, flags in {
        "bare": [],
        "none": ["--safety-margin", "0"],
        "layer": ["--safety-margin", "0.01", "--no-escape"],
        "way out": ["--safety-margin", "0.01"],
        "points": ["--safety-margin", "0.015", "--encoder", "points"],
    }.items():
        command = ["--policy", "go-to-goal", "--task", "random_boxes_hard", "--num-queries", "25"]
        command += ["--split", "validation", "--goal-type", "combined"]
        assert evaluation.main([*command, *flags, "--json", str(tmp_path / "result.json")]) == 0
        found[name] = json.loads((tmp_path / "result.json").read_text())
    assert _numbers(found["none"]) == _numbers(found["bare"])
    layers = {name: result["safety_filter"] for name, result in found.items()}
    assert layers["bare"] is layers["none"] is None
    assert layers["layer"] == {"keep": 0.01, "escape": False, "version": VERSION}
    assert layers["way out"] == {"keep": 0.01, "escape": True, "version": VERSION}
    assert layers["points"] == {"keep": 0.015, "escape": True, "version": VERSION}
    knows = {name: result["env"].get("link_distances") for name, result in found.items()}
    assert knows == {name: "obstacles" for name in knows} | {
        "bare": None,
        "none": None,
        "points": "points",
    }
    assert found["points"]["encoder"] == "points" and found["way out"]["encoder"] is None
    for name in ("layer", "way out", "points"):
        assert found[name]["collision_rate"] < 0.6 * found["bare"]["collision_rate"]
    rates = {name: result["success_rate"] for name, result in found.items()}
    assert rates["bare"] < rates["layer"] < rates["way out"]
    own = ["--policy", "dagger-combined-points-random_boxes_hard-s1", "--task", "wall"]
    own += ["--num-queries", "1", "--no-escape", "--json", str(tmp_path / "result.json")]
    assert evaluation.main(own) == 0
    layer = json.loads((tmp_path / "result.json").read_text())["safety_filter"]
    assert not layer["escape"] and layer["keep"] > 0
    assert found["points"]["seed"] == 0 and found["bare"]["seed"] is None


@pytest.mark.parametrize(
    "noted", [{}, {"link_distances": None}]
)  # before and since SAC and TD3 had it
def test_a_safety_filter_around_a_network_that_has_no_distances(tmp_path, noted):
    path = _save(tmp_path / "policy.pt", env={"goal_type": "config"} | noted)
    bare = evaluate(path, "boxes", split="validation", num_queries=5)
    assert bare["env"].get("link_distances") is None and bare["collision_rate"] > 0
    for encoder, knows in ((None, "obstacles"), ("points", "points")):
        layer = SafetyFilter(keep=0.01)
        result = evaluate(
            path, "boxes", split="validation", num_queries=5, safety_filter=layer, encoder=encoder
        )
        assert result["env"]["link_distances"] == knows
        assert result["collision_rate"] < bare["collision_rate"]


def test_a_planner_that_looks():
    """It knows only what is seen; here that is enough, mostly, and its plans are other ones."""
    results = [
        evaluate("planner", "random_boxes_hard", num_queries=8, split="validation", encoder=encoder)
        for encoder in (None, "points")
    ]
    assert [result["encoder"] for result in results] == [None, "points"]
    assert all(result["success_rate"] >= 0.75 for result in results)
    assert results[0]["path_length"] != results[1]["path_length"]


def test_a_planner_without_time_gives_up():
    both = _queries((LEFT, RIGHT), (RIGHT, LEFT))
    result = evaluate("planner", "wall", queries=both, time_limit=1e-6)
    assert result["success_rate"] == result["collision_rate"] == 0
    assert result["mean_steps"] is None and result["ms_per_action"] is None
    assert result["planning_seconds"] > 0 and result["planning_seconds_solved"] is None


def test_the_planner_without_ompl(monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl", None)
    monkeypatch.delitem(sys.modules, "roboarm_nmp.demo_generation.planning")
    monkeypatch.delattr(demo_generation, "planning")
    queries = _queries((LEFT, HIGHER))
    with pytest.raises(evaluation.EvaluationError, match="the policy planner needs OMPL"):
        evaluate("planner", "wall", queries=queries)
    assert evaluate("via-points", "wall", queries=queries)["success_rate"] == 1


def test_a_policy_with_longer_steps_is_not_comparable(query_file, tmp_path, capsys):
    def run(policy, *flags):
        arguments = ["--task", "no_obstacles", "--queries", query_file, "--num-queries", "3"]
        arguments += ["--policy", policy, "--json", tmp_path / "out.json", *flags]
        assert evaluation.main([str(argument) for argument in arguments]) == 0
        return json.loads((tmp_path / "out.json").read_text()), capsys.readouterr().out

    usual = _save(tmp_path / "usual.pt", env={"goal_type": "config", "max_step": 0.03})
    longer = _save(tmp_path / "longer.pt", env={"goal_type": "config", "max_step": 0.06})
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


@pytest.mark.parametrize("policy", ["go-to-goal", "via-points", "planner"])
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


def test_queries_of_a_scene_file(tmp_path):
    task, path = _write_scenes(tmp_path, Scene(), [Scene(), BLOCKED])
    assert evaluate("go-to-goal", task, split="original", queries=path)["mean_steps"] < 30
    (tmp_path / "other.yaml").write_text(Path(task).read_text())
    cases = [
        ((str(tmp_path / "other.yaml"), path), "is for the task 'mine', not 'other'"),
        ((str(tmp_path / "other.yaml"), load_queries(path)), "for the task 'mine', not 'other'"),
        ((str(tmp_path / "other.yaml"), None), "other_queries.h5: no such file"),
        ((str(tmp_path / "no.yaml"), path), "no.yaml: No such file"),
    ]
    for (other, queries), message in cases:
        with pytest.raises(evaluation.EvaluationError, match=message):
            evaluate("go-to-goal", other, queries=queries)
    save_scene(BLOCKED, task)  # after the queries were made
    for queries in (None, path):
        with pytest.raises(evaluation.EvaluationError, match="out of date: made for another"):
            evaluate("go-to-goal", task, queries=queries)


def test_random_scenes_are_part_of_a_query(monkeypatch):
    scenes = SimpleNamespace(base=Scene(), sample=lambda rng: Scene())
    monkeypatch.setitem(envs.TASKS, "varied", Task(scenes, "scenes that vary"))
    pairs = [(LEFT, RIGHT), (LEFT, RIGHT)]
    with pytest.raises(evaluation.EvaluationError, match="varied has random scenes: these queries"):
        evaluate("go-to-goal", "varied", queries=_queries(*pairs))
    queries = _queries(*pairs, scenes=[BLOCKED, Scene()])
    assert evaluate("go-to-goal", "varied", queries=queries)["collision_free_success_rate"] == 0.5


# --- The command


def test_the_command_from_another_folder(query_file, tmp_path):
    arguments = ["--policy", "go-to-goal", "--task", "no_obstacles", "--queries", query_file]
    arguments += ["--num-queries", "12", "--workers", "2"]
    arguments += ["--json", tmp_path / "out.json", "--picture", tmp_path / "out.png"]
    path = os.pathsep.join([str(SCRIPT.parents[1]), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(
        [sys.executable, SCRIPT, *arguments],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert "go-to-goal on no_obstacles: 12 test queries" in run.stdout
    result = json.loads((tmp_path / "out.json").read_text())
    assert f"success {result['success_rate']:>17.4f}" in run.stdout
    assert result["split"] == "test" and result["num_queries"] == 12
    assert set(result["versions"]) == {"python", "pybullet", "torch", "numpy"}
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(os.listdir(tmp_path)) == ["out.json", "out.png"]


def test_errors_of_the_command(query_file, tmp_path, capsys, monkeypatch):
    def never(job, progress):
        raise AssertionError("work was done")

    monkeypatch.setattr(evaluation, "_run", never)
    policy = str(_save(tmp_path / "policy.pt"))
    (tmp_path / "broken.pt").write_bytes(Path(policy).read_bytes()[:500])
    encoder = str(_save(tmp_path / "encoder.pt", kind="encoder"))
    arguments = {"goal_type": "config", "link_distances": "obstacles"}
    near = str(_save(tmp_path / "near.pt", env=arguments))
    arguments = {"goal_type": "config", "action_mode": "subgoal"}
    subgoal = str(_save(tmp_path / "subgoal.pt", env=arguments))
    unsaid = str(_save(tmp_path / "unsaid.pt", env={}))
    unfit = str(_save(tmp_path / "unfit.pt", env={"goal_type": "ee"}))
    (tmp_path / "empty").mkdir()
    cases = [
        ({"policy": "go-to-gaol"}, "no such policy: go-to-gaol"),
        ({"policy": str(tmp_path / "empty")}, "no such policy"),
        ({"policy": str(tmp_path / "broken.pt")}, "broken.pt: not a network file"),
        ({"policy": encoder}, "encoder.pt: a network, but not a policy"),
        ({"encoder": "points"}, "encoder is for via-points, planner and a last layer"),
        ({"policy": near, "safety-margin": "0.1", "encoder": "points"}, "from obstacles, not"),
        ({"policy": subgoal, "safety-margin": "0.01"}, "a last layer changes displacements"),
        ({"policy": "go-to-goal", "safety-margin": "0.15"}, "keep must be a distance below 0.15"),
        ({"policy": unsaid}, "unsaid.pt: does not say which goal type"),
        ({"policy": unfit}, "unfit.pt: aten.sub.Tensor failed"),
        ({"policy": policy, "goal-type": "ee"}, "trained with the goal type 'config'"),
        ({"task": "moon"}, "unknown task 'moon': one of no_obstacles"),
        ({"task": "wall"}, "this file is for the task 'no_obstacles', not 'wall'"),
        ({"queries": str(tmp_path / "no.h5")}, "no.h5"),
        ({"num-queries": "31"}, "num_queries must be 1 to 30, got 31"),
        ({"num-queries": "0"}, "--num-queries must be at least 1, got 0"),
        ({"split": "validation", "num-queries": "11"}, "num_queries must be 1 to 10"),
        ({"split": "original"}, "has no original queries"),
        ({"workers": "0"}, "--workers must be in [1, 256]"),
        ({"tries": "0"}, "--tries must be at least 1, got 0"),
        ({"time-limit": "0"}, "--time-limit must be above 0, and finite, got 0.0"),
        ({"time-limit": "nan"}, "--time-limit must be above 0, and finite, got nan"),
        ({"json": str(tmp_path)}, "is a directory, not a file"),
        ({"json": str(tmp_path / "no such folder" / "a.json")}, "cannot write"),
        ({"picture": str(tmp_path / "no such folder" / "a.png")}, "cannot write"),
    ]
    good = {"policy": "go-to-goal", "task": "no_obstacles", "queries": str(query_file)}
    for change, message in cases:
        flags = good | change
        arguments = [text for name, value in flags.items() for text in (f"--{name}", value)]
        assert evaluation.main(arguments) == 2, change
        output = capsys.readouterr()
        assert output.out == "" and message in output.err
        assert output.err.startswith("evaluate.py: ") and output.err.count("\n") == 1
    with pytest.raises(SystemExit) as stop:
        evaluation.main(["--policy", "random", "--task", "wall", "--goal-type", "pose"])
    assert stop.value.code == 2


def test_devices_are_written_to_and_never_replaced(query_file, tmp_path):
    flags = ["--policy", "go-to-goal", "--task", "no_obstacles", "--queries", str(query_file)]
    command = [sys.executable, evaluation.__file__, *flags, "--num-queries", "1", "--json"]
    shown = subprocess.run([*command, "/dev/stdout"], capture_output=True, text=True, check=True)
    assert json.loads(shown.stdout[shown.stdout.index("{") :])["num_queries"] == 1
    with open(tmp_path / "out.txt", "w") as file:  # the table, and the JSON after it
        subprocess.run([*command, "/dev/stdout"], stdout=file, check=True)
    text = (tmp_path / "out.txt").read_text()
    assert "success" in text[: text.index("{")] and text.rstrip().endswith("}")
    full = subprocess.run([*command, "/dev/full"], capture_output=True, text=True)
    assert full.returncode == 2 and "Traceback" not in full.stderr
    assert full.stderr.rstrip().endswith("cannot write: [Errno 28] No space left on device")
    assert not Path("/dev/stdout").is_file() or Path("/dev/stdout").is_symlink()


def test_a_query_that_is_refused_is_named(queries):
    goal = queries.goal.copy()
    goal[3] = 7.0
    broken = SimpleNamespace(start=queries.start, goal=goal)
    with pytest.raises(evaluation.EvaluationError, match="query 3: goal is outside the joint"):
        evaluate("go-to-goal", "no_obstacles", queries=broken)


def test_an_action_that_is_no_number_is_an_error(queries):
    with pytest.raises(evaluation.EvaluationError, match="query 0: an action is 7 finite numbers"):
        evaluate(lambda observation: np.full(7, np.nan), "no_obstacles", queries=queries)
