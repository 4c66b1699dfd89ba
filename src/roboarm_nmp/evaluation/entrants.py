"""Methods from outside, as policies: a Python function, or a program in any language.

    method = FunctionMethod("my_planner:plan", observes="point_cloud")
    method = ProgramMethod("./my_planner --fast", observes="ground_truth")
    roboarm_nmp.evaluate(method, "random_boxes_hard", num_queries=50)

Both receive a `Problem` at the start of each episode, with as much of the scene as the method
observes. A function returns a policy, a joint path, or None where it gives up. A program speaks
JSON, a line each (docs/benchmark/enter.md). A joint path is followed with one sub-goal per step.
"""

import contextlib
import json
import os
import pkgutil
import select
import shlex
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.perception.point_clouds import observed_points
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.files import obstacle_entry
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.policies.baselines import follow_path
from roboarm_nmp.policies.policy import BeginEpisode, EpisodePolicy, Method
from roboarm_nmp.policies.pose_goals import observed_at_start
from roboarm_nmp.utils.progress import write_line

Observes = Literal["nothing", "point_cloud", "ground_truth"]
MAX_LINE = 10_000_000  # bytes of a program's answer
MAX_WAYPOINTS = 10_000
BEYOND_LIMITS = 0.01  # rad, of a waypoint: rounding, and what the arm is held back from
PATIENCE = 30.0  # s, until a program's silence is mentioned


class EntrantError(ValueError):
    """A method that cannot be started, or that gave an answer that is none."""


@dataclass(frozen=True)
class Problem:
    """What a method is given at the start of an episode. Of an arm with n joints:

    Attributes:
        number: of the query, from 0 on.
        start, goal: joint angles (n,), rad.
        goal_pose: of the end effector at the goal: position (m) and quaternion (x, y, z, w), (7,).
        robot: the `Robot`.
        scene: the `Scene` if the method observes the ground truth, otherwise None.
        points: float32 (m, 3), m, in the base's frame, observed by four depth cameras, if the
            method observes a point cloud, otherwise None.
        seed: of random numbers.
    """

    number: int
    start: np.ndarray
    goal: np.ndarray
    goal_pose: np.ndarray
    robot: Robot
    scene: Scene | None
    points: np.ndarray | None
    seed: int


def _problem(env: RoboArmEnv, number: int, query: Query, observes: str, seed: int) -> Problem:
    observed = observed_at_start(env, query)
    return Problem(
        number=number,
        start=np.array(query.start, np.float64),
        goal=np.array(query.goal, np.float64),
        goal_pose=env.robot.end_effector_pose(query.goal),
        robot=env.robot,
        scene=observed if observes == "ground_truth" else None,
        points=observed_points(observed) if observes == "point_cloud" else None,
        seed=seed,
    )


class FunctionMethod(Method):
    """A Python function, called with the `Problem` of each episode.

    Args:
        name: MODULE:FUNCTION. The module is imported from the current folder, too.
        observes: what the `Problem` has of the scene.

    Raises:
        EntrantError: there is no such function.
    """

    def __init__(self, name: str, observes: Observes = "nothing"):
        self.name = name
        self.observes = observes
        self._function()

    def __str__(self) -> str:
        return self.name

    def _function(self) -> Any:
        if str(Path.cwd()) not in sys.path:
            sys.path.insert(0, str(Path.cwd()))
        try:
            return pkgutil.resolve_name(self.name)
        except (ImportError, AttributeError, ValueError) as error:
            raise EntrantError(
                f"{self.name}: {error}; expected MODULE:FUNCTION, importable from here"
            ) from error

    def begin(self, env: RoboArmEnv, seed: int) -> BeginEpisode:
        """As of `Method`."""
        function = self._function()

        def begin_function(number: int, query: Query) -> EpisodePolicy:
            answer: Any = function(_problem(env, number, query, self.observes, seed))
            if answer is None:
                return EpisodePolicy(None, plan_found=False)
            if not isinstance(answer, (np.ndarray, list)):
                return EpisodePolicy(answer)
            path = _checked_path(answer, env.robot, self.name)
            return EpisodePolicy(follow_path(path, env.robot), True)

        return begin_function


class ProgramMethod(Method):
    """A program that reads and writes JSON, a line each, on its standard input and output.

    Args:
        command: the command line; each process of an evaluation starts it once.
        observes: what the program is given of the scene.
    """

    def __init__(self, command: str, observes: Observes = "nothing"):
        self.command = command
        self.observes = observes

    def __str__(self) -> str:
        return self.command

    def begin(self, env: RoboArmEnv, seed: int) -> BeginEpisode:
        """As of `Method`. Raises EntrantError: the program cannot be started."""
        program = _Program(self.command)
        joints = env.robot.num_joints

        def act(observation: Any) -> np.ndarray:
            arrays = {name: array.tolist() for name, array in observation.items()}
            answer = program.ask({"observation": arrays})
            return _numbers(answer.get("action"), joints, f"{self.command}: action")

        def begin_program(number: int, query: Query) -> EpisodePolicy:
            problem = _problem(env, number, query, self.observes, seed)
            answer = program.ask(_message(problem))
            if answer == {}:
                return EpisodePolicy(act)
            if "path" not in answer:
                raise EntrantError(
                    f"{self.command}: its answer to a problem has {', '.join(answer)}, must have "
                    "`path`, or be {} to act step by step"
                )
            if answer["path"] is None:
                return EpisodePolicy(None, plan_found=False)
            path = _checked_path(answer["path"], env.robot, self.command)
            return EpisodePolicy(follow_path(path, env.robot))

        return begin_program


