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

import yaml

from roboarm_nmp.envs.robots.attached import MAX_ATTACHED
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.meshes import MeshError, load_mesh, mesh_hulls
from roboarm_nmp.envs.scenes.motions import (
    MAX_INTERVALS,
    MAX_TIME,
    MAX_WAYPOINTS,
    ONCE,
    REPEATS,
    Oscillation,
    Presence,
    Waypoints,
)
from roboarm_nmp.envs.scenes.primitives import (
    FLOOR,
    FRICTION,
    IDENTITY,
    MAX_HULL_VERTICES,
    MAX_LENGTH,
    MAX_SCENE_OBSTACLES,
    TABLE,
    Attached,
    Box,
    ConvexHull,
    Cylinder,
    ObservedScene,
    Scene,
    Sphere,
    check_obstacle,
    unit_quaternion,
)
from roboarm_nmp.utils.files import write_atomically

_MAX_DEPTH = 12  # a scene needs 10
# Values of a file with aliases, each repeated value counted. (A small file could be gigabytes.)
_MAX_REPEATED = 1_000_000
_HEADER = """\
# A scene for RoboArm-NMP. Lengths in metres, in the frame of the robot's base: x forward, y left,
# z up. The format is described in envs/scenes/files.py.
"""


class SceneFileError(ValueError):
    """A scene file that cannot be used. The message is `PATH:LINE: reason`, with lines from 1.

    It is `PATH: reason` where a file cannot be read, or a scene cannot be written.
    """


def load_scene(path):
    """The `Scene` in a YAML file (format: see the module). Nothing in the file is executed.

    Raises:
        SceneFileError: the file is missing, or is not a scene; also for a misspelt key.
    """
    try:
        contents = Path(path).read_bytes()
    except OSError as error:
        raise SceneFileError(f"{path}: {error.strerror}") from error
    try:
        return _parse(contents, Path(path).parent)
    except _Mistake as mistake:
        raise SceneFileError(f"{path}:{mistake.line}: {mistake.reason}") from mistake.__cause__


def save_scene(scene, path):
    """Write a scene so that `load_scene` returns an equal one, with every float exact.

    Atomic: at every moment `path` is the old file or the whole new one.

    Raises:
        SceneFileError: `load_scene` would reject the file, which is then not written; or the scene
            is an `ObservedScene`, whose points a scene file cannot have.
        OSError: the file cannot be written; an old file is left as it was.
    """
    path = Path(path)
    if isinstance(scene, ObservedScene):
        raise SceneFileError(f"{path}: cannot be written, the scene has points: save them as .npy")
    text = _format_scene(scene)
    try:
        _parse(text.encode(), path.parent)
    except _Mistake as mistake:
        line = text.splitlines()[mistake.line - 1].strip()
        raise SceneFileError(f"{path}: cannot be written, {mistake.reason}: {line}") from None
    write_atomically(path, text.encode())


# --- Writing


def _format_scene(scene):
    table = "false" if scene.table is None else _format_fields(scene.table)
    robot, held = scene.robot, ""
    if robot.held_positions != robot.arm.held_positions:
        held = ", ".join(f"{joint}: {value!r}" for joint, value in robot.held.items())
    lines = [
        *[f"robot: {robot.source}"] * (robot.arm != PANDA),
        *[f"held: {{{held}}}"] * bool(held),
        *["attached:"] * bool(robot.attached),
        *[f"  - {_format_obstacle(one.shape, _format_link(one))}" for one in robot.attached],
        f"table: {'true' if scene.table == TABLE else table}",
        f"floor: {'false' if scene.floor is None else repr(float(scene.floor))}",
        *[f"friction: {float(scene.friction)!r}"] * (scene.friction != FRICTION),
        "obstacles:" if scene.obstacles else "obstacles: []",
    ]
    lines += [f"  - {_format_obstacle(obstacle)}" for obstacle in scene.obstacles]
    return _HEADER + "\n".join(lines) + "\n"


def _format_obstacle(obstacle, more=()):
    kind = "convex_hull" if isinstance(obstacle, ConvexHull) else type(obstacle).__name__.lower()
    return f"{kind}: {_format_fields(obstacle, more)}"


