"""Evaluation of a policy on the queries of a task.

    result = evaluate("go-to-goal", "wall", num_queries=100, workers=2)
    result["success_rate"], result["collision_free_success_rate"]

An episode is one query, in the query's scene, under the task's standard rules: goal tolerances,
horizon and longest step of `RoboArmEnv`'s defaults, contacts allowed. The same arguments give the
same numbers, times excepted, whatever the number of workers.
"""

import contextlib
import math
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from roboarm_nmp import envs
from roboarm_nmp.datasets.format import QueryScenes
from roboarm_nmp.datasets.problems import load_problems
from roboarm_nmp.datasets.queries import Query, load_queries, validate
from roboarm_nmp.envs.arm_env import deviations
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.envs.perception.encoders import ORACLE
from roboarm_nmp.envs.perception.geometry_source import GROUND_TRUTH
from roboarm_nmp.envs.perception.noise import SensorNoise
from roboarm_nmp.envs.perception.point_clouds import POINT_CLOUD
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.tasks import get_task, task_name
from roboarm_nmp.evaluation.rollout import REAL_TIME, render_strip, rollout
from roboarm_nmp.motions.metrics import motion_metrics, path_length, smoothness
from roboarm_nmp.policies.baselines import (
    CHECKING,
    OMPL_PLANNERS,
    PLANNERS,
    REPLANNING,
    SPACE_TIME,
    TIME_LIMIT,
    TRIES,
)
from roboarm_nmp.policies.pose_goals import goal_configuration
from roboarm_nmp.policies.registry import (
    filter_around,
    find_policy,
    make_policy,
    own_safety_filter,
    own_task,
)
from roboarm_nmp.policies.safety_filter import VERSION, SafetyFilter
from roboarm_nmp.utils import workers
from roboarm_nmp.utils.progress import progress_bar, write_line

LEAST_CLEARANCE = 0.001  # m, of a goal among several; the checks may differ from PyBullet's by less
CHUNK = 10  # queries a worker takes at a time


class EvaluationError(ValueError):
    """An evaluation that is not possible; the message says why."""


@dataclass(frozen=True)
class EvaluationOptions:
    """The options of `evaluate`.

    Attributes:
        goal_type: `ee`, `config`, `combined`, `pose`; None for the policy's own, otherwise `ee`.
            Goal poses are those of the queries' goals. A policy for configurations may have them,
            too (`policies.pose_goals`).
        queries: queries instead of the task's own: the path of a query file, or an object with
            `start` and `goal`, float32 (m, n), rad, and `scenes`, a sequence of m `Scene`s, like
            `datasets.queries.Queries`. Without `scenes` they are in the task's scene, which
            must then not be random.
        problems: path of a file or folder of problems instead of queries
            (`datasets.problems`), in their own scenes. Of several goals, the goal is the one
            nearest to the start that is free; of a pose, a free configuration that has it.
        split: `test`, `validation` or `original`; which queries of the file.
        num_queries: only the first so many of them; None for all.
        stop_on_collision: end an episode at the first contact.
        seed: of random numbers, >= 0; each query has its own generator.
        tries: random configurations that `via-points` tries per query, >= 1.
        time_limit: seconds that `planner` and `space-time` may search per query,
            > 0.
        geometry_source: where `planner`, `via-points`, the safety filter and the policy's
            observations take the obstacles from (`envs.perception.geometry_source`); None for the
            policy's own, otherwise `ground_truth`.
        safety_filter: an `policies.safety_filter.SafetyFilter` around the policy; None for the
            one that the policy includes, if any; False for none.
        replan: whenever the policy is stuck, follow a plan for a while
            (`policies.replanning.ReplanWhenStuck`), among the geometry source's obstacles.
        observe_every: steps from one observation of the scene to the next; None: static scenes are
            observed once (`envs.wrappers.ObservedSceneWrapper`).
        sensor_noise: an `envs.perception.noise.SensorNoise`; None for none.
        action_delay: steps after which an action takes effect; 0: the simulation waits for the
            policy (`evaluation.rollout.rollout`).
        real_time: instead of `action_delay`, as many steps as an action, or a plan, takes to
            compute, at least 1. Results then depend on the machine and its load.
        measure_clearance: also measure each episode's smallest distance from the ground-truth
            obstacles.
        workers: processes, >= 1. More than one needs the caller's script to be importable
            (`if __name__ == "__main__":`), as always with `multiprocessing`.
        env: dict with `action_mode`, `max_step`, `velocities` where a function needs other than the
            defaults. A policy network brings its own.

    Raises:
        EvaluationError: a number is out of its range.
    """

    goal_type: str | None = None
    queries: Any = None
    problems: str | Path | None = None
    split: str = "test"
    num_queries: int | None = None
    stop_on_collision: bool = False
    seed: int = 0
    tries: int = TRIES
    time_limit: float = TIME_LIMIT
    geometry_source: str | None = None
    safety_filter: SafetyFilter | bool | None = None
    replan: bool = False
    observe_every: int | None = None
    sensor_noise: SensorNoise | None = None
    action_delay: int = 0
    real_time: bool = False
    measure_clearance: bool = False
    workers: int = 1
    env: dict | None = None

    def __post_init__(self):
        for name in ("workers", "tries"):
            if getattr(self, name) < 1:
                raise EvaluationError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not isinstance(self.action_delay, int | np.integer) or self.action_delay < 0:
            steps = "steps: a whole number, not negative"
            raise EvaluationError(f"action_delay must be {steps}, got {self.action_delay!r}")
        if self.action_delay and self.real_time:
            raise EvaluationError("action_delay and real_time: give one of them")
        if not 0 < self.time_limit < math.inf:
            raise EvaluationError(
                f"time_limit must be a positive number of seconds, got {self.time_limit}"
            )


