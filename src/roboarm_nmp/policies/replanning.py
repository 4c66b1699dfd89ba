"""Replanning: a policy that follows a plan, watches it, and plans again when it is blocked.

    current_checker = lambda: find_geometry_source("point_cloud")(observed_scene(env))
    act = Replanning(robot, goal, current_checker, rng)          # at the start of an episode
    action = act(observation)

In each step, the policy checks the remaining path against the obstacles as they are observed now:
the next second of it, and from time to time all of it. A blocked path is replaced by a plan from
where the arm is, if one is found within a number of checks, which a step has time for; otherwise
it is kept. The arm waits where the next steps are blocked, or will be, if obstacles continue to
approach as they do now. If they come close to a waiting arm, it goes back along the way it came, as
far as that leads away from them. The safety filter (`policies.safety_filter`) moves the arm
out of the way of what comes closer, and the policy returns to its path.

While the goal is occupied, the policy plans to a configuration near it that is clear of obstacles,
and waits there.

A limit of checks, unlike one of time, gives the same actions on every machine.
"""

from collections import deque
from collections.abc import Callable

import numpy as np

from roboarm_nmp.envs.arm_env import Observation
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.subgoals import SUBGOAL_SPACING
from roboarm_nmp.policies.policy import Policy
from roboarm_nmp.policies.safety_filter import PATIENCE, PROGRESS, PROGRESS_SHARE, ApproachRates

# The numbers below were chosen on fresh queries: docs/lab_notebook.md.
WATCHED, WATCH_ALL_EVERY = 30, 10  # sub-goals checked in each step; steps between checks of all
HOLD = 8  # sub-goals: if one of the next ones is blocked, the arm waits
CHECK_MARGIN = 0.003  # m
# Steps ahead at which obstacles are predicted; slower approaches (m per step) are neglected.
PREDICTED, LEAST_APPROACH = np.arange(1, 17, 3), 0.002
# What a plan keeps clear, m: between links and from obstacles, from obstacles in addition; and how
# many checks it may take until the next ones are tried. After each failure twice as many checks, up
# to MAX_EFFORT times, with as much smaller margins. Steps from a failed plan to the next one, as
# many times.
LEVELS = ((0.01, 0.015, 8_000), (0.01, 0.0, 12_000), (0.003, 0.0, 12_000))
# A waiting arm goes back if it will be nearer to what approaches than RETREAT_DISTANCE (m) in
# RETREAT_STEPS, and if that distance is larger by RETREAT_GAIN (m) at one of the last places.
RETREAT_DISTANCE, RETREAT_STEPS, RETREAT_GAIN = 0.05, 10, 0.01
TRAIL = 100  # places that are remembered
PLANNED = 90  # steps that `ReplanWhenStuck` follows a plan
MARGIN_GROWTH = 0.03  # as `planning.planner.MARGIN_GROWTH`
RETRY, MAX_EFFORT = 3, 8
STRAYED = 0.15  # L2, normalised, from the path: farther away, a new plan is made
SEARCHED = 12  # sub-goals from the last one, among which the nearest to the arm is due
PASSED = 0.01  # L2, normalised: a sub-goal nearer than this is passed
# m: a goal with a smaller distance from obstacles is occupied. (An observed cloud takes up a few
# millimetres more than the obstacles.)
OCCUPIED = -0.012
# Of the places to wait at: tries, their largest distance from the goal (normalised, per joint), and
# their clearances (m), the first that any of them has.
WAITING_TRIES, WAITING_RADIUS, WAITING_CLEARANCES = 128, 0.6, (0.08, 0.03, 0.01)


