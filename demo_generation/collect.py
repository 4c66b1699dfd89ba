"""Collect demonstrations: sample a query, plan, follow the plan in the simulator, verify, store.

    roboarm collect --task double_walls --num 10000

Paper: appendix "Collection of demonstrations". Demonstration i depends only on the seed, i and the
options, so the file is the same on every machine and for every number of workers. Every verified
demonstration is written to a journal beside the output at once. After an interruption of any kind,
the same command continues from the journal.
"""

import base64
import collections
import contextlib
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import demo_path, write_demos
from roboarm_nmp.datasets.journal import Journal, journal_of
from roboarm_nmp.datasets.queries import query_path, validate
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.following import Execution, follow
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Scene, from_lists, to_lists
from roboarm_nmp.planning.planner import Planner, PlanningError
from roboarm_nmp.utils import flags, workers
from roboarm_nmp.utils.files import check_writable
from roboarm_nmp.utils.flags import (
    CORES,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveInt,
    Seed,
    Workers,
)
from roboarm_nmp.utils.progress import progress_bar, write_line
from roboarm_nmp.utils.random_streams import Stream
from roboarm_nmp.utils.signals import end_with_one_line, error_line

MAX_QUERIES = 100  # tried for one demonstration
ATTEMPTS = 3  # plans tried on a query of the Panda
REASONS = ("no_plan", "missed", "collided", "too_long")


@dataclass
class Args:
    task: str
    """Name of a task, or path of a scene file; with another arm, TASK@FILE."""
    num: PositiveInt = 10_000
    """Number of demonstrations."""
    seed: Seed = 0
    """Seed of queries and plans. (The pretrained files have 0, and plans of an earlier version.)"""
    workers: Workers = CORES
    """Number of processes, by default that of the cores. The file does not depend on it."""
    planner: str = "compiled"
    """The compiled planner, or one of OMPL's, by name."""
    max_checks: PositiveInt = 200_000
    """Collision checks for one plan (about 0.2 us each)."""
    clearance: NonNegativeFloat = 0.005
    """Metres between plans and the scene, where start and goal allow it."""
    planner_range: NonNegativeFloat = 0.4
    """Longest motion (normalised) that the planner tries at once; 0 for OMPL's choice."""
    simplify: NonNegativeInt = 1
    """Rounds of removing vertices of a plan and cutting its corners."""
    attempts: PositiveInt | None = None
    """Plans tried on a query before it is given up for a new one. By default 3 (paper); 1 for other
    arms than the Panda, where many a random query has no plan."""
    allow_collisions: bool = False
    """Accept demonstrations with contact that reach the goal (the paper's rule)."""
    output: Path | None = None
    """File to write. The default is `src/roboarm_nmp/datasets/demos/<task>.h5`, or
    `<name>_demos.h5` beside a scene file, or `<task>@<robot>_demos.h5` beside a robot's file."""
    overwrite: bool = False
    """Replace the output, if it exists."""
    ray_address: str | None = None
    """Work on the Ray cluster at this address (`auto`, `HOST:PORT`) and not in local processes."""


# What a demonstration depends on, besides its number.
OPTIONS = (
    "task",
    "seed",
    "planner",
    "max_checks",
    "clearance",
    "planner_range",
    "simplify",
    "attempts",
    "allow_collisions",
)
PLANNER_OPTIONS = ("planner", "max_checks", "clearance", "planner_range", "simplify")
# Those of files that were made before these were options, such as the pretrained files.
EARLIER_OPTIONS = {"planner_range": 0.0, "simplify": 3}


def options_of(args: Args) -> dict:
    """The `OPTIONS` in `args`, whose task is known, as a dict."""
    options = {name: getattr(args, name) for name in OPTIONS}
    if args.attempts is None:
        is_panda = envs.get_task(args.task).base_scene.robot == PANDA
        options["attempts"] = ATTEMPTS if is_panda else 1
    return options


