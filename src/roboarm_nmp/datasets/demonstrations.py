"""Demonstrations: a task's files of them, read, written, described.

    demos = load_demos("wall")
    demos[0].configurations  # rad
    demos[0].states, demos[0].actions  # normalised, as in observations and actions
    demos[-1], demos[:10]  # as with queries

The format of the files: `datasets.format`.
"""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, overload

import numpy as np

from roboarm_nmp.datasets.format import (
    DEMO_ARRAYS,
    DEMO_SCHEMA,
    DatasetError,
    QueryScenes,
    array_formats,
    check_configurations,
    check_format,
    locate,
    offsets_of,
    read_file,
    read_scenes,
    scene_arrays,
    task_file,
    write_file,
)
from roboarm_nmp.datasets.queries import query_keys, query_path, validate
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.subgoals import MAX_STEP, schedule
from roboarm_nmp.envs.tasks import get_task

# Resolution of the stored configurations, normalised. Their error is at most half of it, and moves
# the end effector by less than 0.5 mm. Where scenes vary, twice that keeps the files small.
QUANTUM = 2e-4
QUANTUM_IN_SCENES = 4e-4


@dataclass(frozen=True, eq=False)
class Demo:
    """One demonstration.

    `start`, `goal`, `plan` and `configurations` are joint angles in rad, as in queries; `states`
    and `actions` are normalised, as the environment observes and receives them. The robot is that
    of the scene; j is the number of its joints.

    Attributes:
        start, goal: float32 (j,), rad.
        scene: the `Scene`.
        plan: float32 (p, j), rad: the waypoints from start to goal.
        states: float32 (m, j), the executed configurations, normalised.
        actions: float32 (m - 1, j), the displacement commanded in each, clipped to `MAX_STEP` as
            the environment does.
        digest: CRC-32 of the bytes of the exact states, before they were rounded.
    """

    start: np.ndarray
    goal: np.ndarray
    scene: Scene
    plan: np.ndarray
    states: np.ndarray
    actions: np.ndarray
    digest: int

    @property
    def configurations(self) -> np.ndarray:
        """The executed configurations: float64 (m, j), rad."""
        return self.scene.robot.denormalise(self.states)


@dataclass(frozen=True, eq=False)
class Demos:
    """Demonstrations, flat. `demos[i]` is a `Demo`; a slice or index array, fewer demonstrations.

    An index beyond the last one raises IndexError; -1 is the last one. In `made_by`, `parameters`
    and `seed`, fewer demonstrations are those of the whole file.

    Attributes:
        task: name of the task they are for.
        seed: of the command that made them.
        start, goal: float32 (n, j), rad.
        scenes: `QueryScenes`; `scenes[i]` is that of demonstration i.
        states: float32 (m, j): the executed configurations of all demonstrations, normalised.
        actions: float32 (m, j): the displacement commanded in each; zero in the last one of each
            demonstration, which has no action.
        offsets: int64 (n + 1,): demonstration i is `states[offsets[i] : offsets[i + 1]]`.
        plan: float32 (p, j), rad: the waypoints of all plans.
        plan_offsets: int64 (n + 1,), the same for `plan`.
        plan_seed: uint32 (n,), the planner's seeds.
        digest: uint32 (n,), see `Demo`.
        collided: bool (n,), whether the execution has a contact.
        made_by: the command that made the file.
        parameters: dict of everything else that determined them, and of counts of rejections.
    """

    task: str
    seed: int
    start: np.ndarray
    goal: np.ndarray
    scenes: QueryScenes
    states: np.ndarray
    actions: np.ndarray
    offsets: np.ndarray
    plan: np.ndarray
    plan_offsets: np.ndarray
    plan_seed: np.ndarray
    digest: np.ndarray
    collided: np.ndarray
    made_by: str
    parameters: dict[str, Any]

    @property
    def quantum(self) -> float:
        """Resolution of `states`: their deviations from the plan are multiples of it."""
        return self.parameters.get("quantum", QUANTUM)

    def __len__(self) -> int:
        return len(self.start)

    def __iter__(self) -> Iterator[Demo]:
        return (self[i] for i in range(len(self)))

    @overload
    def __getitem__(self, index: int) -> Demo: ...

    @overload
    def __getitem__(self, index: slice | np.ndarray | list[int]) -> "Demos": ...

    def __getitem__(self, index: int | slice | np.ndarray | list[int]) -> "Demo | Demos":
        try:
            i = np.arange(len(self))[index]
        except IndexError as error:
            raise IndexError(f"demonstration {index} of {len(self)}") from error
        if i.ndim:
            return self._take(i)
        rows = slice(self.offsets[i], self.offsets[i + 1])
        return Demo(
            start=self.start[i],
            goal=self.goal[i],
            scene=self.scenes[int(i)],
            plan=self.plan[self.plan_offsets[i] : self.plan_offsets[i + 1]],
            states=self.states[rows],
            actions=self.actions[rows][:-1],
            digest=int(self.digest[i]),
        )

    def _take(self, chosen):
        """The demonstrations with these numbers, int64 (k,)."""
        rows, offsets = _rows(self.offsets, chosen)
        plan_rows, plan_offsets = _rows(self.plan_offsets, chosen)
        return replace(
            self,
            start=self.start[chosen],
            goal=self.goal[chosen],
            scenes=self.scenes.take(chosen),
            states=self.states[rows],
            actions=self.actions[rows],
            offsets=offsets,
            plan=self.plan[plan_rows],
            plan_offsets=plan_offsets,
            plan_seed=self.plan_seed[chosen],
            digest=self.digest[chosen],
            collided=self.collided[chosen],
        )


