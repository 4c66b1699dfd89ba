"""HDF5 files: written, read, and checked. Query and demonstration files, and their scenes.

docs/reference/file_formats.md describes the arrays and attributes. Files are written under a
temporary name and then renamed: there is never half a file.
"""

import contextlib
import fcntl
import functools
import hashlib
import io
import itertools
import json
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.motions import motion_from_numbers
from roboarm_nmp.envs.scenes.moving_boxes import MovingScenes
from roboarm_nmp.envs.scenes.primitives import (
    MAX_LENGTH,
    ROW,
    ConvexHull,
    Scene,
    check_obstacle,
    from_array,
    hull_vertices,
    motion_numbers,
    scene_from_json,
    scene_to_json,
    to_array,
    vertex_counts,
    with_may_touch,
    with_motion,
)
from roboarm_nmp.envs.scenes.wide_scenes.distribution import WideScenes
from roboarm_nmp.envs.tasks import (
    TASKS,
    TRAINING_SCENES,
    get_task,
    has_name,
    is_task,
    split_robot,
    task_name,
)
from roboarm_nmp.utils.files import write_atomically

SPLITS = ("test", "validation")
ORIGINAL = "original"  # split of queries that were not sampled; few tasks have it
QUERY_SCHEMA = "roboarm-nmp queries"
DEMO_SCHEMA = "roboarm-nmp demonstrations"
SCHEMA_VERSION = 1
MAX_ARRAY_BYTES = 2**30
"""Largest array in memory: 100,000 demonstrations have a fifth of that."""
MAY_BE_EMPTY = ("obstacles", "goals")  # scenes without any, problems with a goal pose
JOINTS = "joints"
# Of each array: dtype, numbers per row (None: one dimension; JOINTS: one per joint of the robot),
# and the array of the same length.
SCENE_ARRAYS = {
    "scene": ("<u4", None, None),
    "obstacle_count": ("<u4", None, "obstacle_count"),
    "obstacles": ("<f8", ROW, "obstacles"),
}
OPTIONAL_SCENE_ARRAYS = (
    {"hull_vertices": ("<f8", 3, "hull_vertices")},  # where there are convex hulls
    {"may_touch": ("<u1", None, "may_touch")},  # where obstacles have it
    {"motion_count": ("<u4", None, "obstacles"), "motions": ("<f8", None, "motions")},
)
SEED_ARRAYS = {"scene_seed": ("<u4", None, "start")}  # where scenes are drawn from seeds
QUERY_ARRAYS = {
    "start": ("<f4", JOINTS, "start"),
    "goal": ("<f4", JOINTS, "start"),
    "goal_position": ("<f4", 3, "start"),
}
DEMO_ARRAYS = {
    "plan": ("<f4", JOINTS, "plan"),
    "plan_length": ("<u4", None, "plan_length"),
    "residual": ("<i2", JOINTS, "residual"),
    "length": ("<u4", None, "plan_length"),
    "plan_seed": ("<u4", None, "plan_length"),
    "digest": ("<u4", None, "plan_length"),
    "collided": ("<u1", None, "plan_length"),
}
ATTRIBUTES = {
    "schema": str,
    "schema_version": int,
    "task": str,
    "seed": int,
    "scene": str,
    "made_by": str,
    "parameters": str,
}
"""Names and types of the attributes of query and demonstration files."""
# Scenes may differ by a rounding error between machines.
_SCENE_TOLERANCE = 1e-9


class DatasetError(ValueError):
    """A file that cannot be used. The message names the file and the error."""


class OutOfDateError(DatasetError):
    """A file that was made for another version of its task's scene."""


def array_formats(schema: str, names: Any) -> dict[str, tuple]:
    """The formats of a file's arrays: required ones, and the optional ones that are in `names`."""
    if schema == DEMO_SCHEMA:
        return _with_scenes(DEMO_ARRAYS, "plan_length", names)
    formats = {}
    for split in (*SPLITS, ORIGINAL):
        if split in SPLITS or f"{split}/start" in names:
            arrays = dict(QUERY_ARRAYS)
            if f"{split}/scene_seed" in names and f"{split}/goal_position" not in names:
                del arrays["goal_position"]  # which follows from the goal
            formats.update(_with_scenes(arrays, "start", names, f"{split}/"))
    return formats


