"""Planning: a query in, a joint path out, by one of OMPL's planners or by one of your own.

    import roboarm_nmp
    from roboarm_nmp.planning.planner import Planner
    from roboarm_nmp.datasets.queries import load_queries

    env = roboarm_nmp.make("double_walls")
    query = load_queries("double_walls")[0]  # start, goal, scene
    path = Planner(env).plan(*query, seed=1)  # float32 (k, n), rad
    path = Planner(env).plan(query.start, goal_pose=pose, seed=1)  # of the end effector, (7,)

Collisions are checked by `envs.collision.checker`. It agrees with PyBullet within a fraction of a
millimetre and is about twenty times faster. The environment itself decides whether start and goal
are feasible. Planning happens in the normalised configuration space [-1, 1]^n.
"""

import math
import operator
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.collision.checker import RESOLUTION, CollisionChecker
from roboarm_nmp.envs.robots.inverse_kinematics import NUM_SEEDS, inverse_kinematics
from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.utils.names import suggest

# OMPL writes to the console. What concerns a user is raised here.
ou.setLogLevel(ou.LogLevel.LOG_NONE)

PLANNERS = tuple(
    sorted(
        name
        for name, kind in vars(og).items()
        if isinstance(kind, type)
        and issubclass(kind, ob.Planner)
        # PRM and PRMstar work in two threads: PRM's paths differ from run to run, PRMstar hangs.
        and not name.startswith("PRM")
    )
)
"""Names of OMPL's planners that can be used."""

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
MARGIN_SCHEDULE = ((0, 1.0), (4_000, 0.5), (8_000, 0.25), (16_000, 0.0))
# After so many checks without a path, RRT-Connect hands over to another planner for half as many.
# They alternate, each turn twice as long as the last: LBKPIECE1 quickly finds some paths out of
# shelves that RRT-Connect does not find.
# (Chosen on the same queries, and on the original MotionBenchMaker problems:
# docs/benchmark/performance.md.)
OTHER_PLANNER, FIRST_TURN = "LBKPIECE1", 8_000
# Searches at most, per plan, for a path that can be followed within an episode.
SEARCHES = 3
# Steps by which the arm may arrive later than its last sub-goal.
LAG = 10
# A goal pose is a set of configurations, at most this many. Inverse kinematics begins from
# `NUM_SEEDS` states; if it finds nothing free, again from 4, 16 and 64 times as many.
MAX_GOALS, IK_ROUNDS = 16, 4
# Shortcuts tried in one round of simplification, and how many may fail in a row. A limit of
# iterations is deterministic, unlike the seconds of OMPL's simplifyMax.
SHORTCUT_STEPS, SHORTCUT_EMPTY_STEPS = 50, 25


class PlanningError(RuntimeError):
    """No path was found within the limits."""


