"""Trajectories and joint paths as files, to plot, to show or to run on an arm.

    save_trajectory("motion.yaml", trajectory)             # a `JointTrajectory`
    save_trajectory("episode.csv", trajectory)             # an episode of `evaluation.rollout`
    save_joint_path("path.csv", configurations, times)     # a path of one's own
    trajectory = load_trajectory("motion.yaml", env.robot)            # of each of them
    times, configurations = load_joint_path("path.csv", env.robot)    # likewise, only these

`roboarm show --trajectory FILE` and `roboarm view --trajectory FILE` play such a file;
`roboarm retime` makes an executable one; `roboarm show --save-trajectory FILE` writes an episode.
The ending names the format, for an arm with n joints:

- `.csv`: a header and a row per configuration: `time` (s), the joint angles `q1` to `qn` (rad), and
  of a `JointTrajectory` velocities `v1`, ... (rad/s) and accelerations `a1`, ... (rad/s^2). An
  episode has the action after each configuration (`action1`, ...), whether the arm was in contact
  on the way to the next one (`contact`, 0 or 1) and the policy's computing time (`policy_seconds`);
  the last configuration has none of these.
- `.npz`: the same as arrays: `times` (m,), `configurations`, `velocities`, `accelerations` (m, n);
  of an episode also `states` (m, n), normalised, `actions` (m - 1, n), `contacts` and
  `policy_seconds` (m - 1,), and `success`.
- `.json`: the arrays of `.npz` as lists, and `robot` and `joint_names`.
- `.yaml`: ROS's message `trajectory_msgs/JointTrajectory`, with times rounded to 1 ns. The other
  columns of an episode are not in it.

Only joint angles have to be there. Other columns and arrays do not matter. `.json` and `.yaml` name
their joints, which are read in any order; the other formats do not.
"""

import csv
import io
import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from roboarm_nmp.datasets.format import MAX_ARRAY_BYTES, DatasetError
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.utils.files import write_atomically

ENDINGS = (".csv", ".npz", ".json", ".yaml")
LIMIT_TOLERANCE = 0.1  # rad. The simulated arm may exceed its limits a little; degrees exceed them.
MAX_DURATION = 100_000  # s: images of longer ones would need all of a machine's memory
MAX_TEXT = {".csv": 100_000_000, ".json": 100_000_000, ".yaml": 10_000_000}  # bytes
# What readers raise for a file that is damaged, or of another kind: NotImplementedError is
# zipfile's for an unknown compression.
DAMAGE = (ValueError, ArithmeticError, RecursionError, EOFError, NotImplementedError, MemoryError)
DAMAGE += (csv.Error, zipfile.BadZipFile, zlib.error)
# A loader in C is ten times as fast, where PyYAML has it.
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


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

    def __len__(self):
        """The number of samples."""
        return len(self.times)

    @property
    def configurations(self):
        """`positions`, by the name that episodes have for them."""
        return self.positions

    @property
    def duration(self):
        """s."""
        return float(self.times[-1] - self.times[0])

    def at(self, times):
        """Positions (k, n), rad, at times (k,), s; before the first and after the last those.

        By cubic polynomials, or on straight lines where velocities are unknown.
        """
        times = np.clip(times, self.times[0], self.times[-1])
        if len(self) == 1:
            return np.repeat(self.positions, len(times), axis=0)
        i = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self) - 2)
        span = np.diff(self.times)[i][:, None]
        share = (times - self.times[i])[:, None] / span
        here, there = self.positions[i], self.positions[i + 1]
        straight = here + share * (there - here)
        if self.velocities is None:
            return straight
        # Hermite's cubic: it leaves the chord where velocities differ from the chord's.
        before = self.velocities[i] * span - (there - here)
        after = self.velocities[i + 1] * span - (there - here)
        return straight + share * (1 - share) * ((1 - share) * before - share * after)

    def frames(self):
        """Positions (k, n), rad, every `STEP_SECONDS`, to show; the last one is the end."""
        steps = max(1, round(self.duration / STEP_SECONDS))
        positions = self.at(self.times[0] + np.arange(steps + 1) * STEP_SECONDS)
        positions[-1] = self.positions[-1]
        return positions


def check_ending(path):
    """Raise ValueError unless a path ends in .csv, .npz, .json or .yaml."""
    if Path(path).suffix.lower() not in ENDINGS:
        raise ValueError(f"a trajectory's file must end in .csv, .npz, .json or .yaml, got {path}")