def _with_scenes(arrays, rows_of, names, prefix=""):
    """The formats of arrays and of those of their scenes. The names begin with `prefix`."""
    formats = dict(arrays)
    if f"{prefix}scene" in names:
        formats.update(SCENE_ARRAYS)
        formats["scene"] = ("<u4", None, rows_of)
        for optional in OPTIONAL_SCENE_ARRAYS:
            if prefix + next(iter(optional)) in names:
                formats.update(optional)
    if f"{prefix}scene_seed" in names:
        formats.update(SEED_ARRAYS)
    return {
        prefix + name: (dtype, width, prefix + sibling)
        for name, (dtype, width, sibling) in formats.items()
    }


def offsets_of(lengths: np.ndarray | list[int]) -> np.ndarray:
    """Where parts of these lengths (n,) begin in a flat array: int64 (n + 1,), the end included."""
    return np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])


# --- Scenes of queries and demonstrations


@dataclass(frozen=True, eq=False)
class QueryScenes:
    """The scenes of n queries: `scenes[i]` is the `Scene` of query i, made on access.

    Attributes:
        base: the `Scene` without the obstacles that vary; the scene itself, if none do.
        index: int64 (n,), the number of each query's scene; None if all have the same scene.
        offsets: int64 (s + 1,): the obstacles of scene j are `rows[offsets[j] : offsets[j + 1]]`.
        rows: float64 (k, 11), as of `envs.scenes.primitives.to_array`.
        vertices: float64 (v, 3), as of `envs.scenes.primitives.hull_vertices`.
        may_touch: a list, `may_touch` of each of the k obstacles; None if it is () for all.
        motions: None, or the two arrays of `envs.scenes.primitives.motion_numbers`.
    """

    base: Scene
    index: np.ndarray | None = None
    offsets: np.ndarray = field(default_factory=lambda: np.zeros(1, np.int64))
    rows: np.ndarray = field(default_factory=lambda: np.empty((0, ROW)))
    vertices: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    may_touch: list | None = None
    motions: tuple[np.ndarray, np.ndarray] | None = None

    @functools.cached_property
    def _vertex_offsets(self):
        """The vertices of row j begin at this number."""
        return offsets_of(vertex_counts(self.rows))

    @functools.cached_property
    def _motion_offsets(self):
        """The numbers of the motion of row j begin at this number."""
        assert self.motions is not None
        return offsets_of(self.motions[1])

    def __getitem__(self, i: int) -> Scene:
        if self.index is None:
            return self.base
        first, last = self.offsets[self.index[i] :][:2]
        begin, end = self._vertex_offsets[[first, last]]
        obstacles = from_array(self.rows[first:last], self.vertices[begin:end])
        if self.may_touch is not None:
            obstacles = with_may_touch(obstacles, self.may_touch[first:last])
        if self.motions is not None:
            ends = self._motion_offsets[first : last + 1]
            numbers = [self.motions[0][a:b] for a, b in itertools.pairwise(ends)]
            obstacles = tuple(map(with_motion, obstacles, numbers))
        return replace(self.base, obstacles=obstacles)

    def take(self, chosen: slice | np.ndarray) -> "QueryScenes":
        """The scenes of fewer queries, by slice or index array."""
        return replace(self, index=None if self.index is None else self.index[chosen])


@dataclass(frozen=True, eq=False)
class SeededScenes:
    """The scenes of n queries, drawn from a seed each, on access.

    Attributes:
        distribution: the scenes' distribution, for a robot with j joints; with `animate`, the
            obstacles move.
        seeds: uint32 (n,).
        start, goal: float32 (n, j), rad, of the queries.
    """

    distribution: MovingScenes | WideScenes
    seeds: np.ndarray
    start: np.ndarray
    goal: np.ndarray

    @property
    def base(self) -> Scene:
        """The `Scene` without the obstacles that vary."""
        return self.distribution.base

    def __getitem__(self, i: int) -> Scene:
        at_rest, motions = scene_seeds(self.seeds[i])
        scene = self.distribution.sample(np.random.default_rng(at_rest))
        if not isinstance(self.distribution, MovingScenes):
            return scene
        rng = np.random.default_rng(motions)
        return self.distribution.animate(scene, self.start[i], self.goal[i], rng)

    def take(self, chosen: slice | np.ndarray) -> "SeededScenes":
        """As `QueryScenes.take`."""
        return SeededScenes(
            self.distribution, self.seeds[chosen], self.start[chosen], self.goal[chosen]
        )

    def summary(self) -> list[float]:
        """Numbers that tell scenes of another version of the distribution from these.

        The sums of all numbers of the first query's obstacles, at several times.
        """
        scene = self[0]
        return [float(to_array(scene.at(t).obstacles).sum()) for t in (0.0, 1.0, 3.0, 6.0)]


