"""Queries: a start, a goal and a scene each; a task's files of them, read, written, validated.

    for start, goal, scene in load_queries("wall", "validation"): ...

The format of the files: `datasets.format`.
"""

import contextlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from roboarm_nmp.datasets.format import (
    ORIGINAL,
    QUERY_ARRAYS,
    QUERY_SCHEMA,
    SPLITS,
    AnimatedScenes,
    DatasetError,
    OutOfDateError,
    QueryScenes,
    check_configurations,
    check_format,
    locate,
    read_file,
    read_scenes,
    scene_arrays,
    task_file,
    write_file,
)
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.tasks import get_task
from roboarm_nmp.envs.world import HOLD_STEPS, World
from roboarm_nmp.utils.names import suggest
from roboarm_nmp.utils.progress import progress_bar

# Positions may differ by a rounding error between machines.
_POSITION_TOLERANCE = 1e-6  # m


class Query(NamedTuple):
    """Joint angles at start and goal, float32 (j,), rad, and the `Scene`.

    `env.reset_specific(*query)` begins an episode on it.
    """

    start: np.ndarray
    goal: np.ndarray
    scene: Scene


@dataclass(frozen=True, eq=False)
class Queries:
    """Queries of one split. `queries[i]` is a `Query`; a slice or index array, fewer queries.

    Attributes:
        task: name of the task they are for.
        split: `test`, `validation` or `original`.
        seed: of the command that made them.
        start: float32 (n, j), rad, of the j joints of the robot, `scenes.base.robot`.
        goal: float32 (n, j), rad.
        goal_position: float32 (n, 3), end-effector position at the goal, m.
        scenes: `QueryScenes` or `AnimatedScenes`; `scenes[i]` is that of query i.
    """

    task: str
    split: str
    seed: int
    start: np.ndarray
    goal: np.ndarray
    goal_position: np.ndarray
    scenes: QueryScenes | AnimatedScenes

    def __len__(self):
        return len(self.start)

    def __getitem__(self, index):
        start, goal, position = self.start[index], self.goal[index], self.goal_position[index]
        if start.ndim == 1:
            return Query(start, goal, self.scenes[index])
        scenes_of = self.scenes.take(index)
        return Queries(self.task, self.split, self.seed, start, goal, position, scenes_of)


def query_path(task):
    """Path of a task's query file; for a scene file, `<name>_queries.h5` beside it.

    That of `TASK@ROBOT` is `<task>@<robot>_queries.h5` beside the scene file, or, for a name,
    beside the robot's file.

    Raises ValueError: `task` is none of these.
    """
    return task_file(task, "data", "_queries.h5")


def load_queries(task_or_path, split="test", task=None):
    """The `Queries` of a task's pretrained file, or of any query file.

    Args:
        task_or_path: name of a task, path of a scene file, `TASK@ROBOT`, or path of a query file.
        split: `test`, `validation`, or, where a task has it, `original`.
        task: the task that a query file must be for. A robot's files need one, unless the robot is
            the Panda.

    Raises:
        DatasetError: the file is missing, corrupt, not a query file, or made for another task, for
            another version of the task's scene, or for another robot.
        ValueError: unknown split; a malformed scene file.
    """
    if split not in (*SPLITS, ORIGINAL):
        raise ValueError(f"unknown split {split!r}: {suggest(split, (*SPLITS, ORIGINAL))}")
    path, found = locate(task_or_path, query_path)
    queries = _read_queries(path, task or found)[0]
    if split not in queries:
        raise DatasetError(f"{path}: has no {split} queries")
    return queries[split]


def write_queries(path, task, seed, splits, made_by, parameters):
    """Write a query file, atomically: at every moment `path` is the old file or the whole new one.

    The same arguments give the same bytes (same build of h5py; before 3.15 it adds time stamps).

    Args:
        path: file to write; an existing one is replaced.
        task: name of the task, path of a scene file, or `TASK@ROBOT`.
        seed: the seed the queries were made with, an int.
        splits: `{"test": (start, goal, scenes), "validation": (start, goal, scenes)}`, and
            `original` where there are some; start and goal float32 (n, j), rad; scenes a sequence
            of n `Scene`s, left out where all of them are the task's, or `AnimatedScenes`.
        made_by: the command line that makes this file.
        parameters: JSON-ready dict of everything else that determined the queries.

    Raises:
        DatasetError: arrays that a query file must not have; nothing is written then.
        ValueError: unknown task, or other splits.
        OSError: the file cannot be written; an old file is left as it was.
    """
    path = Path(path)
    base = get_task(task).base_scene  # refuses an unknown task
    if set(splits) - {ORIGINAL} != set(SPLITS):
        raise ValueError(f"splits must be {', '.join(SPLITS)}, got {', '.join(splits)}")
    arrays = {}
    for split, (start, goal, *scenes_of) in splits.items():
        start, goal = np.asarray(start), np.asarray(goal)
        arrays |= scene_arrays(path, scenes_of[0] if scenes_of else None, base, f"{split}/")
        arrays |= {f"{split}/start": start, f"{split}/goal": goal}
        if goal.ndim == 2 and goal.shape[1] == base.robot.num_joints:
            position = base.robot.forward_kinematics(goal).astype(np.float32)
            arrays[f"{split}/goal_position"] = position
    check_format(path, QUERY_SCHEMA, arrays, base.robot)
    _check_queries(path, arrays, base.robot)
    if len(scenes := splits["test"][2:]) and isinstance(scenes[0], AnimatedScenes):
        parameters = {**parameters, "first_scene": scenes[0].summary()}
    write_file(path, QUERY_SCHEMA, task, seed, arrays, made_by, parameters)


