"""The HDF5 format that query and demonstration files share: written, read, and checked.

A query file, `datasets/data/<task>.h5`, has the groups `test` and `validation`, and `original`
where a task has queries from elsewhere, each with

- `start`, `goal`: float32 (n, j), joint angles in rad, exactly those checked in the simulator;
- `goal_position`: float32 (n, 3), the end-effector position at the goal in metres,
- where scenes vary, `scene`: uint32 (n,), the number of each query's scene, `obstacle_count`:
  uint32 (s,), obstacles in each scene, and `obstacles`: float64 (k, 11), the obstacles of all
  scenes, one scene after another, as rows of `envs.scenes.primitives.to_array`; where there are
  convex hulls, `hull_vertices`: float64 (v, 3), their vertices, one hull after another; where there
  are obstacles with `may_touch`, that of all k obstacles: uint8 (b,), a list as JSON; where
  obstacles move, `motion_count`: uint32 (k,), how many numbers each one's motion has, and
  `motions`: float64 (m,), the numbers (`envs.scenes.motions.motion_to_numbers`);
- of tasks with moving obstacles, instead of these, `scene_seed`: uint32 (n,), from which each
  query's scene is drawn (`AnimatedScenes`).

A demonstration file, `datasets/demos/<task>.h5`, has the arrays

- `plan`: float32 (p, j), joint angles in rad: the waypoints of all plans, one plan after another,
  the first one of each the start, the last one the goal; `plan_length`: uint32 (n,);
- `residual`: int16 (m, j), the executed configurations, one execution after another (see
  `datasets.demonstrations.write_demos`); `length`: uint32 (n,), configurations in each;
- `plan_seed`, `digest`: uint32 (n,), the planner's seed and the CRC-32 of the exact execution;
- `collided`: uint8 (n,), whether the execution has a contact;
- where scenes vary, `scene`, `obstacle_count`, `obstacles`, `hull_vertices`, `may_touch`, as above.

j is the number of the robot's joints, 7 of the Panda.

Both have the attributes `schema`, `schema_version`, `task`, `seed`, `scene` (JSON: the scene,
without the obstacles that vary; it has the name and fingerprint of a robot, if that is not the
Panda), `made_by` (the command that makes the file again), `parameters` (JSON) and `checksum`
(SHA-256 of all the others and the arrays). Files are written under a temporary name and then
renamed: there is never half a file.
"""

import hashlib
import io
import itertools
import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.motions import motion_from_numbers
from roboarm_nmp.envs.scenes.primitives import (
    MAX_LENGTH,
    ROW,
    ConvexHull,
    check_obstacle,
    from_array,
    hull_vertices,
    motion_numbers,
    scene_from_json,
    scene_to_json,
    split_list,
    to_array,
    vertex_counts,
    with_may_touch,
    with_motion,
)
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
QUERY_SCHEMA, DEMO_SCHEMA = "roboarm-nmp queries", "roboarm-nmp demonstrations"
SCHEMA_VERSION = 1
MAX_ARRAY_BYTES = 2**30
"""Largest array in memory: 100,000 demonstrations have a fifth of that."""
JOINTS = "joints"
# Of each array: dtype, numbers per row (None: one dimension; JOINTS: one per joint of the robot),
# and the array of the same length.
SCENE_ARRAYS = {
    "scene": ("<u4", None, None),
    "obstacle_count": ("<u4", None, "obstacle_count"),
    "obstacles": ("<f8", ROW, "obstacles"),
}
SEED_ARRAYS = {"scene_seed": ("<u4", None, "start")}  # where obstacles move
HULL_ARRAYS = {"hull_vertices": ("<f8", 3, "hull_vertices")}  # where there are convex hulls
TOUCH_ARRAYS = {"may_touch": ("<u1", None, "may_touch")}  # where obstacles have it
MOTION_ARRAYS = {  # where obstacles move
    "motion_count": ("<u4", None, "obstacles"),
    "motions": ("<f8", None, "motions"),
}
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