def scene_seeds(seed: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """The seeds of a scene at rest, and of its motions, from a seed of `SeededScenes`."""
    return (int(seed), 0), (int(seed), 1)


def scene_arrays(
    path: str | Path, scenes: Iterable[Scene] | SeededScenes | None, base: Scene, prefix: str = ""
) -> dict[str, np.ndarray]:
    """Arrays for a sequence of `Scene`s, equal ones stored once; none for None."""
    if scenes is None:
        return {}
    if isinstance(scenes, SeededScenes):
        return {f"{prefix}scene_seed": scenes.seeds}
    number_of = {}  # scene -> its number, in the order of their first use
    index = [number_of.setdefault(scene, len(number_of)) for scene in scenes]
    for scene in number_of:
        if replace(scene, obstacles=()) != replace(base, obstacles=()):
            raise DatasetError(
                f"{path}: {prefix}scene differs from the task's in more than its obstacles"
            )
    obstacles = [obstacle for scene in number_of for obstacle in scene.obstacles]
    counts = [len(scene.obstacles) for scene in number_of]
    arrays = {
        f"{prefix}scene": np.array(index, np.uint32),
        f"{prefix}obstacle_count": np.array(counts, np.uint32),
        f"{prefix}obstacles": to_array(obstacles),
    }
    vertices = hull_vertices(obstacles)
    if len(vertices):
        arrays[f"{prefix}hull_vertices"] = vertices
    if any(obstacle.may_touch for obstacle in obstacles):
        arrays[f"{prefix}may_touch"] = json_array([obstacle.may_touch for obstacle in obstacles])
    numbers, counts = motion_numbers(obstacles)
    if len(numbers):
        arrays[f"{prefix}motion_count"] = counts
        arrays[f"{prefix}motions"] = numbers
    return arrays


def read_scenes(
    path: str | Path, base: Scene, arrays: dict[str, np.ndarray], prefix: str = ""
) -> QueryScenes:
    """The inverse of `scene_arrays`. Raises DatasetError for invalid arrays."""
    if f"{prefix}scene" not in arrays:
        return QueryScenes(base)
    index = arrays[f"{prefix}scene"]
    offsets = offsets_of(arrays[f"{prefix}obstacle_count"])
    rows = arrays[f"{prefix}obstacles"]
    if offsets[-1] != len(rows) or index.max() >= len(offsets) - 1:
        raise DatasetError(f"{path}: {prefix}scene does not fit the number of scenes or obstacles")
    vertices = arrays.get(f"{prefix}hull_vertices", np.empty((0, 3)))
    may_touch = None
    try:
        obstacles = from_array(rows, vertices)
        if f"{prefix}may_touch" in arrays:
            may_touch = json.loads(arrays[f"{prefix}may_touch"].tobytes())
            obstacles = with_may_touch(obstacles, may_touch)
        for obstacle in obstacles:
            base.robot.links_called(obstacle.may_touch)
            if isinstance(obstacle, ConvexHull):
                check_obstacle(obstacle)
    except (RecursionError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: {prefix}obstacles: {error}") from error
    if not np.isfinite(rows).all():
        raise DatasetError(f"{path}: {prefix}obstacles has numbers that are not finite")
    if len(rows) and not (rows[:, 8:].min() > 0 and np.abs(rows).max() <= MAX_LENGTH):
        raise DatasetError(
            f"{path}: {prefix}obstacles has sizes that are not positive, or too large"
        )
    motions = None
    if f"{prefix}motion_count" in arrays:
        motions = arrays[f"{prefix}motions"], arrays[f"{prefix}motion_count"]
        ends = offsets_of(motions[1]).tolist()
        if ends[-1] != len(motions[0]):
            raise DatasetError(f"{path}: {prefix}motion_count does not fit {prefix}motions")
        try:
            for first, last in itertools.pairwise(ends):
                motion_from_numbers(motions[0][first:last])
        except ValueError as error:
            raise DatasetError(f"{path}: {prefix}motions: {error}") from error
    return QueryScenes(base, index.astype(np.int64), offsets, rows, vertices, may_touch, motions)


def read_base_scene(path: str | Path, text: str, robot: Robot) -> Scene:
    """The `Scene` without the obstacles that vary, from a file's attribute `scene`.

    Args:
        path: the file.
        text: the attribute, of `scene_to_json`.
        robot: the `Robot` for which the file must have been made.

    Raises DatasetError: it was made for another one.
    """
    name, fingerprint = json.loads(text).get("robot", (PANDA.name, PANDA.fingerprint))
    check_robot(path, name, fingerprint, robot.arm)
    return scene_from_json(text, robot.arm)


def check_robot(path: str | Path, name: str, fingerprint: str, arm: Robot) -> None:
    """Raise DatasetError unless a file's robot, by its name and fingerprint, is this arm."""
    if fingerprint == arm.fingerprint:
        return
    hint = ""
    if name == arm.name:
        hint = ": its description is another one, so make the file again"
    elif arm == PANDA:
        hint = ": name the robot's file, as TASK@FILE"
    raise DatasetError(
        f"{path}: made for the robot {name!r} ({fingerprint[:12]}), not for {arm.name!r} "
        f"({arm.fingerprint[:12]}){hint}"
    )


def _is_close(one, other):
    """Whether two values of JSON are equal up to rounding. A missing entry of a dict is None."""
    if isinstance(one, dict) and isinstance(other, dict):
        return all(_is_close(one.get(key), other.get(key)) for key in {*one, *other})
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_is_close, one, other))
    if isinstance(one, (int, float)) and isinstance(other, (int, float)):
        return abs(one - other) <= _SCENE_TOLERANCE
    return one == other


