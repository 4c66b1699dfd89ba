"""Joint paths as files, to plot, to show or to run on an arm: `.csv` or `.npz`, by the ending.

    save_trajectory("episode.csv", trajectory)             # an episode of `envs.policies.rollout`
    save_joint_path("path.csv", configurations, times)     # a path of one's own
    times, configurations = load_joint_path("path.csv", env.robot)    # of either

`roboarm show --trajectory FILE` plays such a file; `--save-trajectory FILE` writes one.

A `.csv` file has a header and a row per configuration: `time` (s) and the angles of the arm's j
joints, `q1` to `q7` (rad) of an arm with seven. An episode also has the action after each
configuration (`action1`, ...), whether the arm was in contact on the way to the next one
(`contact`, 0 or 1) and the policy's computing time (`policy_seconds`); the last configuration has
none of these. A `.npz` file has the same as arrays: `times` (n,), `configurations` (n, j); of an
episode also `states` (n, j), normalised, `actions` (n - 1, j), `contacts` and `policy_seconds`
(n - 1,), and `success`.

Read are only the joint angles and, if there are any, the times: other columns and arrays do not
matter. The files do not name their robot.
"""

import csv
import io
import zipfile
from pathlib import Path

import numpy as np

from roboarm_nmp.envs.datasets.format import MAX_ARRAY_BYTES, DatasetError
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.envs.utils.files import write_atomically
from roboarm_nmp.envs.world import SUBSTEPS, TIME_STEP

STEP_SECONDS = SUBSTEPS * TIME_STEP
"""s, of one environment step: 1/30."""
ENDINGS = (".csv", ".npz")
LIMIT_TOLERANCE = 0.1  # rad. The simulated arm may exceed its limits a little; degrees exceed them.


def check_ending(path):
    """Raise ValueError unless a path ends in .csv or .npz."""
    if Path(path).suffix.lower() not in ENDINGS:
        raise ValueError(f"a trajectory's file must end in .csv or .npz, got {path}")


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


def save_joint_path(path, configurations, times):
    """Write a joint path, atomically.

    Args:
        path: the file, .csv or .npz; an existing one is replaced.
        configurations: (n, j), rad.
        times: (n,), s.

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
    _write(path, {"time": times}, configurations, {"times": times})


def save_trajectory(path, trajectory):
    """Write an episode, a `Trajectory`, as `save_joint_path` does; its first time is 0."""
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
    _write(path, columns, trajectory.configurations, arrays)


def load_joint_path(path, robot):
    """The times (n,), s, and configurations (n, j), rad, in a file, whoever made it.

    Without times, the configurations are waypoints: the result is `timed`. The `Robot` has j
    joints.

    Raises DatasetError: no such file, or not a joint path of this robot.
    """
    joints = robot.num_joints
    try:
        check_ending(path)
        read = _read_csv if Path(path).suffix.lower() == ".csv" else _read_npz
        times, configurations = read(path, joints)
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror or error}") from error
    except (ValueError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path}: not a joint path: {error}") from error
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
        return timed(configurations, robot)
    if times.shape != (len(configurations),) or not np.isfinite(times).all():
        raise DatasetError(f"{path}: it needs one finite time per configuration")
    if (np.diff(times) <= 0).any():
        raise DatasetError(f"{path}: its times do not increase")
    return times, configurations


def _write(path, columns, configurations, arrays):
    check_ending(path)
    if Path(path).suffix.lower() == ".npz":
        contents = io.BytesIO()
        np.savez(contents, configurations=configurations, **arrays)
        write_atomically(path, contents.getvalue())
        return
    time, *others = columns.items()
    joints = ((f"q{i + 1}", column) for i, column in enumerate(configurations.T))
    columns = dict([time, *joints, *others])
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in range(len(configurations)):
        writer.writerow([column[row] if row < len(column) else "" for column in columns.values()])
    write_atomically(path, text.getvalue().encode())


def _read_csv(path, joints):
    wanted = [f"q{joint}" for joint in range(1, joints + 1)]
    with open(path, newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file, skipinitialspace=True)
        found = rows.fieldnames or ()
        names = [name for name in ("time", *wanted) if name in found]
        missing = [name for name in wanted if name not in names]
        if missing:
            raise ValueError(
                f"it has no column {missing[0]}; the header names q1 to {wanted[-1]}, rad"
            )
        if f"q{joints + 1}" in found:
            raise ValueError(f"it has a column q{joints + 1}, and the arm {joints} joints")
        try:
            table = [[float(row[name]) for name in names] for row in rows]
        except (TypeError, ValueError, csv.Error) as error:
            raise ValueError(f"line {rows.line_num}: not a number") from error
    table = np.array(table).reshape(-1, len(names))
    return table[:, 0] if "time" in names else None, table[:, -joints:]


def _read_npz(path, _):
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.filelist) > MAX_ARRAY_BYTES:
            raise ValueError("it is too large")
    with np.load(path, allow_pickle=False) as file:
        if "configurations" not in file:
            raise ValueError(f"it has no array configurations, but {', '.join(file) or 'none'}")
        arrays = [np.asarray(file[n]) for n in ("configurations", "times") if n in file]
    if any(array.dtype.kind not in "fiu" for array in arrays):
        raise ValueError("it has something other than numbers")
    configurations, times = [*arrays, None][:2]
    return times, configurations.astype(np.float64)
