"""Roadmaps: many short paths in one scene, and how to go on from any configuration in it.

    python -m roboarm_nmp.demo_generation.roadmaps --task random_boxes_hard --scenes 6000 --output roadmaps

collects paths of many scenes (read by `envs.datasets.roadmap_paths.load_roadmap_paths`). In Python:

    from roboarm_nmp.demo_generation.roadmaps import Roadmap

    roadmap = Roadmap(scene, rng)
    roadmap.random_paths(300, rng)           # so many paths, each (k, 7), normalised
    roadmap.paths(starts, goals, rng)        # the same for given queries; None where there is none
    roadmap.labels(states, goals, rng)       # the direction to go on in, and how long the rest is

A probabilistic roadmap (Kavraki et al., 1996): random free configurations, each joined to its
nearest neighbours where the straight motion is free, and shortest paths in that graph, which are
then pruned and cut short. Of a motion only some states are looked at beforehand, and the others
when a shortest path would take it (Bohlin and Kavraki, 2000), which finds the same paths.

Paths keep `margin` from everything where there is room. A node, a start or a goal that is nearer
to something than that is not lost: around it, a path may come as near as it is itself, and has to
get away by `MARGIN_GROWTH`.

Scene i of a collection and its paths depend on the seed, the options and i only, so the files are
the same whatever the number of workers. They are written a shard at a time, each in one piece; a
run that was interrupted or killed goes on when it is started again, and one that is finished can be
continued with more scenes.
"""

import copy
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from roboarm_nmp import envs
from roboarm_nmp.envs.collision.checker import RESOLUTION, CollisionChecker
from roboarm_nmp.envs.datasets import shards
from roboarm_nmp.envs.datasets.roadmap_paths import load_roadmap_paths, open_shard, shard_bytes
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.training.flags import PositiveFloat, PositiveInt, Seed, Workers

# L2, normalised, between states of a motion that are looked at before a path wants to take it.
COARSE = 8 * RESOLUTION
# CircularConv a configuration that is nearer to something than the margin, the margin grows by this much
# (m) per unit of normalised distance from it.
MARGIN_GROWTH = 0.05
# Nodes keep at least this (m), as plans do (`demo_generation.planning.MARGIN`).
NODE_MARGIN = 0.003
# A motion costs up to 1 + NARROW times its length, where one of its ends has no room at all.
NARROW = 2.0
# A configuration that is deeper (m) in something is moved out of it before anything else, until it
# is NODE_MARGIN away, in steps of OUT_STEP (normalised).
INSIDE, OUT_STEP, MAX_OUT_STEPS = 0.001, 0.01, 100
# A way begins and ends at one of so many nearest nodes.
JOINED = 30
# Where there is none: nodes that are added near the ends, and how near (normalised) they are drawn,
# the largest standard deviation of each joint.
GROWN, GROWN_SCALE = 400, 0.6
# Normalised, along ways through narrow places: where it is asked how narrow they are.
DENSE = 0.15
# `random_paths`: goals for each path (each costs a search of the whole roadmap), queries for each
# path that is wanted, and how often it draws more of them before it gives up.
GOALS_PER_PATH, SPARE, MAX_ROUNDS = 0.13, 1.1, 10
# Random chords tried on each path, and the share of its length that each has to save.
CHORDS, LEAST_GAIN = 40, 0.005
# A label's direction is that of so much (normalised) of its way, a third of a step of the arm.
AHEAD = 0.01
_HAIR = 1e-5  # m: what rounding may take from a distance
_DIFFERENCES = 1e-4 * np.stack([-np.eye(7), np.eye(7)])  # normalised: (2, 7, 7)


