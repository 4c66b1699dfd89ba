"""The shapes of the arm and of a scene as the arrays that compiled functions take."""

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import (
    BEGIN,
    BODY_COLUMNS,
    CENTRE,
    CORNERS,
    FRAME,
    FRAME_COLUMNS,
    HALF,
    JOINT,
    LINK,
    LINK_ROW,
    PARENT,
    POSITION,
    PRISMATIC,
    RADIUS,
    ROTATION,
    ROUNDING,
    ROW,
    SHARP,
    SPAN,
    SPHERE,
)
from roboarm_nmp.envs.collision.gjk_kernels import BULLET_MARGIN, CELLS, rows_of_primitives
from roboarm_nmp.envs.collision.grid_kernels import blocks_of_points, first_in_cells, group_cubes
from roboarm_nmp.envs.robots.body import body_alone, collision_elements
from roboarm_nmp.envs.robots.robot import Link, Robot
from roboarm_nmp.envs.robots.rotations import matrix
from roboarm_nmp.envs.scenes.primitives import ConvexHull, to_array
from roboarm_nmp.utils.bullet import load_urdf
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.utils.files import temporary_file

MAX_MARGIN = 0.5
"""m. Margins and radii of points must be smaller."""
# Edge (m) of the smaller cubes that group points, and how many are in a group along each axis.
_CUBE_SIZE, _GROUP_CUBES = 0.04, 4


@functools.lru_cache(64)
def arm_hulls(robot: Robot) -> tuple[np.ndarray, ...]:
    """The links' shapes as PyBullet makes them: `(chain, bodies, pairs, vertices, cells)`.

    A body is a convex hull, the points within its rounding included; a link may have several. With
    f frames, of which the first is the base's:

    - `chain`: float64 (f, `FRAME_COLUMNS`): a frame's parent, its joint, whether that is prismatic,
      the joint's value at -1 and its range, position 3 and rotation 9 in the parent;
    - `bodies`: float64 (b, `BODY_COLUMNS` + f): the frame in which a body moves, the centre of its
      bounding box there 3, the radius of the sphere around that centre, half edges 3, rounding (m),
      the link's row of link distances (`Robot.link_rows`), -1 for those that do not move, which
      come first; of a box, which has a second mesh, without rounding, that mesh and the first of
      its vertices, of other bodies -1; then `_levers`;
    - `pairs`: int64 (p, 2), the bodies that may collide;
    - `vertices`: float64 (v, 3), m, relative to their body's centre;
    - `cells`: see `_cells`.
    """
    chain = np.zeros((1 + len(robot.frames), FRAME_COLUMNS))
    chain[0, POSITION:ROTATION] = robot.base_position
    chain[0, ROTATION:] = _exact(matrix(robot.base_orientation)).ravel()
    span = robot.upper - robot.lower
    for row, frame in zip(chain[1:], robot.frames, strict=True):
        row[PARENT], row[JOINT], row[PRISMATIC] = 1 + frame.parent, frame.joint, frame.is_prismatic
        row[BEGIN] = frame.multiplier * robot.lower[frame.joint] + frame.offset
        row[SPAN] = frame.multiplier * span[frame.joint]
        row[POSITION:ROTATION] = frame.position
        row[ROTATION:] = _exact(frame.rotation)
    bodies, meshes, boxes = [], [], []
    of_link = {link.index: [] for link in robot.links}
    for link, mesh, rounding, surface in _kept_shapes(robot):
        centre = (mesh.min(0) + mesh.max(0)) / 2
        mesh = mesh - centre
        body = np.empty(BODY_COLUMNS)
        body[FRAME], body[CENTRE:RADIUS] = 1 + link.frame, centre
        body[RADIUS] = np.linalg.norm(mesh, axis=1).max()
        body[HALF:ROUNDING], body[ROUNDING] = mesh.max(0), rounding
        body[LINK_ROW] = robot.link_rows.get(link.index, -1)
        body[SHARP] = body[CORNERS] = -1
        if not np.array_equal(mesh, surface - centre):
            # Two boxes may touch where their cores with the rounding do not: that rounding counts
            # twice in what excludes distant shapes.
            body[RADIUS] = np.linalg.norm(surface - centre, axis=1).max() + rounding
            body[HALF:ROUNDING] = (surface - centre).max(0) + rounding
            boxes.append((body, surface - centre))
        of_link[link.index].append(len(bodies))
        bodies.append(body)
        meshes.append(mesh)
    pairs = []
    for a, b in robot.self_collision_pairs:
        pairs += itertools.product(of_link[a], of_link[b])
    pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    for body, surface in boxes:
        body[SHARP], body[CORNERS] = len(meshes), sum(map(len, meshes))
        meshes.append(surface)
    bodies = np.reshape(bodies, (-1, BODY_COLUMNS))
    bodies = np.concatenate([bodies, _levers(chain, bodies)], axis=1)
    return chain, bodies, pairs, np.concatenate(meshes), _cells(meshes)


