"""Scenes as YAML files, which people can write. Mistakes are reported with their line.

All lengths in metres, in the frame of the robot's base (x forward, y left, z up):

    robot: ur5.yaml # the arm: a file, relative to this one (docs/customise/robot.md); the Panda if
                    # left out
    held: {panda_finger_joint1: 0.025}  # where its other joints are held, rad or m; as the robot
                    # has them if left out
    table: true     # true (as if left out): the standard table; false: none; or one of your own,
                    # {position: [x, y, z], size: [x, y, z]}, turned like a box
    floor: -0.6     # height of the floor's surface (-0.6 if left out); false: none
    friction: 0.5   # the obstacles' friction coefficient (0.5 if left out)
    obstacles:      # positions are centres
      - box: {position: [0.5, 0.0, 0.3], size: [0.3, 0.04, 0.6]}            # full edges
      - box: {position: [0.5, 0.3, 0.3], size: [0.3, 0.04, 0.6], yaw: 45}   # degrees about z
      - cylinder: {position: [0.4, 0.4, 0.25], radius: 0.05, length: 0.5,   # around its own z axis
                   orientation: [0, 0, 0, 1]}                               # quaternion x, y, z, w
      - sphere: {position: [0.3, -0.4, 0.5], radius: 0.1}
      - convex_hull: {position: [-0.4, 0.4, 0.2], vertices: [[0, 0, 0], [0.2, 0, 0],  # in its own
                      [0, 0.2, 0], [0, 0, 0.2]]}       # frame, whose origin is at the position

An obstacle can be a mesh of a file in this file's folder, or below: `mesh: {file: part.stl, scale:
0.001, decompose: true, position: [0.5, 0, 0.2]}`. `scale` is 1 and `decompose` false if left out:
then a mesh's convex hull takes its place (`envs.scenes.meshes`).

Obstacles may have `may_touch`: `true`, or names of links, such as `[panda_hand]`, whose contacts
with it are no collisions; `true` means the hand and its fingers. Objects that the arm carries are
listed like obstacles under the key `attached`, placed in the frame of a link: `- box: {link:
panda_hand, position: [0, 0, 0.1], size: [0.05, 0.05, 0.2], touch_links: []}`. `link` is the one
with the end effector if left out. `touch_links` are links that the object may touch, besides those
that move with it.

Obstacles may move, appear and disappear (`envs.scenes.motions`); times in s, from the start of an
episode, angles in rad:

      - box: {position: [0.5, 0, 0.3], size: [0.1, 0.1, 0.1], motion: {oscillation: {amplitude:
              [0, 0.2, 0], period: 4, phase: 0, axis: [0, 0, 1], angle: 0}}}  # all but the period
                                                                              # may be left out
      - sphere: {position: [0.5, 0, 0.5], radius: 0.1, motion: {waypoints: {times: [1, 2],
                 displacements: [[0, 0, 0], [0, 0.3, 0]], rotations: [[0, 0, 0, 1], [0, 0, 0, 1]],
                 repeat: back_and_forth}}}  # or once, as if left out, or cyclic
      - box: {position: [0.5, 0, 0.3], size: [0.1, 0.1, 0.1], motion: {present: [[0, 2], [5]]}}

`rotations` may be left out. `present` are intervals of time, of which the last one may have no end;
it may stand beside `oscillation` or `waypoints`. A mesh and the table cannot move.

All but a sphere may have `yaw` or `orientation`, not both. A quaternion whose norm differs from
1 by up to 1 % is normalised. A number is any finite number that Python's `float` reads, without
quotes; also `1e-2`, which YAML 1.1 treats as text. YAML's anchors and aliases (`&a`, `*a`) work;
tags (`!a`) and merge keys (`<<`) are rejected. Positions are not checked here: the simulator
reports collisions with the arm.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.variants import MAX_ATTACHED, with_attached, with_held
from roboarm_nmp.envs.scenes.meshes import load_mesh, mesh_hulls
from roboarm_nmp.envs.scenes.motions import (
    MAX_INTERVALS,
    MAX_TIME,
    MAX_WAYPOINTS,
    ONCE,
    REPEATS,
    Motion,
    Oscillation,
    Presence,
    Waypoints,
)
from roboarm_nmp.envs.scenes.numbers import MAX_LENGTH, Quaternion, unit_quaternion
from roboarm_nmp.envs.scenes.primitives import (
    FRICTION,
    IDENTITY,
    MAX_HULL_VERTICES,
    MAX_SCENE_OBSTACLES,
    TABLE,
    Attached,
    Box,
    ConvexHull,
    Cylinder,
    ObservedScene,
    Obstacle,
    Scene,
    Sphere,
    check_obstacle,
)
from roboarm_nmp.utils import documents
from roboarm_nmp.utils.documents import (
    DocumentError,
    Mistake,
    Node,
    describe,
    errors_at,
    load_document,
    mistakes_in,
    number,
    numbers,
    parse_document,
    sequence,
    shorten,
    switch,
)
from roboarm_nmp.utils.files import write_atomically

_HEADER = """\
# A scene for RoboArm-NMP. Lengths in metres, in the frame of the robot's base: x forward, y left,
# z up. The format is described in envs/scenes/files.py.
"""


def load_scene(path: str | Path) -> Scene:
    """The `Scene` in a YAML file (format: see the module). Nothing in the file is executed.

    Raises:
        DocumentError: the file is missing, is not a scene, or has a misspelt key.
    """
    root = load_document(path, allow_tags=False)
    with mistakes_in(path):
        return _scene(root, Path(path).parent)


def save_scene(scene: Scene, path: str | Path) -> None:
    """Write a scene so that `load_scene` returns an equal one, with every float exact.

    It writes atomically: `path` always has the whole old file or the whole new one.

    Raises:
        DocumentError: `load_scene` would reject the file, or the scene is an `ObservedScene`, whose
            points a scene file cannot have. Nothing is written then.
        OSError: the file cannot be written; an old file is left as it was.
    """
    path = Path(path)
    if isinstance(scene, ObservedScene):
        raise DocumentError(f"{path}: cannot be written, the scene has points: save them as .npy")
    text = _format_scene(scene)
    try:
        _scene(parse_document(text), path.parent)
    except Mistake as mistake:
        line = text.splitlines()[mistake.line - 1].strip()
        raise DocumentError(f"{path}: cannot be written, {mistake.reason}: {line}") from None
    write_atomically(path, text.encode())


# --- Writing


def _format_scene(scene: Scene) -> str:
    robot = scene.robot
    lines = []
    if robot.arm != PANDA:
        lines.append(f"robot: {json.dumps(robot.source)}")
    if robot.held_positions != robot.arm.held_positions:
        lines.append(f"held: {_in_one_line(robot.held)}")
    if robot.attached:
        lines.append("attached:")
    for attached in robot.attached:
        entry = obstacle_entry(attached.shape)
        [fields] = entry.values()
        fields["link"] = attached.link
        if attached.touch_links:
            fields["touch_links"] = attached.touch_links
        lines.append(f"  - {_in_one_line(entry)[1:-1]}")
    if scene.table is None or scene.table == TABLE:
        lines.append(f"table: {'false' if scene.table is None else 'true'}")
    else:
        lines.append(f"table: {_in_one_line(obstacle_entry(scene.table)['box'])}")
    lines.append(f"floor: {'false' if scene.floor is None else float(scene.floor)}")
    if scene.friction != FRICTION:
        lines.append(f"friction: {float(scene.friction)}")
    lines.append("obstacles:" if scene.obstacles else "obstacles: []")
    lines += [f"  - {_in_one_line(obstacle_entry(obstacle))[1:-1]}" for obstacle in scene.obstacles]
    return _HEADER + "\n".join(lines) + "\n"


def obstacle_entry(obstacle: Obstacle) -> dict[str, dict[str, Any]]:
    """An obstacle's kind and fields, as they are in a file; numbers may be NumPy's."""
    kind = "convex_hull" if isinstance(obstacle, ConvexHull) else type(obstacle).__name__.lower()
    fields = vars(obstacle) | {"motion": _motion_fields(obstacle.motion)}
    for name in ("motion", "may_touch"):
        if not fields[name]:
            del fields[name]
    if fields.get("orientation") == IDENTITY:
        del fields["orientation"]
    return {kind: fields}


def _motion_fields(motion: Motion | None) -> dict[str, Any] | None:
    if isinstance(motion, Presence):
        intervals = [[time for time in pair if time < math.inf] for pair in motion.intervals]
        return (_motion_fields(motion.motion) or {}) | {"present": intervals}
    if motion is None:
        return None
    fields = {name: value for name, value in vars(motion).items() if value != ()}
    return {type(motion).__name__.lower(): fields}


def _in_one_line(value: Any) -> str:
    """Mappings, lists, numbers and names as YAML, every float exact."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_in_one_line(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(map(_in_one_line, value)) + "]"
    if value is None or isinstance(value, (bool, str)):
        return json.dumps(value)
    return repr(float(value))


