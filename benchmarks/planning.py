"""Planning with compiled collision checks: how fast, and how often is there a plan in time?

    pip install -c constraints.txt -e .
    python benchmarks/planning.py    # random_boxes_hard; about 3 minutes
    python benchmarks/planning.py --task benchmaker_bookshelf_thin --split original

`ours` is `planning.planner.Planner` with its defaults: RRT-Connect alternates with
LBKPIECE1, margins shrink, and one round of shortening follows. Two others check one configuration
at a time in PyBullet's world, asked from Python. They make up to three searches with smaller and
smaller margins, as `Planner` did before `envs.collision.checker`. `pybullet_same_options` has our
range and shortening, `pybullet_checked` OMPL's own range and three rounds of shortening.

The others plan the first `--peer` queries, in turns with ours. Means are over all queries of a
planner, unsolved queries included; ratios are over the queries of both planners. Times are
wall-clock time of one process, so nothing else should run. The last line is JSON.
"""

import argparse
import contextlib
import json
import math
import os
import platform
import time
from dataclasses import replace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from ompl import base as ob
from tqdm import tqdm

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.collision.checker import RESOLUTION
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene
from roboarm_nmp.planning import planner as planning
from roboarm_nmp.planning.planner import MARGIN, MARGIN_GROWTH, Planner, PlanningError
from roboarm_nmp.utils.bullet import pybullet as p


class PyBulletValidity:
    """Whether a normalised configuration is free, by the contacts that PyBullet reports."""

    def __init__(self, world, margin, ends, deadline):
        self.world, self.margin, self.checks = world, margin, 0
        self.ends = [(PANDA.normalise(end), self.distance(end) - 1e-5) for end in ends]
        self.deadline = deadline

    def distance(self, configuration):
        client, body = self.world.client, self.world.body
        PANDA.set_configuration(client, body, configuration)
        p.performCollisionDetection(physicsClientId=client)
        contacts = p.getContactPoints(bodyA=body, physicsClientId=client)
        return min((contact[8] for contact in contacts), default=math.inf)

    def __call__(self, state):
        self.checks += 1
        state = [state[i] for i in range(PANDA.num_joints)]
        nearest = self.distance(PANDA.denormalise_one(state))
        return nearest >= self.margin or any(
            nearest >= distance + MARGIN_GROWTH * math.dist(state, end)
            for end, distance in self.ends
        )

    def exhausted(self):
        return time.monotonic() > self.deadline

    def restore_margins(self):
        """Nothing to do: margins do not change within a search."""


class PyBulletPlanner(Planner):
    """The earlier planner: inflated scenes give clearance, and every search starts anew."""

    def __init__(self, env, **options):
        super().__init__(env, **options)
        self.inflated = envs.RoboArmEnv(env.scene)

    def plan(self, start, goal, scene=None, *, seed, time_limit=5.0):
        rng, deadline = np.random.default_rng(seed), time.monotonic() + time_limit
        self.env.reset_specific(start, goal, scene)
        goals = np.array([goal], dtype=np.float32)
        for share, self.margin_scale in ((0.5, 1.0), (0.5, 0.5), (1.0, 0.25)):
            until = time.monotonic() + share * (deadline - time.monotonic())
            path = self._search(start, goals, int(rng.integers(1, 2**32)), until)
            if path is not None:
                return path
        raise PlanningError(f"no path in {time_limit} s")

    def _turns(self):
        return ((self.planner, math.inf),)

    def _validity(self, start, goals, deadline):
        world, goal = self.env, goals[0]
        self.inflated.set_scene(inflate(self.env.scene, self.margin_scale * self.clearance))
        if not any(self.inflated.in_collision(end) for end in (start, goal)):
            world = self.inflated
        return PyBulletValidity(world, self.margin_scale * MARGIN, (start, goal), deadline)

    def _space(self, is_valid):
        information = ob.SpaceInformation(planning.normalised_space(PANDA.num_joints))
        information.setStateValidityChecker(is_valid)
        longest = information.getStateSpace().getMaximumExtent()
        information.setStateValidityCheckingResolution(RESOLUTION / longest)
        information.setup()
        return information


