"""Trajectories and joint paths as files, to plot, to show or to run on an arm.

    save_trajectory("motion.yaml", trajectory)             # a `JointTrajectory`
    save_trajectory("episode.csv", trajectory)             # an episode of `evaluation.rollout`
    save_joint_path("path.csv", configurations, times)     # a path of your own
    trajectory = load_trajectory("motion.yaml", env.robot)            # of each of them
    times, configurations = load_joint_path("path.csv", env.robot)    # likewise, only these

`roboarm show --trajectory FILE` and `roboarm view --trajectory FILE` play such a file;
`roboarm retime` makes an executable one; `roboarm show --save-trajectory FILE` writes an episode.
The ending names the format: `.csv`, `.npz`, `.json`, or `.yaml`, ROS's
`trajectory_msgs/JointTrajectory` (docs/reference/file_formats.md). Only joint angles have to be
there. `.json` and `.yaml` name their joints, which are read in any order; the others do not.
"""

import csv
import io
import json
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roboarm_nmp.datasets.format import MAX_ARRAY_BYTES, DatasetError
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.utils.documents import Mistake, parse_document, plain_data
from roboarm_nmp.utils.files import write_atomically

ENDINGS = (".csv", ".npz", ".json", ".yaml")
LIMIT_TOLERANCE = 0.1  # rad. The simulated arm may exceed its limits a little; degrees exceed them.
MAX_DURATION = 100_000  # s: images of longer ones would need all of a machine's memory
MAX_TEXT = {".csv": 100_000_000, ".json": 100_000_000, ".yaml": 10_000_000}  # bytes
# What readers raise for a file that is damaged, or of another kind.
DAMAGE = (
    ArithmeticError,
    EOFError,
    MemoryError,
    NotImplementedError,  # zipfile's, for an unknown compression
    RecursionError,
    ValueError,
    csv.Error,
    zipfile.BadZipFile,
    zlib.error,
)
# A loader in C is ten times as fast, where PyYAML has it.


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """An executable trajectory: m samples of an arm with n joints.

    `motions.time_parameterisation.time_parameterise` makes it of a path. Between two samples of its
    results, accelerations are linear and positions cubic polynomials, so a controller that
    interpolates by quintic splines repeats them exactly.

    Attributes:
        times: s, (m,), increasing.
        positions: rad (or m), (m, n).
        velocities: rad/s, (m, n); None if unknown.
        accelerations: rad/s^2, (m, n); None if unknown.
        robot: the `Robot`.
    """

    times: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray | None
    accelerations: np.ndarray | None
    robot: Robot

    def __len__(self) -> int:
        """The number of samples."""
        return len(self.times)

    @property
    def configurations(self) -> np.ndarray:
        """`positions`, by the name that episodes have for them."""
        return self.positions

    @property
    def duration(self) -> float:
        """s."""
        return float(self.times[-1] - self.times[0])

    def at(self, times: np.ndarray | Sequence[float]) -> np.ndarray:
        """Positions (k, n), rad, at times (k,), s; before the first and after the last those.

        By cubic polynomials, or on straight lines where velocities are unknown.
        """
        times = np.clip(times, self.times[0], self.times[-1])
        if len(self) == 1:
            return np.repeat(self.positions, len(times), axis=0)
        i = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self) - 2)
        span = np.diff(self.times)[i][:, None]
        share = (times - self.times[i])[:, None] / span
        here = self.positions[i]
        there = self.positions[i + 1]
        straight = here + share * (there - here)
        if self.velocities is None:
            return straight
        # Hermite's cubic: it leaves the chord where velocities differ from the chord's.
        before = self.velocities[i] * span - (there - here)
        after = self.velocities[i + 1] * span - (there - here)
        return straight + share * (1 - share) * ((1 - share) * before - share * after)

    def frames(self) -> np.ndarray:
        """Positions (k, n), rad, every `STEP_SECONDS`, to show; the last one is the end."""
        steps = max(1, round(self.duration / STEP_SECONDS))
        positions = self.at(self.times[0] + np.arange(steps + 1) * STEP_SECONDS)
        positions[-1] = self.positions[-1]
        return positions


