"""Demonstrations of motions that others have made: by a person, by cuRobo, in another simulator.

    recordings = [Recording(positions, times) for positions, times in my_data]  # rad, s
    refused = write_demonstrations("teleop.h5", recordings, "wall")
    for name, reason in refused:
        print(name, reason)

A recording is a path of joint angles at any rate. `fit_path` takes the noise out of it, the
simulated arm follows it at the pace of the environment (`envs.following`), and what it does there
is the demonstration. So its states and actions are those of the MDP, and its file is like that of
planned ones.
"""

import contextlib
import operator
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roboarm_nmp.datasets.demonstrations import write_demos
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.problem_formats import Rejected
from roboarm_nmp.datasets.queries import query_keys, query_path, validate
from roboarm_nmp.envs import make
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.following import Execution, follow
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.tasks import get_task
from roboarm_nmp.utils import workers
from roboarm_nmp.utils.progress import progress_bar, write_line

TOLERANCES = (0.01, 0.003)
"""rad, L2: how far the path that is followed may be from the recording. The second is tried where
the simulated arm touches something or misses the goal with the first."""
BEYOND_LIMITS = 0.01  # rad, which a noisy recording of an arm at a limit may exceed it by
SPEED_SECONDS = 0.1  # over which speeds are measured, so that noise is none
SPEED_FACTOR = 1.5  # times the robot's limit: faster is a jump in the data, or another unit
SHORTEST = 1e-6  # rad: waypoints nearer than that are one


@dataclass(frozen=True, eq=False)
class Recording:
    """One motion of an arm with n joints, from a start to a goal.

    Attributes:
        positions: (m, n), rad (or m): the joints at m times.
        times: (m,), s, increasing, at any rate; None where they are unknown. The demonstration has
            the environment's pace, so they serve to find jumps in the data.
        goal: (n,), rad: the configuration that the motion was for; by default its last one.
        actions: (m, n), rad: the configurations that were commanded, where they are known. Then
            the simulated arm follows these, and the positions where that does not work.
        scene: the `Scene`, where a task's scenes vary.
        name: for messages; by default its number.
    """

    positions: np.ndarray
    times: np.ndarray | None = None
    goal: np.ndarray | None = None
    actions: np.ndarray | None = None
    scene: Scene | None = None
    name: str = ""


def fit_path(path: np.ndarray, tolerance: float) -> np.ndarray:
    """The fewest waypoints (k, n) of a path (m, n), in its order, that it is near, all in rad.

    No waypoint is farther than `tolerance` (L2) from the straight lines between those that are
    kept, or goes back along them by more. So noise below the tolerance vanishes. The first and the
    last one are kept. (Douglas and Peucker, 1973.)
    """
    moved = np.linalg.norm(np.diff(path, axis=0), axis=1) > SHORTEST
    path = path[np.concatenate([[True], moved])]
    keep = np.zeros(len(path), dtype=bool)
    keep[[0, -1]] = True
    stack = [(0, len(path) - 1)]
    while stack:
        first, last = stack.pop()
        inner = path[first + 1 : last] - path[first]
        chord = path[last] - path[first]
        if not len(inner):
            continue
        length = max(np.linalg.norm(chord), SHORTEST)
        along = np.clip(inner @ chord / length, 0.0, length)
        misses = np.linalg.norm(inner - along[:, None] / length * chord, axis=1)
        back = np.maximum.accumulate(along) - along
        # A path that returns to where it was keeps a waypoint, however near.
        if max(misses.max(), back.max()) > tolerance or length == SHORTEST:
            worst = back if back.max() > tolerance >= misses.max() else misses
            middle = first + 1 + int(worst.argmax())
            keep[middle] = True
            stack += [(first, middle), (middle, last)]
    return path[keep]


class Refused(ValueError):
    """A recording that is no demonstration. The message is the reason."""