@functools.lru_cache(64)
def _kept_shapes(robot):
    return tuple(link_shapes(robot))


def vertex_counts(robot: Robot) -> list[int]:
    """How many of the `vertices` of `arm_hulls` each body has, from the first one on."""
    return [len(mesh) for _, mesh, _, _ in _kept_shapes(robot)]


def _levers(chain, bodies):
    """How far a body's points move at most, per unit that a frame's joint turns or slides: (b, f).

    m per rad: the largest distance of its points from the joint's axis, in any configuration; 1
    for a prismatic joint; 0 for a frame that does not move the body.
    """
    levers = np.zeros((len(bodies), len(chain)))
    for body, row in zip(bodies, levers, strict=True):
        frame, position, beyond = int(body[FRAME]), body[CENTRE:RADIUS], body[RADIUS]
        while frame > 0:
            numbers = chain[frame]
            if numbers[PRISMATIC]:
                row[frame] = 1.0
                beyond += max(abs(numbers[BEGIN]), abs(numbers[BEGIN] + numbers[SPAN]))
            else:
                row[frame] = math.hypot(*position[:2]) + beyond
            beyond += np.linalg.norm(position)
            frame, position = int(numbers[PARENT]), numbers[POSITION:ROTATION]
    return levers


def link_shapes(robot: Robot) -> Iterator[tuple[Link, np.ndarray, float, np.ndarray]]:
    """Each `Link` of a robot with each of its shapes.

    PyBullet is asked for them: it replaces a mesh, and a cylinder, by its convex hull.

    Yields:
        The link; the vertices (v, 3), m, of the shape's core, in the link's frame; rounding, m; the
        vertices of its surface. The latter differ from the core's only for boxes. A sphere has one
        vertex, a capsule two.
    """
    with body_alone(robot) as body:
        for link in robot.links:
            for mesh, rounding, surface in _shapes(body.client, robot, body.id, link.index):
                for position, rotation in link.placements:
                    mesh = _moved(mesh, position, rotation)
                    surface = _moved(surface, position, rotation)
                yield link, mesh, rounding, surface


def _shapes(client, robot, body, link):
    """The shapes of a link of a body, in the link's frame: core, rounding, surface."""
    shapes = p.getCollisionShapeData(body, link, physicsClientId=client)
    if len(shapes) > 1 or any(len(_objects(shape[4].decode())) > 1 for shape in shapes):
        # PyBullet returns the vertices of all hulls as one, so each is loaded alone.
        for element in collision_elements(robot, robot.link_names[link]):
            for text in _one_by_one(element):
                with temporary_file(_ONE_SHAPE.format(text), ".urdf") as urdf:
                    alone = load_urdf(urdf, physicsClientId=client)
                yield from _shapes(client, robot, alone, -1)
                p.removeBody(alone, physicsClientId=client)
        return
    # PyBullet's positions are relative to the centre of mass.
    position, quaternion = p.getDynamicsInfo(body, link, physicsClientId=client)[3:5]
    for shape in shapes:
        if shape[2] == p.GEOM_MESH:
            flags = p.MESH_DATA_SIMULATION_MESH
            mesh = p.getMeshData(body, link, flags=flags, physicsClientId=client)[1]
            if not mesh:  # one of several, without triangles
                continue
            mesh = surface = np.array(mesh)
            rounding = BULLET_MARGIN
        else:
            mesh, rounding, surface = _primitive(shape)
        if any(quaternion[:3]):
            rotation = matrix(quaternion).ravel()
            mesh = _moved(mesh, (0.0, 0.0, 0.0), rotation)
            surface = _moved(surface, (0.0, 0.0, 0.0), rotation)
        yield mesh + position, rounding, surface + position


_ONE_SHAPE = """<robot name="shape"><link name="shape"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>{}</link></robot>"""


def _objects(file):
    """The objects of an OBJ file, each as the text of a file; PyBullet makes a hull of each."""
    if not file.lower().endswith(".obj"):
        return [None]
    vertices, objects = [], [[]]
    for line in Path(file).read_text(errors="replace").splitlines():
        word = line.split(maxsplit=1)[:1]
        if word in (["o"], ["g"]):
            objects.append([])
        elif word == ["v"]:
            vertices.append(line)
        elif word == ["f"]:
            # Only the vertices' numbers: those of textures and normals are not there.
            numbers = [corner.partition("/")[0] for corner in line.split()[1:]]
            objects[-1].append(f"f {' '.join(numbers)}")
    return ["\n".join([*vertices, *faces]) for faces in objects if faces]


