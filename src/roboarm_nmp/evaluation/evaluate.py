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
import sys
import time
import zlib
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from roboarm_nmp import envs
from roboarm_nmp.datasets.format import QueryScenes, SeededScenes
from roboarm_nmp.datasets.problem_formats import Problem
from roboarm_nmp.datasets.problems import Problems, load_problems
from roboarm_nmp.datasets.queries import Query, load_queries, validate
from roboarm_nmp.envs.arm_env import Observation, RoboArmEnv, deviations
from roboarm_nmp.envs.goals import GOAL_TYPES, GoalTypeName
from roboarm_nmp.envs.perception.encoders import ORACLE
from roboarm_nmp.envs.perception.geometry_source import GROUND_TRUTH, Unknown
from roboarm_nmp.envs.perception.noise import SensorNoise
from roboarm_nmp.envs.perception.point_clouds import POINT_CLOUD
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.tasks import get_task, task_name
from roboarm_nmp.evaluation.rollout import REAL_TIME, render_steps, rollout
from roboarm_nmp.motions.metrics import motion_metrics, path_length, smoothness
from roboarm_nmp.motions.trajectories import Trajectory
from roboarm_nmp.policies.baselines import (
    BASELINES,
    CHECKING,
    OMPL_PLANNERS,
    PLANNERS,
    REPLANNING,
    SPACE_TIME,
    TIME_LIMIT,
    TRIES,
)
from roboarm_nmp.policies.policy import BeginEpisode, Method, Policy
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
            With `pose`, the goal is the pose of the query's goal; a policy for configurations can
            have it, too (`policies.pose_goals`).
        queries: queries instead of the task's own: the path of a query file, or an object with
            `start` and `goal`, float32 (m, n), rad, and `scenes`, a sequence of m `Scene`s, like
            `datasets.queries.Queries`. Without `scenes` they are in the task's scene, which
            must then not be random.
        problems: path of a file or folder of problems instead of queries
            (`datasets.problems`), in their own scenes. If a problem
            has several goals, the free one nearest to the start is used; for a pose, a free
            configuration that has it.
        split: `test`, `validation` or `original`; which queries of the file.
        num_queries: how many of them, from the first on; None for all.
        stop_on_collision: end an episode at the first contact.
        seed: of random numbers, >= 0; each query has its own generator.
        tries: random configurations that `via-points` tries per query, >= 1.
        time_limit: seconds that `planner` and `space-time` may search per query,
            > 0.
        geometry_source: where `planner`, `via-points`, the safety filter and the policy's
            observations take the obstacles from (`envs.perception.geometry_source`); None for the
            policy's own, otherwise `ground_truth`, and with `verify_else` `point_cloud`.
        safety_filter: a `policies.safety_filter.SafetyFilter` around the policy; None for the one
            that the policy includes, if any; False for none.
        replan: whenever the policy is stuck, follow a plan for a while, among the obstacles of the
            geometry source (`policies.replanning.ReplanWhenStuck`).
        search: let a policy that draws paths search for one if it can verify none
            (`policies.generative`).
        unknown: whether space that no sensor sees counts as `free` or `occupied`. With None, a
            policy that draws paths takes it as occupied, and as free only if it finds no path
            otherwise; `planner` with the geometry source `point_cloud` takes it as free.
        verify_else: predict the policy's motion in static scenes, and verify it before the arm
            moves. Where that fails, this policy acts: a name or path, of the policy itself, too. It
            is what `search` and `unknown` then belong to (`policies.predicted`).
        observe_every: steps from one observation of the scene to the next. With None, static scenes
            are observed once (`envs.wrappers.ObservedSceneWrapper`).
        sensor_noise: a `envs.perception.noise.SensorNoise`; None for perfect sensors.
        action_delay: steps after which an action takes effect. With 0 the simulation waits for the
            policy (`evaluation.rollout.rollout`).
        real_time: instead of `action_delay`, as many steps as an action, or a plan, takes to
            compute, at least 1. Results then depend on the machine and its load.
        measure_clearance: also measure each episode's smallest distance from the ground-truth
            obstacles.
        workers: processes, >= 1. With more than one, guard your script with
            `if __name__ == "__main__":`, as always with `multiprocessing`.
        env: dict of arguments of `envs.make`, such as `action_mode`, that differ from the defaults.
            A policy network's own arguments take precedence.

    Raises:
        EvaluationError: a number is out of its range.
    """

    goal_type: GoalTypeName | None = None
    queries: Any = None
    problems: str | Path | None = None
    split: str = "test"
    num_queries: int | None = None
    stop_on_collision: bool = False
    seed: int = 0
    tries: int = TRIES
    time_limit: float = TIME_LIMIT
    geometry_source: str | None = None
    safety_filter: SafetyFilter | Literal[False] | None = None
    replan: bool = False
    search: bool = False
    unknown: Unknown | None = None
    verify_else: str | Path | None = None
    observe_every: int | None = None
    sensor_noise: SensorNoise | None = None
    action_delay: int = 0
    real_time: bool = False
    measure_clearance: bool = False
    workers: int = 1
    env: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        for name in ("workers", "tries"):
            if getattr(self, name) < 1:
                raise EvaluationError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not isinstance(self.action_delay, int | np.integer) or self.action_delay < 0:
            raise EvaluationError(
                "action_delay must be steps: a whole number, not negative, got "
                f"{self.action_delay!r}"
            )
        if self.action_delay and self.real_time:
            raise EvaluationError("action_delay and real_time: give one of them")
        if not 0 < self.time_limit < math.inf:
            raise EvaluationError(
                f"time_limit must be a positive number of seconds, got {self.time_limit}"
            )


def evaluate(
    policy: str | Path | Policy | Method,
    task: str | Path | None = None,
    *,
    progress: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Run a policy on a task's queries.

    Args:
        policy: `go-to-goal`, `random`, `via-points`, `planner`, `replanning`, `space-time`, the
            path of a policy network or of a folder with a `policy.onnx`, the name of a pretrained
            policy, a function from an observation (dict of `RoboArmEnv`) to an action (n,), or a
            `policies.policy.Method`; with several workers, one that can be pickled.
        task: name of the task, path of a scene file, or `TASK@ROBOT` with a robot's file. None
            stands for the task that the policy was trained on; with `problems` there is no task.
        progress: show a progress bar, with the success rate so far.
        options: the fields of `EvaluationOptions`.

    Returns:
        A dict that JSON can write. Means over nothing (no successful episode, say) are None, and so
        are values that the policy doesn't have.

        - `success_rate`, `collision_free_success_rate`, `collision_rate`, each with its 95% Wilson
          interval, `..._interval`; `contact_share`: the share of all steps with a contact;
        - `mean_steps`, `path_length` (rad), `smoothness` (rad per step^2): means over successes;
        - `ee_path_length` (m), `ee_rotation` (degrees), `duration` (s), `mean_jerk` and `max_jerk`
          (rad/s^3), `sparc`, `ee_sparc`, and with `measure_clearance` `min_clearance` (m): means
          over successes of `motions.metrics.motion_metrics`;
        - `ms_per_action`: of the policy alone, without the simulator and without planning;
        - `planning_seconds`, `planning_seconds_solved`: means over all queries, and over those for
          which a motion was found; `free_motion_rate`, only of `via-points`;
        - `policy`, `task`, `robot` (its name), `goal_type`, `split`, `queries` (the file, if it is
          not the task's own), `problems` (their file and its SHA-256), `num_queries`, `env`,
          `deviations` (from the standard rules), `safety_filter`, `seed`, `tries`, `time_limit`,
          `action_delay` (steps, or `real_time`), `versions`;
        - `geometry_source`: where obstacles were taken from, None without one; `privileged`:
          whether policy, filter or observations received the ground-truth obstacles;
        - where sensors observe a static scene once, `unobserved_share`: the mean share of the
          arm's motion that passes through space that no sensor sees;
        - of a policy that draws paths, or with `verify_else`, `verified_rate`: the share of queries
          with a verified path; with `search` or `verify_else` `search_rate`, the share of queries
          for which one was searched for;
        - `replan`, `search`, `verify_else`, `observe_every`, `sensor_noise` (a dict), where given.

    Raises:
        EvaluationError: the policy, the task or the queries cannot be used.
    """
    job = _prepare(policy, task, EvaluationOptions(**options))
    return _summary(job, _run(job, progress))