# --- Reading. Each function gets a node of the file, and raises `Mistake`.


def _scene(node: Node, folder: Path) -> Scene:
    """The `Scene` of a document; the files it names are relative to `folder`."""
    keys = ("robot", "held", "attached", "table", "floor", "friction", "obstacles")
    fields = _fields(node, "a scene", optional=keys)
    scene = {}
    robot = PANDA
    if "robot" in fields:
        robot = _robot(fields["robot"], folder)
    if "held" in fields:
        held = _fields(fields["held"], "held", optional=tuple(robot.held))
        positions = {joint: number(at, joint, MAX_LENGTH) for joint, at in held.items()}
        with errors_at(fields["held"]):
            robot = with_held(robot, positions)
    if "attached" in fields:
        attached = _attached(fields["attached"], folder)
        with errors_at(fields["attached"]):
            robot = with_attached(robot, attached)
    if "table" in fields:
        scene["table"] = _table(fields["table"])
    if "floor" in fields:
        scene["floor"] = _floor(fields["floor"])
    if "friction" in fields:
        friction = scene["friction"] = number(fields["friction"], "friction", MAX_LENGTH)
        if friction < 0:
            raise Mistake(fields["friction"], f"friction must not be negative, got {friction}")
    if "obstacles" in fields:
        scene["obstacles"] = _obstacles(fields["obstacles"], folder)
    with errors_at(node):  # an obstacle may touch a link that the robot does not have
        return Scene(robot=robot, **scene)


