"""Roadmaps: many short paths in one scene.

    roboarm roadmaps --task random_boxes_hard --scenes 6000 --output roadmaps

collects paths of many scenes, for `datasets.roadmap_paths.load_roadmap_paths`. In Python:

    from roboarm_nmp.demo_generation.roadmaps import Roadmap

    roadmap = Roadmap(scene, rng)
    roadmap.random_paths(300, rng)           # 300 paths, each (k, j), normalised
    roadmap.paths(starts, goals, rng)        # paths of given queries; None where there is none

A roadmap is a probabilistic roadmap (Kavraki et al., 1996). Its nodes are random free
configurations; its edges are free straight motions to the nearest neighbours. Shortest paths in
that graph are then pruned and shortened. Edges are checked coarsely at first, and finely when a
shortest path would take them (Bohlin and Kavraki, 2000), which finds the same paths.

Paths keep `margin` from obstacles and from the arm itself where there is room. Near a node, a start
or a goal that is closer, the margin is that configuration's own distance, and grows by
`MARGIN_GROWTH` away from it. In shapes, j is the robot's number of joints.

Scene i of a collection and its paths depend only on the seed, the options and i, so the files are
the same for every number of workers. They are written in shards, each atomically. After an
interruption the same command continues; a finished collection is extended by a larger `--scenes`.
"""

import copy
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from roboarm_nmp import envs
from roboarm_nmp.datasets import shards
from roboarm_nmp.datasets.roadmap_paths import (
    RoadmapPaths,
    load_roadmap_paths,
    open_shard,
    shard_bytes,
)
from roboarm_nmp.demo_generation.place_configurations import place_configurations
from roboarm_nmp.envs.collision.checker import RESOLUTION, CollisionChecker
from roboarm_nmp.envs.scenes.containers import Containers
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.scenes.wide_scenes.distribution import WideScenes
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.flags import CORES, PositiveFloat, PositiveInt, Seed, Workers
from roboarm_nmp.utils.random_streams import Stream
from roboarm_nmp.utils.signals import end_with_one_line, error_line

# L2, normalised, between checked states of a motion before a path wants to take it.
COARSE = 8 * RESOLUTION
# Near a configuration that is closer to an obstacle than the margin, the margin is its distance. It
# grows by this much (m) per unit of normalised distance from it.
MARGIN_GROWTH = 0.05
# Least margin (m) of nodes, that of plans (`planning.planner.MARGIN`).
NODE_MARGIN = 0.003
# A motion costs up to 1 + NARROW times its length, where one of its ends has no room at all.
NARROW = 2.0
# A configuration in deeper (m) contact is first moved out of it, in steps of OUT_STEP (normalised),
# until its distance is NODE_MARGIN.
INSIDE, OUT_STEP, MAX_OUT_STEPS = 0.001, 0.01, 100
# A path begins and ends at one of so many nearest nodes.
JOINED = 30
# Where there is no path: the number of nodes that are added near the ends, and the largest standard
# deviation of each joint (normalised) around them.
GROWN, GROWN_SCALE = 400, 0.6
# Nodes around each configuration on the way out of a place.
AROUND = 5
# Standard deviation (normalised, each joint) of starts around the arm's observed pose.
POSE_NOISE = 0.15
# Spacing (normalised) of the points at which paths through narrow places measure their room.
DENSE = 0.15
# `random_paths`: goals per path (each costs a search of the whole roadmap), queries per path, and
# how often it samples more queries before it gives up.
GOALS_PER_PATH, SPARE, MAX_ROUNDS = 0.13, 1.1, 10
# Random chords tried on each path, and the share of its length that each has to save.
CHORDS, LEAST_GAIN = 40, 0.005
_ROUNDING = 1e-5  # m: largest rounding error of a distance
_DIFFERENCE = 1e-4  # normalised


