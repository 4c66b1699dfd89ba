"""Folders of shards: `shard_00012.h5` and so on, HDF5 files of a few hundred scenes each.

Arrays and HDF5's metadata have checksums: damage is detected when it is read. `collect` makes the
shards of a folder, whatever their contents.
"""

import contextlib
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np

from roboarm_nmp.datasets.format import (
    DatasetError,
    QueryScenes,
    attribute,
    check_plain,
    check_schema,
    get_array,
    hdf5_bytes,
    offsets_of,
    open_hdf5,
)
from roboarm_nmp.envs.scenes.primitives import Scene, hull_vertices, scene_to_json, to_array
from roboarm_nmp.envs.tasks import get_task, task_name
from roboarm_nmp.utils import workers
from roboarm_nmp.utils.files import check_folder, write_atomically
from roboarm_nmp.utils.progress import progress_bar, write_line

_SHARD = re.compile(r"shard_(\d{5})\.h5")


def shard_path(folder: str | Path, number: int) -> Path:
    """Path of a folder's shard."""
    return Path(folder) / f"shard_{number:05d}.h5"


@dataclass(frozen=True)
class ShardFormat:
    """A kind of shards.

    Attributes:
        contents: what they have, in words.
        schema, version: of their files.
    """

    contents: str
    schema: str
    version: int = 1

    def paths(self, folder: str | Path) -> list[Path]:
        """Paths of all shards of a folder, in order.

        Raises DatasetError: there are none, or one is missing.
        """
        matches = [_SHARD.fullmatch(path.name) for path in Path(folder).glob("*")]
        numbers = sorted(int(match[1]) for match in matches if match)
        if not numbers:
            raise DatasetError(f"{folder}: no {self.contents} (shard_00000.h5, ...) in this folder")
        for expected, number in enumerate(numbers):
            if number != expected:
                path = shard_path(folder, expected)
                raise DatasetError(f"{path}: no such file, but later ones exist")
        return [shard_path(folder, number) for number in numbers]

    @contextlib.contextmanager
    def open(self, path: str | Path) -> Iterator[h5py.File]:
        """A context with the `h5py.File` of a shard.

        Raises DatasetError: it is of another kind, or damaged. Damage may also be found later, in
        the context.
        """
        with open_hdf5(path) as file:
            check_schema(path, file, self.contents, self.schema, self.version)
            check_plain(path, file)
            yield file

    def to_bytes(
        self,
        task: str | Path,
        seed: int,
        first: int,
        scenes: Sequence[Scene],
        arrays: dict[str, np.ndarray],
        made_by: str,
        attributes: dict[str, str] | None = None,
        images: Iterable[tuple[str, np.ndarray, dict]] = (),
    ) -> bytes:
        """The contents of a shard's file.

        Args:
            task: name of the task, path of a scene file, or `TASK@ROBOT`.
            seed: of the collection.
            first: number of the first scene.
            scenes: the `Scene`s.
            arrays: those of this kind, by name.
            made_by: the command line that makes the shards.
            attributes: further ones.
            images: further arrays, with their options, as of `format.hdf5_bytes`.

        Raises DatasetError: scenes that shards cannot have.
        """
        if not all(scene.is_static for scene in scenes):
            raise DatasetError(f"{self.contents} are of static scenes: obstacles of this task move")
        obstacles = [obstacle for scene in scenes for obstacle in scene.obstacles]
        if any(obstacle.may_touch for obstacle in obstacles):
            raise DatasetError(
                f"files of {self.contents} cannot have random obstacles with may_touch"
            )
        counts = [len(scene.obstacles) for scene in scenes]
        arrays = {
            "obstacle_count": np.array(counts, np.uint32),
            "obstacles": to_array(obstacles),
            "hull_vertices": hull_vertices(obstacles),
            **arrays,
        }
        if not len(arrays["hull_vertices"]):
            del arrays["hull_vertices"]
        all_attributes = {
            "schema": self.schema,
            "schema_version": self.version,
            "task": task_name(task),
            "seed": int(seed),
            "first": int(first),
            "scene": scene_to_json(get_task(task).base_scene),
            "made_by": made_by,
            **(attributes or {}),
        }
        datasets = [(name, array, {"fletcher32": True}) for name, array in arrays.items()]
        return hdf5_bytes(all_attributes, itertools.chain(datasets, images))


