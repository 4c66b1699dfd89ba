"""What the four sensors see."""

import numpy as np

from roboarm_nmp.envs.perception.geometry_source import cautious_checker, fine_observed_checker
from roboarm_nmp.envs.perception.point_clouds import DENSE_RAYS, sensor_images
from roboarm_nmp.envs.perception.visibility import are_seen, unobserved_share, unseen_points
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Box, Scene

START = PANDA.normalise([[0.0, 0.6, 0.0, -1.9, 0.0, 2.5, 0.8]])  # the hand is in the box
CENTRE, EDGE = np.array([0.5, 0.0, 0.4]), 0.3


def test_inside_of_a_closed_box_is_not_seen_and_space_around_it_is():
    walls = []
    for axis in range(3):
        size = np.full(3, EDGE)
        size[axis] = 0.01
        for side in (-1, 1):
            position = CENTRE.copy()
            position[axis] += side * EDGE / 2
            walls.append(Box(tuple(position), tuple(size)))
    scene = Scene(obstacles=tuple(walls))
    usual = sensor_images(scene, None)
    sensor_images.cache_clear()
    sensor_images(scene, DENSE_RAYS)  # of which the usual ones are a part
    assert all((a[1] == b[1]).all() for a, b in zip(usual, sensor_images(scene, None), strict=True))
    rng = np.random.default_rng(0)
    inside = CENTRE + rng.uniform(-0.12, 0.12, (300, 3))
    above = rng.uniform((-0.5, -0.5, 0.9), (0.5, 0.5, 1.2), (300, 3))
    assert not are_seen(scene, inside).any() and are_seen(scene, above).all()
    assert are_seen(Scene(), inside).all()
    observed = PANDA.normalise(np.array([PANDA.observed_pose]))
    assert unobserved_share(Scene(), observed) == 0.0  # the arm itself is known
    around = unseen_points(scene, observed)
    assert (np.abs(around - CENTRE) < EDGE / 2).all(1).any()
    assert not are_seen(scene, around).any() and len(unseen_points(scene, START)) < len(around)
    states = rng.uniform(-1.0, 1.0, (200, 7))
    free = fine_observed_checker(scene, DENSE_RAYS).is_free(states)
    careful = cautious_checker(scene, observed).is_free(states)
    assert not (careful & ~free).any() and careful.sum() < free.sum()
    assert unobserved_share(Scene(), states) < unobserved_share(scene, states) < 0.1
