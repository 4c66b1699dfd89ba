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
import pkgutil
import shlex
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

Observes = Literal["nothing", "point_cloud", "ground_truth"]
MAX_LINE = 10_000_000  # bytes of a program's answer
MAX_WAYPOINTS = 10_000


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
            return EpisodePolicy(follow_path(_checked_path(answer, env.robot), env.robot), True)

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
        try:
            program = subprocess.Popen(
                shlex.split(self.command), stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
        except (OSError, ValueError) as error:
            raise EntrantError(f"{self.command}: cannot be started: {error}") from error
        joints = env.robot.num_joints

        def act(observation: Any) -> np.ndarray:
            arrays = {name: array.tolist() for name, array in observation.items()}
            answer = self._ask(program, {"observation": arrays})
            return _numbers(answer.get("action"), (joints,), f"{self.command}: action")

        def begin_program(number: int, query: Query) -> EpisodePolicy:
            problem = _problem(env, number, query, self.observes, seed)
            answer = self._ask(program, _message(problem))
            if "path" not in answer:
                return EpisodePolicy(act)
            if answer["path"] is None:
                return EpisodePolicy(None, plan_found=False)
            return EpisodePolicy(follow_path(_checked_path(answer["path"], env.robot), env.robot))

        return begin_program

    def _ask(self, program, message) -> dict[str, Any]:
        """The program's answer to a message."""
        try:
            program.stdin.write(json.dumps(message).encode() + b"\n")
            program.stdin.flush()
            line = program.stdout.readline(MAX_LINE)
        except OSError:
            line = b""
        if not line:
            code = None
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = program.wait(5)
            raise EntrantError(f"{self.command}: ended without an answer (exit code {code})")
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise EntrantError(f"{self.command}: its answer is not JSON: {line[:80]!r}") from error
        if not isinstance(answer, dict):
            raise EntrantError(f"{self.command}: its answer is no JSON object: {line[:80]!r}")
        return answer


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


def _checked_path(path: Any, robot: Robot) -> np.ndarray:
    """A joint path (k, n), rad, as float32. Raises EntrantError: it is none."""
    path = _numbers(path, (None, robot.num_joints), "path").astype(np.float32)
    if not 2 <= len(path) <= MAX_WAYPOINTS:
        raise EntrantError(f"path: {len(path)} waypoints, must have 2 to {MAX_WAYPOINTS:,}")
    return path


def _numbers(value: Any, shape: tuple[int | None, ...], what: str) -> np.ndarray:
    """An array of finite numbers. Raises EntrantError: it is none, or has another shape."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise EntrantError(f"{what}: {error}") from error
    fits = len(array.shape) == len(shape) and all(
        size in (None, length) for size, length in zip(shape, array.shape, strict=True)
    )
    if not fits or not np.isfinite(array).all():
        words = " x ".join("k" if size is None else str(size) for size in shape)
        raise EntrantError(f"{what}: must be {words} finite numbers, got {str(value)[:60]}")
    return array
