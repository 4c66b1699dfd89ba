"""Policies and baselines whose sensors are noisy.

    python benchmarks/sensor_noise.py --folder noise_results --num 100
    python benchmarks/sensor_noise.py --folder noise_more --num 400 --methods policy --only accepted

Each cell is `roboarm evaluate` on the first `--num` test queries of a task with one kind of noise;
its result is a JSON file in `--folder`, and cells that have one are not run again. All methods
observe four point clouds. `--shard 0/2` and `--shard 1/2` share the cells between two processes.
The cells go into the tables of docs/benchmark/sensor_noise.md. With `--only accepted`, its first
table shows these cells alone; in the others, cells that were not run stay as they are.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

os.environ.setdefault("OMP_NUM_THREADS", "1")

import tyro
from markdown_tables import NOTHING, csv_rows, interval, share, write_csv
from moving_obstacles import METHODS

from roboarm_nmp.envs.perception.noise import SensorNoise
from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.utils.files import write_atomically

TASKS = ("random_boxes_hard", "moving_boxes_medium")
LABELS = {
    "policy": "roadmap BC",
    "go-filter": "go-to-goal with filter",
    "plan": "one plan",
    "replanning": "replanning",
}
# Chosen on validation queries: docs/lab_notebook.md.
FILTER = {"edge_filter": 0.03}
# Three strengths of each kind: words for the table, and settings.
NOISES = {
    "none": ("none", {}),
    "gaussian-2": ("depth, 2 mm", {"gaussian": 0.002}),
    "gaussian-5": ("depth, 5 mm", {"gaussian": 0.005}),
    "gaussian-10": ("depth, 10 mm", {"gaussian": 0.01}),
    "per-metre-2": ("depth, 2 mm per m", {"per_metre": 0.002}),
    "per-metre-5": ("depth, 5 mm per m", {"per_metre": 0.005}),
    "per-metre-10": ("depth, 10 mm per m", {"per_metre": 0.01}),
    "quantisation-5": ("depth in steps of 5 mm", {"quantisation": 0.005}),
    "quantisation-10": ("depth in steps of 10 mm", {"quantisation": 0.01}),
    "quantisation-20": ("depth in steps of 20 mm", {"quantisation": 0.02}),
    "dropout-10": ("dropout, 10 %", {"dropout": 0.1}),
    "dropout-30": ("dropout, 30 %", {"dropout": 0.3}),
    "dropout-60": ("dropout, 60 %", {"dropout": 0.6}),
    "flying-10": ("flying pixels, 10 %", {"flying_pixels": 0.1}),
    "flying-30": ("flying pixels, 30 %", {"flying_pixels": 0.3}),
    "flying-100": ("flying pixels, 100 %", {"flying_pixels": 1.0}),
    "flying-10-filter": ("flying pixels, 10 %, edge filter", {"flying_pixels": 0.1} | FILTER),
    "flying-30-filter": ("flying pixels, 30 %, edge filter", {"flying_pixels": 0.3} | FILTER),
    "flying-100-filter": ("flying pixels, 100 %, edge filter", {"flying_pixels": 1.0} | FILTER),
    "missing-1": ("one camera missing", {"missing_cameras": 1}),
    "missing-2": ("two cameras missing", {"missing_cameras": 2}),
    "missing-3": ("three cameras missing", {"missing_cameras": 3}),
    "calibration-2": (
        "calibration, 2 mm and 0.2°",
        {"calibration_mm": 2.0, "calibration_degrees": 0.2},
    ),
    "calibration-5": (
        "calibration, 5 mm and 0.5°",
        {"calibration_mm": 5.0, "calibration_degrees": 0.5},
    ),
    "calibration-10": (
        "calibration, 10 mm and 1°",
        {"calibration_mm": 10.0, "calibration_degrees": 1.0},
    ),
    "latency-1": ("latency, 1 step", {"latency": 1}),
    "latency-3": ("latency, 3 steps", {"latency": 3}),
    "latency-6": ("latency, 6 steps", {"latency": 6}),
}
ACCEPTED = ("none", "gaussian-5", "dropout-10", "missing-1")
"""What a method should stand almost without a loss; measured on more queries."""


@dataclass
class Args:
    folder: Path
    """Folder of the results."""
    num: int = 100
    """Test queries of each cell."""
    only: Literal["all", "accepted"] = "all"
    """All kinds of noise, or only `ACCEPTED`, for a table of their own."""
    kinds: tuple[str, ...] = ()
    """Only these kinds of noise, names of `NOISES`."""
    tasks: tuple[str, ...] = TASKS
    """Only these tasks."""
    methods: tuple[str, ...] = tuple(LABELS)
    """Only these methods."""
    shard: str = "0/1"
    """K/N: only each Nth cell, from the Kth on."""


def file_of(folder, task, method, noise):
    return folder / f"{task}--{method}--{noise}.json"


def run(args, noises):
    k, n = map(int, args.shard.split("/"))
    cells = [(task, m, noise) for m in args.methods for noise in noises for task in args.tasks]
    for task, name, noise in cells[k::n]:
        file, method = file_of(args.folder, task, name, noise), METHODS[name]
        if not file.exists():
            print(file.stem, flush=True)
            settings = NOISES[noise][1]
            options = {"sensor_noise": SensorNoise(**settings)} if settings else {}
            options |= {"num_queries": args.num, **method.options}
            result = evaluate(method.policy, task, progress=True, **options)
            write_atomically(file, json.dumps(result, indent=1).encode())


def results(folder, task, noise):
    """Method -> result of the cells that have one."""
    files = {name: file_of(folder, task, name, noise) for name in LABELS}
    return {name: json.loads(f.read_text()) for name, f in files.items() if f.exists()}


def wide_table(folder, task):
    """A row per kind of noise: success and collision-free success of the methods that were run.

    A cell without a result in `folder` keeps what the table has.
    """
    kinds = ("success", "success_rate"), ("collision-free", "collision_free_success_rate")
    shown = {row["noise"]: row for row in csv_rows(f"noise_{task}.csv")}
    for noise, (words, _) in NOISES.items():
        row = shown.setdefault(words, {})
        for name, result in results(folder, task, noise).items():
            row |= {f"{LABELS[name]}: {kind}": share(result[key]) for kind, key in kinds}
    columns = [f"{label}: {kind}" for label in LABELS.values() for kind, _ in kinds]
    columns = [column for column in columns if any(column in row for row in shown.values())]
    rows = [(words, shown[words]) for words, _ in NOISES.values() if shown[words]]
    cells = [[words, *(row.get(column, NOTHING) for column in columns)] for words, row in rows]
    return ["noise", *columns], cells


def accepted_table(folder):
    """A row per task, method and kind of noise, with intervals."""
    head = ["task", "method", "noise", "queries", "success", "95 % interval"]
    head += ["collision-free success", "its 95 % interval"]
    rows = []
    for task in TASKS:
        for noise in ACCEPTED:
            for name, result in results(folder, task, noise).items():
                row = [f"`{task}`", LABELS[name], NOISES[noise][0], result["num_queries"]]
                for key in ("success_rate", "collision_free_success_rate"):
                    row += [share(result[key]), interval(result[f"{key}_interval"])]
                rows.append(row)
    return head, rows


def main(args):
    args.folder.mkdir(parents=True, exist_ok=True)
    run(args, args.kinds or (ACCEPTED if args.only == "accepted" else NOISES))
    if args.only == "accepted":
        write_csv("noise_accepted.csv", *accepted_table(args.folder))
    else:
        for task in TASKS:
            write_csv(f"noise_{task}.csv", *wide_table(args.folder, task))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
