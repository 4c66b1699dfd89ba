"""Motion planning problems: a start, goals and a scene each; files of many formats, read.

    problems = load_problems("bookshelf_tall_panda")
    for problem in problems: ...
    env.reset_specific(*problems.query(0))

Formats:

- MotionBenchMaker and MoveIt: a folder of `scene####.yaml` (PlanningScene: quaternions xyzw,
  cylinders [height, radius]) with `request####.yaml` (MotionPlanRequest, joints in any order);
- robometrics: a YAML file, lists of problems by the names of their scenes;
- VAMP: a JSON file, with half extents or full edges of boxes;
- `problems.h5`, of `write_problems`, and this project's query files.

The attributes of a `problems.h5` are `schema`, `schema_version`, `robot` (JSON: name and
fingerprint of the arm), `made_by` and `checksum` (SHA-256 of all others and the arrays). Its arrays
are `start`: float64 (m, n), rad; `goal_count`: uint32 (m,); `goals`: float64 (k, n), rad, those of
one problem after another; `goal_pose`: float64 (m, 7), position (m) and quaternion (xyzw), NaN
where there is none; `scene`: uint32 (m,), the number of each problem's scene; `names` and `scenes`:
uint8, the names and the scenes (`envs.scenes.primitives.scene_to_json`) as JSON.
"""

import hashlib
import io
import json
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from roboarm_nmp.datasets.format import (
    JOINTS,
    QUERY_SCHEMA,
    DatasetError,
    attribute,
    check_plain,
)
from roboarm_nmp.datasets.problem_formats import (
    MAX_GOALS,
    MAX_PROBLEMS,
    Problem,
    Rejected,
    read_file,
    read_folder,
    request_files,
)
from roboarm_nmp.datasets.queries import Query, validate
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import scene_from_json, scene_to_json, unit_quaternion
from roboarm_nmp.utils.documents import DocumentError
from roboarm_nmp.utils.files import write_atomically

SCHEMA, SCHEMA_VERSION = "roboarm-nmp problems", 1
MAX_ARRAY = 30_000_000  # bytes, of an array of a file: as JSON it needs twenty times as much
ARRAYS = {
    "start": ("<f8", JOINTS, "start"),
    "goal_count": ("<u4", None, "start"),
    "goals": ("<f8", JOINTS, "goals"),
    "goal_pose": ("<f8", 7, "start"),
    "scene": ("<u4", None, "start"),
    "names": ("<u1", None, "names"),
    "scenes": ("<u1", None, "scenes"),
}
"""As those of `datasets.format`."""


@dataclass(frozen=True, eq=False)
class Problems:
    """Problems of one arm. `problems[i]` is a `Problem`; a slice, fewer problems.

    Attributes:
        all: tuple of `Problem`s.
        robot: the `Robot`; scenes may hold its other joints elsewhere.
        rejected: list of `Rejected`: problems of the file that cannot be used.
        path, digest: the file or folder they were read from, and the SHA-256 (hex) of its contents.
    """

    all: tuple
    robot: object = PANDA
    rejected: list = field(default_factory=list)
    path: Path | None = None
    digest: str | None = None

    def __len__(self):
        return len(self.all)

    def __getitem__(self, index):
        found = self.all[index]
        if isinstance(index, slice):
            return Problems(found, self.robot, [], self.path, self.digest)
        return found

    def query(self, index):
        """Problem `index` with its first goal configuration, as an `datasets.queries.Query`.

        Raises ValueError: its goal is a pose only.
        """
        problem = self.all[index]
        if not len(problem.goals):
            raise ValueError(f"problem {problem.name}: its goal is a pose, without configurations")
        start, goal = problem.start.astype(np.float32), problem.goals[0].astype(np.float32)
        return Query(start, goal, problem.scene)

    @property
    def names(self):
        """The problems' names, a tuple."""
        return tuple(problem.name for problem in self.all)

    @property
    def start(self):
        """float32 (m, n), rad."""
        return np.array([problem.start for problem in self.all], np.float32)

    @property
    def goal(self):
        """float32 (m, n), rad: the first goal of each. Raises ValueError as `query` does."""
        return np.array([self.query(index).goal for index in range(len(self))], np.float32)

    @property
    def scenes(self):
        """The problems' scenes, a tuple."""
        return tuple(problem.scene for problem in self.all)


