"""Readers of problems in other programs' formats; `datasets.problems` says which.

Each reader yields a `Problem`, or a `Rejected` with the reason, for every problem of a file.
"""

import functools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.placements import link_placement
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.variants import with_held
from roboarm_nmp.envs.scenes.formats import (
    check_frame,
    check_frames,
    checked_scene,
    compose_poses,
    curobo_obstacles,
    is_world,
    moveit_scene,
    vamp_obstacles,
    with_attached_objects,
)
from roboarm_nmp.envs.scenes.primitives import MAX_LENGTH, Scene, unit_quaternion
from roboarm_nmp.utils import documents
from roboarm_nmp.utils.documents import (
    DocumentError,
    Mistake,
    get,
    is_nothing,
    load_document,
    mapping,
    mistakes_in,
    number,
    numbers,
    sequence,
    shorten,
)

MAX_PROBLEMS = 100_000  # of a file
MAX_GOALS = 1_000  # of a problem
MAX_OBSTACLES = 1_000_000  # of a file
# Where the Panda's fingers are, m, in sets that do not say it.
VAMP_OPENING = 0.065
ROBOMETRICS_OPENING = 0.025
MAX_ANGLE = 1e4  # rad or m, of a joint


class Problem(NamedTuple):
    """A motion planning problem.

    Attributes:
        name: of the set and of the problem in it.
        start: float64 (n,), joint angles, rad.
        goals: float64 (k, n), rad: any of them will do; k is 0 where the goal is a pose only.
        goal_pose: float64 (7,), or None: position (m) and quaternion (xyzw) of the end effector in
            the world.
        scene: the `Scene`, whose robot has its held joints, such as the gripper's, in place.
    """

    name: str
    start: np.ndarray
    goals: np.ndarray
    goal_pose: np.ndarray | None
    scene: Scene


class Rejected(NamedTuple):
    """A problem that cannot be used: its name, and the reason."""

    name: str
    reason: str


def read_file(path: str | Path, robot: Robot) -> Iterator[Problem | Rejected]:
    """Yield a `Problem` or a `Rejected` for each problem of a YAML or JSON file.

    Raises DocumentError: the file is of no known format.
    """
    root = load_document(path)
    with mistakes_in(path):
        fields = mapping(root, "a file of problems")
        if is_world(root) or "obstacles" in fields:
            raise Mistake(root, "a world without starts and goals, which can be a task: --task")
        if "problems" in fields:
            entries = list(_vamp_entries(fields, Path(path).stem))
            reader = _vamp_problem
        else:
            entries = list(_robometrics_entries(fields))
            reader = functools.partial(_robometrics_problem, folder=Path(path).parent)
        if not entries:
            raise Mistake(root, "no problems")
        if len(entries) > MAX_PROBLEMS:
            raise Mistake(root, f"{len(entries):,} problems, at most {MAX_PROBLEMS:,}")
    obstacles = 0
    for name, node in entries:
        try:
            problem = reader(name, node, robot)
        except Mistake as mistake:
            yield Rejected(name, f"{path}:{mistake.line}: {mistake.reason}")
            continue
        obstacles += len(problem.scene.obstacles)
        if obstacles > MAX_OBSTACLES:
            raise DocumentError(f"{path}: more than {MAX_OBSTACLES:,} obstacles in all")
        yield problem


# --- MotionBenchMaker and MoveIt: pairs of files


def request_files(folder: str | Path) -> dict[str, tuple[Path | None, Path | None]]:
    """The scene file and the request file of each number, as text, in a folder; None for none."""
    scenes, requests = _numbered(folder, "scene"), _numbered(folder, "request")
    return {
        digits: (scenes.get(digits), requests.get(digits))
        for digits in sorted({*scenes, *requests})
    }


def _numbered(folder, word):
    """The YAML files `word####.yaml` of a folder, by their digits."""
    paths = {}
    for path in sorted(Path(folder).glob(f"{word}*")):
        match = re.fullmatch(rf"{word}_?(\d{{1,9}})\.ya?ml", path.name)
        if match:
            paths[match[1]] = path
    return paths