def _one_by_one(element):
    """A URDF's `collision` element, or one for each object of its OBJ file, as text."""
    mesh = element.find("geometry/mesh")
    objects = [] if mesh is None else _objects(mesh.get("filename"))
    if mesh is None or len(objects) < 2:
        yield ElementTree.tostring(element, "unicode")
        return
    for text in objects:
        with temporary_file(text, ".obj") as file:
            mesh.set("filename", file)
            yield ElementTree.tostring(element, "unicode")


def _primitive(shape):
    """A box, sphere or capsule, relative to the centre of mass: core, rounding, surface."""
    kind, size, position, quaternion = shape[2], shape[3], shape[5], shape[6]
    if kind == p.GEOM_BOX:
        rounding = min(BULLET_MARGIN, min(size) / 2)
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        mesh = (np.array(size) / 2 - rounding) * signs
        surface = np.array(size) / 2 * signs
    elif kind == p.GEOM_SPHERE:
        rounding = size[0]
        mesh = surface = np.zeros((1, 3))
    elif kind == p.GEOM_CAPSULE:
        rounding = size[1]
        mesh = surface = np.array([(0.0, 0.0, -size[0] / 2), (0.0, 0.0, size[0] / 2)])
    else:
        raise ValueError(f"a link has a collision shape of PyBullet's kind {kind}")
    rotation = matrix(quaternion).ravel()
    return _moved(mesh, position, rotation), rounding, _moved(surface, position, rotation)


