"""The HDF5 files of the tasks: queries (start and goal configurations), read, written, validated.

A query file, `envs/data/<task>.h5`, has two groups, `test` and `validation`, each with

- `start`, `goal`: float32 (n, 7), joint angles in rad, exactly those the simulator was asked about;
- `goal_position`: float32 (n, 3), the end-effector position at the goal in metres,

and the attributes `schema`, `schema_version`, `task`, `seed`, `scene` (JSON), `made_by` (the
command that makes the file again), `parameters` (JSON) and `checksum` (SHA-256 of all the others
and the arrays). Files are written to a temporary name and then renamed: there is never half a file.

    python -m envs.datasets validate envs/data/wall.h5 --simulate
"""

import argparse
import contextlib
import hashlib
import io
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from envs import panda, scenes
from envs.arm_env import HOLD_STEPS, RoboArmEnv
from envs.tasks import TASKS

SCHEMA = "roboarm-nmp queries"
SCHEMA_VERSION = 1
SPLITS = ("test", "validation")
_WIDTHS = {"start": 7, "goal": 7, "goal_position": 3}
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


@dataclass(frozen=True, eq=False)
class Queries:
    """Queries of one split. `queries[i]` is `(start, goal)`; a slice or index array, fewer queries.

    Attributes:
        task: name of the task they are for.
        split: `test` or `validation`.
        seed: of the command that made them.
        start: float32 (n, 7), rad.
        goal: float32 (n, 7), rad.
        goal_position: float32 (n, 3), end-effector position at the goal, m.
    """

    task: str
    split: str
    seed: int
    start: np.ndarray
    goal: np.ndarray
    goal_position: np.ndarray

    def __len__(self):
        return len(self.start)

    def __getitem__(self, index):
        start, goal, position = self.start[index], self.goal[index], self.goal_position[index]
        if start.ndim == 1:
            return start, goal
        return Queries(self.task, self.split, self.seed, start, goal, position)


def query_path(task):
    """Where the packaged query file of a task is (or belongs). Raises ValueError: unknown task."""
    if task not in TASKS:
        raise ValueError(f"unknown task {task!r}: one of {', '.join(TASKS)}")
    return Path(__file__).parent / "data" / f"{task}.h5"


def load_queries(task_or_path, split="test"):
    """The `Queries` of a task's packaged file, or of any query file.

    Args:
        task_or_path: name of a task, or path of a file.
        split: `test` or `validation`.

    Raises:
        DatasetError: the file is missing, corrupt, not a query file, or made for another task or
            for another version of the task's scene.
        ValueError: unknown split.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
    path, task = _locate(task_or_path)
    return _read(path, task)[0][split]


def write_queries(path, task, seed, splits, made_by, parameters):
    """Write a query file, atomically: at every moment `path` is the old file or the whole new one.

    The same arguments give the same bytes (same build of h5py; before 3.15 it adds time stamps).

    Args:
        path: file to write; an existing one is replaced.
        task: name of the task.
        seed: the seed the queries were made with, an int.
        splits: `{"test": (start, goal), "validation": (start, goal)}`, each float32 (n, 7), rad.
        made_by: the command line that makes this file.
        parameters: dict of whatever else determined the queries; must fit into JSON.

    Raises:
        DatasetError: arrays that a query file must not have; nothing is written then.
        ValueError: unknown task, or not exactly these splits.
        OSError: the file cannot be written; an old file is left as it was.
    """
    path = Path(path)
    query_path(task)  # refuses an unknown task
    if set(splits) != set(SPLITS):
        raise ValueError(f"splits must be {', '.join(SPLITS)}, got {', '.join(splits)}")
    arrays = {}
    for split in SPLITS:
        start, goal = splits[split]
        arrays[split] = {"start": np.asarray(start), "goal": np.asarray(goal)}
        _check_format(path, split, arrays[split])
    _check_values(path, arrays)
    for columns in arrays.values():
        position = panda.forward_kinematics(columns["goal"])
        columns["goal_position"] = position.astype(np.float32)
    attributes = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "task": task,
        "seed": int(seed),
        "scene": _scene_to_json(TASKS[task].scene),
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
        for split in SPLITS:
            group = file.create_group(split)
            for name, array in arrays[split].items():
                # Shuffled in one chunk, sign and exponent bytes compress: 13% off the file.
                group.create_dataset(
                    name,
                    data=array.astype("<f4"),
                    chunks=array.shape,
                    shuffle=True,
                    compression="gzip",
                    compression_opts=9,
                    track_times=False,
                )
    _write_atomically(path, contents.getbuffer())


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
    queries, parameters = _read(path, task)
    if simulate:
        _simulate(path, queries, parameters.get("hold_steps", HOLD_STEPS), progress)
    return queries


def _locate(task_or_path):
    """(path, task it must be for): `task_or_path` is a task's name or the path of any file."""
    if task_or_path in TASKS:
        return query_path(task_or_path), task_or_path
    return Path(task_or_path), None