def _format_link(attached):
    yield f"link: {json.dumps(attached.link)}"
    if attached.touch_links:
        yield f"touch_links: {json.dumps(attached.touch_links)}"


def _format_fields(obstacle, more=()):
    """The dataclass's fields, and texts of more fields, as a YAML mapping on one line."""
    fields = []
    for name, value in vars(obstacle).items():
        if name == "motion":
            if value is not None:
                fields.append(f"motion: {_format_motion(value)}")
        elif name in ("position", "size", "orientation"):
            if name == "orientation" and tuple(value) == IDENTITY:
                continue
            fields.append(f"{name}: {_format_numbers(value)}")
        elif name == "vertices":
            fields.append(f"{name}: [{', '.join(map(_format_numbers, value))}]")
        elif name == "may_touch":
            fields += [f"{name}: {json.dumps(value)}"] * bool(value)
        else:
            fields.append(f"{name}: {float(value)!r}")
    return "{" + ", ".join([*fields, *more]) + "}"


def _format_motion(motion):
    present = ""
    if isinstance(motion, Presence):
        intervals = [_format_numbers(n for n in one if n < math.inf) for one in motion.intervals]
        present, motion = f"present: [{', '.join(intervals)}]", motion.motion
    if motion is None:
        return f"{{{present}}}"
    if isinstance(motion, Oscillation):
        kind, vectors = "oscillation", ("amplitude", "axis")
        fields = [f"{name}: {_format_numbers(getattr(motion, name))}" for name in vectors]
        fields += [f"{name}: {getattr(motion, name)!r}" for name in ("period", "phase", "angle")]
    else:
        kind, fields = "waypoints", [f"times: {_format_numbers(motion.times)}"]
        for name in ("displacements", "rotations"):
            if rows := getattr(motion, name):
                fields.append(f"{name}: [{', '.join(map(_format_numbers, rows))}]")
        fields.append(f"repeat: {motion.repeat}")
    present = f", {present}" if present else ""
    return f"{{{kind}: {{{', '.join(fields)}}}{present}}}"


def _format_numbers(numbers):
    return f"[{', '.join(repr(float(number)) for number in numbers)}]"


# --- Reading. PyYAML only composes nodes, which have line numbers; the functions below descend the
# format. So neither aliases that contain themselves nor deep ones need any care.


class _Mistake(Exception):
    def __init__(self, line, reason):
        super().__init__(line, reason)
        self.line, self.reason = line, reason


def _mistake(node, reason):
    return _Mistake(node.start_mark.line + 1, reason)


class _Loader(yaml.SafeLoader):
    """Composes nodes, except tagged or deeply nested ones (PyYAML would recurse without limit).

    Aliases may repeat up to `_MAX_REPEATED` values.
    """

    depth = values = 0

    def compose_node(self, parent, index):
        event = self.peek_event()
        if getattr(event, "tag", None) is not None:
            raise _mistake(event, "tags (words that start with !) are not allowed")
        if self.depth == _MAX_DEPTH:
            raise _mistake(event, "nested too deeply")
        self.depth += 1
        before = self.values
        node = super().compose_node(parent, index)
        self.depth -= 1
        if not isinstance(event, yaml.AliasEvent):
            self.values += 1
            node.values = self.values - before
            return node
        self.values += getattr(node, "values", 1)  # it has none yet where it contains itself
        if self.values > _MAX_REPEATED:
            raise _mistake(event, f"with its aliases, the file has over {_MAX_REPEATED:,} values")
        return node


def _parse(contents, folder):
    """bytes -> `Scene`, whose robot's file is relative to `folder`. Raises `_Mistake`."""
    try:
        text = contents.decode()
    except UnicodeDecodeError as error:
        line = contents.count(b"\n", 0, error.start) + 1
        raise _Mistake(line, f"byte {contents[error.start]:#04x} is not UTF-8 text") from error
    node = _compose(text)
    if node is None or _is_plain(node) and node.value == "":
        raise _Mistake(1, "the file is empty (a scene without obstacles of its own is {})")
    return _scene(node, folder)


