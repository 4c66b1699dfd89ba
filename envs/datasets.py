"""The HDF5 files of the tasks, read, written, validated: queries and demonstrations.

A query file, `envs/data/<task>.h5`, has the groups `test` and `validation`, and `original` where a
task has queries from elsewhere, each with

- `start`, `goal`: float32 (n, 7), joint angles in rad, exactly those the simulator was asked about;
- `goal_position`: float32 (n, 3), the end-effector position at the goal in metres,
- where scenes vary, `scene`: uint32 (n,), the number of each query's scene, `obstacle_count`:
  uint32 (s,), obstacles in each scene, and `obstacles`: float64 (k, 11), the obstacles of all
  scenes, one scene after another, as rows of `envs.scenes.to_array`.

A demonstration file, `envs/demos/<task>.h5`, has the arrays

- `plan`: float32 (p, 7), joint angles in rad: the waypoints of all plans, one plan after another,
  the first one of each the start, the last one the goal; `plan_length`: uint32 (n,);
- `residual`: int16 (m, 7), the executed configurations (see `write_demos`), one execution
  after another; `length`: uint32 (n,), configurations in each;
- `plan_seed`, `digest`: uint32 (n,), the planner's seed and the CRC-32 of the exact execution;
- `collided`: uint8 (n,), whether the execution touched something;
- where scenes vary, `scene`, `obstacle_count` and `obstacles`, as above.

Both have the attributes `schema`, `schema_version`, `task`, `seed`, `scene` (JSON: the scene,
without the obstacles that vary), `made_by` (the command that makes the file again), `parameters`
(JSON) and `checksum` (SHA-256 of all the others and the arrays). Files are written to a temporary
name and then renamed: there is never half a file.

    python -m envs.datasets validate envs/data/wall.h5 --simulate
"""

import argparse
import contextlib
import hashlib
import io
import json
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from envs import panda, scenes
from envs.arm_env import HOLD_STEPS, RoboArmEnv
from envs.files import write_atomically
from envs.scenes import Scene
from envs.tasks import TASKS, get_task, is_task, task_name

SPLITS = ("test", "validation")
ORIGINAL = "original"  # split of queries that were not sampled; few tasks have it
QUERY_SCHEMA, DEMO_SCHEMA = "roboarm-nmp queries", "roboarm-nmp demonstrations"
SCHEMA_VERSION = 1
# Of each array: dtype, numbers per row (None: one dimension), and the array of the same length.
_SCENE_ARRAYS = {
    "scene": ("<u4", None, None),
    "obstacle_count": ("<u4", None, "obstacle_count"),
    "obstacles": ("<f8", scenes.ROW, "obstacles"),
}
_QUERY_ARRAYS = {
    "start": ("<f4", 7, "start"),
    "goal": ("<f4", 7, "start"),
    "goal_position": ("<f4", 3, "start"),
}
_DEMO_ARRAYS = {
    "plan": ("<f4", 7, "plan"),
    "plan_length": ("<u4", None, "plan_length"),
    "residual": ("<i2", 7, "residual"),
    "length": ("<u4", None, "plan_length"),
    "plan_seed": ("<u4", None, "plan_length"),
    "digest": ("<u4", None, "plan_length"),
    "collided": ("<u1", None, "plan_length"),
}


def _arrays_of(schema, names):
    """The formats of a file's arrays: required ones, and optional ones if `names` has the first."""

    def with_scenes(arrays, rows_of, prefix=""):
        if f"{prefix}scene" in names:
            arrays = {**arrays, **_SCENE_ARRAYS, "scene": ("<u4", None, rows_of)}
        return {
            prefix + name: (dtype, width, prefix + sibling)
            for name, (dtype, width, sibling) in arrays.items()
        }

    if schema == DEMO_SCHEMA:
        return with_scenes(_DEMO_ARRAYS, "plan_length")
    arrays = {}
    for split in (*SPLITS, *(ORIGINAL,) * (f"{ORIGINAL}/start" in names)):
        arrays |= with_scenes(_QUERY_ARRAYS, "start", f"{split}/")
    return arrays


_ATTRIBUTES = {
    "schema": str,
    "schema_version": int,
    "task": str,
    "seed": int,
    "scene": str,
    "made_by": str,
    "parameters": str,
}
# Scenes and positions may differ by a rounding error between machines.
_SCENE_TOLERANCE = 1e-9
_POSITION_TOLERANCE = 1e-6  # m


class DatasetError(ValueError):
    """A file that cannot be used. The message names the file and says what is wrong with it."""


