"""Folders of shards: `shard_00012.h5` and so on, HDF5 files of some hundred scenes each.

Every array has checksums, and so has what HDF5 says about them: damage is noticed when it is read.
"""

import re
from pathlib import Path

import h5py
import numpy as np

from envs.dataset_format import DatasetError, attribute

_SHARD = re.compile(r"shard_(\d{5})\.h5")


def shard_path(folder, number):
    """Path of a folder's shard."""
    return Path(folder) / f"shard_{number:05d}.h5"


def shard_paths(folder, what):
    """Paths of all shards of a folder, in order. Raises DatasetError: there are none of `what`, or
    one is missing.
    """
    numbers = sorted(
        int(match[1]) for path in Path(folder).glob("*") if (match := _SHARD.match(path.name))
    )
    if not numbers:
        raise DatasetError(f"{folder}: no {what} (shard_00000.h5, ...) in this folder")
    if numbers != list(range(len(numbers))):
        missing = next(i for i, number in enumerate(numbers) if i != number)
        raise DatasetError(f"{shard_path(folder, missing)}: no such file, but later ones exist")
    return [shard_path(folder, number) for number in numbers]


def write_attributes(file, attributes):
    """Texts and numbers, by name. (Strings of a fixed length: see `dataset_format.write_file`.)"""
    for name, value in attributes.items():
        file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value


def open_shard(path, what, schema, version):
    """An `h5py.File` of a shard. Raises DatasetError: damaged, or something else than `what`."""
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise DatasetError(f"{path}: truncated or corrupt HDF5 ({error})") from error
    found = attribute(file, "schema"), attribute(file, "schema_version")
    if found != (schema, version):
        file.close()
        raise DatasetError(f"{path}: not {what} of version {version}: {found}")
    return file


def read_array(file, path, name):
    """An array of an open shard. Raises DatasetError if it is bad."""
    try:
        return file[name][()]
    except (KeyError, OSError) as error:
        raise DatasetError(f"{path}: {name} is missing or corrupt ({error})") from error
