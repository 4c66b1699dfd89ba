"""Plan a path, check it, and export it with times, for a robot or for `roboarm show`.

    python examples/02_plan_a_path.py --task double_walls --query 0 --output path.csv
    roboarm show double_walls --trajectory path.csv --output path.gif

Prints the number of waypoints, whether the path is free and how near it comes to an obstacle, and
the result of following it in the simulator. The file has a row every 1/30 s: time (s) and the seven
joint angles (rad). With `--output path.npz` it has the arrays `times` and `configurations`.
"""

import argparse
from pathlib import Path

import numpy as np

import roboarm_nmp
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.following import follow
from roboarm_nmp.motions.trajectories import save_joint_path, timed
from roboarm_nmp.planning.planner import Planner


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="double_walls")
    parser.add_argument("--query", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("path.csv"))
    args = parser.parse_args()

    # Plan. Start, goal and path are joint angles in rad; any two collision-free ones will do.
    env = roboarm_nmp.make(args.task)
    start, goal, scene = load_queries(args.task)[args.query]
    path = Planner(env).plan(start, goal, scene, seed=0)
    print(f"{len(path)} waypoints")

    # Check. The collision checker takes normalised configurations.
    checker = CollisionChecker(scene)
    waypoints = np.clip(env.robot.normalise(path), -1.0, 1.0)
    free = checker.is_motion_free(waypoints[:-1], waypoints[1:])
    times, configurations = timed(path, env.robot)  # at the environment's speed
    states = np.clip(env.robot.normalise(configurations), -1.0, 1.0)
    near = checker.signed_distances(states, self_collisions=False).distance.min()
    print(f"{free.sum()} of {len(free)} motions are free, smallest distance {1000 * near:.1f} mm")

    # Export.
    save_joint_path(args.output, configurations, times)
    print(f"{args.output}: {len(times)} configurations, {times[-1]:.2f} s")

    # Follow it in the simulator, where the arm lags behind a little.
    execution = follow(env, path, scene)
    contact = "with contact" if execution.collided else "collision-free"
    reached = "reached" if execution.reached else "not reached"
    print(f"in the simulator: goal {reached} in {len(execution.states) - 1} steps, {contact}")
    hand = env.robot.forward_kinematics(configurations[-1])  # the point between the fingertips, m
    print(f"end effector at the goal: {hand.round(3).tolist()} m")


if __name__ == "__main__":
    main()
