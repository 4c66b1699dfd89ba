"""Executable trajectories of plans: limits, collisions, duration, and time to make them.

    pip install -c constraints.txt -e ".[trajectories]"
    python benchmarks/trajectories.py    # 1,000 plans of random_boxes_hard's validation queries

Plans are those of `Planner` with its defaults, several per query, each of its own seed. A
trajectory violates a limit if a position, velocity, acceleration or jerk exceeds it by more than
1e-6 of it, at the samples or every millisecond. It collides if `CollisionChecker` says so at one
of the points every millisecond, or PyBullet at one of the samples. Its optimum is TOPP-RA's for the
same geometric path: a spline through points of the trajectory, 5 mrad apart, from stop to stop,
with the same limits of velocity and acceleration, on a grid of 1,000 points and more.
Milliseconds are the process's own, collision checks included. The last line is JSON.
"""

import argparse
import json
import os
import platform
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from roboarm_nmp import envs
from roboarm_nmp.utils.progress import progress_bar

MILLISECOND, SPACING = 0.001, 0.005
TOLERANCE = 1e-6


def optimum(trajectory, robot):
    """TOPP-RA's duration, s, of the trajectory's geometric path, and the number of its stops."""
    import toppra
    from toppra.algorithm import TOPPRA
    from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint

    toppra.setup_logging("ERROR")
    still = ~np.abs(trajectory.velocities).any(axis=1)
    starts = np.flatnonzero(still[:-1] & ~still[1:])
    ends = np.flatnonzero(~still[:-1] & still[1:]) + 1
    constraints = [
        JointVelocityConstraint(np.stack([-robot.velocity, robot.velocity], axis=1)),
        JointAccelerationConstraint(np.stack([-robot.acceleration, robot.acceleration], axis=1)),
    ]
    total = 0.0
    for start, end in zip(trajectory.times[starts], trajectory.times[ends], strict=True):
        points = trajectory.at(np.linspace(start, end, int((end - start) / 0.0001) + 2))
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        at = np.linspace(0.0, s[-1], max(5, int(s[-1] / SPACING)))
        spline = np.stack([np.interp(at, s, joint) for joint in points.T], axis=1)
        path = toppra.SplineInterpolator(at, spline)
        grid = np.linspace(0.0, s[-1], max(1001, len(at)))
        problem = TOPPRA(constraints, path, gridpoints=grid, solver_wrapper="seidel")
        _, speeds, _ = problem.compute_parameterization(0.0, 0.0)
        total += (2 * np.diff(grid) / (speeds[:-1] + speeds[1:])).sum()
    return total, len(starts) - 1


def violations(trajectory, limits):
    """Whether a position, velocity, acceleration or jerk exceeds its limit: four bools."""
    robot, step = trajectory.robot, trajectory.times[1]
    fine = trajectory.at(np.arange(0, trajectory.duration, MILLISECOND))
    lower, upper = robot.position_limits(limits)
    outside = (fine < lower - TOLERANCE) | (fine > upper + TOLERANCE)
    jerk = np.diff(trajectory.accelerations, axis=0) / step
    values = [
        (np.diff(fine, axis=0) / MILLISECOND, robot.velocity),
        (trajectory.velocities, robot.velocity),
        # Between samples accelerations are linear: they are largest at the samples.
        (trajectory.accelerations, robot.acceleration),
        (jerk, robot.jerk),
    ]
    fast, fast_between, sharp, jerky = (
        (np.abs(found) > limit * (1 + TOLERANCE)).any() for found, limit in values
    )
    return outside.any(), fast or fast_between, sharp, jerky


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="random_boxes_hard", choices=list(envs.TASKS))
    parser.add_argument("--num", type=int, default=1000, help="plans (1,000)")
    parser.add_argument("--limits", default="urdf", choices=["urdf", "datasheet"])
    args = parser.parse_args()
    if args.num < 1:
        parser.error("--num must be at least 1")
    # Here, so that --help does not wait for OMPL and Numba.
    from roboarm_nmp.datasets.queries import load_queries
    from roboarm_nmp.envs.collision.checker import CollisionChecker
    from roboarm_nmp.motions.time_parameterisation import time_parameterise
    from roboarm_nmp.planning.planner import Planner, PlanningError

    env = envs.make(args.task)
    planner, robot, queries = Planner(env), env.robot, load_queries(args.task, "validation")
    checker = CollisionChecker(queries[0].scene)
    time_parameterise([robot.contact_free, robot.observed_pose], robot)  # imports
    checker.is_motion_free(np.zeros((1, 7)), np.zeros((1, 7)))  # compiles
    counts = dict.fromkeys(["plans", "no plan", "refused", "timed", "stops", "with stops"], 0)
    counts |= dict.fromkeys(["position", "velocity", "acceleration", "jerk", "collides"], 0)
    ratios, milliseconds, durations, exact, clearances = [], [], [], [], []
    for number in progress_bar(range(args.num), "trajectories", unit="plan"):
        query = queries[number % len(queries)]
        try:
            plan = planner.plan(*query, seed=number)
        except PlanningError:
            counts["no plan"] += 1
            continue
        counts["plans"] += 1
        checker = CollisionChecker(query.scene)
        began = time.process_time()
        try:
            trajectory = time_parameterise(plan, robot, checker=checker, limits=args.limits)
        except ValueError as error:
            counts["refused"] += 1
            print(f"plan {number}: {error}", flush=True)
            continue
        milliseconds.append(1000 * (time.process_time() - began))
        counts["timed"] += 1
        found = violations(trajectory, args.limits)
        for name, violated in zip(
            ("position", "velocity", "acceleration", "jerk"), found, strict=True
        ):
            counts[name] += bool(violated)
        fine = trajectory.at(np.arange(0, trajectory.duration, MILLISECOND))
        states = np.clip(robot.normalise(fine), -1.0, 1.0)
        collides = not checker.is_free(states).all()
        env.set_scene(query.scene)
        collides = collides or any(map(env.in_collision, trajectory.positions))
        counts["collides"] += collides
        clearances.append(checker.signed_distances(states[::10]).distance.min())
        best, stops = optimum(trajectory, robot)
        counts["stops"] += stops
        counts["with stops"] += stops > 0
        ratios.append(trajectory.duration / best)
        durations.append(trajectory.duration)
        stopping = time_parameterise(plan, robot, deviation=0.0, limits=args.limits)
        exact.append(stopping.duration)
    result = counts | {"task": args.task, "limits": args.limits}
    result |= {
        "duration over optimum": [
            float(f(ratios)) for f in (np.mean, np.median, lambda x: np.quantile(x, 0.99), np.max)
        ],
        "mean duration": float(np.mean(durations)),
        "mean duration with a stop at each corner": float(np.mean(exact)),
        "ms per trajectory": [
            float(f(milliseconds)) for f in (np.mean, np.median, lambda x: np.quantile(x, 0.95))
        ],
        "smallest clearance (m)": float(np.min(clearances)),
        "machine": platform.processor() or platform.machine(),
    }
    for name, value in result.items():
        print(f"{name:<44}{value}")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