class RecordedEpisode(NamedTuple):
    """An episode as `record` returns it.

    actions: float32 (T, n), exactly as they were executed, rounded to 16 significant bits.
    success, collision: whether the goal was reached, and whether there was any contact.
    digest: CRC-32 of the states and contacts, the same for exactly the same motions.
    seconds: s, of the policy's own computation, planning included.
    """

    actions: np.ndarray
    success: bool
    collision: bool
    digest: int
    seconds: float


def record(
    policy: str | Path | Policy | Method,
    task: str | Path,
    *,
    progress: bool = False,
    **options: Any,
) -> tuple[dict[str, Any], list[RecordedEpisode]]:
    """`evaluate`, and the actions of each episode, which were rounded before their execution.

    Arguments and errors as for `evaluate`.
    """
    job = replace(_prepare(policy, task, EvaluationOptions(**options)), record=True)
    outcomes = _run(job, progress)
    return _summary(job, outcomes), [outcome.pop("episode") for outcome in outcomes]


def first_episode_images(
    policy: str | Path | Policy | Method,
    task: str | Path | None = None,
    number: int = 8,
    **options: Any,
) -> list[np.ndarray]:
    """`number` images of the first query's episode, uint8 (height, width, 3).

    Arguments and errors as for `evaluate`. Short episodes have fewer images.
    """
    job = _prepare(policy, task, EvaluationOptions(**options))
    env, begin = job.make(render_mode="rgb_array")
    query = job.query(0)
    actions = rollout(env, query, begin(0, query).act, job.delay).actions
    steps = np.unique(np.linspace(0, len(actions), number).round().astype(int)).tolist()
    images = render_steps(env, query, actions, steps)
    env.close()
    return images


