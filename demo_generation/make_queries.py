"""Make the query files of tasks (`datasets/data/<task>.h5`): random feasible starts and goals.

    roboarm queries --task wall
    roboarm queries --task random_boxes_hard --solvable
    roboarm queries --task three_shelves --goal-region 0.4 0.65 -0.4 0.4 0.24 0.46 \\
        --num-test 200 --num-validation 20 --output in_the_shelf.h5

With `--solvable`, a query is accepted only if the planner solves it. That means: one of
`SOLVE_ATTEMPTS` plans, of at most `SOLVE_CHECKS` collision checks each, reaches the goal in the
simulator without contact. With `--plannable` one plan has to be found, which is not followed.

With `--goal-region`, the end effector of every goal is in a box. The goals are random feasible
configurations as always, of which those elsewhere are left out. In scenes that vary, the box must
have room in every scene.

With `--limits datasheet`, starts and goals are inside the position limits of the arm's datasheet,
where these are narrower than the URDF's. Others are left out. Plans of `--solvable` stay inside.

Where obstacles move (`envs.scenes.moving_boxes`), each query has a scene of its own. Queries whose
start or goal is blocked when it has to be free are left out. Of these scenes and of wide ones
(`envs.scenes.wide_scenes`) the file stores seeds instead of obstacles.

Where scenes vary, `--queries-per-scene` queries in a row share a scene, which makes smaller files;
in wide scenes they share their start, too, unless no goal can be reached from it.

Query i of a split depends only on the seed, the split and i, so the file is the same on every
machine and for every number of workers. The file is written at the end, in one piece. Until then,
queries are written to a journal beside it. After an interruption, the same command continues.
"""

import contextlib
import math
import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from roboarm_nmp import envs
from roboarm_nmp.datasets.format import ORIGINAL, SeededScenes, scene_seeds
from roboarm_nmp.datasets.journal import Journal, journal_of
from roboarm_nmp.datasets.problems import load_problems
from roboarm_nmp.datasets.queries import query_path, write_queries
from roboarm_nmp.demo_generation.collect import MAX_QUERIES, demonstrate
from roboarm_nmp.envs import world
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.moving_boxes import MovingScenes
from roboarm_nmp.envs.scenes.primitives import Scene, from_lists, to_lists
from roboarm_nmp.envs.scenes.wide_scenes.distribution import WideScenes
from roboarm_nmp.envs.world import HOLD_DRIFT, SUBSTEPS, TIME_STEP
from roboarm_nmp.planning.planner import Planner, PlanningError
from roboarm_nmp.utils import flags, workers
from roboarm_nmp.utils.files import check_writable
from roboarm_nmp.utils.flags import CORES, PositiveInt, Seed, Workers
from roboarm_nmp.utils.progress import progress_bar, write_line
from roboarm_nmp.utils.random_streams import Stream
from roboarm_nmp.utils.signals import end_with_one_line, error_line

# Stored queries are held longer than those sampled in training, 0.8 s; not so in wide scenes.
HOLD_STEPS = 24
STREAMS = {"test": Stream.TEST_QUERIES, "validation": Stream.VALIDATION_QUERIES}
SCENES = 1  # a fourth number, for the scenes of a split
MAX_SCENES = 2**20  # wide ones of a split; more would be those of the next split
SOLVE_ATTEMPTS, SOLVE_CHECKS = 3, 200_000
SHARED_ATTEMPTS = 6  # queries to try from the start of a scene, before another one
# Random configurations for a goal in a region: as many at a time, and at most for one goal.
GOALS, MAX_GOALS = 1_000, 1_000_000


Region = Annotated[tuple[float, ...], tyro.conf.arg(metavar="XMIN XMAX YMIN YMAX ZMIN ZMAX")]
Limits = Literal["urdf", "datasheet"]


@dataclass
class Args:
    task: tuple[str, ...]
    """Names of tasks, or paths of scene files, with another arm as TASK@FILE; or `all`."""
    solvable: bool = False
    """Accept only queries that the planner solves."""
    plannable: bool = False
    """Accept only queries for which the planner finds a path; much faster than `--solvable`."""
    queries_per_scene: PositiveInt = 1
    """Queries in each scene, where scenes vary."""
    goal_region: Region = ()
    """Box (m) for the goals' end-effector positions, in the world's frame: its origin is the arm's
    base, x points to the front, y to the left, z up. By default they are anywhere."""
    limits: Limits = "urdf"
    """Position limits of starts and goals: the URDF's, or those of the arm's datasheet."""
    seed: Seed = 0
    """Seed of the queries. (The files of this project have seed 0.)"""
    num_test: PositiveInt = 10_000
    """Number of test queries."""
    num_validation: PositiveInt = 200
    """Number of validation queries."""
    workers: Workers = CORES
    """Number of processes, by default that of the cores. The file does not depend on it."""
    original: Path | None = None
    """File or folder of problems, such as MotionBenchMaker's (docs/customise/problems.md), to add
    as the split `original`; goes with one task."""
    output: Path | None = None
    """File to write; goes with one task. The default is `src/roboarm_nmp/datasets/data/<task>.h5`,
    or, for a scene file, `<name>_queries.h5` beside it, or, for a robot's file,
    `<task>@<robot>_queries.h5`."""
    overwrite: bool = False
    """Replace files that exist."""


