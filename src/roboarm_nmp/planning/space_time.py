"""Planning in space and time: a reference that receives all future motions.

    from roboarm_nmp.planning.space_time import SpaceTimePlanner

    path = SpaceTimePlanner(env).plan(*query, seed=1)   # float32 (k, n), rad: where to be each step
    follow(env, path, query.scene)                      # envs.following

The planner makes a probabilistic roadmap of random configurations, and searches it by safe-interval
path planning (Phillips and Likhachev, 2011): of each node, the intervals of time in which the arm
may stand there are known, and of each node and interval the earliest arrival. An edge is a straight
motion at nearly the longest step per environment step, which may begin as soon as all of its
configurations are free when the arm is there. So the first path found arrives as early as any in
the roadmap. Each plan is followed in the simulator, and only a plan without contact is returned.
"""

import heapq
import math
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.following import follow
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.subgoals import SUBGOAL_SPACING
from roboarm_nmp.planning.planner import MARGIN_GROWTH, PlanningError
from roboarm_nmp.planning.timed_checker import TimedChecker

# m: what attempts keep clear, between links and from obstacles, from obstacles in addition. Each
# attempt has a roadmap of its own, of so many nodes.
ATTEMPTS = ((0.005, 0.015, 1_000), (0.005, 0.005, 2_000), (0.003, 0.0, 4_000), (0.003, 0.0, 8_000))
NUM_NEIGHBOURS = 15
SETTLING = 8  # steps that the arm may stand at the goal, until it is reached
LATEST = 20  # steps before the end of an episode at which a plan has to arrive


class SpaceTimePlanner:
    """Plans in the world of an environment with moving obstacles, whose motions are known.

    Args:
        env: a `RoboArmEnv` with relative actions; its scene may change between plans. A plan
            resets it, so reset before the next step.
    """

    def __init__(self, env: RoboArmEnv):
        self.env = env

    def plan(
        self,
        start: ArrayLike,
        goal: ArrayLike,
        scene: Scene | None = None,
        *,
        seed: int | Sequence[int],
        time_limit: float = 60.0,
    ) -> np.ndarray:
        """Where to be after each step, float32 (k, n), rad; its ends are start and goal.

        The same seed gives the same path, as long as the time suffices.

        Args:
            start, goal: joint angles (n, rad), inside the limits; the start is free at time 0.
            scene: a `Scene` to change the environment to first.
            seed: int >= 0 or a sequence of such ints.
            time_limit: seconds for all attempts, checked between them.

        Raises:
            ValueError: start or goal is not n numbers inside the limits, or in collision.
            PlanningError: no path was found that can be followed without contact.
        """
        rng = np.random.default_rng(seed)
        deadline = time.monotonic() + time_limit
        self.env.reset_specific(start, goal, scene)
        robot = self.env.unwrapped.robot
        scene = self.env.unwrapped.scene
        start = np.asarray(start, dtype=np.float32)
        goal = np.asarray(goal, dtype=np.float32)
        ends = np.clip(robot.normalise(np.stack([start, goal]).astype(np.float64)), -1.0, 1.0)
        for margin, clearance, num_nodes in ATTEMPTS:
            if time.monotonic() > deadline:
                break
            checker = self._checker(scene, ends, margin, clearance)
            nodes = np.concatenate([ends, rng.uniform(-1.0, 1.0, (num_nodes, len(start)))])
            states = search(nodes, checker, self.env.unwrapped.horizon - LATEST)
            if states is None:
                continue
            path = robot.denormalise(states).astype(np.float32)
            path[0] = start
            path[-1] = goal
            execution = follow(self.env, path, scene)
            if execution.reached and not execution.collided:
                return path
        raise PlanningError("no path was found that can be followed without contact")

    def _checker(self, scene, ends, margin, clearance):
        """The `TimedChecker` with smaller margins around start and goal, as `Planner` has them."""
        horizon = self.env.unwrapped.horizon
        # Obstacles may be far from the goal at one time only: then its distance is that from
        # whatever does not move.
        times = STEP_SECONDS * np.arange(0, horizon, 5)
        scenes = [scene] if scene.is_static else [scene.at(t) for t in times.tolist()]
        checkers = [CollisionChecker(scene) for scene in scenes]
        at_start = checkers[0].signed_distances(ends[0]).distance.min()
        at_goal = max(checker.signed_distances(ends[1]).distance.min() for checker in checkers)
        distances = np.array([at_start, at_goal]) - 1e-5
        endpoint_margins = ends, distances - clearance, MARGIN_GROWTH
        return TimedChecker(scene, horizon, STEP_SECONDS, margin, clearance, endpoint_margins)


