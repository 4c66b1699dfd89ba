"""The shapes of the arm and of a scene as the arrays that `kernels` takes."""

import functools
import math

import numpy as np

from roboarm_nmp.envs import panda
from roboarm_nmp.envs.collision.kernels import BULLET_MARGIN, CELLS, ROW, SPHERE
from roboarm_nmp.envs.scenes.primitives import Cylinder, Sphere, to_array
from roboarm_nmp.envs.utils.bullet import pybullet as p

MAX_MARGIN = 0.5
"""m. Margins and radii of points must be smaller."""
# Edge (m) of the cubes that group points.
_GROUP_SIZE = 0.16


@functools.cache
def arm_hulls():
    """The links' hulls as PyBullet makes them: `(bodies, pairs, vertices, cells)`.

    `bodies`: float64 (11, 8), the base and `panda.COLLISION_LINKS`: the frame in which a body moves
    (0 for the base's, otherwise the number of a joint), the centre of its bounding box there 3, the
    radius of the sphere around that centre, half edges 3. `pairs`: int64 (n, 2), the bodies that
    may collide. `vertices`: float64 (v, 3), m, relative to their body's centre. `cells`: see
    `_cells`.
    """
    client = p.connect(p.DIRECT)
    try:
        robot = panda.load(client)
        meshes = []
        for link in (-1, *panda.COLLISION_LINKS):
            # PyBullet's vertices are relative to the link's centre of mass.
            mass_centre = p.getDynamicsInfo(robot, link, physicsClientId=client)[3]
            flags = p.MESH_DATA_SIMULATION_MESH
            mesh = p.getMeshData(robot, link, flags=flags, physicsClientId=client)[1]
            meshes.append(np.array(mesh) + mass_centre)
    finally:
        p.disconnect(physicsClientId=client)
    # The hand and the open fingers move with joint 7.
    for finger, side in ((9, 1.0), (10, -1.0)):
        meshes[finger] += np.array(panda.HAND_TO_FINGER) + (0.0, side * panda.FINGER_OPENING, 0.0)
    c, s = math.cos(panda.HAND_YAW), math.sin(panda.HAND_YAW)
    for body in (8, 9, 10):
        x, y, z = meshes[body].T
        meshes[body] = np.stack([c * x - s * y, s * x + c * y, z + panda.FLANGE_LENGTH], axis=1)
    bodies = np.zeros((len(meshes), 8))
    for body, mesh in enumerate(meshes):
        centre = (mesh.min(0) + mesh.max(0)) / 2
        mesh -= centre
        radius = np.linalg.norm(mesh, axis=1).max()
        bodies[body] = (min(body, panda.NUM_JOINTS), *centre, radius, *mesh.max(0))
    order = {link: body for body, link in enumerate((-1, *panda.COLLISION_LINKS))}
    pairs = np.array([[order[a], order[b]] for a, b in panda.SELF_COLLISION_PAIRS])
    return bodies, pairs, np.concatenate(meshes), _cells(meshes)


def _cells(meshes):
    """The vertices that can be the farthest one of their hull, for each cell of directions.

    A cell's directions are mixtures of those of its four corners, so a vertex that another one
    beats in all four is never the farthest: about five vertices of 150 remain.

    Returns:
        An int64 array: for each cell (body by body, face by face) the position in this array where
        the indices of its vertices begin; the position where the last ones end; then the indices.
    """
    steps = np.linspace(-1.0, 1.0, CELLS + 1)
    u, v = np.meshgrid(steps, steps, indexing="ij")
    ends, candidates, first = [0], [], 0
    for mesh in meshes:
        for face in range(6):
            directions = [None] * 3
            directions[face // 2] = np.full_like(u, 1 - 2 * (face % 2))
            directions[(face // 2 + 1) % 3], directions[(face // 2 + 2) % 3] = u, v
            far = np.einsum("vi,iab->vab", mesh, np.stack(directions))
            corners = np.stack([far[:, :-1, :-1], far[:, 1:, :-1], far[:, :-1, 1:], far[:, 1:, 1:]])
            best = corners.min(0).argmax(0)
            bests = np.take_along_axis(corners, best[None, None], axis=1)
            possible = (corners >= bests).any(0)  # (v, cells, cells)
            cell, vertex = np.nonzero(possible.reshape(len(mesh), -1).T)
            candidates.append(vertex + first)
            ends.append(ends[-1] + np.bincount(cell, minlength=CELLS**2).cumsum())
            ends = [*ends[:-1], *ends[-1].tolist()]
        first += len(mesh)
    return np.concatenate([np.array(ends) + len(ends), *candidates])


def shape_rows(obstacles):
    """Obstacles -> float64 (n, `ROW`)."""
    rows = np.zeros((len(obstacles), ROW))
    for obstacle, numbers, row in zip(obstacles, to_array(obstacles), rows, strict=True):
        (kind,), position, quaternion, size = np.split(numbers, (1, 4, 8))
        norm = math.sqrt(quaternion @ quaternion)
        half = np.array(size) if isinstance(obstacle, Sphere) else size / 2
        if isinstance(obstacle, Cylinder):
            half[:2] = obstacle.radius
        rounding = half[0] if isinstance(obstacle, Sphere) else min(BULLET_MARGIN, half.min())
        x, y, z, w = quaternion / norm
        rotation = (
            *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        )
        row[:] = (kind, *position, *rotation, *half - rounding, rounding, 0)
    return rows


def group_points(points, radius):
    """Points in groups of neighbours, as the compiled functions take them. Raises ValueError.

    Returns:
        `points`: float64 (n, 3), m. `groups`: float64 (g, 6): the centre (m) of a group, the
        largest distance (m) of its points from the centre, the index of its first point, and the
        index after its last. `ball`: float64 (1, `ROW`), a point as a shape.
    """
    points = np.asarray(points, dtype=np.float64)
    if not points.size:
        points = points.reshape(0, 3)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape (n, 3), got {points.shape}")
    if not (np.isfinite(points).all() and 0 <= radius < MAX_MARGIN):
        raise ValueError(f"points must be finite, with a radius in [0, {MAX_MARGIN}) m")
    _, cell = np.unique(
        np.floor(points / _GROUP_SIZE).astype(np.int64), axis=0, return_inverse=True
    )
    points = points[np.argsort(cell.ravel(), kind="stable")]
    offsets = np.cumsum([0, *np.bincount(cell.ravel())])
    groups = np.empty((len(offsets) - 1, 6))
    for group, first, end in zip(groups, offsets[:-1], offsets[1:], strict=True):
        middle = (points[first:end].min(0) + points[first:end].max(0)) / 2
        reach = np.linalg.norm(points[first:end] - middle, axis=1).max()
        group[:] = (*middle, reach, first, end)
    ball = np.zeros((1, ROW))
    ball[0, 0], ball[0, 16] = SPHERE, radius
    return points, groups, ball