def load_problems(path, robot=PANDA):
    """The `Problems` in a file or folder; the formats are those of the module.

    Problems are as the file has them: starts and goals may be in collision or beyond the limits.

    Args:
        path: file or folder.
        robot: the `Robot` of the problems.

    Raises:
        DatasetError, utils.documents.DocumentError: the file cannot be used; ValueErrors with
            the path, and the line where there is one. Unusable problems of a file that can be used
            are in `rejected`.
    """
    path = Path(path)
    if path.is_dir():
        found = list(read_folder(path, robot))
        pairs = request_files(path).values()
        digest = _digest(*(one for pair in pairs for one in pair if one is not None))
    elif path.suffix in (".yaml", ".yml", ".json"):
        found = list(read_file(path, robot))
        digest = _digest(path)
    elif path.suffix in (".h5", ".hdf5"):
        found, digest = _read_hdf5(path, robot), _digest(path)
    elif not path.exists():
        raise DocumentError(f"{path}: no such file or folder")
    else:
        raise DocumentError(
            f"{path}: problems are in .yaml, .json and .h5 files, and in folders with request "
            f"files (docs/customise/problems.md)"
        )
    problems = tuple(one for one in found if isinstance(one, Problem))
    rejected = [one for one in found if isinstance(one, Rejected)]
    return Problems(problems, robot.arm, rejected, path, digest)


def write_problems(path, problems, made_by=""):
    """Write `problems.h5`, atomically: at every moment `path` is the old file or the new one.

    Args:
        path: file to write; an existing one is replaced.
        problems: sequence of `Problem`s of one arm.
        made_by: the command line that makes this file.

    Raises:
        DatasetError: problems that a file must not have; nothing is written then.
        OSError: the file cannot be written; an old file is left as it was.
    """
    problems = list(problems)
    if not problems:
        raise DatasetError(f"{path}: no problems to write")
    arm, numbers = problems[0].scene.robot.arm, {}
    index = [numbers.setdefault(problem.scene, len(numbers)) for problem in problems]
    poses = [np.full(7, np.nan) if one.goal_pose is None else one.goal_pose for one in problems]
    arrays = {
        "start": np.array([problem.start for problem in problems]),
        "goal_count": np.array([len(problem.goals) for problem in problems]),
        "goals": np.concatenate([problem.goals for problem in problems]),
        "goal_pose": np.array(poses),
        "scene": np.array(index),
        "names": _as_bytes([problem.name for problem in problems]),
        "scenes": _as_bytes([json.loads(scene_to_json(scene)) for scene in numbers]),
    }
    arrays = {name: arrays[name].astype(dtype) for name, (dtype, *_) in ARRAYS.items()}
    attributes = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "robot": json.dumps([arm.name, arm.fingerprint]),
        "made_by": made_by,
    }
    for name, array in arrays.items():
        _check_size(path, name, array)
    _problems_of(path, arrays, arm)
    contents = io.BytesIO()  # as of datasets.format.write_file
    with h5py.File(contents, "w", libver=("v110", "v110")) as file:
        for name, value in {**attributes, "checksum": _checksum(attributes, arrays)}.items():
            file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value
        for name, array in arrays.items():
            packing = {"compression": "gzip", "shuffle": True} if array.size else {}
            file.create_dataset(name, data=array, track_times=False, **packing)
    write_atomically(path, contents.getbuffer())


def _as_bytes(value):
    return np.frombuffer(json.dumps(value).encode(), np.uint8)


def _digest(*paths):
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _checksum(attributes, arrays):
    digest = hashlib.sha256(json.dumps(attributes, sort_keys=True).encode())
    for name, array in arrays.items():
        digest.update(f"{name} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


# --- Reading HDF5


def _read_hdf5(path, robot):
    try:
        with open(path, "rb"):
            pass
        if not h5py.is_hdf5(path):
            raise DatasetError(f"{path}: not an HDF5 file")
        with h5py.File(path, "r") as file:
            schema = attribute(file, "schema")
            if schema == SCHEMA:
                return _read_open(path, file, robot)
    except DatasetError:
        raise
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror or 'truncated or corrupt HDF5'}") from error
    except Exception as error:  # damaged HDF5 raises all kinds of exceptions
        raise DatasetError(f"{path}: truncated or corrupt HDF5 ({error})") from error
    if schema != QUERY_SCHEMA:
        raise DatasetError(
            f"{path}: neither problems nor queries (schema {schema!r}, not {SCHEMA!r})"
        )
    if robot.arm != PANDA:
        raise DatasetError(f"{path}: queries are read as problems of the Panda only")
    return [
        Problem(f"{split}/{index}", *_as_float64(query), None, query.scene)
        for split, queries in validate(path).items()
        for index, query in enumerate(queries)
    ]


def _as_float64(query):
    return query.start.astype(np.float64), query.goal.astype(np.float64)[None]


