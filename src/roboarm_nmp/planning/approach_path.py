"""Approach paths: out of a start, and into a goal, that is a few millimetres from obstacles.

    path = approach_path(robot, goal, checker.link_distances)    # (k, n), the goal first

From a configuration in a tight place, the path climbs the smallest link distances until a few
centimetres are free. A policy that follows such a path needs no safety filter there, whose margin
would stop it. Between its start's path and its goal's path it acts as usual. There the goal that it
observes is the free end of the goal's path, like a pre-grasp in grasp planning.

From there, the path to a goal goes straight back along the end effector's axis z, out of a box or a
compartment, if there is room and the way is not long (`retreat_path`).

Both are local and do not search. One step of the climb moves along the gradient of the softmin of
all rows of link distances. Between two boards, the nearest of which alternates, steps would only go
back and forth, so the direction is averaged over steps. The constraints of the safety filter keep
every row from becoming smaller (`policies.safety_filter`).
"""

import math
from collections.abc import Callable

import numpy as np

from roboarm_nmp.envs.arm_env import Observation, RoboArmEnv
from roboarm_nmp.envs.collision.checker import self_distances
from roboarm_nmp.envs.robots.inverse_kinematics import kinematic_chain
from roboarm_nmp.envs.robots.kernels import move_back
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.planning.projection_kernels import project

# The clearances were compared on validation queries, how paths climb on problems of
# MotionBenchMaker: docs/lab_notebook.md, "Approach paths".
START_CLEARANCE, GOAL_CLEARANCE = 0.02, 0.05  # m, where a start's and a goal's path end
SELF_CLEARANCE = 0.01  # m, of links from other links
MAX_STEPS = 320  # of a path; it also ends there
STEP = 0.003  # L2, normalised; with 0.012, paths jump through obstacles
SOFTMIN = 0.006  # m: a row weighs exp(-(distance - smallest) / SOFTMIN)
MOMENTUM = 0.9
PROJECTION_SWEEPS = 12
# From there a goal's path goes back by RETREAT, and keeps RETREAT_CLEARANCE, or what there is. It
# does so where something is nearer than OPEN, if its end has MORE_ROOM, or if the way over its end
# is at most DETOUR times as long as the straight one (docs/lab_notebook.md, "Straight back").
RETREAT, RETREAT_CLEARANCE, OPEN, MORE_ROOM = 0.3, 0.02, 0.15, 0.1  # m
DETOUR = 1.5
# Steps of an episode. If the arm is not at the free end until then, the path does not go back.
GIVE_UP = 150
# L2, normalised. A path is followed STRIDE points at a time. The next ones are due when the arm is
# nearer than TRACKING; the goal's path begins when the arm is nearer than REACHED to its free end.
STRIDE, TRACKING, REACHED = 3, 0.006, 0.01

LinkDistances = Callable[[np.ndarray], np.ndarray]
"""A function like `CollisionChecker.link_distances`."""


def approach_path(
    robot: Robot,
    state: np.ndarray,
    link_distances_at: LinkDistances,
    clearance: float = GOAL_CLEARANCE,
) -> np.ndarray:
    """A path from a configuration to a place with more clearance, normalised, float64 (k, n).

    Without enough room nearby, it ends after `MAX_STEPS`. Where there is room, k is 1.

    Args:
        robot: the `Robot`.
        state: (n,), normalised.
        link_distances_at: a function like `CollisionChecker.link_distances`.
        clearance: m, at the path's end.
    """
    path = [np.clip(np.asarray(state, np.float64), -1.0, 1.0)]
    direction = np.zeros(len(path[0]))
    while len(path) <= MAX_STEPS:
        rows = _rows(robot, path[-1], link_distances_at, clearance)
        distances = rows[:, 0]
        if distances.min() >= clearance:
            break
        gradient = np.exp((distances.min() - distances) / SOFTMIN) @ rows[:, 1:]
        length = np.linalg.norm(gradient)
        if length < 1e-9:
            break
        direction = MOMENTUM * direction + gradient / length
        length = np.linalg.norm(direction)
        wanted = STEP * direction / length
        move = _move(robot, path[-1], wanted, rows, link_distances_at, clearance)
        direction = move * length / max(np.linalg.norm(move), 1e-9)
        path.append(np.clip(path[-1] + move, -1.0, 1.0))
    return np.array(path)


def retreat_path(
    robot: Robot, state: np.ndarray, arm: np.ndarray, link_distances_at: LinkDistances
) -> np.ndarray:
    """A path straight back along the end effector's axis z, normalised, float64 (k, n).

    Link distances alone show no way out of a box or a compartment, and a hand has come in along
    this axis. k is 1 in the open, where there is no room for all of the path, and where it leads
    neither to more room nor nearer to the arm.

    Args:
        robot: the `Robot`.
        state: (n,), normalised.
        arm: the configuration (n,), normalised, that the path should lead to.
        link_distances_at: a function like `CollisionChecker.link_distances`.
    """
    chain = kinematic_chain(robot)
    path = [np.array(state, np.float64)]
    positions = []
    room = link_distances_at(path[0])[:, 0].min()
    if room >= OPEN:
        return np.array(path)
    while len(path) <= MAX_STEPS:
        back = path[-1].copy()
        positions.append(move_back(back, chain))
        if math.dist(positions[0], positions[-1]) >= RETREAT:
            break
        wanted = STEP * (back - path[-1]) / max(np.linalg.norm(back - path[-1]), 1e-9)
        rows = _rows(robot, path[-1], link_distances_at, RETREAT_CLEARANCE)
        move = _move(robot, path[-1], wanted, rows, link_distances_at, RETREAT_CLEARANCE)
        if move @ wanted < 0.5 * STEP**2:
            return np.array(path[:1])
        path.append(np.clip(path[-1] + move, -1.0, 1.0))
    else:
        return np.array(path[:1])
    has_room = link_distances_at(path[-1])[:, 0].min() >= room + MORE_ROOM
    straight = np.linalg.norm(path[0] - arm)
    detour = STEP * (len(path) - 1) + np.linalg.norm(path[-1] - arm)
    is_on_the_way = detour <= DETOUR * straight
    return np.array(path if has_room or is_on_the_way else path[:1])