def is_privileged(env_arguments: dict[str, Any]) -> bool:
    """Whether observations contain ground-truth obstacles.

    Args:
        env_arguments: dict of arguments of `envs.make`.
    """
    if env_arguments.get("encoder") == ORACLE:
        return True
    has_distances = bool(env_arguments.get("link_distances"))
    return has_distances and env_arguments.get("geometry_source") == GROUND_TRUTH


# --- Metrics


def wilson_interval(successes: float, n: int) -> tuple[float, float]:
    """The 95% Wilson score interval (low, high) of a share, for `successes` out of `n` >= 1."""
    z = 1.959964
    share = successes / n
    centre = share + z * z / (2 * n)
    spread = z * (share * (1 - share) / n + z * z / (4 * n * n)) ** 0.5
    scale = 1 + z * z / n
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


# --- Arguments


Scenes = Sequence[Scene] | QueryScenes | SeededScenes


@dataclass(frozen=True)
class _Job:
    """An evaluation whose arguments were checked, for the workers.

    `options` are those in use: `env` has all arguments of `envs.make`, `geometry_source` is None
    where nothing takes obstacles from one, `queries` is the name of a file or None. Instead of it
    there are `start`, `goal` and `scenes`. `problems` is as in the result.
    """

    policy: str | Path | Policy | Method
    task: str
    options: EvaluationOptions
    start: np.ndarray
    goal: np.ndarray
    scenes: Scenes
    problems: dict[str, str] | None = None
    record: bool = False

    def make(self, render_mode: str | None = None) -> tuple[RoboArmEnv, BeginEpisode]:
        """The environment, and the policy in it as `make_policy` returns it."""
        options = self.options
        env = envs.make(
            self.task,
            **options.env,
            observe_every=options.observe_every,
            sensor_noise=options.sensor_noise,
            render_mode=render_mode,
        )
        begin = make_policy(
            self.policy,
            env,
            seed=options.seed,
            tries=options.tries,
            time_limit=options.time_limit,
            geometry_source=options.geometry_source or GROUND_TRUTH,
            safety_filter=options.safety_filter or False,
            replan=options.replan,
            search=options.search,
            unknown=options.unknown,
            verify_else=options.verify_else,
        )
        return env, begin

    @property
    def delay(self) -> int | str:
        """As of `rollout`."""
        return REAL_TIME if self.options.real_time else self.options.action_delay

    def query(self, index: int) -> Query:
        return Query(self.start[index], self.goal[index], self.scenes[index])


