"""LeRobot datasets (version 3.0: Parquet files and `meta/`), in and out.

    write_lerobot("wall_lerobot", load_demos("wall"))
    recordings = read_lerobot("my_teleoperation", PANDA)
    write_demonstrations("teleop.h5", recordings, "wall")

`roboarm export` and `roboarm import` do the same. Needs the extra `lerobot` (pyarrow); the package
`lerobot` itself isn't needed. A frame of ours has the joint angles (`observation.state`), the
commanded ones (`action`) and the goal's (`observation.environment_state`), all in rad.
"""

import contextlib
import importlib.util
import io
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from roboarm_nmp.datasets.demonstrations import Demos
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.recordings import Recording
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.utils.documents import (
    Mistake,
    load_document,
    mapping,
    mistakes_in,
    plain_data,
    switch,
    text,
)

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = "v3.0"
STATE = "observation.state"
ACTION = "action"
GOAL = "observation.environment_state"
IMAGE = "observation.images.camera"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FIRST = {"chunk_index": 0, "file_index": 0}
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
INDICES = {
    name: {"dtype": dtype, "shape": [1], "names": None}
    for name, dtype in (
        ("timestamp", "float32"),
        ("frame_index", "int64"),
        ("episode_index", "int64"),
        ("index", "int64"),
        ("task_index", "int64"),
    )
}
"""The features that every dataset has."""
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
MAX_FRAMES = 10_000_000


def check_pyarrow() -> None:
    """Raise ImportError unless pyarrow is installed."""
    if importlib.util.find_spec("pyarrow") is None:
        raise ImportError('this needs the extra `lerobot`: pip install -e ".[lerobot]"')


# --- Out


def write_lerobot(
    folder: str | Path, demos: Demos, env: RoboArmEnv | None = None, overwrite: bool = False
) -> int:
    """Write demonstrations as a LeRobot dataset, a folder. Returns its number of frames.

    Args:
        folder: the folder to write. An existing one is replaced once the new one is complete.
        demos: the `Demos`, in a fixed scene, which a dataset doesn't store.
        env: with an environment of the task with `render_mode="rgb_array"`, frames have an image.
        overwrite: replace a folder that exists.

    Raises:
        ImportError: pyarrow is not installed.
        ValueError: the folder exists, or the scenes vary.
        OSError: it cannot be written.
    """
    check_pyarrow()
    folder = Path(folder)
    if folder.exists() and not overwrite:
        raise ValueError(f"{folder} exists; --overwrite replaces it")
    if demos.scenes.index is not None:
        raise ValueError(
            f"the scenes of {demos.task} vary, and a LeRobot dataset does not store them: only "
            f"demonstrations in a fixed scene can be exported"
        )
    new = folder.with_name(f".{folder.name}.exporting")
    shutil.rmtree(new, ignore_errors=True)
    try:
        _write(new, demos, env)
        if folder.exists():
            old = folder.with_name(f".{folder.name}.replaced")
            folder.rename(old)
            new.rename(folder)
            shutil.rmtree(old)
        else:
            new.rename(folder)
    finally:
        shutil.rmtree(new, ignore_errors=True)
    return len(demos.states)


