"""Benchmarks run with tiny numbers, and write their numbers where a page shows them."""

import csv
import json
import sys

import markdown_tables
import numpy as np
import pytest
from paths import ROOT
from trainers import run_here

sys.path.append(str(ROOT / "benchmarks"))


@pytest.mark.parametrize(
    ("name", "flags", "expected"),
    [
        ("planning", "--num 3 --limits 5", {"solved_in_5_s": 1.0, "queries": 3}),
        ("demo_throughput", "--num 2 --tasks wall", {}),
        ("env_throughput", "--blocks 2 --scenes 2", {"blocks": 2}),
    ],
)
def test_benchmark_runs_and_ends_with_json(name, flags, expected, capsys):
    if name == "env_throughput":
        pytest.importorskip("panda_gym", reason="needs the extra `bench`")
    run_here(ROOT / "benchmarks" / f"{name}.py", *flags.split())
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert expected.items() <= result.items()


@pytest.fixture
def tables(tmp_path, monkeypatch):
    """A folder that tables are written to, instead of the repository's pages."""
    monkeypatch.setattr(markdown_tables, "RESULTS", tmp_path)
    monkeypatch.setattr(markdown_tables, "pages", list)
    return tmp_path


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_moving_obstacles_runs_each_cell_once(tables):
    import moving_obstacles

    args = moving_obstacles.Args(tables, num=2, only=("chased_goals",), methods=("go",))
    moving_obstacles.main(args)
    [row] = rows(tables / moving_obstacles.NAME)
    assert (row["task"], row["method"], row["queries"]) == ("`chased_goals`", "go-to-goal", "2")
    file = tables / "chased_goals--go.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"success_rate": 0.125}))
    moving_obstacles.main(args)
    assert rows(tables / moving_obstacles.NAME)[0]["success"] == "0.125"


def test_sensor_noise_fills_the_cells_of_its_table(tables):
    import sensor_noise

    kinds = ("none", "missing-1")
    task = "random_boxes_hard"
    args = sensor_noise.Args(tables, num=1, kinds=kinds, tasks=(task,), methods=("plan",))
    sensor_noise.main(args)
    table = rows(tables / f"noise_{task}.csv")
    assert [row["noise"] for row in table] == ["none", "one camera missing"]
    assert all(row["one plan: success"] in ("0.000", "1.000") for row in table)


def test_median_time_to_success_counts_runs_that_never_reach_it_as_slow(tmp_path):
    import time_to_success

    args = time_to_success.Args(tmp_path)
    for name, minutes, reached in (
        ("ours", (5, 4, 9), (True, True, True)),
        ("sb3", (70, 20, 60), (False, True, False)),
    ):
        for seed, (minute, good) in enumerate(zip(minutes, reached, strict=True), start=1):
            run = {"reached": good, "seconds": 60.0 * minute, "steps": 1000 * minute}
            run |= {"updates": 500 * minute, "curve": [{"success": 0.9 if good else 0.4}]}
            time_to_success.file_of(args, name, seed).write_text(json.dumps(run))
    runs = time_to_success.runs_of(args, time_to_success.LEARNERS)
    ours = ["ours", "3 of 3", "5.0", "5,000", "2,500", "0.900", "1.0"]
    sb3 = ["sb3", "1 of 3", "more than 60.0", "60,000", "30,000", "0.400", "more than 12.0"]
    assert time_to_success.rows_of(runs) == [ours, sb3]


def test_probe_decodes_cells_from_informative_latents_only():
    import decoded_geometry

    latents = np.random.default_rng(0).normal(size=(900, 6)).astype(np.float32)
    cells = latents > 0
    means = cells[:700].mean(0)
    for inputs, low, high in ((latents, 0.6, 1.0), (np.zeros_like(latents), -0.1, 0.05)):
        probabilities = decoded_geometry.probe(inputs[:700], cells[:700], inputs[700:], epochs=30)
        scores = decoded_geometry.scores(probabilities, means, cells[700:])
        assert low < scores["information"] < high
