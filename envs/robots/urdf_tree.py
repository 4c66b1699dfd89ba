"""A URDF, which is untrusted input: its links, joints and meshes, checked."""

import hashlib
import json
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from roboarm_nmp.envs.robots.attached_xml import LIGHT, add_inertial
from roboarm_nmp.envs.robots.body import resolve
from roboarm_nmp.envs.robots.glb import read_glb
from roboarm_nmp.envs.robots.placements import joint_axis, joint_end
from roboarm_nmp.envs.robots.untrusted import RobotError, read_xml

MAX_LINKS = 200
MAX_NAME = 200  # letters
# Bytes of all meshes, and shapes for collisions.
MAX_MESHES = {"collision": 50_000_000, "visual": 100_000_000}
MAX_SHAPES = 500
MAX_MESH = {"collision": 20_000_000, "visual": 30_000_000}  # bytes of one
BLOCK = 4_000_000  # bytes of a mesh that are read at once
MESH_ENDINGS = (".obj", ".stl", ".dae", ".glb")
MOVABLE = ("revolute", "continuous", "prismatic")
DEFAULT_EFFORT = 1_000.0  # N m or N, where a URDF has none
MAX_NUMBER = 1e6
# Attributes that are numbers, how many of these there may be, and which must be positive.
VECTORS = {"xyz": (3,), "rpy": (3,), "size": (3,), "scale": (1, 3)}
SCALARS = ("radius", "length", "value", "ixx", "iyy", "izz", "ixy", "ixz", "iyz")
SCALARS += ("lower", "upper", "effort", "velocity", "multiplier", "offset")
NUMBERS = VECTORS | dict.fromkeys(SCALARS, (1,))
POSITIVE = ("size", "radius", "length")


