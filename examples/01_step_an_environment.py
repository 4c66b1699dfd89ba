"""Make an environment, step it, and read what it returns.

    python examples/01_step_an_environment.py --task double_walls

Moves straight to the goal of one test query, and prints how the episode ends.
"""

import argparse

import numpy as np

import roboarm_nmp
from roboarm_nmp.datasets.queries import load_queries


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="double_walls", choices=roboarm_nmp.TASKS)
    parser.add_argument("--query", type=int, default=0)
    args = parser.parse_args()

    env = roboarm_nmp.make(args.task, goal_type="config")
    query = load_queries(args.task)[args.query]  # start and goal, rad, and the scene
    observation, info = env.reset_specific(*query)
    print("observation:", {name: values.shape for name, values in observation.items()})

    total_reward, ended = 0.0, False
    while not ended:
        # An action is a displacement of the normalised joint angles, clipped to a length of 0.03.
        action = observation["desired_goal"] - observation["achieved_goal"]
        action = np.clip(action, -1.0, 1.0)
        observation, reward, terminated, truncated, info = env.step(action)
        total_reward += float(reward)
        ended = terminated or truncated

    reached = "reached" if info["is_success"] else "not reached"
    contact = "with contact" if info["collision_so_far"] else "without contact"
    print(f"goal {reached} in {info['elapsed_steps']} steps, {contact}, return {total_reward:.0f}")
    env.close()


if __name__ == "__main__":
    main()
