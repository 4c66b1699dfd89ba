"""A `Robot` from a URDF, which is untrusted input: everything in it is checked first."""

import dataclasses
import hashlib
import json
import math
import re
import warnings
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from roboarm_nmp.envs.robots.attached_xml import LIGHT
from roboarm_nmp.envs.robots.body import end_effector_rotation, resolve
from roboarm_nmp.envs.robots.cache import cached
from roboarm_nmp.envs.robots.control import GAINS, calibrate
from roboarm_nmp.envs.robots.placements import about, aligning, joint_axis, joint_origin, link_steps
from roboarm_nmp.envs.robots.robot import Frame, Link, Robot
from roboarm_nmp.envs.robots.self_collisions import SAMPLES, disabled_pairs, sample_pairs
from roboarm_nmp.envs.robots.untrusted import RobotError, bullet_indices, read_xml

MAX_LINKS = 200
MAX_JOINTS, MAX_MOVABLE = 32, 100  # actuated ones, and all: PyBullet has states of 128
MAX_NAME = 200  # letters
# Bytes of all meshes, and shapes for collisions.
MAX_MESHES = {"collision": 50_000_000, "visual": 100_000_000}
MAX_SHAPES = 500
MAX_MESH = {"collision": 20_000_000, "visual": 30_000_000}  # bytes of one
BLOCK = 4_000_000  # bytes of a mesh that are read at once
MESH_ENDINGS = (".obj", ".stl", ".dae")
MOVABLE = ("revolute", "continuous", "prismatic")
MAX_STEPS = 100  # of acceleration
DEFAULT_EFFORT = 1_000.0  # N m or N, where a URDF has none
WIDENED = "limits of joints, where the file has wider ones"  # since then, gains are others
MAX_NUMBER, MAX_NORM_ERROR = 1e6, 0.01
NUMBERS = ("xyz", "rpy", "size", "radius", "length", "scale", "value", "ixx", "iyy", "izz")
NUMBERS += ("lower", "upper", "effort", "velocity", "multiplier", "offset", "ixy", "ixz", "iyz")
VECTORS = {"xyz": (3,), "rpy": (3,), "size": (3,), "scale": (1, 3)}  # how many numbers
POSITIVE = ("size", "radius", "length")