def make_planner(env: RoboArmEnv, options: dict) -> Planner:
    """A `Planner` with the `PLANNER_OPTIONS` of a collection, or of a demonstration file."""
    options = EARLIER_OPTIONS | options
    return Planner(env, **{name: options[name] for name in PLANNER_OPTIONS})


class Collector:
    """Makes demonstrations one by one; `options` is a dict with the keys `OPTIONS`."""

    def __init__(self, options: dict):
        self.options = options
        self.env = envs.make(options["task"])
        self.planner = make_planner(self.env, options)

    def __call__(self, index: int) -> dict:
        """Demonstration `index`: a JSON-ready dict with its plan, execution and rejections."""
        options = self.options
        rejected = collections.Counter()
        rng = np.random.default_rng([options["seed"], Stream.DEMONSTRATIONS, index])
        for given_up in range(MAX_QUERIES):
            self.env.sample_scene(rng)
            start, goal = self.env.sample_query(rng)
            demo = demonstrate(
                self.planner,
                start,
                goal,
                rng,
                options["attempts"],
                options["allow_collisions"],
                rejected,
            )
            if demo is not None:
                return {
                    "index": index,
                    "plan": _encode(demo.plan),
                    "states": _encode(demo.execution.states),
                    "digest": demo.execution.digest,
                    "collided": demo.execution.collided,
                    "plan_seed": demo.plan_seed,
                    "obstacles": to_lists(self.env.scene.obstacles),
                    "rejected": dict(rejected),
                    "given_up": given_up,
                }
        raise RuntimeError(
            f"{MAX_QUERIES} queries in a row could not be solved ({dict(rejected)}): "
            f"are the limits too tight?"
        )


class Demonstration(NamedTuple):
    """A plan, float32 (k, j), rad; its `Execution`; and the seed of the planner."""

    plan: np.ndarray
    execution: Execution
    plan_seed: int


def demonstrate(
    planner: Planner,
    start: np.ndarray,
    goal: np.ndarray,
    rng: np.random.Generator,
    attempts: int,
    allow_collisions: bool = False,
    rejected: collections.Counter | None = None,
) -> Demonstration | None:
    """Plan and follow the plan until it works; None where it does not.

    Args:
        planner: a `Planner` with `max_checks`; its environment has the query's scene.
        start, goal: float32 (j,), rad.
        rng: NumPy Generator of the planner's seeds.
        attempts: plans to try at most.
        allow_collisions: accept an execution with contact.
        rejected: a Counter to which the reasons of failed attempts, `REASONS`, are added.
    """
    rejected = collections.Counter() if rejected is None else rejected
    for _ in range(attempts):
        seed = int(rng.integers(1, 2**32))
        try:
            # A limit in seconds would make the result depend on the machine.
            plan = planner.plan(start, goal, seed=seed, time_limit=math.inf)
        except PlanningError:
            rejected["no_plan"] += 1
            continue
        execution = follow(planner.env, plan)
        if not execution.reached:
            rejected["missed"] += 1
        elif execution.collided and not allow_collisions:
            rejected["collided"] += 1
        elif len(execution.states) - 1 > planner.env.horizon:
            rejected["too_long"] += 1
        else:
            return Demonstration(plan, execution, seed)
    return None


def _encode(array: np.ndarray) -> str:
    return base64.b64encode(array.astype("<f4").tobytes()).decode()


def _decode(text: str, num_joints: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, num_joints)


