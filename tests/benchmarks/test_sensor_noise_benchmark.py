"""The benchmark of sensor noise: cells are kept, shared out once, and shown where they were run."""

import csv
import sys

import markdown_tables
import pytest
from paths import ROOT

sys.path.append(str(ROOT / "benchmarks"))
import sensor_noise  # noqa: E402


@pytest.fixture
def calls(tmp_path, monkeypatch):
    """Calls of `evaluate`, which is not run for real; tables go to `tmp_path`."""
    made = []

    def evaluate(policy, task, **options):
        made.append((policy, task, options.get("sensor_noise"), options["num_queries"]))
        shares = {"success_rate": 0.75, "success_rate_interval": (0.5, 0.9)}
        return shares | {f"collision_free_{k}": v for k, v in shares.items()} | {"num_queries": 4}

    monkeypatch.setattr(sensor_noise, "evaluate", evaluate)
    monkeypatch.setattr(markdown_tables, "RESULTS", tmp_path)
    monkeypatch.setattr(markdown_tables, "pages", list)
    return made


def test_shards_share_all_cells_and_none_is_run_twice(calls, tmp_path):
    for shard in ("0/2", "1/2", "0/2"):
        sensor_noise.main(sensor_noise.Args(tmp_path, num=4, methods=("policy",), shard=shard))
    noises = [noise for _, task, noise, _ in calls if task == "moving_boxes_medium"]
    assert len(calls) == 2 * len(sensor_noise.NOISES) and len(noises) == len(set(noises)) == 28
    with open(tmp_path / "noise_random_boxes_hard.csv", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["noise", "DAgger: success", "DAgger: collision-free"]
    assert [row[1:] for row in rows] == [["0.750", "0.750"]] * 28


def test_only_the_given_kinds_are_run(calls, tmp_path):
    kinds = ("none", "flying-30-filter")
    sensor_noise.main(sensor_noise.Args(tmp_path, num=4, methods=("policy",), kinds=kinds))
    assert len(calls) == 4
    assert {noise.edge_filter if noise else None for _, _, noise, _ in calls} == {None, 0.03}


def test_cells_of_other_folders_stay_in_the_table(calls, tmp_path):
    task, folder = "random_boxes_hard", tmp_path / "other"
    first = sensor_noise.Args(tmp_path, num=4, methods=("policy",), tasks=(task,))
    sensor_noise.main(first)
    second = sensor_noise.Args(
        folder, num=4, methods=("plan",), tasks=(task,), kinds=("flying-30",)
    )
    sensor_noise.main(second)
    with open(tmp_path / f"noise_{task}.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["DAgger: success"] for row in rows] == ["0.750"] * 28
    plans = {row["noise"]: row["one plan: collision-free"] for row in rows}
    assert {words for words, cell in plans.items() if cell == "0.750"} == {"flying pixels, 30 %"}


def test_table_of_accepted_noise_has_a_row_per_task_and_kind(calls, tmp_path):
    args = sensor_noise.Args(tmp_path, num=4, methods=("policy",), only="accepted")
    sensor_noise.main(args)
    with open(tmp_path / "noise_accepted.csv", newline="") as file:
        _, *rows = csv.reader(file)
    assert [row[2] for row in rows[:4]] == [
        "none",
        "depth, 5 mm",
        "dropout, 10 %",
        "one camera missing",
    ]
    assert len(rows) == 8 and calls[0][2] is None and calls[2][2].gaussian == 0.005
