"""Planning: a query in, a joint path out, in a few milliseconds.

    import roboarm_nmp
    from roboarm_nmp.planning.planner import Planner
    from roboarm_nmp.datasets.queries import load_queries

    env = roboarm_nmp.make("double_walls")
    query = load_queries("double_walls")[0]  # start, goal, scene
    path = Planner(env).plan(*query, seed=1)  # float32 (k, n), rad
    path = Planner(env).plan(query.start, goal_pose=pose, seed=1)  # of the end effector, (7,)

The default planner is RRT-Connect with restarts, compiled as a whole together with its collision
checks (`envs.collision.search_kernels`). OMPL's planners can be used by name, and so can one of
your own. Collisions are checked by `envs.collision.checker`, which agrees with PyBullet within a
fraction of a millimetre. Planning happens in the normalised configuration space [-1, 1]^n.
"""

import contextlib
import copy
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from roboarm_nmp.envs.arm_env import RoboArmEnv, checked_configuration
from roboarm_nmp.envs.collision.checker import (
    ARM,
    FLOOR,
    POINT,
    REACH,
    TABLE,
    CollisionChecker,
    Rules,
)
from roboarm_nmp.envs.robots.inverse_kinematics import NUM_SEEDS, inverse_kinematics
from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.scenes.primitives import Scene, obstacle_at
from roboarm_nmp.envs.subgoals import SUBGOAL_SPACING, subgoals
from roboarm_nmp.planning.ompl_planners import OMPL_LOCK, OMPL_PLANNERS, OmplSearch, Validity
from roboarm_nmp.utils.names import suggest

COMPILED = "compiled"
"""The name of the default planner."""
PLANNERS = (COMPILED, *OMPL_PLANNERS)
"""Names of planners: the default one, and OMPL's that can be used."""

# A configuration this close (m) to a collision counts as one, which absorbs most of the
# controller's lag: without the margin, two of three plans on `double_walls` collide when followed.
# This is the Panda's; for another arm, margin and clearance scale with its reach, as the lag does.
MARGIN = 0.003
# The distance (m) by which the checks and PyBullet may disagree.
EXACTNESS = 0.001
# Where start or goal is nearer than that, the margin is the distance there. It grows by this much
# (m) per unit of normalised distance from them: the full margin holds again about three steps away.
MARGIN_GROWTH = 0.03
# A search that has taken long is likely to take much longer, so margin and clearance shrink: after
# so many collision checks, they are scaled by this factor.
# (Chosen on 1,000 fresh queries of `random_boxes_hard`: docs/benchmark/performance.md.)
MARGIN_SCHEDULE = ((0, 1.0), (16_000, 0.5), (32_000, 0.25), (64_000, 0.0))
_RULES_BEGIN = np.array([checks for checks, _ in MARGIN_SCHEDULE])
# After so many checks without a path, RRT-Connect hands over to another planner for half as many.
# They alternate, each turn twice as long as the last: LBKPIECE1 finds some paths out of shelves
# that RRT-Connect does not find, but takes ten times as long for a check.
# (Chosen on 1,000 queries of the demonstrations of `random_boxes_hard`, and on validation queries
# of `wide_scenes` and the shelves.)
OTHER_PLANNER, FIRST_TURN = "LBKPIECE1", 640_000
# Searches at most, per plan, for a path that can be followed within an episode.
SEARCHES = 3
# Steps by which the arm may arrive later than its last sub-goal.
LAG = 10
# A goal pose is a set of configurations, at most this many. Inverse kinematics begins from
# `NUM_SEEDS` states; if it finds nothing free, again from 4, 16 and 64 times as many.
MAX_GOALS, IK_ROUNDS = 16, 4
# Chords that the compiled planner tries in one round of simplification, and three times as many
# corners.
CHORDS = 40
# L2, normalised: states that the search checks are at most this far apart. The longest edges have
# 16, which are checked at once.
SEARCH_RESOLUTION = 0.0251


