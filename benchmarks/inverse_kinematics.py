"""Inverse kinematics: milliseconds of processor time per pose, and the share that is solved.

    python benchmarks/inverse_kinematics.py --robots examples/robots/iiwa.yaml

The poses are those of random configurations, so that all of them can be reached. The distance is
that of the nearest solution from a random configuration, L2, normalised.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.inverse_kinematics import NUM_SEEDS, inverse_kinematics
from roboarm_nmp.envs.robots.panda import PANDA


def measure(robot, number, num_seeds):
    """Milliseconds, share solved, mean number of solutions, mean distance of the nearest one."""
    rng = np.random.default_rng(0)
    size = number, robot.num_joints
    poses = robot.end_effector_pose(rng.uniform(robot.lower, robot.upper, size))
    near = rng.uniform(robot.lower, robot.upper, size)
    inverse_kinematics(robot, poses[0], near=near[0])  # compiles
    began = time.process_time()
    found = [
        inverse_kinematics(robot, pose, num_seeds=num_seeds, near=start)
        for pose, start in zip(poses, near, strict=True)
    ]
    milliseconds = 1000 * (time.process_time() - began) / number
    solved = [len(solutions) > 0 for solutions in found]
    distances = [
        np.linalg.norm(robot.normalise(solutions[0]) - robot.normalise(start))
        for solutions, start in zip(found, near, strict=True)
        if len(solutions)
    ]
    return milliseconds, np.mean(solved), np.mean([len(one) for one in found]), np.mean(distances)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--robots", type=Path, nargs="*", default=[], help="beside the Panda")
    parser.add_argument("--num", type=int, default=1000, help="of poses")
    parser.add_argument("--num-seeds", type=int, nargs="*", default=[16, NUM_SEEDS, 64])
    args = parser.parse_args()
    print("robot,searches,duration (ms),share solved,solutions,distance of the nearest")
    for robot in (PANDA, *map(load_robot, args.robots)):
        for num_seeds in args.num_seeds:
            duration, solved, solutions, distance = measure(robot, args.num, num_seeds)
            numbers = f"{duration:.2f},{solved:.3f},{solutions:.1f},{distance:.2f}"
            print(f"{robot.name},{num_seeds},{numbers}", flush=True)


if __name__ == "__main__":
    main()