def _rows(offsets, chosen):
    """The rows of the chosen demonstrations in a flat array, and their offsets among these."""
    lengths = np.diff(offsets)[chosen]
    new = offsets_of(lengths)
    return np.arange(new[-1]) + np.repeat(offsets[chosen] - new[:-1], lengths), new


def demo_path(task: str | Path) -> Path:
    """Path of a task's demonstration file; for a scene file, `<name>_demos.h5` beside it.

    For `TASK@ROBOT` it is `<task>@<robot>_demos.h5` beside the scene file, or, where TASK is a
    name, beside the robot's file. Raises ValueError: `task` is none of these.
    """
    return task_file(task, "demos", "_demos.h5")


def load_demos(task_or_path: str | Path, task: str | Path | None = None) -> Demos:
    """Load the demonstrations of a task, or of any demonstration file.

    Args:
        task_or_path: name of a task, path of a scene file, `TASK@ROBOT`, or path of a demonstration
            file.
        task: the task that a demonstration file must be for; needed for other arms than the Panda.

    Raises:
        DatasetError: the file is missing, corrupt, not a demonstration file, or made for another
            task, for another version of the task's scene, or for another robot.
    """
    path, task_of_path = locate(task_or_path, demo_path)
    attributes, arrays, base = read_file(path, DEMO_SCHEMA, task or task_of_path)
    robot = base.robot
    offsets = offsets_of(arrays["length"])
    plan = arrays["plan"]
    plan_offsets = offsets_of(arrays["plan_length"])
    if offsets[-1] != len(arrays["residual"]) or plan_offsets[-1] != len(plan):
        raise DatasetError(f"{path}: the lengths do not add up to the number of rows")
    if arrays["length"].min() < 2 or arrays["plan_length"].min() < 2:
        raise DatasetError(f"{path}: a demonstration has at least two configurations")
    check_configurations(path, "plan", plan, robot)
    parameters = json.loads(attributes["parameters"])
    lag = parameters.get("lag")
    if not isinstance(lag, list) or len(lag) != robot.num_joints or not all(map(_is_finite, lag)):
        raise DatasetError(f"{path}: parameters: lag is not {robot.num_joints} finite numbers")
    quantum = parameters.get("quantum", QUANTUM)
    if not _is_finite(quantum):
        raise DatasetError(f"{path}: parameters: quantum is not 1 finite number")
    before, here, after = schedule(plan, plan_offsets, offsets, robot)
    states = here - lag * (here - before) + arrays["residual"] * quantum
    states = states.astype(np.float32)
    actions = after - states
    length = np.maximum(np.linalg.norm(actions, axis=1, keepdims=True), 1e-9)
    actions *= np.minimum(1.0, MAX_STEP / length)
    actions[offsets[1:] - 1] = 0.0
    return Demos(
        task=attributes["task"],
        seed=attributes["seed"],
        start=plan[plan_offsets[:-1]],
        goal=plan[plan_offsets[1:] - 1],
        scenes=read_scenes(path, base, arrays),
        states=states,
        actions=actions.astype(np.float32),
        offsets=offsets,
        plan=plan,
        plan_offsets=plan_offsets,
        plan_seed=arrays["plan_seed"],
        digest=arrays["digest"],
        collided=arrays["collided"].astype(bool),
        made_by=attributes["made_by"],
        parameters=parameters,
    )