def read_array(file: h5py.File, path: str | Path, name: str) -> np.ndarray:
    """An array of an open shard. Raises DatasetError if it is bad."""
    try:
        return np.asarray(get_array(path, file, name)[()])
    except OSError as error:
        raise DatasetError(f"{path}: {name} is missing or corrupt ({error})") from error


def read_obstacles(file: h5py.File, path: str | Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`obstacle_count`, `obstacles` and `hull_vertices` of an open shard. Raises DatasetError."""
    vertices = np.empty((0, 3))
    if "hull_vertices" in file:
        vertices = read_array(file, path, "hull_vertices")
    counts = read_array(file, path, "obstacle_count")
    return counts, read_array(file, path, "obstacles"), vertices


def scenes_from(
    base: Scene, counts: np.ndarray, rows: np.ndarray, vertices: np.ndarray
) -> QueryScenes:
    """The scenes of arrays as `read_obstacles` gives them, in their order."""
    return QueryScenes(base, np.arange(len(counts)), offsets_of(counts), rows, vertices)


def common_attributes(
    file: h5py.File, path: str | Path, names: Sequence[str], first: dict[str, Any]
) -> dict[str, Any]:
    """Attributes of an open shard. Raises DatasetError unless they are those of the first one.

    `first` has the attributes of that one; it is empty for itself.
    """
    attributes = {name: attribute(file, name) for name in names}
    for name, value in attributes.items():
        if first and value != first[name]:
            raise DatasetError(f"{path}: its {name} differs from that of the first shard")
    return attributes


# --- Making all of a folder


class CollectionFlags(Protocol):
    """The flags that the commands for collecting share."""

    task: str
    output: Path
    shard_size: int
    workers: int
    ray_address: str | None


def check_collection(args: CollectionFlags) -> None:
    """Raise ValueError for flags of a collection that cannot work."""
    check_folder(args.output)
    if not get_task(args.task).trainable:
        raise ValueError(f"{args.task} is for testing only: training on it is not allowed")
    workers.check_ray(args.ray_address)


def collect(
    args: CollectionFlags,
    num_scenes: int,
    collector: type,
    arguments: tuple,
    made_by: str,
    open_shard: Callable[[Path], contextlib.AbstractContextManager[h5py.File]],
    *,
    counted: str,
    unit: str,
    per_scene: int = 1,
    progress: bool = True,
) -> None:
    """Make the missing shards of a folder in workers. Each shard is written atomically.

    Args:
        args: the flags; `output` is the folder.
        num_scenes: number of scenes in all shards.
        collector: a class. Its instances are functions from a job, `(number, first scene, scene
            after the last)`, to `(number, contents of the file)`.
        arguments: those of the class.
        made_by: the command line that the shards store. Shards with another one do not belong to
            this collection.
        open_shard: a function from a path to a context with an `h5py.File`.
        counted: name of an array with a row per scene.
        unit, per_scene: unit of the progress bar, and the number of them per scene.
        progress: whether there is a bar.

    Raises:
        ValueError: the folder holds shards of another collection, or damaged ones.
        RuntimeError: workers keep dying.
        ConnectionError: there is no Ray cluster.
        OSError: the folder cannot be written. Finished shards are kept.
    """
    missing = []
    for number, first in enumerate(range(0, num_scenes, args.shard_size)):
        end = min(first + args.shard_size, num_scenes)
        path = shard_path(args.output, number)
        if not path.exists() or _count(path, made_by, open_shard, counted) < end - first:
            missing.append((number, first, end))  # the last shard may have had fewer scenes
    scenes_of = {number: end - first for number, first, end in missing}
    bar = progress_bar(
        description=str(args.task),
        total=num_scenes * per_scene,
        initial=(num_scenes - sum(scenes_of.values())) * per_scene,
        unit=unit,
        disable=not progress,
    )
    if args.ray_address is None:
        results = workers.run(collector, arguments, missing, args.workers, warn=write_line)
    else:
        results = workers.run_on_ray(args.ray_address, collector, arguments, missing)
    with bar, contextlib.closing(results):
        for number, contents in results:
            args.output.mkdir(parents=True, exist_ok=True)
            write_atomically(shard_path(args.output, number), contents)
            bar.update(scenes_of[number] * per_scene)


def _count(path, made_by, open_shard, counted):
    """The number of scenes in a shard. Raises ValueError: it is of another collection."""
    with open_shard(path) as file:
        stored = attribute(file, "made_by")
        count = len(get_array(path, file, counted))
    if stored != made_by:
        raise ValueError(f"{path} was made by another command: {stored}")
    return count