def robot_from_urdf(
    path,
    joints=None,
    end_effector=None,
    end_effector_position=(0.0, 0.0, 0.0),
    fixed=None,
    limits=None,
    srdf=None,
    packages=None,
    name=None,
    base_position=(0.0, 0.0, 0.0),
    base_orientation=(0.0, 0.0, 0.0, 1.0),
    gain=None,
    acceleration_steps=1,
    velocity=None,
    acceleration=None,
    jerk=None,
    datasheet_limits=None,
):
    """The arm that a URDF describes, as PyBullet loads it.

    The kinematic chain, axes, limits and collision shapes are the URDF's. Joints that mimic
    another one follow it.

    Args:
        path: of the URDF.
        joints: names of the n actuated joints; by default all movable joints between the base
            and the end effector.
        end_effector: name of the link that has the end effector; by default the link at the end
            of the longest chain of turning joints.
        end_effector_position: m, (3,), in that link's frame.
        fixed: dict from names of other joints, such as fingers, to where they are held (rad or
            m); by default 0, or the limit that is nearest to it.
        limits: dict from names of joints to (lower, upper), rad or m, where the URDF has none,
            or others.
        srdf: path of an SRDF, whose `disable_collisions` pairs of links do not collide. More
            pairs are left out by sampling (`envs.robots.self_collisions`).
        packages: dict from names of packages to folders, for `package://` paths of meshes.
        name: of the robot; by default the URDF's.
        base_position, base_orientation: pose of the base in the world, m and quaternion (xyzw).
        gain: of the position controllers; by default from a calibration
            (`envs.robots.control`).
        acceleration_steps: environment steps, 1 to 100, in which the sub-goals of a plan reach
            full speed after a waypoint, and slow down before the next.
        velocity, acceleration, jerk: limits of trajectories, rad/s, rad/s^2, rad/s^3 (or m): a
            number, or a dict from names of joints. By default the velocities are the URDF's, if
            it has some, and the others are unknown.
        datasheet_limits: dict from names of joints to (lower, upper), rad or m, inside the
            position limits: those of the manufacturer's datasheet (`position_limits`). Joints
            without have their position limits.

    Raises:
        RobotError: the file cannot be used; a ValueError that names it and the reason.
    """
    _check_options(
        path,
        joints=joints or (),
        fixed=fixed or {},
        pairs={"limits": limits or {}, "datasheet_limits": datasheet_limits or {}},
        positive={"velocity": velocity, "acceleration": acceleration, "jerk": jerk},
        end_effector_position=end_effector_position,
        base_position=base_position,
        base_orientation=base_orientation,
        gain=gain,
        acceleration_steps=acceleration_steps,
    )
    tree = _Tree(Path(path), packages)
    movable = [joint for joint in tree.joints if tree.is_movable(joint)]
    if not movable:
        raise RobotError(f"{path}: no joint can move")
    if len(movable) > MAX_MOVABLE:
        raise RobotError(f"{path}: {len(movable)} movable joints, at most {MAX_MOVABLE}")
    end_effector = end_effector or tree.likely_end_effector()
    if end_effector not in tree.links:
        raise RobotError(f"{path}: no link {end_effector!r}, but {', '.join(tree.links)}")
    on_chain = [joint for joint in tree.chain(end_effector) if tree.is_movable(joint)]
    joints = on_chain if joints is None else list(joints)
    if not joints:
        raise RobotError(f"{path}: no joint moves {end_effector!r}")
    for joint in joints:
        if joint not in on_chain:
            raise RobotError(
                f"{path}: {joint!r} is no movable joint between the base and {end_effector!r}; "
                f"those are {', '.join(on_chain)}"
            )
    if len(joints) > MAX_JOINTS:
        raise RobotError(f"{path}: {len(joints)} actuated joints, at most {MAX_JOINTS}")
    joints = sorted(joints, key=on_chain.index)
    others = [joint for joint in movable if joint not in joints]
    for joint in fixed or {}:
        if joint not in others:
            raise RobotError(f"{path}: fixed: {joint!r} is none of the other joints {others}")
    for joint in limits or {}:
        if joint not in tree.joints:
            raise RobotError(f"{path}: limits: no joint {joint!r}, but {', '.join(tree.joints)}")
    for joint in datasheet_limits or {}:
        if joint not in joints:
            raise RobotError(f"{path}: datasheet_limits: {joint!r} is none of the joints {joints}")
    bounds = np.array([tree.limits(joint, limits) for joint in joints])
    held = {joint: tree.held_at(joint, fixed) for joint in others}
    positions, mimics = dict(held), {}
    for joint in tree.joints:  # parents first, so that a mimic's leader may be a mimic, too
        if (mimic := tree.mimic(joint)) is None:
            continue
        leader, multiplier, offset = mimic
        if leader in mimics:
            leader, scale, shift = mimics[leader]
            multiplier, offset = multiplier * scale, multiplier * shift + offset
        if leader in positions:
            positions[joint] = multiplier * positions[leader] + offset
        elif leader in joints:
            mimics[joint] = leader, multiplier, offset
        else:
            raise RobotError(f"{path}: {joint!r} mimics {leader!r}, which cannot move")
    frames, placements = _frames(tree, joints, positions, mimics)
    for joint in tree.joints.values():
        if joint.get("type") != "fixed" and joint.find("limit") is None:
            ElementTree.SubElement(joint, "limit")  # PyBullet loads no joint without
    ElementTree.indent(tree.root)  # PyBullet breaks lines of more than 8,191 letters
    xml = ElementTree.tostring(tree.root, "unicode")
    index, link_index, shapes = bullet_indices(path, xml)
    for link, element in tree.elements.items():
        if shapes[link] < len(element.findall("collision")):
            raise RobotError(
                f"{path}: link {link!r}: PyBullet cannot use one of its collision shapes"
            )
    links = [
        Link(link_index[link], placements[link][0], link_steps(*placements[link][1:]))
        for link in tree.links
        if tree.elements[link].find("collision") is not None
    ]
    # Those that do not move come first.
    links.sort(key=lambda link: (link.frame >= 0, link.index))
    still = [joint for joint in positions if joint in tree.joints]
    frame, rotation, position = placements[end_effector]
    urdf_velocity = tree.limit_values("velocity", joints)
    datasheet = np.array(
        [tree.datasheet_limits(joint, datasheet_limits, limits) for joint in joints]
    )
    robot = Robot(
        name=name or tree.root.get("name") or Path(path).stem,
        urdf=str(path),
        xml=xml,
        mesh_digest=tree.mesh_digest,
        joint_names=tuple(joints),
        joint_indices=tuple(index[joint] for joint in joints),
        bullet_joint_names=tuple(index),
        link_names={number: link for link, number in link_index.items()},
        lower=bounds[:, 0],
        upper=bounds[:, 1],
        velocity=_motion_limits(path, "velocity", velocity, joints, urdf_velocity),
        acceleration=_motion_limits(path, "acceleration", acceleration, joints),
        jerk=_motion_limits(path, "jerk", jerk, joints),
        urdf_velocity=urdf_velocity,
        effort=[tree.effort(joint) for joint in joints],
        held_indices=tuple(index[joint] for joint in still),
        held_positions=tuple(positions[joint] for joint in still),
        held_effort=tuple(tree.effort(joint) for joint in still),
        mimics=tuple(
            (index[joint], joints.index(leader), multiplier, offset)
            for joint, (leader, multiplier, offset) in mimics.items()
        ),
        frames=tuple(frames),
        links=tuple(links),
        self_collision_pairs=(),
        end_effector_link=link_index[end_effector],
        end_effector_offset=tuple(map(float, end_effector_position)),
        end_effector_frame=frame,
        end_effector_position=tuple(position + rotation @ np.array(end_effector_position)),
        end_effector_rotation=np.eye(3),  # see below
        gains=(gain or 0.6,) * len(joints),
        acceleration_steps=acceleration_steps,
        contact_free=tuple(bounds.mean(1)),
        observed_pose=tuple(bounds.mean(1)),
        base_position=tuple(map(float, base_position)),
        base_orientation=tuple((base_orientation / np.linalg.norm(base_orientation)).tolist()),
        datasheet_lower=datasheet[:, 0] if datasheet_limits else None,
        datasheet_upper=datasheet[:, 1] if datasheet_limits else None,
    )
    adjacent = {
        tuple(sorted((link_index[a], link_index[b]))) for a, b in tree.neighbours(robot, link_index)
    }
    disabled = adjacent | (disabled_pairs(srdf, link_index) if srdf else set())
    pairs, contact_free = cached(
        "pairs", robot, [SAMPLES, sorted(disabled)], lambda: sample_pairs(robot, disabled)
    )
    robot = dataclasses.replace(
        robot,
        self_collision_pairs=tuple(map(tuple, pairs)),
        contact_free=tuple(contact_free),
        observed_pose=tuple(contact_free),
    )
    if gain is None:
        gain = cached("gain", robot, [GAINS, WIDENED], lambda: calibrate(robot)[0])
        robot = dataclasses.replace(robot, gains=(gain,) * len(joints))
    axes = cached("end effector", robot, [], lambda: end_effector_rotation(robot).tolist())
    return dataclasses.replace(robot, end_effector_rotation=np.array(axes))


