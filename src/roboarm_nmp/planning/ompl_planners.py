"""OMPL's planners: the collision checks that they ask, and their searches."""

import math
import operator
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from roboarm_nmp.envs.collision.checker import RESOLUTION, CollisionChecker, Rules

# OMPL writes to the console. What concerns a user is raised by the planner.
ou.setLogLevel(ou.LogLevel.LOG_NONE)

OMPL_PLANNERS = tuple(
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

OMPL_LOCK = threading.RLock()
"""Held during a search: OMPL has one seed for all generators that are made from then on."""
# Shortcuts tried in one round of simplification, and how many may fail in a row. A limit of
# iterations is deterministic, unlike the seconds of OMPL's simplifyMax.
SHORTCUT_STEPS, SHORTCUT_EMPTY_STEPS = 50, 25


class Validity:
    """Decides which normalised configurations and motions are free, and counts the checks.

    Call it with one configuration (n numbers), or use `free` and `motions_free` for many at once.
    `checks` is the number of configurations checked so far. `exhausted()` says whether the limits
    of this plan are reached: a planner asks now and then, and gives up.

    Args:
        checker: a `CollisionChecker`.
        rules: the `Rules` of the checks.
        deadline: the time (`time.monotonic()`, s) at which the plan is exhausted.
        max_checks: the number of checks at which the plan is exhausted.
    """

    def __init__(
        self,
        checker: CollisionChecker,
        rules: Rules,
        deadline: float,
        max_checks: float,
    ):
        self._checker = checker
        self._rules = rules
        self._deadline = deadline
        self._max_checks = max_checks
        self.checks = 0
        self._use_rule(0)

    def __call__(self, state: Sequence[float]) -> bool:
        """Whether a configuration is free."""
        state = tuple(map(float, state))
        return self.motion_free(state, state)

    def motion_free(self, start: tuple[float, ...], end: tuple[float, ...]) -> bool:
        """Whether the straight motion from a configuration that is free to another is free.

        Both are tuples of n floats.
        """
        if self._check is None:
            self._check = self._checker.motion_checker(**self._rule)
        checks = self._check(start, end)
        self.checks += checks if checks > 0 else -checks  # quicker than `abs`: planners ask often
        if self.checks >= self._next:
            self._next_rule()
        return checks > 0

    def free(self, states: ArrayLike) -> np.ndarray:
        """Which configurations (..., n) are free: bool (...)."""
        free = self._checker.is_free(states, **self._rule)
        self.count(free.size)
        return free

    def motions_free(self, starts: ArrayLike, ends: ArrayLike) -> np.ndarray:
        """Which straight motions from `starts` (..., n) to `ends` (..., n) are free: bool (...)."""
        checks = self._checker.motion_checks(starts, ends, **self._rule)
        self.count(int(np.abs(checks).sum()))
        return checks > 0

    def exhausted(self) -> bool:
        """Whether the limits of this plan are reached."""
        return self.checks >= self._max_checks or time.monotonic() > self._deadline

    def postpone(self, seconds: float) -> None:
        """Let this plan take longer by so many seconds."""
        self._deadline += seconds

    def restore_margins(self) -> None:
        """Return to the full margins, for changes to a path that has been found."""
        self._use_rule(0)
        self._next = math.inf

    def count(self, checks: int) -> None:
        """Add to the number of checks."""
        self.checks += checks
        if self.checks >= self._next:
            self._next_rule()

    def _next_rule(self):
        """Apply the last rule whose number of checks is reached."""
        begins = self._rules.begins
        self._use_rule(int(np.searchsorted(begins, self.checks, side="right")) - 1)

    def _use_rule(self, number):
        begins, numbers, endpoints = self._rules
        margin, clearance, growth, _ = numbers[number].tolist()
        states, distances = endpoints[number, :, :-1], endpoints[number, :, -1]
        self._rule = {
            "margin": margin,
            "clearance": clearance,
            "endpoint_margins": (states, distances, growth),
        }
        self._check = None  # made at the first question
        self._next = begins[number + 1] if number + 1 < len(begins) else math.inf


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


class OmplSearch:
    """One search by OMPL's planners, which may take turns.

    Args:
        is_valid: the `Validity` of the search.
        bounds: of the normalised space, (2, n).
        planner_range: longest motion that a planner tries at once, if it has such a range.
        start, goals: normalised, (n,) and (m, n). A path ends at one of the goals.
        seed: from 1 on.
    """

    def __init__(self, is_valid, bounds, planner_range, start, goals, seed):
        self._is_valid = is_valid
        self._range = planner_range
        # For the random number generators that OMPL makes from here on. Spaces make some, for the
        # projections of KPIECE1 and its kin; how many must not matter to the planner.
        ou.RNG.setSeed(seed)
        space = normalised_space(len(start), *bounds)
        self._space = ob.SpaceInformation(space)
        self._space.setStateValidityChecker(_States(self._space, is_valid))
        self._space.setMotionValidator(_Motions(self._space, is_valid))
        # For the planners that count a motion's states themselves: a share of the longest motion.
        self._space.setStateValidityCheckingResolution(RESOLUTION / space.getMaximumExtent())
        self._space.setup()
        ou.RNG.setSeed(seed)
        self._problem = ob.ProblemDefinition(self._space)
        if len(goals) == 1:
            self._problem.setStartAndGoalStates(self._state(start), self._state(goals[0]))
        else:
            self._problem.addStartState(self._state(start))
            several = ob.GoalStates(self._space)
            for goal in goals:
                several.addState(self._state(goal))
            self._problem.setGoal(several)
        self._planners = {}

    def solve(self, name: str, checks: float) -> np.ndarray | None:
        """A normalised path (k, n) by the planner called `name`; None: it has not found one.

        `checks`: of the `Validity`, at which it gives up. It continues its search of an earlier
        turn.
        """
        if name not in self._planners:
            planner = self._planners[name] = getattr(og, name)(self._space)
            planner.setProblemDefinition(self._problem)
            if hasattr(planner, "setRange"):
                planner.setRange(self._range)
            planner.setup()

        is_valid = self._is_valid  # a condition that refers to this object would leak it

        def over():
            return is_valid.checks >= checks or is_valid.exhausted()

        self._planners[name].solve(ob.PlannerTerminationCondition(over))
        if not self._problem.hasExactSolution():
            return None
        return self._to_array(self._problem.getSolutionPath())

    def simplified(self, path: np.ndarray, rounds: int) -> np.ndarray:
        """A path (k, n) with fewer vertices and its corners cut."""
        geometric = og.PathGeometric(self._space)
        for state in path:
            geometric.append(self._state(state))
        simplifier = og.PathSimplifier(self._space)
        for _ in range(rounds):
            simplifier.reduceVertices(geometric, 0, 0)
            simplifier.partialShortcutPath(geometric, SHORTCUT_STEPS, SHORTCUT_EMPTY_STEPS)
        simplifier.collapseCloseVertices(geometric)
        return self._to_array(geometric)

    def _state(self, values):
        state: Any = self._space.allocState()
        for i, value in enumerate(values):
            state[i] = float(value)
        return state

    def _to_array(self, path):
        joints = range(self._space.getStateDimension())
        return np.array([[state[i] for i in joints] for state in path.getStates()])


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
