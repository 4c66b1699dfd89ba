"""The tables of unseen scenes, from results, and a run's policy by name."""

import json
import sys

import numpy as np
import torch
import unseen_obstacles as unseen

from roboarm_nmp import envs
from roboarm_nmp.datasets.roadmap_paths import shard_bytes
from roboarm_nmp.datasets.shards import shard_path
from roboarm_nmp.envs.tasks import STATIC_TASKS
from roboarm_nmp.networks.exported_networks import load_network, save_network
from roboarm_nmp.policies.safety_filter import VERSION


def result(success, collision_free, number=200):
    return {
        "success_rate": success,
        "success_rate_interval": [success - 0.03, success + 0.03],
        "collision_free_success_rate": collision_free,
        "num_queries": number,
        "ms_per_action": 1.25,
        "planning_seconds": 0.5,
        "date": "2026-11-22",
    }


def test_tables_list_what_was_run_with_one_quantity_per_column():
    hard = {unseen.OBSERVED: result(0.93, 0.91, 3000)}
    hard[f"{unseen.OBSERVED}, no filter"] = result(0.7, 0.4)
    hard[f"{unseen.OBSERVED}, seed 3"] = result(0.91, 0.85)
    found = {unseen.HARD: hard, "wall": {unseen.OBSERVED: result(0.8, 0.75)}}
    found["wall"]["dagger, oracle"] = result(0.7, 0.6) | {"safety_filter": {"escape": True}}
    tables = unseen.tables(found, {unseen.HARD: {}})
    _, _, row = tables["unseen-policies"].splitlines()
    numbers = "0.930 | [0.900,\u00a00.960] | 0.910 | 3,000 | 1.2 | – |"
    assert row == f"| DAgger | point cloud | point cloud | no | {numbers}"
    _, _, without, with_filter = tables["unseen-filter"].splitlines()
    assert "| none | – | 0.700 |" in without
    assert "| filter and escape | point cloud | 0.930 |" in with_filter
    assert [row[:12] for row in tables["unseen-seeds"].splitlines()[2:]] == [
        "| 1 | 0.930 ",
        "| 3 | 0.910 ",
    ]
    success, free = (tables[f"unseen-tasks-{key}"] for key in ("success", "collision-free"))
    (wall,) = [line for line in success.splitlines() if line.startswith("| `wall` |")]
    assert wall == "| `wall` | 0.971 | – | – | 0.800 | – | 0.700\\* | – |"
    assert success.endswith("\\*: measured with version 1 of the safety filter.")
    assert "| `wall` | – | – | 0.750 | – | 0.600\\* | – |" in free
    assert all(f"| `{task}` |" in success for task in STATIC_TASKS)


def test_results_of_other_flags_files_or_fewer_queries_are_run_again():
    name = unseen.OBSERVED
    safety_filter = {"margin": 0.01, "escape": True, "version": VERSION}
    done = result(0.9, 0.8) | {"flags": unseen.CELLS[name], "safety_filter": safety_filter}
    assert unseen.is_done(done, name, 200)
    for change in (
        {"num_queries": 100},
        {"flags": [*unseen.CELLS[name], "--seed", "1"]},
        {"safety_filter": safety_filter | {"version": 2}},
        {"safety_filter": safety_filter | {"version": 3, "approach": True}},
        {"safety_filter": {"margin": 0.01, "escape": True}},
    ):
        assert not unseen.is_done(done | change, name, 200)
    assert not unseen.is_done(None, name, 200)
    decoded = {"encoder": "point_cloud", "num_points": 32, "geometry_source": "field"}
    with_field = done | {"geometry_source": None, "env": decoded}
    assert unseen.digests(with_field).keys() == {"field"}
    assert unseen.is_done(with_field | {"encoders": unseen.digests(with_field)}, name, 200)
    replaced = with_field | {"encoders": {"field": "0123456789ab"}}
    assert not unseen.is_done(replaced, name, 200) and unseen._mark(replaced) == "†"
    # The first version and the second differ in the escape only.
    first, second = ({"margin": 0.01, "escape": False, "version": version} for version in (1, 2))
    assert {unseen._mark(done | {"safety_filter": one}) for one in (first, second)} == {"‡"}
    assert unseen._mark(done | {"safety_filter": first | {"escape": True}}) == "\\*"
    assert not unseen.is_done(done | {"safety_filter": second}, name, 200)
    # The third and the fourth differ in approach paths only.
    assert unseen.is_done(done | {"safety_filter": safety_filter | {"version": 3}}, name, 200)


def test_policy_of_a_run_is_kept_by_name_with_its_flags(tmp_path, monkeypatch):
    monkeypatch.setattr(unseen, "POLICIES", tmp_path / "policies")
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
    assert json.loads(text)["policy_step"] == 6