def timed(path, robot):
    """A path at the speed of the environment, one sub-goal per step.

    Args:
        path: waypoints (n, j), rad, as of `Planner.plan`.
        robot: the `Robot`, with j joints.

    Returns:
        times (m,), s, from 0 on, `STEP_SECONDS` apart; configurations (m, j), rad.
    """
    configurations = robot.denormalise(subgoals(path, robot))
    return np.arange(len(configurations)) * STEP_SECONDS, configurations


def save_joint_path(path, configurations, times, robot=None):
    """Write a joint path, atomically.

    Args:
        path: the file, by its ending; an existing one is replaced.
        configurations: (n, j), rad.
        times: (n,), s.
        robot: the `Robot`, whose joints .json and .yaml name; by default they are `q1`, ...

    Raises:
        ValueError: another ending, or other shapes.
        OSError: the file cannot be written.
    """
    configurations, times = np.asarray(configurations), np.asarray(times)
    if configurations.ndim != 2 or times.shape != configurations.shape[:1]:
        raise ValueError(
            f"configurations must be (n, joints) and times (n,), got {configurations.shape} and "
            f"{times.shape}"
        )
    _write(path, {"time": times}, configurations, {"times": times}, robot)


def save_trajectory(path, trajectory):
    """Write a `JointTrajectory`, or an episode, a `Trajectory`, as `save_joint_path` does.

    The first time of an episode is 0.
    """
    if isinstance(trajectory, JointTrajectory):
        times, arrays = trajectory.times, {"times": trajectory.times}
        columns = {"time": times}
        for name in ("velocities", "accelerations"):
            values = getattr(trajectory, name)
            if values is not None:
                arrays[name] = values
                columns |= {f"{name[0]}{i + 1}": column for i, column in enumerate(values.T)}
        _write(path, columns, trajectory.positions, arrays, trajectory.robot)
        return
    times = np.arange(len(trajectory.states)) * STEP_SECONDS
    columns = {"time": times}
    columns |= {f"action{i + 1}": column for i, column in enumerate(trajectory.actions.T)}
    columns |= {"contact": trajectory.contacts.astype(int), "policy_seconds": trajectory.times}
    arrays = {
        "times": times,
        "states": trajectory.states,
        "actions": trajectory.actions,
        "contacts": trajectory.contacts,
        "policy_seconds": trajectory.times,
        "success": trajectory.success,
    }
    _write(path, columns, trajectory.configurations, arrays, trajectory.robot)


def load_joint_path(path, robot):
    """The times (n,), s, and configurations (n, j), rad, in a file, whoever made it.

    Without times, the configurations are waypoints: the result is `timed`. The `Robot` has j
    joints.

    Raises DatasetError: no such file, or not a joint path of this robot.
    """
    trajectory = load_trajectory(path, robot)
    return trajectory.times, trajectory.positions


def load_trajectory(path, robot):
    """The `JointTrajectory` in a file, whoever made it.

    Velocities and accelerations are None where the file has none. Without times, the configurations
    are waypoints: times and positions are `timed`.

    Raises DatasetError: no such file, or not a trajectory of this robot.
    """
    joints = robot.num_joints
    try:
        check_ending(path)
        times, configurations, *others = _READERS[Path(path).suffix.lower()](path, robot)
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror or error}") from error
    except DAMAGE as error:
        reason = str(error).replace("\n", " ") or "it is damaged"
        raise DatasetError(f"{path}: not a joint path: {reason}") from error
    if configurations.shape[1:] != (joints,) or not len(configurations):
        raise DatasetError(
            f"{path}: configurations must be (n, {joints}), are {configurations.shape}"
        )
    if not np.isfinite(configurations).all():
        raise DatasetError(f"{path}: it has joint angles that are not finite")
    beyond = np.maximum(robot.lower - configurations, configurations - robot.upper).max(0)
    if beyond.max() > LIMIT_TOLERANCE:
        raise DatasetError(
            f"{path}: q{beyond.argmax() + 1} exceeds its limits by {beyond.max():.2f} rad (are "
            f"the angles in rad?)"
        )
    if times is None:
        return JointTrajectory(*timed(configurations, robot), None, None, robot)
    if times.shape != (len(configurations),) or not np.isfinite(times).all():
        raise DatasetError(f"{path}: it needs one finite time per configuration")
    if (np.diff(times) <= 0).any():
        raise DatasetError(f"{path}: its times do not increase")
    if times[-1] - times[0] > MAX_DURATION:
        raise DatasetError(f"{path}: it takes more than {MAX_DURATION:,} s")
    for name, values in zip(("velocities", "accelerations"), others, strict=True):
        if values is not None and (
            values.shape != configurations.shape or not np.isfinite(values).all()
        ):
            raise DatasetError(f"{path}: {name} must be finite, {configurations.shape}")
    return JointTrajectory(times, configurations, *others, robot)


