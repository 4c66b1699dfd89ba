"""Non-learning baselines on every task: go-to-goal, via-points, planners.

    python benchmarks/baselines.py --workers 2                  # 2 hours; what is done is skipped
    python benchmarks/baselines.py --only wall --workers 2
    python benchmarks/baselines.py --table                      # only writes the tables

Each cell is a call of `clean_rl_scripts/evaluate.py` (goal `ee`): `go-to-goal` on all test queries,
the others on the first `--num`. Results go to benchmarks/results/baselines.json at once, so an
interrupted run goes on where it was; docs/benchmark/baselines.md has tables of what is there. The
planner's numbers depend on the machine, so nothing else should run beside it. Times are per query.
"""

import argparse
import csv
import datetime
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from markdown_tables import NOTHING, share, table, write, write_cells

from roboarm_nmp.datasets.queries import load_queries, query_path
from roboarm_nmp.envs.tasks import STATIC_TASKS

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks/results/baselines.json"
UNSEEN = ROOT / "benchmarks/results/unseen_obstacles.json"  # another benchmark's
PAPER = ROOT / "benchmarks/results/paper_go_to_goal.csv"
# Wide scenes have a page of their own.
TABULATED = {name: task for name, task in STATIC_TASKS.items() if not name.startswith("wide")}
CELLS = {
    "go-to-goal": ["--policy", "go-to-goal"],
    "via-points, K = 16": ["--policy", "via-points", "--tries", "16"],
    "via-points, K = 64": ["--policy", "via-points", "--tries", "64"],
    "RRT-Connect, 0.05 s": ["--policy", "planner", "--time-limit", "0.05"],
    "RRT-Connect, 0.5 s": ["--policy", "planner", "--time-limit", "0.5"],
    "RRT-Connect, 5 s": ["--policy", "planner", "--time-limit", "5"],
    "plan from the point cloud, 5 s": [
        *("--policy", "planner", "--time-limit", "5"),
        *("--geometry-source", "point_cloud"),
    ],
}
REACTIVE = "go-to-goal, filter, point_cloud"  # which that one runs
PLANNERS = tuple(CELLS)[1:]
KEPT = ("success_rate", "success_rate_interval", "collision_free_success_rate")
KEPT += ("collision_free_success_rate_interval", "num_queries", "mean_steps", "path_length")
KEPT += ("ms_per_action", "planning_seconds")
COLUMNS = ("go-to-goal", REACTIVE, *PLANNERS)
SHOWN = {REACTIVE: "go-to-goal with safety filter"}
SOURCES = {
    "go-to-goal": "none",
    REACTIVE: "point cloud",
    "plan from the point cloud, 5 s": "point cloud",
}


def run(results, tasks, names, num, workers):
    """Fill in the cells that are missing, or had fewer queries."""
    for task in tasks:
        for name in names:
            wanted = len(load_queries(task)) if name == "go-to-goal" else num
            done = results.get(task, {}).get(name)
            if done is not None and done["num_queries"] >= wanted:
                continue
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "result.json"
                command = [sys.executable, ROOT / "clean_rl_scripts" / "evaluate.py"]
                command += ["--task", task, *CELLS[name], "--num-queries", str(wanted)]
                command += ["--workers", str(workers), "--json", path]
                subprocess.run(command, check=True)
                result = json.loads(path.read_text())
            result = {key: result[key] for key in KEPT}
            result["date"] = datetime.date.today().isoformat()
            results.setdefault(task, {})[name] = result
            write_cells(RESULTS, results)


def papers_go_to_goal():
    """Dict of task -> success of go-to-goal in the paper, sections 5.2 to 5.4."""
    with open(PAPER, newline="") as file:
        return {row["task"]: float(row["success"]) for row in csv.DictReader(file)}


def tables(results, unseen):
    """Name -> Markdown. `unseen`: results of benchmarks/unseen_obstacles.py."""
    results = {task: dict(results.get(task, {})) for task in TABULATED}
    for task, found in unseen.items():
        if REACTIVE in found:
            results[task][REACTIVE] = found[REACTIVE]
    papers = {task: share(value) for task, value in papers_go_to_goal().items()}
    success = matrix(results, "success_rate", share)
    for row, task in zip(success, TABULATED, strict=True):
        row.insert(1, papers.get(task, NOTHING))
    names = [SHOWN.get(name, name) for name in COLUMNS]
    head = ["task", *names]
    return {
        "baselines-policies": policies(results),
        "baselines-success": table(["task", "paper's go-to-goal", *names], success),
        "baselines-collision-free": table(
            head, matrix(results, "collision_free_success_rate", share)
        ),
        "baselines-path-length": table(head, matrix(results, "path_length", "{:.2f}".format)),
        "baselines-planning-time": table(
            ["task", *PLANNERS], matrix(results, "planning_seconds", "{:.3f}".format, PLANNERS)
        ),
    }


def matrix(results, key, form, names=None):
    """Rows: a task each, and one quantity of each policy."""
    rows = []
    for task in TABULATED:
        values = [results[task].get(name, {}).get(key) for name in names or COLUMNS]
        shown = [NOTHING if value is None else form(value) for value in values]
        rows.append([f"`{task}`", *shown])
    return rows


def policies(results):
    """Markdown: what each policy receives, and how exactly its success was measured."""
    rows = []
    for name in COLUMNS:
        done = [cells[name] for cells in results.values() if name in cells]
        if not done:
            continue
        counts = sorted({result["num_queries"] for result in done})
        widths = [np.diff(result["success_rate_interval"])[0] / 2 for result in done]
        dates = sorted({result["date"] for result in done})
        row = [SHOWN.get(name, name), SOURCES.get(name, "ground truth (privileged)")]
        row += ["yes" if name in PLANNERS else "no", " or ".join(f"{n:,}" for n in counts)]
        rows.append([*row, share(max(widths)), dates[-1]])
    head = ["policy", "geometry source", "search", "queries per task"]
    return table([*head, "half of the widest 95 % interval", "measured until"], rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(TABULATED), metavar="TASK")
    parser.add_argument("--policies", nargs="+", default=list(CELLS), choices=list(CELLS))
    parser.add_argument("--num", type=int, default=1000, help="queries for those that search")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="run nothing")
    args = parser.parse_args()
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    if not args.table:
        # A task without a pretrained query file has no cells.
        tasks = args.only or [task for task in TABULATED if query_path(task).exists()]
        run(results, tasks, args.policies, args.num, args.workers)
    unseen = json.loads(UNSEEN.read_text()) if UNSEEN.exists() else {}
    write(tables(results, unseen))


if __name__ == "__main__":
    main()
