"""Files of observations of sensors: a folder of shards, HDF5 files of a few hundred scenes each.

A shard, `shard_00012.h5`, has the arrays (n scenes)

- `obstacle_count` uint32 (n,) and `obstacles` float64 (k, 11): the scenes, one after another, as
  rows of `envs.scenes.primitives.to_array`; where there are convex hulls, `hull_vertices` float64
  (v, 3), their vertices, one hull after another;
- `configuration` float32 (n, j), the arm's joint angles in rad;
- of each `Camera`, by its name, the outputs: `front/rgb` uint8 (n, height, width, 3),
  `front/segmentation` uint8 (n, height, width), `front/depth` uint16 (n, height, width) in units of
  `far` / 65,535;
- of each `PointCloud`, `depth` and `segmentation` of its grid, from which the points follow;

and the attributes `schema`, `schema_version`, `task`, `seed`, `first` (number of the first scene),
`scene` (JSON: the scene without the obstacles that vary), `sensors` (JSON), `made_by`. Images are
compressed one by one, with a checksum each, so each can be read alone.
"""

import io
from pathlib import Path

import h5py
import numpy as np

from roboarm_nmp.datasets import shards
from roboarm_nmp.datasets.format import (
    DatasetError,
    QueryScenes,
    attribute,
    read_base_scene,
)
from roboarm_nmp.datasets.shards import (
    read_array,
    read_vertices,
    shard_path,
    shard_paths,
    write_attributes,
)
from roboarm_nmp.envs.perception.sensors import (
    PointCloud,
    sensors_from_json,
    sensors_to_json,
)
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import hull_vertices, scene_to_json, to_array
from roboarm_nmp.envs.tasks import get_task, task_name

SCHEMA, SCHEMA_VERSION = "roboarm-nmp observations", 1


def observe(world, sensors):
    """The observation of a `SensorWorld` by each sensor, in the form in which it is stored.

    Returns:
        A dict of `<sensor>/<output>` -> array, as in a shard but without the first dimension.
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


def shard_bytes(task, seed, first, sensors, scenes, configurations, observations, made_by):
    """The contents of a shard's file.

    Args:
        task: name of the task, path of a scene file, or `TASK@ROBOT`.
        seed: of the collection, an int.
        first: number of the first scene.
        sensors: dict of name -> sensor.
        scenes: list of n `Scene`s.
        configurations: float32 (n, j), rad.
        observations: list of n dicts, those of `observe`.
        made_by: the command line that makes the shards.
    """
    if not all(scene.is_static for scene in scenes):
        raise DatasetError("observations are of static scenes: obstacles of this task move")
    obstacles = [o for scene in scenes for o in scene.obstacles]
    if any(obstacle.may_touch for obstacle in obstacles):
        raise DatasetError("files of observations cannot have random obstacles with may_touch")
    arrays = {
        "obstacle_count": np.array([len(scene.obstacles) for scene in scenes], np.uint32),
        "obstacles": to_array(obstacles),
        "configuration": np.asarray(configurations, np.float32),
    }
    if len(vertices := hull_vertices(obstacles)):
        arrays["hull_vertices"] = vertices
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
        write_attributes(file, attributes)
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
    """A context with the `h5py.File` of a shard. Raises DatasetError: as `shards.open_shard`."""
    return shards.open_shard(path, "observations", SCHEMA, SCHEMA_VERSION)


class Observations:
    """A folder of shards, checked. Scenes are numbered through all shards.

    Args:
        folder: path.
        robot: the `Robot` that the scenes must have.

    Raises:
        DatasetError: there are no shards, or one is missing, damaged, or not of the same collection
            as the others; or they were made for another robot.
    """

    def __init__(self, folder, robot=PANDA):
        self.folder = Path(folder)
        paths = shard_paths(folder, "observations")
        self.offsets = np.zeros(len(paths) + 1, np.int64)
        """Number of the first scene of each shard, and the number of all scenes."""
        first = None
        for number, path in enumerate(paths):
            with open_shard(path) as file:
                found = {name: attribute(file, name) for name in ("task", "seed", "sensors")}
                found["scene"] = attribute(file, "scene")
                self.offsets[number + 1] = self.offsets[number] + len(file["configuration"])
            first = first or found
            for name, value in found.items():
                if value != first[name]:
                    raise DatasetError(f"{path}: its {name} differs from that of the first shard")
        self.task, self.seed = first["task"], first["seed"]
        self.sensors = sensors_from_json(first["sensors"])
        """Dict of name -> sensor."""
        self.base_scene = read_base_scene(folder, first["scene"], robot)

    def __len__(self):
        return int(self.offsets[-1])

    def read(self, number, name):
        """One array of a shard, e.g. `read(3, "front/rgb")`. Raises DatasetError: it is damaged."""
        path = shard_path(self.folder, number)
        with open_shard(path) as file:
            return read_array(file, path, name)

    def scenes(self, number):
        """The `Scene`s of a shard, a list."""
        path = shard_path(self.folder, number)
        with open_shard(path) as file:
            counts, rows = (read_array(file, path, n) for n in ("obstacle_count", "obstacles"))
            vertices = read_vertices(file, path)
        offsets = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        indices = np.arange(len(counts))
        scenes = QueryScenes(self.base_scene, indices, offsets, rows, vertices)
        return [scenes[i] for i in indices]