# --- Files of tasks


def task_file(task: str | Path, folder: str, suffix: str) -> Path:
    """The path of a task's file in a folder of `datasets`, or beside a scene or robot's file.

    Raises:
        ValueError: there is no such task.
        DatasetError: no files are made for this one.
    """
    get_task(task)  # rejects an unknown task
    name, robot = split_robot(task)
    if name in TRAINING_SCENES:
        raise DatasetError(
            f"{name} are scenes for training: there are no queries or demonstrations in them"
        )
    if robot is None and has_name(name):
        return Path(__file__).parent / folder / f"{name}.h5"
    beside = robot if robot is not None and has_name(name) else name
    return Path(beside).with_name(task_name(task) + suffix)


def locate(
    task_or_path: str | Path, path_of_task: Callable[[str], Path]
) -> tuple[Path, str | None]:
    """(path, task it must be for): `task_or_path` is a task, or the path of any file.

    Raises DatasetError: no files are made for this task.
    """
    if is_task(task_or_path):
        task = str(task_or_path)
        return path_of_task(task), task
    return Path(task_or_path), None


def write_file(
    path: str | Path,
    schema: str,
    task: str | Path,
    seed: int,
    arrays: dict[str, np.ndarray],
    made_by: str,
    parameters: dict,
) -> None:
    """Write checked arrays, by name, as a file of a schema. For the rest, see `write_queries`."""
    formats = array_formats(schema, arrays)
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
    datasets = []
    for name, array in arrays.items():
        # Shuffled in one chunk, sign and exponent bytes compress: 13% off a query file.
        options = {"shuffle": True, "compression": "gzip", "compression_opts": 9}
        options["chunks"] = array.shape
        # Neighbours in a column are alike: 37% off obstacles, a quarter off executions.
        if name.endswith("obstacles") or name == "residual":
            options["shuffle"] = False
            options["chunks"] = (len(array), 1)
        datasets.append((name, array, options))
    attributes["checksum"] = checksum(attributes, arrays)
    write_atomically(path, hdf5_bytes(attributes, datasets))


def check_format(
    path: str | Path, formats: dict[str, tuple], arrays: dict[str, Any], robot: Robot
) -> None:
    """Raise DatasetError unless NumPy arrays or HDF5 datasets have these shapes and dtypes."""
    for name, array in arrays.items():
        dtype, width, sibling = formats[name]
        width = robot.num_joints if width == JOINTS else width
        if array.dtype != np.dtype(dtype):
            raise DatasetError(f"{path}: {name} must be {np.dtype(dtype)}, is {array.dtype}")
        empty = array.size == 0 and name.rpartition("/")[2] not in MAY_BE_EMPTY
        if array.shape[1:] != (() if width is None else (width,)) or empty:
            expected = "(n,)" if width is None else f"(n, {width})"
            raise DatasetError(
                f"{path}: {name} must have shape {expected} with n > 0, has {array.shape}"
            )
        if len(array) != len(arrays[sibling]):
            raise DatasetError(f"{path}: {name} has {len(array)} rows, not {len(arrays[sibling])}")