class Replayer:
    """Makes demonstrations of recordings: a function from (number, `Recording`) to a result.

    That is (number, waypoints, `Execution`), or (number, the reason why there is none, None).
    """

    def __init__(self, task: str, allow_collisions: bool):
        self.env: RoboArmEnv = make(task)
        self.allow_collisions = allow_collisions

    def __call__(
        self, job: tuple[int, Recording]
    ) -> tuple[int, np.ndarray | str, Execution | None]:
        number, recording = job
        try:
            path, execution = self._demonstration(recording)
        except Refused as error:
            return number, str(error), None
        return number, path, execution

    def _demonstration(self, recording):
        """(waypoints float32 (k, n), `Execution`). Raises Refused."""
        env = self.env
        if env.scene_distribution is None:
            if recording.scene not in (None, env.scene):
                raise Refused("its scene differs from the task's, which is fixed")
        elif recording.scene is None:
            raise Refused("has no scene, and the scenes of this task vary")
        else:
            try:
                env.set_scene(recording.scene)
            except ValueError as error:
                raise Refused(str(error)) from error
        paths = checked_paths(recording, env.robot, env.config_tolerance)
        reason = ""
        for path in paths:
            for tolerance in TOLERANCES:
                waypoints = _inside(fit_path(path, tolerance), env.robot)
                try:
                    execution = follow(env, waypoints)
                except ValueError as error:  # start or goal is in collision
                    raise Refused(str(error)) from error
                obstruction = self._obstruction(execution)
                if obstruction is None:
                    return waypoints, execution
                reason = reason or obstruction
        raise Refused(reason)

    def _obstruction(self, execution):
        """Why an execution is no demonstration, in words; None if it is one."""
        steps = len(execution.states) - 1
        if execution.collided and not self.allow_collisions:
            return f"contact in the simulation: {self._contact(execution)}"
        if not execution.reached:
            return "the simulated arm does not reach the goal"
        if steps > self.env.horizon:
            return f"takes {steps} steps, and an episode has {self.env.horizon}"
        return None

    def _contact(self, execution):
        """The first contact of an execution, in words."""
        angles = self.env.robot.denormalise(execution.states)
        for step, configuration in enumerate(angles):
            if self.env.in_collision(configuration.tolist()):
                return f"{self.env.world.contact_names()}, in step {step} of {len(angles) - 1}"
        return "between two steps"


def _inside(path, robot):
    """A path as float32, inside the limits in spite of rounding."""
    low = np.nextafter(robot.lower.astype(np.float32), np.float32(np.inf))
    high = np.nextafter(robot.upper.astype(np.float32), np.float32(-np.inf))
    return np.clip(path.astype(np.float32), low, high)


def checked_paths(recording: Recording, robot: Robot, goal_tolerance: float) -> list[np.ndarray]:
    """The paths that may be followed, the best one first: float64 (k, n), rad, inside the limits.

    Args:
        recording: of `robot`.
        goal_tolerance: L2, normalised: how far a motion may end from its goal.

    Raises:
        Refused: it cannot be a demonstration; the message says why.
    """
    positions = _rows("positions", recording.positions, robot)
    if len(positions) < 2:
        raise Refused("has one configuration, and a motion has at least two")
    seconds = None
    if recording.times is not None:
        seconds = np.asarray(recording.times, dtype=np.float64)
        if seconds.shape != (len(positions),) or not (np.diff(seconds) > 0).all():
            raise Refused(f"times must be {len(positions)} numbers that increase")
    _check_limits("positions", positions, robot)
    if seconds is not None and robot.velocity is not None:
        _check_speeds(positions, seconds, robot)
    goal = positions[-1]
    if recording.goal is not None:
        goal = _rows("goal", np.atleast_2d(recording.goal), robot)[0]
        _check_limits("goal", goal[None], robot)
    ends = robot.normalise(np.stack([positions[0], positions[-1], goal]))
    if np.linalg.norm(ends[1] - ends[2]) > goal_tolerance:
        raise Refused(
            f"ends {np.linalg.norm(ends[1] - ends[2]):.2f} (L2, normalised) from its goal: more "
            f"than {goal_tolerance:g}"
        )
    if np.linalg.norm(ends[0] - ends[2]) <= goal_tolerance:
        raise Refused("its goal is where it starts: split it where it reaches something")
    paths = [positions]
    if recording.actions is not None:
        actions = _rows("actions", recording.actions, robot)
        if len(actions) != len(positions):
            raise Refused(f"has {len(positions)} positions and {len(actions)} actions")
        _check_limits("actions", actions, robot)
        paths.insert(0, np.concatenate([positions[:1], actions]))
    return [np.clip(np.concatenate([path, goal[None]]), robot.lower, robot.upper) for path in paths]


def _rows(name, values, robot):
    """Numbers (m, n), float64. Raises Refused."""
    try:
        rows = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise Refused(f"{name} are no array of numbers: {error}") from error
    if rows.ndim != 2 or rows.shape[1] != robot.num_joints or not len(rows):
        raise Refused(f"{name} must have shape (m, {robot.num_joints}), got {rows.shape}")
    if not np.isfinite(rows).all():
        raise Refused(f"{name}[{np.argmin(np.isfinite(rows).all(1))}] is not finite")
    return rows


def _check_limits(name, rows, robot):
    beyond = np.maximum(robot.lower - rows, rows - robot.upper)
    if beyond.max() > BEYOND_LIMITS:
        row, joint = np.unravel_index(beyond.argmax(), beyond.shape)
        hint = ": are they in degrees?" if np.abs(rows).max() > 4 * np.pi else ""
        raise Refused(
            f"{name}[{row}] is outside the limits by {beyond[row, joint]:.3f} rad: "
            f"{robot.joint_names[joint]}{hint}"
        )


