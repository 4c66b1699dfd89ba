"""Collect observations: camera images and point clouds of random scenes, to train encoders on.

    roboarm observations --num 20000 --image-size 128 --output observations
    roboarm observations --num 200000 --ray-address auto   # the paper's number

Paper: appendix "Training and verifying the encoders": four sensors around the robot, images and
point clouds of 200,000 environments. Scene i, with the arm in a feasible configuration, depends
only on the seed and i, so the files are the same for every number of workers. They are written in
shards, each atomically. After an interruption the same command continues; a finished collection is
extended by a larger `--num`.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from roboarm_nmp import envs
from roboarm_nmp.datasets import shards
from roboarm_nmp.datasets.observations import Observations, observe, open_shard, shard_bytes
from roboarm_nmp.envs.perception.sensors import Camera, PointCloud, SensorWorld, cardinal
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.flags import CORES, PositiveInt, Seed, Workers
from roboarm_nmp.utils.random_streams import Stream
from roboarm_nmp.utils.signals import end_with_one_line, error_line


@dataclass
class Args:
    task: str = "random_boxes_hard"
    """Name of a task, or path of a scene file; with another arm, TASK@FILE."""
    num: PositiveInt = 20_000
    """Number of scenes."""
    sensors: Literal["images", "clouds", "both"] = "both"
    """Cameras, point clouds, or both in the same places."""
    image_size: PositiveInt = 224
    """Width and height of the images in pixels."""
    num_samples: PositiveInt = 10_000
    """Rays of a point cloud: a square number."""
    shard_size: PositiveInt = 500
    """Scenes in each file."""
    seed: Seed = 0
    """Seed of scenes and configurations."""
    workers: Workers = CORES
    """Number of processes, by default that of the cores. The files do not depend on it."""
    output: Path = Path("observations")
    """Folder to write to."""
    ray_address: str | None = None
    """Address of a Ray cluster (`auto`, `HOST:PORT`) to use instead of local processes."""


def make_sensors(args: Args) -> dict[str, Camera | PointCloud]:
    """The sensors of the flags: dict of name -> sensor."""
    robot = envs.get_task(args.task).base_scene.robot
    sensors = {}
    if args.sensors != "clouds":
        sensors |= cardinal(Camera, robot, size=(args.image_size, args.image_size))
    if args.sensors != "images":
        clouds = cardinal(PointCloud, robot, num_samples=args.num_samples)
        sensors |= {f"{name}_cloud": sensor for name, sensor in clouds.items()}
    return sensors


class Collector:
    """Makes shards. A job is (number of the shard, first scene, scene after the last)."""

    def __init__(self, task: str, seed: int, sensors: dict, made_by: str):
        self.task = task
        self.seed = seed
        self.sensors = sensors
        self.made_by = made_by
        self.env = envs.make(task)
        self.world = SensorWorld()

    def __call__(self, job: tuple[int, int, int]) -> tuple[int, bytes]:
        """`(number, contents of the file)`."""
        number, first, end = job
        scenes, configurations, observations = [], [], []
        for index in range(first, end):
            rng = np.random.default_rng([self.seed, Stream.OBSERVATIONS, index])
            self.env.sample_scene(rng)
            configurations.append(self.env.sample_feasible(rng))
            scenes.append(self.env.scene)
            self.world.show(self.env.scene, configurations[-1])
            observations.append(observe(self.world, self.sensors))
        contents = shard_bytes(
            self.task,
            self.seed,
            first,
            self.sensors,
            scenes,
            configurations,
            observations,
            self.made_by,
        )
        return number, contents


def collect(args: Args, progress: bool = True) -> Observations:
    """Make the missing shards. Returns the `Observations`.

    Raises:
        ValueError: the flags cannot work, or the folder holds other observations.
        ConnectionError: there is no Ray cluster.
        OSError: the folder cannot be written. Finished shards are kept.
    """
    flags.check(args)
    shards.check_collection(args)
    names = ("task", "sensors", "image_size", "num_samples", "shard_size", "seed")
    words = [f"--{name.replace('_', '-')} {getattr(args, name)}" for name in names]
    made_by = " ".join(["roboarm observations", *words])
    arguments = (args.task, args.seed, make_sensors(args), made_by)
    shards.collect(
        args,
        args.num,
        Collector,
        arguments,
        made_by,
        open_shard,
        counted="configuration",
        unit="scene",
        progress=progress,
    )
    return Observations(args.output, envs.get_task(args.task).base_scene.robot)


def main(args: Args):
    """The command."""
    try:
        observations = collect(args)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(error_line(error))
    size = sum(path.stat().st_size for path in args.output.glob("shard_*.h5"))
    print(f"{args.output}: {len(observations)} scenes, {size / 1e6:.1f} MB")


if __name__ == "__main__":
    end_with_one_line("the same command continues from here")
    main(flags.parse(Args, others="sensor"))