def read_file(
    path: str | Path, schema: str, task: str | Path | None
) -> tuple[dict[str, Any], dict[str, np.ndarray], Scene]:
    """(attributes, arrays, base scene) of a file, after the checks that both kinds share.

    `task`: the task that it must be for; None for any of the Panda.
    """
    robot = get_task(task).base_scene.robot if task else PANDA
    if not os.path.exists(path):
        hint = _command_for(schema, task) if task else " or task"
        raise DatasetError(f"{path}: no such file{hint}")
    with open_hdf5(path) as file:
        return _read_open(path, file, schema, task, robot)


def _command_for(schema, task):
    """The command that makes a task's file, for a message; nothing where there is none."""
    if schema == DEMO_SCHEMA and not get_task(task).trainable:
        return ""
    command = "queries" if schema == QUERY_SCHEMA else "collect"
    return f"; make it with: roboarm {command} --task {task}"


def _read_open(path, file, schema, task, robot):
    contents = "a query file" if schema == QUERY_SCHEMA else "a demonstration file"
    check_schema(path, file, contents, schema, SCHEMA_VERSION)
    attributes = read_attributes(path, file, ATTRIBUTES)
    made_for = attributes["task"]
    if task is not None and made_for != task_name(task):
        raise DatasetError(
            f"{path}: this file is for the task {made_for!r}, not {task_name(task)!r}"
        )
    base = read_base_scene(path, attributes["scene"], robot)
    check_plain(path, file)
    formats = array_formats(schema, file)
    datasets = {name: get_array(path, file, name) for name in formats}
    check_format(path, formats, datasets, robot)
    arrays = {name: dataset[()] for name, dataset in datasets.items()}
    check_checksum(path, file, attributes, arrays)
    if not isinstance(json.loads(attributes["parameters"]), dict):
        raise DatasetError(f"{path}: attribute parameters is not a dict")
    if task is None and made_for in TASKS:
        task = made_for
    # Where the scene file is not at hand, the scene is that of this file.
    if task is not None:
        current = scene_to_json(get_task(task).base_scene)
        if not _is_close(json.loads(attributes["scene"]), json.loads(current)):
            flag = " --overwrite" if schema == DEMO_SCHEMA else ""
            raise OutOfDateError(
                f"{path}: out of date: made for another version of the scene of {made_for!r}; "
                f"make it again with: {attributes['made_by']}{flag}"
            )
    return attributes, arrays, base


def check_configurations(
    path: str | Path, name: str, configurations: np.ndarray, robot: Robot
) -> None:
    """Raise DatasetError unless configurations (n, j), rad, are finite and inside the limits."""
    if not np.isfinite(configurations).all():
        raise DatasetError(f"{path}: {name} has numbers that are not finite")
    outside = (configurations < robot.lower) | (configurations > robot.upper)
    if outside.any():
        row = int(np.argmax(outside.any(axis=1)))
        raise DatasetError(f"{path}: {name}[{row}] is outside the joint limits")


# --- HDF5, of all kinds of files


def hdf5_bytes(
    attributes: dict[str, str | int], datasets: Iterable[tuple[str, np.ndarray, dict]]
) -> bytes:
    """The contents of an HDF5 file.

    Args:
        attributes: of the file, by name.
        datasets: of each array its name, the array, and options of `h5py.Group.create_dataset`,
            which an empty array is written without.
    """
    # HDF5 crashes the process on damaged metadata in its oldest format and in strings of variable
    # length (h5py's default). Newer formats have checksums of metadata, which include fixed-length
    # strings. The file is made in memory because HDF5 also crashes when the disk is full.
    contents = io.BytesIO()
    with h5py.File(contents, "w", libver=("v110", "v110")) as file:
        for name, value in attributes.items():
            file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value
        for name, array, options in datasets:
            if not array.size:
                options = {}
            file.create_dataset(name, data=array, track_times=False, **options)
    return contents.getvalue()