class Roadmap:
    """The roadmap of a scene. Configurations are normalised.

    The same scene, arguments and generators give the same answers.

    Args:
        scene: a `Scene`.
        rng: a NumPy Generator.
        num_nodes: random free configurations.
        num_neighbours: of the nearest nodes, how many each node, start and goal is joined to.
        margin: m, at least `NODE_MARGIN`: what paths keep from everything, the arm itself included.

    Raises:
        ValueError: the margin is smaller.
        RuntimeError: the scene leaves no room for the arm.
    """

    def __init__(self, scene, rng, num_nodes=1000, num_neighbours=14, margin=0.015):
        if not margin >= NODE_MARGIN:
            raise ValueError(f"margin must be at least {NODE_MARGIN} m, got {margin!r}")
        self.scene, self.num_neighbours, self.margin = scene, num_neighbours, margin
        self._checker = CollisionChecker(scene)
        self.nodes, self._room = np.empty((0, 7)), np.empty(0)
        # Motions between neighbours: which of these margins each keeps, 2 if none; and whether all
        # of it has been looked at, or it is only believed.
        self._margins = margin, NODE_MARGIN
        self._edges, self._edge_costs = np.empty((2, 0), np.int64), np.empty((2, 0))
        self._kept, self._is_known = np.empty(0, np.int64), np.empty(0, bool)
        self._add_nodes(self.sample(num_nodes, rng, NODE_MARGIN))

    def _add_nodes(self, nodes):
        """Let motions lead from free configurations (n, 7) to the nearest nodes."""
        first = len(self.nodes)
        self.nodes = np.concatenate([self.nodes, nodes])
        self._room = np.concatenate([self._room, self._rooms(nodes)])
        near = self._nearest_nodes(nodes, self.num_neighbours + 1)  # one is the node itself
        one = np.repeat(np.arange(first, len(self.nodes)), near.shape[1])
        edges = np.stack([one, near.ravel()])
        edges = np.unique(np.sort(edges[:, edges[0] != edges[1]], axis=0), axis=1)
        self._edges = np.concatenate([self._edges, edges], axis=1)
        ends = self.nodes[edges]
        costs = np.stack([self._costs(*ends, *self._room[edges]), self._costs(*ends, 0.0, 0.0)])
        self._edge_costs = np.concatenate([self._edge_costs, costs], axis=1)
        kept = np.zeros(edges.shape[1], np.int64)
        for i, margin in enumerate(self._margins):
            asked = np.flatnonzero(kept == i)
            motions = *self.nodes[edges[:, asked]], *self._room[edges[:, asked]]
            kept[asked] += ~self._joined(*motions, margin, COARSE)
        self._kept = np.concatenate([self._kept, kept])
        self._is_known = np.concatenate([self._is_known, np.zeros(len(kept), bool)])

    def _grown(self, around, rng):
        """This roadmap with more nodes, near configurations that could not be joined to it."""
        centres = around[np.arange(GROWN) % len(around)]
        scale = rng.uniform(0.0, GROWN_SCALE, (GROWN, 1))
        new = np.clip(centres + scale * rng.standard_normal((GROWN, 7)), -1.0, 1.0)
        roadmap = copy.copy(self)
        roadmap._add_nodes(new[self._checker.is_free(new, NODE_MARGIN)])
        return roadmap

    def sample(self, number, rng, margin=0.0):
        """Random free configurations, float64 (number, 7). Raises RuntimeError: there are none."""
        found, missing = [np.empty((0, 7))], number
        for _ in range(1000):
            if missing == 0:
                break
            states = rng.uniform(-1.0, 1.0, (4 * missing, 7))
            found.append(states[self._checker.is_free(states, margin)][:missing])
            missing -= len(found[-1])
        else:
            raise RuntimeError("the scene leaves no room for the arm")
        return np.concatenate(found)

    def random_paths(self, number, rng):
        """`number` smoothed paths between random free configurations: a list of float32 (k, 7).

        Fewer, where hardly any configurations can be joined.
        """
        goals = self.sample(int(np.ceil(GOALS_PER_PATH * number)), rng)
        paths = []
        for _ in range(MAX_ROUNDS):
            tried = int(np.ceil(SPARE * (number - len(paths))))
            which = rng.integers(len(goals), size=tried)
            found = self.paths(self.sample(tried, rng), goals[which], rng)
            paths += [path for path in found if path is not None]
            if len(paths) >= number:
                break
        return paths[:number]

    def paths(self, starts, goals, rng):
        """Smoothed paths from starts (n, 7) to goals (n, 7): a list of float32 (k, 7), k > 1, or
        None where there is no way.

        Starts may be in contact, as for `labels`. Fast for many queries with few different goals.
        """
        # The simulated arm may be a little beyond its limits.
        starts, goals = (
            np.clip(np.asarray(x, dtype=np.float64), -1.0, 1.0).reshape(-1, 7)
            for x in (starts, goals)
        )
        begins = self._moved_out(starts, -INSIDE)
        points, room, found = self._search(begins, goals)
        paths = [None] * len(starts)
        ways = self._smooth(points[found], points[found], room[found], rng)
        for i, path in zip(np.flatnonzero(found), ways, strict=True):
            paths[i] = path
        lost = np.flatnonzero(~found)
        if len(lost):
            # Through narrow places, where the margin is not kept. Away from them it is.
            begins[lost] = self._moved_out(begins[lost], NODE_MARGIN)
            ends = np.unique(np.concatenate([begins[lost], goals[lost]]), axis=0)
            points, _, found = self._grown(ends, rng)._search(
                begins[lost], goals[lost], narrow=True
            )
            states = _dense(points[found])
            room = self._rooms(states.reshape(-1, 7)).reshape(states.shape[:2])
            ways = self._smooth(points[found], states, room, rng)
            for i, path in zip(lost[found], ways, strict=True):
                paths[i] = path
        for i, path in enumerate(paths):
            if path is not None:
                path = np.concatenate([starts[i : i + 1], path]).astype(np.float32)
                moves = (path[1:] != path[:-1]).any(1)
                # A path whose start is its goal has two points, too.
                paths[i] = path[np.r_[True, moves]] if moves.any() else path[:2]
        return paths

    def labels(self, states, goals, rng):
        """How to go on from each of the states (n, 7) to its goal (n, 7).

        States may be in contact. Where one is nearer to something than the margin, the way begins
        as near as it is. From really inside something, it first goes the shortest way out.

        Returns:
            directions: float32 (n, 7), unit vectors: to where the way is after `AHEAD`. Zeros where
                the state is its goal, NaN where there is no way.
            lengths: float32 (n,), of the way, L2, normalised. NaN where there is none.
        """
        directions = np.full((len(states), 7), np.nan, np.float32)
        lengths = np.full(len(states), np.nan, np.float32)
        for i, path in enumerate(self.paths(states, goals, rng)):
            if path is not None:
                steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
                come = np.concatenate([[0.0], np.cumsum(steps, dtype=np.float64)])
                move = [np.interp(AHEAD, come, values) for values in path.T] - path[0]
                directions[i] = move / max(np.linalg.norm(move), 1e-12)
                lengths[i] = come[-1]
        return directions, lengths

    def _distances(self, states):
        """m, of the arm from the nearest thing; negative inside of it."""
        return self._checker.signed_distances(states).distance.min(-1)

    def _rooms(self, states):
        """The distances, at most the margin."""
        room = np.full(len(states), self.margin)
        near = ~self._checker.is_free(states, self.margin)
        room[near] = np.minimum(self._distances(states[near]), self.margin)
        return room

    def _free(self, starts, ends, states, room, margin, **options):
        """Whether motions (n, 7) are free, each as near as its own states (n, k, 7) allow."""
        endpoint_margins = (states, room - _HAIR, MARGIN_GROWTH)
        return self._checker.is_motion_free(
            starts, ends, margin, endpoint_margins=endpoint_margins, **options
        )

    def _costs(self, starts, ends, start_room, end_room):
        """Of straight motions (..., 7), if they are free."""
        tightness = 1.0 - np.clip(np.minimum(start_room, end_room) / self.margin, 0.0, 1.0)
        return np.linalg.norm(ends - starts, axis=-1) * (1.0 + NARROW * tightness)

    def _joined(self, starts, ends, start_room, end_room, margin, resolution=RESOLUTION):
        """Whether straight motions (n, 7) are free, as near as both of their ends allow."""
        states, room = np.stack([starts, ends], axis=1), np.stack([start_room, end_room], axis=1)
        options = {"resolution": resolution, "ends_known": True}
        return self._free(starts, ends, states, room, margin, **options)

    def _nearest_nodes(self, states, number):
        """(n, number), in any order."""
        squared = (self.nodes**2).sum(1) - 2.0 * states @ self.nodes.T
        return np.argpartition(squared, number, axis=1)[:, :number]

    def _smooth(self, points, states, room, rng):
        """Paths (n, k, 7), padded, made shorter, as near as the states (n, m, 7) allow that they
        come by.
        """
        return self._cut_short(self._prune(points, states, room), states, room, rng)

    def _search(self, starts, goals, narrow=False):
        """Shortest paths: points (n, k, 7), padded with the goal, their room (n, k), found (n,).

        Where they are `narrow`, their motions need not keep more than `NODE_MARGIN`.
        """
        margin, count = self._margins[narrow], len(self.nodes)
        goals, which = np.unique(goals, axis=0, return_inverse=True)
        start_room, goal_room = self._rooms(starts), self._rooms(goals)
        states, room = np.concatenate([self.nodes, goals]), np.concatenate([self._room, goal_room])
        # Edges lead from goals to nodes and not back: no path goes through another query's goal.
        goal = np.repeat(np.arange(len(goals)), JOINED)
        node = self._nearest_nodes(goals, JOINED).ravel()
        ways = goals[goal], self.nodes[node], goal_room[goal], self._room[node]
        goal_costs = self._costs(*ways)
        goal_costs[~self._joined(*ways, margin)] = np.inf
        # The first step is to the goal itself or to a node.
        first = np.c_[count + which, self._nearest_nodes(starts, JOINED)]
        first_costs = self._costs(starts[:, None], states[first], start_room[:, None], room[first])
        first_costs[start_room < -INSIDE] = np.inf
        is_known = np.zeros(first.shape, bool)
        found, routes = np.zeros(len(starts), bool), {}
        waiting = np.arange(len(starts))
        while len(waiting):
            asked, row = np.unique(which[waiting], return_inverse=True)
            rest, before = self._shortest(asked, goal, node, goal_costs, narrow)
            # From or to the inside of something there is no way.
            rest[goal_room[asked] < -INSIDE] = np.inf
            while True:  # the best first step of those that are free
                costs = first_costs[waiting] + rest[row[:, None], first[waiting]]
                best = costs.argmin(1)
                possible = np.isfinite(costs.min(1))
                unknown = possible & ~is_known[waiting, best]
                if not unknown.any():
                    break
                query, step = waiting[unknown], best[unknown]
                tried = first[query, step]
                ends = starts[query], states[tried]
                free = self._joined(*ends, start_room[query], room[tried], margin)
                is_known[query, step] = True
                first_costs[query[~free], step[~free]] = np.inf
            waiting, best, row = waiting[possible], best[possible], row[possible]
            at = first[waiting, best]
            route = [at]
            while (at < count).any():
                at = np.where(at < count, before[row, at], at)
                route.append(at)
            route = np.stack(route, axis=1)
            free = self._look(route, narrow)
            found[waiting[free]] = True
            routes |= dict(zip(waiting[free], route[free], strict=True))
            waiting = waiting[~free]
        size = max(map(len, routes.values()), default=1)
        route = np.repeat(count + which[:, None], size, axis=1)
        for i, nodes in routes.items():
            route[i, : len(nodes)] = nodes
        points = np.concatenate([starts[:, None], states[route]], axis=1)
        return points, np.concatenate([start_room[:, None], room[route]], axis=1), found

    def _shortest(self, asked, goal, node, goal_costs, narrow):
        """Dijkstra's algorithm from the goals that are asked, by what is not known to be blocked.

        `goal[i]` is joined to `node[i]`, where that costs less than infinity.

        Returns lengths and predecessors, (asked, nodes + goals).
        """
        count, usable = len(self.nodes), np.flatnonzero(self._kept <= narrow)
        one, other = self._edges[:, usable]
        costs = self._edge_costs[self._kept[usable], usable]
        joined = np.isfinite(goal_costs)
        tails = np.concatenate([one, other, count + goal[joined]])
        heads = np.concatenate([other, one, node[joined]])
        costs = np.concatenate([costs, costs, goal_costs[joined]])
        size = count + goal[-1] + 1
        graph = csr_array((costs, (tails, heads)), shape=(size, size))
        return dijkstra(graph, indices=count + asked, return_predecessors=True)

    def _look(self, route, narrow):
        """Whether all motions between nodes of each route (n, k) are what they were believed to be.

        Those that were only believed are looked at.
        """
        count = len(self.nodes)
        path, step = np.nonzero((route[:, 1:] < count) & (route[:, :-1] != route[:, 1:]))
        ends = np.sort([route[path, step], route[path, step + 1]], axis=0)
        names, wanted = self._edges[0] * count + self._edges[1], ends[0] * count + ends[1]
        order = np.argsort(names)
        used = order[np.searchsorted(names, wanted, sorter=order)]
        unknown = np.unique(used[~self._is_known[used]])
        for kept in (1, 0):
            edges = unknown[self._kept[unknown] == kept]
            ends = self._edges[:, edges]
            free = self._joined(*self.nodes[ends], *self._room[ends], self._margins[kept])
            self._is_known[edges[free]] = True
            self._kept[edges[~free]] += 1
        free = np.ones(len(route), bool)
        free[path[~self._is_known[used] | (self._kept[used] > narrow)]] = False
        return free

    def _prune(self, points, states, room):
        """Paths (n, k, 7), padded, without the vertices that straight motions can leave out."""
        n, size = points.shape[:2]
        lengths = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
        moves = np.full((n, size, size), np.inf)
        steps = np.arange(size - 1)
        moves[:, steps, steps + 1] = lengths[:, steps, steps + 1]
        first, last = np.triu_indices(size, 2)
        path, pair = np.nonzero(moves[:, last - 1, last] > 0.0)  # not to where the goal is repeated
        first, last = first[pair], last[pair]
        ends = points[path, first], points[path, last]
        free = self._free(*ends, states[path], room[path], self.margin, ends_known=True)
        path, first, last = path[free], first[free], last[free]
        moves[path, first, last] = lengths[path, first, last]
        # The shortest way through what is left, by dynamic programming.
        costs, before = np.zeros((n, size)), np.zeros((n, size), np.int64)
        for i in range(1, size):
            through = costs[:, :i] + moves[:, :i, i]
            before[:, i], costs[:, i] = through.argmin(1), through.min(1)
        kept, at = np.zeros((n, size), bool), np.full(n, size - 1)
        for _ in range(size):
            kept[np.arange(n), at] = True
            at = before[np.arange(n), at]
        order = np.argsort(~kept, axis=1, kind="stable")
        order[np.arange(size) >= kept.sum(1)[:, None]] = size - 1
        pruned = np.take_along_axis(points, order[:, :, None], axis=1)
        return pruned[:, : max(kept.sum(1).max(initial=0), 2)]

    def _cut_short(self, points, states, room, rng):
        """Paths (n, k, 7), padded, after trying random chords; as near as their states allow."""
        rows = np.arange(len(points))
        for _ in range(CHORDS):
            steps = np.linalg.norm(np.diff(points, axis=1), axis=-1)
            ends = np.cumsum(steps, axis=1)
            total = ends[:, -1]
            along = np.sort(rng.random((len(points), 2)), axis=1) * total[:, None]
            edge = (ends[:, None] <= along[:, :, None]).sum(-1).clip(max=points.shape[1] - 2)
            rest = (ends[rows[:, None], edge] - along) / np.maximum(
                steps[rows[:, None], edge], 1e-9
            )
            tail, head = points[rows[:, None], edge], points[rows[:, None], edge + 1]
            chord = head - (head - tail) * rest[:, :, None]
            gain = along[:, 1] - along[:, 0] - np.linalg.norm(chord[:, 1] - chord[:, 0], axis=1)
            tried = np.flatnonzero(gain > LEAST_GAIN * total)
            free = self._free(
                *np.moveaxis(chord[tried], 1, 0), states[tried], room[tried], self.margin
            )
            cut = tried[free]
            points = np.concatenate([points, points[:, -1:]], axis=1)
            # Vertices up to the chord, its two ends, vertices from there on.
            place = np.arange(points.shape[1])
            i, j = edge[cut, 0, None], edge[cut, 1, None]
            old = np.where(place <= i, place, (place - i - 2 + j).clip(0, points.shape[1] - 1))
            new = points[cut[:, None], old]
            new[np.arange(len(cut)), i[:, 0] + 1] = chord[cut, 0]
            new[np.arange(len(cut)), i[:, 0] + 2] = chord[cut, 1]
            points[cut] = new
            while points.shape[1] > 2 and (points[:, -1] == points[:, -2]).all():
                points = points[:, :-1]
        return points

    def _moved_out(self, states, room):
        """The states, those with less room (m) moved to `NODE_MARGIN` by the shortest way."""
        states = states.copy()
        inside = np.flatnonzero(self._rooms(states) < room)
        for _ in range(MAX_OUT_STEPS):
            if not len(inside):
                break
            # Uphill in distance, by central differences.
            around = np.clip(states[inside, None, None] + _DIFFERENCES, -1.0, 1.0)
            low, high = np.moveaxis(self._distances(around.reshape(-1, 7)).reshape(-1, 2, 7), 1, 0)
            uphill = high - low
            uphill /= np.maximum(np.linalg.norm(uphill, axis=1, keepdims=True), 1e-12)
            states[inside] = np.clip(states[inside] + OUT_STEP * uphill, -1.0, 1.0)
            inside = inside[self._distances(states[inside]) < NODE_MARGIN]
        return states