def validate(path, task=None, simulate=False, progress=False):
    """Check a query file; returns its splits, a dict of split -> `Queries`.

    Args:
        path: the file.
        task: the task it should be for; None allows any of the Panda.
        simulate: also check in the simulator (minutes for 10,000 queries) that every start and goal
            is feasible, for as long as when the file was made, and that `goal_position` is right.
        progress: show a progress bar while simulating.

    Raises:
        DatasetError: the first error found.
    """
    queries, parameters = _read_queries(path, task)
    if simulate:
        _simulate(path, queries, parameters.get("hold_steps", HOLD_STEPS), progress)
    return queries


def _read_queries(path, task):
    """({split: Queries}, parameters) of a file, after every check that needs no simulator."""
    attributes, arrays, base = read_file(path, QUERY_SCHEMA, task)
    _check_queries(path, arrays, base.robot)
    queries = {}
    for split in (*SPLITS, ORIGINAL):
        if f"{split}/start" not in arrays:
            continue
        columns = {name: arrays[f"{split}/{name}"] for name in QUERY_ARRAYS}
        if f"{split}/scene_seed" in arrays:
            seeds = arrays[f"{split}/scene_seed"]
            columns["scenes"] = _animated(path, task or attributes["task"], seeds, columns)
        else:
            columns["scenes"] = read_scenes(path, base, arrays, f"{split}/")
        queries[split] = Queries(attributes["task"], split, attributes["seed"], **columns)
    parameters = json.loads(attributes["parameters"])
    scenes = queries["test"].scenes
    if isinstance(scenes, AnimatedScenes) and not np.allclose(
        scenes.summary(), parameters.get("first_scene", np.nan), rtol=0.0, atol=1e-6
    ):
        raise OutOfDateError(
            f"{path}: out of date: made for another version of the moving scenes of "
            f"{attributes['task']!r}; make it again with: {attributes['made_by']} --overwrite"
        )
    return queries, parameters


def _animated(path, task, seeds, columns):
    """The `AnimatedScenes` of a split. Raises DatasetError: the task has none."""
    distribution = get_task(task).scene
    if not hasattr(distribution, "animate"):
        raise DatasetError(f"{path}: has seeds of moving scenes, and the task {task!r} has none")
    return AnimatedScenes(distribution, seeds, columns["start"], columns["goal"])


def query_keys(start, goal):
    """The set of queries as bytes: start and goal, each float32 (n, j), exactly."""
    return {row.tobytes() for row in np.hstack([start, goal])}


def _check_queries(path, arrays, robot):
    """Joint limits, finite numbers, and no query in both splits."""
    for split in (*SPLITS, ORIGINAL):
        if f"{split}/start" not in arrays:
            continue
        for name in ("start", "goal"):
            check_configurations(path, f"{split}/{name}", arrays[f"{split}/{name}"], robot)
        if not np.isfinite(arrays[f"{split}/goal_position"]).all():
            raise DatasetError(f"{path}: {split}/goal_position has numbers that are not finite")
    test, validation = (
        query_keys(arrays[f"{split}/start"], arrays[f"{split}/goal"]) for split in SPLITS
    )
    if test & validation:
        raise DatasetError(f"{path}: {len(test & validation)} queries are in both splits")


def _simulate(path, queries, hold_steps, progress):
    robot = queries["test"].scenes.base.robot
    for split in queries:
        position = robot.forward_kinematics(queries[split].goal)
        off = np.linalg.norm(position - queries[split].goal_position, axis=1) > _POSITION_TOLERANCE
        if off.any():
            row = int(np.argmax(off))
            raise DatasetError(
                f"{path}: {split}/goal_position[{row}] is not the position of the goal"
            )
    world = World(queries["test"].scenes.base)
    total = sum(len(queries[split]) for split in queries)
    with (
        contextlib.closing(world),
        progress_bar(None, Path(path).name, total, "query", disable=not progress) as bar,
    ):
        for split in queries:
            for row, (start, goal, scene) in enumerate(queries[split]):
                still = [obstacle for obstacle in scene.obstacles if obstacle.motion is None]
                # Moving obstacles may be at the goal.
                for name, configuration, around in (
                    ("start", start, scene),
                    ("goal", goal, replace(scene, obstacles=still)),
                ):
                    world.set_scene(around)
                    if not world.is_feasible(configuration, hold_steps):
                        raise DatasetError(f"{path}: {split}/{name}[{row}] is not feasible")
                bar.update()
