"""Planning: a query in, a joint path out, by one of OMPL's planners or by one of your own.

    import envs
    from demo_generation.planning import Planner
    from envs.datasets import load_queries

    env = envs.make("double_walls")
    query = load_queries("double_walls")[0]  # start, goal, scene
    path = Planner(env).plan(*query, seed=1)  # float32 (n, 7), rad

Collisions are checked in the environment's own PyBullet world, so planner and simulator agree.
Planning happens in the normalised configuration space [-1, 1]^7.
"""

import math
import time
from dataclasses import replace

import numpy as np
import pybullet as p
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from envs import panda
from envs.arm_env import RoboArmEnv
from envs.scenes import Box, Cylinder, Scene

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

# Motions are checked at points this far apart, as a fraction of the space's diagonal: 0.021 in the
# normalised space, less than one step of the arm.
RESOLUTION = 0.004
# A configuration this close (m) to a collision counts as one, which absorbs most of the
# controller's lag: without it, two of three plans on `double_walls` touch something when followed.
# PyBullet reports contacts from about 0.0039 m on.
MARGIN = 0.003
# Around a start or goal that is nearer than that, the margin grows by this much (m) per unit of
# normalised distance from it: all of it is kept again some three steps away.
MARGIN_GROWTH = 0.03
# Trials of cutting a corner in one round of simplification, and how many may fail in a row. Bounded
# by iterations, unlike OMPL's simplifyMax, which is bounded by seconds, they are deterministic.
SHORTCUT_STEPS, SHORTCUT_EMPTY_STEPS = 50, 25


class PlanningError(RuntimeError):
    """No path was found within the limits."""


class Validity:
    """Whether a normalised configuration (7 numbers) is collision free; counts what it is asked.

    `checks` is how often it was called, `exhausted()` whether the limits of this plan are reached:
    a planner asks now and then, and gives up.
    """

    def __init__(self, env, margin, ends, time_limit, max_checks):
        self._env, self._margin = env, margin
        # Less a hair, because the ends are checked again after normalising, which rounds.
        self._ends = [(panda.normalise(end), clearance_at(env, end) - 1e-5) for end in ends]
        self._deadline, self._max_checks = time.monotonic() + time_limit, max_checks
        self.checks = 0

    def __call__(self, state):
        self.checks += 1
        state = [state[i] for i in range(panda.NUM_JOINTS)]
        nearest = clearance_at(self._env, panda.denormalise_one(state))
        return nearest >= self._margin or any(
            nearest >= clearance + MARGIN_GROWTH * math.dist(state, end)
            for end, clearance in self._ends
        )

    def exhausted(self):
        return self.checks >= self._max_checks or time.monotonic() > self._deadline


def clearance_at(env, configuration):
    """Distance (m) of the nearest contact at joint angles (7, rad), negative inside a collision.

    Infinite if PyBullet reports no contact, that is from about 0.0039 m on. Moves the arm.
    """
    client, robot = env.client, env.robot
    panda.set_configuration(client, robot, configuration)
    p.performCollisionDetection(physicsClientId=client)
    contacts = p.getContactPoints(bodyA=robot, physicsClientId=client)
    return min((contact[8] for contact in contacts), default=float("inf"))