def _prepare(policy, task, options: EvaluationOptions) -> _Job:
    """The `_Job` of an evaluation, once all of its arguments have been checked."""
    try:
        job = _make_job(policy, task, options)
        job.make()[0].close()  # to see whether that raises
    except (TypeError, ValueError) as error:
        raise EvaluationError(str(error)) from error
    return job


def _make_job(
    policy: str | Path | Policy | Method, task: str | Path | None, options: EvaluationOptions
) -> _Job:
    if task is not None:
        get_task(task)  # to see whether that raises
    if isinstance(policy, (str, Path)):
        policy, trained = find_policy(policy)
        if task is None:
            task = own_task(policy)
        trained_with = trained.get("goal_type")
        if trained_with is not None and options.goal_type not in (None, trained_with):
            by_kinematics = (
                options.goal_type == "pose" and GOAL_TYPES[trained_with].has_configuration
            )
            if not by_kinematics:
                raise EvaluationError(
                    f"{policy} was trained with the goal type {trained_with!r}, and cannot be "
                    f"evaluated with {options.goal_type!r}: leave out --goal-type"
                )
        options = replace(options, env=options.env | trained)
    problems = None
    if options.problems is not None:
        if task is None:
            task = "no_obstacles"
        options, problems = _with_problems(task, options)
    if task is None:
        name = getattr(policy, "__name__", policy)
        raise EvaluationError(f"{name} has no task of its own: choose one (--task)")
    queries, scenes = _queries(task, options)
    options = replace(
        _in_use(policy, options),
        queries=str(options.queries) if isinstance(options.queries, (str, Path)) else None,
        split=getattr(queries, "split", None),
    )
    start = queries.start[: options.num_queries]
    goal = queries.goal[: options.num_queries]
    return _Job(policy, str(task), options, start, goal, scenes, problems)


def _with_problems(task, options):
    """The options with the problems as queries, and what the result says of their file."""
    if options.queries is not None:
        raise EvaluationError("queries and problems: give one of them")
    if options.split != "test":
        raise EvaluationError(f"split {options.split!r}: problems have no splits")
    problems = problem_queries(options.problems, get_task(task).base_scene.robot)
    options = replace(options, queries=problems)
    return options, {"file": Path(options.problems).name, "sha256": problems.digest}


def problem_queries(path: str | Path, robot: Robot = PANDA) -> Problems:
    """Problems with one goal configuration each, as `evaluate` takes them.

    Raises EvaluationError: some cannot be used.
    """
    problems = load_problems(path, robot)
    if problems.rejected:
        raise EvaluationError(
            f"{len(problems.rejected)} problems cannot be used: {problems.rejected[0].reason}; "
            f"`roboarm import` writes a file of the others"
        )
    return replace(problems, all=tuple(_with_one_goal(problem) for problem in problems.all))


def _with_one_goal(problem: Problem) -> Problem:
    """A problem with a single goal configuration; one of several, or of its goal pose.

    Ground-truth obstacles decide which are free, as they decide where episodes may begin.
    """
    if len(problem.goals) == 1:
        return problem
    # Here, because Numba takes a while to import.
    from roboarm_nmp.envs.perception.geometry_source import ground_truth_checker

    robot = problem.scene.robot
    checker = ground_truth_checker(problem.scene)
    if problem.goal_pose is not None and not len(problem.goals):
        goal = goal_configuration(robot, problem.goal_pose, problem.start, checker)
        if goal is None:
            raise EvaluationError(
                f"problem {problem.name}: no collision-free configuration has its goal pose; "
                f"leave it out, or give another goal"
            )
        return problem._replace(goals=goal[None].astype(np.float64))
    states = robot.normalise(problem.goals)
    free = np.flatnonzero(checker.is_free(np.clip(states, -1.0, 1.0), margin=LEAST_CLEARANCE))
    if not len(free):
        raise EvaluationError(
            f"problem {problem.name}: all of its goals are in collision; leave it out, or give "
            f"another goal"
        )
    distances = np.linalg.norm(states[free] - robot.normalise(problem.start), axis=1)
    return problem._replace(goals=problem.goals[free[distances.argmin()]][None])


