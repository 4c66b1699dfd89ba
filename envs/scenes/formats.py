"""Scenes in other programs' formats: MoveIt (YAML and `.scene` text), robometrics, cuRobo, VAMP.

    scene = load_world("shelf.scene")

All lengths in metres, in the frame of the robot's base. None of these formats has a table or a
floor. Meshes become convex hulls (`envs.scenes.meshes`). What cannot be represented is rejected,
with its line: see `UNSUPPORTED`.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from roboarm_nmp.envs.robots.attached import MAX_ATTACHED
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import matrix
from roboarm_nmp.envs.scenes import documents, meshes
from roboarm_nmp.envs.scenes.documents import (
    DocumentError,
    Mistake,
    Node,
    describe,
    get,
    is_nothing,
    load_document,
    mapping,
    number,
    numbers,
    read_text,
    sequence,
    shorten,
)
from roboarm_nmp.envs.scenes.files import load_scene
from roboarm_nmp.envs.scenes.primitives import (
    IDENTITY,
    MAX_LENGTH,
    MAX_SCENE_OBSTACLES,
    Attached,
    Box,
    Cylinder,
    Scene,
    Sphere,
    unit_quaternion,
)

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


def load_world(path):
    """The `Scene` in a file: of this project's YAML, MoveIt's `.scene` or YAML, or cuRobo's YAML.

    Raises:
        DocumentError, envs.scenes.files.SceneFileError: the file cannot be used; ValueErrors whose
            message is `PATH:LINE: reason`.
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
    try:
        if any(key in root.value for key in _MOVEIT_SCENE):
            return moveit_scene(root, PANDA)
        return checked_scene(root, curobo_obstacles(root, path.parent))
    except Mistake as mistake:
        raise DocumentError(f"{path}:{mistake.line}: {mistake.reason}") from mistake


def is_world(root):
    """Whether a document, a `Node`, is a world of MoveIt's or cuRobo's YAML."""
    keys = root.value if isinstance(root.value, dict) else ()
    return any(key in keys for key in (*_MOVEIT_SCENE, *_CUROBO_KINDS))


def reject(node, name):
    """Raise Mistake: a file has contents of `UNSUPPORTED`."""
    raise Mistake(node, f"{UNSUPPORTED[name]} are not supported ({name})")


def _reject_unless_empty(fields, *names):
    """Raise Mistake if one of these keys of a dict of `Node`s has contents."""
    for name in names:
        if not is_nothing(fields.get(name)):
            reject(fields[name], name)


# --- MoveIt: PlanningScene messages as YAML


def moveit_scene(root, robot):
    """The `Scene` of a PlanningScene, a `Node`, with a `Robot`. Raises Mistake."""
    fields = mapping(root, "a planning scene")
    check_frames(fields, robot)
    world = mapping(fields["world"], "world") if "world" in fields else fields
    _reject_unless_empty(world, "octomap")
    allowed = _AllowedCollisions(fields.get("allowed_collision_matrix"))
    obstacles = []
    if "collision_objects" in world:
        for entry in sequence(world["collision_objects"], "collision_objects"):
            found = _collision_object(entry, robot)
            if touching := allowed.links(_id(entry), robot):
                found = [replace(one, may_touch=touching) for one in found]
            obstacles += found
            _check_number(entry, obstacles)
    state = fields.get("robot_state")
    if not is_nothing(state):
        robot = with_attached_objects(mapping(state, "robot_state"), robot, allowed)
    return checked_scene(root, tuple(obstacles), robot)


def _id(node):
    name = mapping(node, "a collision object").get("id")
    return "" if name is None else documents.text(name, "id")


