"""Planning: a query in, a joint path out, by one of OMPL's planners or by one of your own.

    import roboarm_nmp
    from roboarm_nmp.demo_generation.planning import Planner
    from roboarm_nmp.envs.datasets.queries import load_queries

    env = roboarm_nmp.make("double_walls")
    query = load_queries("double_walls")[0]  # start, goal, scene
    path = Planner(env).plan(*query, seed=1)  # float32 (n, 7), rad

Collisions are checked by `envs.collision.checker`, which agrees with the environment's PyBullet world to
within a fraction of a millimetre and is some twenty times faster; the environment itself has the
last word on start and goal. Planning happens in the normalised configuration space [-1, 1]^7.
"""

import math
import time

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from roboarm_nmp.envs import panda
from roboarm_nmp.envs.collision.checker import RESOLUTION, CollisionChecker
from roboarm_nmp.envs.subgoals import subgoals

# OMPL writes to the console; what a user should know is raised here.
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
# controller's lag: without it, two of three plans on `double_walls` touch something when followed.
MARGIN = 0.003
# CircularConv a start or goal that is nearer than that, the margin grows by this much (m) per unit of
# normalised distance from it: all of it is kept again some three steps away.
MARGIN_GROWTH = 0.03
# `Planner.plan_within` gives up these distances bit by bit as a search goes on, because one that
# takes long is likely to go on for long: after so many configurations it keeps this share of them.
# (Chosen on 1,000 fresh queries of `random_boxes_hard`: docs/benchmarks.md.)
MARGIN_SCHEDULE = ((0, 1.0), (4_000, 0.5), (8_000, 0.25), (16_000, 0.0))
# Where RRT-Connect has found nothing after so many configurations, another planner may look at half
# as many before it goes on, and so in turns, each twice as long as the last one: some ways out of a
# shelf that RRT-Connect does not find, LBKPIECE1 finds at once.
# (Chosen on the same queries, and on the original MotionBenchMaker problems: docs/benchmarks.md.)
OTHER_PLANNER, FIRST_TURN = "LBKPIECE1", 8_000
# Searches that it makes at most for a path that can be followed within an episode.
SEARCHES = 3
# Steps by which the arm may come later than its last sub-goal.
LAG = 10
# Trials of cutting a corner in one round of simplification, and how many may fail in a row. Bounded
# by iterations, unlike OMPL's simplifyMax, which is bounded by seconds, they are deterministic.
SHORTCUT_STEPS, SHORTCUT_EMPTY_STEPS = 50, 25


class PlanningError(RuntimeError):
    """No path was found within the limits."""


class Validity:
    """Which normalised configurations and motions are free; counts what it is asked.

    Call it with one configuration (7 numbers), or use `free` and `motions_free` for many at once.
    `checks` is how many configurations were looked at so far, `exhausted()` whether the limits of
    this plan are reached: a planner asks now and then, and gives up.

    Args:
        checker: a `CollisionChecker`.
        rules: pairs of a number of checks and, to be kept from then on, a dict of `margin`,
            `clearance` and `endpoint_margins` of the checker's methods; the first from 0 on.
        time_limit, max_checks: as for `Planner`.
    """

    def __init__(self, checker, rules, time_limit, max_checks):
        self._checker, self._rules, self._later = checker, rules, list(rules)
        self._deadline, self._max_checks = time.monotonic() + time_limit, max_checks
        self.checks = 0
        self._relax()

    def __call__(self, state):
        """Whether a configuration is free."""
        state = tuple(map(float, state))
        return self.motion_free(state, state)

    def motion_free(self, start, end):
        """Whether the straight motion from a configuration that is free to another is free.

        Both are tuples of 7 floats.
        """
        checks = self._check(start, end)
        self._count(abs(checks))
        return checks > 0

    def free(self, states):
        """Which configurations (..., 7) are free: bool (...)."""
        free = self._checker.is_free(states, **self._rule)
        self._count(free.size)
        return free

    def motions_free(self, starts, ends):
        """Which straight motions from `starts` (..., 7) to `ends` (..., 7) are free: bool (...)."""
        checks = self._checker.motion_checks(starts, ends, **self._rule)
        self._count(int(np.abs(checks).sum()))
        return checks > 0

    def exhausted(self):
        return self.checks >= self._max_checks or time.monotonic() > self._deadline

    def restore_margins(self):
        """From now on, the first rule is kept: for what improves a path that is there."""
        self._later = [self._rules[0]]
        self._relax()

    def _count(self, checks):
        self.checks += checks
        if self.checks >= self._next:
            self._relax()

    def _relax(self):
        """Keep the next rule."""
        while self._later and self._later[0][0] <= self.checks:
            self._rule = self._later.pop(0)[1]
        self._next = self._later[0][0] if self._later else math.inf
        self._check = self._checker.motion_checker(**self._rule)