def _moved(mesh, position, rotation):
    """Vertices (v, 3) rotated by a row-major matrix (9,), then moved."""
    x, y, z = mesh.T
    r = rotation
    rows = [r[i] * x + r[i + 1] * y + r[i + 2] * z + position[i // 3] for i in (0, 3, 6)]
    return np.stack(rows, axis=1)


def _exact(rotation):
    """A rotation whose right angles are exact: cos(pi / 2) is 6e-17 in floating point."""
    rotation = np.array(rotation, dtype=np.float64)
    near = np.round(rotation)
    return np.where(np.abs(rotation - near) < 1e-9, near, rotation)


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
    counts, candidates, first = [], [], 0
    for mesh in meshes:
        for face in range(6):
            axis, sign = face // 2, 1 - 2 * (face % 2)
            directions = np.empty((3, *u.shape))
            directions[axis] = sign
            directions[(axis + 1) % 3] = u
            directions[(axis + 2) % 3] = v
            far = np.einsum("vi,iab->vab", mesh, directions)
            corners = np.stack([far[:, :-1, :-1], far[:, 1:, :-1], far[:, :-1, 1:], far[:, 1:, 1:]])
            best = corners.min(0).argmax(0)
            bests = np.take_along_axis(corners, best[None, None], axis=1)
            possible = (corners >= bests).any(0)  # (v, cells, cells)
            cell, vertex = np.nonzero(possible.reshape(len(mesh), -1).T)
            candidates.append(vertex + first)
            counts.append(np.bincount(cell, minlength=CELLS**2))
        first += len(mesh)
    ends = np.concatenate([[0], *counts]).cumsum()
    return np.concatenate([ends + len(ends), *candidates])


def world_shapes(obstacles: Sequence, robot: Robot) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Obstacles as `shape_rows`, and a robot's `arm_hulls` with their convex hulls as well.

    A convex hull is a row of the kind `LINK`, of a body that is not among the arm's `bodies`. If
    links may touch some of the obstacles, rows have a column more for each body: 1 if it may.
    """
    rows = shape_rows(obstacles)
    arm = arm_hulls(robot)
    if any(obstacle.may_touch for obstacle in obstacles):
        links = [robot.links_called(obstacle.may_touch) for obstacle in obstacles]
        of_rows = [[link in touching for link in robot.collision_links] for touching in links]
        # (The base, whose row is -1, touches nothing anyway.)
        touching = np.array(of_rows, dtype=np.float64)[:, arm[1][:, LINK_ROW].astype(int)]
        rows = np.concatenate([rows, touching], axis=1)
    hulls = [obstacle for obstacle in obstacles if isinstance(obstacle, ConvexHull)]
    if not hulls:
        return rows, arm
    chain, bodies, pairs, vertices, cells = arm
    num_meshes = (cells[0] - 1) // (6 * CELLS**2)
    rows[[isinstance(obstacle, ConvexHull) for obstacle in obstacles], 17] = np.arange(
        num_meshes, num_meshes + len(hulls)
    )
    for hull in hulls:
        _, mesh, own_cells = _hull(hull.vertices)
        cells = _concat_cells(cells, own_cells, len(vertices))
        vertices = np.concatenate([vertices, mesh])
    return rows, (chain, bodies, pairs, vertices, cells)


@functools.cache
def _client_of_hulls():
    """A world for `_hull`: to connect takes longer than the hull. It stays open."""
    return p.connect(p.DIRECT)


@functools.lru_cache(maxsize=1024)
def _hull(vertices):
    """A `ConvexHull` as PyBullet makes it: centre (3,), vertices (v, 3) relative to it, `_cells`.

    PyBullet is asked for the vertices: it rounds them to about 1/10,000 of the hull's size.
    """
    client = _client_of_hulls()
    shape = p.createCollisionShape(p.GEOM_MESH, vertices=vertices, physicsClientId=client)
    body = p.createMultiBody(0.0, shape, physicsClientId=client)
    flags = p.MESH_DATA_SIMULATION_MESH
    mesh = np.array(p.getMeshData(body, -1, flags=flags, physicsClientId=client)[1])
    p.removeBody(body, physicsClientId=client)
    centre = (mesh.min(0) + mesh.max(0)) / 2
    return centre, mesh - centre, _cells([mesh - centre])


def _concat_cells(cells, others, num_vertices):
    """`_cells` of two lists of meshes as those of one; the first ones have `num_vertices`."""
    # The first entry says where indices begin: after all positions.
    a, b = cells[0], others[0]
    positions = np.concatenate([cells[: a - 1], others[:b] + (cells[a - 1] - b)]) + (b - 1)
    return np.concatenate([positions, cells[a:], others[b:] + num_vertices])


def shape_rows(obstacles: Sequence) -> np.ndarray:
    """Obstacles -> float64 (n, `ROW`); `world_shapes` adds the bodies of convex hulls."""
    rows = rows_of_primitives(to_array(obstacles))
    for number, obstacle in enumerate(obstacles):
        if isinstance(obstacle, ConvexHull):
            centre, mesh, _ = _hull(obstacle.vertices)
            row = rows[number]
            row[0], row[16] = LINK, BULLET_MARGIN
            row[1:4] += row[4:13].reshape(3, 3) @ centre
            row[13:16] = mesh.max(0)
    return rows


def shape_centres(obstacles: Sequence) -> np.ndarray:
    """The centres of obstacles' shapes in their own frames: float64 (n, 3), m."""
    centres = np.zeros((len(obstacles), 3))
    for centre, obstacle in zip(centres, obstacles, strict=True):
        if isinstance(obstacle, ConvexHull):
            centre[:] = _hull(obstacle.vertices)[0]
    return centres


def group_points(points, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple]:
    """Points in groups of neighbours, as the compiled functions take them. Raises ValueError.

    Returns:
        `points`: float64 (n, 4): m, and of the first point in each cube the index after the cube's
        last point (of others the next one's). `groups`: float64 (g, 6): the centre (m) of a group,
        the largest distance (m) of its points from the centre, the index of its first point, and
        the index after its last. `ball`: float64 (1, `ROW`), a point as a shape. And the points as
        `grid_kernels.blocks_of_points` returns them.
    """
    points = np.asarray(points, dtype=np.float64)
    if not points.size and radius == 0.0:
        return _NO_POINTS
    if not points.size:
        points = points.reshape(0, 3)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape (n, 3), got {points.shape}")
    if not (np.isfinite(points).all() and 0 <= radius < MAX_MARGIN):
        raise ValueError(f"points must be finite, with a radius in [0, {MAX_MARGIN}) m")
    points = np.require(points, np.float64, ("C", "W"))
    first, cubes, count = first_in_cells(points, _CUBE_SIZE, False)
    cells = np.floor(points[first] / _CUBE_SIZE).astype(np.int64)
    groups = cells // _GROUP_CUBES
    x, y, z = (cells - _GROUP_CUBES * groups).T
    groups -= groups.min(0, initial=0)
    _, b, c = groups.max(0, initial=0) + 1
    group = (groups[:, 0] * b + groups[:, 1]) * c + groups[:, 2]
    order = np.argsort(((group * _GROUP_CUBES + x) * _GROUP_CUBES + y) * _GROUP_CUBES + z)
    number = np.zeros(len(order), np.int64)
    number[order[1:]] = (np.diff(group[order]) != 0).cumsum()
    points, groups = group_cubes(points, cubes, order, count, number)
    ball = np.zeros((1, ROW))
    ball[0, 0], ball[0, 16] = SPHERE, radius
    return points, groups, ball, blocks_of_points(points, groups)


_NOTHING = np.empty(0, np.float32)
_NO_POINTS = (
    np.empty((0, 4)),
    np.empty((0, 6)),
    np.zeros((1, ROW)),
    (_NOTHING, _NOTHING, np.empty(0, np.int64)),
)
_NO_POINTS[2][0, 0] = SPHERE
