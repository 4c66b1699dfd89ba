"""Configurations with the hand in a scene's places, such as between two boards or in a box.

scene, places = Containers().sample_with_places(rng)
ends, on_ways = place_configurations(scene, places, rng, 20)
"""

from collections.abc import Sequence

import numpy as np

from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.inverse_kinematics import inverse_kinematics
from roboarm_nmp.envs.scenes.places import Place, random_poses
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.planning.approach_path import approach_path

MARGIN, NEAR = 0.003, 0.015  # m: of all configurations, and of most of them at most
FAR_SHARE = 0.25  # of those farther than NEAR, so many are kept
RETREATED = 0.5  # share of the configurations from which the arm has retreated
POSES, NUM_SEEDS, MAX_ROUNDS = 32, 8, 10  # of inverse kinematics: poses a round, states a pose
EVERY = 10  # steps of an approach path between configurations on the way


def place_configurations(
    scene: Scene, places: Sequence[Place], rng: np.random.Generator, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Free configurations with the end effector in one of the `Place`s of a scene.

    Half of them are at the end of an approach path, with as much room as there is nearby.

    Returns:
        float64 (k, n), normalised, k <= `number`, and (m, n): more on the ways out of places.
    """
    robot, checker = scene.robot, CollisionChecker(scene)
    ends, on_ways = [], []
    for _ in range(MAX_ROUNDS):
        poses = random_poses(places, rng, POSES)
        seed = int(rng.integers(2**32))
        states = []
        for solutions in inverse_kinematics(robot, poses, seed, NUM_SEEDS, checker, MARGIN):
            if len(solutions):
                states.append(robot.normalise(solutions[rng.integers(len(solutions))]))
        for state in states:
            near = not checker.is_free(state[None], NEAR)[0]
            if len(ends) == number or not (near or rng.random() < FAR_SHARE):
                continue
            path = approach_path(robot, state, checker.link_distances)
            ends.append(path[-1] if rng.random() < RETREATED else path[0])
            on_ways.extend(path[::EVERY])
        if len(ends) == number:
            break
    shape = (-1, robot.num_joints)
    return np.reshape(ends, shape), np.reshape(on_ways, shape)