class _AllowedCollisions:
    """MoveIt's allowed collision matrix, a `Node` or None. Raises Mistake."""

    def __init__(self, node):
        self._rows, self._defaults = {}, {}
        if is_nothing(node):
            return
        fields, names = mapping(node, "allowed_collision_matrix"), {}
        for what in ("entry_names", "entry_values", "default_entry_names", "default_entry_values"):
            names[what] = sequence(fields.get(what, Node([], node.line)), what, MAX_NAMES)
        columns = [documents.text(name, "entry_names") for name in names["entry_names"]]
        rows = [self._row(row, columns) for row in names["entry_values"]]
        if len(rows) != len(columns):
            raise Mistake(node, f"{len(columns)} entry_names have {len(rows)} entry_values")
        self._rows = dict(zip(columns, rows, strict=True))
        named = [documents.text(name, "a name") for name in names["default_entry_names"]]
        values = [_switch(value) for value in names["default_entry_values"]]
        if len(named) != len(values):
            raise Mistake(node, f"{len(named)} default_entry_names have {len(values)} values")
        self._defaults = dict(zip(named, values, strict=True))

    def _row(self, node, columns):
        if isinstance(node.value, dict):
            node = get(node, "enabled", "a row of entry_values")
        values = [_switch(value) for value in sequence(node, "a row of entry_values")]
        if len(values) != len(columns):
            raise Mistake(node, f"{len(columns)} entry_names have a row of {len(values)} values")
        return dict(zip(columns, values, strict=True))

    def links(self, name, robot):
        """Names of the robot's links that an object may touch, a tuple."""
        row, default = self._rows.get(name, {}), self._defaults.get(name, False)
        if not row and not default:
            return ()
        links = robot.arm.bullet_names[1].values()
        return tuple(link for link in links if row.get(link, default))


def _switch(node):
    value = documents.text(node, "an entry of the allowed collision matrix").lower()
    if value not in ("true", "false", "0", "1"):
        raise Mistake(node, f"an entry must be true or false, got {describe(node)}")
    return value in ("true", "1")


def with_attached_objects(state, robot, allowed=None):
    """A `Robot` with the attached objects of a RobotState, a dict of `Node`s. Raises Mistake."""
    node = state.get("attached_collision_objects")
    if is_nothing(node):
        return robot
    found = list(robot.attached)
    for entry in sequence(node, "attached_collision_objects", MAX_ATTACHED):
        link = documents.text(get(entry, "link_name", "an attached object"), "link_name")
        shape = get(entry, "object", "an attached object")
        touched = mapping(entry, "an attached object").get("touch_links")
        touched = [] if touched is None else sequence(touched, "touch_links", MAX_NAMES)
        touched = [documents.text(one, "touch_links") for one in touched]
        if allowed is not None:
            touched += allowed.links(_id(shape), robot)
        shapes = _collision_object(shape, robot, link)
        if not shapes:
            raise Mistake(shape, "an attached object needs primitives or meshes of its own")
        try:
            objects = [Attached(one, link, touched) for one in shapes]
            found += [one for one in objects if one not in found]  # of the start state, too
        except ValueError as error:
            raise Mistake(entry, str(error)) from error
    try:
        return robot.with_attached(found)
    except ValueError as error:
        raise Mistake(node, str(error)) from error


def checked_scene(node, obstacles, robot=PANDA):
    """The `Scene` of obstacles from a file, without table and floor. Raises Mistake."""
    try:
        return Scene(obstacles, table=None, floor=None, robot=robot)
    except ValueError as error:  # after a move by an outer pose, say
        raise Mistake(node, str(error)) from error


def check_frames(fields, robot):
    """Raise Mistake unless the frames of a message, a dict of `Node`s, are the base's."""
    transforms = fields.get("fixed_frame_transforms")
    for entry in [] if transforms is None else sequence(transforms, "fixed_frame_transforms"):
        one = mapping(entry, "a fixed frame")
        if "transform" in one:
            check_identity(one["transform"], "a fixed frame's transform")
    state = fields.get("robot_state", fields.get("start_state"))
    if state is None or is_nothing(state):
        return
    joints = mapping(state, "a robot state").get("multi_dof_joint_state")
    if joints is None or is_nothing(joints):
        return
    transforms = mapping(joints, "multi_dof_joint_state").get("transforms")
    for entry in [] if transforms is None else sequence(transforms, "transforms"):
        check_identity(entry, "the transform of the base")