def _write(folder, demos, env):
    import pyarrow as pa

    robot = demos.scenes.base.robot
    joints = list(robot.joint_names)
    lengths = np.diff(demos.offsets)
    frame = np.arange(demos.offsets[-1])
    episode = np.repeat(np.arange(len(demos)), lengths)
    in_episode = frame - demos.offsets[episode]
    columns = {
        STATE: robot.denormalise(demos.states).astype(np.float32),
        ACTION: robot.denormalise(demos.states + demos.actions).astype(np.float32),
        GOAL: demos.goal[episode],
        "timestamp": (in_episode * STEP_SECONDS).astype(np.float32),
        "frame_index": in_episode,
        "episode_index": episode,
        "index": frame,
        "task_index": np.zeros_like(frame),
    }
    features: dict[str, dict] = {
        name: {"dtype": "float32", "shape": [len(joints)], "names": names}
        for name, names in (
            (STATE, joints),
            (ACTION, joints),
            (GOAL, [f"goal.{joint}" for joint in joints]),
        )
    }
    task = f"reach the goal configuration ({demos.task})"
    starts, ends = demos.offsets[:-1], demos.offsets[1:]
    episodes: dict[str, Any] = {
        "episode_index": np.arange(len(demos)),
        "tasks": [[task]] * len(demos),
        "length": lengths,
        "data/chunk_index": np.zeros_like(lengths),
        "data/file_index": np.zeros_like(lengths),
        "dataset_from_index": starts,
        "dataset_to_index": ends,
        "meta/episodes/chunk_index": np.zeros_like(lengths),
        "meta/episodes/file_index": np.zeros_like(lengths),
    }
    stats = {name: _statistics(values) for name, values in columns.items()}
    for name, values in columns.items():
        of_episodes = [_statistics(values[a:b]) for a, b in zip(starts, ends, strict=True)]
        for statistic in stats[name]:
            key = f"stats/{name}/{statistic}"
            episodes[key] = [of_episode[statistic] for of_episode in of_episodes]
    table = {name: _array(values) for name, values in columns.items()}
    if env is not None:
        images = pa.array(list(_images(demos, env)), pa.binary())
        names = ["bytes", "path"]
        table[IMAGE] = pa.StructArray.from_arrays(
            [images, pa.nulls(len(images), pa.string())], names
        )
        shape = [*reversed(env.render_size), 3]
        features[IMAGE] = {
            "dtype": "image", "shape": shape, "names": ["height", "width", "channels"]
        }  # fmt: skip
    info = {
        "codebase_version": VERSION,
        "robot_type": robot.name,
        "total_episodes": len(demos),
        "total_frames": len(frame),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": round(1 / STEP_SECONDS),
        "splits": {"train": f"0:{len(demos)}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features | INDICES,
    }
    _write_table(folder / DATA_PATH.format(**FIRST), pa.table(table))
    _write_table(folder / EPISODES_PATH, pa.table(episodes))
    # As pandas writes a table whose index is the text of the tasks.
    column = {"field_name": "task_index", "name": "task_index", "pandas_type": "int64",
              "numpy_type": "int64", "metadata": None}  # fmt: skip
    index = {"field_name": "__index_level_0__", "name": None, "pandas_type": "unicode",
             "numpy_type": "object", "metadata": None}  # fmt: skip
    pandas = {
        "index_columns": ["__index_level_0__"],
        "column_indexes": [],
        "columns": [column, index],
    }
    tasks = pa.table({"task_index": [0], "__index_level_0__": [task]})
    tasks = tasks.replace_schema_metadata({"pandas": json.dumps(pandas)})
    _write_table(folder / "meta/tasks.parquet", tasks)
    (folder / "meta/info.json").write_text(json.dumps(info, indent=4))
    (folder / "meta/stats.json").write_text(json.dumps(stats, indent=4))


def _write_table(path, table):
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _array(values: np.ndarray) -> "pa.Array":
    import pyarrow as pa

    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def _statistics(values):
    """Statistics by name, lists of one number per column."""
    values = values.reshape(len(values), -1).astype(np.float64)
    found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0)}
    found["std"] = values.std(0)
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    found |= dict(zip(QUANTILES, quantiles, strict=True))
    return {name: array.tolist() for name, array in found.items()} | {"count": [len(values)]}


def _images(demos, env) -> Iterator[bytes]:
    """An image of each state, as PNG."""
    for demo in demos:
        env.reset_specific(demo.start, demo.goal)
        for configuration in demo.configurations:
            env.world.place(configuration.tolist())
            contents = io.BytesIO()
            Image.fromarray(env.render()).save(contents, "png")
            yield contents.getvalue()


# --- In


@dataclass(frozen=True)
class JointNames:
    """Where the joints of an arm are in a dataset; `load_joint_names` reads it from a YAML file.

    Attributes:
        joints: the arm's name of a joint -> the dataset's. Others have the same name.
        state, action: the features with the joint angles, and with the commanded ones; `action` is
            None where these are not used.
        degrees: whether the dataset's angles are in degrees.
    """

    joints: dict[str, str] = field(default_factory=dict)
    state: str = STATE
    action: str | None = None
    degrees: bool = False


def load_joint_names(path: str | Path) -> JointNames:
    """Read a YAML file with keys `joints`, `state`, `action`, `degrees`, none of them required.

    Raises DocumentError, which names the line.
    """
    with mistakes_in(path):
        fields = mapping(load_document(path), "the file")
        found: dict[str, Any] = {}
        for key, node in fields.items():
            if key == "joints":
                names = mapping(node, "joints").items()
                found[key] = {str(ours): text(theirs, ours) for ours, theirs in names}
            elif key == "degrees":
                found[key] = switch(node)
                if found[key] is None:
                    raise Mistake(node, "degrees must be true or false")
            elif key in ("state", "action"):
                found[key] = text(node, key)
            else:
                raise Mistake(node, f"unknown key {key!r}: joints, state, action or degrees")
    return JointNames(**found)


