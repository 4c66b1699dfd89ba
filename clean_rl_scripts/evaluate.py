"""Evaluate a policy on the queries of a task: how often it gets there, and how well.

    python clean_rl_scripts/evaluate.py --policy go-to-goal --task double_walls --workers 2
    python clean_rl_scripts/evaluate.py --policy runs/my_run --task wall --json result.json

An episode is one query, in the query's scene, under the task's standard rules: goal tolerances,
horizon and longest step of `RoboArmEnv`'s defaults, contacts allowed. The same arguments give the
same numbers, times excepted, whatever the number of workers.

A policy that was trained with another longest step (`max_step`) acts with that one, and
`--stop-on-collision` is no standard rule either. Such numbers are not comparable with others: the
table says so, and the JSON (`deviations`, empty under the standard rules).

Policies to compare a trained one with:

- go-to-goal: straight to the goal configuration, whatever is in the way;
- random: a random action at every step;
- via-points: looks before it moves. It goes straight to the goal configuration if that motion is
  free of collisions, or else by way of the first of `--tries` random configurations for which the
  motion is free; if there is none it goes straight all the same;
- planner: plans before it moves, with OMPL's RRT-Connect, and follows the plan. It may search for
  `--time-limit` seconds per query; the longer it searches, the less it keeps away from obstacles.
  (Shortening a plan may take some milliseconds more.) Without a plan it gives up: a failure of 0
  steps. As the limit is wall-clock time, the numbers may depend on the machine, and on what else it
  is doing.

The last two check collisions with the true obstacles (`envs.collision.checker`), which a trained policy
does not see; with `--encoder points`, with what four point clouds see of them: look, then plan;
with the name of an encoder that has a decoder (`--encoder field`), with what its 64 numbers tell.

CircularConv any policy, `--safety-margin` puts a last layer (`envs.policies.safety_filter`): links stay that far (m)
from everything, as far as it can, and the arm leaves dead ends. It knows the true obstacles, too,
or with `--encoder points` what is seen. A policy that was trained with points and distances from
them may get those that an encoder tells of: `--encoder field`.

What comes out:

- success: share of episodes that reached the goal, with a 95% Wilson interval;
- clean success: share that reached it and never touched anything on the way;
- collision: share in which anything was touched, whether the goal was reached or not;
- steps, path length, smoothness: means over the successful episodes. With configurations
  c_0 ... c_T in rad, the path length is the sum of |c_t+1 - c_t|, in rad, and the smoothness the
  mean of |c_t+1 - 2 c_t + c_t-1|, in rad per step^2 (L2 norms; lower is smoother);
- time per action: of the policy alone, without the simulator and without planning.

Of `via-points` and `planner` also:

- planning time: what they spent before moving, in s: mean over all queries, and over those for
  which they found something;
- free motion (only `via-points`): share of queries for which it found a motion free of collisions.

From Python: `evaluate(policy, task, ...)` returns the same numbers as a dict.
"""

import io
import json
import math
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
import tyro
from PIL import Image
from tqdm import tqdm

from roboarm_nmp import envs
from roboarm_nmp.envs import panda
from roboarm_nmp.envs.arm_env import STANDARD_RULES, deviations
from roboarm_nmp.envs.datasets.format import QueryScenes
from roboarm_nmp.envs.datasets.queries import Query, load_queries, validate
from roboarm_nmp.envs.policies.registry import (
    PLANNING,
    TIME_LIMIT,
    TRIES,
    find_policy,
    make_policy,
    own_safety_filter,
)
from roboarm_nmp.envs.policies.safety_filter import VERSION, SafetyFilter
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.tasks import get_task, task_name
from roboarm_nmp.envs.training import flags
from roboarm_nmp.envs.training.flags import (
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Seed,
    Workers,
)
from roboarm_nmp.envs.utils import workers
from roboarm_nmp.envs.utils.files import check_writable, write_atomically

CHUNK = 10  # queries a worker takes at a time
FRAMES = 8  # of a picture