class Planner:
    """Plans in the world of an environment.

    Args:
        env: a `RoboArmEnv`; its scene may change between plans. Planning moves its arm: reset
            before the next step.
        planner: one of `PLANNERS`, or your own: a function `(is_valid, start, goal, rng)` that
            returns a path (n, 7) from start to goal, or None. `is_valid` is a `Validity`, start
            and goal are normalised configurations (7,), float64, `rng` is a NumPy Generator.
        time_limit: seconds for one plan.
        max_checks: collision checks for one plan; unlike seconds, the same on every machine.
            Asymptotically optimal planners use all of it; FMT and BFMT need more than this.
        clearance: metres that a path keeps from the scene (by inflating it), in addition to
            `MARGIN`. A query that starts or ends nearer is planned without it.
        planner_range: longest motion (L2, normalised) that the planner tries at once, if it is of
            those that have such a range; 0 for OMPL's own choice, 1.06. (0.4 was chosen with
            RRTConnect, docs/benchmarks.md.)
        simplify: rounds of removing vertices and cutting corners; 0 for none.

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
        self._inflated = RoboArmEnv(inflate(env.scene, clearance)) if clearance > 0 else None
        self.checks = 0
        """Collision checks of the last plan."""

    def plan(self, start, goal, scene=None, *, seed, caution=1.0):
        """A path from start to goal: float32 (n, 7), rad; its ends are exactly start and goal.

        Args:
            start, goal: joint angles (7, rad).
            scene: a `Scene` to change the environment to first.
            seed: int > 0. The same seed gives the same path, whatever was planned before (except
                where `time_limit` is what ends the search).
            caution: share of `clearance` and `MARGIN` to keep, in [0, 1].

        Raises:
            ValueError: start or goal is not 7 numbers inside the limits, or is in collision; seed
                or caution is out of range; or your own planner returned something that is not a
                path from start to goal.
            PlanningError: no path within `time_limit` and `max_checks`.
        """
        if not seed > 0:
            raise ValueError(f"seed must be positive, got {seed!r}")  # OMPL ignores others
        if not 0 <= caution <= 1:
            raise ValueError(f"caution must be in [0, 1], got {caution!r}")
        if np.shape(goal) == (3,):  # a position, with which an episode may begin
            raise ValueError("goal must have 7 numbers, got shape (3,)")
        # Both are refused here as an episode would refuse them.
        self.env.reset_specific(start, goal, scene)
        start, goal = (np.asarray(end, dtype=np.float32) for end in (start, goal))
        is_valid = self._validity(start, goal, caution)
        states = panda.normalise(start), panda.normalise(goal)
        # For the random number generators that OMPL makes from here on. Spaces make some, for the
        # projections of KPIECE1 and its kin; how many must not matter to the planner.
        ou.RNG.setSeed(seed)
        space = _space(is_valid)
        ou.RNG.setSeed(seed)
        if callable(self.planner):
            path = self.planner(is_valid, *states, np.random.default_rng(seed))
            path = None if path is None else _checked(path, *states)
        else:
            kind = getattr(og, self.planner)
            path = _solve(kind, self.planner_range, space, is_valid, *states)
        if path is not None and self.simplify:
            path = _simplify(space, path, self.simplify)
        self.checks = is_valid.checks
        if path is None:
            raise PlanningError(
                f"no path in {is_valid.checks} collision checks (limits: {self.max_checks} checks, "
                f"{self.time_limit} s)"
            )
        path = panda.denormalise(path).astype(np.float32)
        path[0], path[-1] = start, goal
        return path

    def _validity(self, start, goal, caution):
        """In the inflated world, if start and goal are free there, or else in the plain one."""
        world = self.env
        if self._inflated is not None:
            self._inflated.set_scene(inflate(self.env.scene, caution * self.clearance))
            if not any(self._inflated.in_collision(end) for end in (start, goal)):
                world = self._inflated
        ends = start, goal
        return Validity(world, caution * MARGIN, ends, self.time_limit, self.max_checks)

    def close(self):
        """Disconnect the inflated world from PyBullet; the environment stays open."""
        if self._inflated is not None:
            self._inflated.close()


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
        friction=scene.friction,
    )


def _space(is_valid):
    """OMPL's view of the normalised configuration space: a `SpaceInformation`."""
    space = ob.RealVectorStateSpace(panda.NUM_JOINTS)
    bounds = ob.RealVectorBounds(panda.NUM_JOINTS)
    bounds.setLow(-1.0)
    bounds.setHigh(1.0)
    space.setBounds(bounds)
    information = ob.SpaceInformation(space)
    information.setStateValidityChecker(is_valid)
    information.setStateValidityCheckingResolution(RESOLUTION)
    information.setup()
    return information


def _state(space, values):
    state = space.allocState()
    for i, value in enumerate(values):
        # float32 may round a limit to just beyond it.
        state[i] = min(max(float(value), -1.0), 1.0)
    return state


def _solve(kind, planner_range, space, is_valid, start, goal):
    """Normalised path (n, 7) by one of OMPL's planners; None if there was none in time."""
    problem = ob.ProblemDefinition(space)
    problem.setStartAndGoalStates(_state(space, start), _state(space, goal))
    planner = kind(space)
    planner.setProblemDefinition(problem)
    if hasattr(planner, "setRange"):
        planner.setRange(planner_range)
    planner.setup()
    planner.solve(ob.PlannerTerminationCondition(is_valid.exhausted))
    return _to_array(problem.getSolutionPath()) if problem.hasExactSolution() else None


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