class Roadmap:
    """The roadmap of a scene. Configurations are normalised.

    The same scene, arguments and generators give the same results.

    Args:
        scene: a `Scene`.
        rng: a NumPy Generator.
        num_nodes: random free configurations.
        num_neighbours: nearest nodes to which each node is joined.
        margin: m, at least `NODE_MARGIN`: distance of paths from obstacles and from the arm itself.
        more_nodes: (n, j), or None: more nodes at those of these configurations that are free.

    Raises:
        ValueError: the margin is smaller.
        RuntimeError: the scene leaves no room for the arm.
    """

    def __init__(
        self,
        scene: Scene,
        rng: np.random.Generator,
        num_nodes: int = 1000,
        num_neighbours: int = 14,
        margin: float = 0.015,
        more_nodes: np.ndarray | None = None,
    ):
        if not margin >= NODE_MARGIN:
            raise ValueError(f"margin must be at least {NODE_MARGIN} m, got {margin!r}")
        self.scene = scene
        self.num_neighbours = num_neighbours
        self.margin = margin
        self._checker = CollisionChecker(scene)
        self._joints = scene.robot.num_joints
        self.nodes = np.empty((0, self._joints))
        self._room = np.empty(0)  # of each node, m: its distance, at most the margin
        # Motions between neighbours: their two nodes, and their costs with the margin and without.
        self._edges = np.empty((2, 0), np.int64)
        self._edge_costs = np.empty((2, 0))
        # The index of the margin that each keeps, 2 for none; and whether it was checked finely, or
        # only coarsely.
        self._margins = (margin, NODE_MARGIN)
        self._kept = np.empty(0, np.int64)
        self._is_checked = np.empty(0, bool)
        self._add_nodes(self.sample(num_nodes, rng, NODE_MARGIN))
        if more_nodes is not None and len(more_nodes):
            self._add_nodes(more_nodes[self._checker.is_free(more_nodes, NODE_MARGIN)])

    def _add_nodes(self, nodes: np.ndarray):
        """Add free configurations (n, j) as nodes, with edges to their nearest nodes."""
        first = len(self.nodes)
        self.nodes = np.concatenate([self.nodes, nodes])
        self._room = np.concatenate([self._room, self._rooms(nodes)])
        near = self._nearest_nodes(nodes, self.num_neighbours + 1)  # one is the node itself
        new = np.repeat(np.arange(first, len(self.nodes)), near.shape[1])
        edges = np.stack([new, near.ravel()])
        edges = np.unique(np.sort(edges[:, edges[0] != edges[1]], axis=0), axis=1)
        self._edges = np.concatenate([self._edges, edges], axis=1)
        tails, heads = self.nodes[edges]
        tail_room, head_room = self._room[edges]
        with_margin = self._costs(tails, heads, tail_room, head_room)
        costs = np.stack([with_margin, self._costs(tails, heads, 0.0, 0.0)])
        self._edge_costs = np.concatenate([self._edge_costs, costs], axis=1)
        kept = np.zeros(edges.shape[1], np.int64)
        for i, margin in enumerate(self._margins):
            checked = np.flatnonzero(kept == i)
            is_free = self._are_edges_free(edges[:, checked], margin, COARSE)
            kept[checked[~is_free]] += 1
        self._kept = np.concatenate([self._kept, kept])
        self._is_checked = np.concatenate([self._is_checked, np.zeros(len(kept), bool)])

    def _grown(self, around: np.ndarray, rng: np.random.Generator) -> "Roadmap":
        """This roadmap with more nodes near configurations (n, j) that have no path in it."""
        centres = around[np.arange(GROWN) % len(around)]
        scale = rng.uniform(0.0, GROWN_SCALE, (GROWN, 1))
        new = np.clip(centres + scale * rng.standard_normal((GROWN, self._joints)), -1.0, 1.0)
        roadmap = copy.copy(self)
        roadmap._add_nodes(new[self._checker.is_free(new, NODE_MARGIN)])
        return roadmap

    def sample(self, number: int, rng: np.random.Generator, margin: float = 0.0) -> np.ndarray:
        """Random free configurations, float64 (number, j). Raises RuntimeError: none is found."""
        free, missing = [np.empty((0, self._joints))], number
        for _ in range(1000):
            if missing == 0:
                break
            states = rng.uniform(-1.0, 1.0, (4 * missing, self._joints))
            free.append(states[self._checker.is_free(states, margin)][:missing])
            missing -= len(free[-1])
        else:
            raise RuntimeError("the scene leaves no room for the arm")
        return np.concatenate(free)

    def random_paths(
        self, number: int, rng: np.random.Generator, ends: np.ndarray | None = None
    ) -> list[np.ndarray]:
        """`number` smoothed paths between random free configurations: a list of float32 (k, j).

        Fewer, where hardly any two configurations have a path between them. With `ends` (n, j),
        the goals are those, but for one in five, and so are a third of the starts; a quarter of the
        starts is near the pose in which the arm is observed, where that is free.
        """
        goals = self.sample(_goal_count(number), rng)
        if ends is None:
            ends = np.empty((0, self._joints))
        if len(ends):
            goals = np.concatenate([goals[: -(-len(goals) // 5)], ends])
        paths = []
        for _ in range(MAX_ROUNDS):
            tried = int(np.ceil(SPARE * (number - len(paths))))
            which = rng.integers(len(goals), size=tried)
            starts = self.sample(tried, rng)
            if len(ends):
                drawn = rng.random(tried)
                at_end = drawn < 1 / 3
                starts[at_end] = ends[rng.integers(len(ends), size=at_end.sum())]
                pose = self.scene.robot.normalise(np.array(self.scene.robot.observed_pose))
                poses = pose + POSE_NOISE * rng.standard_normal(starts.shape)
                poses = poses.clip(-1.0, 1.0)
                at_pose = (drawn > 3 / 4) & self._checker.is_free(poses, NODE_MARGIN)
                starts[at_pose] = poses[at_pose]
            for path in self.paths(starts, goals[which], rng):
                if path is not None and (path[0] != path[-1]).any():
                    paths.append(path)
            if len(paths) >= number:
                break
        return paths[:number]

    def paths(self, starts, goals, rng: np.random.Generator) -> list[np.ndarray | None]:
        """Smoothed paths from starts (n, j) to goals (n, j): a list of float32 (k, j), k > 1.

        None where there is no path. Starts may be in contact: a path from a contact deeper than
        `INSIDE` first leaves the obstacle. Many queries with few different goals are fast.
        """
        # The simulated arm may be a little beyond its limits.
        starts = np.clip(np.asarray(starts, np.float64), -1.0, 1.0).reshape(-1, self._joints)
        goals = np.clip(np.asarray(goals, np.float64), -1.0, 1.0).reshape(-1, self._joints)
        begins = self._moved_out(starts, -INSIDE)
        points, room, is_found = self._search(begins, goals)
        paths: list[np.ndarray | None] = [None] * len(starts)
        points = points[is_found]
        smooth = self._smooth(points, points, room[is_found], rng)
        for i, path in zip(np.flatnonzero(is_found), smooth, strict=True):
            paths[i] = path
        lost = np.flatnonzero(~is_found)
        if len(lost):
            # Through narrow places, where less than the margin is kept.
            begins[lost] = self._moved_out(begins[lost], NODE_MARGIN)
            ends = np.unique(np.concatenate([begins[lost], goals[lost]]), axis=0)
            grown = self._grown(ends, rng)
            points, _, is_found = grown._search(begins[lost], goals[lost], narrow=True)
            states = _dense(points[is_found])
            room = self._rooms(states.reshape(-1, self._joints)).reshape(states.shape[:2])
            smooth = self._smooth(points[is_found], states, room, rng)
            for i, path in zip(lost[is_found], smooth, strict=True):
                paths[i] = path
        for i, path in enumerate(paths):
            if path is not None:
                path = np.concatenate([starts[i : i + 1], path]).astype(np.float32)
                moves = (path[1:] != path[:-1]).any(1)
                # A path whose start is its goal has two points all the same.
                paths[i] = path[np.r_[True, moves]] if moves.any() else path[:2]
        return paths

    def _distances(self, states: np.ndarray) -> np.ndarray:
        """Distances (m) of the arm from obstacles and from itself; negative in contact."""
        return self._checker.signed_distances(states).distance.min(-1)

    def _rooms(self, states: np.ndarray) -> np.ndarray:
        """The same, at most the margin."""
        room = np.full(len(states), self.margin)
        near = ~self._checker.is_free(states, self.margin)
        room[near] = np.minimum(self._distances(states[near]), self.margin)
        return room

    def _are_free(
        self, starts, ends, states, room, margin, resolution=RESOLUTION, ends_known=True
    ) -> np.ndarray:
        """Whether motions (n, j) are free, with the room at each one's states (n, k, j)."""
        endpoint_margins = (states, room - _ROUNDING, MARGIN_GROWTH)
        return self._checker.is_motion_free(
            starts,
            ends,
            margin,
            resolution=resolution,
            ends_known=ends_known,
            endpoint_margins=endpoint_margins,
        )

    def _costs(self, starts, ends, start_room, end_room) -> np.ndarray:
        """Costs of straight motions (..., j)."""
        tightness = 1.0 - np.clip(np.minimum(start_room, end_room) / self.margin, 0.0, 1.0)
        return np.linalg.norm(ends - starts, axis=-1) * (1.0 + NARROW * tightness)

    def _are_straight_free(
        self, starts, ends, start_room, end_room, margin, resolution=RESOLUTION
    ) -> np.ndarray:
        """Whether straight motions (n, j) are free, with the room at both of their ends."""
        states = np.stack([starts, ends], axis=1)
        room = np.stack([start_room, end_room], axis=1)
        return self._are_free(starts, ends, states, room, margin, resolution)

    def _are_edges_free(self, edges, margin, resolution=RESOLUTION) -> np.ndarray:
        """Whether the motions between pairs of nodes (2, n) are free."""
        starts, ends = self.nodes[edges]
        start_room, end_room = self._room[edges]
        return self._are_straight_free(starts, ends, start_room, end_room, margin, resolution)

    def _nearest_nodes(self, states, number) -> np.ndarray:
        """Indices of the nearest nodes, (n, number), in any order."""
        squared = (self.nodes**2).sum(1) - 2.0 * states @ self.nodes.T
        return np.argpartition(squared, number, axis=1)[:, :number]

    def _smooth(self, points, states, room, rng):
        """Shortened paths (n, k, j), padded, with the room at their states (n, m, j)."""
        return self._cut_short(self._prune(points, states, room), states, room, rng)

    def _search(self, starts, goals, narrow=False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shortest paths: points (n, k, j), padded with the goal, their room (n, k), found (n,).

        `narrow` paths keep `NODE_MARGIN` only.
        """
        margin = NODE_MARGIN if narrow else self.margin
        count = len(self.nodes)
        goals, which = np.unique(goals, axis=0, return_inverse=True)
        start_room, goal_room = self._rooms(starts), self._rooms(goals)
        states = np.concatenate([self.nodes, goals])
        room = np.concatenate([self._room, goal_room])
        # Edges lead from goals to nodes and not back: no path leads through another query's goal.
        goal = np.repeat(np.arange(len(goals)), JOINED)
        node = self._nearest_nodes(goals, JOINED).ravel()
        motions = (goals[goal], self.nodes[node], goal_room[goal], self._room[node])
        goal_costs = self._costs(*motions)
        goal_costs[~self._are_straight_free(*motions, margin)] = np.inf
        # The first step is to the goal itself or to a node.
        first = np.c_[count + which, self._nearest_nodes(starts, JOINED)]
        first_costs = self._costs(starts[:, None], states[first], start_room[:, None], room[first])
        first_costs[start_room < -INSIDE] = np.inf
        is_checked = np.zeros(first.shape, bool)
        is_found = np.zeros(len(starts), bool)
        routes = {}
        waiting = np.arange(len(starts))
        while len(waiting):
            asked, row = np.unique(which[waiting], return_inverse=True)
            rest, before = self._shortest(asked, goal, node, goal_costs, narrow)
            # There is no path from or to a configuration in contact.
            rest[goal_room[asked] < -INSIDE] = np.inf
            while True:  # the best first step of those that are free
                costs = first_costs[waiting] + rest[row[:, None], first[waiting]]
                best = costs.argmin(1)
                possible = np.isfinite(costs.min(1))
                unchecked = possible & ~is_checked[waiting, best]
                if not unchecked.any():
                    break
                query, step = waiting[unchecked], best[unchecked]
                tried = first[query, step]
                free = self._are_straight_free(
                    starts[query], states[tried], start_room[query], room[tried], margin
                )
                is_checked[query, step] = True
                first_costs[query[~free], step[~free]] = np.inf
            waiting, best, row = waiting[possible], best[possible], row[possible]
            at = first[waiting, best]
            route = [at]
            while (at < count).any():
                at = np.where(at < count, before[row, at], at)
                route.append(at)
            route = np.stack(route, axis=1)
            free = self._check(route, narrow)
            is_found[waiting[free]] = True
            routes.update(zip(waiting[free], route[free], strict=True))
            waiting = waiting[~free]
        size = max(map(len, routes.values()), default=1)
        route = np.repeat(count + which[:, None], size, axis=1)
        for i, nodes in routes.items():
            route[i, : len(nodes)] = nodes
        points = np.concatenate([starts[:, None], states[route]], axis=1)
        return points, np.concatenate([start_room[:, None], room[route]], axis=1), is_found

    def _shortest(self, asked, goal, node, goal_costs, narrow):
        """Dijkstra's algorithm from the goals `asked`, by motions that are not known to collide.

        `goal[i]` is joined to `node[i]`, where that costs less than infinity.

        Returns lengths and predecessors, (asked, nodes + goals).
        """
        count = len(self.nodes)
        usable = np.flatnonzero(self._kept <= int(narrow))
        first, second = self._edges[:, usable]
        costs = self._edge_costs[self._kept[usable], usable]
        is_joined = np.isfinite(goal_costs)
        tails = np.concatenate([first, second, count + goal[is_joined]])
        heads = np.concatenate([second, first, node[is_joined]])
        costs = np.concatenate([costs, costs, goal_costs[is_joined]])
        size = count + goal[-1] + 1
        graph = csr_array((costs, (tails, heads)), shape=(size, size))
        return dijkstra(graph, indices=count + asked, return_predecessors=True)

    def _check(self, route, narrow):
        """Whether fine checks confirm all motions between nodes of each route (n, k): bool (n,).

        Motions without one get theirs here.
        """
        count = len(self.nodes)
        path, step = np.nonzero((route[:, 1:] < count) & (route[:, :-1] != route[:, 1:]))
        ends = np.sort([route[path, step], route[path, step + 1]], axis=0)
        names = self._edges[0] * count + self._edges[1]  # one number for each edge
        wanted = ends[0] * count + ends[1]
        order = np.argsort(names)
        used = order[np.searchsorted(names, wanted, sorter=order)]
        unchecked = np.unique(used[~self._is_checked[used]])
        for kept in (1, 0):
            edges = unchecked[self._kept[unchecked] == kept]
            free = self._are_edges_free(self._edges[:, edges], self._margins[kept])
            self._is_checked[edges[free]] = True
            self._kept[edges[~free]] += 1
        free = np.ones(len(route), bool)
        free[path[~self._is_checked[used] | (self._kept[used] > int(narrow))]] = False
        return free

    def _prune(self, points, states, room):
        """Paths (n, k, j), padded, without the vertices that free straight motions bypass."""
        n, size = points.shape[:2]
        lengths = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
        moves = np.full((n, size, size), np.inf)
        steps = np.arange(size - 1)
        moves[:, steps, steps + 1] = lengths[:, steps, steps + 1]
        first, last = np.triu_indices(size, 2)
        path, pair = np.nonzero(moves[:, last - 1, last] > 0.0)  # not to the padding
        first, last = first[pair], last[pair]
        free = self._are_free(
            points[path, first], points[path, last], states[path], room[path], self.margin
        )
        path, first, last = path[free], first[free], last[free]
        moves[path, first, last] = lengths[path, first, last]
        # The shortest path through these motions, by dynamic programming.
        costs = np.zeros((n, size))
        before = np.zeros((n, size), np.int64)
        for i in range(1, size):
            through = costs[:, :i] + moves[:, :i, i]
            before[:, i], costs[:, i] = through.argmin(1), through.min(1)
        kept = np.zeros((n, size), bool)
        at = np.full(n, size - 1)
        for _ in range(size):
            kept[np.arange(n), at] = True
            at = before[np.arange(n), at]
        order = np.argsort(~kept, axis=1, kind="stable")
        order[np.arange(size) >= kept.sum(1)[:, None]] = size - 1
        pruned = np.take_along_axis(points, order[:, :, None], axis=1)
        return pruned[:, : max(kept.sum(1).max(initial=0), 2)]

    def _cut_short(self, points, states, room, rng):
        """Paths (n, k, j), padded, shortened by random chords, with the room at their states."""
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
            begin, end = np.moveaxis(chord[tried], 1, 0)
            free = self._are_free(
                begin, end, states[tried], room[tried], self.margin, ends_known=False
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
        """The states; those with less room (m) are moved along the gradient to `NODE_MARGIN`."""
        states = states.copy()
        differences = _DIFFERENCE * np.stack([-np.eye(self._joints), np.eye(self._joints)])
        inside = np.flatnonzero(self._rooms(states) < room)
        for _ in range(MAX_OUT_STEPS):
            if not len(inside):
                break
            # Uphill in distance, by central differences.
            around = np.clip(states[inside, None, None] + differences, -1.0, 1.0)
            distances = self._distances(around.reshape(-1, self._joints))
            low, high = np.moveaxis(distances.reshape(-1, 2, self._joints), 1, 0)
            uphill = high - low
            uphill /= np.maximum(np.linalg.norm(uphill, axis=1, keepdims=True), 1e-12)
            states[inside] = np.clip(states[inside] + OUT_STEP * uphill, -1.0, 1.0)
            inside = inside[self._distances(states[inside]) < NODE_MARGIN]
        return states


def _dense(points: np.ndarray) -> np.ndarray:
    """Points along paths (n, k, j), at most DENSE apart: (n, m, j)."""
    moves = np.diff(points, axis=1)[:, :, None]
    pieces = max(int(np.ceil(np.linalg.norm(moves, axis=-1).max(initial=0.0) / DENSE)), 1)
    dense = points[:, :-1, None] + np.arange(pieces)[:, None] / pieces * moves
    dense = dense.reshape(len(points), moves.shape[1] * pieces, points.shape[-1])
    return np.concatenate([dense, points[:, -1:]], axis=1)


@dataclass
class Args:
    output: Path
    """Folder to write to."""
    task: str = "random_boxes_hard"
    """Name of a task, `mixed_scenes`, `containers`, or path of a scene file; with another arm,
    TASK@FILE. Each scene has a roadmap of its own, also where scenes do not vary."""
    scenes: PositiveInt = 6000
    """Number of scenes."""
    paths_per_scene: PositiveInt = 300
    """Paths in each of them."""
    num_nodes: PositiveInt = 1000
    """Nodes of a roadmap."""
    num_neighbours: PositiveInt = 14
    """Nearest nodes to which each node is joined."""
    margin: PositiveFloat = 0.015
    """Distance (m) of paths from obstacles and from the arm itself, where there is room."""
    shard_size: PositiveInt = 50
    """Scenes in each file."""
    seed: Seed = 0
    """Seed of scenes and roadmaps."""
    workers: Workers = CORES
    """Number of processes, by default that of the cores. The files do not depend on it."""
    ray_address: str | None = None
    """Address of a Ray cluster (`auto`, `HOST:PORT`) to use instead of local processes."""


# What paths depend on, besides the number of their scene.
OPTIONS = ("task", "paths_per_scene", "num_nodes", "num_neighbours", "margin", "seed")


def random_paths_of_scene(
    index: int, task: str, seed: int, paths_per_scene: int = 300, **options
) -> tuple[Scene, list[np.ndarray]]:
    """Scene `index` of a collection, and its paths: float32 (k, j), normalised.

    `options`: `num_nodes`, `num_neighbours` and `margin` of `Roadmap`.

    Raises RuntimeError: the scene leaves no room for the arm.
    """
    rng = np.random.default_rng([seed, Stream.ROADMAPS, index])
    scene = envs.get_task(task).scene
    ends = more_nodes = None
    if isinstance(scene, (Containers, WideScenes)):
        scene, places = scene.sample_with_places(rng)
        ends, on_ways = place_configurations(scene, places, rng, _goal_count(paths_per_scene))
        more_nodes = _around(on_ways, rng)
    elif not isinstance(scene, Scene):
        scene = scene.sample(rng)
    roadmap = Roadmap(scene, rng, more_nodes=more_nodes, **options)
    return scene, roadmap.random_paths(paths_per_scene, rng, ends)


def _around(states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The configurations (n, j), and more around them."""
    centres = np.repeat(states, AROUND, axis=0)
    scale = rng.uniform(0.0, GROWN_SCALE / 2, (len(centres), 1))
    around = centres + scale * rng.standard_normal(centres.shape)
    return np.concatenate([states, around]).clip(-1, 1)


def _goal_count(number: int) -> int:
    """Goals of so many paths."""
    return int(np.ceil(GOALS_PER_PATH * number))


class Collector:
    """Makes shards; a job is (number of the shard, first scene, scene after the last)."""

    def __init__(self, options: dict, made_by: str):
        self.options = options
        self.made_by = made_by

    def __call__(self, job: tuple[int, int, int]) -> tuple[int, bytes]:
        """`(number, contents of the file)`."""
        number, first, end = job
        scenes, paths = [], []
        for index in range(first, end):
            scene, paths_of_scene = random_paths_of_scene(index, **self.options)
            scenes.append(scene)
            paths.append(paths_of_scene)
        task, seed = self.options["task"], self.options["seed"]
        return number, shard_bytes(task, seed, first, scenes, paths, self.made_by)


def collect(args: Args, progress: bool = True) -> RoadmapPaths:
    """Make the missing shards. Returns all `RoadmapPaths`.

    Raises:
        ValueError: the flags cannot work, or the folder holds other paths, or damaged ones.
        RuntimeError: a scene leaves no room for the arm, or workers keep dying.
        ConnectionError: there is no Ray cluster.
        OSError: the folder cannot be written. Finished shards are kept.
    """
    flags.check(args)
    if args.num_nodes <= max(args.num_neighbours, JOINED):
        raise ValueError(f"--num-nodes must be above {max(args.num_neighbours, JOINED)}")
    if not args.margin >= NODE_MARGIN:
        raise ValueError(f"--margin must be at least {NODE_MARGIN} m")
    package = Path(envs.__file__).parents[1].resolve()
    if package in (args.output.resolve(), *args.output.resolve().parents):
        raise ValueError(
            f"{args.output} is in {package}, which has the repository's own files only"
        )
    shards.check_collection(args)
    options = {name: getattr(args, name) for name in OPTIONS}
    words = [
        f"--{name.replace('_', '-')} {getattr(args, name)}"
        for name in (*OPTIONS[:-1], "shard_size", "seed")
    ]
    made_by = " ".join(["roboarm roadmaps", *words])
    shards.collect(
        args,
        args.scenes,
        Collector,
        (options, made_by),
        made_by,
        open_shard,
        counted="path_count",
        unit="path",
        per_scene=args.paths_per_scene,
        progress=progress,
    )
    return load_roadmap_paths(args.output, envs.get_task(args.task).base_scene.robot)


def main(args: Args):
    """The command."""
    try:
        paths = collect(args)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(error_line(error))
    size = sum(path.stat().st_size for path in args.output.glob("shard_*.h5"))
    count = len(paths.offsets) - 1
    print(f"{args.output}: {len(paths)} scenes, {count} paths, {size / 1e6:.1f} MB")


if __name__ == "__main__":
    end_with_one_line("the same command continues from here")
    main(flags.parse(Args, others="roadmap"))
