"""Files of strangers: XML with limits, and a first attempt of PyBullet in another process."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

from roboarm_nmp.utils.files import temporary_file

MAX_FILE, MAX_DEPTH, MAX_ELEMENTS = 5_000_000, 30, 50_000  # bytes, nested elements, all elements
MAX_HULL = 100_000  # vertices of the convex hulls of all collision meshes
# PyBullet may crash while it loads a hostile file, so another process tries it first.
MAX_SECONDS, MAX_MEMORY = 4, 1_000_000_000  # of its processor time; bytes
XACRO_LEFTOVERS = ("xacro:arg", "xacro:property")  # do no harm
LARGEST = 1000.0  # m, of a mesh's coordinates
TRIAL = """
import json, os, resource, sys
resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
answer = os.dup(1)
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
p = __import__("pybullet")
p.connect(p.DIRECT)
body = p.loadURDF(sys.argv[1], useFixedBase=True, flags=p.URDF_IGNORE_VISUAL_SHAPES)
infos = [p.getJointInfo(body, i) for i in range(p.getNumJoints(body))]
vertices, shapes = 0, []
for link in range(-1, len(infos)):
    kinds = [shape[2] for shape in p.getCollisionShapeData(body, link)]
    if p.GEOM_MESH in kinds:
        number, corners = p.getMeshData(body, link, flags=p.MESH_DATA_SIMULATION_MESH)
        vertices += number
        if not number or not all(abs(x) <= LARGEST for corner in corners for x in corner):
            kinds = []
    shapes.append(len(kinds))
names = [[info[1].decode(), info[12].decode()] for info in infos]
base = p.getBodyInfo(body)[0].decode()
os.write(answer, json.dumps([base, names, shapes, vertices]).encode())
"""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # threads take memory


class RobotError(ValueError):
    """A robot's description cannot be used; the message names the file and the reason."""


def read_xml(path: Path) -> ElementTree.Element:
    """The first element of an XML file. Raises RobotError: it cannot be read, or is hostile."""
    try:
        size = path.stat().st_size
        if not path.is_file():  # a pipe would never end
            raise RobotError(f"{path}: no regular file")
        if size > MAX_FILE:
            raise RobotError(f"{path}: more than {MAX_FILE // 1_000_000} MB")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise RobotError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RobotError(f"{path}: not text: {error}") from error
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise RobotError(f"{path}: has a document type or entities, which no robot needs")
    # Some URDFs have extensions of other programs, with prefixes that they do not declare.
    parser, builder = expat.ParserCreate(), ElementTree.TreeBuilder()
    depth = number = 0

    def start(tag, attributes):
        nonlocal depth, number
        depth += 1
        number += 1
        if tag.startswith("xacro:") and tag not in XACRO_LEFTOVERS:
            raise RobotError(f"{path}: has the element {tag}: run `xacro` on it first")
        if number > MAX_ELEMENTS:
            raise RobotError(f"{path}: more than {MAX_ELEMENTS:,} elements")
        if depth > MAX_DEPTH:
            raise RobotError(f"{path}: elements are nested more than {MAX_DEPTH} deep")
        plain = {n: value for n, value in attributes.items() if ":" not in n and n != "xmlns"}
        builder.start(tag.replace(":", "_"), plain)

    def end(tag):
        nonlocal depth
        depth -= 1
        builder.end(tag.replace(":", "_"))

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        parser.Parse(text, True)
        return builder.close()
    except expat.ExpatError as error:
        raise RobotError(f"{path}: malformed XML: {error}") from error


def bullet_indices(
    path: str | Path, xml: str
) -> tuple[dict[str, int], dict[str, int], dict[str, int]]:
    """PyBullet's indices of joints and of links, and links' numbers of collision shapes.

    Three dicts from names. The base's index is -1.

    Args:
        path: of the URDF, for messages.
        xml: its text.

    Raises:
        RobotError: PyBullet cannot load it, or needs too much time, memory or vertices.
    """
    trial = f"SECONDS, MEMORY, LARGEST = {MAX_SECONDS}, {MAX_MEMORY}, {LARGEST}\n{TRIAL}"
    with temporary_file(xml, ".urdf") as urdf:
        command = [sys.executable, "-c", trial, urdf]
        done = subprocess.run(command, capture_output=True, env=os.environ | ONE_THREAD)
    try:
        base, names, shapes, vertices = json.loads(done.stdout)
    except ValueError as error:
        reason = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no reason"]
        if done.returncode < 0:
            reason = [f"it ended with {signal.Signals(-done.returncode).name}"]
        raise RobotError(f"{path}: PyBullet cannot load it: {reason[0]}") from error
    if vertices > MAX_HULL:
        raise RobotError(
            f"{path}: the convex hulls of the collision meshes have {vertices:,} vertices, at most "
            f"{MAX_HULL:,}: simplify the meshes"
        )
    joints, links = {}, {base: -1}
    for index, (joint, link) in enumerate(names):
        joints[joint] = index
        links[link] = index
    return joints, links, dict(zip(links, shapes, strict=True))