def _compose(text):
    """The root node of the only document; None if there is no document."""
    try:
        loader = _Loader(text)
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise _Mistake(line, f"character {error.character:#x} is not allowed") from error
    try:
        return loader.get_single_node()
    except yaml.MarkedYAMLError as error:
        reason, mark = error.problem, error.problem_mark
        if error.context and error.context_mark:
            reason = f"{error.context} from line {error.context_mark.line + 1} on, {reason}"
        raise _Mistake(mark.line + 1, reason) from error
    except (ValueError, OverflowError) as error:  # PyYAML's, of an escape such as "\UFFFFFFFF"
        raise _Mistake(loader.line + 1, f"not valid YAML ({error})") from error
    finally:
        loader.dispose()


def _scene(node, folder):
    keys = ("robot", "held", "attached", "table", "floor", "friction", "obstacles")
    fields = _mapping(node, "a scene", optional=keys)
    table, floor, friction, obstacles, robot = TABLE, FLOOR, FRICTION, (), PANDA
    if "robot" in fields:
        robot = _robot(fields["robot"], folder)
    if "held" in fields:
        robot = _held(fields["held"], robot)
    if "attached" in fields:
        robot = _attached(fields["attached"], robot, folder)
    if "table" in fields:
        table = _table(fields["table"])
    if "floor" in fields:
        switch = _switch(fields["floor"])
        if switch is True:
            raise _mistake(fields["floor"], "floor must be a height in metres or false, got true")
        floor = None if switch is False else _number(fields["floor"], "floor")
    if "friction" in fields:
        friction = _number(fields["friction"], "friction")
        if friction < 0:
            raise _mistake(fields["friction"], f"friction must not be negative, got {friction}")
    if "obstacles" in fields:
        node = fields["obstacles"]
        if not isinstance(node, yaml.SequenceNode):
            reason = f"obstacles must be a list ([] if there are none), got {_describe(node)}"
            raise _mistake(node, reason)
        if len(node.value) > MAX_SCENE_OBSTACLES:
            raise _mistake(node, f"a scene has at most {MAX_SCENE_OBSTACLES:,} obstacles")
        obstacles = []
        for entry in node.value:
            obstacles += _obstacle(entry, folder)
            if len(obstacles) > MAX_SCENE_OBSTACLES:  # a mesh may be several
                raise _mistake(entry, f"a scene has at most {MAX_SCENE_OBSTACLES:,} obstacles")
    try:
        return Scene(obstacles, table, floor, friction, robot)
    except ValueError as error:  # an obstacle may touch a link that the robot does not have
        raise _mistake(node, str(error)) from error


def _robot(node, folder):
    if not isinstance(node, yaml.ScalarNode):
        raise _mistake(node, f"robot must be a file's name, got {_describe(node)}")
    try:
        return load_robot(node.value if node.value == PANDA.name else folder / node.value)
    except ValueError as error:
        raise _mistake(node, str(error)) from error


def _held(node, robot):
    held = _mapping(node, "held", optional=tuple(robot.held))
    try:
        return robot.with_held({joint: _number(at, joint) for joint, at in held.items()})
    except ValueError as error:
        raise _mistake(node, str(error)) from error


def _attached(node, robot, folder):
    if not isinstance(node, yaml.SequenceNode):
        raise _mistake(node, f"attached must be a list, got {_describe(node)}")
    found = []
    for entry in node.value:
        shapes, more = _shapes(entry, folder, ("link", "touch_links"))
        link = more.get("link")
        if link is not None and not isinstance(link, yaml.ScalarNode):
            raise _mistake(link, f"link must be a link's name, got {_describe(link)}")
        touched = _names(more["touch_links"], "touch_links") if "touch_links" in more else ()
        try:
            found += [Attached(shape, link and link.value, touched) for shape in shapes]
        except ValueError as error:
            raise _mistake(entry, str(error)) from error
        if len(found) > MAX_ATTACHED:
            raise _mistake(entry, f"an arm has at most {MAX_ATTACHED} attached objects")
    try:
        return robot.with_attached(found)
    except ValueError as error:
        raise _mistake(node, str(error)) from error