def _in_use(policy, options):
    """The options with environment, safety filter and geometry source as they will be used."""
    env = dict(options.env)
    env["goal_type"] = options.goal_type or env.get("goal_type", "ee")
    env["stop_on_collision"] = options.stop_on_collision
    if options.replan and policy == REPLANNING:
        raise EvaluationError("replan: replanning plans again by itself")
    safety_filter = options.safety_filter
    if safety_filter is None:
        safety_filter = own_safety_filter(policy)
    safety_filter = filter_around(policy, safety_filter, options.replan)
    if safety_filter:
        env["link_distances"] = True
    encoder = env.get("encoder")
    source = options.geometry_source or env.get("geometry_source")
    if env.get("link_distances"):
        source = env["geometry_source"] = source or GROUND_TRUTH
    elif encoder == POINT_CLOUD and source != GROUND_TRUTH:
        source = env["geometry_source"] = source or POINT_CLOUD
    elif policy in CHECKING or options.replan:
        source = source or GROUND_TRUTH
    elif options.verify_else is not None:
        source = source or POINT_CLOUD
    elif options.geometry_source is not None:
        raise EvaluationError(
            "geometry_source is for via-points, planner, a safety filter, replanning, and policies "
            "that observe points or link distances"
        )
    if policy == SPACE_TIME or (source is None and encoder is None):
        for name in ("observe_every", "sensor_noise"):
            if getattr(options, name) is not None:
                raise EvaluationError(
                    f"{name}: this policy observes nothing of the scene; leave it out"
                )
    noise = options.sensor_noise
    if noise is not None and noise.changes_images and not _uses_sensors(source, encoder):
        raise EvaluationError(
            "sensor_noise: nothing is observed by sensors; choose the geometry source point_cloud, "
            "or a policy that receives an encoded scene"
        )
    return replace(options, env=env, geometry_source=source, safety_filter=safety_filter)


def _uses_sensors(geometry_source, encoder):
    return geometry_source not in (None, GROUND_TRUTH) or encoder not in (None, ORACLE)


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
        raise EvaluationError(
            f"these queries are for the task {queries.task!r}, not {name!r}: evaluate on that task"
        )
    available = len(queries.start)
    if options.num_queries is not None and not 1 <= options.num_queries <= available:
        raise EvaluationError(f"num_queries must be 1 to {available}, got {options.num_queries}")
    scenes = getattr(queries, "scenes", None)
    if scenes is None:
        scene = get_task(task).scene
        if not isinstance(scene, Scene):
            raise EvaluationError(f"{name} has random scenes: these queries need `scenes` as well")
        scenes = QueryScenes(scene)
    return queries, scenes


# --- Episodes


MOTION_METRICS = (
    *("ee_path_length", "ee_rotation", "duration", "mean_jerk", "max_jerk", "sparc", "ee_sparc"),
    "min_clearance",
)
LENGTHS = ("mean_steps", "path_length", "smoothness", *MOTION_METRICS)
Outcome = dict[str, Any]
"""Of an episode: its success, contact and times, and if it was successful its `LENGTHS`."""


class _Counted:
    """A policy, and how many actions it has chosen: not as many as steps where there is a delay."""

    def __init__(self, act: Policy, rounds: bool):
        self.act = act
        self.rounds = rounds
        self.actions = 0

    def __call__(self, observation: Observation) -> np.ndarray:
        self.actions += 1
        action = self.act(observation)
        return rounded(action) if self.rounds else action