@dataclass
class Args:
    policy: str
    """`go-to-goal`, `random`, `via-points`, `planner` (see above), a policy network, a run's folder
    with a `policy.pt` in it, or the name of a pretrained one (docs/results.md)"""
    task: str
    """the task, one of `envs.TASKS`, or a scene file (.yaml)"""
    goal_type: Literal["ee", "config", "combined"] | None = None
    """what the goal is; by default what the policy was trained with, or else `ee`"""
    split: Literal["test", "validation", "original"] = "test"
    """which of the task's queries; few tasks have `original` ones"""
    queries: Path | None = None
    """a query file to use instead of the task's own"""
    num_queries: PositiveInt | None = None
    """only the first so many queries of the split"""
    workers: Workers = 1
    """processes; each uses one core"""
    stop_on_collision: bool = False
    """end an episode at the first touch"""
    geometry_source: str | None = None
    """where `planner`, `via-points`, the safety filter and the policy's observations take the
    obstacles from: `ground_truth`, `point_cloud`, or an encoder with a decoder (a name or path); by
    default the policy's own, otherwise `ground_truth`"""
    safety_margin: NonNegativeFloat | None = None
    """put a last layer around the policy that keeps this distance (m), e.g. 0.01; by default the
    one that is part of the policy, if it has one (0: none at all)"""
    escape: bool = True
    """the last layer also leaves dead ends, by a detour into a random direction"""
    seed: Seed = 0
    """of what is random: `random`, `via-points`, `planner`, ways out"""
    tries: PositiveInt = TRIES
    """random configurations that `via-points` tries per query"""
    time_limit: PositiveFloat = TIME_LIMIT
    """seconds that `planner` may search per query"""
    json: Path | None = None
    """write the results to this file too"""
    picture: Path | None = None
    """draw the first query's episode as a strip of pictures into this PNG file"""


class EvaluationError(ValueError):
    """An evaluation that cannot be done; the message says why."""


class Outcome(NamedTuple):
    """What came out of one episode; lengths are NaN where the goal was not reached.

    `found`: whether a motion was found before moving; None if the policy did not look for one.
    """

    success: bool
    collision: bool
    steps: int
    path_length: float
    smoothness: float
    policy_seconds: float
    planning_seconds: float
    found: bool | None


# --- Metrics


def wilson_interval(successes, n):
    """The 95% Wilson score interval (low, high) of a share, for `successes` out of `n` >= 1."""
    z = 1.959964
    share = successes / n
    centre = share + z * z / (2 * n)
    spread = z * (share * (1 - share) / n + z * z / (4 * n * n)) ** 0.5
    scale = 1 + z * z / n
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def path_length(configurations):
    """Sum of the L2 distances, in rad, between successive configurations (T + 1, 7), rad."""
    return float(np.linalg.norm(np.diff(configurations, axis=0), axis=1).sum())


def smoothness(configurations):
    """Mean L2 norm of the second differences, rad per step^2, of configurations (T + 1, 7), rad.

    Zero for fewer than three configurations.
    """
    if len(configurations) < 3:
        return 0.0
    return float(np.linalg.norm(np.diff(configurations, n=2, axis=0), axis=1).mean())


# --- Episodes


@dataclass(frozen=True)
class _Job:
    """All that a worker needs to know."""

    policy: str | Path | Callable
    task: str
    env: dict
    geometry_source: str | None
    safety_filter: SafetyFilter | None
    start: np.ndarray
    goal: np.ndarray
    scenes: Sequence[Scene]
    split: str | None
    seed: int
    tries: int
    time_limit: float
    workers: int

    def make(self, **kwargs):
        env = envs.make(self.task, **self.env, **kwargs)
        options = self.seed, self.tries, self.time_limit, self.geometry_source, self.safety_filter
        return env, make_policy(self.policy, env, *options)

    def query(self, index):
        return Query(self.start[index], self.goal[index], self.scenes[index])


def _run_episode(env, policy, index, query, on_step=None):
    """One episode's `Outcome`. `on_step(action)` is called after every step."""
    observation, info = env.reset_specific(*query)
    began = time.perf_counter()
    act, found = policy(index, query)
    planning_seconds = time.perf_counter() - began
    if found is not None:  # it may have moved the arm
        observation, info = env.reset_specific(*query)
    states = [observation["observation"][:7]]
    seconds, ended = 0.0, info["is_success"] or act is None
    while not ended:
        began = time.perf_counter()
        action = act(observation)
        seconds += time.perf_counter() - began
        observation, _, terminated, truncated, info = env.step(action)
        states.append(observation["observation"][:7])
        ended = terminated or truncated
        if on_step is not None:
            on_step(action)
    lengths = [np.nan, np.nan]
    if info["is_success"]:
        configurations = panda.denormalise(states)
        lengths = [path_length(configurations), smoothness(configurations)]
    return Outcome(
        info["is_success"],
        info["collision_so_far"],
        len(states) - 1,
        *lengths,
        seconds,
        planning_seconds,
        found,
    )


