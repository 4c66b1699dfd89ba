"""Scenes in other programs' formats: MoveIt (YAML and `.scene` text), robometrics, cuRobo, VAMP.

    scene = load_world("shelf.scene")

All lengths in metres, in the frame of the robot's base. None of these formats has a table or a
floor. Meshes become convex hulls (`envs.scenes.meshes`). What cannot be represented is rejected,
with its line: see `UNSUPPORTED`.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.rotations import matrix
from roboarm_nmp.envs.robots.variants import MAX_ATTACHED, with_attached
from roboarm_nmp.envs.scenes import meshes
from roboarm_nmp.envs.scenes.files import load_scene
from roboarm_nmp.envs.scenes.numbers import Quaternion, Vector, multiply, unit_quaternion
from roboarm_nmp.envs.scenes.primitives import (
    IDENTITY,
    MAX_LENGTH,
    MAX_SCENE_OBSTACLES,
    Attached,
    Box,
    ConvexHull,
    Cylinder,
    Obstacle,
    Scene,
    Sphere,
)
from roboarm_nmp.utils import documents
from roboarm_nmp.utils.documents import (
    DocumentError,
    Mistake,
    Node,
    describe,
    errors_at,
    get,
    is_nothing,
    load_document,
    mapping,
    mistakes_in,
    number,
    numbers,
    read_text,
    sequence,
    shorten,
)

Pose = tuple[Vector, Quaternion]
"""Position, m, and orientation (x, y, z, w)."""
UNSUPPORTED = {
    "mesh": "meshes",
    "meshes": "meshes",
    "octomap": "octomaps",
    "octree": "octomaps",
    "cone": "cones",
    "plane": "planes",
    "planes": "planes",
    "capsule": "capsules",
    "prism": "prisms",
    "voxel": "voxel grids",
    "voxels": "voxel grids",
    "blox": "nvblox maps",
}
"""Contents that are rejected where they are not empty, by their names in files, and in words."""
# MoveIt's numbers for a primitive's type, of messages that were printed.
_MOVEIT_TYPES = {"1": "box", "2": "sphere", "3": "cylinder", "4": "cone", "5": "prism"}
_MOVEIT_SCENE = ("world", "robot_model_name", "fixed_frame_transforms", "collision_objects")
_CUROBO_KINDS = ("cuboid", "cylinder", "sphere", "capsule", "mesh", "voxel", "blox")
MAX_NAMES = 1000  # of an allowed collision matrix
WORLD_FILES = (".yaml", ".yml", ".scene")


def load_world(path: str | Path) -> Scene:
    """Load the `Scene` in a file: our YAML, MoveIt's `.scene` or YAML, or cuRobo's YAML.

    Raises DocumentError: the file cannot be used. The message is `PATH:LINE: reason`.
    """
    path = Path(path)
    if path.suffix == ".scene":
        return read_scene_text(path)
    if path.suffix not in WORLD_FILES:
        raise DocumentError(f"{path}: a file of a world ends in {', '.join(WORLD_FILES)}")
    try:
        root = load_document(path)
    except DocumentError:
        return load_scene(path)  # its messages say what a scene file needs
    if not is_world(root):
        return load_scene(path)
    with mistakes_in(path):
        if _has_key(root, _MOVEIT_SCENE):
            return moveit_scene(root, PANDA)
        return checked_scene(root, curobo_obstacles(root, path.parent))


def is_world(root: Node) -> bool:
    """Whether a document is a world of MoveIt's or cuRobo's YAML."""
    return _has_key(root, _MOVEIT_SCENE) or _has_key(root, _CUROBO_KINDS)


def _has_key(node: Node, keys: Iterable[str]) -> bool:
    return isinstance(node.value, dict) and any(key in node.value for key in keys)


def _reject(node: Node, name: str) -> NoReturn:
    raise Mistake(node, f"{UNSUPPORTED[name]} are not supported ({name})")


def _reject_unless_empty(fields: dict[str, Node], *names: str) -> None:
    for name in names:
        if not is_nothing(fields.get(name)):
            _reject(fields[name], name)


# --- MoveIt: PlanningScene messages as YAML


def moveit_scene(root: Node, robot: Robot) -> Scene:
    """The `Scene` of a PlanningScene, with a robot. Raises Mistake."""
    fields = mapping(root, "a planning scene")
    check_frames(fields, robot)
    world = mapping(fields["world"], "world") if "world" in fields else fields
    _reject_unless_empty(world, "octomap")
    allowed = _AllowedCollisions(fields.get("allowed_collision_matrix"))
    obstacles = []
    if "collision_objects" in world:
        for entry in sequence(world["collision_objects"], "collision_objects"):
            shapes = _collision_object(entry, robot)
            may_touch = allowed.links(_id(entry), robot)
            obstacles += [replace(shape, may_touch=may_touch) for shape in shapes]
            _check_number(entry, obstacles)
    state = fields.get("robot_state")
    if state is not None and not is_nothing(state):
        robot = with_attached_objects(mapping(state, "robot_state"), robot, allowed)
    return checked_scene(root, obstacles, robot)


def _id(node: Node) -> str:
    name = mapping(node, "a collision object").get("id")
    return "" if name is None else documents.text(name, "id")


class _AllowedCollisions:
    """MoveIt's allowed collision matrix. Raises Mistake."""

    def __init__(self, node: Node | None):
        self._rows = {}
        self._defaults = {}
        if node is None or is_nothing(node):
            return
        fields = mapping(node, "allowed_collision_matrix")

        def entries(what: str) -> list[Node]:
            return sequence(fields[what], what, MAX_NAMES) if what in fields else []

        columns = [documents.text(name, "entry_names") for name in entries("entry_names")]
        rows = [self._row(row, columns) for row in entries("entry_values")]
        if len(rows) != len(columns):
            raise Mistake(node, f"{len(columns)} entry_names have {len(rows)} entry_values")
        self._rows = dict(zip(columns, rows, strict=True))
        names = [documents.text(name, "a name") for name in entries("default_entry_names")]
        values = [self._is_allowed(value) for value in entries("default_entry_values")]
        if len(names) != len(values):
            raise Mistake(node, f"{len(names)} default_entry_names have {len(values)} values")
        self._defaults = dict(zip(names, values, strict=True))

    def _row(self, node: Node, columns: list[str]) -> dict[str, bool]:
        if isinstance(node.value, dict):
            node = get(node, "enabled", "a row of entry_values")
        values = [self._is_allowed(value) for value in sequence(node, "a row of entry_values")]
        if len(values) != len(columns):
            raise Mistake(node, f"{len(columns)} entry_names have a row of {len(values)} values")
        return dict(zip(columns, values, strict=True))

    @staticmethod
    def _is_allowed(node: Node) -> bool:
        value = documents.text(node, "an entry of the allowed collision matrix").lower()
        if value not in ("true", "false", "0", "1"):
            raise Mistake(node, f"an entry must be true or false, got {describe(node)}")
        return value in ("true", "1")

    def links(self, name: str, robot: Robot) -> tuple[str, ...]:
        """Names of the robot's links that an object may touch."""
        row = self._rows.get(name, {})
        default = self._defaults.get(name, False)
        if not row and not default:
            return ()
        return tuple(link for link in robot.arm.link_names.values() if row.get(link, default))