def _motion_limits(path, name, given, joints, own=None):
    """Limits (n,) of velocity, acceleration or jerk, or None: `given`, or the URDF's own."""
    if given is None:
        return own
    if not isinstance(given, dict):
        return [given] * len(joints)
    if unknown := [joint for joint in given if joint not in joints]:
        raise RobotError(f"{path}: {name}: {unknown[0]!r} is none of the joints {joints}")
    given = dict(zip(joints, own or (), strict=False)) | given
    if missing := [joint for joint in joints if joint not in given]:
        raise RobotError(f"{path}: {name}: no limit of {', '.join(missing)}")
    return [given[joint] for joint in joints]


def _check_options(path, joints, fixed, pairs, positive, gain, acceleration_steps, **vectors):
    """Raise RobotError for an option of another type, or one that is not finite."""

    def are_numbers(values, count):
        return len(values) == count and all(
            isinstance(x, (int, float, np.number))
            and not isinstance(x, bool)
            and abs(x) <= MAX_NUMBER
            for x in values
        )

    sizes = {"end_effector_position": 3, "base_position": 3, "base_orientation": 4}
    wrong = [f"{name} {v}" for name, v in vectors.items() if not are_numbers(v, sizes[name])]
    wrong += [f"joints {name!r}" for name in joints if not isinstance(name, str)]
    wrong += [f"fixed {name}: {x}" for name, x in fixed.items() if not are_numbers([x], 1)]
    wrong += [
        f"{option} {name}: {pair}"
        for option, given in pairs.items()
        for name, pair in given.items()
        if not (isinstance(pair, (list, tuple, np.ndarray)) and are_numbers(pair, 2))
    ]
    for option, given in positive.items():
        values = given if isinstance(given, dict) else {"of all joints": given}
        wrong += [
            f"{option} {name}: {value}, which must be positive"
            for name, value in values.items()
            if given is not None and not (are_numbers([value], 1) and value > 0)
        ]
    if gain is not None and not (are_numbers([gain], 1) and 0 < gain <= 1):
        wrong.append(f"gain {gain}, which must be in (0, 1]")
    if not isinstance(acceleration_steps, int) or not 1 <= acceleration_steps <= MAX_STEPS:
        wrong.append(f"acceleration_steps {acceleration_steps}, which must be 1 to {MAX_STEPS}")
    if not wrong and abs(np.linalg.norm(vectors["base_orientation"]) - 1) > MAX_NORM_ERROR:
        wrong.append(f"base_orientation {vectors['base_orientation']}: its norm is not 1")
    if wrong:
        raise RobotError(f"{path}: these options cannot be used: {'; '.join(wrong)}")