def _run_queries(job, env, policy, indices):
    outcomes = []
    for index in indices:
        try:
            outcomes.append(_run_episode(env, policy, index, job.query(index)))
        except ValueError as error:  # the query or the action was refused
            raise EvaluationError(f"query {index}: {error}") from error
    return outcomes


class _Worker:
    """Runs the queries of a job, chunk by chunk."""

    def __init__(self, job):
        torch.set_num_threads(1)
        self.job = job
        self.env, self.policy = job.make()

    def __call__(self, indices):
        """`indices`, a range, and their outcomes."""
        return indices, _run_queries(self.job, self.env, self.policy, indices)


def _results(job, chunks, warn):
    """The chunks and their outcomes, in any order."""
    if job.workers == 1:
        return map(_Worker(job), chunks)
    return workers.run(_Worker, (job,), chunks, min(job.workers, len(chunks)), warn)


def _run(job, progress):
    """The outcomes of all queries, in their order."""
    count = len(job.start)
    chunks = [range(first, min(first + CHUNK, count)) for first in range(0, count, CHUNK)]
    outcomes, successes = [None] * count, 0
    bar = tqdm(total=count, unit="query", disable=None if progress else True)
    threads = torch.get_num_threads()
    try:
        with bar:
            for indices, found in _results(job, chunks, bar.write):
                outcomes[indices.start : indices.stop] = found
                successes += sum(outcome.success for outcome in found)
                bar.update(len(found))
                if bar.n:  # 0 as long as no bar is shown
                    bar.set_postfix(success=f"{successes / bar.n:.3f}")
    finally:
        torch.set_num_threads(threads)
    return outcomes


# --- The evaluation


def evaluate(
    policy,
    task,
    goal_type=None,
    *,
    queries=None,
    split="test",
    num_queries=None,
    stop_on_collision=False,
    seed=0,
    tries=TRIES,
    time_limit=TIME_LIMIT,
    geometry_source=None,
    safety_filter=None,
    workers=1,
    env=None,
    progress=False,
):
    """Run a policy on a task's queries.

    Args:
        policy: `go-to-goal`, `random`, `via-points`, `planner`, the path of a policy network or of
            a folder with a `policy.pt`, the name of a policy in a `policies` folder, or a function
            from an observation (dict of `RoboArmEnv`) to an action (7,); with several workers, one
            that can be pickled.
        task: name of the task, or path of a scene file.
        goal_type: `ee`, `config`, `combined`; None for the policy's own, or else `ee`.
        queries: what to use instead of the task's own queries: the path of a query file, or an
            object with `start` and `goal`, float32 (n, 7), rad, and `scenes`, a sequence of n
            `Scene`s, like `envs.datasets.Queries`. Without `scenes` they are in the task's scene,
            which must then not be random.
        split: `test`, `validation` or `original`; which queries of the file.
        num_queries: only the first so many of them.
        stop_on_collision: end an episode at the first touch.
        seed: of what is random; each query has its own generator.
        tries: random configurations that `via-points` tries per query, >= 1.
        time_limit: seconds that `planner` may search per query, > 0.
        geometry_source: where `planner`, `via-points`, the safety filter and the policy's
            observations take the obstacles from (`envs.perception.geometry_source`); None for the
            policy's own, otherwise `ground_truth`.
        safety_filter: an `envs.policies.safety_filter.SafetyFilter` around the policy; None: the one that is part of
            it, if it has one; False: none.
        workers: processes. More than one needs the caller's script to be importable
            (`if __name__ == "__main__":`), as always with `multiprocessing`.
        env: dict with `action_mode`, `max_step`, `velocities` where a function needs other than the
            defaults. A policy network brings its own.
        progress: show a progress bar, with the success rate so far.

    Returns:
        A dict that fits into JSON; what it holds is described at the top of this file. Means over
        nothing (no successful episode, say) are None, and so is what a policy has not.

    Raises:
        EvaluationError: the policy, the task or the queries cannot be used.
    """
    arguments = {name: value for name, value in locals().items() if name != "progress"}
    job = _prepare(**arguments)
    return _summary(job, _run(job, progress))