class _Program:
    """A running program, which answers each line with a line. Raises EntrantError if it doesn't."""

    def __init__(self, command: str):
        self.command = command
        self.is_patient = True
        try:
            self.process: Any = subprocess.Popen(
                shlex.split(command), bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
        except (OSError, ValueError) as error:
            raise EntrantError(f"{command}: cannot be started: {error}") from error

    def ask(self, message: dict[str, Any]) -> dict[str, Any]:
        """Its answer to a message."""
        if select.select([self.process.stdout], [], [], 0.0)[0]:
            self._check_end(self._read())
        try:
            self.process.stdin.write(json.dumps(message).encode() + b"\n")
        except OSError:
            self._fail_ended()
        line = b""
        while not line.endswith(b"\n"):
            part = self._read()
            end = part.find(b"\n") + 1
            self._check_end(part[end:] if end else b"")
            line += part
            if len(line) > MAX_LINE:
                raise EntrantError(f"{self.command}: its answer is longer than {MAX_LINE:,} bytes")
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError) as error:
            text = line[:80].decode(errors="replace").strip()
            raise EntrantError(
                f"{self.command}: its answer is not one line of JSON: {text!r}; messages belong on "
                "standard error"
            ) from error
        if not isinstance(answer, dict):
            raise EntrantError(f"{self.command}: its answer is no JSON object: {line[:80]!r}")
        return answer

    def _read(self) -> bytes:
        """Some of its output."""
        stdout = self.process.stdout
        if self.is_patient and not select.select([stdout], [], [], PATIENCE)[0]:
            self.is_patient = False  # it is mentioned once
            write_line(
                f"{self.command}: no answer for {PATIENCE:.0f} s; does it flush its standard "
                "output after each line?"
            )
        part = os.read(stdout.fileno(), 2**16)
        return part or self._fail_ended()

    def _check_end(self, rest: bytes) -> None:
        if rest:
            text = rest[:80].decode(errors="replace").strip()
            raise EntrantError(
                f"{self.command}: it printed more than one line for a question: {text!r}; messages "
                "belong on standard error"
            )

    def _fail_ended(self) -> Any:
        code = None
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = self.process.wait(5)
        how = f"exit code {code}"
        if code is not None and code < 0:
            how = f"killed by {signal.Signals(-code).name}"
        advice = "; it must read on until its standard input ends" if code == 0 else ""
        raise EntrantError(f"{self.command}: ended without an answer ({how}){advice}")


def _message(problem: Problem) -> dict[str, Any]:
    """A problem for a program; docs/benchmark/enter.md describes it."""
    robot = problem.robot
    message: dict[str, Any] = {
        "number": problem.number,
        "seed": problem.seed,
        "start": problem.start.tolist(),
        "goal": problem.goal.tolist(),
        "goal_pose": problem.goal_pose.tolist(),
        "joint_limits": [robot.lower.tolist(), robot.upper.tolist()],
    }
    if problem.points is not None:
        message["points"] = problem.points.tolist()
    if problem.scene is not None:
        table = problem.scene.table
        message["obstacles"] = [obstacle_entry(shape) for shape in problem.scene.obstacles]
        message["table"] = None if table is None else obstacle_entry(table)
        message["floor"] = problem.scene.floor
    return message


def _checked_path(path: Any, robot: Robot, method: str) -> np.ndarray:
    """A joint path (k, n), rad, as float32. Raises EntrantError: it is none."""
    if not isinstance(path, (list, np.ndarray)) or not 2 <= len(path) <= MAX_WAYPOINTS:
        raise EntrantError(f"{method}: path: must have 2 to {MAX_WAYPOINTS:,} waypoints")
    waypoints = []
    for i, waypoint in enumerate(path):
        what = f"{method}: waypoint {i}"
        angles = _numbers(waypoint, robot.num_joints, what)
        beyond = np.maximum(robot.lower - angles, angles - robot.upper)
        if beyond.max() > BEYOND_LIMITS:
            joint = int(beyond.argmax())
            raise EntrantError(
                f"{what} is outside the limits, joint {joint + 1} at {angles[joint]:.4g} rad: "
                "is it in degrees, or in another order of the joints?"
            )
        waypoints.append(angles)
    return np.array(waypoints, np.float32)


def _numbers(value: Any, count: int, what: str) -> np.ndarray:
    """An array (count,) of finite numbers, float64. Raises EntrantError: it is none."""
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        array = np.array(None)
    if array.shape != (count,) or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
        raise EntrantError(f"{what}: must be {count} finite numbers, got {str(value)[:60]}")
    return array.astype(np.float64)