def _write_atomically(path, contents):
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(contents)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _scene_to_json(scene):
    fields = {
        "obstacles": scenes.to_array(scene.obstacles).tolist(),
        "table": None if scene.table is None else scenes.to_array([scene.table])[0].tolist(),
        "floor": scene.floor,
    }
    return json.dumps(fields, sort_keys=True)


def _same_scene(one, other):
    """Whether two scenes (JSON) are equal up to rounding."""
    one, other = json.loads(one), json.loads(other)
    for field in ("obstacles", "table", "floor"):
        if one[field] is None or other[field] is None:
            if one[field] is not other[field]:
                return False
            continue
        a, b = np.array(one[field], dtype=float), np.array(other[field], dtype=float)
        if a.shape != b.shape or not np.allclose(a, b, rtol=0.0, atol=_SCENE_TOLERANCE):
            return False
    return True


def _checksum(attributes, arrays):
    """SHA-256 of the attributes, and of the names, shapes and contents of the arrays."""
    digest = hashlib.sha256(json.dumps(attributes, sort_keys=True).encode())
    for split in SPLITS:
        for name in _WIDTHS:
            array = arrays[split][name]
            digest.update(f"{split}/{name} {array.shape}".encode())
            digest.update(array.astype("<f4").tobytes())
    return digest.hexdigest()


def _check_format(path, split, arrays):
    """Shapes and dtypes of one split; `arrays` are NumPy arrays or HDF5 datasets, by name."""
    for name, array in arrays.items():
        if array.dtype != np.float32:
            raise DatasetError(f"{path}: {split}/{name} must be float32, is {array.dtype}")
        if array.ndim != 2 or array.shape[1] != _WIDTHS[name] or len(array) == 0:
            expected = f"(n, {_WIDTHS[name]}) with n > 0"
            raise DatasetError(
                f"{path}: {split}/{name} must have shape {expected}, has {array.shape}"
            )
        if len(array) != len(arrays["start"]):
            raise DatasetError(
                f"{path}: {split}/{name} has {len(array)} rows, not {len(arrays['start'])}"
            )


def _check_values(path, arrays):
    """Joint limits, finite numbers, and no query in both splits."""
    for split in SPLITS:
        for name, array in arrays[split].items():
            if not np.isfinite(array).all():
                raise DatasetError(f"{path}: {split}/{name} has numbers that are not finite")
        for name in ("start", "goal"):
            configuration = arrays[split][name]
            outside = (configuration < panda.LOWER) | (configuration > panda.UPPER)
            if outside.any():
                row = int(np.argmax(outside.any(axis=1)))
                raise DatasetError(f"{path}: {split}/{name}[{row}] is outside the joint limits")
    test, validation = (
        {row.tobytes() for row in np.hstack([arrays[split]["start"], arrays[split]["goal"]])}
        for split in SPLITS
    )
    if test & validation:
        raise DatasetError(f"{path}: {len(test & validation)} queries are in both splits")


def _read(path, task):
    """({split: Queries}, parameters) of a file, after every check that needs no simulator."""
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
            return _read_open(path, file, task)
    except DatasetError:
        raise
    except Exception as error:  # damaged HDF5 raises all kinds of exceptions
        raise DatasetError(f"{path}: truncated or corrupt HDF5 ({error})") from error