class Validity:
    """Decides which normalised configurations and motions are free, and counts the checks.

    Call it with one configuration (n numbers), or use `free` and `motions_free` for many at once.
    `checks` is the number of configurations checked so far. `exhausted()` says whether the limits
    of this plan are reached: a planner asks now and then, and gives up.

    Args:
        checker: a `CollisionChecker`.
        rules: pairs of a number of checks and the arguments that hold from then on: a dict of
            `margin`, `clearance` and `endpoint_margins` for the checker. The first number is 0.
        deadline: the time (`time.monotonic()`, s) at which the plan is exhausted.
        max_checks: the number of checks at which the plan is exhausted.
    """

    def __init__(
        self,
        checker: CollisionChecker,
        rules: list[tuple[int, dict[str, Any]]],
        deadline: float,
        max_checks: float,
    ):
        self._checker = checker
        self._rules = rules
        self._later = list(rules)
        self._deadline = deadline
        self._max_checks = max_checks
        self.checks = 0
        self._next_rule()

    def __call__(self, state: Sequence[float]) -> bool:
        """Whether a configuration is free."""
        state = tuple(map(float, state))
        return self.motion_free(state, state)

    def motion_free(self, start: tuple[float, ...], end: tuple[float, ...]) -> bool:
        """Whether the straight motion from a configuration that is free to another is free.

        Both are tuples of n floats.
        """
        checks = self._check(start, end)
        self.checks += checks if checks > 0 else -checks  # quicker than `abs`: planners ask often
        if self.checks >= self._next:
            self._next_rule()
        return checks > 0

    def free(self, states: ArrayLike) -> np.ndarray:
        """Which configurations (..., n) are free: bool (...)."""
        free = self._checker.is_free(states, **self._rule)
        self._count(free.size)
        return free

    def motions_free(self, starts: ArrayLike, ends: ArrayLike) -> np.ndarray:
        """Which straight motions from `starts` (..., n) to `ends` (..., n) are free: bool (...)."""
        checks = self._checker.motion_checks(starts, ends, **self._rule)
        self._count(int(np.abs(checks).sum()))
        return checks > 0

    def exhausted(self) -> bool:
        """Whether the limits of this plan are reached."""
        return self.checks >= self._max_checks or time.monotonic() > self._deadline

    def restore_margins(self) -> None:
        """Return to the full margins, for changes to a path that has been found."""
        self._later = [self._rules[0]]
        self._next_rule()

    def _count(self, checks):
        self.checks += checks
        if self.checks >= self._next:
            self._next_rule()

    def _next_rule(self):
        """Apply the last rule whose number of checks is reached."""
        while self._later and self._later[0][0] <= self.checks:
            self._rule = self._later.pop(0)[1]
        self._next = self._later[0][0] if self._later else math.inf
        self._check = self._checker.motion_checker(**self._rule)


class _States(ob.StateValidityChecker):
    """Answers OMPL's question about one state."""

    def __init__(self, space, is_valid):
        super().__init__(space)
        self._is_valid = is_valid
        self._values = _values_of(space)

    def isValid(self, state):  # noqa: N802 (OMPL's name)
        state = self._values(state)
        return self._is_valid.motion_free(state, state)


class _Motions(ob.MotionValidator):
    """Answers OMPL's question about a motion with a valid start."""

    def __init__(self, space, is_valid):
        super().__init__(space)
        self._is_valid = is_valid
        self._values = _values_of(space)

    def checkMotion(self, start, end):  # noqa: N802
        return self._is_valid.motion_free(self._values(start), self._values(end))


def _values_of(space) -> Callable[[Any], tuple[float, ...]]:
    """A function from a state of OMPL's `SpaceInformation` to a tuple of its numbers."""
    joints = space.getStateDimension()
    if joints == 1:
        return lambda state: (state[0],)
    return operator.itemgetter(*range(joints))  # in C: planners ask for millions of states


