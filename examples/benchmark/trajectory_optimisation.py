"""An entry to the benchmark: a path is optimised as a whole, as by CHOMP (Zucker et al., 2013).

    roboarm benchmark run --function trajectory_optimisation:begin --observes ground_truth \
        --searches --output entry

Smoothness and the obstacle cost of the whole path are minimised with SciPy's L-BFGS-B, first from
the straight line, then from bent ones, until a path is free. Run the command in this folder.
"""

import time

import numpy as np
from scipy.optimize import minimize

from roboarm_nmp.envs.collision.checker import CollisionChecker

SECONDS = 1.0  # of processor time, after which no other path is begun
STATES = 24  # between start and goal
REACH = 0.05  # m: nearer obstacles cost
MARGIN = 0.003  # m, which absorbs most of the arm's lag behind its targets
WEIGHT = 20.0  # of the obstacles
ITERATIONS = 60


def begin(problem):
    robot = problem.robot
    checker = CollisionChecker(problem.scene)
    ends = np.clip(robot.normalise(np.stack([problem.start, problem.goal])), -1.0, 1.0)
    near = checker.end_distances(ends, 2 * MARGIN)[0] - 1e-4
    margins = (ends, near, 0.03)  # smaller ones near a start or goal that is near an obstacle
    shares = np.linspace(0.0, 1.0, STATES + 2)[:, None]
    line = ends[0] + shares * (ends[1] - ends[0])
    rng = np.random.default_rng([problem.seed, problem.number])
    deadline = time.process_time() + SECONDS
    bend = np.zeros(robot.num_joints)
    while True:
        first = np.clip(line + np.sin(np.pi * shares) * bend, -1.0, 1.0)
        path = optimised(first, checker)
        if checker.is_motion_free(path[:-1], path[1:], MARGIN, endpoint_margins=margins).all():
            break
        if time.process_time() > deadline:
            break  # the last one has to do
        bend = rng.normal(0.0, 0.4, robot.num_joints)
    return robot.denormalise(path)


def optimised(path, checker):
    """A path (k, n), normalised, of less cost; its ends stay."""

    def cost(inner):
        path[1:-1] = inner.reshape(STATES, -1)
        steps = np.diff(path, axis=0)
        gradient = -2.0 * np.diff(steps, axis=0) * STATES
        links = checker.link_distances(path[1:-1], self_collisions=True, within=REACH)
        depth = REACH - links[..., :1]  # (k, links, 1), m
        obstacles = WEIGHT * (depth**2).sum() / REACH**2
        gradient -= 2.0 * WEIGHT * (depth * links[..., 1:]).sum(axis=1) / REACH**2
        return (steps**2).sum() * STATES + obstacles, gradient.ravel()

    options = {"maxiter": ITERATIONS}
    result = minimize(
        cost, path[1:-1].ravel(), jac=True, method="L-BFGS-B", options=options,
        bounds=[(-1.0, 1.0)] * path[1:-1].size,
    )  # fmt: skip
    path[1:-1] = result.x.reshape(STATES, -1)
    return path