class Query(NamedTuple):
    """Joint angles at start and goal, float32 (7,), rad, and the `Scene`.

    `env.reset_specific(*query)` begins an episode on it.
    """

    start: np.ndarray
    goal: np.ndarray
    scene: Scene


class Scenes:
    """The scenes of n queries: `scenes[i]` is the `Scene` of query i, made when asked for.

    Attributes:
        base: the `Scene` without the obstacles that vary; the scene itself, if none do.
        index: int64 (n,), the number of each query's scene; None if all have the same scene.
        offsets: int64 (s + 1,): the obstacles of scene j are `rows[offsets[j] : offsets[j + 1]]`.
        rows: float64 (k, 11), as of `envs.scenes.to_array`.
    """

    def __init__(self, base, index=None, offsets=None, rows=None):
        self.base, self.index, self.offsets, self.rows = base, index, offsets, rows

    def __getitem__(self, i):
        if self.index is None:
            return self.base
        first, last = self.offsets[self.index[i] :][:2]
        return replace(self.base, obstacles=scenes.from_array(self.rows[first:last]))

    def take(self, which):
        """The scenes of fewer queries, by slice or index array."""
        index = None if self.index is None else self.index[which]
        return Scenes(self.base, index, self.offsets, self.rows)


@dataclass(frozen=True, eq=False)
class Queries:
    """Queries of one split. `queries[i]` is a `Query`; a slice or index array, fewer queries.

    Attributes:
        task: name of the task they are for.
        split: `test`, `validation` or `original`.
        seed: of the command that made them.
        start: float32 (n, 7), rad.
        goal: float32 (n, 7), rad.
        goal_position: float32 (n, 3), end-effector position at the goal, m.
        scenes: `Scenes`; `scenes[i]` is that of query i.
    """

    task: str
    split: str
    seed: int
    start: np.ndarray
    goal: np.ndarray
    goal_position: np.ndarray
    scenes: Scenes

    def __len__(self):
        return len(self.start)

    def __getitem__(self, index):
        start, goal, position = self.start[index], self.goal[index], self.goal_position[index]
        if start.ndim == 1:
            return Query(start, goal, self.scenes[index])
        scenes_of = self.scenes.take(index)
        return Queries(self.task, self.split, self.seed, start, goal, position, scenes_of)


def query_path(task):
    """Where the queries of a task are, or belong: of a scene file, `<name>_queries.h5` beside.

    Raises ValueError for a task that is neither.
    """
    return _task_file(task, "data", "_queries.h5")


def load_queries(task_or_path, split="test"):
    """The `Queries` of a task's packaged file, or of any query file.

    Args:
        task_or_path: name of a task, path of a scene file, or path of a query file.
        split: `test`, `validation`, or, where a task has it, `original`.

    Raises:
        DatasetError: the file is missing, corrupt, not a query file, or made for another task or
            for another version of the task's scene.
        ValueError: unknown split; a malformed scene file.
    """
    if split not in (*SPLITS, ORIGINAL):
        known = ", ".join((*SPLITS, ORIGINAL))
        raise ValueError(f"split must be one of {known}, got {split!r}")
    path, task = _locate(task_or_path, query_path)
    queries = _read_queries(path, task)[0]
    if split not in queries:
        raise DatasetError(f"{path}: has no {split} queries")
    return queries[split]


