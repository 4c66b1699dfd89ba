"""Files of observations of sensors: a folder of shards, HDF5 files of a few hundred scenes each.

    observations = Observations("observations")
    observations.read(3, "front/rgb")  # of shard 3: uint8 (n, height, width, 3)
    observations.scenes(3)             # its n Scenes

docs/reference/file_formats.md describes the arrays. Images are compressed one by one, with a
checksum each, so each can be read alone.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from roboarm_nmp.datasets.format import get_array, offsets_of, read_base_scene
from roboarm_nmp.datasets.shards import (
    ShardFormat,
    common_attributes,
    read_array,
    read_obstacles,
    scenes_from,
    shard_path,
)
from roboarm_nmp.envs.perception.sensors import (
    Camera,
    PointCloud,
    SensorWorld,
    sensors_from_json,
    sensors_to_json,
)
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Scene

FORMAT = ShardFormat("observations", "roboarm-nmp observations")
open_shard = FORMAT.open


def observe(world: SensorWorld, sensors: dict[str, Camera | PointCloud]) -> dict[str, np.ndarray]:
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


def shard_bytes(
    task: str | Path,
    seed: int,
    first: int,
    sensors: dict[str, Camera | PointCloud],
    scenes: Sequence[Scene],
    configurations: Sequence[np.ndarray],
    observations: Sequence[dict[str, np.ndarray]],
    made_by: str,
) -> bytes:
    """The contents of a shard's file.

    Args:
        task, seed, first, scenes, made_by: as of `shards.ShardFormat.to_bytes`, n scenes.
        sensors: by name.
        configurations: float32 (n, j), rad.
        observations: n dicts, those of `observe`.
    """

    def images():  # made one after another: they are large
        for name in observations[0]:
            array = np.stack([observation[name] for observation in observations])
            yield (
                name,
                array,
                {
                    "chunks": (1, *array.shape[1:]),
                    "compression": "gzip",
                    "compression_opts": 4,
                    "shuffle": array.dtype == np.uint16,
                    "fletcher32": True,
                },
            )

    return FORMAT.to_bytes(
        task,
        seed,
        first,
        scenes,
        {"configuration": np.asarray(configurations, np.float32)},
        made_by,
        attributes={"sensors": sensors_to_json(sensors)},
        images=images(),
    )


class Observations:
    """A folder of shards, checked. Scenes are numbered through all shards.

    Args:
        folder: path.
        robot: the `Robot` that the scenes must have.

    Attributes:
        task: name of the scenes' task.
        seed: of the collection.
        sensors: dict of name -> sensor.
        base_scene: the `Scene` without the obstacles that vary.
        offsets: number of the first scene of each shard, and the number of all scenes: int64.

    Raises:
        DatasetError: there are no shards, or one is missing, damaged, or not of the same collection
            as the others; or they were made for another robot.
    """

    def __init__(self, folder: str | Path, robot: Robot = PANDA):
        self.folder = Path(folder)
        first = {}
        counts = []
        for path in FORMAT.paths(folder):
            with open_shard(path) as file:
                names = ("task", "seed", "sensors", "scene")
                attributes = common_attributes(file, path, names, first)
                counts.append(len(get_array(path, file, "configuration")))
            first = first or attributes
        self.offsets = offsets_of(counts)
        self.task: str = first["task"]
        self.seed: int = first["seed"]
        self.sensors: dict[str, Camera | PointCloud] = sensors_from_json(first["sensors"])
        self.base_scene: Scene = read_base_scene(folder, first["scene"], robot)

    def __len__(self) -> int:
        return int(self.offsets[-1])

    def read(self, number: int, name: str) -> np.ndarray:
        """One array of a shard, e.g. `read(3, "front/rgb")`. Raises DatasetError: it is damaged."""
        path = shard_path(self.folder, number)
        with open_shard(path) as file:
            return read_array(file, path, name)

    def scenes(self, number: int) -> list[Scene]:
        """The `Scene`s of a shard."""
        path = shard_path(self.folder, number)
        with open_shard(path) as file:
            counts, rows, vertices = read_obstacles(file, path)
        scenes = scenes_from(self.base_scene, counts, rows, vertices)
        return [scenes[i] for i in range(len(counts))]