def _robot(node: Node, folder: Path) -> Robot:
    name = documents.text(node, "robot")
    with errors_at(node):
        return load_robot(name if name == PANDA.name else folder / name)


def _attached(node: Node, folder: Path) -> list[Attached]:
    objects = []
    for entry in _list(node, "attached"):
        shapes, more = _shapes(entry, folder, ("link", "touch_links"))
        link = documents.text(more["link"], "link") if "link" in more else None
        touch_links = _names(more["touch_links"], "touch_links") if "touch_links" in more else ()
        with errors_at(entry):
            objects += [Attached(shape, link, touch_links) for shape in shapes]
        if len(objects) > MAX_ATTACHED:
            raise Mistake(entry, f"an arm has at most {MAX_ATTACHED} attached objects")
    return objects


def _names(node: Node, what: str) -> tuple[str, ...]:
    """Names of links."""
    if not isinstance(node.value, list):
        raise Mistake(node, f"{what} must be a list of links' names, got {describe(node)}")
    return tuple(documents.text(name, "a link's name") for name in node.value)


def _table(node: Node) -> Box | None:
    standard = switch(node)
    if standard is not None:
        return TABLE if standard else None
    if not isinstance(node.value, dict):
        expected = "true, false or {position: [x, y, z], size: [x, y, z]}"
        raise Mistake(node, f"table must be {expected}, got {describe(node)}")
    fields = _fields(node, "table", *_KEYS["box"], more=("may_touch", "motion"))
    if "motion" in fields:
        raise Mistake(node, "the table cannot move: leave it out, and add a box that does")
    return replace(_box(fields, "table"), may_touch=_may_touch(fields))


def _floor(node: Node) -> float | None:
    is_standard = switch(node)
    if is_standard:
        raise Mistake(node, "floor must be a height in metres or false, got true")
    return None if is_standard is False else number(node, "floor", MAX_LENGTH)


def _obstacles(node: Node, folder: Path) -> list[Obstacle]:
    if not isinstance(node.value, list):
        reason = f"obstacles must be a list ([] if there are none), got {describe(node)}"
        raise Mistake(node, reason)
    obstacles = []
    for entry in node.value:
        shapes, more = _shapes(entry, folder, ("may_touch", "motion"))
        may_touch = _may_touch(more)
        obstacles += [replace(shape, may_touch=may_touch) for shape in shapes]
        if len(obstacles) > MAX_SCENE_OBSTACLES:
            raise Mistake(entry, f"a scene has at most {MAX_SCENE_OBSTACLES:,} obstacles")
    return obstacles