def check_identity(node, what):
    """Raise Mistake unless a transform moves nothing."""
    fields = mapping(node, what)
    moves = any(_vector(fields.get("translation"), what, (0.0, 0.0, 0.0)))
    _, _, _, w = turn = _vector(fields.get("rotation"), what, IDENTITY)
    if moves or not (abs(abs(w) - 1) < 1e-9 and not any(turn[:3])):
        raise Mistake(node, f"{what} must be the identity: obstacles are read in the base's frame")


def check_frame(node, robot):
    """Raise Mistake unless a frame's name is that of the robot's base, `world`, or empty."""
    name = documents.text(node, "a frame")
    base = robot.bullet_names[1][-1]
    if name not in ("", "world", base, "/" + base):
        raise Mistake(node, f"the frame {shorten(name)} is neither {base}, the base, nor world")


def _collision_object(node, robot, link=None):
    """The obstacles of a collision object; `link`: the frame of an attached one."""
    fields = mapping(node, "a collision object")
    if "header" in fields:
        header = mapping(fields["header"], "header")
        if "frame_id" in header and link is None:
            check_frame(header["frame_id"], robot)
        elif "frame_id" in header and documents.text(header["frame_id"], "a frame") != link:
            name = shorten(header["frame_id"].value)
            raise Mistake(header["frame_id"], f"the frame {name} is not {link}, the object's link")
    _reject_unless_empty(fields, "planes")
    if "operation" in fields:
        operation = documents.text(fields["operation"], "operation")
        if operation not in ("0", "add"):
            raise Mistake(fields["operation"], f"operation {shorten(operation)} is not `add`")
    outer = _moveit_pose(fields["pose"], "pose") if "pose" in fields else None
    found = []
    for many, one, read in (
        ("primitives", "primitive", _moveit_primitive),
        ("meshes", "mesh", _moveit_mesh),
    ):
        if is_nothing(fields.get(many)):
            continue
        shapes = sequence(fields[many], many, MAX_SCENE_OBSTACLES)
        poses = sequence(get(node, f"{one}_poses", "a collision object"), f"{one}_poses")
        if len(shapes) != len(poses):
            raise Mistake(node, f"{len(shapes)} {many} have {len(poses)} {one}_poses")
        for shape, pose in zip(shapes, poses, strict=True):
            position, orientation = _moveit_pose(pose, f"{one}_poses")
            if outer is not None:  # from the left
                position, orientation = compose_poses(*outer, position, orientation)
            found += read(shape, position, orientation)
            _check_number(shape, found)
    return found


def _moveit_primitive(node, position, orientation):
    kind = documents.text(get(node, "type", "a primitive"), "type").lower()
    kind = _MOVEIT_TYPES.get(kind, kind)
    sizes = get(node, "dimensions", "a primitive")
    if kind == "box":
        return [Box(position, _sizes(sizes, "the dimensions of a box", 3), orientation)]
    if kind == "sphere":
        return [Sphere(position, *_sizes(sizes, "the dimensions of a sphere", 1))]
    if kind == "cylinder":
        length, radius = _sizes(sizes, "the dimensions of a cylinder", 2)
        return [Cylinder(position, radius, length, orientation)]
    _unknown_kind(node, kind)


def _moveit_mesh(node, position, orientation):
    points = sequence(get(node, "vertices", "a mesh"), "vertices")
    vertices = [_vector(point, "a vertex", (0.0, 0.0, 0.0)) for point in points]
    triangles = sequence(get(node, "triangles", "a mesh"), "triangles", meshes.MAX_TRIANGLES)
    faces = (_face(get(one, "vertex_indices", "a triangle")) for one in triangles)
    return _hulls(node, vertices, faces, position, orientation)