def array_formats(schema, names):
    """The formats of a file's arrays: required ones, and optional ones if `names` has the first."""

    def with_scenes(arrays, rows_of, prefix=""):
        if f"{prefix}scene" in names:
            arrays = {**arrays, **SCENE_ARRAYS, "scene": ("<u4", None, rows_of)}
            if f"{prefix}hull_vertices" in names:
                arrays |= HULL_ARRAYS
            if f"{prefix}may_touch" in names:
                arrays |= TOUCH_ARRAYS
            if f"{prefix}motion_count" in names:
                arrays |= MOTION_ARRAYS
        if f"{prefix}scene_seed" in names:
            arrays = {**arrays, **SEED_ARRAYS}
        return {
            prefix + name: (dtype, width, prefix + sibling)
            for name, (dtype, width, sibling) in arrays.items()
        }

    if schema == DEMO_SCHEMA:
        return with_scenes(DEMO_ARRAYS, "plan_length")
    arrays = {}
    for split in (*SPLITS, *(ORIGINAL,) * (f"{ORIGINAL}/start" in names)):
        arrays |= with_scenes(QUERY_ARRAYS, "start", f"{split}/")
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
# Scenes may differ by a rounding error between machines.
_SCENE_TOLERANCE = 1e-9


class DatasetError(ValueError):
    """A file that cannot be used. The message names the file and the error."""


class OutOfDateError(DatasetError):
    """A file that was made for another version of its task's scene."""


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

    def __init__(
        self, base, index=None, offsets=None, rows=None, vertices=(), may_touch=None, motions=None
    ):
        self.base, self.index, self.offsets, self.rows = base, index, offsets, rows
        self.vertices, self.may_touch, self.motions = vertices, may_touch, motions
        if motions is not None:  # the numbers of row j begin at number `_motion_offsets[j]`
            counts = motions[1].astype(np.int64)
            self._motion_offsets = np.concatenate([[0], np.cumsum(counts)])
        if rows is not None:  # the vertices of row j begin at number `_vertex_offsets[j]`
            self._vertex_offsets = np.concatenate([[0], np.cumsum(vertex_counts(rows))])

    def __getitem__(self, i):
        if self.index is None:
            return self.base
        first, last = self.offsets[self.index[i] :][:2]
        begin, end = self._vertex_offsets[[first, last]]
        obstacles = from_array(self.rows[first:last], self.vertices[begin:end])
        if self.may_touch is not None:
            obstacles = with_may_touch(obstacles, self.may_touch[first:last])
        if self.motions is not None:
            ends = self._motion_offsets[first : last + 1]
            numbers = [self.motions[0][i:j] for i, j in itertools.pairwise(ends)]
            obstacles = map(with_motion, obstacles, numbers)
        return replace(self.base, obstacles=obstacles)

    def take(self, which):
        """The scenes of fewer queries, by slice or index array."""
        index = None if self.index is None else self.index[which]
        rest = self.offsets, self.rows, self.vertices, self.may_touch, self.motions
        return QueryScenes(self.base, index, *rest)


class AnimatedScenes:
    """The scenes of n queries with moving obstacles: drawn from a seed each, on access.

    Attributes:
        distribution: an `envs.scenes.moving_boxes.MovingScenes`, whose robot has j joints.
        seeds: uint32 (n,).
        start, goal: float32 (n, j), rad, of the queries.
    """

    def __init__(self, distribution, seeds, start, goal):
        self.distribution, self.base = distribution, distribution.base
        self.seeds, self.start, self.goal = seeds, start, goal

    def __getitem__(self, i):
        rest, motions = map(np.random.default_rng, scene_seeds(self.seeds[i]))
        scene = self.distribution.sample(rest)
        return self.distribution.animate(scene, self.start[i], self.goal[i], motions)

    def take(self, which):
        """As `QueryScenes.take`."""
        given = self.seeds[which], self.start[which], self.goal[which]
        return AnimatedScenes(self.distribution, *given)

    def summary(self):
        """Numbers (JSON-ready) that tell scenes of another version of the distribution from these.

        The sums of all numbers of the first query's obstacles, at several times.
        """
        times, scene = (0.0, 1.0, 3.0, 6.0), self[0]
        return [float(to_array(scene.at(t).obstacles).sum()) for t in times]