def write_queries(path, task, seed, splits, made_by, parameters):
    """Write a query file, atomically: at every moment `path` is the old file or the whole new one.

    The same arguments give the same bytes (same build of h5py; before 3.15 it adds time stamps).

    Args:
        path: file to write; an existing one is replaced.
        task: name of the task, or path of a scene file.
        seed: the seed the queries were made with, an int.
        splits: `{"test": (start, goal, scenes), "validation": (start, goal, scenes)}`, and
            `original` where there are some; start and goal float32 (n, 7), rad; scenes a sequence
            of n `Scene`s, left out where all of them are the task's.
        made_by: the command line that makes this file.
        parameters: dict of whatever else determined the queries; must fit into JSON.

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
        arrays |= _scene_arrays(path, scenes_of[0] if scenes_of else None, base, f"{split}/")
        arrays |= {f"{split}/start": start, f"{split}/goal": goal}
        if goal.ndim == 2 and goal.shape[1] == panda.NUM_JOINTS:
            position = panda.forward_kinematics(goal).astype(np.float32)
            arrays[f"{split}/goal_position"] = position
    _check_format(path, QUERY_SCHEMA, arrays)
    _check_queries(path, arrays)
    _write(path, QUERY_SCHEMA, task, seed, arrays, made_by, parameters)


def validate(path, task=None, simulate=False, progress=False):
    """Check a query file; returns its splits, a dict of split -> `Queries`.

    Args:
        path: the file.
        task: the task it should be for; None allows any.
        simulate: also put the arm at every start and goal (minutes for 10,000 queries): feasible,
            held as long as when the file was made, and `goal_position` where the goal is.
        progress: show a progress bar while simulating.

    Raises:
        DatasetError: the first thing found wrong.
    """
    queries, parameters = _read_queries(path, task)
    if simulate:
        _simulate(path, queries, parameters.get("hold_steps", HOLD_STEPS), progress)
    return queries


# --- What both kinds of file share


def _task_file(task, folder, suffix):
    get_task(task)  # refuses an unknown task
    if task in TASKS:
        return Path(__file__).parent / folder / f"{task}.h5"
    return Path(task).with_name(task_name(task) + suffix)


def _locate(task_or_path, path_of_task):
    """(path, task it must be for): `task_or_path` is a task, or the path of any file."""
    if is_task(task_or_path):
        return path_of_task(task_or_path), task_or_path
    return Path(task_or_path), None


def _write(path, schema, task, seed, arrays, made_by, parameters):
    formats = _arrays_of(schema, arrays)
    arrays = {name: arrays[name].astype(dtype) for name, (dtype, *_) in formats.items()}
    attributes = {
        "schema": schema,
        "schema_version": SCHEMA_VERSION,
        "task": task_name(task),
        "seed": int(seed),
        "scene": scene_to_json(get_task(task).base_scene),
        "made_by": made_by,
        "parameters": json.dumps(parameters, sort_keys=True),
    }
    # HDF5 crashes the process on damaged metadata in its oldest format and in strings of variable
    # length (h5py's default); newer formats have checksums over metadata, fixed lengths included.
    # It is made in memory because HDF5 also crashes when the disk is full.
    contents = io.BytesIO()
    with h5py.File(contents, "w", libver=("v110", "v110")) as file:
        for name, value in {**attributes, "checksum": _checksum(attributes, arrays)}.items():
            file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value
        for name, array in arrays.items():
            # Shuffled in one chunk, sign and exponent bytes compress: 13% off a query file.
            packing = {"shuffle": True, "compression": "gzip", "compression_opts": 9}
            packing |= {"chunks": array.shape}
            # Neighbours in a column are alike: 37% off obstacles, a quarter off executions.
            if name.endswith("obstacles") or name == "residual":
                packing |= {"shuffle": False, "chunks": (len(array), 1)}
            file.create_dataset(
                name, data=array, track_times=False, **(packing if array.size else {})
            )
    write_atomically(path, contents.getbuffer())


def check_writable(path):
    """Raise ValueError if no file can be written at `path`. To be called before long work."""
    if path.is_dir():
        raise ValueError(f"{path} is a directory, not a file")
    try:
        tempfile.TemporaryFile(dir=path.absolute().parent).close()
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error.strerror}") from error


def scene_to_json(scene):
    """A `Scene` as text; equal scenes give equal texts."""
    fields = {
        "obstacles": scenes.to_array(scene.obstacles).tolist(),
        "table": None if scene.table is None else scenes.to_array([scene.table])[0].tolist(),
        "floor": scene.floor,
    }
    if scene.friction != scenes.FRICTION:
        fields["friction"] = scene.friction
    return json.dumps(fields, sort_keys=True)


def scene_from_json(text):
    """The inverse of `scene_to_json`."""
    fields = json.loads(text)
    table = fields["table"] and scenes.from_array([fields["table"]])[0]
    rows = np.array(fields["obstacles"]).reshape(-1, scenes.ROW)
    friction = fields.get("friction", scenes.FRICTION)
    return Scene(scenes.from_array(rows), table, fields["floor"], friction)


def _scene_arrays(path, scenes_of, base, prefix=""):
    """Arrays for a sequence of `Scene`s, equal ones stored once; none for None."""
    if scenes_of is None:
        return {}
    numbers = {}  # scene -> its number, in the order of their first use
    index = [numbers.setdefault(scene, len(numbers)) for scene in scenes_of]
    for scene in numbers:
        if replace(scene, obstacles=()) != replace(base, obstacles=()):
            raise DatasetError(
                f"{path}: {prefix}scene differs from the task's in more than its obstacles"
            )
    return {
        f"{prefix}scene": np.array(index, np.uint32),
        f"{prefix}obstacle_count": np.array([len(s.obstacles) for s in numbers], np.uint32),
        f"{prefix}obstacles": scenes.to_array([o for s in numbers for o in s.obstacles]),
    }


def _scenes_from(path, attributes, arrays, prefix=""):
    """The inverse of `_scene_arrays`: `Scenes`. Raises DatasetError where they make no sense."""
    base = scene_from_json(attributes["scene"])
    if f"{prefix}scene" not in arrays:
        return Scenes(base)
    index, counts, rows = (arrays[f"{prefix}{name}"] for name in _SCENE_ARRAYS)
    offsets = np.concatenate([[0], np.cumsum(counts.astype(np.int64))])
    if offsets[-1] != len(rows) or index.max() >= len(counts):
        raise DatasetError(f"{path}: {prefix}scene does not fit the number of scenes or obstacles")
    try:
        scenes.from_array(rows)
    except ValueError as error:
        raise DatasetError(f"{path}: {prefix}obstacles: {error}") from error
    if not np.isfinite(rows).all():
        raise DatasetError(f"{path}: {prefix}obstacles has numbers that are not finite")
    return Scenes(base, index.astype(np.int64), offsets, rows)


def _same_scene(one, other):
    """Whether two scenes (JSON) are equal up to rounding."""
    one, other = json.loads(one), json.loads(other)
    for field in ("obstacles", "table", "floor", "friction"):
        here, there = one.get(field), other.get(field)
        if here is None or there is None:
            if here is not there:
                return False
            continue
        a, b = np.array(here, dtype=float), np.array(there, dtype=float)
        if a.shape != b.shape or not np.allclose(a, b, rtol=0.0, atol=_SCENE_TOLERANCE):
            return False
    return True


def _checksum(attributes, arrays):
    """SHA-256 of the attributes, and of the names, shapes and contents of the arrays."""
    digest = hashlib.sha256(json.dumps(attributes, sort_keys=True).encode())
    for name, (dtype, *_) in _arrays_of(attributes["schema"], arrays).items():
        digest.update(f"{name} {arrays[name].shape}".encode())
        digest.update(arrays[name].astype(dtype).tobytes())
    return digest.hexdigest()


def _check_format(path, schema, arrays):
    """Shapes and dtypes; `arrays` are NumPy arrays or HDF5 datasets, by name."""
    formats = _arrays_of(schema, arrays)
    for name, array in arrays.items():
        dtype, width, sibling = formats[name]
        if array.dtype != np.dtype(dtype):
            raise DatasetError(f"{path}: {name} must be {np.dtype(dtype)}, is {array.dtype}")
        empty = array.size == 0 and name.rpartition("/")[2] != "obstacles"  # of scenes without any
        if array.shape[1:] != (() if width is None else (width,)) or empty:
            expected = "(n,)" if width is None else f"(n, {width})"
            raise DatasetError(
                f"{path}: {name} must have shape {expected} with n > 0, has {array.shape}"
            )
        if len(array) != len(arrays[sibling]):
            raise DatasetError(f"{path}: {name} has {len(array)} rows, not {len(arrays[sibling])}")


def _read(path, schema, task):
    """(attributes, arrays) of a file, after the checks that both kinds share."""
    try:
        with open(path, "rb"):
            pass
    except OSError as error:
        missing = "no such file" if task else "no such file or task"
        what = missing if isinstance(error, FileNotFoundError) else error.strerror
        raise DatasetError(f"{path}: {what}") from error
    if not h5py.is_hdf5(path):
        raise DatasetError(f"{path}: not an HDF5 file")
    try:
        with h5py.File(path, "r") as file:
            return _read_open(path, file, schema, task)
    except DatasetError:
        raise
    except Exception as error:  # damaged HDF5 raises all kinds of exceptions
        raise DatasetError(f"{path}: truncated or corrupt HDF5 ({error})") from error


def attribute(file, name):
    """An attribute of the file as a Python object; None if there is none."""
    value = file.attrs.get(name)
    value = value.item() if isinstance(value, np.generic) else value
    return value.decode() if isinstance(value, bytes) else value


def _read_open(path, file, schema, task):
    attributes = {}
    for name, kind in _ATTRIBUTES.items():
        value = attribute(file, name)
        if name == "schema" and value != schema:
            kind_of_file = {QUERY_SCHEMA: "query", DEMO_SCHEMA: "demonstration"}[schema]
            raise DatasetError(
                f"{path}: not a {kind_of_file} file (schema {value!r}, not {schema!r})"
            )
        if not isinstance(value, kind):
            raise DatasetError(f"{path}: attribute {name} is {value!r}, must be {kind.__name__}")
        if name == "schema_version" and value != SCHEMA_VERSION:
            raise DatasetError(f"{path}: schema version {value}, this code reads {SCHEMA_VERSION}")
        attributes[name] = value

    datasets = {name: file.get(name) for name in _arrays_of(schema, file)}
    for name, dataset in datasets.items():
        if not isinstance(dataset, h5py.Dataset):
            raise DatasetError(f"{path}: array {name} is missing or damaged")
    _check_format(path, schema, datasets)
    arrays = {name: dataset[()] for name, dataset in datasets.items()}
    if attribute(file, "checksum") != _checksum(attributes, arrays):
        raise DatasetError(f"{path}: corrupt (the checksum does not match the contents)")

    made_for = attributes["task"]
    if task is not None and made_for != task_name(task):
        raise DatasetError(
            f"{path}: this file is for the task {made_for!r}, not {task_name(task)!r}"
        )
    if task is None and made_for in TASKS:
        task = made_for
    # Of a scene file that is not at hand, the file itself says what the scene is.
    wanted = scene_to_json(get_task(task).base_scene) if task else attributes["scene"]
    if not _same_scene(attributes["scene"], wanted):
        replacing = " --overwrite" * (schema == DEMO_SCHEMA)
        raise DatasetError(
            f"{path}: out of date: made for another version of the scene of {made_for!r}; "
            f"make it again with: {attributes['made_by']}{replacing}"
        )
    return attributes, arrays


# --- Queries, continued


def _read_queries(path, task):
    """({split: Queries}, parameters) of a file, after every check that needs no simulator."""
    attributes, arrays = _read(path, QUERY_SCHEMA, task)
    _check_queries(path, arrays)
    queries = {}
    for split in (*SPLITS, ORIGINAL):
        if f"{split}/start" not in arrays:
            continue
        columns = {name: arrays[f"{split}/{name}"] for name in _QUERY_ARRAYS}
        columns["scenes"] = _scenes_from(path, attributes, arrays, f"{split}/")
        queries[split] = Queries(attributes["task"], split, attributes["seed"], **columns)
    return queries, json.loads(attributes["parameters"])


def _check_configurations(path, name, configurations):
    if not np.isfinite(configurations).all():
        raise DatasetError(f"{path}: {name} has numbers that are not finite")
    outside = (configurations < panda.LOWER) | (configurations > panda.UPPER)
    if outside.any():
        row = int(np.argmax(outside.any(axis=1)))
        raise DatasetError(f"{path}: {name}[{row}] is outside the joint limits")


def query_keys(start, goal):
    """The set of queries as bytes: start and goal, each float32 (n, 7), exactly."""
    return {row.tobytes() for row in np.hstack([start, goal])}


def _check_queries(path, arrays):
    """Joint limits, finite numbers, and no query in both splits."""
    for split in (*SPLITS, ORIGINAL):
        if f"{split}/start" not in arrays:
            continue
        for name in ("start", "goal"):
            _check_configurations(path, f"{split}/{name}", arrays[f"{split}/{name}"])
        if not np.isfinite(arrays[f"{split}/goal_position"]).all():
            raise DatasetError(f"{path}: {split}/goal_position has numbers that are not finite")
    test, validation = (
        query_keys(arrays[f"{split}/start"], arrays[f"{split}/goal"]) for split in SPLITS
    )
    if test & validation:
        raise DatasetError(f"{path}: {len(test & validation)} queries are in both splits")


def _simulate(path, queries, hold_steps, progress):
    from tqdm import tqdm  # here, because nothing else in this module needs it

    for split in queries:
        position = panda.forward_kinematics(queries[split].goal)
        off = np.linalg.norm(position - queries[split].goal_position, axis=1) > _POSITION_TOLERANCE
        if off.any():
            row = int(np.argmax(off))
            raise DatasetError(f"{path}: {split}/goal_position[{row}] is not where the goal is")
    env = RoboArmEnv(queries["test"].scenes.base)
    total = sum(len(queries[split]) for split in queries)
    with (
        contextlib.closing(env),
        tqdm(total=total, unit=" queries", desc=Path(path).name, disable=not progress) as bar,
    ):
        for split in queries:
            for row, (start, goal, scene) in enumerate(queries[split]):
                env.set_scene(scene)
                for name, configuration in (("start", start), ("goal", goal)):
                    if not env.is_feasible(configuration, hold_steps):
                        raise DatasetError(f"{path}: {split}/{name}[{row}] is not feasible")
                bar.update()


# --- Demonstrations

# A plan is followed by commanding one sub-goal per step. This far apart, the controller's lag
# seldom makes a step longer than the paper's 0.03, to which it is clipped.
MAX_STEP = 0.03
SUBGOAL_SPACING = 0.95 * MAX_STEP
# Resolution of the stored configurations, normalised: they are off by half of it at most, which
# moves the end-effector by less than 0.5 mm. Where scenes vary, these need the space: twice that.
QUANTUM, QUANTUM_IN_SCENES = 2e-4, 4e-4


@dataclass(frozen=True, eq=False)
class Demo:
    """One demonstration.

    Attributes:
        start, goal: float32 (7,), rad.
        scene: the `Scene`.
        plan: float32 (p, 7), rad: the waypoints from start to goal.
        states: float32 (m, 7), the executed configurations, normalised.
        actions: float32 (m - 1, 7), the displacement commanded in each, clipped to `MAX_STEP` as
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