class _Tree:
    """A checked URDF: its links, parents first, and the joints between them.

    Attributes:
        root: the XML, with absolute paths of meshes and axes of length 1.
        links: names of the links, parents first.
        elements: a link's XML element.
        joints: a joint's XML element, parents first.
        mesh_digest: SHA-256 (hex) of the collision shapes.
    """

    def __init__(self, path, packages):
        self.path = path
        self.root = _read(path)
        self.elements = self._by_name("link")
        joints = self._by_name("joint")
        if not self.elements:
            raise RobotError(f"{path}: no links")
        if len(self.elements) > MAX_LINKS:
            raise RobotError(f"{path}: {len(self.elements)} links, at most {MAX_LINKS}")
        self._parent = {}  # of a link, the joint
        for name, joint in joints.items():
            for end in ("parent", "child"):
                element = joint.find(end)
                link = None if element is None else element.get("link")
                if link not in self.elements:
                    raise RobotError(f"{path}: joint {name!r}: no {end} link {link!r}")
            child = joint.find("child").get("link")
            if child in self._parent:
                raise RobotError(
                    f"{path}: a kinematic loop: link {child!r} is moved by the joints "
                    f"{self._parent[child]!r} and {name!r}"
                )
            self._parent[child] = name
        tops = [link for link in self.elements if link not in self._parent]
        if len(tops) != 1:
            raise RobotError(f"{path}: {len(tops)} links without a parent, there must be one base")
        children = {}
        for name, joint in joints.items():
            children.setdefault(joint.find("parent").get("link"), []).append(name)
        self.links, self.joints = [tops[0]], {}
        for link in self.links:
            for name in children.get(link, ()):
                self.joints[name] = joints[name]
                self.links.append(joints[name].find("child").get("link"))
        if len(self.links) < len(self.elements):
            left = sorted(self.elements.keys() - set(self.links))
            raise RobotError(f"{path}: a kinematic loop of the links {', '.join(left)}")
        self._check_numbers()
        self._check_meshes(packages)
        for name, joint in self.joints.items():
            kind = joint.get("type")
            if kind not in (*MOVABLE, "fixed"):
                raise RobotError(
                    f"{path}: joint {name!r} has type {kind!r}, not {MOVABLE} or fixed"
                )
            if kind in MOVABLE:
                axis = joint.find("axis")
                if axis is None:
                    axis = ElementTree.SubElement(joint, "axis", xyz="1 0 0")  # URDF's default
                axis.set("xyz", " ".join(map(repr, self.axis(name).tolist())))
        self._add_masses()

    def _add_masses(self):
        """Give links without `inertial` some: PyBullet would take 1 kg, with a warning each."""
        for name, link in self.elements.items():
            if link.find("inertial") is None:
                joint = self.joints.get(self._parent.get(name))
                moves = joint is not None and joint.get("type") in MOVABLE
                mass, inertia = ("1", "1") if moves else LIGHT
                inertial = ElementTree.SubElement(link, "inertial")
                ElementTree.SubElement(inertial, "mass", value=mass)
                moments = dict.fromkeys(("ixx", "iyy", "izz"), inertia)
                others = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
                ElementTree.SubElement(inertial, "inertia", **moments, **others)

    def _by_name(self, tag):
        found = {}
        for element in self.root.findall(tag):
            name = element.get("name")
            if name and (len(name) > MAX_NAME or not name.isprintable()):
                raise RobotError(
                    f"{self.path}: the name of a {tag} has at most {MAX_NAME} letters, and no "
                    f"control characters: {name[:40]!r}"
                )
            if not name or name in found:
                raise RobotError(f"{self.path}: two {tag}s, or one without a name: {name!r}")
            found[name] = element
        return found

    def _check_numbers(self):
        for element in self.root.iter():
            for name in NUMBERS:
                if (text := element.get(name)) is None or element.tag in ("color", "texture"):
                    continue
                try:
                    values = [float(part) for part in text.split()]
                except ValueError:
                    values = [math.nan]
                if not all(abs(value) <= MAX_NUMBER for value in values):
                    raise RobotError(
                        f"{self.path}: {element.tag} {name}={text[:40]!r}: not finite numbers"
                    )
                if name in POSITIVE and not min(values, default=0.0) > 0:
                    raise RobotError(
                        f"{self.path}: {element.tag} {name}={text[:40]!r}: must be positive"
                    )
                if len(values) not in VECTORS.get(name, (1,)):
                    raise RobotError(
                        f"{self.path}: {element.tag} {name}={text[:40]!r}: {len(values)} numbers"
                    )

    def _check_meshes(self, packages):
        # A URDF is often in a folder beside those of its meshes.
        folders = [self.path.absolute().parent.parent.resolve()]
        folders += [Path(folder).resolve() for folder in (packages or {}).values()]
        digest, shapes, left = hashlib.sha256(), 0, dict(MAX_MESHES)
        for link in self.elements.values():
            for kind, limit in MAX_MESH.items():
                for mesh in link.findall(f"{kind}/geometry/mesh"):
                    file = self._mesh_file(link, mesh, folders, packages)
                    size = file.stat().st_size
                    left[kind] -= size
                    if size > limit or left[kind] < 0:
                        most = f"{limit // 1_000_000} MB, or all {MAX_MESHES[kind] // 1_000_000} MB"
                        raise RobotError(
                            f"{self.path}: link {link.get('name')!r}: {kind} mesh {file} has more "
                            f"than {most}"
                        )
                    mesh.set("filename", str(file))
                    contents = file.read_bytes()
                    if file.suffix.lower() == ".obj" and not _has_its_vertices(contents):
                        raise RobotError(
                            f"{self.path}: link {link.get('name')!r}: a face of mesh {file} has a "
                            f"vertex that is not there"
                        )
                    if kind == "collision":
                        if file.suffix.lower() == ".stl" and _is_text(contents):
                            raise RobotError(
                                f"{self.path}: link {link.get('name')!r}: PyBullet cannot use mesh "
                                f"{file}, an STL file of text: save it as a binary one"
                            )
                        shapes += contents.count(b"\no ") + contents.count(b"\ng ")
                        digest.update(contents)
            for shape in link.findall("collision"):
                digest.update(_beside_mesh(shape))
                shapes += 1
        if shapes > MAX_SHAPES:
            raise RobotError(f"{self.path}: {shapes} collision shapes, at most {MAX_SHAPES}")
        self.mesh_digest = digest.hexdigest()

    def _mesh_file(self, link, mesh, folders, packages):
        """The path of a mesh that may be read: one in `folders`."""
        given = mesh.get("filename") or ""
        file = Path(resolve(given, self.path, packages)).resolve()
        where = f"{self.path}: link {link.get('name')!r}: mesh {given[:MAX_NAME]!r}"
        if not any(file.is_relative_to(folder) for folder in folders):
            raise RobotError(f"{where} is outside of {folders[0]}: name its folder in `packages`")
        if file.suffix.lower() not in MESH_ENDINGS:
            raise RobotError(f"{where}: must end in {', '.join(MESH_ENDINGS)}")
        if not file.is_file():
            hint = ": name its folder in `packages`" if given.startswith("package://") else ""
            raise RobotError(f"{where}: no such file ({file}){hint}")
        return file

    def axis(self, joint):
        """The direction (3,), of length 1, about or along which a joint moves."""
        axis = joint_axis(self.joints[joint])
        norm = np.linalg.norm(axis)
        if axis.shape != (3,) or not norm > 1e-6:
            raise RobotError(f"{self.path}: joint {joint!r}: the axis {axis} has no direction")
        return axis if abs(norm - 1) < 1e-12 else axis / norm

    def is_movable(self, joint):
        """Whether a joint moves by itself."""
        return self.joints[joint].get("type") in MOVABLE and self.mimic(joint) is None

    def mimic(self, joint):
        """(leader, multiplier, offset) of a joint that follows another one, or None."""
        element = self.joints[joint].find("mimic")
        if element is None:
            return None
        leader = element.get("joint")
        if leader not in self.joints or leader == joint:
            raise RobotError(f"{self.path}: {joint!r} mimics {leader!r}, which is no other joint")
        return leader, float(element.get("multiplier", 1)), float(element.get("offset", 0))

    def parent_link(self, link):
        """The link before a link; None for the base."""
        joint = self._parent.get(link)
        return None if joint is None else self.joints[joint].find("parent").get("link")

    def chain(self, link):
        """Names of the joints from the base to a link."""
        names = []
        while link in self._parent:
            names.append(self._parent[link])
            link = self.parent_link(link)
        return names[::-1]

    def likely_end_effector(self):
        """The link at the end of the longest chain of turning joints."""
        parents = {self.parent_link(link) for link in self.links}
        leaves = [link for link in self.links if link not in parents]

        def rank(link):
            kinds = [self.joints[j].get("type") for j in self.chain(link) if self.is_movable(j)]
            return len(kinds) - 2 * kinds.count("prismatic")

        best = max(map(rank, leaves))
        found = [link for link in leaves if rank(link) == best]
        if len(found) > 1:
            raise RobotError(
                f"{self.path}: several links may be the end effector, name one: {', '.join(found)}"
            )
        return found[0]

    def limits(self, joint, given):
        """Position limits (lower, upper) of a joint, from `given`, a dict, or the URDF."""
        if joint in (given or {}):
            lower, upper = map(float, given[joint])
        else:
            element = self.joints[joint].find("limit")
            if self.joints[joint].get("type") == "continuous" or element is None:
                raise RobotError(
                    f"{self.path}: joint {joint!r} has no limits: give some, such as "
                    f"limits={{{joint!r}: (-3.14, 3.14)}}"
                )
            lower, upper = (float(element.get(end, 0)) for end in ("lower", "upper"))
        if not lower < upper:
            raise RobotError(f"{self.path}: joint {joint!r}: limits from {lower} to {upper}")
        return lower, upper

    def datasheet_limits(self, joint, given, limits):
        """Limits (lower, upper) of a joint's datasheet, from `given`, or those of `limits`."""
        widest = self.limits(joint, limits)
        lower, upper = map(float, (given or {}).get(joint, widest))
        if not widest[0] <= lower < upper <= widest[1]:
            raise RobotError(
                f"{self.path}: joint {joint!r}: datasheet_limits from {lower} to {upper} are not "
                f"inside the limits from {widest[0]} to {widest[1]}"
            )
        return lower, upper

    def held_at(self, joint, fixed):
        """The position of another joint: from `fixed`, or 0 within its limits."""
        if joint in (fixed or {}):
            return float(fixed[joint])
        element = self.joints[joint].find("limit")
        if element is None or self.joints[joint].get("type") == "continuous":
            return 0.0
        return min(max(0.0, float(element.get("lower", 0))), float(element.get("upper", 0)))

    def limit_values(self, name, joints):
        """A limit of all `joints`, or None if one has none."""
        elements = [self.joints[joint].find("limit") for joint in joints]
        values = [0.0 if e is None else float(e.get(name, 0)) for e in elements]
        return values if min(values) > 0 else None

    def effort(self, joint):
        """The largest torque (N m) or force (N) of a joint."""
        element = self.joints[joint].find("limit")
        effort = 0.0 if element is None else float(element.get("effort", 0))
        return effort if effort > 0 else DEFAULT_EFFORT

    def neighbours(self, robot, link_index):
        """Pairs of links that may collide with nothing that may between them."""
        solid = {link.index for link in robot.links}
        for link in self.links:
            if link_index[link] not in solid:
                continue
            before = self.parent_link(link)
            while before is not None and link_index[before] not in solid:
                before = self.parent_link(before)
            if before is not None:
                yield before, link

    def origin(self, joint):
        """Position (3,) and rotation (3, 3) of a joint in its parent link."""
        return joint_origin(self.joints[joint])