def _dense(points):
    """Points along paths (n, k, 7), at most DENSE apart: (n, m, 7)."""
    moves = np.diff(points, axis=1)[:, :, None]
    pieces = max(int(np.ceil(np.linalg.norm(moves, axis=-1).max(initial=0.0) / DENSE)), 1)
    dense = points[:, :-1, None] + np.arange(pieces)[:, None] / pieces * moves
    dense = dense.reshape(len(points), moves.shape[1] * pieces, 7)
    return np.concatenate([dense, points[:, -1:]], axis=1)


# Streams 1 to 4 of random numbers are those of queries, demonstrations and observations. Seeds are
# below 2^32, so each is one word of what NumPy seeds with: no scene is one of another stream's.
STREAM = 5


@dataclass
class Args:
    output: Path
    """Folder to write to."""
    task: str = "random_boxes_hard"
    """Name of a task, `mixed_scenes`, or path of a scene file. Where scenes do not vary, each has a
    new roadmap."""
    scenes: PositiveInt = 6000
    """Number of scenes."""
    paths_per_scene: PositiveInt = 300
    """Paths in each of them."""
    num_nodes: PositiveInt = 1000
    """Nodes of a roadmap."""
    num_neighbours: PositiveInt = 14
    """SignedDistances nodes that each is joined to, where the motion is free."""
    margin: PositiveFloat = 0.015
    """Metres that paths keep from everything, where there is room."""
    shard_size: PositiveInt = 50
    """Scenes in each file."""
    seed: Seed = 0
    """Seed of scenes and roadmaps."""
    workers: Workers = 2
    """Number of processes. The files do not depend on it."""
    ray_address: str | None = None
    """Work on the Ray cluster at this address (`auto`, `HOST:PORT`) and not in local processes."""


