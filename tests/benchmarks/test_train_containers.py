"""benchmarks/train_containers.py: a tiny training, and what a worker does on a query."""

import json
import sys

import numpy as np
import pytest
import torch
from paths import ROOT

from roboarm_nmp import envs
from roboarm_nmp.datasets.roadmap_paths import shard_bytes
from roboarm_nmp.datasets.shards import shard_path
from roboarm_nmp.demo_generation.roadmaps import Roadmap
from roboarm_nmp.policies.registry import find_policy, own_safety_filter

sys.path.append(str(ROOT / "benchmarks"))
import train_containers as script  # noqa: E402

HARD = "random_boxes_hard"


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    """A folder with paths in two scenes."""
    rng, folder = np.random.default_rng(0), tmp_path_factory.mktemp("paths")
    scenes = [envs.get_task(HARD).scene.sample(rng) for _ in range(2)]
    made = [Roadmap(scene, rng, num_nodes=150).random_paths(6, rng) for scene in scenes]
    shard_path(folder, 0).write_bytes(shard_bytes(HARD, 0, 0, scenes, made, "a test"))
    return folder


def test_tiny_training_saves_two_policies_with_approach_paths(paths, tmp_path):
    tiny = {"seconds": 0.5, "workers": 1, "visitors": 1, "device": "cpu"}
    tiny |= {"batch_size": 16, "first_draws": 1, "pool_size": 600}
    script.main(script.Args(paths=(paths,), output=tmp_path / "out", **tiny))
    made = json.loads((tmp_path / "out" / "made.json").read_text())
    assert made["updates"] > 0 and made["drawn"] > 2 * made["updates"] - 2
    for name in ("fine_tuned", "new"):
        path, arguments = find_policy(tmp_path / "out" / f"{name}.pt")
        assert own_safety_filter(path).approach and arguments["num_points"] == 64


def test_states_that_the_policy_visits_are_labelled_equally_for_equal_numbers(
    paths, tmp_path, monkeypatch
):
    env, _ = script.make_env()
    weights = tmp_path / "weights.pt"
    torch.save(script.make_actor(env).state_dict(), weights)
    monkeypatch.setattr(script, "LABEL_NODES", 100)
    threads = torch.get_num_threads()
    script.begin(script.Args(paths=(paths,)), weights)
    torch.set_num_threads(threads)
    (one, *ended), (again, *_) = (script.visit(3) for _ in range(2))
    assert 0 < len(one["scene"]) <= script.LABELS_PER_QUERY
    assert all(np.array_equal(one[name], again[name]) for name in one)
    assert all(isinstance(outcome, bool) for outcome in ended)
    drawn = script.draw(0)
    assert {name: array.shape[1:] for name, array in drawn.items()} == {
        name: array.shape[1:] for name, array in one.items()
    }
