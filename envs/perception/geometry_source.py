"""Geometry sources: where collision checks and link distances take a scene's obstacles from.

    geometry_source = find_geometry_source("point_cloud")
    checker = geometry_source(scene)             # a CollisionChecker of the observed points alone

- `ground_truth`: the obstacles themselves (privileged);
- `point_cloud`: points that four sensors observe of them, or those of an `ObservedScene`;
- the name or path of an encoder with a decoder: points decoded from its latent code.

Table and floor are known to all of them, and so are obstacles with `may_touch`: points within
`KNOWN_DISTANCE` of them are left out.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.point_clouds import (
    DENSE_RAYS,
    FINE_POINT_RADIUS,
    POINT_CLOUD,
    fine_observed_points,
    observed_points,
    without_known,
)
from roboarm_nmp.envs.perception.visibility import unseen_points
from roboarm_nmp.envs.robots.panda import PANDA, scale_of
from roboarm_nmp.envs.scenes.primitives import POINT_RADIUS, ObservedScene, Scene
from roboarm_nmp.utils.names import suggest

if TYPE_CHECKING:
    from roboarm_nmp.envs.perception.encoders import NetworkEncoder

GeometrySource = Callable[[Scene], CollisionChecker]
Unknown = Literal["free", "occupied"]
"""What space counts as that no sensor sees."""
GROUND_TRUTH = "ground_truth"
CACHED_CHECKERS = 64  # about 60 kB each
CACHED_FINE_CHECKERS = 4  # about 1 MB each
DECODED_RADIUS = 0.0  # m, of the ball around a decoded point


def find_geometry_source(name, robot=PANDA, fine=False):
    """A function from a `Scene` to a `CollisionChecker` of its obstacles as the source has them.

    Args:
        name: `ground_truth`, `point_cloud`, or the name or path of an encoder with a decoder.
        robot: the `Robot` of the scenes.
        fine: with `point_cloud`: more points, for approach paths.

    Raises:
        ValueError: it is none of these, or an encoder for another robot.
    """
    name = str(name)
    if name == GROUND_TRUTH:
        return ground_truth_checker
    if name == POINT_CLOUD:
        return fine_observed_checker if fine else observed_checker
    from roboarm_nmp.envs.perception.encoders import encoder_with_decoder  # PyTorch takes seconds

    try:
        encoder = encoder_with_decoder(name)
    except ValueError as error:
        raise ValueError(
            f"a geometry source is {GROUND_TRUTH}, {POINT_CLOUD} or an encoder with a decoder: "
            f"{suggest(name, [GROUND_TRUTH, POINT_CLOUD], str(error))}"
        ) from error
    encoder.check_robot(robot)
    return functools.partial(decoded_checker, encoder=encoder)


@functools.lru_cache(CACHED_CHECKERS)
def ground_truth_checker(scene: Scene) -> CollisionChecker:
    """The `CollisionChecker` of a `Scene`."""
    return CollisionChecker(scene)


@functools.lru_cache(CACHED_CHECKERS)
def observed_checker(scene: Scene) -> CollisionChecker:
    """A `CollisionChecker` of table, floor, and the observed points of a `Scene`'s obstacles."""
    if isinstance(scene, ObservedScene):
        return CollisionChecker(replace(scene, obstacles=()))
    radius = scale_of(scene.robot) * POINT_RADIUS
    return _checker_of_points(scene, observed_points(scene), radius)


@functools.lru_cache(CACHED_FINE_CHECKERS)
def fine_observed_checker(scene: Scene, num_rays: int | None = None) -> CollisionChecker:
    """As `observed_checker`, with more points and smaller balls; an `ObservedScene` has its own.

    `num_rays`: of each sensor; None for the usual 10,000, `DENSE_RAYS` to verify a whole path.
    """
    if isinstance(scene, ObservedScene):
        return observed_checker(scene)
    radius = scale_of(scene.robot) * FINE_POINT_RADIUS
    return _checker_of_points(scene, fine_observed_points(scene, num_rays), radius)


def cautious_checker(scene: Scene, states: np.ndarray) -> CollisionChecker:
    """As `fine_observed_checker` with `DENSE_RAYS`, but space that no sensor sees is occupied, too.

    Args:
        scene: the `Scene`.
        states: normalised configurations (m, n), such as start and goal, in which the arm has room.
    """
    points = unseen_points(scene, states)
    if not len(points):
        return fine_observed_checker(scene, DENSE_RAYS)
    radius = scale_of(scene.robot) * FINE_POINT_RADIUS
    points = np.concatenate([fine_observed_points(scene, DENSE_RAYS), points])
    return _checker_of_points(scene, points, radius)


@functools.lru_cache(CACHED_CHECKERS)
def decoded_checker(scene: Scene, encoder: "NetworkEncoder") -> CollisionChecker:
    """A `CollisionChecker` of table, floor, and points decoded from z_E of a `NetworkEncoder`."""
    return _checker_of_points(scene, encoder.decoded_points(scene), DECODED_RADIUS)


def _checker_of_points(scene: Scene, points: np.ndarray, radius: float) -> CollisionChecker:
    """The checker of points in the place of a scene's obstacles, except those with `may_touch`."""
    known = tuple(obstacle for obstacle in scene.obstacles if obstacle.may_touch)
    points = without_known(points, known) if known else points
    return CollisionChecker(replace(scene, obstacles=known), points, radius)
