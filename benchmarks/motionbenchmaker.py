"""MotionBenchMaker's problems from their own files: imported, planned, and followed.

    pip install -c constraints.txt -e .
    python benchmarks/motionbenchmaker.py FOLDER

FOLDER has a folder a set, such as `bookshelf_tall_panda`, with `scene####.yaml` and
`request####.yaml`: those of MotionBenchMaker, or of VAMP's archive of them
(docs/benchmark/motionbenchmaker.md). The gripper is as open as the files say, 0.065 m a finger.

Each problem is planned once by `planning.planner.Planner` with its defaults and ground
truth, in one thread, for at most 5 s. The duration is that of `plan`: start and goal are checked in
PyBullet, the obstacles' shapes are prepared, the path is searched and shortened. Nothing else
should run. A plan is then followed in the simulator: it must reach the goal without contact.
"""

import os
import statistics
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import tyro
from markdown_tables import write_csv

from roboarm_nmp.datasets.import_problems import import_problems, summary
from roboarm_nmp.datasets.problems import load_problems
from roboarm_nmp.envs import RoboArmEnv
from roboarm_nmp.envs.following import follow
from roboarm_nmp.planning.planner import Planner, PlanningError
from roboarm_nmp.utils.progress import progress_bar

NAME = "motionbenchmaker.csv"
HEAD = ("set", "problems", "imported", "plan found within 5 s", "followed without contact")
HEAD += ("median duration (ms)", "mean duration (ms)", "longest duration (ms)")
TIME_LIMIT = 5.0  # s


@dataclass
class Args:
    folder: tyro.conf.Positional[Path]
    """Folder of the sets."""
    num: int | None = None
    """Only the first so many problems of each set; nothing is written then."""
    seed: int = 0
    """Of the planner."""


def measure(problems, seed=0):
    """Plan and follow problems.

    Returns:
        list of durations (ms) of the plans found, and the number of plans that reach the goal
        without contact.
    """
    env = RoboArmEnv(problems[0].scene, goal_type="combined")
    planner, durations, followed = Planner(env), [], 0
    planner.plan(*query_of(problems[0]), seed=seed)  # what is made once
    for number, problem in enumerate(progress_bar(problems, "planning", transient=True)):
        query = query_of(problem)
        env.set_scene(query[2])
        began = time.perf_counter()
        try:
            path = planner.plan(*query, seed=[seed, number], time_limit=TIME_LIMIT)
        except PlanningError:
            continue
        durations.append(1e3 * (time.perf_counter() - began))
        execution = follow(env, path)
        followed += execution.reached and not execution.collided
    env.close()
    return durations, followed


def query_of(problem):
    """Start, first goal and scene."""
    return problem.start, problem.goals[0], problem.scene


def row_of(name, total, imported, durations, followed):
    """A row of the table."""
    times = (statistics.median(durations), statistics.fmean(durations), max(durations))
    return [name, total, imported, len(durations), followed, *(f"{one:.1f}" for one in times)]


def main(args):
    folders = sorted(one for one in args.folder.iterdir() if any(one.glob("request*.yaml")))
    rows, everything = [], []
    for folder in folders:
        total = len(load_problems(folder)) if args.num is None else args.num
        kept, rejected = import_problems([folder])
        kept = kept[: args.num]
        print(summary(kept, rejected))
        durations, followed = measure(kept, args.seed)
        rows.append(row_of(f"`{folder.name}`", total, len(kept), durations, followed))
        everything.append((total, len(kept), durations, followed))
        print(", ".join(f"{name} {value}" for name, value in zip(HEAD, rows[-1], strict=True)))
    totals, imported, durations, followed = zip(*everything, strict=True)
    sums = sum(totals), sum(imported), sum(durations, []), sum(followed)
    rows.append(row_of("all", *sums))
    print(", ".join(f"{name} {value}" for name, value in zip(HEAD, rows[-1], strict=True)))
    if args.num is None:
        write_csv(NAME, HEAD, rows)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
