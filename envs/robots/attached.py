"""Objects attached to an arm's links: links of their own in its URDF, each on a fixed joint."""

import atexit
import dataclasses
import functools
import hashlib
import math
import os
import shutil
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from roboarm_nmp.envs.robots.robot import Link, matrix
from roboarm_nmp.envs.robots.urdf import LIGHT, link_placement, steps
from roboarm_nmp.utils.bullet import pybullet as p

COLOUR = "0.85 0.55 0.2 1"
MAX_ATTACHED = 100
SWEPT, NEAR = 200, 0.005  # values of a joint; m, between neighbours
SAMPLES = 1_000  # configurations among which one without contacts is looked for


@functools.lru_cache(64)
def attach(robot, objects):
    """See `Robot.with_attached`; `robot` has no objects yet, and `objects` is a tuple."""
    if not all(hasattr(one, "described") for one in objects):
        raise TypeError(f"attached objects must be of the type Attached, got {objects!r}")
    if len(objects) > MAX_ATTACHED:
        raise ValueError(f"an arm has at most {MAX_ATTACHED} attached objects, got {len(objects)}")
    names = robot.bullet_names[1]
    objects = tuple(
        dataclasses.replace(one, link=one.link or names[robot.end_effector_link]) for one in objects
    )
    carriers = [_carrier(robot, one.link) for one in objects]
    attached = dataclasses.replace(
        robot, attached=objects, carriers=tuple(carriers), described=robot.arm
    )
    # The new links may change PyBullet's indices of those after them.
    index = {name: link for link, name in attached.bullet_names[1].items()}
    new = {link: index[name] for link, name in names.items()}
    links = [link._replace(index=new[link.index]) for link in robot.links]
    frames = {link.index: link.frame for link in links}
    touched = [robot.links_called(one.touch_links) for one in objects]
    pairs = [(new[a], new[b]) for a, b in robot.self_collision_pairs]
    for i, one in enumerate(objects):
        own, frame = index[_name(i)], frames[new[carriers[i]]]
        touching = {new[link] for link in touched[i]}
        pairs += [
            (min(own, other), max(own, other))
            for other, other_frame in frames.items()
            if other_frame != frame and other not in touching
        ]
        frames[own] = frame
        links.append(Link(own, frame, steps(link_placement(robot, one.link))))
    attached = dataclasses.replace(
        attached,
        carriers=tuple(new[link] for link in carriers),
        joint_indices=tuple(new[joint] for joint in robot.joint_indices),
        held_indices=tuple(new[joint] for joint in robot.held_indices),
        mimics=tuple((new[mimic[0]], *mimic[1:]) for mimic in robot.mimics),
        end_effector_link=new[robot.end_effector_link],
        links=tuple(links),
        self_collision_pairs=tuple(pairs),
    )
    kept = _without_distant_neighbours(attached, tuple(pairs[len(robot.self_collision_pairs) :]))
    pairs = (*pairs[: len(robot.self_collision_pairs)], *kept)
    attached = dataclasses.replace(attached, self_collision_pairs=pairs)
    return dataclasses.replace(attached, contact_free=_contact_free(attached))


def _carrier(robot, link):
    """PyBullet's index of the link that shares its row of link distances with what `link` carries.

    That is `link` itself, or, where it has no collision shape, another one that moves with it.
    """
    joint = link_placement(robot, link)[0]
    if joint is None:
        raise ValueError(f"{robot.name}: {link!r} does not move: make the object an obstacle")
    names = robot.bullet_names[1]
    beside = {
        names[other]: other
        for other in robot.collision_links
        if link_placement(robot, names[other])[0] == joint
    }
    if not beside:
        raise ValueError(f"{robot.name}: no link that may collide moves with {link!r}")
    joints = robot.parsed_urdf().findall("joint")
    parents = {one.find("child").get("link"): one.find("parent").get("link") for one in joints}
    above = link
    while above is not None and above not in beside:
        above = parents.get(above)
    return beside.get(above, max(beside.values()))


def _without_distant_neighbours(robot, pairs):
    """The pairs without those of neighbours that never come near each other.

    A single joint moves neighbours against each other, so its range says it all. Their distance
    hardly changes, so a safety filter could do nothing about it.
    """
    frame_of, kept = {link.index: link.frame for link in robot.links}, []
    client = p.connect(p.DIRECT)
    try:
        body = robot.load(client, drawn=False)
        for a, b in pairs:
            before, after = sorted((frame_of[a], frame_of[b]))
            if before < 0 or robot.frames[after].parent != before:
                kept.append((a, b))
                continue
            joint, configuration = robot.frames[after].joint, list(robot.contact_free)
            for angle in np.linspace(robot.lower[joint], robot.upper[joint], SWEPT):
                configuration[joint] = angle
                robot.set_configuration(client, body, configuration)
                if p.getClosestPoints(body, body, NEAR, a, b, physicsClientId=client):
                    kept.append((a, b))
                    break
    finally:
        p.disconnect(client)
    return kept