@dataclass(frozen=True, eq=False)
class Demos:
    """The demonstrations of a file, flat. `demos[i]` is a `Demo`.

    Attributes:
        task: name of the task they are for.
        seed: of the command that made them.
        start, goal: float32 (n, 7), rad.
        scenes: `Scenes`; `scenes[i]` is that of demonstration i.
        states: float32 (m, 7): the executed configurations of all demonstrations, normalised.
        actions: float32 (m, 7): the displacement commanded in each; zero in the last of a
            demonstration, from which nothing was commanded.
        offsets: int64 (n + 1,): demonstration i is `states[offsets[i] : offsets[i + 1]]`.
        plan: float32 (p, 7), rad: the waypoints of all plans.
        plan_offsets: int64 (n + 1,), the same for `plan`.
        plan_seed: uint32 (n,), the planner's seeds.
        digest: uint32 (n,), see `Demo`.
        collided: bool (n,), whether something was touched.
        made_by: the command that made the file.
        parameters: dict of what else determined them, and of how many attempts were rejected.
    """

    task: str
    seed: int
    start: np.ndarray
    goal: np.ndarray
    scenes: Scenes
    states: np.ndarray
    actions: np.ndarray
    offsets: np.ndarray
    plan: np.ndarray
    plan_offsets: np.ndarray
    plan_seed: np.ndarray
    digest: np.ndarray
    collided: np.ndarray
    made_by: str
    parameters: dict

    @property
    def quantum(self):
        """What `states` were rounded to multiples of, measured from where a plan puts them."""
        return self.parameters.get("quantum", QUANTUM)

    def __len__(self):
        return len(self.start)

    def __getitem__(self, i):
        if not 0 <= i < len(self):
            raise IndexError(f"demonstration {i} of {len(self)}")
        rows = slice(self.offsets[i], self.offsets[i + 1])
        return Demo(
            self.start[i],
            self.goal[i],
            self.scenes[i],
            self.plan[self.plan_offsets[i] : self.plan_offsets[i + 1]],
            self.states[rows],
            self.actions[rows][:-1],
            int(self.digest[i]),
        )


