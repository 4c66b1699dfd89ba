"""Time parameterisation: a joint path in, an executable `JointTrajectory` within limits out.

    path = Planner(env).plan(*query, seed=0)  # float32 (k, n), rad
    trajectory = time_parameterise(path, env.robot, checker=CollisionChecker(query.scene))
    save_trajectory("motion.yaml", trajectory)

Needs the extra `trajectories` (toppra). Four steps:

1. The path is fitted: waypoints within a tenth of `deviation` of the lines between others are left
   out. So a recording with noise, of thousands of points, takes no longer than a clean path.
2. The corners of the path are rounded by parabolas, which leave it by at most `deviation`.
3. TOPP-RA (Pham and Pham, IEEE Transactions on Robotics 34(3), 2018) finds the shortest time along
   the rounded path within the limits of velocity and acceleration.
4. The result, sampled every `step`, becomes the control points of a uniform cubic B-spline.
   Positions, velocities and accelerations of the spline are weighted means of those of step 3, with
   positive weights. So they keep the limits at every time, not only at the samples, and the jerk is
   bounded: by twice the acceleration per `step`. Where the arm's limit of the jerk is lower, the
   control points are averaged first.

Where the rounded path collides, the nearest corners are rounded less, and at last not at all: there
the arm stops at the corner, and is exactly on the path before and after it.
"""

import contextlib
import math
from typing import Literal

import numpy as np

from roboarm_nmp.datasets.recordings import fit_path
from roboarm_nmp.envs.collision.checker import RESOLUTION, CollisionChecker
from roboarm_nmp.envs.robots.robot import DEFAULT_VELOCITY, Robot
from roboarm_nmp.motions.trajectories import JointTrajectory

DEVIATION = 0.1
"""rad: L2 distance in joint space by which rounded corners may leave the path, as in MoveIt's
`TimeOptimalTrajectoryGeneration` (`path_tolerance`)."""
STEP = 0.01  # s
MAX_SAMPLES = 1_000_000
DEFAULT_ACCELERATION = 1.0
"""rad/s^2 (or m/s^2), likewise."""
LIMIT_TOLERANCE = 0.01
"""rad: the simulated arm of an episode exceeds its limits by up to this; it is clipped."""
CHECK_RESOLUTION = RESOLUTION / 16  # of collision checks; the planner's own checks are coarser
GRAZE = 0.001  # m: an additional margin, where the path has it, for what is between two checks
FIT = 1 / 10  # of the deviation: waypoints nearer to the lines between others are left out
STRAIGHT = 1e-4  # rad, likewise without a deviation, or where what is left collides
SHORTEST = 1e-3  # rad: shorter lines between two rounded corners have no cell of their own
SHARPEST = 2 * math.sin(math.radians(75))  # change of direction; at sharper corners the arm stops
SHRINK = 1 / 4  # of a rounding that collides
LEAST = 1 / 20  # share of a rounding; with less, the arm stops at the corner
LINE_CELL = 0.05  # rad, the longest cell of TOPP-RA's grid
LEAST_CELLS = 4  # of each piece


class MissingToppraError(ImportError):
    """toppra is not installed."""


