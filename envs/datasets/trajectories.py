"""Joint paths as files, to plot, to show or to run on an arm: `.csv` or `.npz`, by the ending.

    save_trajectory("episode.csv", trajectory)             # an episode of `envs.policies.rollout`
    save_joint_path("path.csv", configurations, times)     # a path of one's own
    times, configurations = load_joint_path("path.csv")    # of either

`roboarm show --trajectory FILE` plays such a file; `--save-trajectory FILE` writes one.

A `.csv` file has a header and a row per configuration: `time` (s) and the joint angles `q1` to `q7`
(rad). An episode also has the action after each configuration (`action1` to `action7`), whether the
arm was in contact on the way to the next one (`contact`, 0 or 1) and the policy's computing time
(`policy_seconds`); the last configuration has none of these. A `.npz` file has the same as arrays:
`times` (n,), `configurations` (n, 7); of an episode also `states` (n, 7), normalised, `actions`
(n - 1, 7), `contacts` and `policy_seconds` (n - 1,), and `success`.

Read are only the joint angles and, if there are any, the times: other columns and arrays do not
matter.
"""

import csv
import io
import zipfile
from pathlib import Path

import numpy as np

from roboarm_nmp.envs import panda
from roboarm_nmp.envs.datasets.format import MAX_ARRAY_BYTES, DatasetError
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.envs.utils.files import write_atomically
from roboarm_nmp.envs.world import SUBSTEPS, TIME_STEP

STEP_SECONDS = SUBSTEPS * TIME_STEP
"""s, of one environment step: 1/30."""
ENDINGS = (".csv", ".npz")
JOINTS = tuple(f"q{joint}" for joint in range(1, panda.NUM_JOINTS + 1))
LIMIT_TOLERANCE = 0.1  # rad. The simulated arm may exceed its limits a little; degrees exceed them.


def check_ending(path):
    """Raise ValueError unless a path ends in .csv or .npz."""
    if Path(path).suffix.lower() not in ENDINGS:
        raise ValueError(f"a trajectory's file must end in .csv or .npz, got {path}")


def timed(path):
    """A path at the speed of the environment, one sub-goal per step.

    Args:
        path: waypoints (n, 7), rad, as of `Planner.plan`.

    Returns:
        times (m,), s, from 0 on, `STEP_SECONDS` apart; configurations (m, 7), rad.
    """
    configurations = panda.denormalise(subgoals(path))
    return np.arange(len(configurations)) * STEP_SECONDS, configurations


def save_joint_path(path, configurations, times):
    """Write a joint path, atomically.

    Args:
        path: the file, .csv or .npz; an existing one is replaced.
        configurations: (n, 7), rad.
        times: (n,), s.

    Raises:
        ValueError: another ending, or other shapes.
        OSError: the file cannot be written.
    """
    configurations, times = np.asarray(configurations), np.asarray(times)
    if configurations.shape != (len(times), panda.NUM_JOINTS) or times.ndim != 1:
        raise ValueError(
            f"configurations must be (n, 7) and times (n,), got {configurations.shape} and "
            f"{times.shape}"
        )
    _write(path, {"time": times}, configurations, {"times": times})


def save_trajectory(path, trajectory):
    """Write an episode, a `Trajectory`, as `save_joint_path` does; its first time is 0."""
    times = np.arange(len(trajectory.states)) * STEP_SECONDS
    columns = {"time": times}
    columns |= {f"action{i + 1}": trajectory.actions[:, i] for i in range(panda.NUM_JOINTS)}
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


def load_joint_path(path):
    """The times (n,), s, and configurations (n, 7), rad, in a file, whoever made it.

    Without times, the configurations are waypoints: the result is `timed`.

    Raises DatasetError: no such file, or not a joint path.
    """
    try:
        check_ending(path)
        read = _read_csv if Path(path).suffix.lower() == ".csv" else _read_npz
        times, configurations = read(path)
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror or error}") from error
    except (ValueError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path}: not a joint path: {error}") from error
    if configurations.ndim != 2 or configurations.shape[1] != 7 or not len(configurations):
        raise DatasetError(f"{path}: configurations must be (n, 7), are {configurations.shape}")
    if not np.isfinite(configurations).all():
        raise DatasetError(f"{path}: it has joint angles that are not finite")
    beyond = np.maximum(panda.LOWER - configurations, configurations - panda.UPPER).max(0)
    if beyond.max() > LIMIT_TOLERANCE:
        raise DatasetError(
            f"{path}: {JOINTS[beyond.argmax()]} exceeds its limits by {beyond.max():.2f} rad (are "
            f"the angles in rad?)"
        )
    if times is None:
        return timed(configurations)
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
    columns = dict([time, *zip(JOINTS, configurations.T, strict=True), *others])
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in range(len(configurations)):
        writer.writerow([column[row] if row < len(column) else "" for column in columns.values()])
    write_atomically(path, text.getvalue().encode())


def _read_csv(path):
    with open(path, newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file, skipinitialspace=True)
        names = [name for name in ("time", *JOINTS) if name in (rows.fieldnames or ())]
        missing = [name for name in JOINTS if name not in names]
        if missing:
            raise ValueError(f"it has no column {missing[0]}; the header names q1 to q7, rad")
        try:
            table = [[float(row[name]) for name in names] for row in rows]
        except (TypeError, ValueError, csv.Error) as error:
            raise ValueError(f"line {rows.line_num}: not a number") from error
    table = np.array(table).reshape(-1, len(names))
    return table[:, 0] if "time" in names else None, table[:, -panda.NUM_JOINTS :]


def _read_npz(path):
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