def _names(node, what):
    """Names of links, a tuple."""
    if not isinstance(node, yaml.SequenceNode):
        raise _mistake(node, f"{what} must be a list of links' names, got {_describe(node)}")
    if wrong := [one for one in node.value if not isinstance(one, yaml.ScalarNode)]:
        raise _mistake(wrong[0], f"a link's name must be text, got {_describe(wrong[0])}")
    return tuple(one.value for one in node.value)


def _table(node):
    switch = _switch(node)
    if switch is not None:
        return TABLE if switch else None
    if not isinstance(node, yaml.MappingNode):
        expected = "true, false or {position: [x, y, z], size: [x, y, z]}"
        raise _mistake(node, f"table must be {expected}, got {_describe(node)}")
    table = _box(node, "table", ("may_touch", "motion"))
    if table.motion is not None:
        raise _mistake(node, "the table cannot move: leave it out, and add a box that does")
    return replace(table, may_touch=_may_touch(_some(node, ("may_touch",))))


def _obstacle(node, folder):
    """A tuple of obstacles: a mesh may be several."""
    shapes, more = _shapes(node, folder, ("may_touch", "motion"))
    return [replace(shape, may_touch=_may_touch(more)) for shape in shapes]


def _may_touch(fields):
    """`may_touch` of an obstacle, from the values of its further keys."""
    if "may_touch" not in fields:
        return ()
    switch = _switch(fields["may_touch"])
    try:
        return _names(fields["may_touch"], "may_touch") if switch is None else switch
    except _Mistake as mistake:
        reason = f"{mistake.reason}, or true, or false"
        raise _Mistake(mistake.line, reason) from None


def _shapes(node, folder, more):
    """An entry's shapes, a tuple, and the values (nodes) of its keys that are in `more`, a dict."""
    kinds = ", ".join((*_KINDS, "mesh"))
    if not isinstance(node, yaml.MappingNode):
        expected = f"a mapping of its kind ({kinds}) to its fields"
        raise _mistake(node, f"an obstacle must be {expected}, got {_describe(node)}")
    if len(node.value) != 1:
        keys = ", ".join(_describe(key) for key, _ in node.value[:5]) or "none"
        raise _mistake(node, f"an obstacle must have exactly one key, its kind ({kinds}): {keys}")
    [(key, fields)] = node.value
    if isinstance(key, yaml.ScalarNode) and key.value == "mesh":
        more = [name for name in more if name != "motion"]
        return _mesh(fields, key.value, folder, more), _some(fields, more)
    if not isinstance(key, yaml.ScalarNode) or key.value not in _KINDS:
        raise _mistake(key, f"unknown kind of obstacle {_describe(key)}: one of {kinds}")
    return (_KINDS[key.value](fields, key.value, more),), _some(fields, more)


def _some(node, names):
    """The values (nodes) of those keys of a mapping that are in `names`."""
    return {key.value: value for key, value in node.value if key.value in names}


def _box(node, what, more=()):
    fields = _mapping(node, what, ("position", "size"), ("orientation", "yaw", *more))
    return Box(
        _vector(fields["position"], f"position of {what}", 3),
        _vector(fields["size"], f"size of {what}", 3, positive=True),
        _orientation(fields, what),
        _motion(fields, what),
    )


def _cylinder(node, what, more):
    fields = _mapping(node, what, ("position", "radius", "length"), ("orientation", "yaw", *more))
    return Cylinder(
        _vector(fields["position"], f"position of {what}", 3),
        _number(fields["radius"], f"radius of {what}", positive=True),
        _number(fields["length"], f"length of {what}", positive=True),
        _orientation(fields, what),
        _motion(fields, what),
    )


def _sphere(node, what, more):
    fields = _mapping(node, what, ("position", "radius"), more)
    return Sphere(
        _vector(fields["position"], f"position of {what}", 3),
        _number(fields["radius"], f"radius of {what}", positive=True),
        _motion(fields, what),
    )