def with_attached_objects(
    state: dict[str, Node], robot: Robot, allowed: _AllowedCollisions | None = None
) -> Robot:
    """The robot with the attached objects of a RobotState. Raises Mistake."""
    node = state.get("attached_collision_objects")
    if node is None or is_nothing(node):
        return robot
    objects = list(robot.attached)
    for entry in sequence(node, "attached_collision_objects", MAX_ATTACHED):
        link = documents.text(get(entry, "link_name", "an attached object"), "link_name")
        shape = get(entry, "object", "an attached object")
        touch_links = []
        if "touch_links" in mapping(entry, "an attached object"):
            names = sequence(get(entry, "touch_links", ""), "touch_links", MAX_NAMES)
            touch_links += [documents.text(name, "touch_links") for name in names]
        if allowed is not None:
            touch_links += allowed.links(_id(shape), robot)
        shapes = _collision_object(shape, robot, link)
        if not shapes:
            raise Mistake(shape, "an attached object needs primitives or meshes of its own")
        with errors_at(entry):
            for attached in [Attached(shape, link, tuple(touch_links)) for shape in shapes]:
                if attached not in objects:  # the scene and the start state may both have it
                    objects.append(attached)
    with errors_at(node):
        return with_attached(robot, objects)


def checked_scene(node: Node, obstacles: Iterable[Obstacle], robot: Robot = PANDA) -> Scene:
    """The `Scene` of obstacles from a file, without table and floor. Raises Mistake."""
    with errors_at(node):  # after a move by an outer pose, say
        return Scene(tuple(obstacles), table=None, floor=None, robot=robot)