# What a shard depends on, besides its number.
OPTIONS = (
    "task",
    "paths_per_scene",
    "num_nodes",
    "num_neighbours",
    "margin",
    "shard_size",
    "seed",
)


def random_paths_of_scene(index, options):
    """`(Scene, paths)` of scene `index` of a collection. `options`: a dict with keys `OPTIONS`."""
    rng = np.random.default_rng([options["seed"], STREAM, index])
    scene = envs.get_task(options["task"]).scene
    scene = scene if isinstance(scene, Scene) else scene.sample(rng)
    arguments = {name: options[name] for name in ("num_nodes", "num_neighbours", "margin")}
    roadmap = Roadmap(scene, rng, **arguments)
    return scene, roadmap.random_paths(options["paths_per_scene"], rng)


class Collector:
    """Makes shards; a job is (number of the shard, first scene, scene after the last)."""

    def __init__(self, options, made_by):
        self.options, self.made_by = options, made_by

    def __call__(self, job):
        """`(number, contents of the file)`."""
        number, first, end = job
        made = [random_paths_of_scene(index, self.options) for index in range(first, end)]
        scenes, paths = zip(*made, strict=True)
        task, seed = self.options["task"], self.options["seed"]
        return number, shard_bytes(task, seed, first, scenes, paths, self.made_by)