def _convex_hull(node, what, more):
    fields = _mapping(node, what, ("position", "vertices"), ("orientation", "yaw", *more))
    vertices = fields["vertices"]
    if not isinstance(vertices, yaml.SequenceNode):
        raise _mistake(vertices, f"vertices must be a list of points, got {_describe(vertices)}")
    if len(vertices.value) > MAX_HULL_VERTICES:
        raise _mistake(vertices, f"{what} has at most {MAX_HULL_VERTICES} vertices")
    hull = ConvexHull(
        _vector(fields["position"], f"position of {what}", 3),
        tuple(_vector(vertex, f"a vertex of {what}", 3) for vertex in vertices.value),
        _orientation(fields, what),
        _motion(fields, what),
    )
    try:
        check_obstacle(hull)
    except ValueError as error:
        raise _mistake(vertices, str(error)) from error
    return hull


def _mesh(node, what, folder, more):
    optional = ("scale", "decompose", "orientation", "yaw", *more)
    fields = _mapping(node, what, ("file", "position"), optional)
    file, scale, decompose = fields["file"], 1.0, False
    if not isinstance(file, yaml.ScalarNode):
        raise _mistake(file, f"file must be a file's name, got {_describe(file)}")
    if "scale" in fields:
        scale = _number(fields["scale"], f"scale of {what}", positive=True)
    if "decompose" in fields:
        decompose = _switch(fields["decompose"])
        if decompose is None:
            found = _describe(fields["decompose"])
            raise _mistake(fields["decompose"], f"decompose must be true or false, got {found}")
    position = _vector(fields["position"], f"position of {what}", 3)
    orientation = _orientation(fields, what)
    try:
        mesh = load_mesh(file.value, folder)
        return mesh_hulls(*mesh, position, orientation, scale, decompose)
    except MeshError as error:
        raise _mistake(file, str(error)) from error


_KINDS = {"box": _box, "cylinder": _cylinder, "sphere": _sphere, "convex_hull": _convex_hull}


def _orientation(fields, what):
    """Quaternion (x, y, z, w) from `orientation` or `yaw`; the identity without both."""
    if "yaw" in fields and "orientation" in fields:
        raise _mistake(fields["yaw"], f"{what} has both yaw and orientation, only one is allowed")
    if "yaw" in fields:
        half = math.radians(_number(fields["yaw"], f"yaw of {what}")) / 2
        return (0.0, 0.0, math.sin(half), math.cos(half))
    if "orientation" not in fields:
        return IDENTITY
    node = fields["orientation"]
    try:
        return unit_quaternion(_vector(node, f"orientation of {what}", 4))
    except ValueError as error:
        raise _mistake(node, f"orientation of {what}: {error}") from error


def _motion(fields, what):
    """The motion of an obstacle; None without one."""
    node = fields.get("motion")
    if node is None:
        return None
    kinds = {"oscillation": _oscillation, "waypoints": _waypoints}
    parts = _mapping(node, f"motion of {what}", optional=(*kinds, "present"))
    chosen = [kind for kind in kinds if kind in parts]
    if len(chosen) > 1 or not parts:
        raise _mistake(node, f"motion of {what} must be one of {', '.join(kinds)}, or present")
    try:
        motion = kinds[chosen[0]](parts[chosen[0]], chosen[0]) if chosen else None
        if "present" in parts:
            motion = Presence(_intervals(parts["present"]), motion)
    except ValueError as error:
        raise _mistake(node, f"motion of {what}: {error}") from error
    return motion


def _oscillation(node, what):
    vectors, numbers = ("amplitude", "axis"), ("period", "phase", "angle")
    fields = _mapping(node, what, ("period",), ("amplitude", "axis", "phase", "angle"))
    given = {
        name: _vector(fields[name], f"{name} of {what}", 3)
        for name in sorted(fields.keys() & set(vectors))
    }
    for name in sorted(fields.keys() & set(numbers)):
        given[name] = _number(fields[name], f"{name} of {what}", most=MAX_TIME)
    return Oscillation(**given)