def check_frames(fields: dict[str, Node], robot: Robot) -> None:
    """Raise Mistake unless the frames of a message are the base's."""
    transforms = fields.get("fixed_frame_transforms")
    if transforms is not None:
        for entry in sequence(transforms, "fixed_frame_transforms"):
            if "transform" in mapping(entry, "a fixed frame"):
                _check_identity(get(entry, "transform", ""), "a fixed frame's transform")
    state = fields.get("robot_state", fields.get("start_state"))
    if state is None or is_nothing(state):
        return
    joints = mapping(state, "a robot state").get("multi_dof_joint_state")
    if joints is None or is_nothing(joints):
        return
    transforms = mapping(joints, "multi_dof_joint_state").get("transforms")
    if transforms is not None:
        for entry in sequence(transforms, "transforms"):
            _check_identity(entry, "the transform of the base")


def _check_identity(node: Node, what: str) -> None:
    fields = mapping(node, what)
    x, y, z, w = _vector(fields.get("rotation"), what, IDENTITY)
    moves = any(_vector(fields.get("translation"), what, (0.0, 0.0, 0.0)))
    turns = x != 0 or y != 0 or z != 0 or abs(abs(w) - 1) >= 1e-9
    if moves or turns:
        raise Mistake(node, f"{what} must be the identity: obstacles are read in the base's frame")


def check_frame(node: Node, robot: Robot) -> None:
    """Raise Mistake unless a frame's name is that of the robot's base, `world`, or empty."""
    name = documents.text(node, "a frame")
    base = robot.link_names[-1]
    if name not in ("", "world", base, "/" + base):
        raise Mistake(node, f"the frame {shorten(name)!r} is neither {base}, the base, nor world")


def _collision_object(node: Node, robot: Robot, link: str | None = None) -> list[Obstacle]:
    """The obstacles of a collision object; `link`: the frame of an attached one."""
    fields = mapping(node, "a collision object")
    header = mapping(fields["header"], "header") if "header" in fields else {}
    if "frame_id" in header:
        if link is None:
            check_frame(header["frame_id"], robot)
        elif (name := documents.text(header["frame_id"], "a frame")) != link:
            reason = f"the frame {shorten(name)!r} is not {link}, the object's link"
            raise Mistake(header["frame_id"], reason)
    _reject_unless_empty(fields, "planes")
    if "operation" in fields:
        operation = documents.text(fields["operation"], "operation")
        if operation not in ("0", "add"):
            raise Mistake(fields["operation"], f"operation {shorten(operation)!r} is not `add`")
    outer = _moveit_pose(fields["pose"], "pose") if "pose" in fields else None
    obstacles = []
    for plural, singular, read in (
        ("primitives", "primitive", _moveit_primitive),
        ("meshes", "mesh", _moveit_mesh),
    ):
        if is_nothing(fields.get(plural)):
            continue
        shapes = sequence(fields[plural], plural, MAX_SCENE_OBSTACLES)
        poses = sequence(get(node, f"{singular}_poses", "a collision object"), f"{singular}_poses")
        if len(shapes) != len(poses):
            raise Mistake(node, f"{len(shapes)} {plural} have {len(poses)} {singular}_poses")
        for shape, pose in zip(shapes, poses, strict=True):
            obstacles += read(shape, _placed(_moveit_pose(pose, f"{singular}_poses"), outer))
            _check_number(shape, obstacles)
    return obstacles


def _moveit_primitive(node: Node, pose: Pose) -> list[Obstacle]:
    kind = documents.text(get(node, "type", "a primitive"), "type").lower()
    kind = _MOVEIT_TYPES.get(kind, kind)
    if kind not in NUM_DIMENSIONS:
        _unknown_kind(node, kind)
    dimensions = get(node, "dimensions", "a primitive")
    return [_primitive(kind, _dimensions(dimensions, kind), pose)]


def _moveit_mesh(node: Node, pose: Pose) -> tuple[ConvexHull, ...]:
    points = sequence(get(node, "vertices", "a mesh"), "vertices")
    vertices = [_vector(point, "a vertex", (0.0, 0.0, 0.0)) for point in points]
    triangles = sequence(get(node, "triangles", "a mesh"), "triangles", meshes.MAX_TRIANGLES)
    faces = [_face(get(one, "vertex_indices", "a triangle")) for one in triangles]
    return _hulls(node, vertices, faces, pose)