# --- Writing


def _write(path, columns, configurations, arrays, robot):
    check_ending(path)
    arrays = {"configurations": configurations} | arrays
    contents = _CONTENTS[Path(path).suffix.lower()](columns, arrays, robot)
    write_atomically(path, contents)


def _csv(columns, arrays, robot):
    time, *others = columns.items()
    joints = ((f"q{i + 1}", column) for i, column in enumerate(arrays["configurations"].T))
    columns = dict([time, *joints, *others])
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in range(len(arrays["configurations"])):
        writer.writerow([column[row] if row < len(column) else "" for column in columns.values()])
    return text.getvalue().encode()


def _npz(columns, arrays, robot):
    contents = io.BytesIO()
    np.savez(contents, **arrays)
    return contents.getvalue()


def _json(columns, arrays, robot):
    content = {"robot": None if robot is None else robot.name}
    content["joint_names"] = _joint_names(arrays["configurations"], robot)
    content |= {name: np.asarray(array).tolist() for name, array in arrays.items()}
    rows = [f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in content.items()]
    return ("{\n" + ",\n".join(rows) + "\n}\n").encode()


def _yaml(columns, arrays, robot):
    names = _joint_names(arrays["configurations"], robot)
    fields = {
        ros: np.asarray(arrays[name]).tolist() if name in arrays else None
        for ros, name in ROS_FIELDS.items()
    }
    lines = [
        "header:",
        "  stamp: {sec: 0, nanosec: 0}",
        "  frame_id: ''",
        f"joint_names: {json.dumps(names)}",
        "points:",
    ]
    for row, time in enumerate(np.asarray(arrays["times"]).tolist()):
        seconds, nanoseconds = divmod(round(time * 1e9), 10**9)
        first = "-"
        for ros, values in fields.items():
            if values is not None:
                numbers = ", ".join(_yaml_number(x) for x in values[row])
                lines.append(f"{first} {ros}: [{numbers}]")
                first = " "
        lines.append(f"  time_from_start: {{sec: {seconds}, nanosec: {nanoseconds}}}")
    return ("\n".join(lines) + "\n").encode()


def _yaml_number(number):
    """A float as YAML 1.1 reads it: `1.0e-05`, where Python writes `1e-05`."""
    text = repr(number)
    return text if "." in text or "e" not in text else text.replace("e", ".0e")


def _joint_names(configurations, robot):
    if robot is not None:
        return list(robot.joint_names)
    return [f"q{i + 1}" for i in range(configurations.shape[1])]


_CONTENTS = {".csv": _csv, ".npz": _npz, ".json": _json, ".yaml": _yaml}
ROS_FIELDS = {
    "positions": "configurations",
    "velocities": "velocities",
    "accelerations": "accelerations",
}


# --- Reading: times or None, configurations, velocities or None, accelerations or None


def _read_csv(path, robot):
    _check_size(path)
    joints = robot.num_joints
    wanted = [f"q{joint}" for joint in range(1, joints + 1)]
    with open(path, newline="", encoding="utf-8-sig") as file:  # of Excel, too
        rows = csv.DictReader(file, skipinitialspace=True)
        found = rows.fieldnames or ()
        missing = [name for name in wanted if name not in found]
        if missing:
            raise ValueError(
                f"it has no column {missing[0]}; the header names q1 to {wanted[-1]}, rad"
            )
        if f"q{joints + 1}" in found:
            raise ValueError(f"it has a column q{joints + 1}, and the arm {joints} joints")
        groups = [["time"], wanted]
        groups += [[f"{letter}{joint}" for joint in range(1, joints + 1)] for letter in "va"]
        groups = [group if all(name in found for name in group) else [] for group in groups]
        names = [name for group in groups for name in group]
        try:
            table = [[float(row[name]) for name in names] for row in rows]
        except (TypeError, ValueError, csv.Error) as error:
            raise ValueError(f"line {rows.line_num}: not a number") from error
    table = np.array(table).reshape(-1, len(names))
    ends = np.cumsum([len(group) for group in groups])
    time, *others = np.split(table, ends[:-1], axis=1)
    others = [values if values.shape[1] else None for values in others]
    return time[:, 0] if time.shape[1] else None, *others


