"""Motion planning problems: a start, goals and a scene each; files of many formats, read.

    problems = load_problems("bookshelf_tall_panda")
    for problem in problems: ...
    env.reset_specific(*problems.query(0))

Formats:

- MotionBenchMaker and MoveIt: a folder of `scene####.yaml` (PlanningScene: quaternions xyzw,
  cylinders [height, radius]) with `request####.yaml` (MotionPlanRequest, joints in any order);
- robometrics: a YAML file, lists of problems by the names of their scenes;
- VAMP: a JSON file, with half extents or full edges of boxes;
- `problems.h5`, of `write_problems`, and this project's query files
  (docs/reference/file_formats.md).
"""

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import overload

import numpy as np

from roboarm_nmp.datasets.format import (
    JOINTS,
    QUERY_SCHEMA,
    DatasetError,
    attribute,
    check_checksum,
    check_format,
    check_plain,
    check_robot,
    check_schema,
    checksum,
    get_array,
    hdf5_bytes,
    json_array,
    offsets_of,
    open_hdf5,
    read_attributes,
    read_base_scene,
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
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Scene, scene_to_json, unit_quaternion
from roboarm_nmp.utils.documents import DocumentError
from roboarm_nmp.utils.files import write_atomically

SCHEMA = "roboarm-nmp problems"
SCHEMA_VERSION = 1
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
ATTRIBUTES = {"schema": str, "schema_version": int, "robot": str, "made_by": str}


@dataclass(frozen=True, eq=False)
class Problems:
    """Problems of one arm. `problems[i]` is a `Problem`; a slice, fewer problems.

    Attributes:
        all: tuple of `Problem`s.
        robot: the `Robot`; scenes may hold its other joints elsewhere.
        rejected: list of `Rejected`: problems of the file that cannot be used.
        path, digest: the file or folder they were read from, and the SHA-256 (hex) of its contents.
    """

    all: tuple[Problem, ...]
    robot: Robot = PANDA
    rejected: list[Rejected] = field(default_factory=list)
    path: Path | None = None
    digest: str | None = None

    def __len__(self) -> int:
        return len(self.all)

    def __iter__(self) -> Iterator[Problem]:
        return iter(self.all)

    @overload
    def __getitem__(self, index: int) -> Problem: ...

    @overload
    def __getitem__(self, index: slice) -> "Problems": ...

    def __getitem__(self, index: int | slice) -> "Problem | Problems":
        if isinstance(index, slice):
            return Problems(self.all[index], self.robot, [], self.path, self.digest)
        return self.all[index]

    def query(self, index: int) -> Query:
        """Problem `index` with its first goal configuration.

        Raises ValueError: its goal is a pose only.
        """
        problem = self.all[index]
        if not len(problem.goals):
            raise ValueError(f"problem {problem.name}: its goal is a pose, without configurations")
        start, goal = problem.start.astype(np.float32), problem.goals[0].astype(np.float32)
        return Query(start, goal, problem.scene)

    @property
    def names(self) -> tuple[str, ...]:
        """The problems' names."""
        return tuple(problem.name for problem in self.all)

    @property
    def start(self) -> np.ndarray:
        """float32 (m, n), rad."""
        return np.array([problem.start for problem in self.all], np.float32)

    @property
    def goal(self) -> np.ndarray:
        """float32 (m, n), rad: the first goal of each. Raises ValueError as `query` does."""
        return np.array([self.query(index).goal for index in range(len(self))], np.float32)

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """The problems' scenes."""
        return tuple(problem.scene for problem in self.all)


def load_problems(path: str | Path, robot: Robot = PANDA) -> Problems:
    """Load the problems in a file or folder, in one of the formats that the module describes.

    Nothing is corrected: starts and goals may be in collision or beyond the limits.

    Args:
        path: file or folder.
        robot: the `Robot` of the problems.

    Raises:
        DatasetError, utils.documents.DocumentError: the file cannot be used; ValueErrors with
            the path, and the line if there is one. If only some problems cannot be used, they are
            in `rejected`.
    """
    path = Path(path)
    files = [path]
    if path.is_dir():
        results = list(read_folder(path, robot))
        files = [file for pair in request_files(path).values() for file in pair if file is not None]
    elif path.suffix in (".yaml", ".yml", ".json"):
        results = list(read_file(path, robot))
    elif path.suffix in (".h5", ".hdf5"):
        results = _read_hdf5(path, robot)
    elif not path.exists():
        raise DocumentError(f"{path}: no such file or folder")
    else:
        raise DocumentError(
            f"{path}: problems are in .yaml, .json and .h5 files, and in folders with request "
            f"files (docs/customise/problems.md)"
        )
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    problems = tuple(result for result in results if isinstance(result, Problem))
    rejected = [result for result in results if isinstance(result, Rejected)]
    return Problems(problems, robot.arm, rejected, path, digest.hexdigest())


def write_problems(path: str | Path, problems: Iterable[Problem], made_by: str = "") -> None:
    """Write `problems.h5`, atomically: `path` always has the whole old file or the whole new one.

    Args:
        path: file to write; an existing one is replaced.
        problems: of one arm.
        made_by: the command line that makes this file.

    Raises:
        DatasetError: a file may not have these problems. Nothing is written then.
        OSError: the file cannot be written; an old file is left as it was.
    """
    problems = list(problems)
    if not problems:
        raise DatasetError(f"{path}: no problems to write")
    arm = problems[0].scene.robot.arm
    number_of = {}  # scene -> its number, in the order of their first use
    index = [number_of.setdefault(problem.scene, len(number_of)) for problem in problems]
    no_pose = np.full(7, np.nan)
    poses = [no_pose if problem.goal_pose is None else problem.goal_pose for problem in problems]
    arrays = {
        "start": np.array([problem.start for problem in problems]),
        "goal_count": np.array([len(problem.goals) for problem in problems]),
        "goals": np.concatenate([problem.goals for problem in problems]),
        "goal_pose": np.array(poses),
        "scene": np.array(index),
        "names": json_array([problem.name for problem in problems]),
        "scenes": json_array([json.loads(scene_to_json(scene)) for scene in number_of]),
    }
    arrays = {name: arrays[name].astype(dtype) for name, (dtype, *_) in ARRAYS.items()}
    _check_arrays(path, arrays, arm)
    _problems_of(path, arrays, arm)
    attributes = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "robot": json.dumps([arm.name, arm.fingerprint]),
        "made_by": made_by,
    }
    attributes["checksum"] = checksum(attributes, arrays)
    packing = {"compression": "gzip", "shuffle": True}
    datasets = [(name, array, packing) for name, array in arrays.items()]
    write_atomically(path, hdf5_bytes(attributes, datasets))