def _may_touch(fields: dict[str, Node]) -> tuple[str, ...] | bool:
    if "may_touch" not in fields:
        return ()
    node = fields["may_touch"]
    touches_hand = switch(node)
    if touches_hand is not None:
        return touches_hand
    if not isinstance(node.value, list):
        expected = "a list of links' names, or true, or false"
        raise Mistake(node, f"may_touch must be {expected}, got {describe(node)}")
    return _names(node, "may_touch")


# The keys of each kind of obstacle: those that it needs, and those that it may have.
_KEYS = {
    "box": (("position", "size"), ("orientation", "yaw")),
    "cylinder": (("position", "radius", "length"), ("orientation", "yaw")),
    "sphere": (("position", "radius"), ()),
    "convex_hull": (("position", "vertices"), ("orientation", "yaw")),
    "mesh": (("file", "position"), ("scale", "decompose", "orientation", "yaw")),
}


def _shapes(
    node: Node, folder: Path, more: tuple[str, ...]
) -> tuple[tuple[Obstacle, ...], dict[str, Node]]:
    """An entry's shapes, of which a mesh may be several, and its fields.

    `more`: the keys that the entry may have besides those of its kind.
    """
    kinds = ", ".join(_KEYS)
    if not isinstance(node.value, dict):
        expected = f"a mapping of its kind ({kinds}) to its fields"
        raise Mistake(node, f"an obstacle must be {expected}, got {describe(node)}")
    if len(node.value) != 1:
        keys = ", ".join(map(shorten, list(node.value)[:5])) or "none"
        raise Mistake(node, f"an obstacle must have exactly one key, its kind ({kinds}): {keys}")
    [(kind, value)] = node.value.items()
    if kind not in _KEYS:
        raise Mistake(kind, f"unknown kind of obstacle {shorten(kind)}: one of {kinds}")
    if kind == "mesh":
        more = tuple(name for name in more if name != "motion")
    fields = _fields(value, kind, *_KEYS[kind], more=more)
    if kind == "mesh":
        return _mesh(fields, folder), fields
    return (_shape(fields, kind),), fields


def _shape(fields: dict[str, Node], kind: str) -> Obstacle:
    if kind == "box":
        return _box(fields, kind)
    position = numbers(fields["position"], f"position of {kind}", 3, MAX_LENGTH)
    motion = _motion(fields, kind)
    if kind == "sphere":
        return Sphere(position, _size(fields, "radius", kind), motion)
    orientation = _orientation(fields, kind)
    if kind == "cylinder":
        radius = _size(fields, "radius", kind)
        return Cylinder(position, radius, _size(fields, "length", kind), orientation, motion)
    vertices = fields["vertices"]
    points = _list(vertices, "vertices")
    if len(points) > MAX_HULL_VERTICES:
        raise Mistake(vertices, f"{kind} has at most {MAX_HULL_VERTICES} vertices")
    points = [numbers(point, f"a vertex of {kind}", 3, MAX_LENGTH) for point in points]
    hull = ConvexHull(position, tuple(points), orientation, motion)
    with errors_at(vertices):
        check_obstacle(hull)
    return hull


def _box(fields: dict[str, Node], what: str) -> Box:
    return Box(
        numbers(fields["position"], f"position of {what}", 3, MAX_LENGTH),
        numbers(fields["size"], f"size of {what}", 3, MAX_LENGTH, positive=True),
        _orientation(fields, what),
        _motion(fields, what),
    )


def _size(fields: dict[str, Node], key: str, what: str) -> float:
    return number(fields[key], f"{key} of {what}", MAX_LENGTH, positive=True)


def _mesh(fields: dict[str, Node], folder: Path) -> tuple[ConvexHull, ...]:
    file = documents.text(fields["file"], "file")
    scale = 1.0
    if "scale" in fields:
        scale = _size(fields, "scale", "mesh")
    decompose = False
    if "decompose" in fields:
        decompose = switch(fields["decompose"])
        if decompose is None:
            got = describe(fields["decompose"])
            raise Mistake(fields["decompose"], f"decompose must be true or false, got {got}")
    position = numbers(fields["position"], "position of mesh", 3, MAX_LENGTH)
    orientation = _orientation(fields, "mesh")
    with errors_at(fields["file"]):
        vertices, faces = load_mesh(file, folder)
        return mesh_hulls(vertices, faces, position, orientation, scale, decompose)


