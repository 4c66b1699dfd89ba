"""Starts and goals as people have them: grasps in a scene's places, pre-grasps, free poses."""

import functools
from collections.abc import Sequence

import numpy as np

from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.inverse_kinematics import inverse_kinematics
from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.scenes.places import Place, random_poses
from roboarm_nmp.envs.scenes.primitives import Scene

GRASPS, PRE_GRASPS = 0.55, 0.2  # shares of the ends; the others are random free configurations
# m, of room around all ends. Grasps are nearer than `NEAR` to something.
MARGIN, NEAR = 0.003, 0.03
RETREAT = (0.04, 0.15)  # m, of pre-grasps, against the direction of approach
GRID = 2.0**-7  # rad: angles are multiples of it, so that files are small
POSES, NUM_SEEDS, ROUNDS = 12, 6, 4  # of inverse kinematics: poses a round, states a pose
TRIES = 5_000


def random_ends(
    scene: Scene, places: Sequence[Place], rng: np.random.Generator, number: int
) -> np.ndarray:
    """Random starts or goals in a scene with places: float32 (number, n), rad.

    All are free, with `MARGIN`. Where no grasp or pre-grasp is found, it is a free pose.

    Raises RuntimeError: the scene leaves no room for the arm.
    """
    checker = _checker(scene)
    ends = []
    for kind in rng.random(number):
        end = None
        if kind < GRASPS + PRE_GRASPS:
            end = _in_place(checker, places, rng, kind < GRASPS)
        ends.append(_anywhere(checker, rng) if end is None else end)
    return np.array(ends, np.float32)


@functools.lru_cache(maxsize=1)
def _checker(scene: Scene) -> CollisionChecker:
    return CollisionChecker(scene)


def _in_place(
    checker: CollisionChecker, places: Sequence[Place], rng: np.random.Generator, is_grasp: bool
) -> np.ndarray | None:
    """A grasp or a pre-grasp, rad; None if none is found."""
    robot = checker.robot
    scale = scale_of(robot)
    for _ in range(ROUNDS):
        poses = random_poses(places, rng, POSES)
        if not is_grasp:
            x, y, z, w = poses[:, 3:].T
            axes = np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], 1)
            poses[:, :3] -= scale * rng.uniform(*RETREAT, (POSES, 1)) * axes
        seed = int(rng.integers(2**32))
        for solutions in inverse_kinematics(robot, poses, seed, NUM_SEEDS, checker, MARGIN):
            if len(solutions):
                end = _rounded(checker, solutions[rng.integers(len(solutions))])
                if end is not None and not (is_grasp and _is_free(checker, end, scale * NEAR)):
                    return end
    return None


def _anywhere(checker: CollisionChecker, rng: np.random.Generator) -> np.ndarray:
    """A random free configuration, rad."""
    robot = checker.robot
    for _ in range(TRIES):
        end = _rounded(checker, rng.uniform(robot.lower, robot.upper))
        if end is not None:
            return end
    raise RuntimeError("the scene leaves no room for the arm")


def _rounded(checker: CollisionChecker, angles: np.ndarray) -> np.ndarray | None:
    """Angles (n,), rad, as multiples of `GRID`; None where these are not free."""
    angles = np.round(angles / GRID) * GRID
    robot = checker.robot
    inside = (robot.lower <= angles) & (angles <= robot.upper)
    return angles if inside.all() and _is_free(checker, angles, MARGIN) else None


def _is_free(checker: CollisionChecker, angles: np.ndarray, margin: float) -> bool:
    return bool(checker.is_free(checker.robot.normalise(angles), margin))
