"""Sub-goals: the points of a plan that are commanded one by one, one per environment step."""

import numpy as np
from numpy.typing import ArrayLike

from roboarm_nmp.envs.robots.robot import Robot

# With this spacing, the controller's lag seldom makes a step longer than the paper's 0.03, to which
# it is clipped.
MAX_STEP = 0.03
SUBGOAL_SPACING = 0.95 * MAX_STEP


def subgoals(path: ArrayLike, robot: Robot) -> np.ndarray:
    """Points along a path at most `SUBGOAL_SPACING` apart, including all waypoints.

    Near waypoints they are closer, if the robot has `acceleration_steps`.

    Args:
        path: (k, n), rad.
        robot: the `Robot`, with n joints.

    Returns:
        float64 (m, n), normalised; the first is the path's start, the last its goal.
    """
    path = np.asarray(path)
    return all_subgoals(path, np.array([0, len(path)]), robot)[0]


def all_subgoals(
    plan: np.ndarray, plan_offsets: np.ndarray, robot: Robot
) -> tuple[np.ndarray, np.ndarray]:
    """The sub-goals of all plans (k, n), and the offset of each plan's first sub-goal (n + 1,)."""
    waypoints = robot.normalise(plan.astype(np.float64))
    moves = np.diff(waypoints, axis=0)
    lengths = np.sqrt(np.square(moves).sum(1)) / SUBGOAL_SPACING
    n = robot.acceleration_steps
    # How far 1, 2, ... steps lead at most, with lengths of 1/n, 2/n, ..., 1, 1, ..., 2/n, 1/n.
    steps = np.arange(2, 2 * n + 3 + int(lengths.max(initial=0.0)))
    reach = np.cumsum(np.minimum(steps // 2, n)) / n
    steps = np.searchsorted(reach, lengths) + 1
    steps[plan_offsets[1:-1] - 1] = 1  # from the end of a plan to the start of the next
    move = np.repeat(np.arange(len(moves)), steps)
    first = np.concatenate([[0], np.cumsum(steps)])  # sub-goals before each waypoint
    number = np.arange(len(move)) - first[move]
    length = np.minimum(np.minimum(number + 1, steps[move] - number), n)
    done = np.concatenate([[0], np.cumsum(length)])
    share = (done[1:] - done[first[move]]) / (done[first[move + 1]] - done[first[move]])
    points = np.concatenate([waypoints[:1], waypoints[move] + moves[move] * share[:, None]])
    return points, np.concatenate([first[plan_offsets[:-1]], [len(points)]])


def schedule(
    plan: np.ndarray, plan_offsets: np.ndarray, offsets: np.ndarray, robot: Robot
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each executed configuration the previous, the due and the next sub-goal, each (m, n).

    Before the first sub-goal and after the last, these are repeated.
    """
    points, first = all_subgoals(plan, plan_offsets, robot)
    demo = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    step = np.arange(offsets[-1]) - offsets[demo]
    here = first[demo] + step
    low = first[demo]
    high = first[demo + 1] - 1
    previous = points[np.clip(here - 1, low, high)]
    due = points[np.clip(here, low, high)]
    following = points[np.clip(here + 1, low, high)]
    return previous, due, following