def _read(path):
    """The URDF's XML element. Raises RobotError."""
    root = read_xml(path)
    if root.tag != "robot":
        raise RobotError(f"{path}: no URDF: its first element is not <robot>")
    return root


def _beside_mesh(collision):
    """What a `collision` element has beside a mesh's contents, as bytes: placement and sizes.

    Nothing, if that is a mesh in the link's own frame.
    """
    usual, found = {"xyz": 0.0, "rpy": 0.0, "scale": 1.0}, []
    for element in collision.iter():
        for name in NUMBERS:
            values = [float(part) for part in element.get(name, "").split()]
            if any(value != usual.get(name) for value in values):
                found.append([element.tag, name, values])
    return json.dumps(found).encode() if found else b""


def _is_text(stl):
    """Whether an STL file is one of text. A binary one has 50 bytes for each triangle."""
    size = 84 + 50 * int.from_bytes(stl[80:84], "little")
    return stl.startswith(b"solid") and b"facet" in stl[:1000] and len(stl) != size


def _has_its_vertices(obj):
    """Whether an OBJ file's faces have vertices of the file; PyBullet would read beyond them."""
    count = sum(len(re.findall(rb"^[ \t]*v[ \t]", part, re.MULTILINE)) for part in _blocks(obj))
    for part in _blocks(obj):
        faces = re.findall(rb"^[ \t]*f[ \t]([^#\r\n]*)", part, re.MULTILINE)
        corners = re.sub(rb"/[^ \t]*", b"", b" ".join(faces)).strip()  # textures and normals
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # of what are no numbers
                numbers = np.fromstring(corners, dtype=np.int64, sep=" ")
        except (DeprecationWarning, ValueError):
            return False
        if ((numbers == 0) | (numbers < -count) | (numbers > count)).any():
            return False
    return True


