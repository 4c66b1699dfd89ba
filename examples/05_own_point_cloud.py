"""A point cloud of your own to an action: a pretrained policy with its safety filter.

    python examples/point_cloud_to_action.py
    python examples/point_cloud_to_action.py --points cloud.ply

The file is a PLY, PCD, NPY or NPZ file, m, in the frame of the robot's base: x forward, y to the
left, z up. Points of the table, the floor and the arm at its start are removed. Without a file, the
points are those of a box in front of the arm. Prints the number of points used, whether they block
the straight motion to the goal, the first action, and how an episode ends that uses nothing but the
points.
"""

import argparse

import numpy as np

import roboarm_nmp
from roboarm_nmp.datasets.cloud_files import load_cloud
from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.point_clouds import prepare_cloud
from roboarm_nmp.envs.scenes.primitives import ObservedScene
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.policies.registry import find_policy, make_policy

POLICY = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"
# Joint angles, rad: from the arm's left to its right.
START = np.array([1.0, 0.4, 0.0, -1.8, 0.0, 2.2, 0.8], np.float32)
GOAL = np.array([-1.0, 0.4, 0.0, -1.8, 0.0, 2.2, 0.8], np.float32)


def box_surface(
    centre: tuple[float, float, float],
    size: tuple[float, float, float],
    number: int = 5000,
    seed: int = 0,
) -> np.ndarray:
    """Random points on the surface of a box: float32 (number, 3), m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (number, 3))
    axis = rng.integers(3, size=number)
    points[np.arange(number), axis] = rng.choice([-0.5, 0.5], number)
    return (np.array(centre) + points * size).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", help="a point cloud's file, m")
    args = parser.parse_args()
    if args.points:
        cloud = load_cloud(args.points)
    else:
        cloud = box_surface(centre=(0.55, 0.0, 0.3), size=(0.2, 0.1, 0.6))
    points, _ = prepare_cloud(cloud, configuration=START)

    # The simulated arm stands among nothing but table and floor: all obstacles are points.
    scene = ObservedScene(points=points)
    checker = CollisionChecker(scene)
    ends = scene.robot.normalise(np.stack([START, GOAL]))
    straight = "free" if checker.is_motion_free(*ends) else "blocked"
    print(f"{len(points)} points; the straight motion to the goal is {straight}")
    policy, arguments = find_policy(POLICY)
    env = roboarm_nmp.make(scene, **arguments)

    query = Query(START, GOAL, scene)
    begin = make_policy(policy, env)  # its safety filter included
    observation, _ = env.reset_specific(*query)
    act = begin(0, query).act
    assert act is not None  # only planners may give up
    print("first action:", act(observation).round(4).tolist())
    trajectory = rollout(env, query, begin(0, query).act)
    reached = "reached" if trajectory.success else "not reached"
    print(f"goal {reached} in {len(trajectory)} steps")
    near = checker.signed_distances(np.clip(trajectory.states, -1, 1), self_collisions=False)
    print(f"smallest distance from a point: {1000 * near.distance.min():.1f} mm")


if __name__ == "__main__":
    main()
