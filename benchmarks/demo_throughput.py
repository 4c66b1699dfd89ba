"""Verified demonstrations per second on one core.

    pip install -c constraints.txt -e .
    python benchmarks/demo_throughput.py                                  # a minute
    python benchmarks/demo_throughput.py --planner-range 0 --simplify 3   # other options

`demo_generation.collect.Collector` makes `--num` demonstrations of each task: it draws a query,
plans, follows the plan, and keeps what reaches its goal without contact. Seconds are processor
time. The last line is JSON.
"""

import argparse
import json
import os
import platform
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from tqdm import tqdm

from roboarm_nmp.demo_generation import collect
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.tasks import STATIC_TASKS

TASKS = [name for name, task in STATIC_TASKS.items() if task.trainable]


def measure(args, number, progress):
    """Make demonstrations with the collector's `Args`; a dict of rates and means."""
    collector = collect.Collector(collect.options_of(args))
    plan = collector.planner.plan
    drawing, checks, lengths = [], [], []

    def timed(draw):
        def timed_draw(rng):
            began = time.process_time()
            drawn = draw(rng)
            drawing.append(time.process_time() - began)
            return drawn

        return timed_draw

    def counted_plan(*query, **options):
        try:
            path = plan(*query, **options)
        finally:
            checks.append(collector.planner.checks)
        lengths.append(np.linalg.norm(np.diff(PANDA.normalise(path), axis=0), axis=1).sum())
        return path

    collector(number)  # compiles
    collector.env.sample_scene = timed(collector.env.sample_scene)
    collector.env.sample_query = timed(collector.env.sample_query)
    collector.planner.plan = counted_plan
    given_up = 0
    began = time.process_time()
    for index in range(number):
        given_up += collector(index)["given_up"]
        progress.update(1)
    seconds = time.process_time() - began
    return {
        "demos_per_second": number / (seconds - sum(drawing)),
        "demos_per_second_with_drawing": number / seconds,
        "solved": number / (number + given_up),
        "checks_per_plan": float(np.mean(checks)),
        "length": float(np.mean(lengths)),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--num", type=int, default=100, help="demonstrations per task")
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    for name in ("planner_range", "simplify"):
        default = getattr(collect.Args, name)
        flag = f"--{name.replace('_', '-')}"
        parser.add_argument(flag, type=type(default), default=default, help=f"({default})")
    args = parser.parse_args()
    if args.num < 1:
        parser.error("--num must be at least 1")
    result = {}
    with tqdm(total=args.num * len(args.tasks), unit=" demonstrations") as progress:
        for task in args.tasks:
            progress.set_description(task)
            options = {"planner_range": args.planner_range, "simplify": args.simplify}
            result[task] = measure(collect.Args(task, **options), args.num, progress)
    print("\ntask                    per second  with drawing  solved  checks  length")
    for task, row in result.items():
        print(
            f"{task:22}{row['demos_per_second']:12.1f}{row['demos_per_second_with_drawing']:14.1f}"
            f"{row['solved']:8.2f}{row['checks_per_plan']:8.0f}{row['length']:8.2f}"
        )
    print(json.dumps({"python": platform.python_version(), "tasks": result}))


if __name__ == "__main__":
    main()