def _moveit_pose(node: Node, what: str) -> Pose:
    """A pose of lists, or of dicts with x, y, z, w."""
    fields = mapping(node, what)
    position = _vector(fields.get("position"), f"position of {what}", (0.0, 0.0, 0.0))
    turn = fields.get("orientation")
    if turn is None:
        return position, IDENTITY
    return position, _unit(turn, _vector(turn, f"orientation of {what}", IDENTITY))


def _vector(node: Node | None, what: str, default: tuple[float, ...]) -> tuple[Any, ...]:
    """Numbers of a list, or of a dict with keys x, y, z, w; `default` if there are none."""
    if node is None or is_nothing(node):
        return default
    if isinstance(node.value, dict):
        keys = "xyzw"[: len(default)]
        node = Node([get(node, key, what) for key in keys], node.line)
    return numbers(node, what, len(default), MAX_LENGTH)


# --- MoveIt: the text that its plugin for RViz exports


def read_scene_text(path: str | Path) -> Scene:
    """The `Scene` in a `.scene` file, in either of its versions. Raises DocumentError."""
    text = read_text(path)
    with mistakes_in(path):
        return checked_scene(Node("", 1), _SceneText(text).obstacles())


class _SceneText:
    """The lines of a `.scene` file, one after another. Raises Mistake."""

    def __init__(self, text: str):
        self._lines = [line.strip() for line in text.splitlines()]
        self._number = 0  # of the present line, from 1

    def _take(self, what: str) -> Node:
        """The next line with contents."""
        while self._number < len(self._lines):
            self._number += 1
            if self._lines[self._number - 1]:
                return Node(self._lines[self._number - 1], self._number)
        raise Mistake(Node("", max(self._number, 1)), f"the file ends before {what}")

    def _take_words(self, what: str) -> Node:
        """The words of the next line."""
        line = self._take(what)
        return Node([Node(word, line.line) for word in str(line.value).split()], line.line)

    def _take_numbers(self, what: str, count: int, most: float = MAX_LENGTH) -> tuple[Any, ...]:
        return numbers(self._take_words(what), what, count, most)

    def _take_count(self, what: str) -> int:
        line = self._take(what)
        digits = str(line.value)
        if not digits.isdecimal() or len(digits) > 9:
            raise Mistake(line, f"{what} must be a whole number, got {describe(line)}")
        return int(digits)

    def _take_pose(self) -> Pose:
        position = self._take_numbers("a position", 3)
        words = self._take_words("an orientation")
        return position, _unit(words, numbers(words, "an orientation", 4, MAX_LENGTH))

    def _pose_follows(self) -> bool:
        """Whether an object's pose comes next, as in newer files; else the number of its shapes."""
        line = next(filter(None, self._lines[self._number :]), "")
        return len(line.split()) > 1

    def obstacles(self) -> list[Obstacle]:
        obstacles = []
        self._take("the scene's name")
        while (line := self._take("the last line, a dot")).value != ".":
            if not str(line.value).startswith("*"):
                raise Mistake(line, f"an object begins with *, got {describe(line)}")
            is_new = self._pose_follows()
            outer = self._take_pose() if is_new else None
            for _ in range(self._take_count("the number of shapes")):
                kind = self._take("a shape")
                obstacles += self._shapes(kind, outer)
                _check_number(kind, obstacles)
            if is_new:
                for _ in range(self._take_count("the number of subframes")):
                    self._take("a subframe's name")
                    self._take_pose()
        return obstacles

    def _shapes(self, node: Node, outer: Pose | None) -> Iterable[Obstacle]:
        kind = str(node.value)
        if kind == "mesh":
            what = "the numbers of vertices and triangles"
            counts = self._take_words(what)
            num_vertices, num_faces = numbers(counts, what, 2, 1e9)
            if max(num_vertices, num_faces) > len(self._lines):
                raise Mistake(counts, "the file ends before the last triangle")
            vertices = [self._take_numbers("a vertex", 3) for _ in range(int(num_vertices))]
            faces = [_face(self._take_words("a triangle")) for _ in range(int(num_faces))]
            return _hulls(node, vertices, faces, self._take_shape_pose(outer))
        if kind not in NUM_DIMENSIONS:
            _unknown_kind(node, kind)
        dimensions = _dimensions(self._take_words(f"the dimensions of a {kind}"), kind)
        if kind == "cylinder":  # here the radius comes first
            dimensions = dimensions[::-1]
        return [_primitive(kind, dimensions, self._take_shape_pose(outer))]

    def _take_shape_pose(self, outer: Pose | None) -> Pose:
        """The pose of a shape in the base's frame; its colour is dropped."""
        pose = self._take_pose()
        self._take_numbers("a colour", 4)
        return _placed(pose, outer)