@dataclass(frozen=True, eq=False)
class Trajectory:
    """An episode of T steps of an arm with n joints.

    Attributes:
        states: float32 (T + 1, n), normalised configurations, from the start on.
        actions: float64 (T, n), as the environment received them.
        contacts: bool (T,), whether the arm was in contact during each step.
        times: float64 (T,), s, from each observation to its action; with a delay, to the next step.
        success: whether the goal was reached.
        robot: the `Robot`.
    """

    states: np.ndarray
    actions: np.ndarray
    contacts: np.ndarray
    times: np.ndarray
    success: bool
    robot: Robot = PANDA

    def __len__(self) -> int:
        """The number of steps."""
        return len(self.actions)

    @property
    def configurations(self) -> np.ndarray:
        """Joint angles (T + 1, n), rad."""
        return self.robot.denormalise(self.states)

    @property
    def collides(self) -> bool:
        """Whether there was a contact in any step."""
        return bool(self.contacts.any())


def check_ending(path: str | Path) -> None:
    """Raise ValueError unless a path ends in .csv, .npz, .json or .yaml."""
    if Path(path).suffix.lower() not in ENDINGS:
        raise ValueError(f"a trajectory's file must end in .csv, .npz, .json or .yaml, got {path}")


def timed(path: np.ndarray, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """A path at the speed of the environment, one sub-goal per step.

    Args:
        path: waypoints (n, j), rad, as of `Planner.plan`.
        robot: the `Robot`, with j joints.

    Returns:
        times (m,), s, from 0 on, `STEP_SECONDS` apart; configurations (m, j), rad.
    """
    configurations = robot.denormalise(subgoals(path, robot))
    return np.arange(len(configurations)) * STEP_SECONDS, configurations


def save_joint_path(
    path: str | Path,
    configurations: np.ndarray,
    times: np.ndarray | Sequence[float],
    robot: Robot | None = None,
) -> None:
    """Write a joint path, atomically.

    Args:
        path: the file; its ending names the format. An existing one is replaced.
        configurations: (n, j), rad.
        times: (n,), s.
        robot: the `Robot` whose joints .json and .yaml name; by default they are `q1`, ...

    Raises:
        ValueError: the ending is unknown, or a shape is wrong.
        OSError: the file cannot be written.
    """
    configurations = np.asarray(configurations)
    times = np.asarray(times)
    if configurations.ndim != 2 or times.shape != configurations.shape[:1]:
        raise ValueError(
            f"configurations must be (n, joints) and times (n,), got {configurations.shape} and "
            f"{times.shape}"
        )
    _write(path, {"configurations": configurations, "times": times}, robot)


def save_trajectory(path: str | Path, trajectory: JointTrajectory | Trajectory) -> None:
    """Write a trajectory, or an episode, as `save_joint_path` does.

    The first time of an episode is 0.
    """
    if isinstance(trajectory, JointTrajectory):
        arrays = {"configurations": trajectory.positions, "times": trajectory.times}
        if trajectory.velocities is not None:
            arrays["velocities"] = trajectory.velocities
        if trajectory.accelerations is not None:
            arrays["accelerations"] = trajectory.accelerations
    else:
        arrays = {
            "configurations": trajectory.configurations,
            "times": np.arange(len(trajectory.states)) * STEP_SECONDS,
            "states": trajectory.states,
            "actions": trajectory.actions,
            "contacts": trajectory.contacts,
            "policy_seconds": trajectory.times,
            "success": np.array(trajectory.success),
        }
    _write(path, arrays, trajectory.robot)


def load_joint_path(path: str | Path, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Load the times (n,), s, and configurations (n, j), rad, of a file from anyone.

    Configurations without times are waypoints, which `timed` gives times. The `Robot` has j joints.

    Raises DatasetError: the file does not exist, or is not a joint path of this robot.
    """
    trajectory = load_trajectory(path, robot)
    return trajectory.times, trajectory.positions


def load_trajectory(path: str | Path, robot: Robot) -> JointTrajectory:
    """Load the trajectory in a file from anyone.

    Velocities and accelerations are None if the file has none. Configurations without times are
    waypoints, which `timed` gives times.

    Raises DatasetError: the file does not exist, or is not a trajectory of this robot.
    """
    try:
        check_ending(path)
        arrays = _READERS[Path(path).suffix.lower()](path, robot)
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror or error}") from error
    except DAMAGE as error:
        reason = str(error).replace("\n", " ") or "it is damaged"
        raise DatasetError(f"{path}: not a joint path: {reason}") from error
    configurations = arrays["configurations"]
    if configurations.shape[1:] != (robot.num_joints,) or not len(configurations):
        raise DatasetError(
            f"{path}: configurations must be (n, {robot.num_joints}), are {configurations.shape}"
        )
    if not np.isfinite(configurations).all():
        raise DatasetError(f"{path}: it has joint angles that are not finite")
    beyond = np.maximum(robot.lower - configurations, configurations - robot.upper).max(0)
    if beyond.max() > LIMIT_TOLERANCE:
        raise DatasetError(
            f"{path}: q{beyond.argmax() + 1} exceeds its limits by {beyond.max():.2f} rad (are "
            f"the angles in rad?)"
        )
    if "times" not in arrays:
        return JointTrajectory(*timed(configurations, robot), None, None, robot)
    times = arrays["times"]
    if times.shape != (len(configurations),) or not np.isfinite(times).all():
        raise DatasetError(f"{path}: it needs one finite time per configuration")
    if (np.diff(times) <= 0).any():
        raise DatasetError(f"{path}: its times do not increase")
    if times[-1] - times[0] > MAX_DURATION:
        raise DatasetError(f"{path}: it takes more than {MAX_DURATION:,} s")
    velocities = arrays.get("velocities")
    accelerations = arrays.get("accelerations")
    for name, values in {"velocities": velocities, "accelerations": accelerations}.items():
        if values is None:
            continue
        if values.shape != configurations.shape or not np.isfinite(values).all():
            raise DatasetError(f"{path}: {name} must be finite, {configurations.shape}")
    return JointTrajectory(times, configurations, velocities, accelerations, robot)


# --- Writing: arrays by the names that .npz has for them


def _write(path, arrays, robot):
    check_ending(path)
    contents = _CONTENTS[Path(path).suffix.lower()](arrays, robot)
    write_atomically(path, contents)


def _csv(arrays, robot):
    columns = {"time": arrays["times"]}
    for name, letter in CSV_LETTERS.items():
        if name in arrays:
            for i, column in enumerate(arrays[name].T):
                columns[f"{letter}{i + 1}"] = column
    if "contacts" in arrays:
        columns["contact"] = arrays["contacts"].astype(int)
        columns["policy_seconds"] = arrays["policy_seconds"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in range(len(arrays["configurations"])):
        writer.writerow([column[row] if row < len(column) else "" for column in columns.values()])
    return text.getvalue().encode()


def _npz(arrays, robot):
    contents = io.BytesIO()
    np.savez(contents, **arrays)
    return contents.getvalue()


def _json(arrays, robot):
    content = {
        "robot": None if robot is None else robot.name,
        "joint_names": _joint_names(arrays, robot),
    }
    for name, array in arrays.items():
        content[name] = array.tolist()
    rows = [f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in content.items()]
    return ("{\n" + ",\n".join(rows) + "\n}\n").encode()


def _yaml(arrays, robot):
    fields = {ros: arrays[name].tolist() for ros, name in ROS_FIELDS.items() if name in arrays}
    lines = [
        "header:",
        "  stamp: {sec: 0, nanosec: 0}",
        "  frame_id: ''",
        f"joint_names: {json.dumps(_joint_names(arrays, robot))}",
        "points:",
    ]
    for row, time in enumerate(arrays["times"].tolist()):
        seconds, nanoseconds = divmod(round(time * 1e9), 10**9)
        indent = "-"
        for ros, values in fields.items():
            numbers = ", ".join(_yaml_number(x) for x in values[row])
            lines.append(f"{indent} {ros}: [{numbers}]")
            indent = " "
        lines.append(f"  time_from_start: {{sec: {seconds}, nanosec: {nanoseconds}}}")
    return ("\n".join(lines) + "\n").encode()


def _yaml_number(number):
    """A float as YAML 1.1 reads it: `1.0e-05`, where Python writes `1e-05`."""
    text = repr(number)
    return text if "." in text or "e" not in text else text.replace("e", ".0e")


def _joint_names(arrays, robot):
    if robot is not None:
        return list(robot.joint_names)
    return [f"q{i + 1}" for i in range(arrays["configurations"].shape[1])]


_CONTENTS = {".csv": _csv, ".npz": _npz, ".json": _json, ".yaml": _yaml}
CSV_LETTERS = {
    "configurations": "q",
    "velocities": "v",
    "accelerations": "a",
    "actions": "action",
}
"""Before the numbers of joints in the header."""
ROS_FIELDS = {
    "positions": "configurations",
    "velocities": "velocities",
    "accelerations": "accelerations",
}


# --- Reading: a dict of arrays, `configurations` and those others of `ARRAYS` that are there

ARRAYS = ("times", "configurations", "velocities", "accelerations")


def _read_csv(path, robot):
    _check_size(path)
    joints = range(1, robot.num_joints + 1)
    columns = {"times": ["time"]}
    for name in ARRAYS[1:]:
        columns[name] = [f"{CSV_LETTERS[name]}{joint}" for joint in joints]
    with open(path, newline="", encoding="utf-8-sig") as file:  # of Excel, too
        rows = csv.DictReader(file, skipinitialspace=True)
        header = rows.fieldnames or ()
        for name in columns["configurations"]:
            if name not in header:
                raise ValueError(
                    f"it has no column {name}; the header names q1 to q{joints[-1]}, rad"
                )
        if f"q{len(joints) + 1}" in header:
            raise ValueError(
                f"it has a column q{len(joints) + 1}, and the arm {len(joints)} joints"
            )
        columns = {key: names for key, names in columns.items() if set(names) <= set(header)}
        table = {key: [] for key in columns}
        try:
            for row in rows:
                for key, names in columns.items():
                    table[key].append([float(row[name]) for name in names])
        except (TypeError, ValueError, csv.Error) as error:
            raise ValueError(f"line {rows.line_num}: not a number") from error
    arrays = {key: np.reshape(table[key], (-1, len(names))) for key, names in columns.items()}
    if "times" in arrays:
        arrays["times"] = arrays["times"][:, 0]
    return arrays


def _read_npz(path, robot):
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.filelist) > MAX_ARRAY_BYTES:
            raise ValueError("it is too large")
    with np.load(path, allow_pickle=False) as file:
        return _numbers(file)


def _read_json(path, robot):
    _check_size(path)
    content = json.loads(Path(path).read_bytes())
    if not isinstance(content, dict):
        raise ValueError("it is no JSON object")
    return _in_order(_numbers(content), content.get("joint_names"), robot)


def _read_yaml(path, robot):
    _check_size(path)
    try:
        content = plain_data(parse_document(Path(path).read_text("utf-8"), allow_tags=False))
    except Mistake as mistake:
        raise ValueError(f"line {mistake.line}: {mistake.reason}") from mistake
    points = content.get("points") if isinstance(content, dict) else None
    if not isinstance(points, list) or not all(isinstance(point, dict) for point in points):
        raise ValueError("it is no trajectory_msgs/JointTrajectory: no list `points`")
    arrays = {"times": [_seconds(point.get("time_from_start")) for point in points]}
    for ros, name in ROS_FIELDS.items():
        rows = [point.get(ros) for point in points]
        if name == "configurations" or any(rows):  # ROS writes [] where there are none
            arrays[name] = rows
    return _in_order(_numbers(arrays), content.get("joint_names"), robot)


def _seconds(duration):
    """s, of a message of ROS 2, or of ROS 1, where its fields are called `secs` and `nsecs`."""
    if not isinstance(duration, dict):
        raise ValueError("a point has no `time_from_start`")
    seconds = duration.get("sec", duration.get("secs", 0))
    nanoseconds = duration.get("nanosec", duration.get("nsecs", 0))
    if type(seconds) is not int or type(nanoseconds) is not int:
        raise ValueError("a `time_from_start` is no duration in whole sec and nanosec")
    return (seconds * 10**9 + nanoseconds) / 1e9


def _numbers(content):
    """Those of `ARRAYS` that are there, as float64."""
    if "configurations" not in content:
        names = ", ".join(content) or "none"
        raise ValueError(f"it has no array configurations, but {names}")
    arrays = {name: np.asarray(content[name]) for name in ARRAYS if name in content}
    if any(array.dtype.kind not in "fiu" for array in arrays.values()):
        raise ValueError("it has something other than numbers")
    return {name: array.astype(np.float64) for name, array in arrays.items()}


def _in_order(arrays, names, robot):
    """Arrays whose columns are named, with the columns in the robot's order."""
    expected = list(robot.joint_names)
    if names in (None, expected, [f"q{i + 1}" for i in range(len(expected))]):
        return arrays
    known = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not known or sorted(names) != sorted(expected):
        raise ValueError(f"its joints are {str(names)[:200]}, those of the arm {expected}")
    order = [names.index(name) for name in expected]
    ordered = {}
    for name, array in arrays.items():
        if name != "times" and array.shape[1:] != (len(expected),):
            raise ValueError(f"a point has not {len(expected)} numbers, one per joint")
        ordered[name] = array if name == "times" else array[:, order]
    return ordered


def _check_size(path):
    limit = MAX_TEXT[Path(path).suffix.lower()]
    if Path(path).stat().st_size > limit:
        raise ValueError(f"it is larger than {limit / 1e6:.0f} MB")


_READERS = {".csv": _read_csv, ".npz": _read_npz, ".json": _read_json, ".yaml": _read_yaml}
