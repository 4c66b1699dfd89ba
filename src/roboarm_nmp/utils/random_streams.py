"""Numbers of the streams of random numbers that datasets are made of.

Result i of a dataset draws from `np.random.default_rng([seed, stream, i])`: it depends on nothing
else, and no two kinds of results draw the same numbers. Seeds are below 2^32, one word of what
NumPy seeds with, so no seed leads from one stream to another.
"""

import enum


@enum.unique
class Stream(enum.IntEnum):
    """Never change a number: files and runs of the same seed would change."""

    # Not 0: to NumPy, [seed, 0, 0] is the same as plain seed, so the first query would be that of
    # an environment's `reset(seed=seed)`.
    TEST_QUERIES = 1
    VALIDATION_QUERIES = 2
    DEMONSTRATIONS = 3
    OBSERVATIONS = 4
    ROADMAPS = 5
    ROADMAP_EXAMPLES = 6
    SENSOR_NOISE = 8
