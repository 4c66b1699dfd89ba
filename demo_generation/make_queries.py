"""Make the query files of tasks, `envs/data/<task>.h5`: random feasible starts and goals.

    python -m demo_generation.make_queries --task wall

Query i of a split depends on the seed, the split and i only, so the file is the same whatever the
number of workers. It is written at the end, in one piece: an interrupted run leaves what was there.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

import envs
from demo_generation import workers
from envs.arm_env import HOLD_DRIFT, SUBSTEPS, TIME_STEP
from envs.datasets import check_writable, query_path, write_queries

# Stored queries are held longer than those sampled in training: 0.8 s.
HOLD_STEPS = 24
# Not 0: NumPy makes the same stream of [seed, 0, 0] as of plain seed, so the first query would be
# that of an environment's `reset(seed=seed)`.
STREAMS = {"test": 1, "validation": 2}


@dataclass
class Args:
    task: tuple[str, ...]
    """Names of tasks, or `all`."""
    seed: int = 0
    """Seed of the queries; 0 gives the packaged files."""
    num_test: int = 10_000
    """Number of test queries."""
    num_validation: int = 200
    """Number of validation queries."""
    workers: int = 2
    """Number of processes. The file does not depend on it."""
    output: Path | None = None
    """File to write or replace; goes with one task. The default is `envs/data/<task>.h5`."""


def sample_query(env, seed, split, index):
    """Query `index` of a split: `(start, goal, rejected)`.

    Args:
        env: the task's environment.
        seed: int >= 0.
        split: `test` or `validation`.
        index: int >= 0.

    Returns:
        start and goal, float32 (7,), rad, and how many samples the long hold check rejected.
    """
    rng = np.random.default_rng([seed, STREAMS[split], index])
    rejected = 0
    while True:
        start, goal = env.sample_query(rng)
        if env.is_feasible(start, HOLD_STEPS) and env.is_feasible(goal, HOLD_STEPS):
            return start, goal, rejected
        rejected += 1


class Sampler:
    """Samples queries of a task; a job is (seed, split, index)."""

    def __init__(self, task):
        self.env = envs.make(task)

    def __call__(self, job):
        return job, sample_query(self.env, *job)


def make_queries(path, task, seed, num_test, num_validation, num_workers=1, progress=True):
    """Sample the queries of a task and write its file.

    Args:
        path: file to write or replace.
        task: name of the task.
        seed: int >= 0.
        num_test, num_validation: numbers of queries, > 0.
        num_workers: number of processes.
        progress: show a progress bar.

    Returns:
        How many samples the long hold check rejected.

    Raises:
        ValueError: unknown task.
        DatasetError, OSError: as `envs.datasets.write_queries` does.
    """
    query_path(task)  # refuses an unknown task
    jobs = [(seed, "test", i) for i in range(num_test)]
    jobs += [(seed, "validation", i) for i in range(num_validation)]
    bar = tqdm(desc=task, total=len(jobs), unit=" queries", disable=not progress)
    made = {}
    with bar:
        for job, query in workers.run(Sampler, (task,), jobs, num_workers, warn=bar.write):
            made[job] = query
            bar.update()
    start, goal, rejected = zip(*(made[job] for job in jobs), strict=True)
    start, goal = np.stack(start), np.stack(goal)
    test, validation = slice(0, num_test), slice(num_test, None)
    write_queries(
        path,
        task,
        seed,
        {"test": (start[test], goal[test]), "validation": (start[validation], goal[validation])},
        made_by=f"python -m demo_generation.make_queries --task {task} --seed {seed} "
        f"--num-test {num_test} --num-validation {num_validation}",
        parameters={
            "hold_steps": HOLD_STEPS,
            "hold_drift": HOLD_DRIFT,
            "time_step": TIME_STEP,
            "substeps": SUBSTEPS,
            "rejected": sum(rejected),
        },
    )
    return sum(rejected)


def _check(args):
    """The (task, path) pairs to make. Raises ValueError for arguments that cannot work."""
    tasks = tuple(envs.TASKS) if args.task == ("all",) else tuple(dict.fromkeys(args.task))
    if not tasks:
        raise ValueError(f"--task: one or more of {', '.join(envs.TASKS)}, or all")
    for name in ("seed", "num_test", "num_validation", "workers"):
        lowest = 0 if name == "seed" else 1
        if getattr(args, name) < lowest:
            raise ValueError(f"--{name.replace('_', '-')} must be at least {lowest}")
    if args.output is not None and len(tasks) > 1:
        raise ValueError("--output is one file: it goes with one task")
    pairs = [(task, args.output or query_path(task)) for task in tasks]
    for task, path in pairs:
        query_path(task)  # refuses an unknown task, also with --output
        check_writable(path)
    return pairs


def main(args):
    try:
        pairs = _check(args)
    except ValueError as error:
        sys.exit(f"error: {error}")
    try:
        for task, path in pairs:
            rejected = make_queries(
                path, task, args.seed, args.num_test, args.num_validation, args.workers
            )
            print(f"{path}: written; {rejected} samples rejected by the long hold check")
    except KeyboardInterrupt:
        print("interrupted: the file being made was not written", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m demo_generation.make_queries", description=__doc__))
