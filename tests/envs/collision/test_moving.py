"""Moving obstacles as arrays agree with `Scene.at`, and velocities with differences of poses."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roboarm_nmp.envs.collision.hulls import shape_rows
from roboarm_nmp.envs.collision.moving import MovingObstacles
from roboarm_nmp.envs.collision.moving_kernels import ABSENT, moved_rows
from roboarm_nmp.envs.scenes.motions import Oscillation, Presence, Waypoints
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene, Sphere, convex_hull

TURNS = Rotation.from_euler("xyz", [(0, 0, 0), (1, 2, 3), (-2, 1, 0.5), (0, 0, 0)]).as_quat()
WAYS = ((0, 0, 0), (0.1, 0.4, 0), (0.2, -0.1, 0.3), (0, 0, 0))
TIMES = (0.5, 1.25, 2.5, 3.5)
PLACE, TURN = (0.4, -0.2, 0.3), tuple(Rotation.from_euler("xyz", (0.3, 0.2, 0.1)).as_quat())


def moving_scene():
    rng = np.random.default_rng(0)
    hull = replace(convex_hull(rng.uniform(0, 0.2, (20, 3)), PLACE, TURN), motion=oscillation())
    boxes = [
        Box(PLACE, (0.1, 0.2, 0.3), TURN, Waypoints(TIMES, WAYS, TURNS, repeat))
        for repeat in ("once", "back_and_forth", "cyclic")
    ]
    there = Presence(((0.0, 1.0), (2.0, math.inf)), oscillation())
    gone = Presence(((1.0, 2.0),))
    still = Waypoints((3.0,), ((0.1, 0.2, 0.3),))
    return Scene(
        (
            *boxes,
            hull,
            Box(PLACE, (0.1, 0.2, 0.3), TURN),
            Cylinder(PLACE, 0.1, 0.3, TURN, there),
            Cylinder(PLACE, 0.1, 0.3, TURN, gone),
            Sphere(PLACE, 0.1, still),
        )
    )


def oscillation():
    return Oscillation((0.1, 0.2, 0.0), 3.0, 0.7, axis=(1, 2, 3), angle=0.9)


@pytest.mark.parametrize("t", [0.0, 0.5, 1.0, 1.7, 3.5, 4.1, 98.765])
def test_arrays_are_those_of_the_scene_at_a_time(t):
    scene = moving_scene()
    moving = MovingObstacles(scene)
    states, now = moving.at(t), scene.at(t)
    present = np.flatnonzero(states.present)
    assert len(present) == len(now.obstacles)
    for row, obstacle in zip(present, now.obstacles, strict=True):
        np.testing.assert_allclose(states.position[row], obstacle.position, atol=1e-12)
        if not isinstance(obstacle, Sphere):
            np.testing.assert_allclose(states.orientation[row], obstacle.orientation, atol=1e-9)
    rows = np.empty_like(moving.shapes)
    moved_rows(moving.motions, moving.centres, moving.shapes, t, rows)
    np.testing.assert_allclose(rows[present], shape_rows(now.obstacles), atol=1e-9)
    assert (rows[~states.present, 3] > ABSENT / 2).all()


def test_velocities_are_derivatives():
    moving, step = MovingObstacles(moving_scene()), 1e-6
    times = np.random.default_rng(1).uniform(0, 12, 200)
    times = times[np.abs(times[:, None] - np.arange(0, 12, 0.25)).min(1) > 2 * step]
    now, before, after = (moving.at(times + shift) for shift in (0, -step, step))
    velocity = (after.position - before.position) / (2 * step)
    np.testing.assert_allclose(now.velocity, velocity, atol=1e-6)
    turns = [Rotation.from_quat(one.orientation.reshape(-1, 4)) for one in (before, after)]
    angular = (turns[1] * turns[0].inv()).as_rotvec() / (2 * step)
    np.testing.assert_allclose(now.angular_velocity.reshape(-1, 3), angular, atol=1e-6)
    assert np.abs(now.velocity).max() > 0.1 and np.abs(now.angular_velocity).max() > 1