class Replanning:
    """A policy for one episode: a function from an observation to an action (n,).

    Args:
        robot: the `Robot`.
        goal: rad, (n,).
        current_checker: a function without arguments that returns the `CollisionChecker` of what is
            observed now.
        rng: a NumPy Generator.

    Attributes:
        plans: how many plans were made, failed ones included.
    """

    def __init__(
        self,
        robot: Robot,
        goal: np.ndarray,
        current_checker: Callable[[], CollisionChecker],
        rng: np.random.Generator,
    ):
        self._robot = robot
        self._goal = np.clip(robot.normalise(goal), -1.0, 1.0)
        self._current_checker = current_checker
        self._rng = rng
        self._path = None  # sub-goals (m, n)
        self._waits_at = None  # whether they lead to a waiting place
        self._due = 0  # the sub-goal to go to
        self._strayed = False
        self._step = 0
        self._next_try = 0  # the step of the next plan after one that failed
        self._effort = 1
        self._approach = ApproachRates(current_checker)
        self._trail = deque(maxlen=TRAIL)  # states, at least a sub-goal's spacing apart
        self._checked = None  # the checker against which the whole path was checked last
        self.plans = 0

    def __call__(self, observation: Observation) -> np.ndarray:
        state = observation["observation"][: self._robot.num_joints].astype(np.float64)
        here = np.clip(state, -1.0, 1.0)
        checker = self._current_checker()
        self._approach.observe()
        self._advance(state)
        if self._needs_plan(checker, here) and self._step >= self._next_try:
            self._plan(checker, here)
            self._advance(state)
        self._step += 1
        if self._path is None or self._must_wait(checker, here, self._path):
            return self._retreat(checker, here)
        if not self._trail or np.linalg.norm(here - self._trail[-1]) >= SUBGOAL_SPACING:
            self._trail.append(here)
        return self._path[self._due] - state

    def forget(self) -> None:
        """Plan anew in the next step, after steps of another policy."""
        self._path = None
        self._waits_at = None
        self._trail.clear()

    def _retreat(self, checker, here):
        """The action of a waiting arm: none, or back along the way it came."""
        if self._approach.any_motion and len(self._trail) > 1:
            states = np.array([here, *list(self._trail)[: -SEARCHED - 1 : -1]])
            distances = checker.link_distances(states)[..., 0]
            rates = self._approach(states, distances)
            # From what approaches alone: the way back may be narrow.
            predicted = distances + RETREAT_STEPS * rates
            clearance = np.where(rates < -LEAST_APPROACH, predicted, np.inf).min(-1)
            if clearance[0] < min(RETREAT_DISTANCE, clearance[1:].max() - RETREAT_GAIN):
                while len(self._trail) > 1 and (
                    np.linalg.norm(self._trail[-1] - here) < SUBGOAL_SPACING
                ):
                    self._trail.pop()
                return self._trail[-1] - here
        return np.zeros(len(here))

    def _must_wait(self, checker, here, path):
        """Whether one of the next sub-goals is blocked, or will be when the arm is there."""
        left = path[self._due :]
        if not self._free(checker, here, path, left[:HOLD], 0.0):
            return True
        if not self._approach.any_motion:
            return False
        states = left[np.minimum(PREDICTED - 1, len(left) - 1)]
        distances = checker.link_distances(states)[..., 0]
        rates = self._approach(states, distances)
        contact = distances + rates * PREDICTED[:, None] < CHECK_MARGIN
        return bool((contact & (rates < -LEAST_APPROACH)).any())

    def _advance(self, state):
        """Find the sub-goal that is due."""
        if self._path is None:
            return
        away = np.linalg.norm(self._path[self._due :][:SEARCHED] - state, axis=1)
        self._due += int(away.argmin())
        self._strayed = away.min() > STRAYED
        last = len(self._path) - 1
        # From the nearest one on, the next is due; and one more if the arm is there already.
        if self._due < last and away.min() < SUBGOAL_SPACING:
            self._due += 1
        if self._due < last and np.linalg.norm(self._path[self._due] - state) < PASSED:
            self._due += 1

    def _needs_plan(self, checker, here):
        path = self._path
        occupied = self._is_occupied(checker)
        if path is None or self._strayed or self._waits_at != occupied:
            return True
        if checker is self._checked:
            return False
        left = path[self._due :]
        if self._step % WATCH_ALL_EVERY:
            left = left[:WATCHED]
        else:
            self._checked = checker
        return not self._free(checker, here, path, left, CHECK_MARGIN)

    def _is_occupied(self, checker):
        distance = checker.signed_distances(self._goal, self_collisions=False).distance
        return bool(distance.min() < OCCUPIED)

    def _free(self, checker, here, path, states, margin):
        """Whether the arm can be at all states; near `here` and the path's end with less margin."""
        near = self._endpoint_margins(checker, here, path[-1])
        return bool(checker.is_free(states, margin, endpoint_margins=near).all())

    def _endpoint_margins(self, checker, *ends):
        # Less a hair, because of rounding.
        distances = checker.signed_distances(ends).distance.min(-1) - 1e-5
        return np.array(ends), distances, MARGIN_GROWTH

    def _plan(self, checker, here):
        """Replace the path by a new one, if there is one."""
        self.plans += 1
        occupied = self._is_occupied(checker)
        goal = self._waiting_place(checker, here) if occupied else self._goal
        path = None
        for margin, clearance, max_checks in LEVELS if goal is not None else ():
            near = self._endpoint_margins(checker, here, goal)
            path, _ = checker.find_path(
                here,
                goal,
                self._rng,
                margin / self._effort,
                clearance / self._effort,
                endpoint_margins=near,
                max_checks=self._effort * max_checks,
            )
            if path is not None:
                break
        if path is None:
            self._next_try = self._step + RETRY * self._effort
            self._effort = min(2 * self._effort, MAX_EFFORT)
            return
        self._effort = 1
        self._path = dense(path)
        self._waits_at = occupied
        self._due = 0
        self._strayed = False
        self._checked = None

    def _waiting_place(self, checker, here):
        """A free configuration near the goal, (n,); None if none is found."""
        radius = self._rng.uniform(0.0, WAITING_RADIUS, (WAITING_TRIES, 1))
        places = self._goal + radius * self._rng.uniform(-1.0, 1.0, (WAITING_TRIES, len(here)))
        places = np.clip(np.concatenate([places, here[None]]), -1.0, 1.0)
        away = np.linalg.norm(places - self._goal, axis=1)
        for clearance in WAITING_CLEARANCES:
            free = checker.is_free(places, margin=0.003, clearance=clearance)
            if free.any():
                return places[np.where(free, away, np.inf).argmin()]
        return None