def scene_seeds(seed):
    """The seeds of a scene at rest, and of its motions, from a seed of `AnimatedScenes`."""
    return (int(seed), 0), (int(seed), 1)


def task_file(task, folder, suffix):
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
    if has_name(name) and robot is None:
        return Path(__file__).parent / folder / f"{name}.h5"
    return Path(robot if has_name(name) else name).with_name(task_name(task) + suffix)


def locate(task_or_path, path_of_task):
    """(path, task it must be for): `task_or_path` is a task, or the path of any file.

    Raises DatasetError: no files are made for this task.
    """
    if is_task(task_or_path):
        return path_of_task(task_or_path), task_or_path
    return Path(task_or_path), None


def write_file(path, schema, task, seed, arrays, made_by, parameters):
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
    # HDF5 crashes the process on damaged metadata in its oldest format and in strings of variable
    # length (h5py's default). Newer formats have checksums of metadata, which include fixed-length
    # strings. The file is made in memory because HDF5 also crashes when the disk is full.
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


def scene_arrays(path, scenes_of, base, prefix=""):
    """Arrays for a sequence of `Scene`s, equal ones stored once; none for None."""
    if scenes_of is None:
        return {}
    if isinstance(scenes_of, AnimatedScenes):
        return {f"{prefix}scene_seed": scenes_of.seeds}
    numbers = {}  # scene -> its number, in the order of their first use
    index = [numbers.setdefault(scene, len(numbers)) for scene in scenes_of]
    for scene in numbers:
        if replace(scene, obstacles=()) != replace(base, obstacles=()):
            raise DatasetError(
                f"{path}: {prefix}scene differs from the task's in more than its obstacles"
            )
    obstacles = [o for s in numbers for o in s.obstacles]
    arrays = {
        f"{prefix}scene": np.array(index, np.uint32),
        f"{prefix}obstacle_count": np.array([len(s.obstacles) for s in numbers], np.uint32),
        f"{prefix}obstacles": to_array(obstacles),
    }
    if len(vertices := hull_vertices(obstacles)):
        arrays[f"{prefix}hull_vertices"] = vertices
    if any(obstacle.may_touch for obstacle in obstacles):
        text = json.dumps([obstacle.may_touch for obstacle in obstacles])
        arrays[f"{prefix}may_touch"] = np.frombuffer(text.encode(), np.uint8)
    numbers, counts = motion_numbers(obstacles)
    if len(numbers):
        arrays |= {f"{prefix}motion_count": counts, f"{prefix}motions": numbers}
    return arrays


def read_scenes(path, base, arrays, prefix=""):
    """The inverse of `scene_arrays`: `QueryScenes`. Raises DatasetError for invalid arrays."""
    if f"{prefix}scene" not in arrays:
        return QueryScenes(base)
    index, counts, rows = (arrays[f"{prefix}{name}"] for name in SCENE_ARRAYS)
    offsets = np.concatenate([[0], np.cumsum(counts.astype(np.int64))])
    if offsets[-1] != len(rows) or index.max() >= len(counts):
        raise DatasetError(f"{path}: {prefix}scene does not fit the number of scenes or obstacles")
    vertices = arrays.get(f"{prefix}hull_vertices", np.empty((0, 3)))
    try:
        obstacles, may_touch = from_array(rows, vertices), None
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
        if motions[1].sum(dtype=np.int64) != len(motions[0]):
            raise DatasetError(f"{path}: {prefix}motion_count does not fit {prefix}motions")
        ends = np.concatenate([[0], np.cumsum(motions[1].astype(np.int64))])
        try:
            for first, last in itertools.pairwise(ends.tolist()):
                motion_from_numbers(motions[0][first:last])
        except ValueError as error:
            raise DatasetError(f"{path}: {prefix}motions: {error}") from error
    rest = offsets, rows, vertices, may_touch, motions
    return QueryScenes(base, index.astype(np.int64), *rest)