def search(nodes: np.ndarray, checker: TimedChecker, last_step: int) -> np.ndarray | None:
    """The path of earliest arrival from nodes[0] to nodes[1], a state per step; None without one.

    Args:
        nodes: (m, n), normalised.
        checker: a `TimedChecker`.
        last_step: the latest arrival.

    Returns:
        float64 (k, n), normalised: the states at steps 0 to k - 1.
    """
    intervals = _Intervals(nodes, checker, last_step + SETTLING)
    lengths = np.linalg.norm(nodes - nodes[1], axis=1)
    to_goal = np.ceil(lengths / SUBGOAL_SPACING - 1e-9).astype(int)  # steps, at least
    first = intervals.of(0)
    if not first or first[0][0] > 0 or not intervals.of(1):
        return None
    neighbours = _neighbours(nodes)
    # Entries: least arrival at the goal, arrival, node, number of its interval; from where.
    queue = [(to_goal[0], 0, 0, 0)]
    came_from = {}
    arrivals = {(0, 0): 0}
    closed = set()
    while queue:
        _, arrival, node, number = heapq.heappop(queue)
        if (node, number) in closed:
            continue
        closed.add((node, number))
        if node == 1:
            return _states(nodes, came_from, arrivals, (node, number))
        until = intervals.of(node)[number][1]
        for other in neighbours[node]:
            length = np.linalg.norm(nodes[other] - nodes[node])
            steps = max(1, math.ceil(length / SUBGOAL_SPACING - 1e-9))
            for there, (begin, end) in enumerate(intervals.of(other)):
                if (other, there) in closed:
                    continue
                last = min(until, end - steps, last_step - steps)
                last -= SETTLING if other == 1 else 0
                # Nothing later than what is known is of use.
                last = min(last, arrivals.get((other, there), last_step + 1) - steps - 1)
                earliest = max(arrival, begin - steps)
                if earliest > last:
                    continue
                departure = checker.first_departure(
                    nodes[node], nodes[other], steps, earliest, last
                )
                if departure is not None:
                    there_at = departure + steps
                    arrivals[other, there] = there_at
                    came_from[other, there] = node, number, departure
                    heapq.heappush(queue, (there_at + to_goal[other], there_at, other, there))
    return None


def _neighbours(nodes):
    """The nearest nodes of each node, both ways, and of the start also the goal: lists."""
    _, near = KDTree(nodes).query(nodes, NUM_NEIGHBOURS + 1)  # one is the node itself
    neighbours = [set() for _ in nodes]
    for i, others in enumerate(np.asarray(near).tolist()):
        for j in others:
            if i != j:
                neighbours[i].add(j)
                neighbours[j].add(i)
    neighbours[0].add(1)
    return [sorted(others) for others in neighbours]


class _Intervals:
    """Of each node, the intervals of steps (first, last) in which the arm may stand there."""

    def __init__(self, nodes, checker, last_step):
        self._nodes = nodes
        self._checker = checker
        self._steps = np.arange(last_step + 1)
        self._known = {}

    def of(self, node):
        if node not in self._known:
            states = np.broadcast_to(self._nodes[node], (len(self._steps), self._nodes.shape[1]))
            free = self._checker.is_free(states, self._steps)
            changes = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]])))
            self._known[node] = [(int(a), int(b) - 1) for a, b in changes.reshape(-1, 2)]
        return self._known[node]


def _states(nodes, came_from, arrivals, last):
    """The states of all steps until the arrival at the last node."""
    pieces = []
    here = last
    while here in came_from:
        node, number, departure = came_from[here]
        steps = arrivals[here] - departure
        share = np.arange(1, steps + 1)[:, None] / steps
        start = nodes[node]
        end = nodes[here[0]]
        waits = np.repeat(start[None], departure - arrivals[node, number], axis=0)
        pieces.append(np.concatenate([waits, start + (end - start) * share]))
        here = node, number
    return np.concatenate([nodes[:1], *pieces[::-1]])