def _read_open(path, file, robot):
    attributes = {}
    for name, kind in {"schema": str, "schema_version": int, "robot": str, "made_by": str}.items():
        attributes[name] = attribute(file, name)
        if not isinstance(attributes[name], kind):
            raise DatasetError(f"{path}: attribute {name} is missing or damaged")
    if attributes["schema_version"] != SCHEMA_VERSION:
        version = attributes["schema_version"]
        raise DatasetError(f"{path}: schema version {version}, this code reads {SCHEMA_VERSION}")
    check_plain(path, file)
    arrays = {}
    for name, (dtype, *_) in ARRAYS.items():
        dataset = file.get(name)
        if not isinstance(dataset, h5py.Dataset) or dataset.dtype != np.dtype(dtype):
            raise DatasetError(f"{path}: array {name} is missing or damaged")
        _check_size(path, name, dataset)
        arrays[name] = dataset[()]
    if attribute(file, "checksum") != _checksum(attributes, arrays):
        raise DatasetError(f"{path}: corrupt (the checksum does not match the contents)")
    name, fingerprint = json.loads(attributes["robot"])
    if fingerprint != robot.arm.fingerprint:
        raise DatasetError(
            f"{path}: made for the robot {name!r} ({fingerprint[:12]}), not for "
            f"{robot.arm.name!r} ({robot.arm.fingerprint[:12]}): name the robot's file (--robot)"
        )
    return _problems_of(path, arrays, robot.arm)


def _check_size(path, name, array):
    if array.size * array.dtype.itemsize > MAX_ARRAY:
        raise DatasetError(f"{path}: {name} has more than {MAX_ARRAY // 1_000_000} MB")


def _problems_of(path, arrays, arm):
    """The list of `Problem`s in a file's arrays. Raises DatasetError: they are no problems."""
    joints, count = arm.num_joints, len(arrays["start"])
    shapes = {"start": (count, joints), "goal_count": (count,), "goal_pose": (count, 7)}
    shapes |= {"scene": (count,), "goals": (int(arrays["goal_count"].sum()), joints)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not 1 <= count <= MAX_PROBLEMS:
            raise DatasetError(
                f"{path}: {name} must have shape {shape}, has {arrays[name].shape}, for 1 to "
                f"{MAX_PROBLEMS:,} problems"
            )
    names, scenes = (_json_of(path, name, arrays[name]) for name in ("names", "scenes"))
    if len(names) != count or not all(isinstance(name, str) for name in names):
        raise DatasetError(f"{path}: {count} problems have other names than text, or {len(names)}")
    if arrays["scene"].max() >= len(scenes):
        raise DatasetError(f"{path}: scene does not fit the number of scenes")
    if arrays["goal_count"].max() > MAX_GOALS:
        raise DatasetError(f"{path}: a problem has more than {MAX_GOALS:,} goals")
    poses, has_pose = arrays["goal_pose"], ~np.isnan(arrays["goal_pose"]).all(axis=1)
    for name, numbers in (("start", arrays["start"]), ("goals", arrays["goals"]),
                          ("goal_pose", poses[has_pose])):  # fmt: skip
        if not np.isfinite(numbers).all():
            raise DatasetError(f"{path}: {name} has numbers that are not finite")
    if not (has_pose | (arrays["goal_count"] > 0)).all():
        raise DatasetError(f"{path}: a problem has no goal")
    try:
        for pose in poses[has_pose]:
            unit_quaternion(pose[3:].tolist())
        scenes = [_scene_of(scene, arm) for scene in scenes]
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: a scene or a pose that cannot be: {error}") from error
    ends = np.cumsum(arrays["goal_count"], dtype=np.int64)
    goals = np.split(arrays["goals"], ends[:-1])
    return [
        Problem(name, start, goal, pose if has else None, scenes[index])
        for name, start, goal, pose, has, index in zip(
            names, arrays["start"], goals, poses, has_pose, arrays["scene"], strict=True
        )
    ]


def _json_of(path, name, array):
    try:
        value = json.loads(array.tobytes())
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: {name} is no JSON: {error}") from error
    if not isinstance(value, list):
        raise DatasetError(f"{path}: {name} is no list")
    return value


def _scene_of(fields, arm):
    """A `Scene` of JSON; its robot, which the file's attribute names, is the arm."""
    name, fingerprint = fields.get("robot", (PANDA.name, PANDA.fingerprint))
    if fingerprint != arm.fingerprint:
        raise ValueError(f"a scene is that of another robot, {name!r}")
    return scene_from_json(json.dumps(fields), arm)