def json_array(value: Any) -> np.ndarray:
    """A value as JSON in bytes: uint8 (n,)."""
    return np.frombuffer(json.dumps(value).encode(), np.uint8)


@contextlib.contextmanager
def open_hdf5(path: str | Path) -> Iterator[h5py.File]:
    """A context with an `h5py.File` to read.

    Raises DatasetError: the file is missing, no HDF5 file or damaged. Damage may also be found
    later, in the context, where HDF5 raises all kinds of exceptions.
    """
    try:
        with open(path, "rb"):
            pass
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}") from error
    if not h5py.is_hdf5(path):
        _check_not_in_use(path)
        raise DatasetError(f"{path}: not an HDF5 file: name a query or demonstration file (.h5)")
    try:
        # Our files are replaced as a whole, so they need no locks, which not every file system has.
        with h5py.File(path, "r", locking=False) as file:
            yield file
    except Exception as error:
        _check_not_in_use(path)
        if isinstance(error, DatasetError):
            raise
        if "already open for write" in str(error):
            raise DatasetError(
                f"{path}: the program that wrote it was killed before it closed it: write it "
                f"again, or try `h5clear -s {path}`"
            ) from error
        raise DatasetError(
            f"{path}: truncated or corrupt HDF5 ({error}): copy it again, or make it again"
        ) from error


def _check_not_in_use(path):
    """Raise DatasetError if another program has a file open for writing: HDF5 locks it then."""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DatasetError(
                f"{path}: another program has it open for writing; read it when that has ended"
            ) from error


def attribute(file: h5py.File, name: str) -> Any:
    """An attribute of the file as a Python object; None if there is none."""
    value = file.attrs.get(name)
    value = value.item() if isinstance(value, np.generic) else value
    return value.decode() if isinstance(value, bytes) else value


def check_schema(
    path: str | Path, file: h5py.File, contents: str, schema: str, version: int
) -> None:
    """Raise DatasetError unless a file has a schema, for example of "a query file"."""
    stored = attribute(file, "schema")
    if stored != schema:
        raise DatasetError(f"{path}: not {contents} (schema {stored!r}, not {schema!r})")
    stored = attribute(file, "schema_version")
    if stored != version:
        raise DatasetError(f"{path}: schema version {stored}, this code reads {version}")


def read_attributes(path: str | Path, file: h5py.File, types: dict[str, type]) -> dict[str, Any]:
    """Attributes by name. Raises DatasetError unless they have these types."""
    attributes = {}
    for name, kind in types.items():
        value = attribute(file, name)
        if not isinstance(value, kind):
            raise DatasetError(f"{path}: attribute {name} is {value!r}, must be {kind.__name__}")
        attributes[name] = value
    return attributes


def get_array(path: str | Path, file: h5py.File, name: str) -> h5py.Dataset:
    """An array of the file, which is not read yet. Raises DatasetError: there is none."""
    dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise DatasetError(f"{path}: array {name} is missing or damaged")
    return dataset


def check_plain(path: str | Path, group: h5py.Group) -> None:
    """Raise DatasetError for links, for arrays outside the file, and for too large arrays.

    A file of a few kB can refer to other files, or declare arrays larger than the memory.
    """
    for name in group:
        where = f"{path}: {str(group.name).rstrip('/')}/{name}"
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise DatasetError(f"{where} is a link, which is never followed")
        member = group[name]
        if isinstance(member, h5py.Group):
            check_plain(path, member)
            continue
        if not isinstance(member, h5py.Dataset) or member.external or member.is_virtual:
            raise DatasetError(f"{where} is not an array in this file")
        if member.size * member.dtype.itemsize > MAX_ARRAY_BYTES:
            raise DatasetError(f"{where} has {member.shape} numbers: too many")
        if member.size and not member.id.get_storage_size():
            raise DatasetError(f"{where} was never written")


def checksum(attributes: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 of the attributes, and of the names, shapes and contents of the arrays."""
    digest = hashlib.sha256(json.dumps(attributes, sort_keys=True).encode())
    for name, array in arrays.items():
        digest.update(f"{name} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def check_checksum(
    path: str | Path, file: h5py.File, attributes: dict[str, Any], arrays: dict[str, np.ndarray]
) -> None:
    """Raise DatasetError unless the contents of a file have the checksum that is in it."""
    if attribute(file, "checksum") != checksum(attributes, arrays):
        raise DatasetError(f"{path}: corrupt (the checksum does not match the contents)")