def time_parameterise(
    path: np.ndarray,
    robot: Robot,
    *,
    deviation: float = DEVIATION,
    checker: CollisionChecker | None = None,
    margin: float = 0.0,
    limits: Literal["urdf", "datasheet"] = "urdf",
    velocity: float | np.ndarray | None = None,
    acceleration: float | np.ndarray | None = None,
    jerk: float | np.ndarray | None = None,
    step: float = STEP,
) -> JointTrajectory:
    """Make a trajectory along a path, from rest to rest, as fast as the limits allow.

    Its first and last configuration are the path's. The same arguments give the same trajectory.

    Args:
        path: (k, n), rad, k >= 1: waypoints with straight motions between them, for example of
            `Planner.plan`, or `Trajectory.configurations` of an episode.
        robot: the `Robot`, with n joints.
        deviation: rad, L2: how far the trajectory may be from the path at rounded corners; 0 to
            stop at each corner. Step 4 adds at most acceleration * step^2 / 6 (0.3 mrad).
        checker: a `CollisionChecker` of the scene; None: collisions are not checked.
        margin: m, that the trajectory keeps from the scene and the arm from itself.
        limits: "urdf" or "datasheet": which position limits of the robot hold.
        velocity, acceleration, jerk: a number or (n,), rad/s, rad/s^2, rad/s^3; by default the
            robot's; without them `DEFAULT_VELOCITY`, `DEFAULT_ACCELERATION` and no limit.
        step: s, between two samples, in [0.001, 1], a multiple of 1 ns.

    Raises:
        ValueError: the path has another shape, or leaves the limits; a number is out of its range;
            the path itself collides; the trajectory has more than `MAX_SAMPLES` samples.
        MissingToppraError: toppra is not installed.
    """
    if not 0 <= deviation < math.inf:
        raise ValueError(f"deviation must be 0 or positive, got {deviation!r}")
    if not 0.001 <= step <= 1:
        raise ValueError(f"step must be in [0.001, 1] s, got {step!r}")
    path = _checked_path(path, robot, limits)
    step = round(1e9 * step) / 1e9
    bounds = (
        _bound("velocity", velocity, robot.velocity, DEFAULT_VELOCITY, robot),
        _bound("acceleration", acceleration, robot.acceleration, DEFAULT_ACCELERATION, robot),
        _bound("jerk", jerk, robot.jerk, math.inf, robot),
    )
    exact = Polyline(path, STRAIGHT)
    if len(exact.points) == 1:
        state = np.clip(robot.normalise(path[0]), -1.0, 1.0)
        if checker is not None and not checker.is_free(state, margin=margin):
            raise ValueError("the path itself collides: it is one configuration")
        return _spline(np.repeat(exact.points, 4, axis=0), step, robot, path)
    fitted = Polyline(path, max(STRAIGHT, FIT * deviation))
    deviation = max(0.0, deviation - FIT * deviation)
    margins = (margin,) if checker is None else (margin + GRAZE, margin)
    polylines = (fitted, exact) if len(fitted.points) < len(exact.points) else (exact,)
    attempts = [(polyline, wide) for wide in margins for polyline in polylines]
    for polyline, wide in attempts[:-1]:
        # The path may be nearer than that to obstacles, or need the waypoints that were left out.
        with contextlib.suppress(ValueError):
            return _trajectory(polyline, deviation, bounds, step, robot, path, checker, wide)
    return _trajectory(exact, deviation, bounds, step, robot, path, checker, margin)


def _trajectory(polyline, deviation, bounds, step, robot, path, checker, margin):
    """A `JointTrajectory` whose corners are rounded by `deviation` at most, with a margin."""
    half_widths = polyline.half_widths(deviation)
    if checker is None:
        controls, _ = _controls(polyline, half_widths, bounds, step)
        return _spline(controls, step, robot, path)
    least = LEAST * half_widths
    while True:
        controls, at = _controls(polyline, half_widths, bounds, step)
        trajectory = _spline(controls, step, robot, path)
        states = np.clip(robot.normalise(trajectory.positions), -1.0, 1.0)
        free = checker.is_motion_free(
            states[:-1], states[1:], margin=margin, resolution=CHECK_RESOLUTION
        )
        if free.all():
            return trajectory
        # The motion after sample i depends on these control points, at these places of the path.
        colliding = np.flatnonzero(~free)
        first = at[colliding]
        last = at[colliding + len(at) - len(free)]
        corner = polyline.lengths[1:-1]
        near = (corner + half_widths >= first[:, None]) & (corner - half_widths <= last[:, None])
        near = (near & (half_widths > 0)).any(0)
        if not near.any():
            raise ValueError(
                f"the path itself collides, {first[0]:.3f} rad (L2) after its start, of "
                f"{polyline.lengths[-1]:.3f}; plan it anew, or time it with a smaller margin"
            )
        half_widths = np.where(near, SHRINK * half_widths, half_widths)
        half_widths[half_widths < least] = 0.0


def _checked_path(path, robot, limits):
    """The path, float64 (k, n), inside the limits. Raises ValueError."""
    lower, upper = robot.position_limits(limits)
    path = np.asarray(path, dtype=np.float64)
    if path.ndim != 2 or path.shape[1] != robot.num_joints or not len(path):
        raise ValueError(f"a path has shape (k, {robot.num_joints}), got {path.shape}")
    if not np.isfinite(path).all():
        raise ValueError("the path has joint angles that are not finite")
    beyond = np.maximum(lower - path, path - upper)
    if beyond.max() > LIMIT_TOLERANCE:
        waypoint, joint = np.unravel_index(beyond.argmax(), beyond.shape)
        raise ValueError(
            f"waypoint {waypoint} of the path is outside the {limits} position limits: "
            f"{robot.joint_names[joint]} is {path[waypoint, joint]:.4f}, limits "
            f"{lower[joint]:g} to {upper[joint]:g}"
        )
    return np.clip(path, lower, upper)


