"""Which pairs of an arm's links may collide: from an SRDF, and from random configurations.

As in MoveIt's setup assistant, pairs are left out that are neighbours, that always collide (their
shapes overlap by design), or that never do.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from roboarm_nmp.envs.robots.body import body_alone
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.untrusted import RobotError, read_xml
from roboarm_nmp.utils.bullet import pybullet as p

SAMPLES = 20_000
# Of the samples: a pair that collides in more of them always collides.
ALWAYS = 0.95


def disabled_pairs(srdf: str | Path, link_index: Mapping[str, int]) -> set[tuple[int, int]]:
    """Pairs (low, high) of PyBullet's link indices that an SRDF disables.

    Args:
        srdf: path of the file.
        link_index: dict from names of links to indices.

    Raises:
        RobotError: the file cannot be read, or names a link that is not there.
    """
    path = Path(srdf)
    pairs = set()
    for element in read_xml(path).iter("disable_collisions"):
        names = element.get("link1", ""), element.get("link2", "")
        for name in names:
            if name not in link_index:
                raise RobotError(f"{path}: disable_collisions: the URDF has no link {name!r}")
        a, b = sorted((link_index[names[0]], link_index[names[1]]))
        pairs.add((a, b))
    return pairs


def sample_pairs(
    robot: Robot, disabled: set[tuple[int, int]], samples: int = SAMPLES, seed: int = 0
) -> tuple[tuple[tuple[int, int], ...], tuple[float, ...]]:
    """The pairs that collide in some random configurations, and a configuration without contacts.

    Args:
        robot: the `Robot`; its own pairs do not matter.
        disabled: set of pairs (low, high) of PyBullet's link indices that are left out.
        samples: number of configurations, uniform in the limits.
        seed: of the configurations.

    Returns:
        pairs, a sorted tuple, and a configuration (n,), a tuple: the middle of the limits if
        nothing collides there.

    Raises:
        RobotError: no configuration is without contacts.
    """
    moved = {link.index: link.frame for link in robot.links}
    candidates = tuple(
        pair
        for pair in itertools.combinations(sorted(moved), 2)
        if pair not in disabled and moved[pair[0]] != moved[pair[1]]
    )
    robot = dataclasses.replace(robot, self_collision_pairs=candidates)
    rng = np.random.default_rng(seed)
    configurations = rng.uniform(robot.lower, robot.upper, (samples, robot.num_joints))
    configurations[0] = (robot.lower + robot.upper) / 2
    counts = dict.fromkeys(candidates, 0)
    colliding = []
    with body_alone(robot) as body:
        for configuration in configurations:
            body.set_configuration(configuration.tolist())
            p.performCollisionDetection(physicsClientId=body.client)
            contacts = p.getContactPoints(body.id, body.id, physicsClientId=body.client)
            overlapping = {tuple(sorted(c[3:5])) for c in contacts if c[8] < 0.0}
            for pair in overlapping:
                counts[pair] += 1
            colliding.append(overlapping)
    always = {pair for pair, count in counts.items() if count > ALWAYS * samples}
    pairs = tuple(pair for pair in candidates if counts[pair] and pair not in always)
    for configuration, overlapping in zip(configurations, colliding, strict=True):
        if not overlapping - always:
            return pairs, tuple(configuration.tolist())
    raise RobotError(
        f"{robot.urdf}: collides with itself in each of {samples} configurations: name pairs of "
        f"links that may overlap in an SRDF (`srdf`)"
    )
