"""flow.py, and the policies that it saves: their distances, their paths, resumed runs."""

import functools
import json

import numpy as np
import onnx
import pytest
import torch
from scipy.spatial import cKDTree
from trainers import PATHS, command, run_here, run_script, short_evaluations, stopped_run

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.collision.distance_field import DistanceField, arm_spheres
from roboarm_nmp.envs.perception.geometry_source import observed_checker
from roboarm_nmp.envs.perception.point_clouds import observed_points
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.subgoals import SUBGOAL_SPACING
from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.policies.generative import PathsOfNetwork, draw_path, search_path
from roboarm_nmp.policies.registry import PolicyError, make_policy
from roboarm_nmp.policies.safety_filter import SafetyFilter

HARD = "random_boxes_hard"
FLAGS = ["--task", HARD, "--eval-queries", "1"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    with short_evaluations():
        return run_script("flow", tmp_path_factory.mktemp("flow"), *FLAGS)


def test_field_has_the_distances_of_points_and_table_and_their_gradient():
    scene = envs.get_task(HARD).scene.sample(np.random.default_rng(0))
    points = observed_points(scene)
    field = DistanceField(PANDA)
    grid = field.of_scene(points, scene)[None]
    states = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 7)).astype(np.float32)
    distances, uphill = field.distances(states, grid)
    centres = field.centres(states).astype(np.float64)
    expected = cKDTree(points).query(centres.reshape(-1, 3))[0].reshape(distances.shape)
    table = scene.table
    beside = np.abs(centres - table.position) - np.array(table.size) / 2
    outside = np.linalg.norm(np.maximum(beside, 0.0), axis=2)
    expected = np.minimum(expected, outside + np.minimum(beside.max(2), 0.0))
    expected = np.minimum(expected, centres[..., 2] - scene.floor).clip(-0.05, 0.2)
    inside = (np.abs(centres[..., :2]) < 0.9).all(2) & (centres[..., 2] < 1.2)
    error = (distances + arm_spheres(PANDA)[:, 4] - expected)[inside]
    assert inside.mean() > 0.9 and np.abs(error).mean() < 0.002
    assert np.percentile(np.abs(error), 99) < 0.01  # (at the table's edges it is more)

    near = np.flatnonzero((distances < 0.08).any(1))[:50]
    numeric = np.empty((len(near), 7))
    for joint in range(7):
        sides = np.repeat(states[None, near], 2, axis=0)
        sides[0, :, joint] += 1e-3
        sides[1, :, joint] -= 1e-3
        one, other = (field.distances(side, grid)[0] for side in sides)
        numeric[:, joint] = np.where(distances[near] < 0.08, one - other, 0.0).sum(1) / 2e-3
    # (Between two cells of the grid the gradient jumps.)
    assert np.median(np.abs(numeric - uphill[near]).max(1)) < 0.01
    assert np.corrcoef(numeric.ravel(), uphill[near].ravel())[0, 1] > 0.98


def test_paths_are_free_in_the_cloud_and_repeatable(run):
    network = load_network(run / "policy.onnx")
    paths = PathsOfNetwork(network, DistanceField(PANDA))
    queries = load_queries(HARD, "validation")
    verified = 0
    for i in range(6):
        query = queries[i]
        checker = observed_checker(query.scene)
        ends = np.clip(PANDA.normalise([query.start, query.goal]), -1.0, 1.0)
        found = []
        for _ in range(2):
            paths.begin(query.scene, *ends.astype(np.float32))
            path, is_verified = draw_path(paths, checker, ends, np.random.default_rng(i))
            if not is_verified:
                path = search_path(checker, ends, np.random.default_rng(i))
            found.append(path)
        path, again = found
        assert np.array_equal(path, again)
        assert np.abs(path[[0, -1]] - ends).max() < 1e-6
        # (The cloud's balls may touch the arm at start and goal already.)
        near = (ends, np.minimum(checker.signed_distances(ends).distance.min(-1) - 1e-5, 0.0), 0.05)
        assert checker.is_motion_free(path[:-1], path[1:], endpoint_margins=near).all()
        verified += is_verified
    assert verified >= 2  # without training, too: draws are repaired


