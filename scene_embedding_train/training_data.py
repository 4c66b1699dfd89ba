"""What encoders are trained on: the observations of a folder, and which of them are for validation.

Its functions are for the trainers: where the user is wrong, they end the program with a message.
"""

import sys

import numpy as np

from envs.datasets import DatasetError
from envs.observations import Observations


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
