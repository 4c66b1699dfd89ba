"""How much the process grows over 20,000 episodes. The target is below 20 MB.

    pip install -c constraints.txt -e ".[bench]"
    python benchmarks/memory.py
    python benchmarks/memory.py --random-boxes --episodes 100000 --steps 1   # each in a new scene

The last line is JSON.
"""

import argparse
import json

import psutil
from tqdm import trange

import envs
from envs.arm_env import MAX_BODIES_MADE, RoboArmEnv
from envs.random_boxes import RandomBoxes


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="double_walls", choices=list(envs.TASKS))
    parser.add_argument("--random-boxes", action="store_true", help="4 to 8 in each episode")
    parser.add_argument("--episodes", type=int, default=20_000)
    parser.add_argument("--steps", type=int, default=20)
    args = parser.parse_args()
    env = RoboArmEnv(RandomBoxes(4, 8)) if args.random_boxes else envs.make(args.task)
    env.action_space.seed(0)
    # PyBullet keeps bodies that are removed, until the world is made anew: not counted as growth.
    for seed in range(2 * MAX_BODIES_MADE // 4 if args.random_boxes else 1):
        env.reset(seed=seed)
    before = psutil.Process().memory_info().rss
    for _ in trange(args.episodes, unit="episode"):
        env.reset()
        for _ in range(args.steps):
            env.step(env.action_space.sample())
    grown = (psutil.Process().memory_info().rss - before) / 1e6
    what = "random boxes" if args.random_boxes else args.task
    print(f"{args.episodes} episodes of {what}: the process grew by {grown:.1f} MB")
    print(json.dumps({"episodes": args.episodes, "grown_mb": grown}))


if __name__ == "__main__":
    main()
