"""Files of trajectories and joint paths, of every format, with one to three random changes."""

import random

import numpy as np

from attacks.children import RAN, REFUSED
from attacks.clouds import damaged
from attacks.problems import hostile
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.motions.trajectories import (
    JointTrajectory,
    load_trajectory,
    save_joint_path,
    save_trajectory,
)

MEGABYTES = 1000
ENDINGS = ("csv", "npz", "json", "yaml")


def attempts(seed, folder):
    """A function from a number to the outcome of reading such a file and writing it again."""
    rng = np.random.default_rng(0)
    times = np.arange(12) / 100
    positions = np.clip(rng.uniform(PANDA.lower, PANDA.upper, (12, 7)), -0.5, 0.5)
    positions[:, 3] -= 1.0  # joint 4, and joint 6, have limits around other values
    positions[:, 5] += 1.5
    trajectory = JointTrajectory(times, positions, positions / 9, -positions, PANDA)
    sources = []
    for ending in ENDINGS:
        whole, plain = folder / f"whole.{ending}", folder / f"path.{ending}"
        save_trajectory(whole, trajectory)
        save_joint_path(plain, positions, times, PANDA)
        sources += [whole, plain]
    sources = [(path.suffix, path.read_bytes()) for path in sources]

    def attempt(number):
        rng = random.Random(f"{seed} {number}")
        suffix, contents = rng.choice(sources)
        path = folder / f"{number}{suffix}"
        path.write_bytes(damaged(contents, rng) if suffix == ".npz" else hostile(rng, contents))
        try:
            loaded = load_trajectory(path, PANDA)
        except DatasetError as error:
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error), error
            return REFUSED
        finally:
            path.unlink()
        for values in (loaded.times, loaded.positions, loaded.frames()):
            assert np.isfinite(values).all()
        again = folder / f"{number}-again.{rng.choice(ENDINGS)}"
        save_trajectory(again, loaded)
        assert len(load_trajectory(again, PANDA)) == len(loaded)
        again.unlink()
        return RAN

    return attempt
