"""Objects attached to an arm's links, as XML of its URDF, and meshes as OBJ files for PyBullet."""

import atexit
import functools
import hashlib
import math
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from roboarm_nmp.envs.robots.glb import read_glb
from roboarm_nmp.envs.robots.rotations import matrix

COLOUR = "0.85 0.55 0.2 1"
LIGHT = "0.001", "0.000001"  # kg, kg m^2: of objects and of frames, such as a tool's


def attached_name(number: int) -> str:
    """The name of an object's link, which no URDF has by chance."""
    return f"attached object {number}"


def attached_elements(objects: Iterable) -> Iterator[ElementTree.Element]:
    """The links and joints of objects, XML elements."""
    for number, attached in enumerate(objects):
        name = attached_name(number)
        link = ElementTree.Element("link", name=name)
        add_inertial(link, *LIGHT)
        for tag in ("visual", "collision"):
            element = ElementTree.SubElement(link, tag)
            _add_shape(element, attached)
            if tag == "visual":
                material = ElementTree.SubElement(element, "material", name=name)
                ElementTree.SubElement(material, "color", rgba=COLOUR)
        joint = ElementTree.Element("joint", name=name, type="fixed")
        ElementTree.SubElement(joint, "parent", link=attached.link)
        ElementTree.SubElement(joint, "child", link=name)
        yield link
        yield joint


def add_inertial(link: ElementTree.Element, mass: str, moment: str) -> None:
    """Give a link, an XML element, a mass (kg) and moments of inertia (kg m^2)."""
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "mass", value=mass)
    moments = {"ixx": moment, "iyy": moment, "izz": moment, "ixy": "0", "ixz": "0", "iyz": "0"}
    ElementTree.SubElement(inertial, "inertia", moments)


def _add_shape(element, attached):
    """Add origin and geometry of an object to a `visual` or `collision` element."""
    shape = attached.shape
    angles = _roll_pitch_yaw(getattr(shape, "orientation", (0.0, 0.0, 0.0, 1.0)))
    ElementTree.SubElement(element, "origin", xyz=_text(shape.position), rpy=_text(angles))
    geometry = ElementTree.SubElement(element, "geometry")
    if hasattr(shape, "vertices"):
        ElementTree.SubElement(
            geometry, "mesh", filename=_obj_file([(shape.vertices, attached.triangles)])
        )
    elif hasattr(shape, "size"):
        ElementTree.SubElement(geometry, "box", size=_text(shape.size))
    elif hasattr(shape, "length"):
        radius, length = _text([shape.radius]), _text([shape.length])
        ElementTree.SubElement(geometry, "cylinder", radius=radius, length=length)
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


def obj_of_glb(path: str) -> str:
    """The path of an OBJ file with the meshes of a GLB file, as long as this process lasts."""
    return _obj_of_glb(path, os.stat(path).st_mtime_ns, os.getpid())


@functools.lru_cache(100)
def _obj_of_glb(path, changed, process):
    return _obj_file(read_glb(Path(path).read_bytes()))


def _obj_file(meshes):
    """The path of an OBJ file of meshes, which lasts as long as this process."""
    lines, before = [], 1  # OBJ counts vertices from 1, over all of its objects
    for vertices, triangles in meshes:
        lines.append("o mesh")
        lines += [f"v {_text(vertex)}" for vertex in vertices]
        lines += [f"f {' '.join(str(before + i) for i in corners)}" for corners in triangles]
        before += len(vertices)
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