def test_what_cannot_be_verified_is_followed_anyway_and_searched_for_if_allowed(run):
    class Blocked(CollisionChecker):
        def is_motion_free(self, *args, **kwargs):
            return np.zeros_like(super().is_motion_free(*args, **kwargs))

        def first_free_path(self, paths, *args, **kwargs):
            return len(paths)

    query = load_queries(HARD, "validation")[0]
    paths = PathsOfNetwork(load_network(run / "policy.onnx"), DistanceField(PANDA))
    ends = np.clip(PANDA.normalise([query.start, query.goal]), -1.0, 1.0)
    checker = Blocked(query.scene)
    paths.begin(query.scene, *ends.astype(np.float32))
    path, verified = draw_path(paths, checker, ends, np.random.default_rng(0))
    assert not verified and np.abs(path[[0, -1]] - ends).max() < 1e-6
    path = search_path(checker, ends, np.random.default_rng(0))
    assert path is not None and len(path) >= 2


def test_stopped_and_resumed_run_is_bit_identical_and_evaluated_as_validated(
    run, tmp_path, short_episodes
):
    stopped = stopped_run(tmp_path, *command("flow", tmp_path, *FLAGS)[1:])
    run_here(PATHS["flow"], "--resume", stopped)
    one, other = (torch.load(each / "checkpoint.pt", weights_only=True) for each in (run, stopped))
    for name in ("network", "average"):
        assert all(torch.equal(one[name][key], other[name][key]) for key in one[name])
    best = json.loads((run / "result.json").read_text())["validation_success_rate"]
    result = evaluate(run, HARD, split="validation", num_queries=1)
    assert result["success_rate"] == best and not result["privileged"]
    assert 0.0 <= result["verified_rate"] <= 1.0 and "search_rate" not in result
    searched = evaluate(run, HARD, split="validation", num_queries=1, search=True)
    assert searched["verified_rate"] == 1.0 and searched["search_rate"] <= 1.0
    careful = evaluate(run, HARD, split="validation", num_queries=1, unknown="occupied")
    assert careful["unknown"] == "occupied" and careful["verified_rate"] <= result["verified_rate"]


def test_own_filter_leaves_a_verified_path_as_it_is_where_nothing_moves(run):
    source = {"geometry_source": "point_cloud", "link_distances": True}
    env = envs.make(HARD, goal_type="combined", horizon=60, **source)
    query = load_queries(HARD, "validation")[0]
    actions = {}
    for name, safety_filter in (("own", None), ("none", False), ("another", SafetyFilter(0.05))):
        act, verified, _ = make_policy(
            run / "policy.onnx", env, search=True, safety_filter=safety_filter
        )(0, query)
        assert verified
        actions[name] = rollout(env, query, act).actions
    assert np.array_equal(actions["own"], actions["none"])
    assert np.linalg.norm(actions["own"][0]) < 0.6 * SUBGOAL_SPACING  # slowly at first
    assert not np.array_equal(actions["own"], actions["another"])


def test_a_reactive_motion_is_verified_before_the_arm_moves_or_another_policy_acts():
    policy = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"
    run = functools.partial(evaluate, policy, HARD, split="validation", num_queries=6)
    alone, verified, planned = (run(verify_else=other) for other in (None, policy, "planner"))
    assert "verified_rate" not in alone and 0.0 == verified["search_rate"] < planned["search_rate"]
    assert 0.0 < verified["verified_rate"] == pytest.approx(1.0 - planned["search_rate"])
    line = evaluate("go-to-goal", HARD, goal_type="config", verify_else="planner", num_queries=1)
    assert line["geometry_source"] == "point_cloud" and not line["privileged"]
    with pytest.raises(PolicyError, match="goals that contain a configuration"):
        make_policy("go-to-goal", envs.make(HARD, goal_type="ee"), verify_else="planner")


@pytest.mark.parametrize(
    "change", [{"curves": "many"}, {"line": 4}, {"every": 0}, {"curves": [[1.0, 2.0]]}]
)
def test_damaged_metadata_are_refused(run, tmp_path, change):
    model = onnx.load(run / "policy.onnx")
    for entry in model.metadata_props:
        if entry.key == "paths":
            entry.value = json.dumps(json.loads(entry.value) | change)
    onnx.save(model, tmp_path / "bad.onnx")
    with pytest.raises(PolicyError, match="bad.onnx: its inputs or its metadata"):
        make_policy(tmp_path / "bad.onnx", envs.make(HARD, goal_type="config"))