def evaluate(policy, task=None, *, progress=False, **options):
    """Run a policy on a task's queries.

    Args:
        policy: `go-to-goal`, `random`, `via-points`, `planner`, `replanning`, `space-time`, the
            path of a policy network or of a folder with a `policy.pt`, the name of a pretrained
            policy, or a function from an observation (dict of `RoboArmEnv`) to an action (n,); with
            several workers, one that can be pickled.
        task: name of the task, or path of a scene file, or `TASK@ROBOT` with a robot's file; None
            for the task that the policy was trained on, and for none with `problems`.
        progress: show a progress bar, with the success rate so far.
        options: the fields of `EvaluationOptions`.

    Returns:
        A dict that fits into JSON. Means over nothing (no successful episode, say) are None, and so
        is what a policy lacks.

        - `success_rate`, `collision_free_success_rate`, `collision_rate`, each with its 95% Wilson
          interval, `..._interval`;
        - `mean_steps`, `path_length` (rad), `smoothness` (rad per step^2): means over successes;
        - `ee_path_length` (m), `ee_rotation` (degrees), `duration` (s), `mean_jerk` and `max_jerk`
          (rad/s^3), `sparc`, `ee_sparc`, and with `measure_clearance` `min_clearance` (m): means
          over successes of `motions.metrics.motion_metrics`;
        - `ms_per_action`: of the policy alone, without the simulator and without planning;
        - `planning_seconds`, `planning_seconds_solved`: means over all queries, and over those with
          a motion found; `free_motion_rate`, only of `via-points`;
        - `policy`, `task`, `robot` (its name), `goal_type`, `split`, `queries` (the file, if it is
          not the task's own), `problems` (their file and its SHA-256), `num_queries`, `env`,
          `deviations` (from the standard rules), `safety_filter`, `seed`, `tries`, `time_limit`,
          `action_delay` (steps, or `real_time`), `versions`;
        - `geometry_source`: where obstacles were taken from, None if from nowhere; `privileged`:
          whether policy, filter or observations received the ground-truth obstacles;
        - `observe_every`, `sensor_noise` (a dict), where they were given.

    Raises:
        EvaluationError: the policy, the task or the queries cannot be used.
    """
    job = _prepare(policy, task, EvaluationOptions(**options))
    return _summary(job, _run(job, progress))


