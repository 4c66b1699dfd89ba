"""Roadmaps: many short paths in one scene, and how to go on from any configuration in it.

    from demo_generation.roadmaps import Roadmap

    roadmap = Roadmap(scene, rng)
    roadmap.random_paths(300, rng)           # so many paths, each (k, 7), normalised
    roadmap.paths(starts, goals, rng)        # the same for given queries; None where there is none
    roadmap.labels(states, goals, rng)       # the direction to go on in, and how long the rest is

A probabilistic roadmap (Kavraki et al., 1996): random free configurations, each joined to its
nearest neighbours where the straight motion is free, and shortest paths in that graph, which are
then pruned and cut short.

Paths keep `margin` from everything where there is room. A node, a start or a goal that is nearer
to something than that is not lost: around it, a path may come as near as it is itself, and has to
get away by `MARGIN_GROWTH`.
"""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from envs.collision import CollisionChecker

# Around a configuration that is nearer to something than the margin, the margin grows by this much
# (m) per unit of normalised distance from it.
MARGIN_GROWTH = 0.05
# Nodes keep at least this (m), as plans do (`demo_generation.planning.MARGIN`).
NODE_MARGIN = 0.003
# A motion costs up to 1 + NARROW times its length, where one of its ends has no room at all.
NARROW = 2.0
# A configuration that is deeper (m) in something is moved out of it before anything else, until it
# is NODE_MARGIN away, in steps of OUT_STEP (normalised).
INSIDE, OUT_STEP, MAX_OUT_STEPS = 0.001, 0.01, 100
# Random goals of `random_paths` for each path: each costs a search of the whole roadmap.
GOALS_PER_PATH = 0.13
# Random chords tried on each path, and the share of its length that each has to save.
CHORDS, LEAST_GAIN = 40, 0.005
# `random_paths` gives up after so many rounds of queries.
MAX_ROUNDS = 10
_HAIR = 1e-5  # m: what rounding may take from a distance
_STEP = 1e-4  # normalised: of finite differences


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
        self.nodes = self.sample(num_nodes, rng, NODE_MARGIN)
        self._room = self._rooms(self.nodes)
        near = self._nearest_nodes(self.nodes, num_neighbours + 1)  # the first is the node itself
        edges = np.stack([np.repeat(np.arange(num_nodes), num_neighbours), near[:, 1:].ravel()])
        one, other = np.unique(np.sort(edges, axis=0), axis=1)
        nodes, room = self.nodes, self._room
        cost = self._costs(nodes[one], nodes[other], room[one], room[other])
        free = np.isfinite(cost)
        self._edges = one[free], other[free], cost[free]

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
            missing = number - len(paths)
            if missing == 0:
                break
            which = rng.integers(len(goals), size=missing)
            found = self.paths(self.sample(missing, rng), goals[which], rng)
            paths += [path for path in found if path is not None]
        return paths

    def paths(self, starts, goals, rng):
        """Smoothed paths from starts (n, 7) to goals (n, 7): a list of float32 (k, 7), k > 1, or
        None where there is no way.

        Starts may be in contact, as for `labels`. Fast for many queries with few different goals.
        """
        starts, goals = (np.array(x, dtype=np.float64).reshape(-1, 7) for x in (starts, goals))
        begins = self._moved_out(starts)
        points, room, found = self._search(begins, goals)
        points, room = points[found], room[found]
        points = self._cut_short(self._prune(points, room), points, room, rng)
        paths = [None] * len(starts)
        for i, path in zip(np.flatnonzero(found), points, strict=True):
            path = np.concatenate([starts[i : i + 1], path])
            moves = (path[1:] != path[:-1]).any(1)
            # A path whose start is its goal has two points, too.
            paths[i] = path[np.r_[True, moves] if moves.any() else [0, -1]].astype(np.float32)
        return paths

    def labels(self, states, goals, rng):
        """How to go on from each of the states (n, 7) to its goal (n, 7).

        States may be in contact. Where one is nearer to something than the margin, the way begins
        as near as it is. From really inside something, it first goes the shortest way out.

        Returns:
            directions: float32 (n, 7), unit vectors: the first move of the way. Zeros where the
                state is its goal, NaN where there is no way.
            lengths: float32 (n,), of the way, L2, normalised. NaN where there is none.
        """
        directions = np.full((len(states), 7), np.nan, np.float32)
        lengths = np.full(len(states), np.nan, np.float32)
        for i, path in enumerate(self.paths(states, goals, rng)):
            if path is not None:
                moves = np.diff(path, axis=0)
                steps = np.linalg.norm(moves, axis=1)
                directions[i] = moves[0] / max(steps[0], 1e-12)
                lengths[i] = steps.sum()
        return directions, lengths

    def _distances(self, states):
        """m, of the arm from the nearest thing; negative inside of it."""
        return self._checker.nearest(states).distance.min(-1)

    def _rooms(self, states):
        """The distances, at most the margin."""
        room = np.full(len(states), self.margin)
        near = ~self._checker.is_free(states, self.margin)
        room[near] = np.minimum(self._distances(states[near]), self.margin)
        return room

    def _free(self, starts, ends, states, room):
        """Whether motions (n, 7) are free, each as near as its own states (n, k, 7) allow."""
        relaxed = (states, room - _HAIR, MARGIN_GROWTH)
        return self._checker.is_motion_free(starts, ends, self.margin, relaxed=relaxed)

    def _costs(self, starts, ends, start_room, end_room):
        """Of straight motions (n, 7); infinite where they are not free."""
        room = np.stack([start_room, end_room], axis=1)
        free = self._free(starts, ends, np.stack([starts, ends], axis=1), room)
        tightness = 1.0 - np.clip(room.min(1) / self.margin, 0.0, 1.0)
        costs = np.linalg.norm(ends - starts, axis=1) * (1.0 + NARROW * tightness)
        return np.where(free, costs, np.inf)

    def _nearest_nodes(self, states, number):
        """(n, number), by distance."""
        nodes = self.nodes
        squared = (states**2).sum(1)[:, None] + (nodes**2).sum(1) - 2.0 * states @ nodes.T
        return np.argsort(squared, axis=1, kind="stable")[:, :number]

    def _join(self, states, room):
        """The nodes that states (n, 7) are joined to and what that costs, both (n, k)."""
        near = self._nearest_nodes(states, self.num_neighbours)
        which, nodes = np.repeat(np.arange(len(states)), near.shape[1]), near.ravel()
        costs = self._costs(states[which], self.nodes[nodes], room[which], self._room[nodes])
        return near, costs.reshape(near.shape)

    def _search(self, starts, goals):
        """Shortest paths: points (n, k, 7), padded with the goal, their room (n, k), found (n,)."""
        goals, which = np.unique(goals, axis=0, return_inverse=True)
        start_room, goal_room = self._rooms(starts), self._rooms(goals)
        near, near_costs = self._join(starts, start_room)
        ways, way_costs = self._join(goals, goal_room)
        way_costs[goal_room < -INSIDE] = np.inf
        # Edges lead from goals to nodes and not back: no path goes through another query's goal.
        count, (one, other, costs) = len(self.nodes), self._edges
        goal, way = np.nonzero(np.isfinite(way_costs))
        tails = np.concatenate([one, other, count + goal])
        heads = np.concatenate([other, one, ways[goal, way]])
        costs = np.concatenate([costs, costs, way_costs[goal, way]])
        graph = csr_array((costs, (tails, heads)), shape=(count + len(goals),) * 2)
        indices = count + np.arange(len(goals))
        rest, before = dijkstra(graph, indices=indices, return_predecessors=True)
        costs = near_costs + rest[which[:, None], near]
        best = costs.argmin(1)
        least = costs.min(1)
        node = near[np.arange(len(starts)), best]
        straight = self._costs(starts, goals[which], start_room, goal_room[which])
        straight[goal_room[which] < -INSIDE] = np.inf
        node = np.where(straight <= least, count + which, node)
        found = np.isfinite(np.minimum(straight, least))
        node[~found] = count + which[~found]
        route = [node]
        while (route[-1] < count).any():
            on_way = route[-1] < count
            route.append(np.where(on_way, before[which, route[-1]], route[-1]))
        route = np.stack(route, axis=1)
        points = np.concatenate([self.nodes, goals])[route]
        room = np.concatenate([self._room, goal_room])[route]
        points = np.concatenate([starts[:, None], points], axis=1)
        return points, np.concatenate([start_room[:, None], room], axis=1), found

    def _prune(self, points, room):
        """Paths (n, k, 7), padded, without the vertices that straight motions can leave out."""
        n, size = points.shape[:2]
        lengths = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
        moves = np.full((n, size, size), np.inf)
        steps = np.arange(size - 1)
        moves[:, steps, steps + 1] = lengths[:, steps, steps + 1]
        first, last = np.triu_indices(size, 2)
        path, pair = np.nonzero(moves[:, last - 1, last] > 0.0)  # not to where the goal is repeated
        first, last = first[pair], last[pair]
        free = self._free(points[path, first], points[path, last], points[path], room[path])
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
            free = self._free(chord[tried, 0], chord[tried, 1], states[tried], room[tried])
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

    def _moved_out(self, states):
        """The states, but those that are inside of something moved the shortest way out of it."""
        states = states.copy()
        inside = np.flatnonzero(self._rooms(states) < -INSIDE)
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


_DIFFERENCES = _STEP * np.stack([-np.eye(7), np.eye(7)])
