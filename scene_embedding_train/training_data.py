"""Shared parts of the encoders' trainers: flags, observations, metadata and results.

These functions are for scripts: on a mistake of the user, they end the program with a message.
"""

import contextlib
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.datasets.shards import shard_path
from roboarm_nmp.envs.perception.sensors import sensors_to_json
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.metadata import robot_metadata
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.training.arguments import errors_of, fail
from roboarm_nmp.training.runs import Run, script_name
from roboarm_nmp.utils.files import new_contents
from roboarm_nmp.utils.flags import PositiveInt, Seed, Share
from roboarm_nmp.utils.progress import progress_bar


@dataclass
class EncoderFlags:
    """The flags of every encoder's trainer."""

    seed: Seed = 1
    """seed of all random numbers; runs with the same seed, machine and device are identical"""
    runs_dir: Path = Path("runs")
    """parent of the run's folder: TensorBoard events, checkpoint, `encoder.onnx`, result.json"""
    resume: Path | None = None
    """continue the run in this folder from its last checkpoint, with its flags"""
    device: str = "cpu"
    """`cpu`, `cuda` or one of several, `cuda:1`"""
    track: bool = False
    """log to Weights & Biases as well as to TensorBoard (`pip install wandb`)"""
    observations: Path = Path("observations")
    """folder that `roboarm observations` wrote"""
    robot: Path | None = None
    """the robot's file, if the observations are not the Panda's; the encoder is for that robot"""
    validation_share: Share = 0.05
    """share of the scenes, the last ones, that is not trained on"""
    eval_every: PositiveInt = 2_000
    """batches between evaluations on validation scenes; the best encoder is kept"""
    eval_scenes: PositiveInt = 512
    """validation scenes per evaluation"""


def load_observations(args: EncoderFlags) -> tuple[Observations, int, np.ndarray]:
    """The observations to train and to validate on.

    Args:
        args: `EncoderFlags`.

    Returns:
        The `Observations`; the number of scenes to train on, the first ones; and the rows to
        validate on, an array.

    Raises:
        SystemExit: there are no observations, or too few, or they are damaged, or another robot's.
    """
    with errors_of("--robot"):
        robot = PANDA if args.robot is None else load_robot(args.robot)
    with errors_of("--observations"):
        observations = Observations(args.observations, robot)
    num_training = len(observations) - max(1, round(args.validation_share * len(observations)))
    if num_training < 1:
        fail(f"--observations: {len(observations)} scenes are too few")
    validation = np.arange(num_training, len(observations))[: args.eval_scenes]
    return observations, num_training, validation


def encoder_metadata(args: EncoderFlags, observations: Observations, names: Iterable[str]) -> dict:
    """The metadata of an encoder that receives the outputs of the sensors `names`: a dict."""
    sensors = sensors_to_json({name: observations.sensors[name] for name in names})
    return {
        "kind": "encoder",
        "script": script_name(),
        "task": observations.task,
        **robot_metadata(observations.base_scene.robot),
        "sensors": sensors,
        "seed": args.seed,
    }


def write_result(run: Run, best: dict, num_training: int) -> dict:
    """Write `result.json`: the best evaluation and the size of the run. Returns its dict.

    Args:
        run: the `Run`.
        best: a dict with the best evaluation's numbers and its `step`.
        num_training: number of scenes that it trained on.
    """
    result = {name: value for name, value in best.items() if name != "step"} | {
        "scenes": num_training,
        "encoder": str(run.folder / "encoder.onnx"),
        "updates": run.step,
        "best_update": best["step"],
        "seconds": round(run.seconds),
    }
    run.write_result(result)
    return result


def unpack(
    observations: Observations, name: str, arrays: dict, shards: Iterable[dict]
) -> dict[str, np.ndarray]:
    """Arrays with a row per scene, made once, kept in files beside the shards and memory-mapped.

    The files, `<name>_<array>_<key>.npy`, may be larger than the memory. The key is a hash of the
    shards' contents, so other observations have other files.

    Args:
        observations: `Observations`.
        name: of the arrays' contents, with the parameters that they depend on.
        arrays: dict from an array's name to its dtype and the shape of a row.
        shards: iterable of dicts with the arrays' rows, shard after shard. It is not started if
            the files exist.

    Returns:
        A dict from an array's name to the array, which is read-only.
    """
    key = contents_key(observations)
    paths = {array: observations.folder / f"{name}_{array}_{key}.npy" for array in arrays}
    if not all(path.exists() for path in paths.values()):
        # Several trainers may do this at once: the last one replaces the files by equal ones.
        with contextlib.ExitStack() as stack:
            files = {}
            for array, (dtype, shape) in arrays.items():
                path = stack.enter_context(new_contents(paths[array]))
                shape = (len(observations), *shape)
                files[array] = np.lib.format.open_memmap(path, "w+", dtype, shape)
            total = len(observations.offsets) - 1
            bar = progress_bar(shards, f"unpacking {name}", total, unit="shard")
            for number, rows in enumerate(bar):
                begin, end = observations.offsets[number : number + 2]
                for array, values in rows.items():
                    files[array][begin:end] = values
            for file in files.values():
                file.flush()
    return {array: np.load(path, mmap_mode="r") for array, path in paths.items()}


def contents_key(observations: Observations) -> str:
    """A hash of the contents of all shards of `Observations`, a string."""
    digest = hashlib.sha256()
    for shard in range(len(observations.offsets) - 1):
        with open(shard_path(observations.folder, shard), "rb") as file:
            while block := file.read(2**20):
                digest.update(block)
    return digest.hexdigest()[:16]
