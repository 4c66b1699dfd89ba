"""The observed point cloud: its points, collision checks against it, and encodings."""

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.envs.collision.checker import POINT, CollisionChecker
from roboarm_nmp.envs.perception.geometry_source import observed_checker
from roboarm_nmp.envs.perception.point_clouds import (
    CELL,
    observed_points,
)
from roboarm_nmp.envs.scenes.primitives import POINT_RADIUS, Box, Scene, Sphere

BOX = Box((0.5, 0.0, 0.25), (0.2, 0.3, 0.5))
EMPTY = Scene(())


@pytest.fixture(scope="module")
def clutter():
    """Scenes of `random_boxes_hard`."""
    env, rng, scenes = envs.make("random_boxes_hard"), np.random.default_rng(3), []
    for _ in range(4):
        env.sample_scene(rng)
        scenes.append(env.scene)
    env.close()
    return scenes


def test_observed_points_lie_on_visible_surfaces():
    points = observed_points(Scene((BOX,)))
    out = np.abs(points - BOX.position) - np.array(BOX.size) / 2
    assert len(points) > 300 and points.dtype == np.float32
    assert np.abs(out.max(1)).max() < 0.005  # m, from its surface: precision of the depths
    sides = (np.abs(out) < 0.005).sum(0)
    assert (sides > 30).all()
    assert (points[:, 2] > 0.49).sum() > 40 and not (points[:, 2] < -0.005).any()
    # At most one in each cell.
    cells = np.floor(points / CELL).astype(int)
    assert len(np.unique(cells, axis=0)) == len(points)


def test_hidden_obstacle_changes_no_observation():
    """A small box inside of the table."""
    hidden = Scene((Box((0.0, 0.0, -0.2), (0.05, 0.05, 0.05)),))
    assert observed_points(hidden).shape == (0, 3)
    options = {"encoder": "point_cloud", "num_points": 4}
    options |= {"link_distances": True, "geometry_source": "point_cloud"}
    env, other = envs.make("wall", **options), envs.make("wall", **options)
    query = env.sample_query(np.random.default_rng(0))
    observed = [
        one.reset_specific(*query, scene)[0] for one, scene in ((env, hidden), (other, EMPTY))
    ]
    for name, value in observed[0].items():
        np.testing.assert_array_equal(value, observed[1][name])
    assert not observed[0]["observation"][10:].any()
    env.close(), other.close()


def test_checks_against_points_equal_those_against_balls():
    """The same balls as obstacles of a scene."""
    rng = np.random.default_rng(1)
    points = np.concatenate(
        [rng.uniform((-0.6, -0.6, 0.0), (0.6, 0.6, 0.9), (8, 3)), rng.normal(0.45, 0.03, (60, 3))]
    )
    balls = Scene(tuple(Sphere(tuple(map(float, point)), 0.02) for point in points))
    one, other = CollisionChecker(balls), CollisionChecker(EMPTY, points, 0.02)
    states = rng.uniform(-1, 1, (3000, 7))
    for options in ({}, {"margin": 0.02, "clearance": 0.01}):
        free = one.is_free(states, **options)
        assert 0.1 < free.mean() < 0.9 and (free == other.is_free(states, **options)).all()
    ends = states[rng.permutation(len(states))]
    assert (one.is_motion_free(states, ends) == other.is_motion_free(states, ends)).all()
    a, b = one.signed_distances(states), other.signed_distances(states)
    np.testing.assert_allclose(b.distance, a.distance, atol=2e-6)
    assert ((a.geometry >= 0) == (b.geometry == POINT)).all() and (b.geometry == POINT).mean() > 0.3
    away = np.abs(a.distance) > 1e-4  # at contact, the normal is a matter of rounding
    assert np.quantile(np.abs(a.gradient - b.gradient)[away], 0.999) < 1e-4


def test_distances_from_observed_points_are_close_to_those_from_obstacles(clutter):
    """Nine of ten are at most 15 mm too long, none is more than 15 mm too short."""
    errors = []
    for scene in clutter:
        states = np.random.default_rng(0).uniform(-1, 1, (3000, 7))
        true, observed = CollisionChecker(scene), observed_checker(scene)
        states = states[true.is_free(states)]
        a, b = (one.signed_distances(states, self_collisions=False) for one in (true, observed))
        near = (a.geometry >= 0) & (a.distance < 0.1)
        errors.append((b.distance - a.distance)[near])
    errors = np.concatenate(errors)
    # A point's ball reaches beyond the surface that it is on.
    assert errors.min() > -POINT_RADIUS - 0.005
    assert np.abs(np.median(errors)) < 0.01 and np.quantile(errors, 0.9) < 0.015


@pytest.mark.parametrize(
    ("points", "radius"),
    [([[0.0, np.nan, 0.0]], 0.01), ([[0.0, 0.0, 0.0]], -0.01), ([[0.0, 0.0]], 0.01)],
)
def test_invalid_points_are_rejected(points, radius):
    with pytest.raises(ValueError, match="points"):
        CollisionChecker(EMPTY, points, radius)
