"""Queries: a start, a goal and a scene each; a task's files of them, read, written, validated.

    for start, goal, scene in load_queries("wall", "validation"): ...

The format of the files: `datasets.format`.
"""

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np

from roboarm_nmp.datasets.format import (
    ORIGINAL,
    QUERY_SCHEMA,
    SPLITS,
    DatasetError,
    OutOfDateError,
    QueryScenes,
    SeededScenes,
    array_formats,
    check_configurations,
    check_format,
    locate,
    read_file,
    read_scenes,
    scene_arrays,
    task_file,
    write_file,
)
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.moving_boxes import MovingScenes
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.scenes.wide_scenes.distribution import WideScenes
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
        scenes: `QueryScenes` or `SeededScenes`; `scenes[i]` is that of query i.
    """

    task: str
    split: str
    seed: int
    start: np.ndarray
    goal: np.ndarray
    goal_position: np.ndarray
    scenes: QueryScenes | SeededScenes

    def __len__(self) -> int:
        return len(self.start)

    def __iter__(self) -> Iterator[Query]:
        return (self[i] for i in range(len(self)))

    @overload
    def __getitem__(self, index: int) -> Query: ...

    @overload
    def __getitem__(self, index: slice | np.ndarray) -> "Queries": ...

    def __getitem__(self, index: int | slice | np.ndarray) -> "Query | Queries":
        start, goal = self.start[index], self.goal[index]
        if isinstance(index, (int, np.integer)):
            return Query(start, goal, self.scenes[int(index)])
        return replace(
            self,
            start=start,
            goal=goal,
            goal_position=self.goal_position[index],
            scenes=self.scenes.take(index),
        )


def query_path(task: str | Path) -> Path:
    """Path of a task's query file; for a scene file, `<name>_queries.h5` beside it.

    For `TASK@ROBOT` it is `<task>@<robot>_queries.h5` beside the scene file, or, where TASK is a
    name, beside the robot's file. Raises ValueError: `task` is none of these.
    """
    return task_file(task, "data", "_queries.h5")


def load_queries(
    task_or_path: str | Path, split: str = "test", task: str | Path | None = None
) -> Queries:
    """Load the queries of a task, or of any query file.

    Args:
        task_or_path: name of a task, path of a scene file, `TASK@ROBOT`, or path of a query file.
        split: `test`, `validation`, or, where a task has it, `original`.
        task: the task that a query file must be for; needed for other arms than the Panda.

    Raises:
        DatasetError: the file is missing, corrupt, not a query file, or made for another task, for
            another version of the task's scene, or for another robot.
        ValueError: the split is unknown, or the scene file malformed.
    """
    if split not in (*SPLITS, ORIGINAL):
        raise ValueError(f"unknown split {split!r}: {suggest(split, (*SPLITS, ORIGINAL))}")
    path, task_of_path = locate(task_or_path, query_path)
    queries, _ = _read_queries(path, task or task_of_path)
    if split not in queries:
        raise DatasetError(f"{path}: has no {split} queries")
    return queries[split]


def write_queries(
    path: str | Path,
    task: str | Path,
    seed: int,
    splits: Mapping[str, tuple],
    made_by: str,
    parameters: dict[str, Any],
) -> None:
    """Write a query file, atomically: `path` always has the whole old file or the whole new one.

    The same arguments give the same bytes (same build of h5py; before 3.15 it adds time stamps).

    Args:
        path: file to write; an existing one is replaced.
        task: name of the task, path of a scene file, or `TASK@ROBOT`.
        seed: the seed the queries were made with.
        splits: `{"test": (start, goal, scenes), "validation": (start, goal, scenes)}`, and
            `original` where there are some; start and goal float32 (n, j), rad; scenes a sequence
            of n `Scene`s, left out where all of them are the task's, or `SeededScenes`.
        made_by: the command line that makes this file.
        parameters: JSON-ready dict of everything else that determined the queries.

    Raises:
        DatasetError: a query file may not have these arrays. Nothing is written then.
        ValueError: unknown task, or other splits.
        OSError: the file cannot be written; an old file is left as it was.
    """
    base = get_task(task).base_scene  # refuses an unknown task
    if set(splits) - {ORIGINAL} != set(SPLITS):
        raise ValueError(f"splits must be {', '.join(SPLITS)}, got {', '.join(splits)}")
    arrays = {}
    for split, queries in splits.items():
        start, goal = np.asarray(queries[0]), np.asarray(queries[1])
        scenes = queries[2] if len(queries) > 2 else None
        arrays.update(scene_arrays(path, scenes, base, f"{split}/"))
        arrays[f"{split}/start"] = start
        arrays[f"{split}/goal"] = goal
        is_wide = isinstance(scenes, SeededScenes) and isinstance(scenes.distribution, WideScenes)
        if goal.ndim == 2 and goal.shape[1] == base.robot.num_joints and not is_wide:
            position = base.robot.forward_kinematics(goal).astype(np.float32)
            arrays[f"{split}/goal_position"] = position
        if split == "test" and isinstance(scenes, SeededScenes):
            parameters = {**parameters, "first_scene": scenes.summary()}
    check_format(path, array_formats(QUERY_SCHEMA, arrays), arrays, base.robot)
    _check_queries(path, arrays, base.robot)
    write_file(path, QUERY_SCHEMA, task, seed, arrays, made_by, parameters)


def validate(
    path: str | Path, task: str | Path | None = None, simulate: bool = False, progress: bool = False
) -> dict[str, Queries]:
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
        _check_positions(path, queries)
        _simulate(path, queries, parameters.get("hold_steps", HOLD_STEPS), progress)
    return queries


def _read_queries(path, task):
    """({split: Queries}, parameters) of a file, after every check that needs no simulator."""
    attributes, arrays, base = read_file(path, QUERY_SCHEMA, task)
    _check_queries(path, arrays, base.robot)
    queries = {}
    for split in _splits_in(arrays):
        start, goal = arrays[f"{split}/start"], arrays[f"{split}/goal"]
        if f"{split}/scene_seed" in arrays:
            distribution = _drawn_scenes(path, task or attributes["task"])
            scenes = SeededScenes(distribution, arrays[f"{split}/scene_seed"], start, goal)
        else:
            scenes = read_scenes(path, base, arrays, f"{split}/")
        position = arrays.get(f"{split}/goal_position")
        if position is None:
            position = base.robot.forward_kinematics(goal)
        queries[split] = Queries(
            task=attributes["task"],
            split=split,
            seed=attributes["seed"],
            start=start,
            goal=goal,
            goal_position=position.astype(np.float32),
            scenes=scenes,
        )
    parameters = json.loads(attributes["parameters"])
    scenes = queries["test"].scenes
    if isinstance(scenes, SeededScenes) and not np.allclose(
        scenes.summary(), parameters.get("first_scene", np.nan), rtol=0.0, atol=1e-6
    ):
        raise OutOfDateError(
            f"{path}: out of date: made for another version of the scenes of "
            f"{attributes['task']!r}; make it again with: {attributes['made_by']} --overwrite"
        )
    return queries, parameters


def _drawn_scenes(path, task):
    """The distribution of a task's scenes. Raises DatasetError: they are not drawn from seeds."""
    distribution = get_task(task).scene
    if not isinstance(distribution, (MovingScenes, WideScenes)):
        raise DatasetError(f"{path}: has seeds of scenes, and the task {task!r} has none")
    return distribution


