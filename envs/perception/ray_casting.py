"""Depth images by compiled ray casting: from a `Scene` and a configuration, without PyBullet.

    caster = RayCaster(scene, configuration)
    depth, classes = caster.image(view_of(camera), camera.size)

The surfaces are the obstacles' own: boxes, cylinders, spheres, convex hulls, table and floor. The
arm's are the convex hulls of its collision meshes, as in collision checks, and its spheres, boxes
and capsules.
"""

import functools
import math
from collections.abc import Sequence

import numpy as np

from roboarm_nmp.envs.collision.hulls import arm_hulls, link_shapes
from roboarm_nmp.envs.perception.ray_kernels import (
    BALL,
    CLASS,
    MESH,
    MOVED_BY,
    PLACE,
    POLYHEDRON,
    ROUND,
    SHAPE,
    SIZE,
    SURFACE_COLUMNS,
    TURN,
    cast_rays,
)
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.rotations import matrix
from roboarm_nmp.envs.scenes.numbers import Vector
from roboarm_nmp.envs.scenes.primitives import (
    Box,
    ConvexHull,
    Cylinder,
    Obstacle,
    Scene,
    floor_box,
    hull_faces,
    to_array,
)

# Classes (paper, appendix "Training and verifying the encoders").
ROBOT = 0
STATIC = 1  # table and floor
OBSTACLE = 2
NOTHING = 3
_CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
# Counterclockwise from outside.
_CUBE_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_KINDS = {Box: POLYHEDRON, ConvexHull: POLYHEDRON, Cylinder: ROUND}  # and spheres
_FLAT = 0.0005  # m: half of the thickness that a mesh in one plane gets


class RayCaster:
    """A scene with the arm in it, for depth images of sensors.

    Args:
        scene: a `Scene`.
        configuration: the arm's joint angles (n, rad).
    """

    def __init__(self, scene: Scene, configuration: np.ndarray | Sequence[float]):
        robot = scene.robot
        self._state = np.asarray(robot.normalise(configuration), dtype=np.float64)
        known = []
        if scene.table is not None:
            known.append(scene.table)
        if scene.floor is not None:
            known.append(floor_box(scene.floor))
        hulls = tuple(o.vertices for o in scene.obstacles if isinstance(o, ConvexHull))
        arm, self._polyhedra = _meshes(robot, hulls)
        rows = _surfaces((*known, *scene.obstacles), len(self._polyhedra[1]) - 1 - len(hulls))
        rows[: len(known), CLASS] = STATIC
        self._surfaces = np.concatenate([rows, arm])
        self._chain, self._bodies, *_ = arm_hulls(robot)

    def image(self, view: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Depth, float32 (height, width), m along the viewing direction, and classes, uint8.

        Args:
            view: float64 (`ray_kernels.VIEW`,), see `envs.perception.sensors.view_of`.
            size: (width, height) in pixels.
        """
        width, height = size
        inverse = np.empty((height, width))
        classes = np.full((height, width), NOTHING, np.uint8)
        cast_rays(
            view,
            self._state,
            self._chain,
            self._bodies,
            self._surfaces,
            self._polyhedra,
            inverse,
            classes,
        )
        return (1.0 / inverse).astype(np.float32), classes


def _surfaces(obstacles: Sequence[Obstacle], first_hull: int) -> np.ndarray:
    """Obstacles as rows for `cast_rays`. `first_hull`: the polyhedron of the first hull."""
    numbers = to_array(obstacles)
    quaternions = numbers[:, 4:8] / np.linalg.norm(numbers[:, 4:8], axis=1, keepdims=True)
    rows = np.zeros((len(obstacles), SURFACE_COLUMNS))
    rows[:, MOVED_BY] = -1
    rows[:, CLASS] = OBSTACLE
    rows[:, PLACE : PLACE + 3] = numbers[:, 1:4]
    rows[:, TURN : TURN + 9] = matrix(quaternions.T).reshape(9, -1).T
    rows[:, SIZE : SIZE + 3] = numbers[:, 8:11]
    for row, obstacle in zip(rows, obstacles, strict=True):
        row[SHAPE] = _KINDS.get(type(obstacle), BALL)
        if isinstance(obstacle, Box):
            row[SIZE : SIZE + 3] /= 2
        elif isinstance(obstacle, Cylinder):
            row[SIZE + 2] /= 2
        elif isinstance(obstacle, ConvexHull):
            row[SIZE : SIZE + 3] = 1.0
            row[MESH] = first_hull
            first_hull += 1
    return rows


@functools.lru_cache(maxsize=64)
def _meshes(robot: Robot, hulls: tuple[tuple[Vector, ...], ...]):
    """The arm's surfaces, and the polyhedra: a cube, the arm's, and those of convex hulls.

    Args:
        robot: a `Robot`.
        hulls: tuple of the vertices of `ConvexHull`s.
    """
    arm, meshes = _arm_surfaces(robot)
    meshes = [(_CUBE, np.array(_CUBE_FACES)), *meshes]
    meshes += [(np.array(vertices), hull_faces(vertices)) for vertices in hulls]
    corners = np.full((sum(len(faces) for _, faces in meshes), 4), -1, np.int64)
    corners[: len(_CUBE_FACES)] = _CUBE_FACES
    corners[len(_CUBE_FACES) :, :3] = np.concatenate([faces[:, :3] for _, faces in meshes])[6:]
    vertices = np.concatenate([vertices for vertices, _ in meshes])
    vertex_ends = np.cumsum([0, *[len(vertices) for vertices, _ in meshes]])
    face_ends = np.cumsum([0, *[len(faces) for _, faces in meshes]])
    return arm, (vertices, vertex_ends, face_ends, corners)


@functools.lru_cache(maxsize=64)
def _arm_surfaces(robot: Robot) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """The arm's surfaces, and their polyhedra, which follow the cube: `(vertices, faces)` each."""
    rows = []
    meshes = []
    for link, _, rounding, mesh in link_shapes(robot):
        row = np.zeros(SURFACE_COLUMNS)
        row[SHAPE] = POLYHEDRON
        row[MOVED_BY] = 1 + link.frame
        row[CLASS] = ROBOT
        row[TURN : TURN + 9] = np.eye(3).ravel()
        row[SIZE : SIZE + 3] = 1.0
        if len(mesh) <= 2:  # a sphere, or a capsule: two spheres and a cylinder
            row[SHAPE] = BALL
            row[SIZE : SIZE + 3] = rounding
            for centre in mesh:
                rows.append(row.copy())
                rows[-1][PLACE : PLACE + 3] = centre
            if len(mesh) == 2:
                row[SHAPE] = ROUND
                row[PLACE : PLACE + 3] = mesh.mean(0)
                row[TURN : TURN + 9] = _turn_to(mesh[1] - mesh[0]).ravel()
                row[SIZE + 2] = math.dist(*mesh) / 2
                rows.append(row)
            continue
        meshes.append(_polyhedron(mesh))
        row[MESH] = len(meshes)
        rows.append(row)
    return np.reshape(rows, (-1, SURFACE_COLUMNS)), meshes


def _polyhedron(mesh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The convex hull of vertices (v, 3), m: vertices, and faces (f, 3)."""
    try:
        return mesh, hull_faces(tuple(map(tuple, mesh.tolist())))
    except ValueError:  # in one plane: it gets a thickness
        mesh = (mesh[:, None] + _FLAT * _CUBE).reshape(-1, 3)
        return mesh, hull_faces(tuple(map(tuple, mesh.tolist())))


def _turn_to(direction: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) whose z axis, the third column, has a direction (3,)."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