def _prepare(
    *,
    policy,
    task,
    goal_type,
    queries,
    split,
    num_queries,
    stop_on_collision,
    geometry_source,
    safety_filter,
    env,
    **options,
):
    """The `_Job` of `evaluate`'s arguments, once everything about them has been checked.

    `options`: those that the `_Job` has as they are, `seed`, `tries`, `time_limit`, `workers`.
    """
    try:
        scene = get_task(task).scene
    except ValueError as error:
        raise EvaluationError(str(error)) from error
    for name in ("workers", "tries"):
        if options[name] < 1:
            raise EvaluationError(f"{name} must be at least 1, got {options[name]}")
    if not 0 < (seconds := options["time_limit"]) < math.inf:
        raise EvaluationError(f"time_limit must be a positive number of seconds, got {seconds}")
    env = dict(env or {})
    try:
        if not callable(policy):
            policy, trained = find_policy(policy)
            if trained:
                if goal_type not in (None, trained["goal_type"]):
                    raise EvaluationError(
                        f"{policy} was trained with the goal type {trained['goal_type']!r}, it "
                        f"cannot be evaluated with {goal_type!r}"
                    )
                env, goal_type = trained, trained["goal_type"]
                if geometry_source is not None and "geometry_source" in env:
                    env = env | {"geometry_source": geometry_source}
        env |= {"goal_type": goal_type or "ee", "stop_on_collision": stop_on_collision}
        if safety_filter is None:
            safety_filter = own_safety_filter(policy)
        if safety_filter:
            source = env.get("geometry_source") or geometry_source or "ground_truth"
            env |= {"link_distances": True, "geometry_source": source}
        elif geometry_source not in (None, env.get("geometry_source")) and policy not in PLANNING:
            raise EvaluationError(
                "geometry_source is for via-points, planner, a safety filter, and policies that "
                "observe points or link distances"
            )
        if queries is None:
            queries = load_queries(task, split)
        elif isinstance(queries, (str, Path)):
            validate(queries, task)  # they are for this task, with the scene it has now
            queries = load_queries(queries, split)
        arm = envs.make(task, **env)
        make_policy(
            policy, arm, geometry_source=geometry_source, safety_filter=safety_filter
        )  # or it raises
        arm.close()
    except (TypeError, ValueError) as error:
        raise EvaluationError(str(error)) from error
    name = task_name(task)
    if getattr(queries, "task", name) != name:
        raise EvaluationError(f"these queries are for the task {queries.task!r}, not {name!r}")
    scenes = getattr(queries, "scenes", None)
    if scenes is None:
        if not isinstance(scene, Scene):
            raise EvaluationError(f"{name} has random scenes: these queries need `scenes` as well")
        scenes = QueryScenes(scene)
    available = len(queries.start)
    count = available if num_queries is None else num_queries
    if not 1 <= count <= available:
        raise EvaluationError(f"num_queries must be 1 to {available}, got {num_queries}")
    return _Job(
        policy,
        str(task),
        env,
        geometry_source,
        safety_filter,
        queries.start[:count],
        queries.goal[:count],
        scenes,
        getattr(queries, "split", None),
        **options,
    )


def _summary(job, outcomes):
    count = len(outcomes)
    columns = Outcome(*(np.array(column) for column in zip(*outcomes, strict=True)))
    reached = columns.success
    clean = reached & ~columns.collision
    actions = int(columns.steps.sum())

    def share(name, hits):
        low, high = wilson_interval(int(hits.sum()), count)
        return {name: float(hits.mean()), f"{name}_interval": [low, high]}

    def mean(values, which=reached):
        return float(values[which].mean()) if which.any() else None

    planning = {"planning_seconds": None, "planning_seconds_solved": None, "free_motion_rate": None}
    if job.policy in PLANNING:
        found = columns.found.astype(bool)
        planning["planning_seconds"] = float(columns.planning_seconds.mean())
        planning["planning_seconds_solved"] = mean(columns.planning_seconds, found)
        if job.policy == "via-points":
            planning["free_motion_rate"] = float(found.mean())

    packages = ["pybullet", "torch", "numpy"] + ["ompl"] * (job.policy == "planner")
    return {
        "policy": getattr(job.policy, "__name__", str(job.policy)),
        "task": job.task,
        "goal_type": job.env["goal_type"],
        "split": job.split,
        "num_queries": count,
        **share("success_rate", reached),
        **share("collision_free_success_rate", clean),
        **share("collision_rate", columns.collision),
        "mean_steps": mean(columns.steps),
        "path_length": mean(columns.path_length),
        "smoothness": mean(columns.smoothness),
        "ms_per_action": 1e3 * float(columns.policy_seconds.sum()) / actions if actions else None,
        **planning,
        "env": job.env,
        "deviations": deviations(job.env),
        "geometry_source": job.geometry_source,
        "safety_filter": asdict(job.safety_filter) | {"version": VERSION}
        if job.safety_filter
        else None,
        "seed": job.seed if job.policy in ("random", *PLANNING) or job.safety_filter else None,
        "tries": job.tries if job.policy == "via-points" else None,
        "time_limit": job.time_limit if job.policy == "planner" else None,
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in packages},
        },
    }


