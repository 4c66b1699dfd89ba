"""Spheres around and inside the links' hulls, which settle most collision checks of motions.

They are computed once per hull, in about a tenth of a second, and kept in the user's cache folder.
"""

import contextlib
import functools
import hashlib

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist

from roboarm_nmp.envs.collision.arm_kernels import (
    BEGIN,
    BODY_COLUMNS,
    CENTRE,
    CORNERS,
    PARENT,
    POSITION,
    PRISMATIC,
    RADIUS,
    ROTATION,
    ROUNDING,
    SPAN,
)
from roboarm_nmp.envs.collision.hulls import arm_hulls, vertex_counts
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.utils.files import cache_folder, write_atomically

NUM_OUTER, NUM_INNER = 8, 4
"""Spheres around each hull, and inside it."""
SLACK = 2e-5
"""m. Spheres are enlarged, and inner ones shrunk, by this times the arm's reach in m, at least one:
rounding to float32 moves a point of the arm by about a tenth of it."""
_VERSION = b"1"  # of the computation below, in the names of cached files
_CANDIDATES = 4000  # random points of a hull, among which inner spheres' centres are chosen
_STEPS = 300  # towards the smallest ball around points
_SMALL = 0.03  # m: radius of a ball that is not cut again
_MARGINS = 0.03  # m: plans seldom keep more distance from points
_CHECKSUM = 32  # bytes, SHA-256
_EXACT = 1e-9  # m: more than rounding in float64


