"""Roadmap paths: how many a second, how long, and does the simulated arm follow them?

    pip install -c constraints.txt -e .
    python benchmarks/roadmaps.py    # random_boxes_hard, 20 scenes, 1,000 paths followed

Making paths includes sampling the scene, the roadmap, pruning and shortcuts. Seconds are the
process's own and the wall clock's, which are the same on an idle machine. Lengths are L2 in the
normalised space: of the straight motion, of the shortest path in the roadmap, and of that path
after pruning and shortcuts, all three where the roadmap has a path without further search. Paths of
`Planner` with its defaults are for some of the same queries; its margin is 8 mm, not 15.
`agreement` is the mean cosine between labels of two roadmaps of a scene that differ in their seed,
`agreement_detours` the same where the path is more than 1 longer than the straight motion: planners
that agree can be imitated. The last line is JSON.
"""

import argparse
import contextlib
import json
import os
import platform
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from tqdm import tqdm

from roboarm_nmp import envs
from roboarm_nmp.demo_generation.roadmaps import OPTIONS, Args, Roadmap, random_paths_of_scene
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.planning.following import follow
from roboarm_nmp.planning.planner import Planner, PlanningError

SEED = 2**32 - 1  # the highest: hardly anybody's collection


def length_of(path):
    return np.linalg.norm(np.diff(np.asarray(path, dtype=np.float64), axis=0), axis=1).sum()


def along(path):
    """Points on a path, about 0.02 apart."""
    pieces = [
        np.linspace(a, b, 1 + int(np.ceil(np.linalg.norm(b - a) / 0.02)))
        for a, b in zip(path[:-1], path[1:], strict=True)
    ]
    return np.concatenate(pieces)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="random_boxes_hard", choices=list(envs.TASKS))
    parser.add_argument("--scenes", type=int, default=20, help="(20)")
    parser.add_argument("--num", type=int, default=1000, help="paths that are followed (1,000)")
    parser.add_argument("--peer", type=int, default=100, help="of them also planned (100)")
    args = parser.parse_args()
    if args.scenes < 1 or args.num < args.scenes or args.peer < 0:
        parser.error("--scenes must be at least 1, --num at least as many, --peer at least 0")
    settings = Args(output=None, task=args.task, seed=SEED)
    options = {name: getattr(settings, name) for name in OPTIONS}
    random_paths_of_scene(args.scenes, options | {"paths_per_scene": 2})  # compiles
    cpu, wall, made = time.process_time(), time.perf_counter(), []
    for index in tqdm(range(args.scenes), desc="paths", unit=" scenes"):
        made.append(random_paths_of_scene(index, options))
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    count = sum(len(paths) for _, paths in made)
    result = {"task": args.task, "scenes": args.scenes, "paths": count}
    result |= {"paths_per_cpu_second": count / cpu, "paths_per_second": count / wall}

    env, each = envs.make(args.task), args.num // args.scenes
    planner = Planner(env)
    lengths, near, peers, agreements = [], [], [], []
    outcomes = {"reached": 0, "collided": 0, "reached_collision_free": 0, "refused": 0}
    for index, (scene, paths) in enumerate(tqdm(made, desc="follow", unit=" scenes")):
        rng = np.random.default_rng([SEED, index])
        chosen = [paths[i] for i in rng.permutation(len(paths))[:each]]
        roadmap, checker = Roadmap(scene, rng), CollisionChecker(scene)
        ends = np.array([(path[0], path[-1]) for path in chosen], np.float64)
        points, _, found = roadmap._search(ends[:, 0], ends[:, 1])
        short = roadmap.paths(ends[:, 0], ends[:, 1], rng)
        labels, others = (
            again.labels(*ends.swapaxes(0, 1), rng) for again in (roadmap, Roadmap(scene, rng))
        )
        excess = np.minimum(labels[1], others[1]) - np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        agreements.append(np.stack([(labels[0] * others[0]).sum(1), excess], axis=1))
        lengths += [
            (length_of(one), length_of(points[i]), length_of(short[i]))
            for i, one in enumerate(ends)
            if found[i]
        ]
        for i, path in enumerate(chosen):
            near.append(checker.signed_distances(along(path)).distance.min(-1))
            path = PANDA.denormalise(path.astype(np.float64)).astype(np.float32)
            path = np.clip(path, PANDA.lower.astype(np.float32), PANDA.upper.astype(np.float32))
            try:
                execution = follow(env, path, scene)
            except ValueError:  # start or goal: free for the compiled checks, not for PyBullet
                outcomes["refused"] += 1
                continue
            outcomes["reached"] += execution.reached
            outcomes["collided"] += execution.collided
            outcomes["reached_collision_free"] += execution.reached and not execution.collided
            if i < args.peer / args.scenes:
                with contextlib.suppress(PlanningError):
                    plan = planner.plan(path[0], path[-1], scene, seed=1)
                    peers.append((length_of(chosen[i]), length_of(PANDA.normalise(plan))))
    followed = len(near)
    result |= {name: value / followed for name, value in outcomes.items()} | {"followed": followed}
    names = ("straight", "raw", "smoothed")
    result |= dict(zip(names, np.mean(lengths, axis=0).tolist(), strict=True))
    ours, theirs = np.mean(peers, axis=0).tolist() if peers else (None, None)
    result |= {"planned": len(peers), "same_queries": ours, "planner": theirs}
    cosines, excess = np.concatenate(agreements).T
    result |= {"agreement": float(np.nanmean(cosines))}
    result |= {"agreement_detours": float(np.nanmean(cosines[excess > 1.0]))}
    all_near = np.concatenate(near)
    result |= {"points_within_margin": float((all_near < settings.margin - 1e-4).mean())}
    result |= {"paths_below_3_mm": float(np.mean([x.min() < 0.003 for x in near]))}
    for name, value in result.items():
        print(f"{name:24}{value:.4g}" if isinstance(value, float) else f"{name:24}{value}")
    print()
    print(json.dumps(result | {"python": platform.python_version()}))


if __name__ == "__main__":
    main()
