"""How much the process grows over 20,000 episodes. The target is below 20 MB.

    pip install -c constraints.txt -e ".[bench]"
    python benchmarks/memory.py
    python benchmarks/memory.py --task random_boxes_hard --episodes 100000 --steps 1
    python benchmarks/memory.py --soak 60

With --soak, all tasks in turn for so many minutes, each time in a new environment with cameras,
point clouds and distances: how much it grows after the first turns of all tasks, in which it fills
what it may remember of scenes and makes worlds anew. The target is below 30 MB in an hour.

The last line is JSON.
"""

import argparse
import itertools
import json
import time

import psutil
from tqdm import tqdm, trange

from roboarm_nmp import envs
from roboarm_nmp.envs.perception.sensors import Camera, PointCloud, cardinal
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.world import MAX_BODIES_MADE
from roboarm_nmp.envs.wrappers import SensorWrapper

EPISODES_PER_TURN, FIRST_TURNS = 20, 20


def megabytes():
    return psutil.Process().memory_info().rss / 1e6


def soak(minutes, steps):
    """Megabytes that an alternation of all tasks adds after `FIRST_TURNS`, and its episodes."""
    began, before, episodes = time.time(), None, 0
    sensors = cardinal(Camera, size=(64, 64))
    clouds = cardinal(PointCloud, num_samples=900)
    sensors |= {f"{name}_cloud": cloud for name, cloud in clouds.items()}
    bar = tqdm(unit="episode")
    for turn in itertools.count():
        for number, task in enumerate(envs.TASKS):
            env = SensorWrapper(envs.make(task, encoder="points", link_distances="points"), sensors)
            env.action_space.seed(turn)
            env.reset(seed=turn * len(envs.TASKS) + number)
            for _ in range(EPISODES_PER_TURN):
                env.reset()
                for _ in range(steps):
                    env.step(env.action_space.sample())
            env.close()
            episodes += EPISODES_PER_TURN
            bar.update(EPISODES_PER_TURN)
            if before is not None:
                bar.set_postfix(grown_mb=f"{megabytes() - before:.1f}")
        if turn + 1 == FIRST_TURNS:
            before = megabytes()
        if before is not None and time.time() - began > 60 * minutes:
            return megabytes() - before, episodes


def one_task(task, episodes, steps):
    """Megabytes that so many episodes of a task add."""
    env = envs.make(task)
    env.action_space.seed(0)
    # PyBullet keeps bodies that are removed, until the world is made anew: not counted as growth.
    varies = not isinstance(envs.TASKS[task].scene, Scene)
    for seed in range(MAX_BODIES_MADE // 2 if varies else 1):
        env.reset(seed=seed)
    before = megabytes()
    for _ in trange(episodes, unit="episode"):
        env.reset()
        for _ in range(steps):
            env.step(env.action_space.sample())
    return megabytes() - before


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="double_walls", choices=list(envs.TASKS))
    parser.add_argument("--episodes", type=int, default=20_000)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--soak", type=float, metavar="MINUTES", help="all tasks, with sensors")
    args = parser.parse_args()
    if args.soak:
        grown, episodes = soak(args.soak, args.steps)
        what = f"all tasks in turn for {args.soak:g} minutes"
    else:
        grown, episodes = one_task(args.task, args.episodes, args.steps), args.episodes
        what = args.task
    print(f"{episodes} episodes of {what}: the process grew by {grown:.1f} MB")
    print(json.dumps({"episodes": episodes, "grown_mb": grown}))


if __name__ == "__main__":
    main()