class PlanningError(RuntimeError):
    """No path was found within the limits."""


class _Query(NamedTuple):
    """A start and m goals that are possible: the ends of paths.

    checker: the `CollisionChecker`.
    ends: float32 (1 + m, n), rad, the start first.
    states: float64 (1 + m, n), normalised.
    distances: m, (2, 1 + m), of the arm from everything, and from the scene; infinite where it is
        far.
    """

    checker: CollisionChecker
    ends: np.ndarray
    states: np.ndarray
    distances: np.ndarray


class Planner:
    """Plans in the world of an environment.

    Args:
        env: a `RoboArmEnv`, whose scene may change between plans. Planning doesn't change it.
        planner: one of `PLANNERS`, or your own: a function `(is_valid, start, goal, rng)` that
            returns a path (k, n) from start to goal, or None. `is_valid` is a `Validity`, start
            and goal are normalised configurations (n,), float64, `rng` is a NumPy Generator. With
            several goals it is called for one after the other, until it returns a path.
            If they take long, `compiled` and `RRTConnect` alternate with `OTHER_PLANNER`.
        clearance: how far a path stays from the scene (m), in addition to `MARGIN`. It is left out
            if the start or the goal is nearer. In a long search `MARGIN_SCHEDULE` reduces both. For
            other arms than the Panda, both are multiplied by the ratio of the reaches.
        planner_range: longest motion (L2, normalised) that the planner tries at once, if it has
            such a range; 0 for OMPL's own choice, 1.06. (0.4 was chosen with RRTConnect,
            docs/benchmark/performance.md.)
        simplify: rounds of removing vertices and cutting corners; 0 for none.
        geometry_source: a function from a `Scene` to the `CollisionChecker` to plan with. By
            default it checks the ground-truth obstacles; `envs.perception.geometry_source` has
            others.
        max_checks: collision checks for one plan; None for no limit. Unlike a time limit, it ends
            a search at the same point on every machine. Asymptotically optimal planners use all of
            their limit; FMT and BFMT need about 100,000 checks.
        limits: "urdf" or "datasheet": which position limits the named planners obey.

    Raises:
        ValueError: the planner or the limits are unknown, or a number is out of range.
    """

    def __init__(
        self,
        env: RoboArmEnv,
        planner: str | Callable[..., ArrayLike | None] = COMPILED,
        clearance: float = 0.005,
        planner_range: float = 0.4,
        simplify: int = 1,
        geometry_source: Callable[[Scene], CollisionChecker] = CollisionChecker,
        max_checks: int | None = None,
        limits: Literal["urdf", "datasheet"] = "urdf",
    ):
        if not callable(planner) and planner not in PLANNERS:
            raise ValueError(f"unknown planner {planner!r}: {suggest(planner, PLANNERS)}")
        if not 0 <= clearance < 0.5:
            raise ValueError(f"clearance must be in [0, 0.5) m, got {clearance!r}")
        if not 0 <= planner_range < math.inf:
            raise ValueError(f"planner_range must be 0 or positive, got {planner_range!r}")
        if not (simplify >= 0 and simplify == int(simplify)):
            raise ValueError(f"simplify must be a number of rounds, got {simplify!r}")
        if max_checks is not None and not max_checks > 0:
            raise ValueError(f"max_checks must be positive or None, got {max_checks!r}")
        # Those of the URDF are -1 and 1, without rounding.
        self._bounds = np.array([[-1.0], [1.0]]) * np.ones(env.robot.num_joints)
        if limits != "urdf":
            bounds = env.robot.position_limits(limits)
            self._bounds = np.clip(env.robot.normalise(bounds), -1.0, 1.0)
        scale = scale_of(env.robot)
        self.env = env
        self.planner = planner
        self.clearance = scale * clearance
        self.margin = scale * MARGIN
        self.planner_range = planner_range
        self.simplify = simplify
        self.max_checks = max_checks
        self.limits: Literal["urdf", "datasheet"] = limits
        self._geometry_source = geometry_source
        self._scene = env.scene
        self._checker = geometry_source(env.scene.at(0.0))
        # Compile here what is compiled at its first call: a plan's time is for planning.
        state = np.zeros(env.robot.num_joints)
        self._checker.end_distances(state[None], 0.0)
        if planner == COMPILED:
            self._checker.find_path(state, state, np.random.default_rng(0), max_checks=1)
        self.checks = 0
        """Collision checks of the last plan."""

    def plan(
        self,
        start: ArrayLike,
        goal: ArrayLike | None = None,
        scene: Scene | None = None,
        *,
        seed: int | Sequence[int],
        time_limit: float = 5.0,
        goal_pose: ArrayLike | None = None,
        optimise: float = 0,
    ) -> np.ndarray:
        """Plan a path, float32 (k, n), rad, that begins exactly at start and ends exactly at goal.

        The same seed gives the same path on every machine, whatever was planned before, unless
        `time_limit` ends the search. If the path takes longer to follow than an episode lasts, up
        to `SEARCHES` searches are made, and the shortest path is returned.

        With a set of goals, the path ends at the one that is reached first; searches prefer goals
        near the start. For a goal pose, the set consists of up to `MAX_GOALS` collision-free
        configurations from inverse kinematics.

        Args:
            start: joint angles (n, rad), inside the `limits`.
            goal: joint angles (n, rad), inside the `limits`, or a set of goals (m, n), of which
                those in collision, or outside the limits, are ignored.
            scene: a `Scene` with the same arm; None for the environment's.
            seed: int >= 0 or a sequence of such ints, as for `np.random.default_rng`.
            time_limit: seconds for all searches; `math.inf` for no limit. The plan may take a
                little longer.
            goal_pose: instead of `goal`, a pose of the end effector (7,), as of
                `Robot.end_effector_pose`.
            optimise: go on searching for a shorter path, for so many seconds if it's a float, or
                for so many more searches if it's an int, which gives the same path on every
                machine. `time_limit` and `max_checks` hold for all searches together.

        Raises:
            ValueError: the start, the goal or every goal of a set is not n numbers inside the
                limits, or is in collision; both or none of `goal` and `goal_pose` are given; seed
                or time_limit is out of range; or your own planner returned something that is not
                a path from start to goal.
            PlanningError: there is no path within `time_limit` and `max_checks`, or no free
                configuration has the goal pose.
        """
        if seed is None:
            raise ValueError("seed must be an int or a sequence of ints, got None")
        if not time_limit > 0:
            raise ValueError(f"time_limit must be positive, got {time_limit!r}")
        if (goal is None) == (goal_pose is None):
            raise ValueError("either goal or goal_pose is needed, and not both")
        checker = self._checker_of(self.env.scene if scene is None else scene)
        start = checked_configuration(checker.robot, "start", start)
        if goal is None:
            goals = self._goals_of_pose(checker, start, goal_pose, seed)
        elif np.ndim(goal) == 2:
            goals = self._set_of_goals(checker.robot, start, goal)
        else:
            goals = checked_configuration(checker.robot, "goal", goal)[None]
        query = self._query(checker, start, goals, goal is not None and np.ndim(goal) == 2)
        deadline = time.monotonic() + time_limit
        rng = np.random.default_rng(seed)
        self.checks = 0
        best, least = None, math.inf
        for _ in range(SEARCHES):
            path = self._search(query, int(rng.integers(1, 2**32)), deadline)
            if path is None:
                break
            steps = self._steps(checker.robot, path)
            if steps < least:
                best, least = path, steps
            if least <= self.env.horizon - LAG:
                break
        if best is None:
            raise PlanningError(
                f"no path in {self.checks} collision checks (time_limit {time_limit} s, max_checks "
                f"{self.max_checks}); more time, or another seed, may find one"
            )
        if optimise:
            best = self._optimised(query, best, optimise, rng, deadline)
        return best

    def _optimised(self, query, best, optimise, rng, deadline):
        """The shortest path of `optimise` further searches, or seconds of them, and of `best`."""
        robot = query.checker.robot
        searches = math.inf
        if isinstance(optimise, int):
            searches = optimise
        else:
            deadline = min(deadline, time.monotonic() + optimise)
        length = _length(robot, best)
        while searches > 0 and time.monotonic() < deadline:
            searches -= 1
            path = self._search(query, int(rng.integers(1, 2**32)), deadline)
            if path is None:
                break
            if _length(robot, path) < length:
                best, length = path, _length(robot, path)
        return best

    def plan_batch(
        self,
        queries: Iterable[tuple[ArrayLike, ArrayLike, Scene | None]],
        *,
        seed: int | Sequence[int],
        time_limit: float = 5.0,
        num_threads: int | None = None,
    ) -> list[np.ndarray | None]:
        """Plan the paths of many queries in several threads; None where no path was found.

        Path i is the same as `plan(*queries[i], seed=[*seed, i])`, for any number of threads.

        Args:
            queries: starts, goals and scenes, as for `plan`.
            seed: int >= 0 or a sequence of such ints.
            time_limit: seconds for each query.
            num_threads: by default, the number of cores.

        Raises ValueError: as `plan` does, for the first query that is not possible.
        """
        seeds = [seed] if isinstance(seed, int) else list(seed)

        def plan_one(numbered):
            number, query = numbered
            planner = copy.copy(self)  # which counts its own checks
            try:
                return planner.plan(*query, seed=[*seeds, number], time_limit=time_limit)
            except PlanningError:
                return None

        with ThreadPoolExecutor(num_threads or len(os.sched_getaffinity(0))) as pool:
            return list(pool.map(plan_one, enumerate(queries)))

    def _checker_of(self, scene):
        if scene is not self._scene:
            if not isinstance(scene, Scene):
                raise TypeError(f"a scene must be a Scene, got {scene!r}")
            if not scene.robot.same_arm(self.env.robot):
                name = self.env.robot.name
                raise ValueError(f"the scene's robot is {scene.robot.name!r}, not {name!r}")
            self._checker = self._geometry_source(scene.at(0.0))
            self._scene = scene
        return self._checker

    def _set_of_goals(self, robot, start, goals):
        """Those of a set of goals that are inside the joint limits, nearest to the start first."""
        if np.shape(goals)[1] != robot.num_joints or not len(goals):
            raise ValueError(
                f"a set of goals has shape (m, {robot.num_joints}), got {np.shape(goals)}"
            )
        inside = []
        problem = None
        for number, goal in enumerate(goals):
            try:
                inside.append(checked_configuration(robot, f"goal {number}", goal))
            except ValueError as error:
                problem = problem or error
        if not inside:
            raise ValueError(f"none of the {len(goals)} goals is possible: {problem}")
        distances = np.linalg.norm(robot.normalise(inside) - robot.normalise(start), axis=1)
        return np.array(inside)[np.argsort(distances, kind="stable")]

    def _goals_of_pose(self, checker, start, pose, seed):
        """Free configurations with a pose, float32 (m, n), rad, nearest to the start first.

        If some have the clearance that a path keeps, only those.
        """
        robot = checker.robot
        for round_ in range(IK_ROUNDS):
            num_seeds = NUM_SEEDS * 4**round_
            goals = inverse_kinematics(
                robot, pose, seed=seed, num_seeds=num_seeds, checker=checker, near=start
            )
            if len(goals):
                break
        else:
            raise PlanningError(
                "no collision-free configuration has the goal pose: move it away from the "
                "obstacles, or into the arm's reach"
            )
        goals = np.asarray(goals, dtype=np.float32)
        states = np.clip(robot.normalise(goals), -1.0, 1.0)
        for clearance in (self.margin + self.clearance, self.margin, EXACTNESS):
            wide = checker.is_free(states, margin=EXACTNESS, clearance=clearance - EXACTNESS)
            if wide.any():
                goals = goals[wide]
                break
        return goals[:MAX_GOALS]

    def _query(self, checker, start, goals, is_set):
        """The `_Query` from a start (n,) to those of the goals (m, n) that are possible, rad.

        Raises ValueError: the start is not, or no goal is.
        """
        ends = np.concatenate([start[None], goals])
        states = np.maximum(np.minimum(checker.robot.normalise(ends), 1.0), -1.0)
        distances = checker.end_distances(states, self.margin + self.clearance + EXACTNESS)
        if self.limits != "urdf" or distances[0].min() < 0.0:
            problems = [self._problem(checker, ends[0], states[0], set())]
            # From a goal, obstacles may move away.
            moving = _moving_obstacles(self._scene)
            for goal, state in zip(ends[1:], states[1:], strict=True):
                problems.append(self._problem(checker, goal, state, moving))
            if problems[0] is not None:
                raise ValueError(f"start {problems[0]}")
            possible = np.array([problem is None for problem in problems])
            if not possible[1:].any():
                if is_set:
                    nearest = f"the nearest one {problems[1]}"
                    raise ValueError(f"none of the {len(goals)} goals is possible: {nearest}")
                raise ValueError(f"goal {problems[1]}")
            ends, states, distances = ends[possible], states[possible], distances[:, possible]
        return _Query(checker, ends, states, distances)

    def _problem(self, checker, end, state, ignored):
        """Why a configuration (n,), in rad and normalised, cannot be an end of a path; or None.

        `ignored`: obstacles that are no reason. Neither are points of a cloud: there may be some of
        what the arm holds or touches.
        """
        if self.limits != "urdf" and not checker.robot.is_within(end, self.limits):
            return f"is outside the {self.limits} position limits: {end}"
        near = checker.signed_distances(state, within=0.0)
        hits = set(near.geometry[near.distance < 0.0].tolist()) - {POINT} - ignored
        if not hits:
            return None
        names = {TABLE: "the table", FLOOR: "the floor", ARM: "itself"}
        contacts = sorted(f"the arm with {names.get(hit, f'obstacle {hit}')}" for hit in hits)
        return f"is in collision: {', '.join(contacts)}"

    def _steps(self, robot, path):
        """Environment steps that following a path takes, without those of an arm that is late."""
        most = _length(robot, path) / SUBGOAL_SPACING + 2 * (1 + robot.acceleration_steps) * len(
            path
        )
        if most <= self.env.horizon - LAG:
            return most  # which is quicker to find
        return len(subgoals(path, robot))

    def _search(self, query, seed, deadline):
        """The path of one search, float32 (k, n), rad; None: there was none within the limits."""
        checker, start, goals = query.checker, query.states[0], query.states[1:]
        left = math.inf if self.max_checks is None else self.max_checks - self.checks
        rules = self._rules(query)
        is_valid = Validity(checker, rules, deadline, left)
        ompl = path = None
        with contextlib.ExitStack() as locks:

            def ompl_search():
                began = time.monotonic()
                checker.motion_checker()(tuple(start), tuple(start))  # it may have to be compiled
                is_valid.postpone(time.monotonic() - began)
                locks.enter_context(OMPL_LOCK)
                return OmplSearch(is_valid, self._bounds, self.planner_range, start, goals, seed)

            if callable(self.planner):
                ompl = ompl_search()
                for goal in goals:
                    path = self.planner(is_valid, start, goal, np.random.default_rng(seed))
                    if path is not None:
                        path = _checked(path, start, goal)
                        break
            else:
                for name, checks in _turns(self.planner):
                    if is_valid.exhausted():
                        break
                    if name == COMPILED:
                        limit = min(checks, left)
                        path = self._compiled(query, rules, seed, is_valid, limit)
                    else:
                        ompl = ompl or ompl_search()
                        path = ompl.solve(name, checks)
                        if path is not None and self.planner == COMPILED:
                            chords = CHORDS * self.simplify
                            path, more = checker.search(
                                start, goals, rules, seed, chords=chords, found=path
                            )
                            is_valid.count(more)
                    if path is not None:
                        break
            if self.planner != COMPILED and self.simplify and path is not None and ompl is not None:
                is_valid.restore_margins()
                path = ompl.simplified(path, self.simplify)
        self.checks += is_valid.checks
        if path is None:
            return None
        reached = 0
        if len(goals) > 1:
            reached = np.linalg.norm(goals - path[-1], axis=1).argmin()
        path = checker.robot.denormalise(path).astype(np.float32)
        path[0] = query.ends[0]
        path[-1] = query.ends[1 + reached]
        return path

    def _compiled(self, query, rules, seed, is_valid, limit):
        """The path of a turn of the compiled planner, shortened, (k, n); None: it found none."""
        path, checks = query.checker.search(
            query.states[0],
            query.states[1:],
            rules,
            # Another turn has other random numbers.
            seed=seed + (is_valid.checks << 32),
            bounds=self._bounds,
            reach=self.planner_range or REACH,
            checks=is_valid.checks,
            max_checks=limit,
            chords=CHORDS * self.simplify,
        )
        is_valid.count(checks - is_valid.checks)
        return path

    def _rules(self, query):
        """`Rules` with margins that shrink, and are smaller around the ends."""
        near, from_scene = query.distances
        clearance = self.clearance if from_scene.min() >= self.clearance else 0.0
        numbers = np.array(
            [
                (scale * self.margin, scale * clearance, MARGIN_GROWTH, SEARCH_RESOLUTION)
                for _, scale in MARGIN_SCHEDULE
            ]
        )
        endpoints = np.empty((len(numbers), len(query.states), query.states.shape[1] + 1))
        endpoints[:, :, :-1] = query.states
        # Less a hair, because the ends are checked again after normalising, which rounds.
        endpoints[:, :, -1] = np.minimum(near, from_scene - numbers[:, 1:2]) - 1e-5
        return Rules(_RULES_BEGIN, numbers, endpoints)


