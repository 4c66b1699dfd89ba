"""How much the process grows over 20,000 episodes. The target is below 20 MB.

    pip install -c constraints.txt -e ".[bench]"
    python benchmarks/memory.py
    python benchmarks/memory.py --task random_boxes_hard --episodes 100000 --steps 1

The last line is JSON.
"""

import argparse
import json

import psutil
from tqdm import trange

import envs
from envs.scenes import Scene
from envs.world import MAX_BODIES_MADE


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="double_walls", choices=list(envs.TASKS))
    parser.add_argument("--episodes", type=int, default=20_000)
    parser.add_argument("--steps", type=int, default=20)
    args = parser.parse_args()
    env = envs.make(args.task)
    env.action_space.seed(0)
    # PyBullet keeps bodies that are removed, until the world is made anew: not counted as growth.
    varies = not isinstance(envs.TASKS[args.task].scene, Scene)
    for seed in range(MAX_BODIES_MADE // 2 if varies else 1):
        env.reset(seed=seed)
    before = psutil.Process().memory_info().rss
    for _ in trange(args.episodes, unit="episode"):
        env.reset()
        for _ in range(args.steps):
            env.step(env.action_space.sample())
    grown = (psutil.Process().memory_info().rss - before) / 1e6
    print(f"{args.episodes} episodes of {args.task}: the process grew by {grown:.1f} MB")
    print(json.dumps({"episodes": args.episodes, "grown_mb": grown}))


if __name__ == "__main__":
    main()