class UrdfTree:
    """A checked URDF: its links, parents first, and the joints between them.

    Attributes:
        path: of the file.
        root: the XML, with absolute paths of meshes and axes of length 1.
        links: names of the links, parents first.
        elements: a link's XML element.
        joints: a joint's XML element, parents first.
        mesh_digest: SHA-256 (hex) of the collision shapes.

    Raises:
        RobotError: the file cannot be used. Methods raise it, too.
    """

    def __init__(self, path: Path, packages: Mapping[str, str | Path] | None = None):
        self.path = path
        self.root = read_xml(path)
        if self.root.tag != "robot":
            raise self.error(
                "no URDF: its first element is not <robot> (of xacro files: run `xacro` first)"
            )
        self.elements = self._by_name("link")
        if not self.elements:
            raise self.error("no links")
        if len(self.elements) > MAX_LINKS:
            raise self.error(f"{len(self.elements)} links, at most {MAX_LINKS}")
        self.links: list[str] = []
        self.joints: dict[str, ElementTree.Element] = {}
        self._parent: dict[str, str] = {}  # of a link, the joint
        self._order(self._by_name("joint"))
        self._check_numbers()
        self.mesh_digest = self._check_meshes(packages or {})
        self._check_joints()
        self._add_masses()

    def error(self, reason: str) -> RobotError:
        """An error that names the file."""
        return RobotError(f"{self.path}: {reason}")

    def _by_name(self, tag):
        elements = {}
        for element in self.root.findall(tag):
            name = element.get("name")
            if name and (len(name) > MAX_NAME or not name.isprintable()):
                raise self.error(
                    f"the name of a {tag} has at most {MAX_NAME} letters, and no control "
                    f"characters: {name[:40]!r}"
                )
            if not name or name in elements:
                raise self.error(f"two {tag}s, or one without a name: {name!r}")
            elements[name] = element
        return elements

    def _order(self, joints):
        """Find each link's parent; sort links and joints, parents first."""
        children = {}
        for name, joint in joints.items():
            for end in ("parent", "child"):
                if (link := joint_end(joint, end)) not in self.elements:
                    raise self.error(f"joint {name!r}: no {end} link {link!r}")
            child = joint_end(joint, "child")
            if child in self._parent:
                raise self.error(
                    f"a kinematic loop: link {child!r} is moved by the joints "
                    f"{self._parent[child]!r} and {name!r}"
                )
            self._parent[child] = name
            children.setdefault(joint_end(joint, "parent"), []).append(name)
        tops = [link for link in self.elements if link not in self._parent]
        if len(tops) != 1:
            raise self.error(
                f"{len(tops)} links without a parent, there must be one base: connect the others "
                f"by fixed joints ({', '.join(tops)[:200]})"
            )
        self.links.append(tops[0])
        for link in self.links:  # grows
            for name in children.get(link, ()):
                self.joints[name] = joints[name]
                self.links.append(joint_end(joints[name], "child"))
        if len(self.links) < len(self.elements):
            left = sorted(self.elements.keys() - set(self.links))
            raise self.error(f"a kinematic loop of the links {', '.join(left)}")

    def _check_numbers(self):
        for element in self.root.iter():
            if element.tag in ("color", "texture"):
                continue
            for name, counts in NUMBERS.items():
                if (text := element.get(name)) is None:
                    continue
                where = f"{element.tag} {name}={text[:40]!r}"
                try:
                    values = [float(part) for part in text.split()]
                except ValueError:
                    values = [math.nan]
                if not all(abs(value) <= MAX_NUMBER for value in values):
                    raise self.error(f"{where}: not finite numbers")
                if name in POSITIVE and not min(values, default=0.0) > 0:
                    raise self.error(f"{where}: must be positive")
                if len(values) not in counts:
                    raise self.error(f"{where}: {len(values)} numbers")

    def _check_joints(self):
        """Check types and axes, which get a length of 1."""
        for name, joint in self.joints.items():
            kind = joint.get("type")
            if kind not in (*MOVABLE, "fixed"):
                raise self.error(
                    f"joint {name!r} has type {kind!r}, not {MOVABLE} or fixed: choose one"
                )
            if kind == "fixed":
                continue
            axis = joint_axis(joint)
            norm = np.linalg.norm(axis)
            if axis.shape != (3,) or not norm > 1e-6:
                raise self.error(f"joint {name!r}: the axis {axis} has no direction")
            if abs(norm - 1) >= 1e-12:
                axis = axis / norm
            element = joint.find("axis")
            if element is None:
                element = ElementTree.SubElement(joint, "axis")
            element.set("xyz", " ".join(map(repr, axis.tolist())))

    def _add_masses(self):
        """Give links without `inertial` some: PyBullet would take 1 kg, with a warning each."""
        for name, link in self.elements.items():
            if link.find("inertial") is not None:
                continue
            mass, moment = LIGHT
            if name in self._parent and self.joints[self._parent[name]].get("type") in MOVABLE:
                mass = moment = "1"
            add_inertial(link, mass, moment)

    # --- Meshes

    def _check_meshes(self, packages):
        """Check all meshes, and make their paths absolute. Returns `mesh_digest`."""
        # A URDF is often in a folder beside those of its meshes.
        folders = [self.path.absolute().parent.parent.resolve()]
        folders += [Path(folder).resolve() for folder in packages.values()]
        digest, shapes, left = hashlib.sha256(), 0, dict(MAX_MESHES)
        for name, link in self.elements.items():
            for kind, limit in MAX_MESH.items():
                for mesh in link.findall(f"{kind}/geometry/mesh"):
                    file = self._mesh_file(name, mesh, folders, packages)
                    left[kind] -= file.stat().st_size
                    if file.stat().st_size > limit or left[kind] < 0:
                        raise self.error(
                            f"link {name!r}: {kind} mesh {file} has more than "
                            f"{limit // 1_000_000} MB, or all {MAX_MESHES[kind] // 1_000_000} MB"
                        )
                    mesh.set("filename", str(file))
                    contents = file.read_bytes()
                    if file.suffix.lower() == ".obj" and not _has_its_vertices(contents):
                        raise self.error(
                            f"link {name!r}: a face of mesh {file} has a vertex that is not there: "
                            f"export it again"
                        )
                    parts = self._glb_parts(name, file, contents)
                    if kind == "visual":
                        continue
                    if file.suffix.lower() == ".stl" and _is_text(contents):
                        raise self.error(
                            f"link {name!r}: PyBullet cannot use mesh {file}, an STL file of text: "
                            f"save it as a binary one"
                        )
                    shapes += parts or contents.count(b"\no ") + contents.count(b"\ng ")
                    digest.update(contents)
            for shape in link.findall("collision"):
                digest.update(_beside_mesh(shape))
                shapes += 1
        if shapes > MAX_SHAPES:
            raise self.error(f"{shapes} collision shapes, at most {MAX_SHAPES}")
        return digest.hexdigest()

    def _glb_parts(self, link, file, contents):
        """The number of meshes in a GLB file; 0 for another file."""
        if file.suffix.lower() != ".glb":
            return 0
        try:
            return len(read_glb(contents))
        except ValueError as error:
            raise self.error(f"link {link!r}: mesh {file}: {error}") from error

    def _mesh_file(self, link, mesh, folders, packages):
        """The path of a mesh that may be read: one in `folders`."""
        name = mesh.get("filename") or ""
        file = Path(resolve(name, self.path, packages)).resolve()
        where = f"link {link!r}: mesh {name[:MAX_NAME]!r}"
        if not any(file.is_relative_to(folder) for folder in folders):
            raise self.error(f"{where} is outside of {folders[0]}: name its folder in `packages`")
        if file.suffix.lower() not in MESH_ENDINGS:
            raise self.error(f"{where}: must end in {', '.join(MESH_ENDINGS)}: convert it")
        if not file.is_file():
            hint = ": name its folder in `packages`" if name.startswith("package://") else ""
            raise self.error(f"{where}: no such file ({file}){hint}")
        return file

    # --- Joints

    def is_movable(self, joint: str) -> bool:
        """Whether a joint moves by itself."""
        return self.joints[joint].get("type") in MOVABLE and self.mimic(joint) is None

    def mimic(self, joint: str) -> tuple[str, float, float] | None:
        """(leader, multiplier, offset) of a joint that follows another one, or None."""
        element = self.joints[joint].find("mimic")
        if element is None or self.joints[joint].get("type") == "fixed":
            return None
        leader = element.get("joint", "")
        if leader not in self.joints or leader == joint:
            raise self.error(f"{joint!r} mimics {leader!r}, which is no other joint")
        return leader, float(element.get("multiplier", 1)), float(element.get("offset", 0))

    def chain(self, link: str) -> list[str]:
        """Names of the joints from the base to a link."""
        names = []
        while link in self._parent:
            names.append(self._parent[link])
            link = joint_end(self.joints[names[-1]], "parent")
        return names[::-1]

    def likely_end_effector(self) -> str:
        """The link at the end of the longest chain of turning joints."""
        parents = {joint_end(joint, "parent") for joint in self.joints.values()}
        ranks = {}
        for link in self.links:
            if link not in parents:
                kinds = [self.joints[j].get("type") for j in self.chain(link) if self.is_movable(j)]
                ranks[link] = len(kinds) - 2 * kinds.count("prismatic")
        best = [link for link, rank in ranks.items() if rank == max(ranks.values())]
        if len(best) > 1:
            raise self.error(f"several links may be the end effector, name one: {', '.join(best)}")
        return best[0]

    def limits(self, joint: str, replaced: Mapping) -> tuple[float, float]:
        """Position limits (lower, upper) of a joint, from `replaced` or the URDF."""
        if joint in replaced:
            lower, upper = map(float, replaced[joint])
        else:
            limit = self.joints[joint].find("limit")
            if self.joints[joint].get("type") == "continuous" or limit is None:
                raise self.error(
                    f"joint {joint!r} has no limits: give some, such as "
                    f"limits={{{joint!r}: (-3.14, 3.14)}}"
                )
            lower, upper = float(limit.get("lower", 0)), float(limit.get("upper", 0))
            self._warn_of_soft_limits(joint, lower, upper)
        if not lower < upper:
            raise self.error(f"joint {joint!r}: limits from {lower} to {upper}")
        return lower, upper

    def _warn_of_soft_limits(self, joint, lower, upper):
        soft = self.joints[joint].find("safety_controller")
        if soft is None:
            return
        least = float(soft.get("soft_lower_limit", str(lower)))
        most = float(soft.get("soft_upper_limit", str(upper)))
        if lower < least or most < upper:
            warnings.warn(
                f"{self.path}: joint {joint!r}: the soft limits of its safety_controller are not "
                f"used; to use them: limits={{{joint!r}: ({least:g}, {most:g})}}",
                stacklevel=2,
            )

    def held_at(self, joint: str, fixed: Mapping[str, float]) -> float:
        """The position of another joint: from `fixed`, or 0 within its limits."""
        if joint in fixed:
            return float(fixed[joint])
        limit = self.joints[joint].find("limit")
        if limit is None or self.joints[joint].get("type") == "continuous":
            return 0.0
        return min(max(0.0, float(limit.get("lower", 0))), float(limit.get("upper", 0)))

    def velocity(self, joint: str) -> float:
        """The largest velocity of a joint, rad/s or m/s; 0 if the URDF has none."""
        return self._limit(joint, "velocity")

    def effort(self, joint: str) -> float:
        """The largest torque (N m) or force (N) of a joint."""
        effort = self._limit(joint, "effort")
        return effort if effort > 0 else DEFAULT_EFFORT

    def _limit(self, joint, name):
        limit = self.joints[joint].find("limit")
        return 0.0 if limit is None else float(limit.get(name, 0))

    def neighbours(self) -> Iterator[tuple[str, str]]:
        """Pairs of links that may collide with nothing that may between them."""
        solid = {link for link in self.links if self.is_solid(link)}
        for link in self.links:
            if link not in solid:
                continue
            for joint in reversed(self.chain(link)):
                before = joint_end(self.joints[joint], "parent")
                if before in solid:
                    yield before, link
                    break

    def is_solid(self, link: str) -> bool:
        """Whether a link may collide."""
        return self.elements[link].find("collision") is not None


def _beside_mesh(collision):
    """What a `collision` element has beside a mesh's contents, as bytes: placement and sizes.

    Nothing, if that is a mesh in the link's own frame.
    """
    usual, others = {"xyz": 0.0, "rpy": 0.0, "scale": 1.0}, []
    for element in collision.iter():
        for name in NUMBERS:
            values = [float(part) for part in element.get(name, "").split()]
            if any(value != usual.get(name) for value in values):
                others.append([element.tag, name, values])
    return json.dumps(others).encode() if others else b""


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