def demo_path(task):
    """Where the demonstrations of a task are, or belong: of a scene file, `<name>_demos.h5` beside.

    Raises ValueError for a task that is neither.
    """
    return _task_file(task, "demos", "_demos.h5")


def load_demos(task_or_path, task=None):
    """The `Demos` of a task's packaged file, or of any demonstration file.

    Args:
        task_or_path: name of a task, path of a scene file, or path of a demonstration file.
        task: the task that a demonstration file must be for.

    Raises:
        DatasetError: the file is missing, corrupt, not a demonstration file, or made for another
            task or for another version of the task's scene.
    """
    path, found = _locate(task_or_path, demo_path)
    task = task or found
    attributes, arrays = _read(path, DEMO_SCHEMA, task)
    offsets, plan_offsets = (
        np.concatenate([[0], np.cumsum(arrays[name].astype(np.int64))])
        for name in ("length", "plan_length")
    )
    if offsets[-1] != len(arrays["residual"]) or plan_offsets[-1] != len(arrays["plan"]):
        raise DatasetError(f"{path}: the lengths do not add up to the number of rows")
    if arrays["length"].min() < 2 or arrays["plan_length"].min() < 2:
        raise DatasetError(f"{path}: a demonstration has at least two configurations")
    _check_configurations(path, "plan", arrays["plan"])
    parameters = json.loads(attributes["parameters"])
    before, here, after = _schedule(arrays["plan"], plan_offsets, offsets)
    quantum = parameters.get("quantum", QUANTUM)
    states = here - parameters["lag"] * (here - before) + arrays["residual"] * quantum
    states = states.astype(np.float32)
    actions = after - states
    length = np.maximum(np.linalg.norm(actions, axis=1, keepdims=True), 1e-9)
    actions *= np.minimum(1.0, MAX_STEP / length)
    actions[offsets[1:] - 1] = 0.0
    return Demos(
        task=attributes["task"],
        seed=attributes["seed"],
        start=arrays["plan"][plan_offsets[:-1]],
        goal=arrays["plan"][plan_offsets[1:] - 1],
        scenes=_scenes_from(path, attributes, arrays),
        states=states,
        actions=actions.astype(np.float32),
        offsets=offsets,
        plan=arrays["plan"],
        plan_offsets=plan_offsets,
        plan_seed=arrays["plan_seed"],
        digest=arrays["digest"],
        collided=arrays["collided"].astype(bool),
        made_by=attributes["made_by"],
        parameters=parameters,
    )


