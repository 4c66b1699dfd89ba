"""Results in unseen scenes: when they are run again, and where a run's policy is kept."""

import json
import sys

import numpy as np
import torch
import unseen_obstacles as unseen

from roboarm_nmp import envs
from roboarm_nmp.datasets.roadmap_paths import shard_bytes
from roboarm_nmp.datasets.shards import shard_path
from roboarm_nmp.networks.exported_networks import load_network, save_network
from roboarm_nmp.policies.safety_filter import VERSION


def test_results_of_other_flags_files_or_fewer_queries_are_run_again():
    name = unseen.OBSERVED
    safety_filter = {"margin": 0.01, "escape": True, "version": VERSION}
    done = {"num_queries": 200, "flags": unseen.CELLS[name], "safety_filter": safety_filter}
    assert unseen.is_done(done, name, 200)
    for change in (
        {"num_queries": 100},
        {"flags": [*unseen.CELLS[name], "--seed", "1"]},
        {"safety_filter": safety_filter | {"version": 2}},
    ):
        assert not unseen.is_done(done | change, name, 200)
    decoded = {"encoder": "point_cloud", "num_points": 32, "geometry_source": "field"}
    with_field = done | {"geometry_source": None, "env": decoded}
    assert unseen.digests(with_field).keys() == {"field"}
    assert unseen.is_done(with_field | {"encoders": unseen.digests(with_field)}, name, 200)
    assert not unseen.is_done(with_field | {"encoders": {"field": "0123456789ab"}}, name, 200)


def test_policy_of_a_run_is_kept_by_name_with_its_flags(tmp_path, monkeypatch):
    monkeypatch.setattr(unseen, "POLICIES", tmp_path / "policies")
    monkeypatch.setattr(unseen, "RESULTS", tmp_path / "results.json")
    (tmp_path / "policies").mkdir()
    network = torch.nn.Linear(3, 2)
    save_network(tmp_path / "policy.pt", network, {"input": torch.zeros(1, 3)}, {"kind": "policy"})
    args = {"goal_type": "combined", "encoder": "point_cloud", "task": unseen.HARD, "seed": 4}
    folders = {name: str(tmp_path) for name in ("runs_dir", "paths", "resume")}
    scene = envs.get_task("mixed_scenes").scene.sample(np.random.default_rng(0))
    path = np.zeros((2, 7), np.float32)
    shard = shard_bytes("mixed_scenes", 0, 0, [scene], [[path]], "a test")
    shard_path(tmp_path, 0).write_bytes(shard)
    made = {"steps": 9, "policy_step": 6, "validation_success_rate": 0.5, "seconds": 7}
    (tmp_path / "result.json").write_text(json.dumps(made | {"args": args | folders}))
    monkeypatch.setattr(sys, "argv", ["unseen_obstacles.py", "--keep", str(tmp_path)])
    unseen.main()
    path = tmp_path / "policies" / "dagger-combined-point_cloud-mixed_scenes-s4.pt"
    kept = load_network(path)(torch.ones(1, 3))
    assert torch.allclose(kept, network(torch.ones(1, 3)), atol=1e-2)
    text = path.with_suffix(".json").read_text()
    assert str(tmp_path) not in text and json.loads(text)["args"] == args