def first_episode_image(policy, task=None, frames=8, **options):
    """The first query's episode as an image strip, uint8 (height, frames * width, 3).

    Arguments and errors as for `evaluate`. Short episodes have fewer frames.
    """
    job = _prepare(policy, task, EvaluationOptions(**options))
    env, begin = job.make(render_mode="rgb_array")
    query = job.query(0)
    actions = rollout(env, query, begin(0, query).act, job.delay).actions
    steps = np.linspace(0, len(actions), frames).round().astype(int)
    image = render_strip(env, query, actions, sorted(set(steps.tolist())))
    env.close()
    return image


def is_privileged(env_arguments):
    """Whether observations contain ground-truth obstacles.

    Args:
        env_arguments: dict of arguments of `envs.make`.
    """
    distances = env_arguments.get("link_distances") and env_arguments.get("geometry_source")
    return env_arguments.get("encoder") == ORACLE or distances == GROUND_TRUTH


# --- Metrics


def wilson_interval(successes, n):
    """The 95% Wilson score interval (low, high) of a share, for `successes` out of `n` >= 1."""
    z = 1.959964
    share = successes / n
    centre = share + z * z / (2 * n)
    spread = z * (share * (1 - share) / n + z * z / (4 * n * n)) ** 0.5
    scale = 1 + z * z / n
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


# --- Arguments


@dataclass(frozen=True)
class _Job:
    """An evaluation whose arguments were checked, for the workers.

    `options` are those in use: `env` has all arguments of `envs.make`, `geometry_source` is None
    where nothing takes obstacles from one, `queries` is the name of a file or None. Instead of it
    there are `start`, `goal` and `scenes`. `problems` is as in the result.
    """

    policy: str | Path | Callable
    task: str
    options: EvaluationOptions
    start: np.ndarray
    goal: np.ndarray
    scenes: Sequence[Scene]
    problems: dict | None = None

    def make(self, **kwargs):
        """The environment, and the policy in it as `make_policy` returns it."""
        o = self.options
        kwargs |= {"observe_every": o.observe_every, "sensor_noise": o.sensor_noise}
        env = envs.make(self.task, **o.env, **kwargs)
        source, safety_filter = o.geometry_source or GROUND_TRUTH, o.safety_filter or False
        options = o.seed, o.tries, o.time_limit, source, safety_filter
        return env, make_policy(self.policy, env, *options, replan=o.replan)

    @property
    def delay(self):
        """As of `rollout`."""
        return REAL_TIME if self.options.real_time else self.options.action_delay

    def query(self, index):
        return Query(self.start[index], self.goal[index], self.scenes[index])


def _prepare(policy, task, options):
    """The `_Job` of an evaluation, once all of its arguments have been checked."""
    try:
        if task is not None:
            get_task(task)  # or it raises
        if not callable(policy):
            policy, trained = find_policy(policy)
            task = own_task(policy) if task is None else task
            own = trained.get("goal_type")
            by_kinematics = (
                options.goal_type == "pose" and trained and GOAL_TYPES[own].has_configuration
            )
            if trained and options.goal_type not in (None, own) and not by_kinematics:
                raise EvaluationError(
                    f"{policy} was trained with the goal type {trained['goal_type']!r}, it cannot "
                    f"be evaluated with {options.goal_type!r}"
                )
            options = replace(options, env=trained or options.env)
        problems = None
        if options.problems is not None:
            task = "no_obstacles" if task is None else task
            options, problems = _with_problems(task, options)
        if task is None:
            name = getattr(policy, "__name__", policy)
            raise EvaluationError(f"{name} has no task of its own: choose one (--task)")
        queries, scenes = _queries(task, options)
        file = str(options.queries) if isinstance(options.queries, (str, Path)) else None
        options = replace(
            _in_use(policy, options), queries=file, split=getattr(queries, "split", None)
        )
        start, goal = queries.start[: options.num_queries], queries.goal[: options.num_queries]
        job = _Job(policy, str(task), options, start, goal, scenes, problems)
        job.make()[0].close()  # or it raises
    except (TypeError, ValueError) as error:
        raise EvaluationError(str(error)) from error
    return job