def inflate(scene, clearance):
    """The scene with everything larger by `clearance` (m) on all sides."""

    def grow(body):
        if isinstance(body, Box):
            return replace(body, size=tuple(edge + 2 * clearance for edge in body.size))
        if isinstance(body, Cylinder):
            return replace(body, radius=body.radius + clearance, length=body.length + 2 * clearance)
        return replace(body, radius=body.radius + clearance)

    return Scene(
        tuple(grow(obstacle) for obstacle in scene.obstacles),
        table=None if scene.table is None else grow(scene.table),
        floor=None if scene.floor is None else scene.floor + clearance,
    )


def plan(planner, query, seconds, seed):
    """(milliseconds, the path or None)"""
    began, path = time.perf_counter(), None
    with contextlib.suppress(PlanningError):
        path = planner.plan(*query, seed=seed, time_limit=seconds)
    return 1e3 * (time.perf_counter() - began), path


def length_of(path):
    """L2 in the normalised space, of a path (n, 7), rad."""
    return np.linalg.norm(np.diff(PANDA.normalise(path), axis=0), axis=1).sum()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="random_boxes_hard", choices=list(envs.TASKS))
    parser.add_argument("--split", default="test", choices=["test", "validation", "original"])
    parser.add_argument("--num", type=int, default=1000, help="queries (1,000)")
    parser.add_argument("--peer", type=int, default=300, help="queries of the others (300)")
    parser.add_argument("--limits", type=float, nargs="+", default=[5.0, 0.05], help="seconds")
    args = parser.parse_args()
    queries = load_queries(args.task, args.split)[: args.num]
    if args.num < 1 or args.peer < 0 or min(args.limits) <= 0:
        parser.error("--num must be at least 1, --peer at least 0, --limits positive")
    env, other_env = envs.make(args.task), envs.make(args.task)
    ways = {
        "ours": Planner(env),
        "pybullet_checked": PyBulletPlanner(other_env, planner_range=0, simplify=3),
        "pybullet_same_options": PyBulletPlanner(other_env),
    }
    plan(ways["ours"], queries[0], 60.0, 0)  # compiles
    result = {"task": args.task, "split": args.split, "queries": len(queries)}
    rows = []
    for seconds in args.limits:
        first = seconds == args.limits[0]
        found = {way: [] for way in ways}
        for i in tqdm(range(len(queries)), desc=f"{args.task}, {seconds:g} s", unit=" queries"):
            for way, planner in ways.items():
                if way == "ours" or (first and i < args.peer):
                    found[way].append(plan(planner, queries[i], seconds, i))
        times = {way: np.array([time for time, _ in plans]) for way, plans in found.items()}
        for way, plans in found.items():
            paths = [path for _, path in plans if path is not None]
            if not paths:
                continue
            solved, length = len(paths) / len(plans), np.mean([length_of(path) for path in paths])
            rows.append((seconds, way, len(plans), solved, times[way], length))
            if way == "ours":
                result[f"solved_in_{seconds:g}_s"] = solved
            if first:
                prefix = "" if way == "ours" else f"{way}_"
                result |= {f"{prefix}mean_ms": times[way].mean(), f"{prefix}solved": solved}
            if first and way != "ours":
                ratio = times[way].mean() / times["ours"][: len(plans)].mean()
                result[f"ratio_to_{way}"] = ratio
    head = f"{'limit':>8}  {'planner':24}{'queries':>8}{'solved':>8}{'mean':>9}{'median':>9}"
    print(f"\n{head}{'90 %':>9}{'length':>8}")
    for seconds, way, count, solved, spent, length in rows:
        line = f"{seconds:6g} s  {way:24}{count:8}{solved:8.3f}"
        for value in (spent.mean(), *np.percentile(spent, [50, 90])):
            line += f"{value:6.1f} ms"
        print(f"{line}{length:8.2f}")
    print()
    print(json.dumps(result | {"python": platform.python_version()}))


if __name__ == "__main__":
    main()