def write_demos(path, task, seed, plans, executions, columns, made_by, parameters, scenes_of=None):
    """Write a demonstration file, atomically, as `write_queries` does.

    Args:
        path: file to write; an existing one is replaced.
        task: name of the task, or path of a scene file.
        seed: the seed they were made with, an int.
        plans: list of float32 (p, 7) arrays, rad, from start to goal.
        executions: list of float32 (m, 7) arrays, normalised configurations, starting at the start.
        columns: `{"plan_seed", "digest", "collided"}`: sequences of ints, one per demonstration.
        made_by: the command line that makes this file.
        parameters: dict of whatever else determined them; must fit into JSON.
        scenes_of: sequence of n `Scene`s; None where all of them are the task's.

    Raises:
        DatasetError: arrays that a file must not have, or a query twice, or one of the task's test
            or validation queries; nothing is written then.
        ValueError: unknown task.
        OSError: the file cannot be written; an old file is left as it was.
    """
    path = Path(path)
    demo_path(task)  # refuses an unknown task
    lengths, plan_lengths = [len(one) for one in executions], [len(one) for one in plans]
    if not plans or len(executions) != len(plans):
        raise DatasetError(f"{path}: {len(plans)} plans and {len(executions)} executions")
    if min(lengths + plan_lengths) < 2:
        raise DatasetError(f"{path}: a demonstration has at least two configurations")
    plan, states = np.concatenate(plans), np.concatenate(executions)
    _check_configurations(path, "plan", plan)
    if states.shape[1:] != (panda.NUM_JOINTS,) or not np.isfinite(states).all():
        raise DatasetError(f"{path}: executions have numbers that are not finite, or not 7 a row")
    offsets, plan_offsets = np.cumsum([0, *lengths]), np.cumsum([0, *plan_lengths])
    start, goal = plan[plan_offsets[:-1]], plan[plan_offsets[1:] - 1]
    keys = query_keys(start, goal)
    if len(keys) < len(start):
        raise DatasetError(f"{path}: {len(start) - len(keys)} queries are in it twice")
    if query_path(task).exists():
        for split, queries in validate(query_path(task), task).items():
            shared = len(keys & query_keys(queries.start, queries.goal))
            if shared:
                raise DatasetError(f"{path}: {shared} queries are {split} queries of {task}")
    # The arm lags behind the sub-goals, each joint by a nearly constant share of their last move.
    before, here, _ = _schedule(plan, plan_offsets, offsets)
    moved = here - before
    lag = ((here - states) * moved).sum(0) / np.maximum(np.square(moved).sum(0), 1e-9)
    lag = [round(value, 6) for value in lag.tolist()]
    quantum = QUANTUM if scenes_of is None else QUANTUM_IN_SCENES
    residual = np.round((states - (here - lag * moved)) / quantum)
    arrays = {
        **_scene_arrays(path, scenes_of, get_task(task).base_scene),
        "plan": plan,
        "plan_length": np.array(plan_lengths, np.uint32),
        "residual": residual.astype(np.int16),
        "length": np.array(lengths, np.uint32),
        **{name: np.array(columns[name], _DEMO_ARRAYS[name][0]) for name in columns},
    }
    _check_format(path, DEMO_SCHEMA, arrays)
    parameters = {**parameters, "lag": lag}
    if quantum != QUANTUM:
        parameters["quantum"] = quantum
    _write(path, DEMO_SCHEMA, task, seed, arrays, made_by, parameters)


