"""From a point cloud to a motion: a pretrained policy with its safety filter.

    python examples/05_own_point_cloud.py
    roboarm show --cloud box.npy --trajectory motion.csv --output motion.png

With `--points` you give your own points: a PLY, PCD, NPY or NPZ file in metres, in the frame of the
robot's base (x forward, y to the left, z up). Otherwise they are random points of a box.
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
from roboarm_nmp.motions.trajectories import save_trajectory
from roboarm_nmp.policies.registry import find_policy, make_policy

POLICY = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"
START = np.array([1.0, 0.4, 0.0, -1.8, 0.0, 2.2, 0.8], np.float32)  # rad
GOAL = np.array([-1.0, 0.4, 0.0, -1.8, 0.0, 2.2, 0.8], np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", help="file of a point cloud")
    args = parser.parse_args()
    if args.points:
        cloud = load_cloud(args.points)
    else:
        rng = np.random.default_rng(0)
        cloud = rng.uniform((0.45, -0.05, 0.0), (0.65, 0.05, 0.6), (5000, 3)).astype(np.float32)
        np.save("box.npy", cloud)

    # Points of the table, the floor and the arm at its start are removed.
    points, _ = prepare_cloud(cloud, configuration=START)
    scene = ObservedScene(points=points)  # obstacles are nothing but points
    checker = CollisionChecker(scene)
    ends = scene.robot.normalise(np.stack([START, GOAL]))
    straight = "free" if checker.is_motion_free(*ends) else "blocked"
    print(f"{len(points)} points; the straight motion to the goal is {straight}")

    policy, arguments = find_policy(POLICY)
    env = roboarm_nmp.make(scene, **arguments)
    query = Query(START, GOAL, scene)
    trajectory = rollout(env, query, make_policy(policy, env)(0, query).act)
    reached = "reached" if trajectory.success else "not reached"
    print(f"goal {reached} in {len(trajectory)} steps")
    save_trajectory("motion.csv", trajectory)
    near = checker.signed_distances(np.clip(trajectory.states, -1, 1), self_collisions=False)
    print(f"smallest distance from a point: {1000 * near.distance.min():.1f} mm")


if __name__ == "__main__":
    main()