class _JoinedScenes:
    """The scenes of several files: query i has scene `which[i, 1]` of file `which[i, 0]`."""

    def __init__(self, parts, which):
        self.parts = parts
        self.which = which
        self.base = parts[0].base

    def __getitem__(self, i):
        part, number = self.which[i]
        return self.parts[part][number]

    def take(self, which):
        """As `QueryScenes.take`."""
        return _JoinedScenes(self.parts, self.which[which])


def load_demo_files(files: Sequence[Path | str], task: str, number: int | None = None) -> Demos:
    """Load several files of a task as one `Demos`, file after file.

    Its `made_by`, `parameters` and `seed` are the first file's.

    Args:
        files: paths; without any, the task's own demonstrations.
        task: the task that they must be for.
        number: how many demonstrations to take from each file, from the first on; None for all.

    Raises:
        DatasetError: as `load_demos`.
    """
    parts = [load_demos(file, task) for file in files or (task,)]
    if number is not None:
        parts = [part[:number] for part in parts]
    if len(parts) == 1:
        return parts[0]
    flat = ("start", "goal", "states", "actions", "plan", "plan_seed", "digest", "collided")
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in flat}
    for name in ("offsets", "plan_offsets"):
        lengths = [np.diff(getattr(part, name)) for part in parts]
        arrays[name] = np.concatenate([[0], np.cumsum(np.concatenate(lengths))])
    which = [(i, number) for i, part in enumerate(parts) for number in range(len(part))]
    scenes = _JoinedScenes([part.scenes for part in parts], np.array(which))
    return replace(parts[0], **arrays, scenes=scenes)


def _is_finite(value):
    return isinstance(value, (int, float)) and math.isfinite(value)


