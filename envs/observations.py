"""Files of what sensors saw: a folder of shards, each an HDF5 file of some hundred scenes.

A shard, `shard_00012.h5`, has the arrays (n scenes)

- `obstacle_count` uint32 (n,) and `obstacles` float64 (k, 11): the scenes, one after another, as
  rows of `envs.scenes.to_array`; `configuration` float32 (n, 7), the arm's joint angles in rad;
- of each `Camera`, by its name, the outputs: `front/rgb` uint8 (n, height, width, 3),
  `front/segmentation` uint8 (n, height, width), `front/depth` uint16 (n, height, width) in units of
  `far` / 65,535;
- of each `PointCloud`, `depth` and `segmentation` of its grid: the points follow from them.

and the attributes `schema`, `schema_version`, `task`, `seed`, `first` (number of the first scene),
`scene` (JSON: the scene without the obstacles that vary), `sensors` (JSON), `made_by`. Images are
compressed one by one, with a checksum each, so that any of them can be read alone.
"""

import io
import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import h5py
import numpy as np

from envs import scenes
from envs.datasets import DatasetError, attribute, scene_from_json, scene_to_json
from envs.sensors import Camera, PointCloud
from envs.tasks import get_task, task_name

SCHEMA, SCHEMA_VERSION = "roboarm-nmp observations", 1
_KINDS = {"camera": Camera, "point_cloud": PointCloud}
_SHARD = re.compile(r"shard_(\d{5})\.h5")


def shard_path(folder, number):
    """Path of a folder's shard."""
    return Path(folder) / f"shard_{number:05d}.h5"


def sensors_to_json(sensors):
    """A dict of name -> `Camera` or `PointCloud` as text."""
    kinds = {kind: name for name, kind in _KINDS.items()}
    return json.dumps(
        {name: {"kind": kinds[type(sensor)], **asdict(sensor)} for name, sensor in sensors.items()}
    )


def sensors_from_json(text):
    """The inverse of `sensors_to_json`."""
    sensors = {}
    for name, fields in json.loads(text).items():
        kind = _KINDS[fields.pop("kind")]
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()}
        sensors[name] = kind(**values)
    return sensors


def observe(world, sensors):
    """What each sensor sees of a `SensorWorld`, in the form in which it is stored.

    Returns:
        A dict of `<sensor>/<output>` -> array, as a shard has them but for the first dimension.
    """
    arrays = {}
    for name, sensor in sensors.items():
        if isinstance(sensor, PointCloud):
            sensor = sensor.camera
        for output, array in sensor.observe(world).items():
            if output == "depth":
                array = np.round(array * (65_535 / sensor.far)).astype(np.uint16)
            arrays[f"{name}/{output}"] = array
    return arrays


def shard_bytes(task, seed, first, sensors, scenes_seen, configurations, observations, made_by):
    """The contents of a shard's file.

    Args:
        task: name of the task, or path of a scene file.
        seed: of the collection, an int.
        first: number of the first scene.
        sensors: dict of name -> sensor.
        scenes_seen: list of n `Scene`s.
        configurations: float32 (n, 7), rad.
        observations: list of n dicts, those of `observe`.
        made_by: the command line that makes the shards.
    """
    rows = scenes.to_array([o for scene in scenes_seen for o in scene.obstacles])
    arrays = {
        "obstacle_count": np.array([len(scene.obstacles) for scene in scenes_seen], np.uint32),
        "obstacles": rows,
        "configuration": np.asarray(configurations, np.float32),
    }
    attributes = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "task": task_name(task),
        "seed": int(seed),
        "first": int(first),
        "scene": scene_to_json(get_task(task).base_scene),
        "sensors": sensors_to_json(sensors),
        "made_by": made_by,
    }
    contents = io.BytesIO()
    with h5py.File(contents, "w", libver=("v110", "v110")) as file:
        for name, value in attributes.items():
            file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value
        for name, array in arrays.items():
            file.create_dataset(name, data=array, track_times=False, fletcher32=array.size > 0)
        for name in observations[0]:
            array = np.stack([one[name] for one in observations])
            file.create_dataset(
                name,
                data=array,
                chunks=(1, *array.shape[1:]),
                compression="gzip",
                compression_opts=4,
                shuffle=array.dtype == np.uint16,
                fletcher32=True,
                track_times=False,
            )
    return contents.getvalue()


def open_shard(path):
    """An `h5py.File` of a shard. Raises DatasetError: damaged, or something else."""
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise DatasetError(f"{path}: truncated or corrupt HDF5 ({error})") from error
    schema = attribute(file, "schema"), attribute(file, "schema_version")
    if schema != (SCHEMA, SCHEMA_VERSION):
        file.close()
        raise DatasetError(f"{path}: not observations of version {SCHEMA_VERSION}: {schema}")
    return file


class Observations:
    """A folder of shards, checked; scenes are numbered through all of them.

    Args:
        folder: path.

    Raises:
        DatasetError: there are no shards, or one is missing, damaged, or not of the same collection
            as the others.
    """

    def __init__(self, folder):
        self.folder = Path(folder)
        numbers = sorted(
            int(match[1]) for path in self.folder.glob("*") if (match := _SHARD.match(path.name))
        )
        if not numbers:
            raise DatasetError(f"{folder}: no observations (shard_00000.h5, ...) in this folder")
        if numbers != list(range(len(numbers))):
            missing = next(i for i, number in enumerate(numbers) if i != number)
            raise DatasetError(f"{shard_path(folder, missing)}: no such file, but later ones exist")
        self.offsets = np.zeros(len(numbers) + 1, np.int64)
        """Number of the first scene of each shard, and of all scenes."""
        first = None
        for number in numbers:
            with open_shard(shard_path(self.folder, number)) as file:
                found = {name: attribute(file, name) for name in ("task", "seed", "sensors")}
                found["scene"] = attribute(file, "scene")
                self.offsets[number + 1] = self.offsets[number] + len(file["configuration"])
            first = first or found
            for name, value in found.items():
                if value != first[name]:
                    path = shard_path(folder, number)
                    raise DatasetError(f"{path}: another {name} than that of the first shard")
        self.task, self.seed = first["task"], first["seed"]
        self.sensors = sensors_from_json(first["sensors"])
        """Dict of name -> sensor."""
        self.base_scene = scene_from_json(first["scene"])

    def __len__(self):
        return int(self.offsets[-1])

    def read(self, number, name):
        """One array of a shard, e.g. `read(3, "front/rgb")`. Raises DatasetError if it is bad."""
        with open_shard(shard_path(self.folder, number)) as file:
            try:
                return file[name][()]
            except (KeyError, OSError) as error:
                path = shard_path(self.folder, number)
                raise DatasetError(f"{path}: {name} is missing or corrupt ({error})") from error

    def scenes(self, number):
        """The `Scene`s of a shard, a list."""
        counts, rows = self.read(number, "obstacle_count"), self.read(number, "obstacles")
        ends = np.cumsum(counts.astype(np.int64))
        return [
            replace(self.base_scene, obstacles=scenes.from_array(rows[end - count : end]))
            for end, count in zip(ends, counts, strict=True)
        ]