def _with_problems(task, options):
    """The options with the problems as queries, and what the result says of their file."""
    if options.queries is not None:
        raise EvaluationError("queries and problems: give one of them")
    if options.split != "test":
        raise EvaluationError(f"split {options.split!r}: problems have no splits")
    problems = load_problems(options.problems, get_task(task).base_scene.robot)
    if problems.rejected:
        raise EvaluationError(
            f"{len(problems.rejected)} problems cannot be used: {problems.rejected[0].reason}; "
            f"`roboarm import` writes a file of the others"
        )
    problems = replace(problems, all=tuple(_with_one_goal(one) for one in problems.all))
    said = {"file": Path(options.problems).name, "sha256": problems.digest}
    return replace(options, queries=problems), said


def _with_one_goal(problem):
    """A problem with a single goal configuration; one of several, or of its goal pose.

    Ground-truth obstacles decide which are free, as they decide where episodes may begin.
    """
    if len(problem.goals) == 1:
        return problem
    # Here, because Numba takes a while to import.
    from roboarm_nmp.envs.perception.geometry_source import ground_truth_checker

    robot, checker = problem.scene.robot, ground_truth_checker(problem.scene)
    if len(problem.goals) == 0:
        goal = goal_configuration(robot, problem.goal_pose, problem.start, checker)
        if goal is None:
            raise EvaluationError(f"problem {problem.name}: its goal pose cannot be reached freely")
        return problem._replace(goals=goal[None].astype(np.float64))
    states = robot.normalise(problem.goals)
    free = np.flatnonzero(checker.is_free(np.clip(states, -1.0, 1.0), margin=LEAST_CLEARANCE))
    if not len(free):
        raise EvaluationError(f"problem {problem.name}: all of its goals are in collision")
    distances = np.linalg.norm(states[free] - robot.normalise(problem.start), axis=1)
    return problem._replace(goals=problem.goals[free[distances.argmin()]][None])


def _in_use(policy, options):
    """The options with environment, safety filter and geometry source as they will be used."""
    env, safety_filter = dict(options.env or {}), options.safety_filter
    env["goal_type"] = options.goal_type or env.get("goal_type", "ee")
    env["stop_on_collision"] = options.stop_on_collision
    if options.replan and policy == REPLANNING:
        raise EvaluationError("replan: replanning plans again by itself")
    if safety_filter is None:
        safety_filter = own_safety_filter(policy)
    safety_filter = filter_around(policy, safety_filter, options.replan)
    if safety_filter:
        env["link_distances"] = True
    source = options.geometry_source or env.get("geometry_source")
    if env.get("link_distances"):
        source = env["geometry_source"] = source or GROUND_TRUTH
    elif env.get("encoder") == POINT_CLOUD and source != GROUND_TRUTH:
        source = env["geometry_source"] = source or POINT_CLOUD
    elif policy in CHECKING or options.replan:
        source = source or GROUND_TRUTH
    elif options.geometry_source is not None:
        raise EvaluationError(
            "geometry_source is for via-points, planner, a safety filter, replanning, and policies "
            "that observe points or link distances"
        )
    noise = options.sensor_noise
    if (source is None and env.get("encoder") is None) or policy == SPACE_TIME:
        for name in ("observe_every", "sensor_noise"):
            if getattr(options, name) is not None:
                raise EvaluationError(f"{name}: this policy observes nothing of the scene")
    unseen = (None, GROUND_TRUTH), (None, ORACLE)
    if noise and noise.changes_images and source in unseen[0] and env.get("encoder") in unseen[1]:
        raise EvaluationError(
            "sensor_noise: nothing is observed by sensors; choose the geometry source point_cloud, "
            "or a policy that receives an encoded scene"
        )
    return replace(options, env=env, geometry_source=source, safety_filter=safety_filter)