def read_base_scene(path, text, robot):
    """The `Scene` without the obstacles that vary, from a file's attribute `scene`.

    Args:
        path: the file.
        text: the attribute, of `scene_to_json`.
        robot: the `Robot` for which the file must have been made.

    Raises DatasetError: it was made for another one.
    """
    name, fingerprint = json.loads(text).get("robot", (PANDA.name, PANDA.fingerprint))
    robot = robot.arm
    if fingerprint != robot.fingerprint:
        hint = ""
        if name == robot.name:
            hint = ": its description is another one, so make the file again"
        elif robot == PANDA:
            hint = ": name the robot's file, as TASK@ROBOT or --robot"
        raise DatasetError(
            f"{path}: made for the robot {name!r} ({fingerprint[:12]}), not for {robot.name!r} "
            f"({robot.fingerprint[:12]}){hint}"
        )
    return scene_from_json(text, robot)


def _same_scene(one, other):
    """Whether two scenes (JSON) are equal up to rounding."""
    one, other = json.loads(one), json.loads(other)
    if any(one.get(field) != other.get(field) for field in ("robot", "held", "attached")):
        return False
    if _names_in(one) != _names_in(other):
        return False
    for field in ("obstacles", "table", "floor", "friction"):
        here, there = one.get(field), other.get(field)
        if here is None or there is None:
            if here is not there:
                return False
            continue
        if field == "table":
            here, there = _flat(here), _flat(there)
        if field == "obstacles":  # rows may have different lengths, of convex hulls and motions
            here, there = ([_flat(row) for row in rows] for rows in (here, there))
            if [len(row) for row in here] != [len(row) for row in there]:
                return False
            here, there = (list(itertools.chain(*rows)) for rows in (here, there))
        a, b = np.array(here, dtype=float), np.array(there, dtype=float)
        if a.shape != b.shape or not np.allclose(a, b, rtol=0.0, atol=_SCENE_TOLERANCE):
            return False
    return True


def _names_in(scene):
    """`may_touch` of a scene's obstacles and table (JSON)."""
    return [split_list(row)[2] for row in (*scene["obstacles"], scene["table"] or ())]


def _flat(row):
    """The numbers of a row of `envs.scenes.primitives.to_lists`, and of its motion."""
    numbers, motion, _ = split_list(row)
    return [*numbers, *motion]


def _checksum(attributes, arrays):
    """SHA-256 of the attributes, and of the names, shapes and contents of the arrays."""
    digest = hashlib.sha256(json.dumps(attributes, sort_keys=True).encode())
    for name, (dtype, *_) in array_formats(attributes["schema"], arrays).items():
        digest.update(f"{name} {arrays[name].shape}".encode())
        digest.update(arrays[name].astype(dtype).tobytes())
    return digest.hexdigest()


def check_format(path, schema, arrays, robot):
    """Shapes and dtypes; `arrays` are NumPy arrays or HDF5 datasets, by name."""
    formats = array_formats(schema, arrays)
    for name, array in arrays.items():
        dtype, width, sibling = formats[name]
        width = robot.num_joints if width == JOINTS else width
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


def read_file(path, schema, task):
    """(attributes, arrays, base scene) of a file, after the checks that both kinds share.

    `task`: the task that it must be for; None for any of the Panda.
    """
    robot = get_task(task).base_scene.robot if task else PANDA
    try:
        with open(path, "rb"):
            pass
    except OSError as error:
        what = error.strerror
        if isinstance(error, FileNotFoundError):
            what = f"no such file{_command_for(schema, task)}" if task else "no such file or task"
        raise DatasetError(f"{path}: {what}") from error
    if not h5py.is_hdf5(path):
        raise DatasetError(f"{path}: not an HDF5 file")
    try:
        with h5py.File(path, "r") as file:
            return _read_open(path, file, schema, task, robot)
    except DatasetError:
        raise
    except Exception as error:  # damaged HDF5 raises all kinds of exceptions
        raise DatasetError(f"{path}: truncated or corrupt HDF5 ({error})") from error