def collect(
    path: Path,
    num: int,
    options: dict,
    num_workers: int = 1,
    ray_address: str | None = None,
    progress: bool = True,
) -> collections.Counter:
    """Collect demonstrations into the journal of `path`, write the file, delete the journal.

    `options` has the keys `OPTIONS`. With `ray_address`, a Ray cluster works instead of local
    processes. Returns counts, as stored in the file: `attempts`, those rejected by reason, and
    `queries_given_up`.

    Raises:
        ValueError: the journal belongs to another collection, or is in use.
        RuntimeError: no query can be solved, or workers keep dying.
        ConnectionError: there is no Ray cluster.
        OSError: journal or file cannot be written.
        Whatever is raised, what is in the journal is safe.
    """
    with contextlib.closing(Journal(journal_of(path), options)) as journal:
        missing = [index for index in range(num) if index not in journal.entries]
        bar = progress_bar(
            description=options["task"],
            total=num,
            initial=num - len(missing),
            unit="demo",
            disable=not progress,
        )
        if ray_address is None:
            results = workers.run(Collector, (options,), missing, num_workers, warn=write_line)
        else:
            results = workers.run_on_ray(ray_address, Collector, (options,), missing)
        with bar, contextlib.closing(results):
            for demo in results:
                journal.append(demo)
                bar.update()
        demos = [journal.entries[index] for index in range(num)]
        counts = collections.Counter(attempts=num, queries_given_up=0)
        for reason in REASONS:
            counts[reason] = sum(demo["rejected"].get(reason, 0) for demo in demos)
            counts["attempts"] += counts[reason]
        counts["queries_given_up"] = sum(demo["given_up"] for demo in demos)
        task = envs.get_task(options["task"])
        base, scenes_of = task.base_scene, None
        joints = base.robot.num_joints
        if not isinstance(task.scene, Scene):
            scenes_of = [replace(base, obstacles=from_lists(demo["obstacles"])) for demo in demos]
        words = [f"--{name.replace('_', '-')} {options[name]}" for name in OPTIONS[:-1]]
        if options["allow_collisions"]:
            words.append("--allow-collisions")
        write_demos(
            path,
            options["task"],
            options["seed"],
            [_decode(demo["plan"], joints) for demo in demos],
            [_decode(demo["states"], joints) for demo in demos],
            {name: [demo[name] for demo in demos] for name in ("plan_seed", "digest", "collided")},
            made_by=f"roboarm collect --num {num} {' '.join(words)}",
            parameters={"options": options, "counts": counts},
            scenes_of=scenes_of,
        )
        journal_of(path).unlink()
        return counts


def _check(args: Args) -> Path:
    """The path to write. Raises ValueError for arguments that cannot work."""
    flags.check(args)
    default = demo_path(args.task)  # rejects an unknown task, also with --output
    path = args.output or default
    if not envs.get_task(args.task).trainable:
        raise ValueError(f"{args.task} is for testing only: training on it is not allowed")
    check_writable(path)
    if path.exists() and not args.overwrite:
        raise ValueError(f"{path} exists; --overwrite replaces it")
    workers.check_ray(args.ray_address)
    if query_path(args.task).exists():
        validate(query_path(args.task), args.task)  # demonstrations must not be of its queries
    with contextlib.closing(envs.make(args.task)) as env:
        # Rejects what a planner rejects. Last, because it may compile the collision checks.
        make_planner(env, vars(args))
    return path


def main(args: Args):
    """The command."""
    try:
        path = _check(args)
        options = options_of(args)
        counts = collect(path, args.num, options, args.workers, args.ray_address)
    except OSError as error:
        sys.exit(
            f"{error_line(error)}\nwhat was collected is safe; the same command continues from here"
        )
    except (ValueError, RuntimeError) as error:
        sys.exit(error_line(error))
    rejected = ", ".join(f"{counts[reason]} {reason}" for reason in REASONS)
    solved = args.num / (args.num + counts["queries_given_up"])
    print(
        f"{path}: {args.num} demonstrations from {counts['attempts']} attempts (rejected: "
        f"{rejected}); {counts['queries_given_up']} queries given up, {solved:.4f} solved"
    )


if __name__ == "__main__":
    end_with_one_line("the same command continues from here")
    main(flags.parse(Args, others="planner"))
