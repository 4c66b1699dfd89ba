"""Places for the hand in a scene: where it goes, and from which direction."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roboarm_nmp.envs.robots.rotations import quaternions

TILT = 0.35  # standard deviation of the hand's direction from a place's approach, each axis
GRASP_TILT = 0.12  # the same where the fingers close around something


@dataclass(frozen=True, eq=False)
class Place:
    """A region for the end effector.

    Attributes:
        centre, size: m, (3,), of a box with the axes of `rotation`.
        rotation: (3, 3), from the region's axes to the world's.
        approach: unit vector (3,), in the world: the direction in which a hand enters.
        across: unit vector (3,), in the world, along which the fingers open, because there is
            something between them; None: any.
    """

    centre: np.ndarray
    size: np.ndarray
    rotation: np.ndarray
    approach: np.ndarray
    across: np.ndarray | None = None


def random_poses(places: Sequence[Place], rng: np.random.Generator, number: int) -> np.ndarray:
    """Random end-effector poses in places, (number, 7): position (m) and quaternion (xyzw)."""
    poses = np.empty((number, 7))
    for pose in poses:
        place = places[int(rng.integers(len(places)))]
        pose[:3] = place.centre + place.rotation @ (rng.uniform(-0.5, 0.5, 3) * place.size)
        tilt = TILT if place.across is None else GRASP_TILT
        axis = place.approach + tilt * rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        if place.across is None:
            pose[3:] = _hand_along(axis, rng.uniform(-np.pi, np.pi))
        else:
            across = place.across if rng.random() < 0.5 else -place.across
            forward = np.cross(across, axis)
            forward /= np.linalg.norm(forward)
            hand = np.stack([forward, np.cross(axis, forward), axis], axis=1)
            pose[3:] = quaternions(hand)
    return poses


def _hand_along(axis: np.ndarray, roll: float) -> np.ndarray:
    """The quaternion (xyzw) that turns z to a unit vector, after a turn about z."""
    x, y, z = axis
    # From z to the axis by the shortest turn; from -z by half a turn about x.
    turn = np.array([-y, x, 0.0, 1.0 + z]) if z > -1.0 + 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])
    a, b, _, w = turn / np.linalg.norm(turn)
    sin, cos = np.sin(roll / 2), np.cos(roll / 2)
    return np.array([a * cos + b * sin, b * cos - a * sin, w * sin, w * cos])