def subgoals(path):
    """Points along a path at most `SUBGOAL_SPACING` apart, every waypoint among them.

    Args:
        path: (n, 7), rad.

    Returns:
        float64 (m, 7), normalised; the first is the path's start, the last its goal.
    """
    return _all_subgoals(np.asarray(path), np.array([0, len(path)]))[0]


def _all_subgoals(plan, plan_offsets):
    """The sub-goals of all plans (k, 7), and the offsets (n + 1,) of each plan's first one."""
    waypoints = panda.normalise(plan.astype(np.float64))
    moves = np.diff(waypoints, axis=0)
    steps = np.ceil(np.sqrt(np.square(moves).sum(1)) / SUBGOAL_SPACING)
    steps = np.maximum(steps, 1).astype(np.int64)
    steps[plan_offsets[1:-1] - 1] = 1  # from the end of a plan to the start of the next
    move = np.repeat(np.arange(len(moves)), steps)
    first = np.concatenate([[0], np.cumsum(steps)])  # sub-goals before each waypoint
    share = (np.arange(len(move)) - first[move] + 1) / steps[move]
    points = np.concatenate([waypoints[:1], waypoints[move] + moves[move] * share[:, None]])
    return points, np.concatenate([first[plan_offsets[:-1]], [len(points)]])