# --- robometrics and cuRobo


def curobo_obstacles(node: Node, folder: Path) -> list[Obstacle]:
    """The obstacles of a cuRobo world, or of robometrics' `obstacles`. Raises Mistake.

    Kinds are dicts from names to fields. A pose is x, y, z and a quaternion w, x, y, z; `dims` are
    full edges. Files of meshes are relative to `folder`, and inside of it.
    """
    kinds = ("cuboid", "box", "cylinder", "sphere", "mesh")
    fields = mapping(node, "obstacles")
    for kind, value in fields.items():
        if kind not in kinds and not is_nothing(value):
            _unknown_kind(value, kind)
    obstacles = []
    for kind in kinds:
        if is_nothing(fields.get(kind)):
            continue
        for name, one in mapping(fields[kind], kind).items():
            what = f"{kind} {shorten(name)}"
            if kind == "mesh":
                obstacles += _curobo_mesh(one, what, folder)
            else:
                obstacles.append(_curobo_obstacle(one, kind, what))
            _check_number(one, obstacles)
    return obstacles


def _curobo_obstacle(node: Node, kind: str, what: str) -> Obstacle:
    fields = mapping(node, what)
    if kind == "sphere" and "pose" not in fields:
        return Sphere(_numbers(node, "position", what, 3), _size(node, "radius", what))
    position, orientation = _curobo_pose(node, what)
    if kind in ("cuboid", "box"):
        return Box(position, _numbers(node, "dims", what, 3, positive=True), orientation)
    radius = _size(node, "radius", what)
    if kind == "sphere":
        return Sphere(position, radius)
    return Cylinder(position, radius, _size(node, "height", what), orientation)


def _curobo_pose(node: Node, what: str) -> Pose:
    x, y, z, w, i, j, k = _numbers(node, "pose", what, 7)
    return (x, y, z), _unit(get(node, "pose", what), (i, j, k, w))


def _curobo_mesh(node: Node, what: str, folder: Path) -> tuple[ConvexHull, ...]:
    """The hulls of a mesh, which has a `file_path`, or `vertices` and `faces`."""
    fields = mapping(node, what)
    scale = (1.0, 1.0, 1.0)
    if not is_nothing(fields.get("scale")):
        scale = _numbers(node, "scale", what, 3, positive=True)
    position, orientation = _curobo_pose(node, what)
    if is_nothing(fields.get("file_path")):
        points = sequence(get(node, "vertices", what), "vertices")
        vertices = [numbers(point, "a vertex", 3, MAX_LENGTH) for point in points]
        triangles = sequence(get(node, "faces", what), "faces", meshes.MAX_TRIANGLES)
        faces = [_face(triangle) for triangle in triangles]
        return _hulls(node, vertices, faces, (position, orientation), scale)
    with errors_at(fields["file_path"]):
        name = documents.text(fields["file_path"], "file_path")
        vertices, faces = meshes.load_mesh(name, folder)
        return meshes.mesh_hulls(vertices, faces, position, orientation, scale)


# --- VAMP's JSON


def vamp_obstacles(node: Node) -> list[Obstacle]:
    """The obstacles of a problem in VAMP's JSON: lists by kind. Raises Mistake.

    A box has `half_extents`, or `size`, its full edges; orientations are `orientation_quat_xyzw`,
    `quat_xyzw`, or `orientation_euler_xyz` (rad: about the fixed x, then y, then z axis).
    """
    fields = mapping(node, "obstacles")
    _reject_unless_empty(fields, *UNSUPPORTED)
    obstacles = []
    for kind in ("box", "cylinder", "sphere"):
        for one in sequence(fields[kind], kind) if kind in fields else ():
            obstacles.append(_vamp_obstacle(one, kind))
            _check_number(one, obstacles)
    return obstacles