def _orientation(fields: dict[str, Node], what: str) -> Quaternion:
    """Quaternion (x, y, z, w) from `orientation` or `yaw`; the identity without both."""
    if "yaw" in fields and "orientation" in fields:
        raise Mistake(fields["yaw"], f"{what} has both yaw and orientation, only one is allowed")
    if "yaw" in fields:
        half = math.radians(number(fields["yaw"], f"yaw of {what}", MAX_LENGTH)) / 2
        return (0.0, 0.0, math.sin(half), math.cos(half))
    if "orientation" not in fields:
        return IDENTITY
    node = fields["orientation"]
    quaternion = numbers(node, f"orientation of {what}", 4, MAX_LENGTH)
    with errors_at(node, f"orientation of {what}"):
        return unit_quaternion(quaternion)


def _motion(fields: dict[str, Node], what: str) -> Motion | None:
    """The motion of an obstacle; None without one."""
    if "motion" not in fields:
        return None
    node = fields["motion"]
    parts = _fields(node, f"motion of {what}", optional=("oscillation", "waypoints", "present"))
    if not parts or "oscillation" in parts and "waypoints" in parts:
        raise Mistake(node, f"motion of {what} must be one of oscillation, waypoints, or present")
    motion = None
    with errors_at(node, f"motion of {what}"):
        if "oscillation" in parts:
            motion = _oscillation(parts["oscillation"])
        if "waypoints" in parts:
            motion = _waypoints(parts["waypoints"])
        if "present" in parts:
            motion = Presence(_intervals(parts["present"]), motion)
    return motion


def _oscillation(node: Node) -> Oscillation:
    what = "oscillation"
    fields = _fields(node, what, ("period",), ("amplitude", "axis", "phase", "angle"))
    values = {}
    for name, value in fields.items():
        if name in ("amplitude", "axis"):
            values[name] = numbers(value, f"{name} of {what}", 3, MAX_LENGTH)
        else:
            values[name] = number(value, f"{name} of {what}", MAX_TIME)
    return Oscillation(**values)


def _waypoints(node: Node) -> Waypoints:
    fields = _fields(node, "waypoints", ("times", "displacements"), ("rotations", "repeat"))

    def rows(name: str) -> list[Node]:
        return _list(fields[name], f"{name} of waypoints", MAX_WAYPOINTS)

    def vectors(name: str, count: int) -> tuple[tuple[Any, ...], ...]:
        return tuple(numbers(row, f"{name} of waypoints", count, MAX_LENGTH) for row in rows(name))

    times = tuple(number(time, "times of waypoints", MAX_TIME) for time in rows("times"))
    rotations = vectors("rotations", 4) if "rotations" in fields else ()
    repeat = ONCE
    if "repeat" in fields:
        repeat = fields["repeat"].value
        if not isinstance(repeat, str) or repeat not in REPEATS:
            got = describe(fields["repeat"])
            reason = f"repeat must be one of {', '.join(REPEATS)}, got {got}"
            raise Mistake(fields["repeat"], reason)
    return Waypoints(times, vectors("displacements", 3), rotations, repeat)


def _intervals(node: Node) -> tuple[tuple[float, float], ...]:
    """Intervals of `Presence`; one of a single time has no end."""
    intervals = []
    for row in _list(node, "present", MAX_INTERVALS):
        ends = _list(row, "an interval of present", 2)
        times = [number(end, "an interval of present", MAX_TIME) for end in ends]
        if len(times) == 1:
            times.append(math.inf)
        intervals.append(tuple(times))
    return tuple(intervals)


def _list(node: Node, what: str, most: int | None = None) -> list[Node]:
    """The nodes of a list, which must not be null. Raises Mistake: it has more than `most`."""
    if not isinstance(node.value, list):
        raise Mistake(node, f"{what} must be a list, got {describe(node)}")
    return sequence(node, what, most)


def _fields(
    node: Node,
    what: str,
    required: tuple[str, ...] = (),
    optional: tuple[str, ...] = (),
    more: tuple[str, ...] = (),
) -> dict[str, Node]:
    """The values of a mapping by key, with all required keys and no unknown key."""
    known = (*required, *optional, *more)
    keys = ", ".join(known)
    if not isinstance(node.value, dict):
        raise Mistake(node, f"{what} must be a mapping with keys {keys}, got {describe(node)}")
    for key in node.value:
        if key not in known:
            raise Mistake(key, f"unknown key {shorten(key)} in {what}: known are {keys}")
    missing = [key for key in required if key not in node.value]
    if missing:
        raise Mistake(node, f"{what} lacks {', '.join(missing)}")
    return documents.mapping(node, what)
