"""What each algorithm reaches in 15 minutes of one core, on tasks with a fixed scene.

    python benchmarks/quarter_hour.py                          # all 54 cells
    python benchmarks/quarter_hour.py --tasks boxes --only sac crl --seeds 1 --workers 2

A cell trains with the flags of `RECIPES` until 15 minutes of processor time are over: loading
demonstrations and evaluating 100 validation queries now and then are part of them. The best policy
by validation then solves 1,000 test queries, without a safety filter. What is done is kept in
benchmarks/results/quarter_hour.json and skipped; a cell that was interrupted begins again. The
table of docs/lab_notebook.md has the mean of the seeds that are done.
"""

import datetime
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
import psutil
import tyro
from markdown_tables import NOTHING, RESULTS, share, table, write, write_cells

from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.flags import PositiveFloat, Seed, Workers

FILE = RESULTS / "quarter_hour.json"
MINUTES = 15.0
TEST_QUERIES = 1_000

Task = Literal["no_obstacles", "double_walls", "boxes"]
Algorithm = Literal["sac", "td3", "crl", "gciql", "bc", "diffusion"]
WITH_DEMOS = ["--goal-type", "ee", "--demo-prob", "1", "--bc-weight", "5"]
# Where the learning rate falls over the updates, their number fits into the time.
RECIPES = {
    "sac": [*WITH_DEMOS, "--eval-every", "10000", "--total-timesteps", "10000000"],
    "td3": [*WITH_DEMOS, "--eval-every", "10000", "--total-timesteps", "10000000"],
    "crl": [*WITH_DEMOS, "--eval-every", "25000", "--total-timesteps", "10000000"],
    "gciql": ["--goal-type", "ee", "--policy-average", "0.003", "--eval-every", "3000"]
    + ["--total-updates", "10000000"],
    "bc": ["--goal-type", "combined", "--eval-every", "25000", "--total-updates", "125000"],
    "diffusion": ["--goal-type", "combined", "--eval-every", "5000", "--total-updates", "25000"],
}


@dataclass
class Args:
    tasks: tuple[Task, ...] = get_args(Task)
    """tasks"""
    only: tuple[Algorithm, ...] = get_args(Algorithm)
    """algorithms"""
    seeds: tuple[Seed, ...] = (1, 2, 3)
    """seeds, a cell each"""
    workers: Workers = 1
    """cells at a time, one core each"""
    minutes: PositiveFloat = MINUTES
    """processor time of a training; other times than 15 minutes are not kept"""
    runs_dir: Path | None = None
    """where run folders are kept; by default they are temporary"""


def trained(algorithm, task, seed, minutes, folder):
    """Train in a process of its own; returns its run folder."""
    command = [sys.executable, "-m", "roboarm_nmp", "train", algorithm, "--task", task]
    command += ["--seed", str(seed), "--runs-dir", str(folder), "--eval-queries", "100"]
    command += ["--test-queries", "0", *RECIPES[algorithm]]
    log = folder / f"{algorithm}-{task}-{seed}.log"
    with open(log, "w") as output:
        process = psutil.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        while process.poll() is None:
            try:
                process.wait(1.0)
            except psutil.TimeoutExpired:
                times = process.cpu_times()
                if times.user + times.system > 60.0 * minutes:
                    process.send_signal(signal.SIGTERM)  # the trainer saves, and ends
                    process.wait(60.0)
    text = log.read_text()
    run = re.search(r"^run folder: (.*)$", text, re.MULTILINE)
    if run is None or not Path(run[1], "policy.onnx").exists():
        raise RuntimeError(f"{algorithm}, {task}, seed {seed} has no policy. It said:\n{text}")
    return Path(run[1])


def cell(algorithm, task, seed, minutes, folder):
    """Train and test: a dict of results."""
    run = trained(algorithm, task, seed, minutes, folder)
    found = evaluate(run / "policy.onnx", task, num_queries=TEST_QUERIES)
    names = ("success_rate", "collision_free_success_rate", "num_queries")
    return {name: found[name] for name in names} | {"date": str(datetime.date.today())}


def load_results():
    """Dict of task -> dict of cell's name -> its result."""
    return json.loads(FILE.read_text()) if FILE.exists() else {}


def quarter_hour_table(results):
    """Markdown: success and collision-free success, mean and range over seeds."""
    head = ["algorithm", "goal", *(f"`{task}`" for task in get_args(Task))]
    rows = []
    for algorithm in get_args(Algorithm):
        goal = RECIPES[algorithm][RECIPES[algorithm].index("--goal-type") + 1]
        row = [f"`{algorithm}`", f"`{goal}`"]
        for task in get_args(Task):
            cells = results.get(task, {})
            cells = [one for name, one in cells.items() if name.split(", ")[0] == algorithm]
            text = NOTHING
            if cells:
                success = [one["success_rate"] for one in cells]
                free = np.mean([one["collision_free_success_rate"] for one in cells])
                text = f"{share(np.mean(success))}, {share(free)}"
                if len(cells) > 1:
                    text += f" ({share(min(success))} to {share(max(success))})"
            row.append(text)
        rows.append(row)
    return table(head, rows)


def main():
    args = tyro.cli(Args, description=__doc__)
    flags.check(args)
    results = load_results()
    kept = args.minutes == MINUTES
    lock = threading.Lock()

    def run_one(one):
        seed, task, algorithm = one
        with tempfile.TemporaryDirectory() as temporary:
            folder = args.runs_dir or Path(temporary)
            folder.mkdir(parents=True, exist_ok=True)
            found = cell(algorithm, task, seed, args.minutes, folder)
        print(algorithm, task, seed, json.dumps(found), flush=True)
        with lock:
            if kept:
                results.setdefault(task, {})[f"{algorithm}, seed {seed}"] = found
                write_cells(FILE, results)

    cells = [(seed, task, one) for seed in args.seeds for task in args.tasks for one in args.only]
    waiting = [
        (seed, task, one)
        for seed, task, one in cells
        if not kept or f"{one}, seed {seed}" not in results.get(task, {})
    ]
    with ThreadPoolExecutor(args.workers) as pool:
        list(pool.map(run_one, waiting))
    write({"quarter_hour": quarter_hour_table(results)})


if __name__ == "__main__":
    main()
