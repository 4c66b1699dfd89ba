"""How fast does the planner plan, and how often does it find a plan in time?

    pip install -c constraints.txt -e .
    python benchmarks/planning.py    # random_boxes_hard
    python benchmarks/planning.py --task benchmaker_bookshelf_thin --split original

Plans the first `--num` queries with each of `--planners`, which take turns from query to query,
with the defaults of `planning.planner.Planner` and a new scene each. Times are processor time of
one thread, unsolved queries included. Lengths are L2 in the normalised space. A path collides if a
state does, of those at most 0.001 apart on it. The last line is JSON.
"""

import argparse
import contextlib
import json
import math
import os
import platform
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from tqdm import tqdm

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.planning.planner import COMPILED, PLANNERS, Planner, PlanningError


def plan(planner, query, seconds, seed):
    """(milliseconds, the path or None)"""
    path = None
    began = time.thread_time()
    with contextlib.suppress(PlanningError):
        path = planner.plan(*query, seed=seed, time_limit=seconds)
    return 1e3 * (time.thread_time() - began), path


def length_and_contact(query, path):
    """L2, normalised, of a path (n, j), rad, and whether a state on it collides."""
    states = query.scene.robot.normalise(path.astype(np.float64)).clip(-1.0, 1.0)
    moves = states[:-1], states[1:]
    is_free = CollisionChecker(query.scene).is_motion_free(*moves, resolution=0.001).all()
    return np.linalg.norm(moves[1] - moves[0], axis=1).sum(), not is_free


def main():
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--task", default="random_boxes_hard", help="with another arm, TASK@FILE")
    parser.add_argument("--split", default="test", choices=["test", "validation", "original"])
    parser.add_argument("--num", type=int, default=1000, help="queries (1,000)")
    parser.add_argument("--limit", type=float, default=5.0, help="seconds")
    parser.add_argument(
        "--planners", nargs="+", default=[COMPILED, "RRTConnect"], choices=PLANNERS, metavar="NAME"
    )
    args = parser.parse_args()
    if args.num < 1 or not 0 < args.limit < math.inf:
        parser.error("--num must be at least 1, --limit positive")
    queries = list(load_queries(args.task, args.split)[: args.num])
    env = envs.make(args.task)
    planners = {name: Planner(env, name) for name in args.planners}
    times = {name: [] for name in planners}
    results = {name: [] for name in planners}
    for planner in planners.values():
        plan(planner, queries[0], 60.0, 0)  # what is made once
    for seed, query in enumerate(tqdm(queries, desc=args.task, unit=" queries")):
        for name, planner in planners.items():
            milliseconds, path = plan(planner, query, args.limit, seed)
            times[name].append(milliseconds)
            if path is not None:
                results[name].append(length_and_contact(query, path))
    rows = {}
    for name in planners:
        lengths, contacts = zip(*results[name], strict=True)
        rows[name] = row = {
            "solved": len(lengths) / len(queries),
            "median_ms": float(np.median(times[name])),
            "mean_ms": float(np.mean(times[name])),
            "slow_ms": float(np.percentile(times[name], 90)),
            "length": float(np.mean(lengths)),
            "collide": int(sum(contacts)),
        }
        print(
            f"{name}: {row['solved']:.3f} solved; median {row['median_ms']:.2f} ms, mean "
            f"{row['mean_ms']:.2f} ms, 90 % {row['slow_ms']:.2f} ms; length {row['length']:.2f}; "
            f"{row['collide']} paths collide"
        )
    result = {"task": args.task, "split": args.split, "queries": len(queries), "planners": rows}
    print(json.dumps(result | {"python": platform.python_version()}))


if __name__ == "__main__":
    main()
