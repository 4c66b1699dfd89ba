"""Replay 1,000 episodes in shuffled order and in another process: the same, bit for bit.

    python benchmarks/exact_replay.py
    python benchmarks/exact_replay.py --task random_boxes_hard

Prints how many episodes differ (it must be 0) and how many of them had contacts. Exit code 1
if any differs. The last line is JSON.
"""

import argparse
import hashlib
import json
import multiprocessing
import sys

import numpy as np
from tqdm import tqdm

from roboarm_nmp import envs


def run_episode(env, seed, steps):
    """(hash of all that an episode with random actions returned, whether there was a contact)."""
    rng = np.random.default_rng(seed)
    env.sample_scene(rng)
    start, goal = env.sample_query(rng)
    digest = hashlib.sha256()
    env.reset_specific(start, goal)
    for action in rng.uniform(-1, 1, (steps // 10, 7)).astype(np.float32).repeat(10, axis=0):
        observation, reward, terminated, truncated, info = env.step(action)
        digest.update(observation["observation"].tobytes())
        digest.update(observation["achieved_goal"].tobytes())
        digest.update(repr((reward, terminated, truncated, info)).encode())
    return digest.hexdigest(), info["collision_so_far"]


def run_all(task, seeds, steps):
    env = envs.make(task)
    results = {seed: run_episode(env, seed, steps) for seed in tqdm(seeds, unit="episode")}
    env.close()
    return results


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="double_walls", choices=list(envs.TASKS))
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=100)
    args = parser.parse_args()
    seeds = list(range(args.episodes))
    first = run_all(args.task, seeds, args.steps)
    shuffled = np.random.default_rng(0).permutation(seeds).tolist()
    again = run_all(args.task, shuffled, args.steps)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        elsewhere = pool.apply(run_all, (args.task, shuffled[::-1], args.steps))
    different = sum(not first[s] == again[s] == elsewhere[s] for s in seeds)
    contacts = sum(contact for _, contact in first.values())
    print(f"{args.episodes} episodes of {args.task}, {contacts} with contacts: {different} differ")
    print(json.dumps({"episodes": args.episodes, "contacts": contacts, "different": different}))
    sys.exit(different > 0)


if __name__ == "__main__":
    main()