def _check_speeds(positions, seconds, robot):
    """Raise Refused for a jump."""
    ticks = np.arange(seconds[0], seconds[-1] + SPEED_SECONDS, SPEED_SECONDS)
    sampled = np.stack([np.interp(ticks, seconds, joint) for joint in positions.T], axis=1)
    speeds = np.abs(np.diff(sampled, axis=0)) / SPEED_SECONDS
    excess = speeds / robot.velocity
    if len(speeds) and excess.max() > SPEED_FACTOR:
        row, joint = np.unravel_index(excess.argmax(), excess.shape)
        raise Refused(
            f"{robot.joint_names[joint]} moves at {speeds[row, joint]:.1f} rad/s (its limit is "
            f"{robot.velocity[joint]:.2f}) at {ticks[row]:.2f} s: a jump, or times in another unit"
        )


def _replayed(task, motions, allow_collisions, num_workers, progress):
    """The results of `Replayer` without their numbers, in the order of the motions."""
    jobs = list(enumerate(motions))
    with contextlib.ExitStack() as stack:
        if num_workers == 1:
            replayer = Replayer(task, allow_collisions)
            stack.callback(replayer.env.close)
            results = map(replayer, jobs)
        else:
            arguments = (task, allow_collisions)
            results = workers.run(Replayer, arguments, jobs, num_workers, write_line)
            stack.enter_context(contextlib.closing(results))
        bar = progress_bar(results, "replay", len(jobs), unit="motion", disable=not progress)
        return [result[1:] for result in sorted(bar, key=operator.itemgetter(0))]


def _evaluated(task):
    """Query (bytes, of `query_keys`) -> why it is in no demonstration."""
    taken = {}
    if query_path(task).exists():
        for split, queries in validate(query_path(task), task).items():
            for key in query_keys(queries.start, queries.goal):
                taken[key] = f"its start and goal are a {split} query of {task}"
    return taken


def write_demonstrations(
    path: str | Path,
    recordings: Iterable[Recording | np.ndarray],
    task: str | Path,
    robot: str | Path | None = None,
    *,
    allow_collisions: bool = False,
    made_by: str = "write_demonstrations",
    num_workers: int = 1,
    progress: bool = False,
) -> list[Rejected]:
    """Write a demonstration file of recorded motions, atomically; an existing one is replaced.

    The simulated arm follows every motion. Motions that reach the goal without contact are written.

    Args:
        path: the file.
        recordings: `Recording`s, or arrays (m, n) of joint angles, rad.
        task: name of a task, path of a scene file (`envs.scenes.files.save_scene` writes one), or
            `TASK@ROBOT`.
        robot: a robot's file, in place of `TASK@ROBOT`.
        allow_collisions: also write motions with contact, which the file marks.
        made_by: the command line that makes this file.
        num_workers: processes.
        progress: show a progress bar.

    Returns:
        the recordings that were refused: their names (by default, numbers), and why.

    Raises:
        DatasetError: none of them can be a demonstration. Nothing is written then.
        ValueError: unknown task.
        OSError: the file cannot be written; an old file stays as it is.
    """
    task = f"{task}@{robot}" if robot is not None else str(task)
    motions = [
        motion if isinstance(motion, Recording) else Recording(motion) for motion in recordings
    ]
    results = _replayed(task, motions, allow_collisions, num_workers, progress)
    taken = _evaluated(task)
    kept: list[tuple[np.ndarray, Execution, Recording]] = []
    refused = []
    for number, (motion, (waypoints, execution)) in enumerate(zip(motions, results, strict=True)):
        name = motion.name or str(number)
        if execution is None:
            refused.append(Rejected(name, waypoints))  # the reason
            continue
        (key,) = query_keys(waypoints[:1], waypoints[-1:])
        if key in taken:
            refused.append(Rejected(name, taken[key]))
        else:
            taken[key] = f"has the start and goal of recording {name}"
            kept.append((waypoints, execution, motion))
    if not kept:
        first = f": {refused[0].reason}" if refused else ""
        raise DatasetError(f"{path}: no recording can be used, of {len(motions)}{first}")
    executions = [execution for _, execution, _ in kept]
    scenes = None
    if not isinstance(get_task(task).scene, Scene):
        scenes = [motion.scene for _, _, motion in kept if motion.scene is not None]
    write_demos(
        path,
        task,
        0,
        [waypoints for waypoints, _, _ in kept],
        [execution.states for execution in executions],
        {
            "plan_seed": [0] * len(kept),
            "digest": [execution.digest for execution in executions],
            "collided": [execution.collided for execution in executions],
        },
        made_by=made_by,
        parameters={
            "options": {"allow_collisions": allow_collisions},
            "counts": {"refused": len(refused)},
        },
        scenes_of=scenes,
    )
    return refused