def read_folder(folder: str | Path, robot: Robot) -> Iterator[Problem | Rejected]:
    """Yield a `Problem` or a `Rejected` for each `scene####.yaml` with its `request####.yaml`.

    Raises DocumentError: there is none in the folder.
    """
    folder = Path(folder)
    pairs = request_files(folder)
    if not any(request for _, request in pairs.values()):
        raise DocumentError(f"{folder}: no request####.yaml with a scene####.yaml in this folder")
    for digits, (scene_file, request_file) in pairs.items():
        name = f"{folder.resolve().name}/{digits}"
        if scene_file is None:
            yield Rejected(name, f"{request_file}: there is no scene{digits}.yaml")
            continue
        if request_file is None:
            yield Rejected(name, f"{scene_file}: there is no request{digits}.yaml")
            continue
        path = request_file
        try:
            start, goals, robot_of_request = _request(load_document(request_file), robot)
            path = scene_file
            scene = moveit_scene(load_document(scene_file), robot_of_request)
        except Mistake as mistake:
            yield Rejected(name, f"{path}:{mistake.line}: {mistake.reason}")
        except DocumentError as error:
            yield Rejected(name, str(error))
        else:
            yield Problem(name, start, goals, None, scene)


def _request(root, robot):
    """Start (n,), goals (k, n), and the robot with its held joints, of a MotionPlanRequest."""
    fields = mapping(root, "a motion plan request")
    for key in ("path_constraints", "trajectory_constraints"):
        if not _is_empty(fields.get(key)):
            raise Mistake(fields[key], f"{key} are not supported")
    check_frames(fields, robot)
    state = mapping(get(root, "start_state", "a request"), "start_state")
    joints = get(fields["start_state"], "joint_state", "start_state")
    names = sequence(get(joints, "name", "joint_state"), "name", 1000)
    values = sequence(get(joints, "position", "joint_state"), "position", 1000)
    if len(names) != len(values):
        raise Mistake(joints, f"{len(names)} joints have {len(values)} positions")
    positions = {}
    for name, value in zip(names, values, strict=True):
        joint = documents.text(name, "the name of a joint")
        positions[joint] = number(value, f"the position of {joint[:40]}", MAX_ANGLE)
    start, held = _configuration(joints, positions, robot, "the start")
    robot = with_attached_objects(state, _with_held(joints, robot, held))
    constraints = get(root, "goal_constraints", "a request")
    goals = []
    for node in sequence(constraints, "goal_constraints", MAX_GOALS):
        goal = mapping(node, "a goal")
        for key in ("position_constraints", "orientation_constraints", "visibility_constraints"):
            if not is_nothing(goal.get(key)):
                raise Mistake(goal[key], f"{key} are not supported: only joint_constraints")
        angles = {}
        for joint in sequence(get(node, "joint_constraints", "a goal"), "joint_constraints", 1000):
            name = documents.text(get(joint, "joint_name", "a joint constraint"), "joint_name")
            value = get(joint, "position", "a joint constraint")
            angles[name] = number(value, f"the position of {name[:40]}", MAX_ANGLE)
        configuration, _ = _configuration(node, angles, robot, "the goal")
        goals.append(configuration)
    if not goals:
        raise Mistake(constraints, "no goal")
    return start, np.array(goals), robot


def _is_empty(node):
    """Whether a message has no contents, at any depth: empty texts, lists and numbers 0."""
    if node is None or isinstance(node.value, str):
        return node is None or node.value in ("", "0", "0.0", "null", "~", "false")
    inner = node.value.values() if isinstance(node.value, dict) else node.value
    return all(map(_is_empty, inner))


def _configuration(node, positions, robot, what):
    """Joint angles (n,) from a dict of names, and the positions of held joints, a dict."""
    missing = [name for name in robot.joint_names if name not in positions]
    if missing:
        raise Mistake(node, f"{what} lacks {', '.join(missing)}")
    held = {name: at for name, at in positions.items() if name not in robot.joint_names}
    unknown = sorted(name for name in held if name not in robot.held)
    if unknown:
        raise Mistake(node, f"{robot.name} has no joint {shorten(unknown[0])!r}")
    return np.array([positions[name] for name in robot.joint_names]), held


def _with_held(node, robot, positions):
    try:
        return with_held(robot, positions)
    except ValueError as error:
        raise Mistake(node, str(error)) from error


# --- robometrics


