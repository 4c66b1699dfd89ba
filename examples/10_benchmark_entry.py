"""Enter a method into the benchmark: a planner that searches among observed points.

    python examples/10_benchmark_entry.py --output entry
    roboarm benchmark verify entry

The second command replays every episode and compares its numbers. docs/benchmark/enter.md has the
rules; in examples/benchmark there are more entries.
"""

import argparse
import sys
from functools import cache
from pathlib import Path

import numpy as np

import roboarm_nmp
from roboarm_nmp.envs.scenes.primitives import ObservedScene
from roboarm_nmp.evaluation.benchmark import main as benchmark
from roboarm_nmp.evaluation.entrants import Problem
from roboarm_nmp.planning.planner import Planner, PlanningError


@cache
def planner() -> Planner:
    """One planner for all episodes of a process."""
    return Planner(roboarm_nmp.make("no_obstacles"), max_checks=100_000)


def begin(problem: Problem) -> np.ndarray | None:
    """A path (k, 7), rad, which is then followed; None to give up."""
    assert problem.points is not None  # --observes point_cloud
    scene = ObservedScene(robot=problem.robot, points=problem.points)
    start, goal = problem.start.astype(np.float32), problem.goal.astype(np.float32)
    try:
        return planner().plan(start, goal, scene, seed=problem.seed, time_limit=60.0)
    except PlanningError:
        return None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", default="entry")
    parser.add_argument("--task", default="random_boxes_hard")
    parser.add_argument("--num-queries", default="50")
    args = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parent))
    method = ["--function", f"{Path(__file__).stem}:begin", "--observes", "point_cloud"]
    run = ["--searches", "--tasks", args.task, "--num-queries", args.num_queries, "--workers", "1"]
    return benchmark(["run", *method, *run, "--output", args.output])


if __name__ == "__main__":
    sys.exit(main())