def write_demos(
    path: str | Path,
    task: str | Path,
    seed: int,
    plans: Sequence[np.ndarray],
    executions: Sequence[np.ndarray],
    columns: dict[str, Sequence[int]],
    made_by: str,
    parameters: dict[str, Any],
    scenes_of: Iterable[Scene] | None = None,
) -> None:
    """Write a demonstration file, atomically, as `write_queries` does.

    Args:
        path: file to write; an existing one is replaced.
        task: name of the task, path of a scene file, or `TASK@ROBOT`.
        seed: the seed they were made with.
        plans: list of float32 (p, j) arrays, rad, from start to goal.
        executions: list of float32 (m, j) arrays, normalised configurations, starting at the start.
        columns: `{"plan_seed", "digest", "collided"}`: sequences of ints, one per demonstration.
        made_by: the command line that makes this file.
        parameters: JSON-ready dict of everything else that determined them.
        scenes_of: the `Scene` of each demonstration; None where all of them are the task's.

    Raises:
        DatasetError: an array is invalid, a query occurs twice, or it is one of the task's test or
            validation queries. Nothing is written then.
        ValueError: unknown task.
        OSError: the file cannot be written; an old file stays as it is.
    """
    demo_path(task)  # rejects an unknown task
    base = get_task(task).base_scene
    robot = base.robot
    lengths = [len(states) for states in executions]
    plan_lengths = [len(plan) for plan in plans]
    if not plans or len(executions) != len(plans):
        raise DatasetError(f"{path}: {len(plans)} plans and {len(executions)} executions")
    if min(lengths + plan_lengths) < 2:
        raise DatasetError(f"{path}: a demonstration has at least two configurations")
    plan = np.concatenate(plans)
    states = np.concatenate(executions)
    if plan.shape[1:] != (robot.num_joints,) or states.shape[1:] != (robot.num_joints,):
        raise DatasetError(
            f"{path}: plans and executions must have {robot.num_joints} numbers a row"
        )
    check_configurations(path, "plan", plan, robot)
    if not np.isfinite(states).all():
        raise DatasetError(f"{path}: executions have numbers that are not finite")
    offsets = offsets_of(lengths)
    plan_offsets = offsets_of(plan_lengths)
    start = plan[plan_offsets[:-1]]
    goal = plan[plan_offsets[1:] - 1]
    keys = query_keys(start, goal)
    if len(keys) < len(start):
        raise DatasetError(f"{path}: {len(start) - len(keys)} queries are in it twice")
    if query_path(task).exists():
        for split, queries in validate(query_path(task), task).items():
            shared = len(keys & query_keys(queries.start, queries.goal))
            if shared:
                raise DatasetError(f"{path}: {shared} queries are {split} queries of {task}")
    # The arm lags behind the sub-goals, each joint by a nearly constant share of the last move.
    before, here, _ = schedule(plan, plan_offsets, offsets, robot)
    moved = here - before
    lag = ((here - states) * moved).sum(0) / np.maximum(np.square(moved).sum(0), 1e-9)
    lag = [round(value, 6) for value in lag.tolist()]
    quantum = QUANTUM if scenes_of is None else QUANTUM_IN_SCENES
    residual = np.round((states - (here - lag * moved)) / quantum)
    arrays = scene_arrays(path, scenes_of, base)
    arrays["plan"] = plan
    arrays["plan_length"] = np.array(plan_lengths, np.uint32)
    arrays["residual"] = residual.astype(np.int16)
    arrays["length"] = np.array(lengths, np.uint32)
    for name, values in columns.items():
        arrays[name] = np.array(values, DEMO_ARRAYS[name][0])
    check_format(path, array_formats(DEMO_SCHEMA, arrays), arrays, robot)
    parameters = {**parameters, "lag": lag}
    if quantum != QUANTUM:
        parameters["quantum"] = quantum
    write_file(path, DEMO_SCHEMA, task, seed, arrays, made_by, parameters)


def describe(demos: Demos) -> dict[str, float]:
    """Statistics of demonstrations, by name.

    `steps`, `waypoints` and `path_length` (rad, sum of the joints' L2 displacements) are means;
    `steps_95` is the 95th percentile; `length_ratio` the mean of path length over the straight
    line's, in the normalised space; `with_contacts` the number of demonstrations with contacts;
    `solved` the share of queries with a demonstration within the allowed attempts. The counts of
    rejected attempts follow.
    """
    moves = np.diff(demos.states.astype(np.float64), axis=0)
    inside = np.ones(len(moves), bool)
    inside[demos.offsets[1:-1] - 1] = False  # not from one demonstration to the next
    owner = np.repeat(np.arange(len(demos)), np.diff(demos.offsets))[:-1][inside]

    def length_of(displacements):
        lengths = np.linalg.norm(displacements[inside], axis=1)
        return np.bincount(owner, lengths, len(demos))

    robot = demos.scenes.base.robot
    straight = np.linalg.norm(robot.normalise(demos.goal) - robot.normalise(demos.start), axis=1)
    steps = np.diff(demos.offsets) - 1
    counts = demos.parameters.get("counts", {})
    return {
        "demonstrations": len(demos),
        "steps": float(steps.mean()),
        "steps_95": float(np.percentile(steps, 95)),
        "path_length": float(length_of(moves * (robot.upper - robot.lower) / 2).mean()),
        "length_ratio": float((length_of(moves) / straight).mean()),
        "waypoints": float(np.diff(demos.plan_offsets).mean()),
        "with_contacts": int(demos.collided.sum()),
        "solved": len(demos) / (len(demos) + counts.get("queries_given_up", 0)),
        **counts,
    }
