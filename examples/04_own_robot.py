"""Plan and move with another arm: a KUKA iiwa among random boxes that scale with its reach.

    python examples/04_own_robot.py
    python examples/04_own_robot.py --robot my_arm.yaml
    roboarm robot check examples/robots/iiwa.yaml

The robot is a URDF file, or a YAML file that names one (docs/customise/robot.md).
"""

import argparse
from pathlib import Path

import numpy as np

import roboarm_nmp
from roboarm_nmp.envs.following import follow
from roboarm_nmp.planning.planner import Planner

IIWA = Path(__file__).parent / "robots" / "iiwa.yaml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", type=Path, default=IIWA)
    args = parser.parse_args()

    env = roboarm_nmp.make(f"random_boxes_hard@{args.robot}")
    env.reset(seed=0)  # draws a scene
    print(f"{env.robot.name}: {env.robot.num_joints} joints, {len(env.scene.obstacles)} obstacles")

    start, goal = env.sample_query(np.random.default_rng(0))  # collision-free, rad
    path = Planner(env).plan(start, goal, env.scene, seed=0)  # float32 (k, n), rad
    execution = follow(env, path, env.scene)
    reached = "reached" if execution.reached else "not reached"
    contact = "with contact" if execution.collided else "without contact"
    print(f"{len(path)} waypoints; goal {reached} in {len(execution.states) - 1} steps, {contact}")
    hand = env.robot.forward_kinematics(goal)
    print(f"end effector at the goal: {hand.round(3).tolist()} m")


if __name__ == "__main__":
    main()