def _robometrics_entries(fields):
    """The (name, node) of the problems: lists of them by the names of their scenes."""
    for scene, problems in fields.items():
        for index, node in enumerate(sequence(problems, "problems", MAX_PROBLEMS)):
            yield f"{scene[:60]}/{index}", node


def _robometrics_problem(name, node, robot, folder):
    fields = mapping(node, "a problem")
    robot = _with_opening(node, robot, ROBOMETRICS_OPENING)
    if "world_frame" in fields:
        check_frame(fields["world_frame"], robot)
    start = _angles(get(node, "start", "a problem"), "start", robot)
    goals = []
    if "goal_ik" in fields:
        nodes = sequence(fields["goal_ik"], "goal_ik", MAX_GOALS)
        goals = [_angles(goal, "a goal of goal_ik", robot) for goal in nodes]
    pose = None
    if not is_nothing(fields.get("goal_pose")):
        pose = _goal_pose(fields["goal_pose"], robot)
    elif not goals:
        raise Mistake(node, "a problem needs goal_ik or goal_pose")
    obstacles = curobo_obstacles(get(node, "obstacles", "a problem"), folder)
    goals = np.reshape(goals, (-1, robot.num_joints))
    return Problem(name, start, goals, pose, checked_scene(node, obstacles, robot))


def _goal_pose(node, robot):
    """The end effector's pose where a link, such as the hand, has the pose of a file: (7,)."""
    from scipy.spatial.transform import Rotation  # here: it takes half a second

    frame = documents.text(get(node, "frame", "goal_pose"), "frame")
    position = numbers(get(node, "position_xyz", "goal_pose"), "position_xyz", 3, MAX_LENGTH)
    orientation = get(node, "quaternion_wxyz", "goal_pose")
    w, x, y, z = numbers(orientation, "quaternion_wxyz", 4, MAX_LENGTH)
    try:
        quaternion = unit_quaternion((x, y, z, w))
        joint, rotation, at = link_placement(robot, frame)
    except ValueError as error:
        raise Mistake(node, str(error)) from error
    end = robot.link_names[robot.end_effector_link]
    end_joint, end_rotation, end_at = link_placement(robot, end)
    if joint != end_joint:
        raise Mistake(node, f"the frame {shorten(frame)!r} does not move with the end effector")
    end_at = end_at + end_rotation @ np.array(robot.end_effector_offset)
    turn = Rotation.from_matrix(rotation.T @ end_rotation).as_quat(canonical=True)
    x, y, z = (rotation.T @ (end_at - at)).tolist()
    return np.concatenate(compose_poses(position, quaternion, (x, y, z), turn))


# --- VAMP


def _vamp_entries(fields, stem):
    """The (name, node) of the problems: a list, or lists by the names of their sets."""
    problems = fields["problems"]
    sets = problems.value if isinstance(problems.value, dict) else {stem: problems}
    for name, nodes in sets.items():
        for index, node in enumerate(sequence(nodes, "problems", MAX_PROBLEMS)):
            number_in_file = mapping(node, "a problem").get("index")
            if number_in_file is not None:
                index = documents.text(number_in_file, "index") or index
            yield f"{name[:60]}/{str(index)[:20]}", node


def _vamp_problem(name, node, robot):
    fields = mapping(node, "a problem")
    robot = _with_opening(node, robot, VAMP_OPENING)
    if "fingers" in fields:
        fingers = numbers(fields["fingers"], "fingers", len(robot.held_indices), MAX_ANGLE)
        robot = _with_held(node, robot, dict(zip(robot.held, fingers, strict=True)))
    start = _angles(get(node, "start", "a problem"), "start", robot)
    nodes = get(node, "goals", "a problem")
    goals = [_angles(goal, "a goal", robot) for goal in sequence(nodes, "goals", MAX_GOALS)]
    if not goals:
        raise Mistake(nodes, "no goal")
    inner = fields.get("obstacles")
    obstacles = vamp_obstacles(node if inner is None else inner)
    return Problem(name, start, np.array(goals), None, checked_scene(node, obstacles, robot))


def _angles(node, what, robot):
    return np.array(numbers(node, what, robot.num_joints, MAX_ANGLE))


def _with_opening(node, robot, opening):
    """The Panda with its fingers at an opening (m); other arms as they are."""
    if robot.arm != PANDA:
        return robot
    return _with_held(node, robot, dict.fromkeys(robot.held, opening))