def _vamp_obstacle(node: Node, kind: str) -> Obstacle:
    fields = mapping(node, kind)
    position = _numbers(node, "position", kind, 3)
    orientation = IDENTITY
    if "quat_xyzw" in fields:
        orientation = _unit(fields["quat_xyzw"], _numbers(node, "quat_xyzw", kind, 4))
    elif "orientation_quat_xyzw" in fields:
        name = "orientation_quat_xyzw"
        orientation = _unit(fields[name], _numbers(node, name, kind, 4))
    elif "orientation_euler_xyz" in fields:
        from scipy.spatial.transform import Rotation  # here, because it takes a while to import

        angles = _numbers(node, "orientation_euler_xyz", kind, 3)
        orientation = tuple(Rotation.from_euler("xyz", angles).as_quat().tolist())
    if kind == "box" and "half_extents" in fields:
        x, y, z = _numbers(node, "half_extents", kind, 3, positive=True)
        return Box(position, (2 * x, 2 * y, 2 * z), orientation)
    if kind == "box":
        return Box(position, _numbers(node, "size", kind, 3, positive=True), orientation)
    radius = _size(node, "radius", kind)
    if kind == "sphere":
        return Sphere(position, radius)
    return Cylinder(position, radius, _size(node, "length", kind), orientation)


# --- What the formats share

NUM_DIMENSIONS = {"box": 3, "sphere": 1, "cylinder": 2}
"""Of MoveIt's primitives: a box's edges, a sphere's radius, a cylinder's length and radius."""


def _dimensions(node: Node, kind: str) -> tuple[Any, ...]:
    what = f"the dimensions of a {kind}"
    return numbers(node, what, NUM_DIMENSIONS[kind], MAX_LENGTH, positive=True)


def _primitive(kind: str, dimensions: tuple[Any, ...], pose: Pose) -> Obstacle:
    position, orientation = pose
    if kind == "box":
        return Box(position, dimensions, orientation)
    if kind == "sphere":
        return Sphere(position, *dimensions)
    length, radius = dimensions
    return Cylinder(position, radius, length, orientation)


def _face(node: Node) -> tuple[int, int, int]:
    """The vertices of a triangle."""
    corners = sequence(node, "a triangle")
    if len(corners) != 3:
        raise Mistake(node, f"a triangle has 3 vertices, got {len(corners)}")
    a, b, c = [int(number(corner, "a triangle's vertex", 1e9)) for corner in corners]
    return a, b, c


def _hulls(
    node: Node,
    vertices: list[Any],
    faces: list[tuple[int, int, int]],
    pose: Pose,
    scale: float | Vector = 1.0,
) -> tuple[ConvexHull, ...]:
    """The hulls of a mesh in the file itself."""
    corners = np.reshape(vertices, (-1, 3)).astype(np.float64)
    triangles = np.reshape(faces, (-1, 3)).astype(np.int64)
    with errors_at(node):
        return meshes.mesh_hulls(corners, triangles, *pose, scale)


def _numbers(
    node: Node, key: str, what: str, count: int, positive: bool = False
) -> tuple[Any, ...]:
    """The numbers of a key."""
    return numbers(get(node, key, what), f"{key} of {what}", count, MAX_LENGTH, positive)


def _size(node: Node, key: str, what: str) -> float:
    return number(get(node, key, what), f"{key} of {what}", MAX_LENGTH, positive=True)


def _unit(node: Node, quaternion: Iterable[float]) -> Quaternion:
    with errors_at(node):
        return unit_quaternion(quaternion)


def _placed(pose: Pose, outer: Pose | None) -> Pose:
    """A pose in an outer one, if there is one."""
    return pose if outer is None else compose_poses(*outer, *pose)


def compose_poses(
    position: Vector, orientation: Quaternion, inner_position: Vector, inner_orientation: Quaternion
) -> Pose:
    """The pose of an inner pose in an outer one: position, m, and quaternion (xyzw)."""
    moved = np.array(position) + matrix(orientation) @ np.array(inner_position)
    x, y, z = moved.tolist()
    return (x, y, z), multiply(orientation, inner_orientation)


def _unknown_kind(node: Node, kind: str) -> NoReturn:
    if kind in UNSUPPORTED:
        _reject(node, kind)
    raise Mistake(node, f"unknown kind of obstacle {shorten(kind)!r}")


def _check_number(node: Node, obstacles: list[Obstacle]) -> None:
    if len(obstacles) > MAX_SCENE_OBSTACLES:
        raise Mistake(node, f"a scene has at most {MAX_SCENE_OBSTACLES:,} obstacles")
