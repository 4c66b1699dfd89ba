"""The meshes and joints of an arm as the browser shows them: the visual shapes of its URDF."""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh

from roboarm_nmp.envs.robots.body import parsed_urdf
from roboarm_nmp.envs.robots.robot import Robot

# Visual meshes are reduced by merging the vertices in each cube of this size (m, of the Panda).
# Ghosts and recordings have the larger one: browsers without a GPU render slowly.
MESH_CELL, COARSE_MESH_CELL = 0.005, 0.013
DEFAULT_COLOUR = (200, 200, 205)  # red, green, blue, where neither URDF nor mesh has any
SECTIONS = 32  # of the circumference of a cylinder

Colour = tuple[int, int, int]
"""Red, green, blue."""
Part = tuple[Colour, np.ndarray, np.ndarray]
"""Colour, vertices (v, 3), faces (f, 3)."""


class Joint(NamedTuple):
    """A joint of the URDF, between two links; parents come first.

    Attributes:
        parent, link: PyBullet's indices of the two links; -1 is the base.
        position, wxyz: of the joint in its parent link, m and quaternion.
        axis: (3,), in the joint's frame.
        is_fixed, is_prismatic: whether it does not move at all, or moves along its axis.
        joint: which of the arm's n joints it follows; None: it stays at `offset`.
        multiplier, offset: its value is multiplier * joint + offset.
    """

    parent: int
    link: int
    position: np.ndarray
    wxyz: np.ndarray
    axis: np.ndarray
    is_fixed: bool
    is_prismatic: bool
    joint: int | None
    multiplier: float
    offset: float

    def pose(self, configuration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (m) and quaternion of what it moves, in its own frame, at angles (n,), rad."""
        value = self.offset
        if self.joint is not None:
            value += self.multiplier * configuration[self.joint]
        if self.is_prismatic:
            return value * self.axis, np.array((1.0, 0.0, 0.0, 0.0))
        return np.zeros(3), np.array((math.cos(value / 2), *(math.sin(value / 2) * self.axis)))


@functools.cache
def arm_joints(robot: Robot) -> list[Joint]:
    """The `Joint`s of a robot's URDF, parents first."""
    joints, links = _bullet_indices(robot)
    follows = {index: (i, 1.0, 0.0) for i, index in enumerate(robot.joint_indices)}
    for index, joint, multiplier, offset in robot.mimics:
        follows[index] = (joint, multiplier, offset)
    held = dict(zip(robot.held_indices, robot.held_positions, strict=True))
    described = []
    for element in parsed_urdf(robot).findall("joint"):
        index = joints[element.get("name")]
        kind = element.get("type")
        axis = np.array((1.0, 0.0, 0.0))
        if kind != "fixed":
            axis = np.array(_numbers(element.find("axis"), "xyz", axis))
        matrix = _origin(element)
        joint, multiplier, offset = follows.get(index, (None, 0.0, held.get(index, 0.0)))
        described.append(
            Joint(
                parent=links[_link_name(element, "parent")],
                link=links[_link_name(element, "child")],
                position=matrix[:3, 3],
                wxyz=trimesh.transformations.quaternion_from_matrix(matrix),
                axis=axis / np.linalg.norm(axis),
                is_fixed=kind == "fixed",
                is_prismatic=kind == "prismatic",
                joint=joint,
                multiplier=multiplier,
                offset=offset,
            )
        )
    return sorted(described, key=lambda joint: joint.link)  # PyBullet has parents first


@functools.cache
def link_meshes(robot: Robot, cell: float) -> dict[int, list[Part]]:
    """The meshes of a robot's links.

    Links without visual shapes have their collision shapes.

    Args:
        robot: the `Robot`.
        cell: m, see `MESH_CELL`.

    Returns:
        dict of PyBullet's link index -> list of (colour, vertices, faces). Vertices are float32
        (n, 3), m, in the link's frame.

    Raises:
        ValueError: a mesh cannot be read.
    """
    _, links = _bullet_indices(robot)
    root = parsed_urdf(robot)
    meshes, colours = {}, {}
    for material in root.iter("material"):
        colours.setdefault(material.get("name"), _rgb(material))
    for link in root.findall("link"):
        parts = []
        for shape in link.findall("visual") or link.findall("collision"):
            material = shape.find("material")
            colour = None
            if material is not None:
                colour = _rgb(material) or colours.get(material.get("name"))
            parts += _shape(shape, colour, cell)
        meshes[links[link.get("name")]] = parts
    return meshes


def _shape(element, colour, cell) -> list[Part]:
    """A URDF's `visual` or `collision` element as a list of (colour, vertices, faces)."""
    kind = element.find("geometry/*")
    if kind is None:
        return []
    if kind.tag == "mesh":
        return _mesh(kind, _origin(element), colour, cell)
    if kind.tag == "box":
        mesh = trimesh.creation.box(_numbers(kind, "size"))
    elif kind.tag == "sphere":
        mesh = trimesh.creation.icosphere(radius=float(kind.get("radius")))
    elif kind.tag == "cylinder":
        mesh = trimesh.creation.cylinder(**_cylinder(kind), sections=SECTIONS)
    elif kind.tag == "capsule":
        mesh = trimesh.creation.capsule(**_cylinder(kind))
        mesh.vertices -= mesh.bounds.mean(0)
    else:
        return []
    vertices = trimesh.transform_points(mesh.vertices, _origin(element))
    return [(colour or DEFAULT_COLOUR, _rounded(vertices), mesh.faces.astype(np.uint32))]


def _cylinder(element):
    return {"radius": float(element.get("radius")), "height": float(element.get("length"))}


def _mesh(element, origin, colour, cell) -> list[Part]:
    """A `mesh` element at an origin (4, 4) as a list of (colour, vertices, faces)."""
    scale = _numbers(element, "scale", (1.0, 1.0, 1.0))
    scale = np.diag([*(3 * scale if len(scale) == 1 else scale), 1.0])
    of_colour = _mesh_by_colour(element.get("filename"))
    if len(of_colour) == 1 and colour is not None:  # a mesh of several colours keeps them
        of_colour = {colour: next(iter(of_colour.values()))}
    parts = []
    for own_colour, meshes in of_colour.items():
        mesh: Any = trimesh.util.concatenate(meshes)
        vertices = trimesh.transform_points(mesh.vertices, origin @ scale)
        vertices, faces = _merged(vertices, mesh.faces, cell)
        parts.append((own_colour or DEFAULT_COLOUR, vertices, faces))
    return parts


@functools.lru_cache(100)
def _mesh_by_colour(path):
    """A mesh file's parts: dict of colour -> list of trimesh's meshes; None is no colour."""
    try:
        loaded = trimesh.load(path, process=False)
        parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        if not parts:
            raise ValueError("it has no triangles")
        units = loaded.units or ""
        unit = float(units.partition(" * ")[0]) if "*" in units else 1.0
    except Exception as error:  # its readers raise all kinds
        raise ValueError(f"{path}: the mesh cannot be drawn: {error}") from error
    of_colour = {}
    for part in parts:
        material = getattr(getattr(part, "visual", None), "material", None)
        colour = None if material is None else _colour(material.main_color[:3])
        if unit != 1:
            part.apply_scale(unit)
        of_colour.setdefault(colour, []).append(part)
    return of_colour


def _merged(vertices, faces, cell):
    """Vertices and faces of a mesh with one vertex for each cube of size `cell`."""
    cubes, cube = np.unique(np.round(vertices / cell), axis=0, return_inverse=True)
    cube = cube.ravel()
    centres = np.zeros((len(cubes), 3))
    np.add.at(centres, cube, vertices)
    centres /= np.bincount(cube)[:, None]
    faces = cube[faces]
    a, b, c = faces.T
    faces = np.unique(faces[(a != b) & (b != c) & (a != c)], axis=0)
    return _rounded(centres), faces.astype(np.uint32)


def _rounded(vertices):
    return np.round(vertices, 4).astype(np.float32)


def _bullet_indices(robot: Robot) -> tuple[dict[str | None, int], dict[str | None, int]]:
    """PyBullet's indices of joints and of links by their names; -1 is the base."""
    joints: dict[str | None, int] = {}
    for index, name in enumerate(robot.bullet_joint_names):
        joints[name] = index
    links: dict[str | None, int] = {name: index for index, name in robot.link_names.items()}
    return joints, links


def _link_name(joint, kind):
    """The name of a joint's `parent` or `child`."""
    return joint.find(kind).get("link")


def _numbers(element, name: str, default: Sequence[float] | np.ndarray = ()) -> tuple[float, ...]:
    """The numbers of an attribute."""
    if element is None or element.get(name) is None:
        return tuple(default)
    return tuple(float(part) for part in element.get(name).split())


def _origin(element):
    """The transform (4, 4) of an element's `origin`."""
    origin = element.find("origin")
    roll, pitch, yaw = _numbers(origin, "rpy", (0.0, 0.0, 0.0))
    matrix = trimesh.transformations.euler_matrix(roll, pitch, yaw)
    matrix[:3, 3] = _numbers(origin, "xyz", (0.0, 0.0, 0.0))
    return matrix


def _rgb(material) -> Colour | None:
    """The colour of a URDF's material; None without one, or where it is malformed."""
    try:
        rgb = np.array(_numbers(material.find("color"), "rgba", ())[:3])
    except ValueError:
        return None
    if rgb.shape != (3,) or not np.isfinite(rgb).all():
        return None
    return _colour(np.round(255 * np.clip(rgb, 0.0, 1.0)))


def _colour(numbers) -> Colour:
    red, green, blue = numbers
    return int(red), int(green), int(blue)