def _bound(name, argument, of_robot, default, robot):
    """A limit (n,), float64: the argument, the robot's or the default. Raises ValueError."""
    values = default if of_robot is None else of_robot
    if argument is not None:
        values = argument
    values = np.asarray(values, dtype=np.float64)
    if values.shape not in ((), (robot.num_joints,)) or not (values > 0).all():
        raise ValueError(f"{name} must be positive, a number or ({robot.num_joints},)")
    return np.broadcast_to(values, robot.num_joints)


# --- The geometric path


class Polyline:
    """A path by its length s from the start (rad, L2), as `fit_path` makes it with a tolerance.

    Attributes:
        points: waypoints (k, n), rad.
        lengths: s of each (k,).
        directions: unit vectors (k - 1, n).
    """

    def __init__(self, path: np.ndarray, tolerance: float):
        self.points = fit_path(path, tolerance)
        moves = np.diff(self.points, axis=0)
        sizes = np.linalg.norm(moves, axis=1)
        self.lengths = np.concatenate([[0.0], np.cumsum(sizes)])
        self.directions = moves / sizes[:, None]

    def half_widths(self, deviation: float) -> np.ndarray:
        """Lengths (k - 2,) before and after each corner from which on it is rounded.

        A parabola leaves the corner by a quarter of that, times the change of direction. Neighbours
        share the segment between them.
        """
        turns = np.linalg.norm(np.diff(self.directions, axis=0), axis=1)
        halves = np.diff(self.lengths) / 2
        widths = np.minimum(halves[:-1], halves[1:])
        widths = np.minimum(widths, 4 * deviation / np.maximum(turns, 1e-9))
        return np.where(turns > SHARPEST, 0.0, widths)

    def positions(self, s: np.ndarray, half_widths: np.ndarray) -> np.ndarray:
        """Configurations (m, n), rad, at lengths (m,), corners rounded."""
        widths = np.concatenate([[0.0], half_widths, [0.0]])
        segment = np.searchsorted((self.lengths + widths)[1:-1], s, side="right")
        end = segment + 1
        before = (s - self.lengths[end])[:, None]
        width = widths[end][:, None]
        u = self.directions[segment]
        v = self.directions[np.minimum(end, len(self.directions) - 1)]
        rounded = (width > 0) & (before > -width)
        parabola = v * (width + before) ** 2 - u * (width - before) ** 2
        parabola = parabola / (4 * np.where(rounded, width, 1.0))
        return self.points[end] + np.where(rounded, parabola, u * before)

    def pieces(self, half_widths: np.ndarray) -> list[list[tuple]]:
        """Lines and parabolas, in lists from one stop to the next.

        A piece is (s at its start, s at its end, derivative there and there, second derivative).
        """
        sections = []
        pieces = []
        at = 0.0
        for segment, direction in enumerate(self.directions):
            last = segment == len(self.directions) - 1
            corner = self.lengths[segment + 1]
            width = 0.0 if last else half_widths[segment]
            if corner - width - at > SHORTEST or not (pieces and width):
                pieces.append((at, corner - width, direction, direction, 0.0 * direction))
            if width > 0:
                after = self.directions[segment + 1]
                bend = (after - direction) / (2 * width)
                pieces.append((corner - width, corner + width, direction, after, bend))
            else:
                sections.append(pieces)
                pieces = []
            at = corner + width
        return sections


# --- Times


class _Grid:
    """The pieces of a section on a grid, as toppra asks for a path.

    s is counted from the start of the section, whose length is 1.
    """

    def __init__(self, pieces, cell):
        s = []
        first = []
        second = []
        for start, end, before, after, bend in pieces:
            cells = max(LEAST_CELLS, math.ceil((end - start) / cell))
            share = np.linspace(0.0, 1.0, cells + 1)
            if s:  # second derivatives jump between pieces: a tiny cell, with one on each side
                share[0] = 0.05 * share[1]
            s.append(start + share * (end - start))
            first.append(before + share[:, None] * (after - before))
            second.append(np.broadcast_to(bend, first[-1].shape))
        s = np.concatenate(s)
        self.length = s[-1] - s[0]
        self.s = (s - s[0]) / self.length
        self._derivatives = {1: np.concatenate(first), 2: self.length * np.concatenate(second)}
        self.path_interval = np.array([0.0, 1.0])
        self.dof = first[0].shape[1]

    def __call__(self, s, order=0):
        """The derivative at the grid's points."""
        return self._derivatives[order]