# --- Reading HDF5


def _read_hdf5(path, robot):
    with open_hdf5(path) as file:
        schema = attribute(file, "schema")
        if schema == SCHEMA:
            return _read_open(path, file, robot)
    if schema != QUERY_SCHEMA:
        raise DatasetError(
            f"{path}: neither problems nor queries (schema {schema!r}, not {SCHEMA!r})"
        )
    if robot.arm != PANDA:
        raise DatasetError(f"{path}: queries are read as problems of the Panda only")
    problems = []
    for split, queries in validate(path).items():
        for index, (start, goal, scene) in enumerate(queries):
            start, goals = start.astype(np.float64), goal.astype(np.float64)[None]
            problems.append(Problem(f"{split}/{index}", start, goals, None, scene))
    return problems


def _read_open(path, file, robot):
    check_schema(path, file, "problems", SCHEMA, SCHEMA_VERSION)
    attributes = read_attributes(path, file, ATTRIBUTES)
    check_plain(path, file)
    name, fingerprint = json.loads(attributes["robot"])
    check_robot(path, name, fingerprint, robot.arm)
    datasets = {name: get_array(path, file, name) for name in ARRAYS}
    _check_arrays(path, datasets, robot.arm)
    arrays = {name: dataset[()] for name, dataset in datasets.items()}
    check_checksum(path, file, attributes, arrays)
    return _problems_of(path, arrays, robot.arm)


def _check_arrays(path, arrays, arm):
    check_format(path, ARRAYS, arrays, arm)
    for name, array in arrays.items():
        if array.size * array.dtype.itemsize > MAX_ARRAY:
            raise DatasetError(f"{path}: {name} has more than {MAX_ARRAY // 1_000_000} MB")
    if len(arrays["start"]) > MAX_PROBLEMS:
        raise DatasetError(f"{path}: more than {MAX_PROBLEMS:,} problems")


def _problems_of(path, arrays, arm):
    """The list of `Problem`s in a file's arrays. Raises DatasetError: they are no problems."""
    count = len(arrays["start"])
    ends = offsets_of(arrays["goal_count"]).tolist()
    if ends[-1] != len(arrays["goals"]):
        raise DatasetError(f"{path}: goal_count does not fit the number of goals")
    poses = arrays["goal_pose"]
    has_pose = ~np.isnan(poses).all(axis=1)
    finite = {"start": arrays["start"], "goals": arrays["goals"], "goal_pose": poses[has_pose]}
    for name, numbers in finite.items():
        if not np.isfinite(numbers).all():
            raise DatasetError(f"{path}: {name} has numbers that are not finite")
    if arrays["goal_count"].max() > MAX_GOALS:
        raise DatasetError(f"{path}: a problem has more than {MAX_GOALS:,} goals")
    if not (has_pose | (arrays["goal_count"] > 0)).all():
        raise DatasetError(f"{path}: a problem has no goal")
    names = _json_list(path, "names", arrays)
    if len(names) != count or not all(isinstance(name, str) for name in names):
        raise DatasetError(f"{path}: {count} problems have other names than text, or {len(names)}")
    scenes = _json_list(path, "scenes", arrays)
    if arrays["scene"].max() >= len(scenes):
        raise DatasetError(f"{path}: scene does not fit the number of scenes")
    try:
        for pose in poses[has_pose]:
            unit_quaternion(pose[3:].tolist())
        scenes = [read_base_scene(path, json.dumps(scene), arm) for scene in scenes]
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: a scene or a pose that cannot be: {error}") from error
    return [
        Problem(
            name=names[i],
            start=arrays["start"][i],
            goals=arrays["goals"][ends[i] : ends[i + 1]],
            goal_pose=poses[i] if has_pose[i] else None,
            scene=scenes[arrays["scene"][i]],
        )
        for i in range(count)
    ]


def _json_list(path, name, arrays):
    try:
        value = json.loads(arrays[name].tobytes())
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: {name} is no JSON: {error}") from error
    if not isinstance(value, list):
        raise DatasetError(f"{path}: {name} is no list")
    return value
