"""Put an obstacle in motion, and let a planner plan again whenever its path is blocked.

    python examples/09_moving_obstacles.py
    roboarm show moving.yaml --trajectory replanning.csv --output replanning.gif
    roboarm view moving.yaml --policy replanning go-to-goal

Writes the scene and two motions, one straight and one of `replanning`, and prints how they end.
"""

import argparse
from pathlib import Path

import numpy as np

import roboarm_nmp
from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.scenes.files import save_scene
from roboarm_nmp.envs.scenes.motions import Oscillation
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.motions.trajectories import save_trajectory
from roboarm_nmp.policies.registry import make_policy

# Joint angles, rad: from the arm's left to its right.
START = np.array([1.0, 0.4, 0.0, -1.8, 0.0, 2.2, 0.8], np.float32)
GOAL = np.array([-1.0, 0.4, 0.0, -1.8, 0.0, 2.2, 0.8], np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("moving.yaml"))
    args = parser.parse_args()

    # A box that swings by 0.2 m to the left and to the right, once in four seconds.
    swing = Oscillation(amplitude=(0.0, 0.2, 0.0), period=4.0)
    scene = Scene((Box((0.55, 0.0, 0.3), (0.2, 0.1, 0.6), motion=swing),))
    save_scene(scene, args.output)

    env = roboarm_nmp.make(scene, goal_type="config")
    env.reset(seed=0)
    for seconds in (1, 2, 3):
        for _ in range(30):  # an environment step is 1/30 s
            env.step(np.zeros(7))
        box = env.current_scene.obstacles[0]
        print(f"after {env.time:.0f} s the box is at y = {box.position[1]:.2f} m")
        assert round(env.time) == seconds

    query = Query(START, GOAL, scene)
    for name in ("go-to-goal", "replanning"):
        trajectory = rollout(env, query, make_policy(name, env)(0, query).act)
        reached = "reached" if trajectory.success else "not reached"
        contact = "with contact" if trajectory.collides else "without contact"
        print(f"{name}: goal {reached} in {len(trajectory)} steps, {contact}")
        save_trajectory(f"{name}.csv", trajectory)


if __name__ == "__main__":
    main()