def read_lerobot(
    folder: str | Path, robot: Robot, names: JointNames | None = None
) -> list[Recording]:
    """The episodes of a LeRobot dataset, version 3: one `Recording` each, named by its number.

    Videos and images are not read.

    Args:
        folder: with `meta/info.json`.
        robot: the `Robot`; other joints of the dataset, such as the gripper's, are left out.
        names: where the joints are, if they have other names.

    Raises:
        ImportError: pyarrow is not installed.
        DatasetError, utils.documents.DocumentError: the dataset cannot be used.
    """
    check_pyarrow()
    import pyarrow as pa
    from pyarrow.dataset import dataset as open_dataset

    folder = Path(folder)
    names = names or JointNames()
    info = plain_data(load_document(folder / "meta" / "info.json"))
    path = folder / "meta" / "info.json"
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not str(version).startswith("v3."):
        raise DatasetError(
            f"{path}: codebase_version is {version!r}, this code reads v3: convert it with LeRobot"
        )
    columns = {name: _columns(path, info, name, robot, names) for name in
               (names.state, names.action) if name is not None}  # fmt: skip
    files = sorted((folder / "data").glob("*/*.parquet"))
    if not files:
        raise DatasetError(f"{folder / 'data'}: no .parquet files")
    wanted = ["episode_index", "frame_index", "timestamp", *columns]
    try:
        dataset = open_dataset([str(file) for file in files], format="parquet")
        if dataset.count_rows() > MAX_FRAMES:
            raise ValueError(f"more than {MAX_FRAMES:,} frames")
        table = dataset.to_table(columns=wanted)
        arrays = {name: _numbers(table[name]) for name in wanted}
    except (pa.ArrowException, OSError, LookupError, TypeError, ValueError) as error:
        raise DatasetError(f"{folder}: its data cannot be read ({error})") from error
    order = np.lexsort((arrays["frame_index"], arrays["episode_index"]))
    arrays = {name: values[order] for name, values in arrays.items()}
    angles = {}
    for name, chosen in columns.items():
        if arrays[name].ndim != 2 or arrays[name].shape[1] <= max(chosen):
            raise DatasetError(f"{folder}: {name} has other columns than meta/info.json names")
        values = arrays[name][:, chosen].astype(np.float64)
        angles[name] = np.radians(values) if names.degrees else values
    numbers, starts = np.unique(arrays["episode_index"], return_index=True)
    ends = [*starts[1:], len(order)]
    return [
        Recording(
            positions=angles[names.state][first:last],
            times=arrays["timestamp"][first:last].astype(np.float64),
            actions=None if names.action is None else angles[names.action][first:last],
            name=f"episode {number}",
        )
        for number, first, last in zip(numbers, starts, ends, strict=True)
    ]


def _columns(path, info, name, robot, names):
    """The columns of the arm's joints in a feature. Raises DatasetError."""
    features = info.get("features")
    feature = features.get(name) if isinstance(features, dict) else None
    if not isinstance(feature, dict):
        known = ", ".join(features) if isinstance(features, dict) else "none"
        raise DatasetError(f"{path}: there is no feature {name!r}; there are: {known}")
    theirs = feature.get("names")
    if isinstance(theirs, dict):  # {"motors": [...]}
        theirs = next(iter(theirs.values()), None)
    theirs = [str(one) for one in theirs] if isinstance(theirs, list) else []
    columns = []
    for joint in robot.joint_names:
        wanted = names.joints.get(joint, joint)
        if wanted not in theirs:
            raise DatasetError(
                f"{path}: {name} has no {wanted!r}, for {joint}; it has: {', '.join(theirs)}. Name "
                f"the joints in a YAML file: --joints FILE"
            )
        columns.append(theirs.index(wanted))
    return columns


def _numbers(column: "pa.ChunkedArray") -> np.ndarray:
    """A column as an array (m,) or (m, k)."""
    column = column.combine_chunks()
    with contextlib.suppress(AttributeError):  # a list's
        flat = column.flatten().to_numpy(zero_copy_only=False)
        return flat.reshape(len(column), -1)
    return column.to_numpy(zero_copy_only=False)
