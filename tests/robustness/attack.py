"""Hostile inputs: does anything crash, hang, lose or change data, or leave something behind?

Each attempt depends only on a seed and its number. What may come of it: the input is refused with
a clear error, it runs, or a damaged file is read as it was before.
"""

import collections
import importlib
import os
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
sys.path.append(str(Path(__file__).parents[1] / "helpers"))

import torch
from attacks import children, files

# How many attempts a night makes, and how many of them share a process.
SIZES = {
    "networks": (10_000, 20),
    "files": (20_000, 200),
    "robots": (10_000, 1),
    "clouds": (10_000, 100),
    "problems": (10_000, 20),
    "flags": (2_000, 1),
    "environments": (20_000, 100),
    "kills": (50, 1),
}
GOOD = (children.REFUSED, children.RAN, files.UNCHANGED)


def attack(name, numbers, seed, folder):
    """Make an attack's attempts; dict from an outcome to the numbers of its attempts."""
    torch.set_num_threads(1)
    module = importlib.import_module(f"attacks.{name}")
    attempt = module.attempts(seed, folder)
    seconds = getattr(module, "SECONDS", children.SECONDS)
    megabytes = getattr(module, "MEGABYTES", children.MEGABYTES)
    per_child = SIZES[name][1]
    numbers_of = collections.defaultdict(list)
    for number, outcome in children.outcomes(attempt, numbers, per_child, seconds, megabytes):
        numbers_of[outcome].append(number)
    return numbers_of


def repeat(name, number, seed, folder):
    """The outcome of one attempt, made in this process, where a debugger can follow."""
    children.repeating = True
    return importlib.import_module(f"attacks.{name}").attempts(seed, folder)(number)
