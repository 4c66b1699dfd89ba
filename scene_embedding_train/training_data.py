"""What encoders are trained on: a folder's observations, unpacked; which are for validation.

Its functions are for the trainers: where the user is wrong, they end the program with a message.
"""

import contextlib
import hashlib
import sys

import numpy as np
from tqdm import tqdm

from roboarm_nmp.envs.datasets.format import DatasetError
from roboarm_nmp.envs.datasets.observations import Observations
from roboarm_nmp.envs.datasets.shards import shard_path
from roboarm_nmp.envs.scenes.primitives import padded_rows
from roboarm_nmp.envs.utils.files import new_contents


def open_observations(folder):
    """The `Observations` in a folder. Raises SystemExit: there are none, or they are damaged."""
    try:
        return Observations(folder)
    except DatasetError as error:
        sys.exit(f"--observations: {error}")


def split(observations, args):
    """The number of scenes to train on, the first ones, and the rows to validate on.

    Args:
        observations: `Observations`.
        args: the flags `validation_share` (of the scenes, the last ones, that is not trained on)
            and `eval_scenes` (how many of these are looked at, at most).
    """
    num_training = len(observations) - max(1, round(args.validation_share * len(observations)))
    if num_training < 1:
        sys.exit(f"--observations: {len(observations)} scenes are too few")
    return num_training, np.arange(num_training, len(observations))[: args.eval_scenes]


def unpacked(observations, name, arrays, shards):
    """Arrays with a row per scene, made once, kept in files beside the shards and memory-mapped.

    The files, `<name>_<array>_<key>.npy`, may be larger than the memory. Their key is of the
    shards' contents: other observations have other files.

    Args:
        observations: `Observations`.
        name: says what is in the arrays and how it was made.
        arrays: dict from an array's name to its dtype and the shape of a row.
        shards: iterable of dicts with the arrays' rows, shard after shard. It is not begun if the
            files are there.

    Returns:
        A dict from an array's name to the array, which cannot be written to.
    """
    key = contents_key(observations)
    paths = {one: observations.folder / f"{name}_{one}_{key}.npy" for one in arrays}
    if not all(path.exists() for path in paths.values()):
        # Several trainers may be at this at once. Who is last replaces the same.
        with contextlib.ExitStack() as stack:
            whole = {
                one: np.lib.format.open_memmap(
                    stack.enter_context(new_contents(paths[one])),
                    "w+",
                    dtype,
                    (len(observations), *shape),
                )
                for one, (dtype, shape) in arrays.items()
            }
            spans = zip(observations.offsets, observations.offsets[1:], strict=False)
            total = len(observations.offsets) - 1
            bar = tqdm(zip(spans, shards, strict=True), f"unpacking {name}", total, unit="shard")
            for (begin, end), rows in bar:
                for one, array in whole.items():
                    array[begin:end] = rows[one]
            for array in whole.values():
                array.flush()
    return {one: np.load(path, mmap_mode="r") for one, path in paths.items()}


def load_obstacles(observations):
    """The true obstacles: float32 (scenes, most, 12), 1 and a row of `to_array`, zeros for none.

    Quaternions have length 1.
    """
    shards = range(len(observations.offsets) - 1)
    scenes = [scene for shard in shards for scene in observations.scenes(shard)]
    most = max(len(scene.obstacles) for scene in scenes)
    obstacles = np.stack([padded_rows(scene.obstacles, most) for scene in scenes])
    turns = obstacles[..., 5:9]
    turns /= np.maximum(np.linalg.norm(turns, axis=-1, keepdims=True), 1e-9)
    return obstacles


def contents_key(observations):
    """A short name, a string, of all that is in the shards of `Observations`."""
    digest = hashlib.sha256()
    for shard in range(len(observations.offsets) - 1):
        with open(shard_path(observations.folder, shard), "rb") as file:
            while block := file.read(2**20):
                digest.update(block)
    return digest.hexdigest()[:16]