class _States(ob.StateValidityChecker):
    """OMPL's question about one state."""

    def __init__(self, space, is_valid):
        super().__init__(space)
        self._is_valid = is_valid

    def isValid(self, state):  # noqa: N802 (OMPL's name)
        state = _values(state)
        return self._is_valid.motion_free(state, state)


class _Motions(ob.MotionValidator):
    """OMPL's question about a motion, the start of which it knows to be valid."""

    def __init__(self, space, is_valid):
        super().__init__(space)
        self._is_valid = is_valid

    def checkMotion(self, start, end):  # noqa: N802
        return self._is_valid.motion_free(_values(start), _values(end))


def _values(state):
    return state[0], state[1], state[2], state[3], state[4], state[5], state[6]


class Planner:
    """Plans in the world of an environment.

    Args:
        env: a `RoboArmEnv`; its scene may change between plans. A plan begins by resetting it to
            the query, so reset before the next step.
        planner: one of `PLANNERS`, or your own: a function `(is_valid, start, goal, rng)` that
            returns a path (n, 7) from start to goal, or None. `is_valid` is a `Validity`, start
            and goal are normalised configurations (7,), float64, `rng` is a NumPy Generator.
        time_limit: seconds for one plan.
        max_checks: configurations looked at for one plan; unlike seconds, the same on every
            machine. Asymptotically optimal planners use all of it; FMT and BFMT need more.
        clearance: metres that a path keeps from the scene, in addition to `MARGIN`. A query that
            starts or ends nearer is planned without it.
        planner_range: longest motion (L2, normalised) that the planner tries at once, if it is of
            those that have such a range; 0 for OMPL's own choice, 1.06. (0.4 was chosen with
            RRTConnect, docs/benchmarks.md.)
        simplify: rounds of removing vertices and cutting corners; 0 for none.
        geometry_source: from a `Scene` to the `CollisionChecker` that is asked, by default that of the
            true obstacles; `envs.perception.point_clouds.observed_checker` knows only what sensors see.

    Raises:
        ValueError: unknown planner, a limit that is not positive, or another number out of range.
    """

    def __init__(
        self,
        env,
        planner="RRTConnect",
        time_limit=10.0,
        max_checks=30_000,
        clearance=0.005,
        planner_range=0.4,
        simplify=1,
        geometry_source=CollisionChecker,
    ):
        if not callable(planner) and planner not in PLANNERS:
            raise ValueError(f"unknown planner {planner!r}: one of {', '.join(PLANNERS)}")
        for name, value in (("time_limit", time_limit), ("max_checks", max_checks)):
            if not value > 0:
                raise ValueError(f"{name} must be positive, got {value!r}")
        if not 0 <= clearance < 0.5:
            raise ValueError(f"clearance must be in [0, 0.5) m, got {clearance!r}")
        if not 0 <= planner_range < math.inf:
            raise ValueError(f"planner_range must be 0 or positive, got {planner_range!r}")
        if not (simplify >= 0 and simplify == int(simplify)):
            raise ValueError(f"simplify must be a number of rounds, got {simplify!r}")
        self.env, self.planner = env, planner
        self.time_limit, self.max_checks = time_limit, max_checks
        self.clearance = clearance
        self.planner_range, self.simplify = planner_range, simplify
        self._geometry_source, self._scene, self._checker = (
            geometry_source,
            env.scene,
            geometry_source(env.scene),
        )
        # What is compiled at its first call is compiled now, not in a plan's time.
        state = (0.0,) * panda.NUM_JOINTS
        self._checker.signed_distances(state)
        self._checker.motion_checker()(state, state)
        self.checks = 0
        """Configurations that the last plan has looked at."""

    def plan(self, start, goal, scene=None, *, seed, margin_scale=1.0):
        """A path from start to goal: float32 (n, 7), rad; its ends are exactly start and goal.

        Args:
            start, goal: joint angles (7, rad).
            scene: a `Scene` to change the environment to first.
            seed: int > 0. The same seed gives the same path, whatever was planned before (except
                where `time_limit` is what ends the search).
            margin_scale: share of `clearance` and `MARGIN` to keep, in [0, 1].

        Raises:
            ValueError: start or goal is not 7 numbers inside the limits, or is in collision; seed
                or margin_scale is out of range; or your own planner returned something that is not a
                path from start to goal.
            PlanningError: no path within `time_limit` and `max_checks`.
        """
        if not 0 <= margin_scale <= 1:
            raise ValueError(f"margin_scale must be in [0, 1], got {margin_scale!r}")
        turns, schedule = ((self.planner, math.inf),), ((0, margin_scale),)
        limits = self.time_limit, self.max_checks
        return self._plan(start, goal, scene, seed, turns, schedule, *limits)

    def plan_within(self, seconds, start, goal, scene=None, *, rng):
        """A path found in `seconds`, which are its only limit; it keeps what `MARGIN_SCHEDULE` say.

        RRT-Connect gets help from `OTHER_PLANNER` where it takes long. The same path comes out on
        every machine that has the time. If it takes longer to follow than an episode lasts, there
        is another search, up to `SEARCHES`, and the shortest is returned. `rng`, a NumPy Generator,
        gives the seeds; the rest is as for `plan`, which may be a little late itself.
        """
        deadline, best = time.monotonic() + seconds, None
        turns = ((self.planner, math.inf),)
        if self.planner == "RRTConnect":
            turns = tuple(_turns())
        for _ in range(SEARCHES):
            seed, left = int(rng.integers(1, 2**32)), deadline - time.monotonic()
            try:
                path = self._plan(start, goal, scene, seed, turns, MARGIN_SCHEDULE, left, math.inf)
            except PlanningError:
                break
            if best is None or len(subgoals(path)) < len(subgoals(best)):
                best = path
            if len(subgoals(best)) <= self.env.horizon - LAG:
                break
        if best is None:
            raise PlanningError(f"no path in {seconds} s")
        return best

    def _plan(self, start, goal, scene, seed, turns, schedule, time_limit, max_checks):
        if not seed > 0:
            raise ValueError(f"seed must be positive, got {seed!r}")  # OMPL ignores others
        if np.shape(goal) == (3,):  # a position, with which an episode may begin
            raise ValueError("goal must have 7 numbers, got shape (3,)")
        # Both are refused here as an episode would refuse them.
        self.env.reset_specific(start, goal, scene)
        start, goal = (np.asarray(end, dtype=np.float32) for end in (start, goal))
        is_valid = self._validity(start, goal, schedule, time_limit, max_checks)
        states = panda.normalise(start), panda.normalise(goal)
        # For the random number generators that OMPL makes from here on. Spaces make some, for the
        # projections of KPIECE1 and its kin; how many must not matter to the planner.
        ou.RNG.setSeed(seed)
        space = self._space(is_valid)
        ou.RNG.setSeed(seed)
        if callable(self.planner):
            path = self.planner(is_valid, *states, np.random.default_rng(seed))
            path = None if path is None else _checked(path, *states)
        else:
            path = _solve(turns, self.planner_range, space, is_valid, *states)
        if path is not None and self.simplify:
            is_valid.restore_margins()
            path = _simplify(space, path, self.simplify)
        self.checks = is_valid.checks
        if path is None:
            raise PlanningError(
                f"no path in {is_valid.checks} collision checks (limits: {max_checks} checks, "
                f"{time_limit} s)"
            )
        path = panda.denormalise(path).astype(np.float32)
        path[0], path[-1] = start, goal
        return path

    def _validity(self, start, goal, schedule, time_limit, max_checks):
        if self._scene is not self.env.scene:
            self._scene, self._checker = self.env.scene, self._geometry_source(self.env.scene)
        ends = np.clip(np.stack([panda.normalise(start), panda.normalise(goal)]), -1.0, 1.0)
        near = self._checker.signed_distances(ends).distance.min(-1)
        from_scene = self._checker.signed_distances(ends, self_collisions=False).distance.min(-1)
        clearance = schedule[0][1] * self.clearance
        clearance = self.clearance if from_scene.min() >= clearance else 0.0
        rules = []
        for checks, margin_scale in schedule:
            # Less a hair, because the ends are checked again after normalising, which rounds.
            distances = np.minimum(near, from_scene - margin_scale * clearance) - 1e-5
            endpoint_margins = ends, distances, MARGIN_GROWTH
            rule = dict(
                margin=margin_scale * MARGIN,
                clearance=margin_scale * clearance,
                endpoint_margins=endpoint_margins,
            )
            rules.append((checks, rule))
        return Validity(self._checker, rules, time_limit, max_checks)

    def _space(self, is_valid):
        """OMPL's `SpaceInformation`, which asks `is_valid`."""
        space = normalised_space()
        information = ob.SpaceInformation(space)
        information.setStateValidityChecker(_States(information, is_valid))
        information.setMotionValidator(_Motions(information, is_valid))
        # For the planners that count a motion's states themselves: a share of the longest motion.
        information.setStateValidityCheckingResolution(RESOLUTION / space.getMaximumExtent())
        information.setup()
        return information