def collect(args, progress=True):
    """Make the shards that are missing; returns all `RoadmapPaths`.

    Raises:
        ValueError: arguments that cannot work; the folder holds other paths, or damaged ones.
        RuntimeError: a scene leaves no room for the arm, or workers keep dying.
        ConnectionError: there is no Ray cluster.
        OSError: the folder cannot be written. What was written is safe.
    """
    if args.num_nodes <= max(args.num_neighbours, JOINED):
        raise ValueError(f"--num-nodes must be above {max(args.num_neighbours, JOINED)}")
    if not args.margin >= NODE_MARGIN:
        raise ValueError(f"--margin must be at least {NODE_MARGIN} m")
    package = Path(envs.__file__).parent.resolve()
    if package in (args.output.resolve(), *args.output.resolve().parents):
        raise ValueError(
            f"{args.output} is in {package}: the repository's own files stay as they are"
        )
    shards.check_collection(args)
    options = {name: getattr(args, name) for name in OPTIONS}
    given = [f"--{name.replace('_', '-')} {value}" for name, value in options.items()]
    made_by = " ".join(["python -m roboarm_nmp.demo_generation.roadmaps", *given])
    shards.collect(
        args,
        args.scenes,
        Collector,
        (options, made_by),
        made_by,
        open_shard,
        counted="path_count",
        unit="paths",
        per_scene=args.paths_per_scene,
        progress=progress,
    )
    return load_roadmap_paths(args.output)


def main(args):
    try:
        made = collect(args)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
        sys.exit(130)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    size = sum(path.stat().st_size for path in args.output.glob("shard_*.h5"))
    count = len(made.offsets) - 1
    print(f"{args.output}: {len(made)} scenes, {count} paths, {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m roboarm_nmp.demo_generation.roadmaps", description=__doc__))