def _moveit_pose(node, what):
    """Position and quaternion (xyzw) of a pose; lists, or dicts with x, y, z, w."""
    fields = mapping(node, what)
    position = _vector(fields.get("position"), f"position of {what}", (0.0, 0.0, 0.0))
    turn = fields.get("orientation")
    return position, _turn(turn, _vector(turn, f"orientation of {what}", IDENTITY))


def _vector(node, what, default):
    """Numbers of a list, or of a dict with keys x, y, z, w; `default` if there are none."""
    if node is None or is_nothing(node):
        return default
    if isinstance(node.value, dict):
        keys = "xyzw"[: len(default)]
        node = Node([get(node, key, what) for key in keys], node.line)
    return numbers(node, what, len(default), MAX_LENGTH)


# --- MoveIt: the text that its plugin for RViz exports


def read_scene_text(path):
    """The `Scene` in a `.scene` file, in either of its versions. Raises DocumentError."""
    lines = [line.strip() for line in read_text(path).splitlines()]
    try:
        return checked_scene(Node("", 1), tuple(_scene_text(lines)))
    except Mistake as mistake:
        raise DocumentError(f"{path}:{mistake.line}: {mistake.reason}") from mistake


def _scene_text(lines):
    at, obstacles = 0, []

    def take(what, count=None, most=MAX_LENGTH):
        """The next line; with a count, so many numbers of it."""
        nonlocal at
        while at < len(lines) and not lines[at]:
            at += 1
        if at == len(lines):
            raise Mistake(Node("", max(at, 1)), f"the file ends before {what}")
        at += 1
        node = Node(lines[at - 1], at)
        if count is None:
            return node
        words = Node([Node(word, at) for word in node.value.split()], at)
        return numbers(words, what, count, most), words

    def starts_with_pose():
        """Whether an object's pose follows, as in newer files; else the number of its shapes."""
        line = next((i for i in range(at, len(lines)) if lines[i]), None)
        return line is not None and len(lines[line].split()) > 1

    def pose():
        position, _ = take("a position", 3)
        turn, node = take("an orientation", 4)
        return position, _turn(node, turn)

    def placed(outer):
        """The pose of a shape in the base's frame, and its colour, which is dropped."""
        position, orientation = pose()
        take("a colour", 4)
        if outer is not None:
            return compose_poses(*outer, position, orientation)
        return position, orientation

    def count(what):
        node = take(what)
        if not node.value.isdecimal() or len(node.value) > 9:
            raise Mistake(node, f"{what} must be a whole number, got {describe(node)}")
        return int(node.value)

    take("the scene's name")
    while (node := take("the last line, a dot")).value != ".":
        if not node.value.startswith("*"):
            raise Mistake(node, f"an object begins with *, got {describe(node)}")
        is_new = starts_with_pose()
        outer = pose() if is_new else None
        for _ in range(count("the number of shapes")):
            kind = take("a shape")
            if kind.value == "mesh":
                (num_vertices, num_faces), node = take(
                    "the numbers of vertices and triangles", 2, 1e9
                )
                if max(num_vertices, num_faces) > len(lines):
                    raise Mistake(node, "the file ends before the last triangle")
                vertices = [take("a vertex", 3)[0] for _ in range(int(num_vertices))]
                faces = [_face(take("a triangle", 3, 1e9)[1]) for _ in range(int(num_faces))]
                position, orientation = placed(outer)
                obstacles += _hulls(kind, vertices, faces, position, orientation)
                _check_number(kind, obstacles)
                continue
            number_of_sizes = {"box": 3, "sphere": 1, "cylinder": 2}.get(kind.value)
            if number_of_sizes is None:
                _unknown_kind(kind, kind.value)
            what = f"the dimensions of a {kind.value}"
            sizes = _sizes(take(what, number_of_sizes)[1], what, number_of_sizes)
            position, orientation = placed(outer)
            if kind.value == "box":
                obstacles.append(Box(position, sizes, orientation))
            elif kind.value == "sphere":
                obstacles.append(Sphere(position, *sizes))
            else:
                radius, length = sizes
                obstacles.append(Cylinder(position, radius, length, orientation))
            _check_number(kind, obstacles)
        for _ in range(count("the number of subframes") if is_new else 0):
            take("a subframe's name")
            pose()
    return obstacles


