"""Benchmarks run with tiny numbers, and write their numbers where a page shows them."""

import csv
import json
import sys

import markdown_tables
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
