"""The tables of unseen scenes, from results, and a run's policy by name."""

import importlib.util
import json
import sys

import numpy as np
import torch
from paths import ROOT

from roboarm_nmp import envs
from roboarm_nmp.envs.datasets.roadmap_paths import shard_bytes
from roboarm_nmp.envs.datasets.shards import shard_path
from roboarm_nmp.envs.networks.exported_networks import load_network, save_network
from roboarm_nmp.envs.policies.safety_filter import VERSION

spec = importlib.util.spec_from_file_location(
    "unseen_obstacles", ROOT / "benchmarks" / "unseen_obstacles.py"
)
unseen = importlib.util.module_from_spec(spec)
spec.loader.exec_module(unseen)


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


def test_tables_between_the_marks_show_the_results(tmp_path, monkeypatch):
    page, results = tmp_path / "page.md", tmp_path / "results.json"
    page.write_text(f"# Before\n\n{unseen.BEGIN}outdated\n{unseen.END}\nAfter\n")
    hard = {unseen.OBSERVED: result(0.93, 0.91, 3000)}
    hard[f"{unseen.OBSERVED}, no filter"] = result(0.7, 0.4)
    found = {unseen.HARD: hard, "wall": {unseen.OBSERVED: result(0.8, 0.75)}}
    found["wall"]["dagger, oracle"] = result(0.7, 0.6) | {"safety_filter": {"escape": True}}
    found["boxes"] = {"dagger, oracle": result(0.7, 0.6) | {"safety_filter": {"escape": False}}}
    results.write_text(json.dumps(found))
    monkeypatch.setattr(unseen, "PAGE", page)
    monkeypatch.setattr(unseen, "RESULTS", results)
    monkeypatch.setattr(sys, "argv", ["unseen_obstacles.py", "--table"])
    unseen.main()
    text = page.read_text()
    assert text.startswith("# Before\n\n") and text.endswith("\nAfter\n") and "outdated" not in text
    (row,) = [line for line in text.splitlines() if line.startswith("| `dagger.py` | point cloud")]
    assert "| 0.700, 0.400 [200: 0.670, 0.730] | not run | 0.930, 0.910 [3,000: 0.9" in row
    assert row.endswith("| 1.2 |")
    (wall,) = [line for line in text.splitlines() if line.startswith("| `wall` |")]
    assert "0.800, 0.750 [200" in wall and wall.count("not run") == 2
    assert "| 0.700, 0.600\\* [200" in wall  # an older escape
    assert text.count("\\*") == 2 and "\\*: with the escape" in text and "†" not in text
    assert all(f"| `{task}` |" in text for task in envs.TASKS)
    assert "seeds" not in text
    # Again, the same.
    unseen.main()
    assert page.read_text() == text
    # With another seed.
    hard[f"{unseen.OBSERVED}, seed 3"] = result(0.91, 0.85)
    results.write_text(json.dumps(found))
    unseen.main()
    sentence = "`dagger.py` with point clouds, 2 seeds, `random_boxes_hard`: success 0.930, 0.910, "
    sentence += "so 0.920 ± 0.014; collision-free 0.910, 0.850, so 0.880 ± 0.042; of 3,000, 200 "
    sentence += "test queries."
    assert sentence in page.read_text().splitlines()


def test_results_of_other_flags_files_or_fewer_queries_are_run_again():
    name = unseen.OBSERVED
    safety_filter = {"margin": 0.01, "escape": True, "version": VERSION}
    done = result(0.9, 0.8) | {"flags": unseen.CELLS[name], "safety_filter": safety_filter}
    assert unseen.is_done(done, name, 200)
    for change in (
        {"num_queries": 100},
        {"flags": [*unseen.CELLS[name], "--seed", "1"]},
        {"safety_filter": safety_filter | {"version": VERSION - 1}},
        {"safety_filter": {"margin": 0.01, "escape": True}},
    ):
        assert not unseen.is_done(done | change, name, 200)
    assert not unseen.is_done(None, name, 200)
    decoded = {"encoder": "point_cloud", "num_points": 32, "geometry_source": "field"}
    with_field = done | {"geometry_source": None, "env": decoded}
    assert unseen.digests(with_field).keys() == {"field"}
    assert unseen.is_done(with_field | {"encoders": unseen.digests(with_field)}, name, 200)
    replaced = with_field | {"encoders": {"field": "0123456789ab"}}
    assert not unseen.is_done(replaced, name, 200) and "0.800† [" in unseen._cell(replaced)
    # The first version and the second differ in the escape only.
    first, second = ({"margin": 0.01, "escape": False, "version": version} for version in (1, 2))
    marked = [unseen._cell(done | {"safety_filter": one}) for one in (first, second)]
    assert marked[0] == marked[1] and "0.800‡ [" in marked[0]
    assert "0.800\\* [" in unseen._cell(done | {"safety_filter": first | {"escape": True}})
    assert not unseen.is_done(done | {"safety_filter": second}, name, 200)


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


def test_page_is_up_to_date_with_the_results():
    begin, end = (unseen.PAGE.read_text().index(mark) for mark in (unseen.BEGIN, unseen.END))
    others = unseen.others_results(json.loads(unseen.BASELINES.read_text()))
    shown = unseen.PAGE.read_text()[begin + len(unseen.BEGIN) : end]
    assert shown == unseen.tables(unseen.load_results(), others)
    assert others[unseen.HARD]["bc, vae, no filter"]["num_queries"] == 1000