def _move(robot, state, wanted, rows, link_distances_at, clearance):
    """The move (n,) nearest to the wanted one after which no row is smaller, or all have room."""
    least = np.minimum(rows[:, 0], clearance)
    move = _project(wanted, rows, least)
    # Again with the distances at the end of the step, extrapolated back to its start.
    end = np.clip(state + move, -1.0, 1.0)
    there = _rows(robot, end, link_distances_at, clearance)
    there[:, 0] -= there[:, 1:] @ move
    return _project(wanted, np.concatenate([rows, there]), np.concatenate([least, least]))


def _rows(robot, state, link_distances_at, clearance):
    """Link distances from the scene and, more than `SELF_CLEARANCE` apart, from other links."""
    scene = link_distances_at(state)
    links = self_distances(robot, state, clearance)
    rows = np.concatenate([scene, links]).astype(np.float64)
    rows[len(scene) :, 0] += clearance - SELF_CLEARANCE
    return rows


def _project(move, rows, least):
    """The nearest move (n,) after which no row is below `least`, to first order."""
    moves = move[None].copy()
    rates = np.zeros((1, len(least)))
    rows = np.ascontiguousarray(rows[None])
    project(moves, rows, least[None].copy(), rates, STEP, 1.0, np.inf, np.inf, PROJECTION_SWEEPS)
    return moves[0]


class ApproachPaths:
    """A policy with approach paths, for one episode: a function from an observation to an action.

    The goal's path needs a goal that is a configuration; with other goals, only the start has one.

    Args:
        act: the policy, a function from an observation to an action (n,).
        env: the `RoboArmEnv` of the episode, with link distances.
    """

    def __init__(self, act: Callable[[Observation], np.ndarray], env: RoboArmEnv):
        self._act = act
        self._env = env
        self._at = env.get_wrapper_attr("link_distances_at")
        self._fine_at = env.get_wrapper_attr("fine_link_distances_at")
        self._retreat = None  # a `_Following`, from the first observation on
        self._approach = None  # likewise, if the goal needs one
        self._free_end = {}  # what is observed of the goal until the arm is at its path's free end
        self._retreats = True  # whether the goal's path goes back
        self._steps = 0
        self._planned_for = None  # scene and goal: both may change during an episode

    def __call__(self, observation: Observation) -> np.ndarray:
        state = observation["observation"][: self._env.robot.num_joints].astype(np.float64)
        if self._retreat is None:
            path = approach_path(self._env.robot, state, self._fine_at, START_CLEARANCE)
            self._retreat = _Following(path)
        if "goal_link_distances" in observation:
            self._steps += 1
            if self._steps > GIVE_UP and not self._has_begun():
                self._retreats = False
            planned_for = self._env.scene, observation["desired_goal"].tobytes(), self._retreats
            if planned_for != self._planned_for:
                self._planned_for = planned_for
                self._plan_approach(observation["desired_goal"], state)
        action = self._retreat(state)
        if action is None and self._approach is not None and self._approach.may_begin(state):
            action = self._approach(state)
        return self._act(observation | self._free_end) if action is None else action

    def _has_begun(self):
        return self._approach is not None and self._approach.has_begun

    def _plan_approach(self, goal, arm):
        robot = self._env.robot
        self._approach = None
        self._free_end = {}
        path = approach_path(robot, goal[: robot.num_joints], self._fine_at)
        if self._retreats:
            retreat = retreat_path(robot, path[-1], arm, self._fine_at)
            path = np.concatenate([path, retreat[1:]])
        path = path[::-1]
        if len(path) == 1:
            return
        self._approach = _Following(path, stays=True)
        position = robot.forward_kinematics(robot.denormalise(path[0]))
        free_end = np.concatenate([path[0], position]).astype(np.float32)[: len(goal)]
        self._free_end = {"desired_goal": free_end, "goal_link_distances": self._at(path[0])}


class _Following:
    """Actions along a path (k, n), normalised; at its end None, or if it `stays`, to its end."""

    def __init__(self, path, stays=False):
        self._path = path
        self._stays = stays
        self._due = 0
        self._ended = False

    @property
    def has_begun(self):
        """Whether the arm follows the path, or did."""
        return self._due > 0

    def may_begin(self, state):
        """Whether the arm is at the beginning of the path, or was."""
        return self.has_begun or np.linalg.norm(state - self._path[0]) < REACHED

    def __call__(self, state):
        last = len(self._path) - 1
        if self._due == 0 or np.linalg.norm(state - self._path[self._due]) < TRACKING:
            self._ended = self._ended or (self._due == last and not self._stays)
            self._due = min(self._due + STRIDE, last)
        return None if self._ended else (self._path[self._due] - state).astype(np.float32)