# --- robometrics and cuRobo


def curobo_obstacles(node, folder):
    """The obstacles of a cuRobo world, or of robometrics' `obstacles`, a `Node`. Raises Mistake.

    Kinds are dicts from names to fields. A pose is x, y, z and a quaternion w, x, y, z; `dims` are
    full edges. Files of meshes are relative to `folder`, and inside of it.
    """
    fields = mapping(node, "obstacles")
    for kind in fields:
        if kind not in ("cuboid", "cylinder", "sphere", "box", "mesh") and not is_nothing(
            fields[kind]
        ):
            _unknown_kind(fields[kind], kind)
    obstacles = []
    for kind in ("cuboid", "box", "cylinder", "sphere", "mesh"):
        if is_nothing(fields.get(kind)):
            continue
        for name, one in mapping(fields[kind], kind).items():
            what = f"{kind} {name[:40]}"
            if kind == "mesh":
                obstacles += _curobo_mesh(one, what, folder)
            else:
                obstacles.append(_curobo_obstacle(one, kind, what))
            _check_number(one, obstacles)
    return tuple(obstacles)


def _curobo_obstacle(node, kind, what):
    fields = mapping(node, what)
    if kind == "sphere" and "pose" not in fields:
        position = numbers(get(node, "position", what), f"position of {what}", 3, MAX_LENGTH)
    else:
        position, orientation = _curobo_pose(node, what)
    if kind in ("cuboid", "box"):
        return Box(position, _sizes(get(node, "dims", what), f"dims of {what}", 3), orientation)
    radius = _size(get(node, "radius", what), f"radius of {what}")
    if kind == "sphere":
        return Sphere(position, radius)
    return Cylinder(
        position, radius, _size(get(node, "height", what), f"height of {what}"), orientation
    )


def _curobo_pose(node, what):
    pose = get(node, "pose", what)
    x, y, z, w, i, j, k = numbers(pose, f"pose of {what}", 7, MAX_LENGTH)
    return (x, y, z), _turn(pose, (i, j, k, w))


def _curobo_mesh(node, what, folder):
    """The `ConvexHull`s of a mesh, which has a `file_path`, or `vertices` and `faces`."""
    fields, scale = mapping(node, what), 1.0
    if not is_nothing(fields.get("scale")):
        scale = numbers(fields["scale"], f"scale of {what}", 3, MAX_LENGTH)
        if min(scale) <= 0:
            raise Mistake(fields["scale"], f"scale of {what} must be positive")
    position, orientation = _curobo_pose(node, what)
    if is_nothing(fields.get("file_path")):
        points = sequence(get(node, "vertices", what), "vertices")
        vertices = [numbers(one, "a vertex", 3, MAX_LENGTH) for one in points]
        faces = sequence(get(node, "faces", what), "faces", meshes.MAX_TRIANGLES)
        return _hulls(node, vertices, map(_face, faces), position, orientation, scale)
    try:
        file = fields["file_path"]
        mesh = meshes.load_mesh(documents.text(file, "file_path"), folder)
        return meshes.mesh_hulls(*mesh, position, orientation, scale)
    except meshes.MeshError as error:
        raise Mistake(file, str(error)) from error


def _face(node):
    """The vertices of a triangle, three whole numbers."""
    return tuple(int(number(one, "a triangle's vertex", 1e9)) for one in _three(node))


