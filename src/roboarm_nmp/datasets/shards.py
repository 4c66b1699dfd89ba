"""Folders of shards: `shard_00012.h5` and so on, HDF5 files of a few hundred scenes each.

Arrays and HDF5's metadata have checksums: damage is detected when it is read. `collect` makes the
shards of a folder, whatever their contents.
"""

import contextlib
import re
from pathlib import Path

import h5py
import numpy as np

from roboarm_nmp.datasets.format import DatasetError, attribute, check_plain
from roboarm_nmp.envs.tasks import get_task
from roboarm_nmp.utils import workers
from roboarm_nmp.utils.files import check_folder, write_atomically
from roboarm_nmp.utils.progress import progress_bar, write_line

_SHARD = re.compile(r"shard_(\d{5})\.h5")


def shard_path(folder, number):
    """Path of a folder's shard."""
    return Path(folder) / f"shard_{number:05d}.h5"


def shard_paths(folder, what):
    """Paths of all shards of a folder, in order.

    Raises DatasetError: there are no shards, or one is missing. `what` names their contents.
    """
    numbers = sorted(
        int(match[1]) for path in Path(folder).glob("*") if (match := _SHARD.fullmatch(path.name))
    )
    if not numbers:
        raise DatasetError(f"{folder}: no {what} (shard_00000.h5, ...) in this folder")
    if numbers != list(range(len(numbers))):
        missing = next(i for i, number in enumerate(numbers) if i != number)
        raise DatasetError(f"{shard_path(folder, missing)}: no such file, but later ones exist")
    return [shard_path(folder, number) for number in numbers]


def write_attributes(file, attributes):
    """Write strings and numbers by name. (Strings have a fixed length: see `format.write_file`.)"""
    for name, value in attributes.items():
        file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value


@contextlib.contextmanager
def open_shard(path, what, schema, version):
    """A context with the `h5py.File` of a shard.

    Raises DatasetError: it is not a shard of `what`, or damaged. Damage may also be found later, in
    the context.
    """
    try:
        with h5py.File(path, "r") as file:
            found = attribute(file, "schema"), attribute(file, "schema_version")
            if found != (schema, version):
                raise DatasetError(f"{path}: not {what} of version {version}: {found}")
            check_plain(path, file)
            yield file
    except (KeyError, OSError, RuntimeError) as error:  # as damaged HDF5 raises
        raise DatasetError(f"{path}: truncated or corrupt HDF5 ({error})") from error


def read_array(file, path, name):
    """An array of an open shard. Raises DatasetError if it is bad."""
    try:
        return file[name][()]
    except (KeyError, OSError) as error:
        raise DatasetError(f"{path}: {name} is missing or corrupt ({error})") from error


def read_vertices(file, path):
    """The vertices of an open shard's convex hulls: float64 (v, 3). Raises DatasetError."""
    if "hull_vertices" not in file:
        return np.empty((0, 3))
    return read_array(file, path, "hull_vertices")


def check_collection(args):
    """Raise ValueError for flags of a collection, as `collect` takes them, that cannot work."""
    check_folder(args.output)
    if not get_task(args.task).trainable:
        raise ValueError(f"{args.task} is for testing only: training on it is not allowed")
    workers.check_ray(args.ray_address)


def collect(
    args,
    num_scenes,
    collector,
    arguments,
    made_by,
    open_shard,
    *,
    counted,
    unit,
    per_scene=1,
    progress=True,
):
    """Make the missing shards of a folder in workers. Each shard is written atomically.

    Args:
        args: the flags `task`, `output` (the folder), `shard_size`, `workers`, `ray_address`.
        num_scenes: number of scenes in all shards.
        collector: a class. Its instances are functions from a job, `(number, first scene, scene
            after the last)`, to `(number, contents of the file)`.
        arguments: those of the class.
        made_by: the command line that the shards store. Shards with another one do not belong to
            this collection.
        open_shard: a function from a path to an `h5py.File`.
        counted: name of an array with a row per scene.
        unit, per_scene: unit of the progress bar, and the number of them per scene.
        progress: whether there is a bar.

    Raises:
        ValueError: the folder holds shards of another collection, or damaged ones.
        RuntimeError: workers keep dying.
        ConnectionError: there is no Ray cluster.
        OSError: the folder cannot be written. Finished shards are kept.
    """
    firsts = range(0, num_scenes, args.shard_size)
    jobs = [(i, k, min(k + args.shard_size, num_scenes)) for i, k in enumerate(firsts)]

    def exists(job):
        number, first, end = job
        path = shard_path(args.output, number)
        if not path.exists():
            return False
        with open_shard(path) as file:
            found = attribute(file, "made_by")
            if found != made_by:
                raise ValueError(f"{path} was made by another command: {found}")
            return len(file[counted]) >= end - first  # the last shard may have had fewer

    missing = [job for job in jobs if not exists(job)]
    done = num_scenes - sum(end - first for _, first, end in missing)
    bar = progress_bar(
        description=str(args.task),
        total=num_scenes * per_scene,
        initial=done * per_scene,
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
            bar.update((jobs[number][2] - jobs[number][1]) * per_scene)
