"""Hostile inputs: does anything crash, hang, lose or change data, or leave something behind?

    python tests/robustness/attack.py                    # everything, hours
    python tests/robustness/attack.py --only files --number 1000
    python tests/robustness/attack.py --only networks --repeat 1234

Attacks: `networks` (network files with one to three values changed at random, each in a process of
its own), `files` (bits flipped and files cut off, of every kind that is written), `robots` (URDFs,
their meshes and YAML files, changed likewise), `clouds` (point clouds of every format, changed
likewise), `problems` (files of problems and scenes in other programs' formats, changed likewise),
`trajectories` (trajectories and joint paths of every format, changed likewise), `flags` (of every
command), `environments` (arguments of environments, scenes and sensors, and actions), `kills`
(`kill -9` at random moments of training, collecting, drawing and sweeping).

Each attempt depends on the seed and its number only. The last lines are a table: how many attempts
were refused clearly, ran, or read what was there before; then, of whatever else came of attempts,
the numbers that repeat them.
"""

import collections
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

os.environ["OMP_NUM_THREADS"] = "1"
sys.path.append(str(Path(__file__).parents[1] / "helpers"))

import torch
import tyro
from attacks import (
    children,
    clouds,
    environments,
    files,
    flags,
    kills,
    networks,
    problems,
    robots,
    trajectories,
)
from tqdm import tqdm

# How many attempts, and how many of them share a process.
SIZES = {
    **{"networks": 10_000, "files": 20_000, "robots": 10_000, "clouds": 10_000},
    **{"problems": 10_000, "trajectories": 10_000, "flags": 2_000, "environments": 20_000},
    **{"kills": 50},
}
Name = Literal[
    "networks",
    "files",
    "robots",
    "clouds",
    "problems",
    "trajectories",
    "flags",
    "environments",
    "kills",
]
PER_CHILD = {
    **{"networks": 1, "files": 200, "robots": 1, "clouds": 100, "problems": 20, "flags": 1},
    **{"trajectories": 200, "environments": 100, "kills": 1},
}
MODULES = {
    "networks": networks,
    "files": files,
    "robots": robots,
    "clouds": clouds,
    "problems": problems,
    "trajectories": trajectories,
    "flags": flags,
    "environments": environments,
    "kills": kills,
}
GOOD = (children.REFUSED, children.RAN, files.UNCHANGED)


@dataclass
class Args:
    only: tuple[Name, ...] = tuple(SIZES)
    """these attacks"""
    number: int | None = None
    """attempts of each; by default 10,000, 20,000, 2,000, 10,000, 10,000, 10,000, 2,000, 20,000, 50
    (of four kills)"""
    seed: int = 0
    """of everything random"""
    repeat: int | None = None
    """only the attempt with this number"""


def attack(name, numbers, seed, folder, progress=False):
    """Make an attack's attempts; dict from an outcome to the numbers of its attempts.

    Args:
        name: one of `SIZES`.
        numbers: of the attempts.
        seed: int.
        folder: an empty one to work in.
        progress: show a progress bar.
    """
    torch.set_num_threads(1)
    attempt = MODULES[name].attempts(seed, folder)
    limits = [
        getattr(MODULES[name], limit, getattr(children, limit))
        for limit in ("SECONDS", "MEGABYTES")
    ]
    found = collections.defaultdict(list)
    results = children.outcomes(attempt, numbers, PER_CHILD[name], *limits)
    for number, word in tqdm(results, name, len(numbers), disable=not progress, mininterval=5):
        found[word].append(number)
    return found


def main(args):
    if args.repeat is not None:  # in this process, for debuggers
        children.repeating = True
        for name in args.only:
            with tempfile.TemporaryDirectory() as folder:
                print(MODULES[name].attempts(args.seed, Path(folder))(args.repeat))
        return 0
    rows = []
    for name in args.only:
        numbers = range(args.number or SIZES[name])
        with tempfile.TemporaryDirectory() as folder:
            found = attack(name, numbers, args.seed, Path(folder), progress=True)
        rows.append((name, len(numbers), found))
    print(f"\n{'seed ' + str(args.seed):13}{'attempts':>9}" + "".join(f"{one:>17}" for one in GOOD))
    for name, tried, found in rows:
        print(f"{name:13}{tried:9}" + "".join(f"{len(found.get(one, ())):17}" for one in GOOD))
    bad = [(name, *one) for name, _, found in rows for one in found.items() if one[0] not in GOOD]
    for name, word, numbers in bad:
        print(f"{name}: {len(numbers)} {word}, numbers {numbers[:20]}")
    if not bad:
        print("nothing else")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args, description=__doc__)))