def _three(node):
    corners = sequence(node, "a triangle")
    if len(corners) != 3:
        raise Mistake(node, f"a triangle has 3 vertices, got {len(corners)}")
    return corners


def _hulls(node, vertices, faces, position, orientation, scale=1.0):
    """The `ConvexHull`s of a mesh in the file itself. Raises Mistake."""
    vertices = np.reshape(vertices, (-1, 3)).astype(np.float64)
    faces = np.reshape(list(faces), (-1, 3)).astype(np.int64)
    try:
        return meshes.mesh_hulls(vertices, faces, position, orientation, scale)
    except meshes.MeshError as error:
        raise Mistake(node, str(error)) from error


# --- VAMP's JSON


def vamp_obstacles(node):
    """The obstacles of a problem in VAMP's JSON, a `Node`: lists by kind. Raises Mistake.

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
    return tuple(obstacles)


def _vamp_obstacle(node, kind):
    fields, what = mapping(node, kind), f"of a {kind}"
    position = numbers(get(node, "position", kind), f"position {what}", 3, MAX_LENGTH)
    orientation = IDENTITY
    for name in ("quat_xyzw", "orientation_quat_xyzw"):
        if name in fields:
            turn = numbers(fields[name], f"{name} {what}", 4, MAX_LENGTH)
            orientation = _turn(fields[name], turn)
            break
    else:
        if "orientation_euler_xyz" in fields:
            angles = numbers(fields["orientation_euler_xyz"], f"orientation {what}", 3, MAX_LENGTH)
            orientation = from_euler(*angles)
    if kind == "box":
        if "half_extents" in fields:
            halves = _sizes(fields["half_extents"], f"half_extents {what}", 3)
            return Box(position, tuple(2 * half for half in halves), orientation)
        return Box(position, _sizes(get(node, "size", kind), f"size {what}", 3), orientation)
    radius = _size(get(node, "radius", kind), f"radius {what}")
    if kind == "sphere":
        return Sphere(position, radius)
    return Cylinder(
        position, radius, _size(get(node, "length", kind), f"length {what}"), orientation
    )


# --- Poses and sizes


def from_euler(x, y, z):
    """The quaternion (xyzw) of turns about the fixed x, then y, then z axis, rad."""
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(a / 2), math.sin(a / 2)) for a in (x, y, z))
    return (
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz - sx * sy * cz,
        cx * cy * cz + sx * sy * sz,
    )


def multiply(one, other):
    """The product of two quaternions (xyzw)."""
    (a, b, c, d), (x, y, z, w) = one, other
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )


def compose_poses(position, orientation, inner_position, inner_orientation):
    """The pose of an inner pose in an outer one: position (3,), m, and quaternion (xyzw)."""
    moved = np.array(position) + matrix(orientation) @ np.array(inner_position)
    return tuple(moved.tolist()), multiply(orientation, inner_orientation)


def _turn(node, quaternion):
    """A quaternion (xyzw) of norm 1. Raises Mistake."""
    try:
        return unit_quaternion(quaternion)
    except ValueError as error:
        raise Mistake(node, str(error)) from error


def _sizes(node, what, count):
    values = numbers(node, what, count, MAX_LENGTH)
    if min(values) <= 0:
        raise Mistake(node, f"{what} must be positive")
    return values


def _size(node, what):
    value = number(node, what, MAX_LENGTH)
    if value <= 0:
        raise Mistake(node, f"{what} must be positive, got {describe(node)}")
    return value


def _unknown_kind(node, kind):
    if kind in UNSUPPORTED:
        reject(node, kind)
    raise Mistake(node, f"unknown kind of obstacle {shorten(kind)}")


def _check_number(node, obstacles):
    if len(obstacles) > MAX_SCENE_OBSTACLES:
        raise Mistake(node, f"a scene has at most {MAX_SCENE_OBSTACLES:,} obstacles")