def fastest(
    pieces: list[tuple], velocity: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """TOPP-RA's profile of a section: s (m,), its derivative by time (m,), and times (m,), s.

    The times begin with 0. The arm rests at both ends. Between two points, the second derivative
    of s is constant.
    """
    try:
        import toppra
        from toppra.algorithm import TOPPRA
        from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint
    except ImportError as error:
        raise MissingToppraError(
            f"time parameterisation needs toppra: pip install 'roboarm-nmp[trajectories]' ({error})"
        ) from error
    toppra.setup_logging("ERROR")
    grid = _Grid(pieces, LINE_CELL)
    # Its tolerances are absolute: lengths are in units of the section's, and times so that
    # accelerations stay what they are.
    unit = math.sqrt(grid.length)
    constraints = [
        JointVelocityConstraint(np.stack([-velocity, velocity], axis=1) / unit),
        JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1)),
    ]
    problem = TOPPRA(constraints, grid, gridpoints=grid.s, solver_wrapper="seidel")
    speeds = problem.compute_parameterization(0.0, 0.0)[1]
    if speeds is None or not np.isfinite(speeds).all():
        raise ValueError("TOPP-RA finds no parameterisation: the path has motions that are tiny")
    durations = unit * 2 * np.diff(grid.s) / (speeds[:-1] + speeds[1:])
    s = pieces[0][0] + grid.length * grid.s
    return s, unit * speeds, np.concatenate([[0.0], np.cumsum(durations)])


def _controls(polyline, half_widths, bounds, step):
    """Control points (m, n), rad, of a spline within the bounds, and the s of each (m,)."""
    velocity, acceleration, jerk = bounds
    sections = [fastest(p, velocity, acceleration) for p in polyline.pieces(half_widths)]
    # The mean over so many control points bounds the jerk.
    width = max(1, math.ceil((2 * acceleration / (jerk * step)).max() - 1e-9))
    stretch = 1.0
    while True:
        at = [np.zeros(width + 1)]
        for s, speeds, times in sections:
            samples = max(1, math.ceil(times[-1] * stretch / step))
            if samples > MAX_SAMPLES:
                raise ValueError(f"the trajectory has more than {MAX_SAMPLES:,} samples")
            at.append(_s_at(np.linspace(0.0, times[-1], samples + 1)[:-1], s, speeds, times))
            at.append(np.full(width + 1, s[-1]))  # so the spline is at rest exactly there
        at.append(at[-1][-1:])
        at = np.concatenate(at)
        controls = polyline.positions(at, half_widths)
        if width > 1:
            windows = np.lib.stride_tricks.sliding_window_view(controls, width, axis=0)
            controls = windows.mean(-1)
        excess = max(
            (np.abs(np.diff(controls, order, axis=0)) / (step**order * bound)).max() ** (1 / order)
            for order, bound in enumerate(bounds, start=1)
        )
        if excess <= 1.0:
            return controls, at
        # Between the points of TOPP-RA's grid, velocities exceed the limits by a fraction.
        stretch *= excess * (1 + 1e-4)


def _s_at(times, s, speeds, grid_times):
    """s (m,) at times (m,)."""
    cell = np.clip(np.searchsorted(grid_times, times, side="right") - 1, 0, len(s) - 2)
    passed = times - grid_times[cell]
    change = (speeds[cell + 1] - speeds[cell]) / np.diff(grid_times)[cell]
    return np.clip(s[cell] + passed * (speeds[cell] + passed * change / 2), s[0], s[-1])


def _spline(controls, step, robot, path):
    """The `JointTrajectory` of control points (m, n)."""
    before = controls[:-2]
    here = controls[1:-1]
    after = controls[2:]
    positions = np.clip((before + 4 * here + after) / 6, path.min(0), path.max(0))  # rounding
    positions[0], positions[-1] = path[0], path[-1]
    nanoseconds = np.arange(len(here)) * round(1e9 * step)  # times that files have exactly
    return JointTrajectory(
        times=nanoseconds / 1e9,
        positions=positions,
        velocities=(after - before) / (2 * step),
        accelerations=(before - 2 * here + after) / step**2,
        robot=robot,
    )
