"""An entry to the benchmark: a program that searches for a path among observed points.

    roboarm benchmark run --program "python examples/10_benchmark_entry.py" --searches \\
        --observes point_cloud --tasks random_boxes_hard --num-queries 50 --output entry
    roboarm benchmark verify entry

The second command replays every episode and compares its numbers. The program reads a problem per
line, as JSON, and answers each with a path, so yours may be in any language. The rules are in
docs/benchmark/enter.md; `examples/benchmark` has entries that act step by step, or are functions.
"""

import json
import sys

import numpy as np

import roboarm_nmp
from roboarm_nmp.envs.scenes.primitives import ObservedScene
from roboarm_nmp.planning.planner import Planner, PlanningError


def main() -> None:
    planner = Planner(roboarm_nmp.make("no_obstacles"), max_checks=100_000)
    for line in sys.stdin:
        problem = json.loads(line)
        scene = ObservedScene(points=np.array(problem["points"], np.float32))  # (n, 3), m
        start = np.array(problem["start"], np.float32)  # (7,), rad
        goal = np.array(problem["goal"], np.float32)
        try:
            path = planner.plan(start, goal, scene, seed=problem["seed"], time_limit=60.0)
            answer = path.tolist()  # (k, 7), rad
        except (PlanningError, ValueError):  # no path, or a start or goal that touches a point
            answer = None
        print(json.dumps({"path": answer}), flush=True)


if __name__ == "__main__":
    main()
