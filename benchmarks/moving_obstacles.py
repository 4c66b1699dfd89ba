"""Policies and baselines in scenes with moving obstacles.

    python benchmarks/moving_obstacles.py --folder moving_results --num 200

Each cell is `roboarm evaluate` on the first `--num` test queries of a task; its result is a JSON
file in `--folder`, and cells that have one are not run again. The table of
docs/benchmark/moving_obstacles.md shows all of them.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import tyro
from markdown_tables import interval, share, write_csv

from roboarm_nmp.envs.policies.safety_filter import SafetyFilter
from roboarm_nmp.envs.tasks import TASKS
from roboarm_nmp.envs.training.evaluation import evaluate
from roboarm_nmp.envs.utils.files import write_atomically

NAME = "moving_obstacles.csv"
HEAD = ("task", "method", "obstacles from", "search", "filter", "queries")
HEAD += ("success", "95 % interval", "collision-free success", "its 95 % interval")
POINTS = {"geometry_source": "point_cloud"}
FILTER = {"safety_filter": SafetyFilter(0.01)}
GOAL = {"env": {"goal_type": "combined"}}
PRETRAINED = "dagger-combined-point_cloud-random_boxes_hard-s1"
TASKS_HERE = [name for name, task in TASKS.items() if hasattr(task.scene, "animate")]


@dataclass(frozen=True)
class Method:
    """A row of each task: words for the table, the policy, and options of `evaluate`."""

    label: str
    policy: str
    search: str
    options: dict[str, Any]


METHODS = {
    "go": Method("go-to-goal", "go-to-goal", "no", GOAL),
    "go-filter": Method("go-to-goal", "go-to-goal", "no", GOAL | POINTS | FILTER),
    "plan": Method("one plan at the start", "planner", "once", GOAL | POINTS),
    "policy": Method("DAgger", PRETRAINED, "no", {}),
    "policy-replan": Method(
        "DAgger, replans when stuck", PRETRAINED, "when stuck", {"replan": True}
    ),
    "replanning": Method("replanning", "replanning", "when blocked", GOAL | POINTS | FILTER),
    "space-time": Method("space-time, a reference", "space-time", "of the future", GOAL),
}


@dataclass
class Args:
    folder: Path
    """Folder of the results."""
    num: int = 200
    """Test queries of each cell."""
    only: tuple[str, ...] = ()
    """Only these tasks."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Only these methods."""
    workers: int = 1
    """Processes."""


def row_of(task, method, result):
    """A row of the table."""
    source = (result["geometry_source"] or "nowhere").replace("_", " ")
    cells = [f"`{task}`", method.label, source, method.search]
    cells += ["yes" if result["safety_filter"] else "no", result["num_queries"]]
    for name in ("success_rate", "collision_free_success_rate"):
        cells += [share(result[name]), interval(result[f"{name}_interval"])]
    return cells


def main(args):
    args.folder.mkdir(parents=True, exist_ok=True)
    for task in args.only or TASKS_HERE:
        for name in args.methods:
            file, method = args.folder / f"{task}--{name}.json", METHODS[name]
            if not file.exists():
                options = {"num_queries": args.num, "workers": args.workers, **method.options}
                result = evaluate(method.policy, task, progress=True, **options)
                write_atomically(file, json.dumps(result, indent=1).encode())
    rows = []
    for task in TASKS_HERE:
        for name, method in METHODS.items():
            file = args.folder / f"{task}--{name}.json"
            if file.exists():
                rows.append(row_of(task, method, json.loads(file.read_text())))
    write_csv(NAME, HEAD, rows)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