class Planner:
    """Plans in the world of an environment.

    Args:
        env: a `RoboArmEnv`; its scene may change between plans. A plan begins by resetting it to
            the query, so reset before the next step.
        planner: one of `PLANNERS`, or your own: a function `(is_valid, start, goal, rng)` that
            returns a path (k, n) from start to goal, or None. `is_valid` is a `Validity`, start
            and goal are normalised configurations (n,), float64, `rng` is a NumPy Generator. With
            several goals it is called for one after the other, until it returns a path.
            `RRTConnect` alternates with `OTHER_PLANNER` where it takes long.
        clearance: metres that a path keeps from the scene, in addition to `MARGIN`. A query that
            starts or ends nearer is planned without it. `MARGIN_SCHEDULE` scales both in a long
            search. For an arm other than the Panda, both are multiplied by the ratio of their
            reaches.
        planner_range: longest motion (L2, normalised) that the planner tries at once, if it has
            such a range; 0 for OMPL's own choice, 1.06. (0.4 was chosen with RRTConnect,
            docs/benchmark/performance.md.)
        simplify: rounds of removing vertices and cutting corners; 0 for none.
        geometry_source: a function from a `Scene` to the `CollisionChecker` to plan with. The
            default is that of the ground-truth obstacles; `envs.perception.geometry_source` has
            others.
        max_checks: collision checks for one plan; None for no limit. Unlike a time limit, it ends
            a search at the same point on every machine. Asymptotically optimal planners use all of
            their limit; FMT and BFMT need about 100,000 checks.
        limits: "urdf" or "datasheet": the position limits inside which OMPL's planners plan.

    Raises:
        ValueError: unknown planner or limits, or a number out of range.
    """

    def __init__(
        self,
        env: RoboArmEnv,
        planner: str | Callable[..., ArrayLike | None] = "RRTConnect",
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
        bounds = env.robot.position_limits(limits)
        self._bounds: tuple = ()  # those of the URDF are -1 and 1, without rounding
        if limits != "urdf":
            self._bounds = tuple(np.clip(env.robot.normalise(bounds), -1.0, 1.0))
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
        state = (0.0,) * env.robot.num_joints
        self._checker.signed_distances(state)
        self._checker.motion_checker()(state, state)
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
    ) -> np.ndarray:
        """A path from start to goal: float32 (k, n), rad; its ends are exactly start and goal.

        The same seed gives the same path on every machine, whatever was planned before, as long as
        the time suffices: only a search that `time_limit` ends depends on the machine. If following
        the path takes longer than an episode, there are up to `SEARCHES` searches, and the shortest
        path is returned.

        The path to a set of goals ends at one of them, whichever is reached first: searches prefer
        those nearest to the start. For a goal pose, the set are up to `MAX_GOALS` collision-free
        configurations from inverse kinematics.

        Args:
            start: joint angles (n, rad), inside the `limits`.
            goal: joint angles (n, rad), inside the `limits`, or a set of goals (m, n), of which
                those in collision, or outside the limits, are ignored.
            scene: a `Scene` to change the environment to first.
            seed: int >= 0 or a sequence of such ints, as for `np.random.default_rng`.
            time_limit: seconds for all searches; `math.inf` for no limit. The plan may take a
                little longer.
            goal_pose: instead of `goal`, a pose of the end effector (7,), as of
                `Robot.end_effector_pose`. Only the geometry source decides which configurations
                are free there.

        Raises:
            ValueError: start or goal is not n numbers inside the limits, or is in collision, or so
                are all goals of a set; both or none of `goal` and `goal_pose` are given; seed or
                time_limit is out of range; your own planner returned something that is not a path
                from start to goal.
            PlanningError: no path within `time_limit` and `max_checks`, or no free configuration
                has the goal pose.
        """
        if seed is None:
            raise ValueError("seed must be an int or a sequence of ints, got None")
        if not time_limit > 0:
            raise ValueError(f"time_limit must be positive, got {time_limit!r}")
        if (goal is None) == (goal_pose is None):
            raise ValueError("either goal or goal_pose is needed, and not both")
        joints = self.env.robot.num_joints
        rng = np.random.default_rng(seed)
        # Bad queries are rejected here, as an episode would reject them.
        if goal is not None and np.ndim(goal) != 2:
            if np.shape(goal) == (3,) != (joints,):  # a position, with which an episode may begin
                raise ValueError(f"goal must have {joints} numbers, got shape (3,)")
            self.env.reset_specific(start, goal, scene)
            start = np.asarray(start, dtype=np.float32)
            goals = np.asarray([goal], dtype=np.float32)
        else:
            if scene is not None:
                self.env.set_scene(scene)
            start = self.env.check_configuration("start", start)
            if goal is not None:
                goals = self._free_goals(start, goal)
            else:
                goals = self._goals_of_pose(start, goal_pose, seed)
        goals = self._goals_within_limits(start, goals)
        deadline = time.monotonic() + time_limit
        self.checks = 0
        best = None
        for _ in range(SEARCHES):
            path = self._search(start, goals, int(rng.integers(1, 2**32)), deadline)
            if path is None:
                break
            if best is None or self._steps(path) < self._steps(best):
                best = path
            if self._steps(best) <= self.env.horizon - LAG:
                break
        if best is None:
            raise PlanningError(
                f"no path in {self.checks} collision checks (time_limit {time_limit} s, max_checks "
                f"{self.max_checks})"
            )
        return best

    def _free_goals(self, start, goals):
        """Those of a set of goals with which an episode can begin, nearest to the start first."""
        joints = self.env.robot.num_joints
        normalise = self.env.robot.normalise
        if np.shape(goals)[1] != joints or not len(goals):
            raise ValueError(f"a set of goals has shape (m, {joints}), got {np.shape(goals)}")
        free = []
        problem = None
        for number, goal in enumerate(goals):
            try:
                free.append(self.env.check_configuration(f"goal {number}", goal))
            except ValueError as error:
                problem = problem or error
        if not free:
            raise ValueError(f"none of the {len(goals)} goals is possible: {problem}")
        distances = np.linalg.norm(normalise(free) - normalise(start), axis=1)
        return np.array(free)[np.argsort(distances, kind="stable")]

    def _goals_within_limits(self, start, goals):
        """Those of the goals (m, n) that are inside the `limits`, as the start has to be."""
        if not self._bounds:
            return goals
        for name, ends in (("start", [start]), ("goal", goals)):
            inside = [end for end in ends if self.env.robot.is_within(end, self.limits)]
            if not inside:
                raise ValueError(f"{name} is outside the {self.limits} position limits: {ends[0]}")
        return np.array(inside)

    def _goals_of_pose(self, start, pose, seed):
        """Free configurations with a pose, float32 (m, n), rad, nearest to the start first.

        If some have the clearance that a path keeps, only those.
        """
        checker = self._current_checker()
        robot = self.env.robot
        for round_ in range(IK_ROUNDS):
            num_seeds = NUM_SEEDS * 4**round_
            goals = inverse_kinematics(
                robot, pose, seed=seed, num_seeds=num_seeds, checker=checker, near=start
            )
            if len(goals):
                break
        else:
            raise PlanningError("no collision-free configuration has the goal pose")
        goals = np.asarray(goals, dtype=np.float32)
        states = np.clip(robot.normalise(goals), -1.0, 1.0)
        for clearance in (self.margin + self.clearance, self.margin, EXACTNESS):
            wide = checker.is_free(states, margin=EXACTNESS, clearance=clearance - EXACTNESS)
            if wide.any():
                goals = goals[wide]
                break
        return goals[:MAX_GOALS]

    def _steps(self, path):
        return len(subgoals(path, self.env.robot))

    def _search(self, start, goals, seed, deadline):
        """The path of one search, float32 (k, n), rad; None: there was none within the limits."""
        is_valid = self._validity(start, goals, deadline)
        robot = self.env.robot
        start_state = robot.normalise(start)
        goal_states = robot.normalise(goals)
        # For the random number generators that OMPL makes from here on. Spaces make some, for the
        # projections of KPIECE1 and its kin; how many must not matter to the planner.
        ou.RNG.setSeed(seed)
        space = self._space(is_valid)
        ou.RNG.setSeed(seed)
        if callable(self.planner):
            for state in goal_states:
                path = self.planner(is_valid, start_state, state, np.random.default_rng(seed))
                if path is not None:
                    path = _checked(path, start_state, state)
                    break
        else:
            path = _solve(
                _turns(self.planner), self.planner_range, space, is_valid, start_state, goal_states
            )
        if path is not None and self.simplify:
            is_valid.restore_margins()
            path = _simplify(space, path, self.simplify)
        self.checks += is_valid.checks
        if path is None:
            return None
        reached = np.linalg.norm(goal_states - path[-1], axis=1).argmin()
        path = robot.denormalise(path).astype(np.float32)
        path[0] = start
        path[-1] = goals[reached]
        return path

    def _current_checker(self):
        if self._scene is not self.env.scene:
            self._scene = self.env.scene
            self._checker = self._geometry_source(self._scene.at(0.0))
        return self._checker

    def _validity(self, start, goals, deadline):
        """The `Validity` of one search."""
        checker = self._current_checker()
        ends = np.clip(self.env.robot.normalise([start, *goals]), -1.0, 1.0)
        near = checker.signed_distances(ends).distance.min(-1)
        from_scene = checker.signed_distances(ends, self_collisions=False).distance.min(-1)
        clearance = self.clearance if from_scene.min() >= self.clearance else 0.0
        rules = []
        for checks, margin_scale in MARGIN_SCHEDULE:
            # Less a hair, because the ends are checked again after normalising, which rounds.
            distances = np.minimum(near, from_scene - margin_scale * clearance) - 1e-5
            rule = {
                "margin": margin_scale * self.margin,
                "clearance": margin_scale * clearance,
                "endpoint_margins": (ends, distances, MARGIN_GROWTH),
            }
            rules.append((checks, rule))
        checks_left = math.inf if self.max_checks is None else self.max_checks - self.checks
        return Validity(checker, rules, deadline, checks_left)

    def _space(self, is_valid):
        """OMPL's `SpaceInformation`, which asks `is_valid`."""
        space = normalised_space(self.env.robot.num_joints, *self._bounds)
        information = ob.SpaceInformation(space)
        information.setStateValidityChecker(_States(information, is_valid))
        information.setMotionValidator(_Motions(information, is_valid))
        # For the planners that count a motion's states themselves: a share of the longest motion.
        information.setStateValidityCheckingResolution(RESOLUTION / space.getMaximumExtent())
        information.setup()
        return information