# --- The command


def _table(result):
    def row(name, value, unit="", interval=None):
        number = "-" if value is None else f"{value:.4g}" if unit else f"{value:.4f}"
        between = f"[{interval[0]:.4f}, {interval[1]:.4f}]" if interval else unit
        return f"  {name:<16}{number:>9}  {between}"

    shares = [
        row(label, result[name], interval=result[f"{name}_interval"])
        for label, name in (
            ("success", "success_rate"),
            ("clean success", "collision_free_success_rate"),
            ("collision", "collision_rate"),
        )
    ]
    planning = []
    if result["planning_seconds"] is not None:
        planning = [
            row("planning time", result["planning_seconds"], "s"),
            row("  ... if found", result["planning_seconds_solved"], "s"),
        ]
    if result["free_motion_rate"] is not None:
        planning.append(row("free motion", result["free_motion_rate"]))
    return "\n".join(
        [
            f"{result['policy']} on {result['task']}: {result['num_queries']} {result['split']} "
            f"queries, goal type {result['goal_type']}",
            *(
                f"  not comparable: {name} is {value}, not {STANDARD_RULES[name]}"
                for name, value in result["deviations"].items()
            ),
            *shares,
            row("mean steps", result["mean_steps"], "on the way to the goal"),
            row("path length", result["path_length"], "rad"),
            row("smoothness", result["smoothness"], "rad/step^2"),
            row("time per action", result["ms_per_action"], "ms"),
            *planning,
        ]
    )


def _draw(job):
    """A PNG file's bytes: the first query's episode in `FRAMES` pictures, side by side."""
    env, policy = job.make(render_mode="rgb_array")
    query, actions = job.query(0), []
    _run_episode(env, policy, 0, query, on_step=actions.append)
    # Again, exactly the same, to take the pictures where they are wanted.
    wanted = set(np.linspace(0, len(actions), FRAMES).round().astype(int).tolist())
    env.reset_specific(*query)
    frames = [env.render()]
    for step, action in enumerate(actions, start=1):
        env.step(action)
        if step in wanted:
            frames.append(env.render())
    env.close()
    png = io.BytesIO()
    Image.fromarray(np.concatenate(frames, axis=1)).save(png, format="PNG")
    return png.getvalue()


def _safety_filter(args):
    """As `evaluate` takes it. Raises ValueError: there is no way out that could be left out."""
    if args.safety_margin is not None:
        return SafetyFilter(args.safety_margin, args.escape) if args.safety_margin else False
    if args.escape:
        return None
    own = own_safety_filter(find_policy(args.policy)[0])
    if own is None:
        raise ValueError("--no-escape: the policy has no last layer; --safety-margin puts one")
    return replace(own, escape=False)


def main(arguments=None):
    """The command. Returns the exit code: 0, or 2 for arguments that make no sense."""
    args = tyro.cli(Args, args=arguments, description=__doc__)
    try:
        flags.check(args)
        for path in (args.json, args.picture):
            if path is not None:
                check_writable(path)
        of_the_command = ("safety_margin", "escape", "json", "picture")
        given = {name: flag for name, flag in vars(args).items() if name not in of_the_command}
        job = _prepare(**given, safety_filter=_safety_filter(args), env=None)
        result = _summary(job, _run(job, progress=True))
    except ValueError as error:
        print(f"evaluate.py: {error}", file=sys.stderr)
        return 2
    print(_table(result))
    try:
        if args.json is not None:
            write_atomically(args.json, (json.dumps(result, indent=2) + "\n").encode())
        if args.picture is not None:
            write_atomically(args.picture, _draw(job))
    except OSError as error:
        print(f"evaluate.py: cannot write: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