class Sampler:
    """Samples queries of a task; a job is (seed, split, number)."""

    def __init__(
        self,
        task: str,
        solvable: bool,
        queries_per_scene: int = 1,
        goal_region: tuple[float, ...] | None = None,
        limits: Limits = "urdf",
        plannable: bool = False,
    ):
        self.queries_per_scene = queries_per_scene
        self.goal_region = goal_region
        self.limits: Limits = limits
        self.env = envs.make(task)
        self._wide_scene: tuple[int | None, np.ndarray | None] = None, None
        self.planner = None
        self.follows_plans = solvable
        if solvable or plannable:
            self.planner = Planner(self.env, max_checks=SOLVE_CHECKS, limits=limits)

    def __call__(self, job: tuple[int, str, int]) -> dict:
        """Query `number` of a split, as a JSON-ready dict.

        Its `rejected` counts the samples that the simulated arm does not hold for long enough
        (`unheld`), those that the planner does not solve (`unsolved`), those outside the limits of
        a datasheet (`outside`), and those whose start or goal is blocked by moving obstacles when
        it has to be free (`blocked`).
        """
        seed, split, number = job
        stream, robot = STREAMS[split], self.env.robot
        scene_number = number // self.queries_per_scene
        scene_seed = start_of_scene = None
        if isinstance(self.env.scene_distribution, WideScenes):
            scene_seed = wide_scene_seed(seed, split, scene_number)
            start_of_scene = self._draw_wide_scene(scene_seed)
        else:
            scene_rng = np.random.default_rng([seed, stream, scene_number, SCENES])
            self.env.sample_scene(scene_rng)
        rng = motions_rng = np.random.default_rng([seed, stream, number])
        moving = self.env.is_animated
        rejected = Counter()
        for attempt in range(MAX_QUERIES):
            if attempt == SHARED_ATTEMPTS:
                start_of_scene = None
            if moving:  # a scene for each query: its motions depend on start and goal
                scene_seed = int(rng.integers(2**32))
                seed_at_rest, seed_of_motions = scene_seeds(scene_seed)
                self.env.sample_scene(np.random.default_rng(seed_at_rest))
                motions_rng = np.random.default_rng(seed_of_motions)
            start, goal = self._sample_query(rng, start_of_scene)
            ends = np.array([start, goal])
            if self.limits != "urdf" and not robot.is_within(ends, self.limits).all():
                rejected["outside"] += 1
                continue
            if not self.env.sample_motions(start, goal, motions_rng):
                rejected["blocked"] += 1
                continue
            if moving:
                self.env.set_scene(self.env.scene_at_rest)
            if not self._are_held(start, goal):
                rejected["unheld"] += 1
            elif self.planner and not self._is_solved(self.planner, start, goal, rng):
                rejected["unsolved"] += 1
            else:
                query = {
                    "index": f"{split}/{number}",
                    "start": start.tolist(),
                    "goal": goal.tolist(),
                    "rejected": rejected,
                }
                if scene_seed is not None:
                    query["scene_seed"] = scene_seed
                else:
                    query["obstacles"] = to_lists(self.env.scene.obstacles)
                return query
        raise RuntimeError(f"{MAX_QUERIES} queries in a row were rejected: {dict(rejected)}")

    def _are_held(self, start, goal) -> bool:
        # Ends in wide scenes have a margin, and were held when they were sampled.
        is_wide = isinstance(self.env.scene_distribution, WideScenes)
        return is_wide or all(self.env.is_feasible(end, HOLD_STEPS) for end in (start, goal))

    def _is_solved(self, planner: Planner, start, goal, rng: np.random.Generator) -> bool:
        if self.follows_plans:
            return demonstrate(planner, start, goal, rng, SOLVE_ATTEMPTS) is not None
        try:
            planner.plan(start, goal, seed=int(rng.integers(1, 2**32)), time_limit=math.inf)
        except PlanningError:
            return False
        return True

    def _draw_wide_scene(self, scene_seed: int) -> np.ndarray | None:
        """Change to a scene, unless it is this one; returns the start its queries share, if so."""
        if scene_seed != self._wide_scene[0]:
            rng = np.random.default_rng(scene_seeds(scene_seed)[0])
            self.env.sample_scene(rng)
            is_shared = self.queries_per_scene > 1
            self._wide_scene = scene_seed, self.env.sample_end(rng) if is_shared else None
        return self._wide_scene[1]

    def _sample_query(
        self, rng: np.random.Generator, start: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `env.sample_query`, with the goal's end effector in the goal region, if there is one.

        Raises RuntimeError: no goal in it was found.
        """
        if self.goal_region is None:
            return self.env.sample_query(rng, start)
        robot = self.env.robot
        start = self.env.sample_feasible(rng) if start is None else start
        inside = 0
        low, high = np.reshape(self.goal_region, (3, 2)).T
        for _ in range(MAX_GOALS // GOALS):
            goals = rng.uniform(robot.lower, robot.upper, (GOALS, robot.num_joints))
            goals = goals.astype(np.float32)
            positions = robot.forward_kinematics(goals)
            for i in np.flatnonzero(((low <= positions) & (positions <= high)).all(axis=1)):
                distance = np.linalg.norm(positions[i] - robot.forward_kinematics(start))
                inside += 1
                if distance > self.env.ee_tolerance and self.env.is_feasible(goals[i]):
                    return start, goals[i]
        raise RuntimeError(
            f"--goal-region: of {MAX_GOALS:,} random configurations, {inside:,} "
            f"({inside / MAX_GOALS:.2%}) have their end effector in this box, and 0 of these are "
            f"feasible goals"
        )


def wide_scene_seed(seed: int, split: str, scene_number: int) -> int:
    """The seed of a wide scene: those of a split are consecutive, which needs hardly any space."""
    return ((2 * seed + list(STREAMS).index(split)) * MAX_SCENES + scene_number) % 2**32


def make_queries(
    path: str | Path,
    task: str,
    seed: int,
    num_test: int,
    num_validation: int,
    solvable: bool = False,
    queries_per_scene: int = 1,
    original: Path | None = None,
    num_workers: int = 1,
    progress: bool = True,
    goal_region: tuple[float, ...] | None = None,
    limits: Limits = "urdf",
    plannable: bool = False,
) -> Counter:
    """Sample the queries of a task and write its file.

    Args:
        task: name of the task, path of a scene file, or `TASK@ROBOT`.
        solvable: accept only queries that the planner solves.
        plannable: accept only queries for which the planner finds a path.
        queries_per_scene: queries in a row that have the same scene, where scenes vary.
        original: path of a file or folder of problems for the split `original`.
        goal_region: (xmin, xmax, ymin, ymax, zmin, zmax), m, of the goals' end-effector positions
            in the world's frame; None for anywhere.
        limits: of starts and goals.

    Returns:
        A Counter of the samples rejected: `unheld`, `unsolved`, `outside`.

    Raises:
        ValueError: unknown task; the journal belongs to other queries, or is in use.
        RuntimeError: no query can be found, also because the goal region has no room; or workers
            keep dying.
        DatasetError, OSError: as `datasets.queries.write_queries` does.
        Whatever is raised, what is in the journal is safe.
    """
    query_path(task)  # rejects an unknown task
    splits: dict[str, tuple] = {}
    if original is not None:
        splits[ORIGINAL] = _original_queries(original)
    path = Path(path)
    distribution, base = envs.get_task(task).scene, envs.get_task(task).base_scene
    options = {
        "task": str(task),
        "seed": seed,
        "solvable": solvable,
        "queries_per_scene": queries_per_scene,
        "goal_region": None if goal_region is None else list(goal_region),
    }
    if limits != "urdf":
        options["limits"] = limits
    if plannable:
        options["plannable"] = True
    with contextlib.closing(Journal(journal_of(path), options)) as journal:
        jobs = [(seed, "test", number) for number in range(num_test)]
        jobs += [(seed, "validation", number) for number in range(num_validation)]
        missing = [job for job in jobs if f"{job[1]}/{job[2]}" not in journal.entries]
        bar = progress_bar(
            description=str(task),
            total=len(jobs),
            initial=len(jobs) - len(missing),
            unit="query",
            disable=not progress,
        )
        arguments = (task, solvable, queries_per_scene, goal_region, limits, plannable)
        results = workers.run(Sampler, arguments, missing, num_workers, warn=write_line)
        with bar, contextlib.closing(results):
            for query in results:
                journal.append(query)
                bar.update()
        is_wide = isinstance(distribution, WideScenes)
        rejected = Counter()
        for split, num in (("test", num_test), ("validation", num_validation)):
            made = [journal.entries[f"{split}/{number}"] for number in range(num)]
            for query in made:
                rejected.update(query["rejected"])
            start = np.array([query["start"] for query in made], np.float32)
            goal = np.array([query["goal"] for query in made], np.float32)
            if isinstance(distribution, (MovingScenes, WideScenes)):
                seeds = np.array([query["scene_seed"] for query in made], np.uint32)
                splits[split] = (start, goal, SeededScenes(distribution, seeds, start, goal))
            elif isinstance(distribution, Scene):
                splits[split] = (start, goal)
            else:
                rows = [query["obstacles"] for query in made]
                scenes = [replace(base, obstacles=from_lists(row)) for row in rows]
                splits[split] = (start, goal, scenes)
        parameters = {
            "hold_steps": world.HOLD_STEPS if is_wide else HOLD_STEPS,
            "hold_drift": HOLD_DRIFT,
            "time_step": TIME_STEP,
            "substeps": SUBSTEPS,
            "rejected": rejected["unheld"],
        }
        made_by = f"roboarm queries --task {task} --seed {seed} "
        made_by += f"--num-test {num_test} --num-validation {num_validation}"
        if solvable:
            made_by += " --solvable"
            parameters["solve_attempts"] = SOLVE_ATTEMPTS
        if plannable:
            made_by += " --plannable"
        if solvable or plannable:
            parameters["unsolved"] = rejected["unsolved"]
            parameters["solve_checks"] = SOLVE_CHECKS
        if queries_per_scene > 1:
            made_by += f" --queries-per-scene {queries_per_scene}"
        if goal_region is not None:
            made_by += f" --goal-region {' '.join(map(str, goal_region))}"
            parameters["goal_region"] = list(goal_region)
        if limits != "urdf":
            made_by += f" --limits {limits}"
            parameters["limits"] = limits
            parameters["outside"] = rejected["outside"]
        if original is not None:
            made_by += f" --original {Path(original).name}"
        write_queries(path, task, seed, splits, made_by, parameters)
        journal_of(path).unlink()
    return rejected


def _original_queries(path: Path) -> tuple:
    """Starts, goals and scenes of the problems in a file. The gripper is as open as in any task."""
    problems = load_problems(path)
    if problems.rejected:
        raise ValueError(problems.rejected[0].reason)
    scenes = [replace(scene, robot=PANDA) for scene in problems.scenes]
    return problems.start, problems.goal, scenes


def _check(args: Args) -> list[tuple[str, Path]]:
    """The (task, path) pairs to make. Raises ValueError for arguments that cannot work."""
    flags.check(args)
    tasks = list(envs.TASKS) if args.task == ("all",) else list(dict.fromkeys(args.task))
    if not tasks:
        raise ValueError(f"--task: one or more of {', '.join(envs.TASKS)}, or all")
    if (args.output or args.original) is not None and len(tasks) > 1:
        raise ValueError("--output and --original are one file: they go with one task")
    if args.original is not None:
        _original_queries(args.original)
        if envs.get_task(tasks[0]).base_scene.robot != PANDA:
            raise ValueError("--original: MotionBenchMaker's problems are the Panda's")
    if args.goal_region:
        region = np.array(args.goal_region)
        if region.shape != (6,) or not (
            np.isfinite(region).all() and (region[::2] < region[1::2]).all()
        ):
            raise ValueError(
                f"--goal-region takes XMIN XMAX YMIN YMAX ZMIN ZMAX, each minimum below its "
                f"maximum, got {' '.join(map(str, args.goal_region))}"
            )
    pairs = [(task, args.output or query_path(task)) for task in tasks]
    for task, path in pairs:
        if isinstance(envs.get_task(task).scene, MovingScenes) and (
            args.solvable or args.plannable or args.queries_per_scene > 1
        ):
            raise ValueError(
                f"--solvable, --plannable and --queries-per-scene are not for {task}: its "
                "obstacles move, for each query in a way of their own"
            )
        envs.get_task(task).base_scene.robot.position_limits(args.limits)  # or it raises
        query_path(task)  # rejects an unknown task, also with --output
        check_writable(path)
        if path.exists() and not args.overwrite:
            raise ValueError(f"{path} exists; --overwrite replaces it")
    return pairs


def main(args: Args):
    """The command."""
    try:
        for task, path in _check(args):
            rejected = make_queries(
                path,
                task,
                args.seed,
                args.num_test,
                args.num_validation,
                args.solvable,
                args.queries_per_scene,
                args.original,
                args.workers,
                goal_region=args.goal_region or None,
                limits=args.limits,
                plannable=args.plannable,
            )
            text = f"{path}: written; {rejected['unheld']} samples rejected by the long hold check"
            if args.solvable or args.plannable:
                unsolved = rejected["unsolved"]
                share = unsolved / (args.num_test + args.num_validation + unsolved)
                text += f", {unsolved} not solved by the planner ({share:.3f})"
            print(text)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(error_line(error))


if __name__ == "__main__":
    end_with_one_line("the same command continues from here")
    main(flags.parse(Args, others="query"))
