"""The benchmark of moving obstacles: cells are kept, and shown in order."""

import csv
import json
import sys

import markdown_tables
import pytest
from paths import ROOT

sys.path.append(str(ROOT / "benchmarks"))
import moving_obstacles  # noqa: E402


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder for results; the table goes there, too, and `evaluate` is not called for real."""

    def evaluate(policy, task, **options):
        shares = {
            "success_rate": {"runs/A": 0.5, "runs/B": 0.6}.get(policy, 0.75),
            "success_rate_interval": (0.5, 0.9),
        }
        shares |= {f"collision_free_{name}": value for name, value in shares.items()}
        source = options.get("geometry_source")
        return shares | {"geometry_source": source, "num_queries": 4, "safety_filter": None}

    monkeypatch.setattr(moving_obstacles, "evaluate", evaluate)
    monkeypatch.setattr(markdown_tables, "RESULTS", tmp_path)
    monkeypatch.setattr(markdown_tables, "pages", list)
    return tmp_path


def test_cells_that_have_a_result_are_not_run_again(folder):
    methods = "plan-truth", "plan", "go"
    args = moving_obstacles.Args(folder, only=("chased_goals",), methods=methods)
    moving_obstacles.main(args)
    file = folder / "chased_goals--plan.json"
    result = json.loads(file.read_text())
    file.write_text(json.dumps(result | {"success_rate": 0.25}))
    moving_obstacles.main(args)
    with open(folder / moving_obstacles.NAME, newline="") as table:
        head, *rows = csv.reader(table)
    assert head == list(moving_obstacles.HEAD) and len(set(head)) == len(head)
    shown = [(row[0], row[1], row[2], row[6]) for row in rows]
    assert shown == [
        ("`chased_goals`", "go-to-goal", "nowhere", "0.750"),
        ("`chased_goals`", "one plan at the start", "point cloud", "0.250"),
        ("`chased_goals`", "one plan at the start", "ground truth", "0.750"),
    ]


def test_rows_of_other_folders_stay_and_rows_are_in_order(folder):
    def rows_after(method):
        args = moving_obstacles.Args(folder / method, only=("chased_goals",), methods=(method,))
        moving_obstacles.main(args)
        with open(folder / moving_obstacles.NAME, newline="") as table:
            return [row[1:3] for row in csv.reader(table)][1:]

    truth, points = ["replanning", "ground truth"], ["replanning", "point cloud"]
    assert rows_after("replanning-truth") == [truth]
    assert rows_after("replanning") == [points, truth]
    assert rows_after("go") == [["go-to-goal", "nowhere"], points, truth]
    assert rows_after("replanning") == [["go-to-goal", "nowhere"], points, truth]


def test_other_seeds_have_a_table_of_their_own(folder):
    args = moving_obstacles.Args(folder, only=("chased_goals",), methods=("policy-replan",))
    moving_obstacles.main(args)
    before = (folder / moving_obstacles.NAME).read_bytes()
    args.seeds, args.methods = {2: "runs/A", 3: "runs/B"}, ("policy-replan", "go")
    moving_obstacles.main(args)
    with open(folder / moving_obstacles.SEEDS, newline="") as table:
        head, *rows = csv.reader(table)
    assert head == list(moving_obstacles.SEEDS_HEAD)
    assert [(row[2], row[4]) for row in rows] == [("1", "0.750"), ("2", "0.500"), ("3", "0.600")]
    assert (folder / moving_obstacles.NAME).read_bytes() == before
    assert [file.name for file in folder.glob("*--go*")] == ["chased_goals--go.json"]


def test_seed_of_the_pretrained_policy_is_refused(folder):
    args = moving_obstacles.Args(folder, methods=("policy-replan",), seeds={1: "runs/A"})
    with pytest.raises(SystemExit, match="pretrained"):
        moving_obstacles.main(args)
    assert not list(folder.iterdir())
