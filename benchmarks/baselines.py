"""Non-learning baselines on every task: go-to-goal, via-points, planners.

    python benchmarks/baselines.py --workers 2                  # 2 hours; what is done is skipped
    python benchmarks/baselines.py --only wall --workers 2
    python benchmarks/baselines.py --table                      # only writes the table

Each cell is a call of `clean_rl_scripts/evaluate.py` (goal `ee`): `go-to-goal` on all test queries,
the others on the first `--num`. Results go to benchmarks/results/baselines.json at once, so an
interrupted run goes on where it was; docs/benchmark/baselines.md is the table of what is there. The
planner's numbers depend on the machine, so nothing else should run beside it. Times are per query.
"""

import argparse
import datetime
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from roboarm_nmp import envs
from roboarm_nmp.envs.datasets.queries import load_queries, query_path
from roboarm_nmp.envs.utils.files import write_atomically

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks/results/baselines.json"
TABLE = ROOT / "docs/benchmark/baselines.md"
UNSEEN = ROOT / "benchmarks/results/unseen_obstacles.json"  # another benchmark's
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
COLUMNS = ("go-to-goal", REACTIVE, *list(CELLS)[1:])
# Success of go-to-goal in the paper, sections 5.2 to 5.4, which give none for the bookshelves.
PAPER = {
    "no_obstacles": 0.979,
    "wall": 0.765,
    "double_walls_wide_gap": 0.648,
    "double_walls": 0.453,
    "boxes": 0.806,
    "random_boxes_easy": 0.491,
    "random_boxes_medium": 0.370,
    "random_boxes_hard": 0.289,
    "three_shelves": 0.832,
    "pole_shelves": 0.721,
    "narrow_shelves": 0.539,
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
            result["date"] = datetime.date.today().isoformat()
            results.setdefault(task, {})[name] = result
            write_atomically(RESULTS, (json.dumps(results, indent=1) + "\n").encode())


def table(results, unseen):
    """The page, in Markdown. `unseen`: results of benchmarks/unseen_obstacles.py."""
    results = {task: dict(results.get(task, {})) for task in envs.TASKS}
    for task, found in unseen.items():
        if REACTIVE in found:
            results[task][REACTIVE] = found[REACTIVE]
    lines = [
        "# Non-learning baselines",
        "",
        "`python benchmarks/baselines.py` measures and writes this page (goal `ee`). The policies:",
        "[tasks.md](tasks.md). In each cell: success, collision-free success [95 % interval of",
        "success]. RRT-Connect and via-points use ground truth (privileged) unless the column says",
        "otherwise.",
        "LBKPIECE1 helps where RRT-Connect takes long ([demonstrations.md](demonstrations.md)).",
        "The success within 0.05 s depends on the machine and its load.",
        f"`{REACTIVE}` is `go-to-goal` with a [safety filter](safety_filter.md) on observed points",
        "(goal `combined`; its version: [unseen_obstacles.md](unseen_obstacles.md)).",
        "",
        "| task | paper, `go-to-goal` | " + " | ".join(COLUMNS) + " |",
        "|---" * (2 + len(COLUMNS)) + "|",
    ]
    for task in envs.TASKS:
        row = [f"`{task}`", f"{PAPER[task]:.3f}" if task in PAPER else "none given"]
        lines.append(
            "| " + " | ".join(row + [_cell(results, task, name) for name in COLUMNS]) + " |"
        )
    lines += [
        "",
        "Path length (rad, mean over successes) and, of planners, mean planning time (s):",
        "",
        "| task | " + " | ".join(COLUMNS) + " |",
        "|---" * (1 + len(COLUMNS)) + "|",
    ]
    for task in envs.TASKS:
        row = [_means(results, task, name) for name in COLUMNS]
        lines.append("| " + " | ".join([f"`{task}`", *row]) + " |")
    lines += ["", *_conditions(results), ""]
    return "\n".join(lines)


def _cell(results, task, name):
    result = results.get(task, {}).get(name)
    if result is None:
        return "not run"
    low, high = result["success_rate_interval"]
    rates = f"{result['success_rate']:.3f}, {result['collision_free_success_rate']:.3f}"
    return f"{rates} [{low:.3f}, {high:.3f}]"


def _means(results, task, name):
    result = results.get(task, {}).get(name)
    if result is None:
        return "not run"
    length = "-" if result["path_length"] is None else f"{result['path_length']:.2f}"
    seconds = result["planning_seconds"]
    return length if seconds is None else f"{length}; {seconds:.3f}"


def _conditions(results):
    done = [(name, result) for cells in results.values() for name, result in cells.items()]
    if not done:
        return []
    dates = sorted({result["date"] for _, result in done})
    counts = {name: {r["num_queries"] for other, r in done if other == name} for name in COLUMNS}
    said = [
        f"{name}: {' or '.join(f'{n:,}' for n in sorted(numbers))}"
        for name, numbers in counts.items()
        if numbers
    ]
    measured = " to ".join(dict.fromkeys([dates[0], dates[-1]]))
    return [
        f"Test queries per task: {'; '.join(said)}. Measured {measured}, on the machine of "
        "[benchmarks.md](benchmarks.md).",
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(envs.TASKS), metavar="TASK")
    parser.add_argument("--policies", nargs="+", default=list(CELLS), choices=list(CELLS))
    parser.add_argument("--num", type=int, default=1000, help="queries for those that search")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="run nothing")
    args = parser.parse_args()
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    if not args.table:
        # A task without a pretrained query file has no cells.
        tasks = args.only or [task for task in envs.TASKS if query_path(task).exists()]
        run(results, tasks, args.policies, args.num, args.workers)
    unseen = json.loads(UNSEEN.read_text()) if UNSEEN.exists() else {}
    write_atomically(TABLE, table(results, unseen).encode())
    print(f"{TABLE} written")


if __name__ == "__main__":
    main()