def _turns(planner: str) -> Iterator[tuple[str, float]]:
    """For `_solve`: RRT-Connect and the other planner alternate, any other planner works alone.

    There are more turns than anybody has time for.
    """
    if planner != "RRTConnect":
        yield planner, math.inf
        return
    checks = 0
    length = FIRST_TURN
    for _ in range(20):
        for name, share in (("RRTConnect", length), (OTHER_PLANNER, length // 2)):
            checks += share
            yield name, checks
        length *= 2


def normalised_space(
    num_joints: int, lower: Sequence[float] | None = None, upper: Sequence[float] | None = None
) -> ob.RealVectorStateSpace:
    """OMPL's view of the normalised configuration space, or of a box (n,), (n,) in it."""
    bounds = ob.RealVectorBounds(num_joints)
    for joint in range(num_joints):
        bounds.setLow(joint, -1.0 if lower is None else float(lower[joint]))
        bounds.setHigh(joint, 1.0 if upper is None else float(upper[joint]))
    space = ob.RealVectorStateSpace(num_joints)
    space.setBounds(bounds)
    return space


def _state(space, values):
    state = space.allocState()
    for i, value in enumerate(values):
        # float32 may round a limit to just beyond it.
        state[i] = min(max(float(value), -1.0), 1.0)
    return state


def _solve(turns, planner_range, space, is_valid, start, goals):
    """Normalised path (k, n) by OMPL's planners; None: there is none within the limits.

    The path ends at one of `goals`, (m, n).
    `turns`: pairs of a planner's name and the number of checks at which the next planner takes
    over. A planner that had a turn before continues its search.
    """
    problem = ob.ProblemDefinition(space)
    if len(goals) == 1:
        problem.setStartAndGoalStates(_state(space, start), _state(space, goals[0]))
    else:
        problem.addStartState(_state(space, start))
        several = ob.GoalStates(space)
        for goal in goals:
            several.addState(_state(space, goal))
        problem.setGoal(several)
    planners = {}
    for name, checks in turns:
        if name not in planners:
            planners[name] = planner = getattr(og, name)(space)
            planner.setProblemDefinition(problem)
            if hasattr(planner, "setRange"):
                planner.setRange(planner_range)
            planner.setup()

        def over(checks=checks):
            return is_valid.checks >= checks or is_valid.exhausted()

        planners[name].solve(ob.PlannerTerminationCondition(over))
        if problem.hasExactSolution():
            return _to_array(problem.getSolutionPath(), len(start))
        if is_valid.exhausted():
            break
    return None


def _simplify(space, path, rounds):
    geometric = og.PathGeometric(space)
    for state in path:
        geometric.append(_state(space, state))
    simplifier = og.PathSimplifier(space)
    for _ in range(rounds):
        simplifier.reduceVertices(geometric, 0, 0)
        simplifier.partialShortcutPath(geometric, SHORTCUT_STEPS, SHORTCUT_EMPTY_STEPS)
    simplifier.collapseCloseVertices(geometric)
    return _to_array(geometric, len(path[0]))


def _to_array(path, num_joints):
    return np.array([[state[i] for i in range(num_joints)] for state in path.getStates()])


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