def _contact_free(robot):
    """A configuration (n,) without contacts of the arm with itself, a tuple."""
    rng, candidate = np.random.default_rng(0), np.array(robot.contact_free)
    client = p.connect(p.DIRECT)
    try:
        body = robot.load(client, drawn=False)
        for _ in range(SAMPLES):
            robot.set_configuration(client, body, candidate.tolist())
            p.performCollisionDetection(physicsClientId=client)
            if not p.getContactPoints(body, body, physicsClientId=client):
                return tuple(candidate.tolist())
            candidate = rng.uniform(robot.lower, robot.upper)
    finally:
        p.disconnect(client)
    raise ValueError(
        f"{robot.name}: with the attached objects the arm collides with itself in each of "
        f"{SAMPLES} configurations: touch_links names links that an object may be in contact with"
    )


# --- The URDF


def _name(number):
    """The name of an object's link, which no URDF has by chance."""
    return f"attached object {number}"


def elements(objects):
    """The links and joints of objects, XML elements."""
    for number, one in enumerate(objects):
        link = ElementTree.Element("link", name=_name(number))
        inertial = ElementTree.SubElement(link, "inertial")
        mass, moment = LIGHT
        ElementTree.SubElement(inertial, "mass", value=mass)
        moments = {"ixx": moment, "iyy": moment, "izz": moment, "ixy": "0", "ixz": "0", "iyz": "0"}
        ElementTree.SubElement(inertial, "inertia", **moments)
        for tag in ("visual", "collision"):
            element = ElementTree.SubElement(link, tag)
            _add_shape(element, one)
            if tag == "visual":
                material = ElementTree.SubElement(element, "material", name=_name(number))
                ElementTree.SubElement(material, "color", rgba=COLOUR)
        joint = ElementTree.Element("joint", name=_name(number), type="fixed")
        ElementTree.SubElement(joint, "parent", link=one.link)
        ElementTree.SubElement(joint, "child", link=_name(number))
        yield from (link, joint)


def _add_shape(element, one):
    """Add origin and geometry of an object to a `visual` or `collision` element."""
    shape = one.shape
    orientation = getattr(shape, "orientation", (0.0, 0.0, 0.0, 1.0))
    origin = {"xyz": _text(shape.position), "rpy": _text(_roll_pitch_yaw(orientation))}
    ElementTree.SubElement(element, "origin", **origin)
    geometry = ElementTree.SubElement(element, "geometry")
    if hasattr(shape, "vertices"):
        ElementTree.SubElement(geometry, "mesh", filename=_obj_file(shape.vertices, one.triangles))
    elif hasattr(shape, "size"):
        ElementTree.SubElement(geometry, "box", size=_text(shape.size))
    elif hasattr(shape, "length"):
        sizes = {"radius": _text([shape.radius]), "length": _text([shape.length])}
        ElementTree.SubElement(geometry, "cylinder", **sizes)
    else:
        ElementTree.SubElement(geometry, "sphere", radius=_text([shape.radius]))


def _text(numbers):
    return " ".join(repr(float(number)) for number in numbers)


def _roll_pitch_yaw(quaternion):
    """Angles about the fixed x, then y, then z axis, rad, of a quaternion (xyzw)."""
    m = matrix(np.array(quaternion) / np.linalg.norm(quaternion))
    across = math.hypot(m[0, 0], m[1, 0])
    pitch = math.atan2(-m[2, 0], across)
    if across < 1e-9:  # roll and yaw are about the same axis
        return math.atan2(-m[1, 2], m[1, 1]), pitch, 0.0
    return math.atan2(m[2, 1], m[2, 2]), pitch, math.atan2(m[1, 0], m[0, 0])


def _obj_file(vertices, triangles):
    """The path of an OBJ file, which lasts as long as this process."""
    lines = [f"v {_text(vertex)}" for vertex in vertices]
    lines += [f"f {' '.join(str(corner + 1) for corner in corners)}" for corners in triangles]
    text = "\n".join(lines) + "\n"
    path = _folder(os.getpid()) / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.obj"
    if not path.exists():
        path.write_text(text)
    return str(path)


@functools.cache
def _folder(process):
    """A temporary folder of a process, which removes it at its end; forks have their own."""
    folder = tempfile.mkdtemp(prefix="roboarm_nmp_")

    def remove():
        if os.getpid() == process:
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return Path(folder)