def _command_for(schema, task):
    """The command that makes a task's file, for a message; nothing where there is none."""
    if schema == DEMO_SCHEMA and not get_task(task).trainable:
        return ""
    name, robot = split_robot(task)
    command = {QUERY_SCHEMA: "queries", DEMO_SCHEMA: "collect"}[schema]
    flags = f"--task {name}" if robot is None else f"--task {name} --robot {robot}"
    return f"; make it with: roboarm {command} {flags}"


def check_plain(path, group):
    """Raise DatasetError for links, for arrays outside the file, and for too large arrays.

    A file of a few kB can refer to other files, or declare arrays larger than the memory.
    """
    for name in group:
        where = f"{path}: {group.name.rstrip('/')}/{name}"
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise DatasetError(f"{where} is a link, which is never followed")
        found = group[name]
        if isinstance(found, h5py.Group):
            check_plain(path, found)
            continue
        if not isinstance(found, h5py.Dataset) or found.external or found.is_virtual:
            raise DatasetError(f"{where} is not an array in this file")
        if found.size * found.dtype.itemsize > MAX_ARRAY_BYTES:
            raise DatasetError(f"{where} has {found.shape} numbers: too many")
        if found.size and not found.id.get_storage_size():
            raise DatasetError(f"{where} was never written")


def attribute(file, name):
    """An attribute of the file as a Python object; None if there is none."""
    value = file.attrs.get(name)
    value = value.item() if isinstance(value, np.generic) else value
    return value.decode() if isinstance(value, bytes) else value


def _read_open(path, file, schema, task, robot):
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

    made_for = attributes["task"]
    if task is not None and made_for != task_name(task):
        raise DatasetError(
            f"{path}: this file is for the task {made_for!r}, not {task_name(task)!r}"
        )
    base = read_base_scene(path, attributes["scene"], robot)

    check_plain(path, file)
    datasets = {name: file.get(name) for name in array_formats(schema, file)}
    for name, dataset in datasets.items():
        if not isinstance(dataset, h5py.Dataset):
            raise DatasetError(f"{path}: array {name} is missing or damaged")
    check_format(path, schema, datasets, robot)
    arrays = {name: dataset[()] for name, dataset in datasets.items()}
    if attribute(file, "checksum") != _checksum(attributes, arrays):
        raise DatasetError(f"{path}: corrupt (the checksum does not match the contents)")

    if not isinstance(json.loads(attributes["parameters"]), dict):
        raise DatasetError(f"{path}: attribute parameters is not a dict")
    if task is None and made_for in TASKS:
        task = made_for
    # Where the scene file is not at hand, the scene is that of this file.
    wanted = scene_to_json(get_task(task).base_scene) if task else attributes["scene"]
    if not _same_scene(attributes["scene"], wanted):
        replacing = " --overwrite" * (schema == DEMO_SCHEMA)
        raise OutOfDateError(
            f"{path}: out of date: made for another version of the scene of {made_for!r}; "
            f"make it again with: {attributes['made_by']}{replacing}"
        )
    return attributes, arrays, base


def check_configurations(path, name, configurations, robot):
    """Raise DatasetError unless configurations (n, j), rad, are finite and inside the limits."""
    if not np.isfinite(configurations).all():
        raise DatasetError(f"{path}: {name} has numbers that are not finite")
    outside = (configurations < robot.lower) | (configurations > robot.upper)
    if outside.any():
        row = int(np.argmax(outside.any(axis=1)))
        raise DatasetError(f"{path}: {name}[{row}] is outside the joint limits")