def _turns(planner: str) -> Iterator[tuple[str, float]]:
    """Pairs of a planner, and the number of checks at which the next one takes over.

    RRT-Connect and the other planner alternate, any other planner works alone. There are more turns
    than anybody has time for.
    """
    if planner not in (COMPILED, "RRTConnect"):
        yield planner, math.inf
        return
    checks = 0
    length = FIRST_TURN
    for _ in range(20):
        for name, share in ((planner, length), (OTHER_PLANNER, length // 2)):
            checks += share
            yield name, checks
        length *= 2


def _moving_obstacles(scene):
    """The indices in `scene.at(0.0).obstacles` of those that move or disappear."""
    present = [one for one in scene.obstacles if obstacle_at(one, 0.0) is not None]
    return {number for number, obstacle in enumerate(present) if obstacle.motion is not None}


def _length(robot, path):
    """L2, normalised, of a path (k, n), rad."""
    states = robot.normalise(path).tolist()
    return sum(map(math.dist, states, states[1:]))


def _checked(path, start, goal):
    """What a user's own planner returned, as an array. Raises ValueError if it is not a path."""
    path, joints = np.asarray(path, dtype=np.float64), len(start)
    if path.ndim != 2 or path.shape[1] != joints or len(path) < 2:
        raise ValueError(
            f"the planner returned shape {path.shape}: a path has shape (k > 1, {joints})"
        )
    if not np.isfinite(path).all() or np.abs(path).max() > 1.0 + 1e-6:
        raise ValueError(f"the planner returned a path that leaves [-1, 1]^{joints}")
    for name, end, wanted in (("start", path[0], start), ("end", path[-1], goal)):
        if np.abs(end - wanted).max() > 1e-6:
            raise ValueError(f"the planner's path does not {name} at the query's {name}: {end}")
    return path