def hull_spheres(mesh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Spheres around and inside the convex hull of vertices (v, 3), m.

    Returns:
        float64 (o, 4), centre and radius, m, which cover the hull; and (i, 4), which lie in it (of
        a flat hull: points of it, with radius 0).
    """
    mesh = np.ascontiguousarray(mesh, np.float64)
    digest = hashlib.sha256(_VERSION + mesh.tobytes()).hexdigest()[:32]
    # (RuntimeError and OSError: there is no folder, or no file.)
    with contextlib.suppress(OSError, RuntimeError):
        contents = _file(digest).read_bytes()
        checksum, numbers = contents[:_CHECKSUM], contents[_CHECKSUM:]
        if checksum == hashlib.sha256(numbers).digest():
            spheres = np.frombuffer(numbers).reshape(-1, 5)
            return spheres[spheres[:, 4] == 1, :4], spheres[spheres[:, 4] == 0, :4]
    outer, inner = _outer(mesh), _inner(mesh)
    spheres = np.concatenate([np.insert(outer, 4, 1, axis=1), np.insert(inner, 4, 0, axis=1)])
    numbers = spheres.astype(np.float64).tobytes()
    with contextlib.suppress(OSError, RuntimeError):  # without the file, they are computed again
        _file(digest).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(_file(digest), hashlib.sha256(numbers).digest() + numbers)
    return outer, inner


def _file(digest):
    return cache_folder() / "spheres" / digest


def _outer(mesh):
    """Spheres that cover a hull: it is cut in two again and again, where a piece's ball is largest.

    Pieces are the hulls of their vertices, so a ball around the vertices has all of the piece.
    """
    pieces = [_corners(mesh)]
    balls = [_ball_around(pieces[0])]
    while len(pieces) < NUM_OUTER:
        largest = int(np.argmax([ball[3] for ball in balls]))
        if balls[largest][3] < _SMALL:
            break
        one, other = _cut(pieces[largest])
        pieces[largest] = one
        balls[largest] = _ball_around(one)
        pieces.append(other)
        balls.append(_ball_around(other))
    return np.array(balls)


def _ball_around(points):
    """Centre and radius of a small ball around points (Badoiu and Clarkson, 2003): (4,)."""
    centre = (points.min(0) + points.max(0)) / 2
    for step in range(1, _STEPS):
        away = points - centre
        centre = centre + away[np.square(away).sum(1).argmax()] / (step + 1)
    radius = np.sqrt(np.square(points - centre).sum(1).max())
    return np.append(centre, radius + _EXACT if radius > 0.0 else 0.0)


def _corners(points):
    """Those of the points (n, 3) that are vertices of their convex hull; of a flat one, all."""
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        return np.unique(points, axis=0)


def _cut(points):
    """Two pieces of a hull, cut across its longest direction: their vertices (a, 3), (b, 3)."""
    axis = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
    along = points @ axis
    middle = (along.min() + along.max()) / 2
    one, other = points[along <= middle], points[along > middle]
    share = (middle - along[along <= middle])[:, None]
    share = share / (along[along > middle] - along[along <= middle][:, None])
    section = one[:, None] + (other - one[:, None]) * share[:, :, None]
    section = section.reshape(-1, 3)
    return _corners(np.concatenate([one, section])), _corners(np.concatenate([other, section]))


def _inner(mesh):
    """Spheres in a hull; each fills most of what the ones before have left of it."""
    try:
        planes = ConvexHull(mesh).equations
    except (QhullError, ValueError):  # it is flat
        return np.append(mesh.mean(0), 0.0)[None]
    rng = np.random.default_rng(0)
    points = rng.uniform(mesh.min(0), mesh.max(0), (_CANDIDATES, 3))
    depths = -(points @ planes[:, :3].T + planes[:, 3]).max(1)
    points, depths = points[depths > 0.0], depths[depths > 0.0]
    if not len(points):
        return np.append(mesh.mean(0), 0.0)[None]
    order = np.argsort(-depths, kind="stable")
    tried = np.unique(np.concatenate([order[:100], rng.choice(len(points), 200)]))
    fills = cdist(points[tried], points) < depths[tried, None]
    left = np.ones(len(points), np.bool_)
    spheres = []
    for _ in range(NUM_INNER):
        best = int((fills & left).sum(1).argmax())
        left &= ~fills[best]
        centre, radius = points[tried[best]], depths[tried[best]]
        spheres.append(np.append(centre, max(radius - _EXACT, 0.0)))
    return np.array(spheres)


@functools.lru_cache(64)
def block_arm(robot: Robot) -> tuple[np.ndarray, ...]:
    """A robot's `arm_hulls` for blocks of states: `(chain, bodies, outer, ..., inner, ...)`.

    - `chain`, `bodies`: those of `arm_hulls`, float32, with larger radii;
    - `outer`, `inner`: float32 (n, 4), spheres of all bodies: their centre in the body's frame, and
      radius, m; each is followed by int64 (b + 1,), where the spheres of each body begin.
    """
    chain, bodies, _, vertices, _ = arm_hulls(robot)
    slack = SLACK * max(1.0, reach_bound(chain))
    kinds = [], []
    begins = [0], [0]
    first = 0
    for body, number in zip(bodies, vertex_counts(robot), strict=True):
        outer, inner = hull_spheres(vertices[first : first + number])
        first += number
        if body[CORNERS] >= 0.0:
            # Two boxes may touch where their cores with the rounding do not: see `arm_hulls`.
            corner = int(body[CORNERS])
            outer, _ = hull_spheres(vertices[corner : corner + 8])
            outer = outer + np.array([0.0, 0.0, 0.0, body[ROUNDING]])
        pairs = zip(kinds, begins, (outer, inner), (slack, -slack), strict=True)
        for kind, begin, found, more in pairs:
            moved = found + np.append(body[CENTRE:RADIUS], more)
            kind.append(moved)
            begin.append(begin[-1] + len(moved))
    single = bodies[:, :BODY_COLUMNS].astype(np.float32)
    single[:, RADIUS] += np.float32(slack)
    outer, inner = (np.concatenate(kind).astype(np.float32) for kind in kinds)
    return (
        chain.astype(np.float32),
        single,
        outer,
        np.array(begins[0]),
        inner,
        np.array(begins[1]),
    )


def reach_bound(chain: np.ndarray) -> float:
    """How far (m) from the base's frame the arm's frames can be at most."""
    reach = np.zeros(len(chain))
    for f in range(1, len(chain)):
        slide = 0.0
        if chain[f, PRISMATIC]:
            slide = max(abs(chain[f, BEGIN]), abs(chain[f, BEGIN] + chain[f, SPAN]))
        step = np.linalg.norm(chain[f, POSITION:ROTATION]) + slide
        reach[f] = reach[int(chain[f, PARENT])] + step
    return float(reach.max())


def grid_reach(robot: Robot, point_radius: float) -> tuple[float, float]:
    """For `grid_kernels.distance_grid`: how far points matter, and how far distances do, m."""
    chain, bodies, outer = block_arm(robot)[:3]
    largest = float(outer[:, 3].max() + bodies[:, ROUNDING].max())
    base = float(np.linalg.norm(chain[0, POSITION:ROTATION]))
    body = float((np.linalg.norm(bodies[:, CENTRE:RADIUS], axis=1) + bodies[:, RADIUS]).max())
    within = largest + point_radius + _MARGINS
    return base + reach_bound(chain) + body + within, within