def _schedule(plan, plan_offsets, offsets):
    """The sub-goal (m, 7) due at each executed configuration, the one before and the one after.

    The last one is repeated as long as the execution went on; so is the first, as `before`.
    """
    points, first = _all_subgoals(plan, plan_offsets)
    demo = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    step = np.arange(offsets[-1]) - offsets[demo]
    here = first[demo] + step
    low, high = first[demo], first[demo + 1] - 1
    return (points[np.clip(here + shift, low, high)] for shift in (-1, 0, 1))


def describe(demos):
    """Statistics of `Demos`: a dict of numbers.

    `steps`, `waypoints` and `path_length` (rad, sum of the joints' L2 displacements) are means;
    `steps_95` is the 95th percentile; `detour` the mean of path length over the straight line's, in
    the normalised space; `solved` the share of queries that had a demonstration within the allowed
    attempts.
    """
    moves = np.diff(demos.states.astype(np.float64), axis=0)
    inside = np.ones(len(moves), bool)
    inside[demos.offsets[1:-1] - 1] = False  # not from one demonstration to the next
    owner = np.repeat(np.arange(len(demos)), np.diff(demos.offsets))[:-1][inside]

    def length_of(displacements):
        lengths = np.linalg.norm(displacements[inside], axis=1)
        return np.bincount(owner, lengths, len(demos))

    straight = np.linalg.norm(panda.normalise(demos.goal) - panda.normalise(demos.start), axis=1)
    steps = np.diff(demos.offsets) - 1
    counts = demos.parameters.get("counts", {})
    return {
        "demonstrations": len(demos),
        "steps": float(steps.mean()),
        "steps_95": float(np.percentile(steps, 95)),
        "path_length": float(length_of(moves * (panda.UPPER - panda.LOWER) / 2).mean()),
        "detour": float((length_of(moves) / straight).mean()),
        "waypoints": float(np.diff(demos.plan_offsets).mean()),
        "touching": int(demos.collided.sum()),
        "solved": len(demos) / (len(demos) + counts.get("queries_given_up", 0)),
        **counts,
    }


def _main(arguments=None):
    parser = argparse.ArgumentParser(
        prog="python -m envs.datasets",
        description="The files of the tasks: queries and demonstrations.",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser(
        "validate",
        help="check query files",
        description="Check query files. One line on stdout for each good one, one on stderr for "
        "each bad one, saying what is wrong; exits with 1 if any is bad. (For demonstrations: "
        "python -m demo_generation.verify.)",
    )
    command.add_argument(
        "files", nargs="+", metavar="FILE", help="path of a file, or a task's name (its own file)"
    )
    command.add_argument("--task", choices=list(TASKS), help="the task the files must be for")
    command.add_argument(
        "--simulate",
        action="store_true",
        help="also check in the simulator that every start and goal is feasible (about 140 queries "
        "a second)",
    )
    command = commands.add_parser(
        "describe",
        help="statistics of demonstration files",
        description="Print statistics of demonstration files, one column per file.",
    )
    command.add_argument(
        "files", nargs="+", metavar="FILE", help="path of a file, or a task's name (its own file)"
    )
    options = parser.parse_args(arguments)
    run = {"validate": _main_validate, "describe": _main_describe}[options.command]
    return run(options)


def _main_validate(options):
    bad = False
    for file in options.files:
        try:
            path, task = _locate(file, query_path)
            queries = validate(path, options.task or task, options.simulate, progress=True)
        except ValueError as error:
            print(f"error: {error}", file=sys.stderr)
            bad = True
        else:
            test, validation = queries["test"], queries["validation"]
            counts = f"{len(test)} test and {len(validation)} validation queries"
            print(f"{path}: good, {counts} for {test.task}, seed {test.seed}")
    return int(bad)


def _main_describe(options):
    try:
        columns = [describe(load_demos(file)) for file in options.files]
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(" | ".join(["", *options.files]))
    for name in columns[0]:
        values = [column.get(name, 0) for column in columns]
        print(" | ".join([name, *(f"{v:.4g}" if isinstance(v, float) else str(v) for v in values)]))
    return 0


if __name__ == "__main__":
    sys.exit(_main())
