"""Policies and baselines in scenes with moving obstacles.

    python benchmarks/moving_obstacles.py --folder moving_results --num 200

Each cell is `roboarm evaluate` on the first `--num` test queries of a task; its result is a JSON
file in `--folder`, and cells that have one are not run again. They go into the table of
docs/benchmark/moving_obstacles.md, where other cells stay as they are. Other seeds of the policy
have a table of their own, beside seed 1, the pretrained one:

    python benchmarks/moving_obstacles.py --folder moving_results_1000 --num 1000 \
        --only appearing_boxes --methods policy-replan --seeds 2 runs/RUN 3 runs/RUN
"""

import itertools
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import tyro
from markdown_tables import csv_rows, interval, share, write_csv

from roboarm_nmp.envs.tasks import TASKS
from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.policies.safety_filter import SafetyFilter
from roboarm_nmp.utils.files import write_atomically

NAME, SEEDS = "moving_obstacles.csv", "moving_obstacles_seeds.csv"
HEAD = ("task", "method", "obstacles from", "search", "filter", "queries")
HEAD += ("success", "95 % interval", "collision-free success")
SEEDS_HEAD = ("task", "method", "seed", *HEAD[5:])
POINTS = {"geometry_source": "point_cloud"}
SOURCES = ("nowhere", "point cloud", "ground truth")
TRUTH = {"geometry_source": "ground_truth"}
FILTER = {"safety_filter": SafetyFilter(0.01)}
GOAL = {"env": {"goal_type": "combined"}}
PRETRAINED = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"
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
    "go-filter-truth": Method("go-to-goal", "go-to-goal", "no", GOAL | TRUTH | FILTER),
    "plan": Method("one plan at the start", "planner", "once", GOAL | POINTS),
    "plan-truth": Method("one plan at the start", "planner", "once", GOAL | TRUTH),
    "policy": Method("roadmap BC", PRETRAINED, "no", {}),
    "policy-replan": Method(
        "roadmap BC, replans when stuck", PRETRAINED, "when stuck", {"replan": True}
    ),
    "replanning": Method("replanning", "replanning", "when blocked", GOAL | POINTS | FILTER),
    "replanning-truth": Method("replanning", "replanning", "when blocked", GOAL | TRUTH | FILTER),
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
    seeds: dict[int, str] = field(default_factory=dict)
    """Other seeds than 1 of the policy: pairs of a seed and a policy."""


def rates_of(result):
    """Cells of a row: queries, success with its interval, collision-free success."""
    rates = share(result["success_rate"]), interval(result["success_rate_interval"])
    return [result["num_queries"], *rates, share(result["collision_free_success_rate"])]


def row_of(task, method, result):
    """A row of the table."""
    source = (result["geometry_source"] or "nowhere").replace("_", " ")
    cells = [f"`{task}`", method.label, source, method.search]
    return [*cells, "yes" if result["safety_filter"] else "no", *rates_of(result)]


def with_others(rows):
    """`rows` and the other rows of the table, which were not run in this folder, in order."""
    present = [list(row.values()) for row in csv_rows(NAME)]
    shown = {tuple(row[:3]): row for row in (*present, *rows)}
    labels = list(dict.fromkeys(method.label for method in METHODS.values()))

    def place(row):
        return TASKS_HERE.index(row[0].strip("`")), labels.index(row[1]), SOURCES.index(row[2])

    return sorted(shown.values(), key=place)


def cell(folder, task, name, seed):
    """The file of a result."""
    return folder / f"{task}--{name}{f'--seed-{seed}' if seed != 1 else ''}.json"


def main(args):
    if 1 in args.seeds:
        raise SystemExit("--seeds: seed 1 is the pretrained policy")
    args.folder.mkdir(parents=True, exist_ok=True)
    for seed, policy in ({1: PRETRAINED} | args.seeds).items():
        for task, name in itertools.product(args.only or TASKS_HERE, args.methods):
            file, method = cell(args.folder, task, name, seed), METHODS[name]
            learned = method.policy == PRETRAINED
            if (learned or seed == 1) and not file.exists():
                options = {"num_queries": args.num, "workers": args.workers, **method.options}
                acting = policy if learned else method.policy
                result = evaluate(acting, task, progress=True, **options)
                write_atomically(file, json.dumps(result, indent=1).encode())
    rows, rows_of_seeds = [], []
    for task, (name, method) in itertools.product(TASKS_HERE, METHODS.items()):
        for seed in sorted({1, *args.seeds}):
            file = cell(args.folder, task, name, seed)
            if file.exists():
                result = json.loads(file.read_text())
                if seed == 1:
                    rows.append(row_of(task, method, result))
                if method.policy == PRETRAINED:
                    rows_of_seeds.append([f"`{task}`", method.label, seed, *rates_of(result)])
    if args.seeds:
        write_csv(SEEDS, SEEDS_HEAD, rows_of_seeds)
    else:
        write_csv(NAME, HEAD, with_others(rows))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