class ReplanWhenStuck:
    """A policy that follows a plan for `PLANNED` steps whenever it is stuck, for one episode.

    Stuck is what local minima are to `policies.safety_filter`, whose random escapes this
    replaces.

    Args:
        act: the policy, a function from an observation to an action (n,).
        replanning: a `Replanning` of the same episode.
        goal: normalised, (n,).
    """

    def __init__(self, act: Policy, replanning: Replanning, goal: np.ndarray):
        self._act = act
        self._replanning = replanning
        self._goal = goal
        self._states = deque(maxlen=PATIENCE + 1)
        self._left = 0  # steps of the plan

    def __call__(self, observation: Observation) -> np.ndarray:
        state = observation["observation"][: len(self._goal)]
        self._states.append(state)
        if self._left == 0 and len(self._states) > PATIENCE:
            moved = np.linalg.norm(state - self._states[0])
            remaining = np.linalg.norm(self._goal - self._states[0])
            if moved < min(PROGRESS, PROGRESS_SHARE * remaining):
                self._left = PLANNED
                self._replanning.forget()
        if self._left == 0:
            return self._act(observation)
        self._left -= 1
        if self._left == 0:
            self._states.clear()
        return self._replanning(observation)


def dense(path: np.ndarray) -> np.ndarray:
    """Sub-goals along a normalised path (k, n), at most `SUBGOAL_SPACING` apart: (m, n)."""
    points = [path[:1]]
    for start, end in zip(path, path[1:], strict=False):
        steps = max(1, int(np.ceil(np.linalg.norm(end - start) / SUBGOAL_SPACING)))
        points.append(start + (end - start) * np.arange(1, steps + 1)[:, None] / steps)
    return np.concatenate(points)