ARRAYS = ("times", "configurations", "velocities", "accelerations")


def _read_npz(path, robot):
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.filelist) > MAX_ARRAY_BYTES:
            raise ValueError("it is too large")
    with np.load(path, allow_pickle=False) as file:
        return _arrays({name: file[name] for name in ARRAYS if name in file}, list(file))


def _read_json(path, robot):
    _check_size(path)
    content = json.loads(Path(path).read_bytes())
    if not isinstance(content, dict):
        raise ValueError("it is no JSON object")
    arrays = _arrays({name: content[name] for name in ARRAYS if name in content}, list(content))
    return _in_order(arrays, content.get("joint_names"), robot)


def _read_yaml(path, robot):
    _check_size(path)
    text = Path(path).read_bytes()
    if b"&" in text or b"*" in text:  # they expand without limit
        raise ValueError("anchors and aliases (& and *) are not allowed")
    try:
        content = yaml.load(text.decode(), LOADER)  # a safe loader
    except yaml.YAMLError as error:
        raise ValueError(f"no YAML: {error}") from error
    points = content.get("points") if isinstance(content, dict) else None
    if not isinstance(points, list) or not all(isinstance(point, dict) for point in points):
        raise ValueError("it is no trajectory_msgs/JointTrajectory: no list `points`")
    arrays = {}
    for ros, name in ROS_FIELDS.items():
        rows = [point.get(ros) for point in points]
        if name == "configurations" or any(rows):  # ROS writes [] where there are none
            arrays[name] = rows
    arrays["times"] = [_seconds(point.get("time_from_start")) for point in points]
    return _in_order(_arrays(arrays, list(arrays)), content.get("joint_names"), robot)


def _seconds(duration):
    """s, of a message of ROS 2, or of ROS 1, where its fields are called `secs` and `nsecs`."""
    if not isinstance(duration, dict):
        raise ValueError("a point has no `time_from_start`")
    parts = [
        duration.get(name, duration.get(ros1, 0))
        for name, ros1 in (("sec", "secs"), ("nanosec", "nsecs"))
    ]
    if any(isinstance(part, bool) or not isinstance(part, int) for part in parts):
        raise ValueError("a `time_from_start` is no duration in whole sec and nanosec")
    return (parts[0] * 10**9 + parts[1]) / 1e9


def _arrays(arrays, found):
    """The arrays of `ARRAYS` as float64, in that order; None for each that is not there."""
    if "configurations" not in arrays:
        raise ValueError(f"it has no array configurations, but {', '.join(found) or 'none'}")
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    if any(array.dtype.kind not in "fiu" for array in arrays.values()):
        raise ValueError("it has something other than numbers")
    arrays = {name: array.astype(np.float64) for name, array in arrays.items()}
    return [arrays.get(name) for name in ARRAYS]


def _in_order(arrays, names, robot):
    """Arrays whose columns are named, with the columns in the robot's order."""
    wanted = list(robot.joint_names)
    if names in (None, wanted, [f"q{i + 1}" for i in range(len(wanted))]):
        return arrays
    known = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not known or sorted(names) != sorted(wanted):
        raise ValueError(f"its joints are {str(names)[:200]}, those of the arm {wanted}")
    times, *others = arrays
    order = [names.index(name) for name in wanted]
    if any(array is not None and array.shape[1:] != (len(wanted),) for array in others):
        raise ValueError(f"a point has not {len(wanted)} numbers, one per joint")
    return [times, *(None if array is None else array[:, order] for array in others)]


def _check_size(path):
    limit = MAX_TEXT[Path(path).suffix.lower()]
    if Path(path).stat().st_size > limit:
        raise ValueError(f"it is larger than {limit / 1e6:.0f} MB")


_READERS = {".csv": _read_csv, ".npz": _read_npz, ".json": _read_json, ".yaml": _read_yaml}