class _Worker:
    """Runs the queries of a job, chunk by chunk."""

    def __init__(self, job: _Job):
        if torch := sys.modules.get("torch"):  # of a policy that is a function
            torch.set_num_threads(1)
        self.job = job
        self.env, self.begin = job.make()
        options = job.options
        uses_sensors = _uses_sensors(options.geometry_source, options.env.get("encoder"))
        self._observes_once = uses_sensors and not options.observe_every

    def __call__(self, indices: range) -> tuple[range, list[Outcome]]:
        """`indices`, and their outcomes."""
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
        act, plan_found, searched = self.begin(index, query)
        planning_seconds = time.perf_counter() - began
        policy = None if act is None else _Counted(act, self.job.record)
        trajectory = rollout(self.env, query, policy, self.job.delay, planning_seconds)
        seconds = float(trajectory.times.sum())
        outcome = {
            **episode_outcome(trajectory, self._checker(query.scene, len(trajectory))),
            "actions": 0 if policy is None else policy.actions,
            "policy_seconds": seconds,
            "planning_seconds": planning_seconds,
            "plan_found": plan_found,
            "searched": searched,
            "steps": len(trajectory),
            "contacts": int(trajectory.contacts.sum()),
        }
        if self._observes_once and query.scene.is_static:
            # Here, because Numba takes a while to import.
            from roboarm_nmp.envs.perception.visibility import unobserved_share

            states = query.scene.robot.normalise(trajectory.configurations)
            outcome["unobserved_share"] = unobserved_share(query.scene, states)
        if self.job.record:
            outcome["episode"] = RecordedEpisode(
                trajectory.actions.astype(np.float32),
                trajectory.success,
                trajectory.collides,
                trajectory_digest(trajectory),
                seconds + planning_seconds,
            )
        return outcome

    def _checker(self, scene, steps):
        """For the clearance in an episode; None where it is not measured."""
        if not self.job.options.measure_clearance:
            return None
        # Here, because Numba takes a while to import.
        from roboarm_nmp.envs.collision.checker import CollisionChecker

        if scene.is_static:
            return CollisionChecker(scene)
        return [CollisionChecker(scene.at(step * STEP_SECONDS)) for step in range(steps + 1)]


def episode_outcome(trajectory: Trajectory, checker: Any = None) -> Outcome:
    """Success and contact of an episode, and if it was successful its `LENGTHS`.

    `checker` as of `motions.metrics.motion_metrics`: for the clearance, None for none.
    """
    outcome: Outcome = {"success": trajectory.success, "collision": trajectory.collides}
    if trajectory.success:
        outcome["mean_steps"] = len(trajectory)
        outcome["path_length"] = path_length(trajectory.configurations)
        outcome["smoothness"] = smoothness(trajectory.configurations)
        motion = motion_metrics(trajectory, checker)
        outcome.update((name, motion[name]) for name in MOTION_METRICS)
    return outcome


def rounded(actions: np.ndarray) -> np.ndarray:
    """Actions as float32 with 16 significant bits, of which a file needs a quarter less."""
    bits = np.array(actions, np.float32).view(np.uint32)
    return ((bits + 0x80) & np.uint32(0xFFFFFF00)).view(np.float32)


def trajectory_digest(trajectory: Trajectory) -> int:
    """CRC-32 of an episode's states and contacts: the same for exactly the same motion."""
    contacts = np.asarray(trajectory.contacts, bool).tobytes()
    return zlib.crc32(contacts, zlib.crc32(np.asarray(trajectory.states, np.float32).tobytes()))


def _run(job: _Job, progress: bool) -> list[Outcome]:
    """The outcomes of all queries, in their order."""
    count = len(job.start)
    chunks = [range(first, min(first + CHUNK, count)) for first in range(0, count, CHUNK)]
    outcomes = {}
    successes = 0
    bar = progress_bar(total=count, unit="query", disable=not progress)
    torch = sys.modules.get("torch")
    threads = torch.get_num_threads() if torch else None
    try:
        with bar, contextlib.closing(_results(job, chunks)) as results:
            for indices, chunk in results:
                outcomes.update(zip(indices, chunk, strict=True))
                successes += sum(outcome["success"] for outcome in chunk)
                bar.update(len(chunk))
                if bar.n:  # 0 if no bar is shown
                    bar.set_postfix(success=f"{successes / bar.n:.3f}")
    finally:
        if torch:
            torch.set_num_threads(threads)
    return [outcomes[index] for index in range(count)]


def _results(job, chunks) -> Generator[tuple[range, list[Outcome]], None, None]:
    """Yield the chunks and their outcomes, in any order."""
    count = min(job.options.workers, len(chunks))
    if count == 1:
        yield from map(_Worker(job), chunks)
    else:
        yield from workers.run(_Worker, (job,), chunks, count, write_line)


# --- The result