def _waypoints(node, what):
    fields = _mapping(node, what, ("times", "displacements"), ("rotations", "repeat"))
    times = _list(fields["times"], f"times of {what}", MAX_WAYPOINTS)
    rows = {
        name: tuple(
            _vector(row, f"{name} of {what}", width)
            for row in _list(fields[name], f"{name} of {what}", MAX_WAYPOINTS)
        )
        for name, width in (("displacements", 3), ("rotations", 4))
        if name in fields
    }
    repeat = ONCE
    if "repeat" in fields:
        repeat = fields["repeat"].value
        if repeat not in REPEATS:
            found = _describe(fields["repeat"])
            kinds = ", ".join(REPEATS)
            raise _mistake(fields["repeat"], f"repeat must be one of {kinds}, got {found}")
    return Waypoints(
        tuple(_number(time, f"times of {what}", most=MAX_TIME) for time in times),
        repeat=repeat,
        **rows,
    )


def _intervals(node):
    """Intervals of `Presence`; one of a single time has no end."""
    intervals = []
    for row in _list(node, "present", MAX_INTERVALS):
        ends = _list(row, "an interval of present", 2)
        times = [_number(end, "an interval of present", most=MAX_TIME) for end in ends]
        intervals.append(tuple(times) if len(times) == 2 else (*times, math.inf))
    return tuple(intervals)


def _list(node, what, most):
    """The nodes of a list that is not longer than `most`."""
    if not isinstance(node, yaml.SequenceNode):
        raise _mistake(node, f"{what} must be a list, got {_describe(node)}")
    if len(node.value) > most:
        raise _mistake(node, f"{what} has {len(node.value):,} entries, at most {most:,}")
    return node.value


def _mapping(node, what, required=(), optional=()):
    """The values (nodes) of a mapping by key, with all required keys and no unknown key."""
    known = ", ".join((*required, *optional))
    if not isinstance(node, yaml.MappingNode):
        raise _mistake(node, f"{what} must be a mapping with keys {known}, got {_describe(node)}")
    fields = {}
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode) or key.value not in (*required, *optional):
            raise _mistake(key, f"unknown key {_describe(key)} in {what}: known are {known}")
        if key.value in fields:
            raise _mistake(key, f"{key.value} is in {what} twice")
        fields[key.value] = value
    missing = [key for key in required if key not in fields]
    if missing:
        raise _mistake(node, f"{what} lacks {', '.join(missing)}")
    return fields


def _vector(node, what, length, positive=False):
    if not isinstance(node, yaml.SequenceNode):
        raise _mistake(node, f"{what} must be a list of {length} numbers, got {_describe(node)}")
    if len(node.value) != length:
        raise _mistake(node, f"{what} must be a list of {length} numbers, got {len(node.value)}")
    return tuple(_number(number, what, positive) for number in node.value)


def _number(node, what, positive=False, most=MAX_LENGTH):
    try:
        number = float(node.value) if _is_plain(node) else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise _mistake(node, f"{what} must be a finite number, got {_describe(node)}")
    if abs(number) > most:
        limit = f"{most:.0f}"
        raise _mistake(node, f"{what} must be at most {limit}, got {_describe(node)}")
    if positive and number <= 0:
        raise _mistake(node, f"{what} must be positive, got {_describe(node)}")
    return number


def _switch(node):
    """True, False, or None if the node is neither `true` nor `false`."""
    return {"true": True, "false": False}.get(node.value) if _is_plain(node) else None


def _is_plain(node):
    """Whether a node is a scalar without quotes; a quoted one is always text."""
    return isinstance(node, yaml.ScalarNode) and node.style is None


def _describe(node):
    if isinstance(node, yaml.MappingNode):
        return "a mapping"
    if isinstance(node, yaml.SequenceNode):
        return "a list"
    if _is_plain(node):
        return _shorten(" ".join(node.value.split())) or "nothing"  # it may have line breaks
    return f"the text {_shorten(node.value)!r}"


def _shorten(text):
    return text if len(text) <= 40 else text[:40] + "..."