def _queries(task, options):
    """The object with the queries' starts and goals, and their scenes."""
    queries = options.queries
    if queries is None:
        queries = load_queries(task, options.split)
    elif isinstance(queries, (str, Path)):
        validate(queries, task)  # they are for this task, with the scene it has now
        queries = load_queries(queries, options.split, task)
    name = task_name(task)
    if getattr(queries, "task", name) != name:
        raise EvaluationError(f"these queries are for the task {queries.task!r}, not {name!r}")
    available = len(queries.start)
    if options.num_queries is not None and not 1 <= options.num_queries <= available:
        raise EvaluationError(f"num_queries must be 1 to {available}, got {options.num_queries}")
    scenes, scene = getattr(queries, "scenes", None), get_task(task).scene
    if scenes is None:
        if not isinstance(scene, Scene):
            raise EvaluationError(f"{name} has random scenes: these queries need `scenes` as well")
        scenes = QueryScenes(scene)
    return queries, scenes


# --- Episodes


MOTION_METRICS = (
    *("ee_path_length", "ee_rotation", "duration", "mean_jerk", "max_jerk", "sparc", "ee_sparc"),
    "min_clearance",
)


class _Outcome(NamedTuple):
    """The result of one episode; lengths are NaN where the goal was not reached.

    `plan_found`: see `EpisodePolicy`. `motion`: the `MOTION_METRICS`, likewise. `actions`: how many
    the policy chose, fewer than there are steps where these are delayed.
    """

    success: bool
    collision: bool
    steps: int
    path_length: float
    smoothness: float
    motion: tuple[float, ...]
    actions: int
    policy_seconds: float
    planning_seconds: float
    plan_found: bool | None


class _Worker:
    """Runs the queries of a job, chunk by chunk."""

    def __init__(self, job):
        torch.set_num_threads(1)
        self.job = job
        self.env, self.begin = job.make()

    def __call__(self, indices):
        """`indices`, a range, and their outcomes."""
        outcomes = []
        for index in indices:
            try:
                outcomes.append(self._outcome(index, self.job.query(index)))
            except ValueError as error:  # the environment refuses the query or an action
                raise EvaluationError(f"query {index}: {error}") from error
        return indices, outcomes

    def _outcome(self, index, query):
        self.env.reset_specific(*query)  # it refuses an invalid query before planning
        began = time.perf_counter()
        act, plan_found = self.begin(index, query)
        planning_seconds = time.perf_counter() - began
        actions = 0

        def counted(observation):
            nonlocal actions
            actions += 1
            return act(observation)

        policy = counted if act else None
        trajectory = rollout(self.env, query, policy, self.job.delay, planning_seconds)
        lengths = [np.nan, np.nan, (np.nan,) * len(MOTION_METRICS)]
        if trajectory.success:
            configurations = trajectory.configurations
            motion = motion_metrics(trajectory, self._checker(query.scene, len(trajectory)))
            lengths = [path_length(configurations), smoothness(configurations)]
            lengths.append(tuple(motion[name] for name in MOTION_METRICS))
        return _Outcome(
            trajectory.success,
            trajectory.collides,
            len(trajectory),
            *lengths,
            actions,
            float(trajectory.times.sum()),
            planning_seconds,
            plan_found,
        )

    def _checker(self, scene, steps):
        """For the clearance in an episode; None where it is not measured."""
        if not self.job.options.measure_clearance:
            return None
        # Here, because Numba takes a while to import.
        from roboarm_nmp.envs.collision.checker import CollisionChecker

        if scene.is_static:
            return CollisionChecker(scene)
        return [CollisionChecker(scene.at(step * STEP_SECONDS)) for step in range(steps + 1)]