def _summary(job: _Job, outcomes: list[Outcome]) -> dict[str, Any]:
    options = job.options
    policy = job.policy
    count = len(outcomes)
    checks = options.replan or policy in CHECKING or options.verify_else in CHECKING
    is_random = checks or policy == "random" or options.safety_filter
    result = {
        "policy": getattr(policy, "__name__", str(policy)),
        "task": None if job.problems else job.task,
        "robot": get_task(job.task).base_scene.robot.name,
        "goal_type": options.env["goal_type"],
        "split": options.split,
        "queries": options.queries,
    }
    if job.problems:
        result["problems"] = job.problems
    result |= rates_and_means(outcomes)
    steps = sum(outcome["steps"] for outcome in outcomes)
    result["contact_share"] = sum(outcome["contacts"] for outcome in outcomes) / max(1, steps)
    reached = [outcome for outcome in outcomes if outcome["success"]]
    clearance = _mean(reached, "min_clearance") if options.measure_clearance else None
    result["min_clearance"] = clearance
    actions = sum(outcome["actions"] for outcome in outcomes)
    seconds = sum(outcome["policy_seconds"] for outcome in outcomes)
    result["ms_per_action"] = 1e3 * seconds / actions if actions else None
    result |= dict.fromkeys(("planning_seconds", "planning_seconds_solved", "free_motion_rate"))
    if policy in PLANNERS:
        solved = [outcome for outcome in outcomes if outcome["plan_found"]]
        result["planning_seconds"] = _mean(outcomes, "planning_seconds")
        result["planning_seconds_solved"] = _mean(solved, "planning_seconds")
        if policy == "via-points":
            result["free_motion_rate"] = len(solved) / count
    packages = ["pybullet", "onnxruntime", "torch", "numpy"]
    if policy in OMPL_PLANNERS or options.verify_else in OMPL_PLANNERS:
        packages.append("ompl")
    result |= {
        "env": options.env,
        "deviations": deviations(options.env),
        "geometry_source": options.geometry_source,
        "privileged": is_privileged(options.env)
        or (checks and options.geometry_source == GROUND_TRUTH),
        "safety_filter": None,
        "seed": options.seed if is_random else None,
        "tries": options.tries if policy == "via-points" else None,
        "time_limit": options.time_limit if "ompl" in packages else None,
        "action_delay": job.delay,
        "versions": {"python": platform.python_version()},
    }
    result["versions"].update((package, version(package)) for package in packages)
    if options.safety_filter:
        result["safety_filter"] = options.safety_filter.to_metadata() | {"version": VERSION}
    if options.observe_every:
        result["observe_every"] = options.observe_every
    if options.sensor_noise:
        result["sensor_noise"] = options.sensor_noise.to_metadata()
    if all("unobserved_share" in outcome for outcome in outcomes):
        result["unobserved_share"] = _mean(outcomes, "unobserved_share")
    if options.replan:
        result["replan"] = True
    if outcomes[0]["plan_found"] is not None and (
        policy not in BASELINES or options.verify_else is not None
    ):
        result["verified_rate"] = sum(outcome["plan_found"] for outcome in outcomes) / count
        result["planning_seconds"] = _mean(outcomes, "planning_seconds")
    if options.unknown:
        result["unknown"] = options.unknown
    if options.search:
        result["search"] = True
    if options.verify_else is not None:
        result["verify_else"] = str(options.verify_else)
    if options.search or options.verify_else is not None:
        result["search_rate"] = sum(outcome["searched"] for outcome in outcomes) / count
    return result


def rates_and_means(outcomes: list[Outcome]) -> dict[str, Any]:
    """`num_queries`, rates with their intervals, and means over successes, without clearance."""
    count = len(outcomes)
    reached = [outcome for outcome in outcomes if outcome["success"]]
    numbers: dict[str, Any] = {"num_queries": count}
    for name, hits in (
        ("success_rate", len(reached)),
        ("collision_free_success_rate", sum(not outcome["collision"] for outcome in reached)),
        ("collision_rate", sum(outcome["collision"] for outcome in outcomes)),
    ):
        numbers[name] = hits / count
        numbers[f"{name}_interval"] = list(wilson_interval(hits, count))
    for name in LENGTHS:
        if name != "min_clearance":
            numbers[name] = _mean(reached, name)
    return numbers


def _mean(outcomes, name):
    """The mean of a number in outcomes; None where there are none."""
    values = np.array([outcome[name] for outcome in outcomes], dtype=np.float64)
    return float(values.mean()) if len(values) else None