def _blocks(text):
    """Yield a text of bytes in parts of whole lines, so that lists of its words stay short."""
    start = 0
    while start < len(text):
        end = text.find(b"\n", start + BLOCK) + 1 or len(text)
        yield text[start:end]
        start = end


def _frames(tree, joints, positions, mimics):
    """The robot's `Frame`s, and where each link is: (frame, rotation (3, 3), position (3,))."""
    frames, placements = [], {tree.links[0]: (-1, np.eye(3), np.zeros(3))}
    for name, joint in tree.joints.items():
        parent, link = joint.find("parent").get("link"), joint.find("child").get("link")
        frame, rotation, position = placements[parent]
        at, turn = tree.origin(name)
        position, rotation = position + rotation @ at, rotation @ turn
        kind = joint.get("type")
        axis = tree.axis(name) if kind in MOVABLE else None
        if name in joints or name in mimics:
            leader, multiplier, offset = mimics.get(name, (name, 1.0, 0.0))
            aligned = aligning(axis)
            frames.append(
                Frame(
                    parent=frame,
                    joint=joints.index(leader),
                    position=tuple(position.tolist()),
                    rotation=tuple((rotation @ aligned).ravel().tolist()),
                    is_prismatic=kind == "prismatic",
                    multiplier=multiplier,
                    offset=offset,
                )
            )
            placements[link] = len(frames) - 1, aligned.T, np.zeros(3)
            continue
        if kind == "prismatic":
            position = position + rotation @ (axis * positions[name])
        elif kind != "fixed":
            rotation = rotation @ about(axis, positions[name])
        placements[link] = frame, rotation, position
    return frames, placements