def _attribute(file, name):
    """An attribute of the file as a Python object; None if there is none."""
    value = file.attrs.get(name)
    value = value.item() if isinstance(value, np.generic) else value
    return value.decode() if isinstance(value, bytes) else value


def _read_open(path, file, task):
    attributes = {}
    for name, kind in _ATTRIBUTES.items():
        value = _attribute(file, name)
        if name == "schema" and value != SCHEMA:
            raise DatasetError(f"{path}: not a query file (schema {value!r}, not {SCHEMA!r})")
        if not isinstance(value, kind):
            raise DatasetError(f"{path}: attribute {name} is {value!r}, must be {kind.__name__}")
        if name == "schema_version" and value != SCHEMA_VERSION:
            raise DatasetError(f"{path}: schema version {value}, this code reads {SCHEMA_VERSION}")
        attributes[name] = value

    arrays = {}
    for split in SPLITS:
        datasets = {name: file.get(f"{split}/{name}") for name in _WIDTHS}
        for name, dataset in datasets.items():
            if not isinstance(dataset, h5py.Dataset):
                raise DatasetError(f"{path}: array {split}/{name} is missing or damaged")
        _check_format(path, split, datasets)
        arrays[split] = {name: dataset[()] for name, dataset in datasets.items()}
    if _attribute(file, "checksum") != _checksum(attributes, arrays):
        raise DatasetError(f"{path}: corrupt (the checksum does not match the contents)")

    made_for = attributes["task"]
    if task is not None and made_for != task:
        raise DatasetError(f"{path}: these queries are for the task {made_for!r}, not {task!r}")
    if made_for not in TASKS:
        raise DatasetError(f"{path}: these queries are for the unknown task {made_for!r}")
    if not _same_scene(attributes["scene"], _scene_to_json(TASKS[made_for].scene)):
        raise DatasetError(
            f"{path}: out of date: made for another version of the scene of {made_for!r}; "
            f"make it again with: {attributes['made_by']}"
        )
    _check_values(path, arrays)
    queries = {
        split: Queries(made_for, split, attributes["seed"], **arrays[split]) for split in SPLITS
    }
    return queries, json.loads(attributes["parameters"])


def _simulate(path, queries, hold_steps, progress):
    from tqdm import tqdm  # here, because nothing else in this module needs it

    for split in SPLITS:
        position = panda.forward_kinematics(queries[split].goal)
        off = np.linalg.norm(position - queries[split].goal_position, axis=1) > _POSITION_TOLERANCE
        if off.any():
            row = int(np.argmax(off))
            raise DatasetError(f"{path}: {split}/goal_position[{row}] is not where the goal is")
    env = RoboArmEnv(TASKS[queries["test"].task].scene)
    total = sum(len(queries[split]) for split in SPLITS)
    with (
        contextlib.closing(env),
        tqdm(total=total, unit=" queries", desc=Path(path).name, disable=not progress) as bar,
    ):
        for split in SPLITS:
            for row, (start, goal) in enumerate(queries[split]):
                for name, configuration in (("start", start), ("goal", goal)):
                    if not env.is_feasible(configuration, hold_steps):
                        raise DatasetError(f"{path}: {split}/{name}[{row}] is not feasible")
                bar.update()


def _main(arguments=None):
    parser = argparse.ArgumentParser(
        prog="python -m envs.datasets", description="The query files of the tasks."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser(
        "validate",
        help="check query files",
        description="Check query files. One line on stdout for each good one, one on stderr for "
        "each bad one, saying what is wrong; exits with 1 if any is bad.",
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
    options = parser.parse_args(arguments)
    bad = False
    for file in options.files:
        path, task = _locate(file)
        try:
            queries = validate(path, options.task or task, options.simulate, progress=True)
        except DatasetError as error:
            print(f"error: {error}", file=sys.stderr)
            bad = True
        else:
            test, validation = queries["test"], queries["validation"]
            counts = f"{len(test)} test and {len(validation)} validation queries"
            print(f"{path}: good, {counts} for {test.task}, seed {test.seed}")
    return int(bad)


if __name__ == "__main__":
    sys.exit(_main())