def _splits_in(arrays):
    """The splits of a file's arrays."""
    return [split for split in (*SPLITS, ORIGINAL) if f"{split}/start" in arrays]


def query_keys(start: np.ndarray, goal: np.ndarray) -> set[bytes]:
    """The set of queries as bytes: start and goal, each float32 (n, j), exactly."""
    return {row.tobytes() for row in np.hstack([start, goal])}


def _check_queries(path, arrays, robot: Robot):
    """Joint limits, finite numbers, and no query in both splits."""
    for split in _splits_in(arrays):
        for name in ("start", "goal"):
            check_configurations(path, f"{split}/{name}", arrays[f"{split}/{name}"], robot)
        position = arrays.get(f"{split}/goal_position", np.zeros(3))
        if not np.isfinite(position).all():
            raise DatasetError(f"{path}: {split}/goal_position has numbers that are not finite")
    test = query_keys(arrays["test/start"], arrays["test/goal"])
    validation = query_keys(arrays["validation/start"], arrays["validation/goal"])
    if test & validation:
        raise DatasetError(f"{path}: {len(test & validation)} queries are in both splits")


def _check_positions(path, splits):
    """Raise DatasetError unless every `goal_position` is that of the goal."""
    for split, queries in splits.items():
        position = queries.scenes.base.robot.forward_kinematics(queries.goal)
        wrong = np.linalg.norm(position - queries.goal_position, axis=1) > _POSITION_TOLERANCE
        if wrong.any():
            raise DatasetError(
                f"{path}: {split}/goal_position[{wrong.argmax()}] is not the position of the goal"
            )


def _simulate(path, splits, hold_steps, progress):
    """Raise DatasetError unless every start and goal is feasible in the simulator."""
    world = World(splits["test"].scenes.base)
    total = sum(map(len, splits.values()))
    bar = progress_bar(None, Path(path).name, total, "query", disable=not progress)
    with contextlib.closing(world), bar:
        for split, queries in splits.items():
            for row, (start, goal, scene) in enumerate(queries):
                # Moving obstacles may be at the goal.
                still = [obstacle for obstacle in scene.obstacles if obstacle.motion is None]
                at_goal = replace(scene, obstacles=still)
                ends = {"start": (start, scene), "goal": (goal, at_goal)}
                for name, (configuration, surroundings) in ends.items():
                    world.set_scene(surroundings)
                    if not world.is_feasible(configuration, hold_steps):
                        raise DatasetError(f"{path}: {split}/{name}[{row}] is not feasible")
                bar.update()