def _run(job, progress):
    """The outcomes of all queries, in their order."""
    count = len(job.start)
    chunks = [range(first, min(first + CHUNK, count)) for first in range(0, count, CHUNK)]
    outcomes, successes = [None] * count, 0
    bar = progress_bar(total=count, unit="query", disable=not progress)
    threads = torch.get_num_threads()
    try:
        with bar, contextlib.closing(_results(job, chunks)) as results:
            for indices, chunk in results:
                outcomes[indices.start : indices.stop] = chunk
                successes += sum(outcome.success for outcome in chunk)
                bar.update(len(chunk))
                if bar.n:  # 0 if no bar is shown
                    bar.set_postfix(success=f"{successes / bar.n:.3f}")
    finally:
        torch.set_num_threads(threads)
    return outcomes


def _results(job, chunks):
    """Yield the chunks and their outcomes, in any order."""
    count = min(job.options.workers, len(chunks))
    if count == 1:
        yield from map(_Worker(job), chunks)
    else:
        yield from workers.run(_Worker, (job,), chunks, count, write_line)


# --- The result


def _summary(job, outcomes):
    options, count = job.options, len(outcomes)
    columns = _Outcome(*(np.array(column) for column in zip(*outcomes, strict=True)))
    reached = columns.success
    actions = int(columns.actions.sum())

    def share(name, hits):
        low, high = wilson_interval(int(hits.sum()), count)
        return {name: float(hits.mean()), f"{name}_interval": [low, high]}

    def mean(values, which=reached):
        return float(values[which].mean()) if which.any() else None

    motion = np.array(columns.motion, dtype=np.float64).T
    motion = dict(zip(MOTION_METRICS, map(mean, motion), strict=True))
    if not options.measure_clearance:
        motion["min_clearance"] = None
    plans, safety_filter = job.policy in PLANNERS, options.safety_filter
    planning = {"planning_seconds": None, "planning_seconds_solved": None, "free_motion_rate": None}
    if plans:
        found = columns.plan_found.astype(bool)
        planning["planning_seconds"] = float(columns.planning_seconds.mean())
        planning["planning_seconds_solved"] = mean(columns.planning_seconds, found)
        if job.policy == "via-points":
            planning["free_motion_rate"] = float(found.mean())
    checks = job.policy in CHECKING or options.replan
    random = checks or job.policy == "random" or safety_filter
    packages = ["pybullet", "torch", "numpy"] + ["ompl"] * (job.policy in OMPL_PLANNERS)
    return {
        "policy": getattr(job.policy, "__name__", str(job.policy)),
        "task": None if job.problems else job.task,
        "robot": get_task(job.task).base_scene.robot.name,
        "goal_type": options.env["goal_type"],
        "split": options.split,
        "queries": options.queries,
        **({"problems": job.problems} if job.problems else {}),
        "num_queries": count,
        **share("success_rate", reached),
        **share("collision_free_success_rate", reached & ~columns.collision),
        **share("collision_rate", columns.collision),
        "mean_steps": mean(columns.steps),
        "path_length": mean(columns.path_length),
        "smoothness": mean(columns.smoothness),
        **motion,
        "ms_per_action": 1e3 * float(columns.policy_seconds.sum()) / actions if actions else None,
        **planning,
        "env": options.env,
        "deviations": deviations(options.env),
        "geometry_source": options.geometry_source,
        **({"observe_every": options.observe_every} if options.observe_every else {}),
        **({"sensor_noise": options.sensor_noise.to_metadata()} if options.sensor_noise else {}),
        "privileged": is_privileged(options.env)
        or (checks and options.geometry_source == GROUND_TRUTH),
        **({"replan": True} if options.replan else {}),
        "safety_filter": safety_filter.to_metadata() | {"version": VERSION}
        if safety_filter
        else None,
        "seed": options.seed if random else None,
        "tries": options.tries if job.policy == "via-points" else None,
        "time_limit": options.time_limit if job.policy in OMPL_PLANNERS else None,
        "action_delay": job.delay,
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in packages},
        },
    }
