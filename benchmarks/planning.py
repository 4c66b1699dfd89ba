"""How fast does the planner plan, and how often does it find a plan in time?

    pip install -c constraints.txt -e .
    python benchmarks/planning.py    # random_boxes_hard
    python benchmarks/planning.py --task benchmaker_bookshelf_thin --split original

Plans the first `--num` queries with `planning.planner.Planner` and its defaults, once for each of
`--limits`. Times are wall-clock time of one process, unsolved queries included, so nothing else
should run. Lengths are L2 in the normalised space. The last line is JSON.
"""

import argparse
import contextlib
import json
import os
import platform
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from tqdm import tqdm

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.planning.planner import Planner, PlanningError


def plan(planner, query, seconds, seed):
    """(milliseconds, the path or None)"""
    path = None
    began = time.perf_counter()
    with contextlib.suppress(PlanningError):
        path = planner.plan(*query, seed=seed, time_limit=seconds)
    return 1e3 * (time.perf_counter() - began), path


def length_of(path):
    """L2 in the normalised space, of a path (n, 7), rad."""
    return np.linalg.norm(np.diff(PANDA.normalise(path), axis=0), axis=1).sum()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="random_boxes_hard", choices=list(envs.TASKS))
    parser.add_argument("--split", default="test", choices=["test", "validation", "original"])
    parser.add_argument("--num", type=int, default=1000, help="queries (1,000)")
    parser.add_argument("--limits", type=float, nargs="+", default=[5.0, 0.05], help="seconds")
    args = parser.parse_args()
    if args.num < 1 or min(args.limits) <= 0:
        parser.error("--num must be at least 1, --limits positive")
    queries = load_queries(args.task, args.split)[: args.num]
    planner = Planner(envs.make(args.task))
    plan(planner, queries[0], 60.0, 0)  # compiles
    result = {"task": args.task, "split": args.split, "queries": len(queries)}
    for seconds in args.limits:
        plans = [
            plan(planner, queries[i], seconds, i)
            for i in tqdm(range(len(queries)), desc=f"{args.task}, {seconds:g} s", unit=" queries")
        ]
        times = np.array([milliseconds for milliseconds, _ in plans])
        lengths = [length_of(path) for _, path in plans if path is not None]
        median, slow = np.percentile(times, [50, 90])
        solved = len(lengths) / len(plans)
        print(
            f"within {seconds:g} s: {solved:.3f} solved; mean {times.mean():.1f} ms, median "
            f"{median:.1f} ms, 90 % {slow:.1f} ms; length {np.mean(lengths):.2f}"
        )
        result[f"solved_in_{seconds:g}_s"] = solved
        result[f"mean_ms_in_{seconds:g}_s"] = times.mean()
    print(json.dumps(result | {"python": platform.python_version()}))


if __name__ == "__main__":
    main()