def normalised_space():
    """OMPL's view of the normalised configuration space."""
    space = ob.RealVectorStateSpace(panda.NUM_JOINTS)
    bounds = ob.RealVectorBounds(panda.NUM_JOINTS)
    bounds.setLow(-1.0)
    bounds.setHigh(1.0)
    space.setBounds(bounds)
    return space


def _state(space, values):
    state = space.allocState()
    for i, value in enumerate(values):
        # float32 may round a limit to just beyond it.
        state[i] = min(max(float(value), -1.0), 1.0)
    return state


def _turns():
    """RRT-Connect's turns and the other planner's, for `_solve`: more than there is time for."""
    checks, length = 0, FIRST_TURN
    for _ in range(20):
        for name, share in (("RRTConnect", length), (OTHER_PLANNER, length // 2)):
            checks += share
            yield name, checks
        length *= 2


def _solve(turns, planner_range, space, is_valid, start, goal):
    """Normalised path (n, 7) by OMPL's planners; None if there was none in time.

    `turns`: pairs of a planner's name, and the number of checks at which the next one takes over;
    one that had a turn before goes on from there.
    """
    problem = ob.ProblemDefinition(space)
    problem.setStartAndGoalStates(_state(space, start), _state(space, goal))
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
            return _to_array(problem.getSolutionPath())
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
    return _to_array(geometric)


def _to_array(path):
    return np.array([[state[i] for i in range(panda.NUM_JOINTS)] for state in path.getStates()])


def _checked(path, start, goal):
    """What a person's own planner returned, as an array. Raises ValueError if it is no path."""
    path = np.asarray(path, dtype=np.float64)
    if path.ndim != 2 or path.shape[1] != panda.NUM_JOINTS or len(path) < 2:
        raise ValueError(f"the planner returned shape {path.shape}: a path has shape (n > 1, 7)")
    if not np.isfinite(path).all() or np.abs(path).max() > 1.0 + 1e-6:
        raise ValueError("the planner returned a path that leaves [-1, 1]^7")
    for name, end, wanted in (("start", path[0], start), ("end", path[-1], goal)):
        if np.abs(end - wanted).max() > 1e-6:
            raise ValueError(f"the planner's path does not {name} at the query's {name}: {end}")
    return path
