"""Compiled signed distances, with EPA (van den Bergen, 2001) where shapes overlap."""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import (
    FAR,
    FRAME,
    JOINT,
    LINK_ROW,
    PARENT,
    PRISMATIC,
    RADIUS,
    ROUNDING,
    ROW,
    SHARP,
    SIMPLEX,
    SPAN,
    place_arm,
    working_memory,
)
from roboarm_nmp.envs.collision.block_kernels import F32, row_gaps, rows_of_block
from roboarm_nmp.envs.collision.gjk_kernels import (
    GJK_TOLERANCE,
    begin_gjk,
    both_boxes,
    box_gap,
    box_gaps,
    boxes_apart,
    gjk,
    nearest_in_triangle,
    relative_pose,
    sphere_gap,
    support,
    write_body_row,
    write_sharp_row,
)
from roboarm_nmp.envs.collision.motion_kernels import is_free
from roboarm_nmp.utils.numba_cache import compiled

_NEAR_SLACK = 1e-5  # m: more than rounding the arm to float32 changes
_EPA_TOLERANCE, _EPA_VERTICES, _EPA_FACES = 1e-7, 128, 768


@compiled
def _add_face(s, faces, n, a, b, c):
    """Append a face of EPA's polytope: its points, unit normal, distance from the origin."""
    f = faces[n]
    f[0], f[1], f[2] = a, b, c
    squared = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        f[3 + i] = (s[b, j] - s[a, j]) * (s[c, k] - s[a, k])
        f[3 + i] -= (s[b, k] - s[a, k]) * (s[c, j] - s[a, j])
        squared += f[3 + i] * f[3 + i]
    f[6] = FAR  # of a face without an area, which is never the nearest
    if squared > 1e-30:
        norm = math.sqrt(squared)
        for i in range(3, 6):
            f[i] /= norm
        f[6] = f[3] * s[a, 0] + f[4] * s[a, 1] + f[5] * s[a, 2]
    return n + 1


@compiled
def _epa(vertices, cells, k, rows, j, pose, s, points, faces, edges):
    """Depth (m) of a body's hull in a shape's core, from a simplex of `gjk` around the origin.

    Writes the normal, along which the body leaves the core, to s[28:31], and the body's deepest
    point to s[24:27]. Working memory: `points` (`_EPA_VERTICES`, 6), `faces` (`_EPA_FACES`, 7),
    `edges` (`_EPA_FACES`, 2).
    """
    for i in range(4):
        for n in range(3):
            points[i, n], points[i, 3 + n] = s[3 * i + n], s[12 + 3 * i + n]
    num_points, num_faces = 4, 0
    for face in range(4):
        a, b, c = (face + 1) % 4, (face + 2) % 4, (face + 3) % 4
        num_faces = _add_face(points, faces, num_faces, a, b, c)
        if faces[num_faces - 1, 6] < 0.0:  # its normal points inwards
            num_faces = _add_face(points, faces, num_faces - 1, a, c, b)
    while True:
        nearest = 0
        for f in range(1, num_faces):
            if faces[f, 6] < faces[nearest, 6]:
                nearest = f
        face = faces[nearest]
        x, y, z = face[3], face[4], face[5]
        px, py, pz, ax, ay, az = support(vertices, cells, k, rows, j, pose, x, y, z)
        further = x * px + y * py + z * pz - face[6]
        # (The next round has at most three times as many faces.)
        full = num_points == points.shape[0] or 3 * num_faces > faces.shape[0]
        if further <= _EPA_TOLERANCE or full:
            break
        new = points[num_points]
        new[0], new[1], new[2], new[3], new[4], new[5] = px, py, pz, ax, ay, az
        # Faces visible from the new point are replaced by faces between it and their outline.
        num_edges, f = 0, 0
        while f < num_faces:
            height = faces[f, 3] * px + faces[f, 4] * py + faces[f, 5] * pz - faces[f, 6]
            if height <= 1e-12:
                f += 1
                continue
            for i in range(3):
                a, b = int(faces[f, i]), int(faces[f, (i + 1) % 3])
                for e in range(num_edges):
                    if edges[e, 0] == b and edges[e, 1] == a:  # between two visible faces
                        num_edges -= 1
                        edges[e, 0], edges[e, 1] = edges[num_edges, 0], edges[num_edges, 1]
                        break
                else:
                    edges[num_edges, 0], edges[num_edges, 1] = a, b
                    num_edges += 1
            num_faces -= 1
            for i in range(7):
                faces[f, i] = faces[num_faces, i]
        for e in range(num_edges):
            num_faces = _add_face(points, faces, num_faces, edges[e, 0], edges[e, 1], num_points)
        num_points += 1
    depth = face[6]
    # The origin's projection on that face, as a mean of its corners, so of the body's vertices.
    triangle = np.empty(9)
    for i in range(3):
        for n in range(3):
            triangle[3 * i + n] = points[int(face[i]), n] - depth * face[3 + n]
    _, u, v, w = nearest_in_triangle(triangle, 0, 3, 6)
    for n in range(3):
        s[24 + n] = (
            u * points[int(face[0]), 3 + n]
            + v * points[int(face[1]), 3 + n]
            + w * points[int(face[2]), 3 + n]
        )
        s[28 + n] = -face[3 + n]
    return depth


@compiled
def _signed_distance(bodies, vertices, cells, k, rows, j, frames, centres, pose, s, far, polytope):
    """Distance (m) of a body's hull from a shape's core, minus the depth where they overlap.

    `FAR` if that is not less than `far`. Otherwise s[28:31] is the normal, along which the body
    moves away, and s[24:27] the witness: the hull's nearest or deepest point, relative to the
    body's centre. Both are in the body's axes.
    """
    squared = sphere_gap(rows, j, centres, k)
    reach = bodies[k, RADIUS] + far
    # If the centre is outside of the box, the depth is at most the radius less the distance.
    if squared > 0.0 and (reach <= 0.0 or squared >= reach * reach):
        return FAR
    relative_pose(rows, j, frames, int(bodies[k, FRAME]), centres, k, pose)
    if boxes_apart(bodies, k, rows, j, pose, far):
        return FAR
    if both_boxes(bodies, k, rows, j):
        return _boxes_distance(bodies, vertices, cells, k, rows, j, pose, s, far, polytope)
    return _core_distance(vertices, cells, k, rows, j, pose, s, far, polytope)


@compiled
def _boxes_distance(bodies, vertices, cells, k, rows, j, pose, s, far, polytope):
    """`_signed_distance` of the cores of two boxes, if their surfaces had no rounding."""
    sharp = s[None, SIMPLEX:]
    write_sharp_row(bodies, rows, j, sharp)
    rounding, body = bodies[k, ROUNDING] + rows[j, 16], int(bodies[k, SHARP])
    distance = _core_distance(vertices, cells, body, sharp, 0, pose, s, far - rounding, polytope)
    if distance == FAR:
        return FAR
    for i in range(3):  # the witness is a point of the core
        s[24 + i] += bodies[k, ROUNDING] * s[28 + i]
    return distance + rounding


@compiled
def _core_distance(vertices, cells, k, rows, j, pose, s, far, polytope):
    """`_signed_distance` without the bounds that exclude distant shapes; `pose` is the core's."""
    begin_gjk(rows, j, pose, s)
    distance, n = gjk(vertices, cells, k, rows, j, pose, s, -1.0, far)
    if distance != 0.0 and distance >= far:  # (where they overlap, the depth decides)
        return FAR
    if distance == 0.0:
        if n < 4:  # the origin is on a face or an edge of the simplex: move it off, by 0.1 um
            pose[9] += 3e-8
            pose[10] += 5e-8
            pose[11] += 7e-8
            n = gjk(vertices, cells, k, rows, j, pose, s, -1.0, FAR)[1]
        if n == 4:
            points, faces, edges = polytope
            return -_epa(vertices, cells, k, rows, j, pose, s, points, faces, edges)
    u, v, w = s[24], s[25] if n > 1 else 0.0, s[26] if n > 2 else 0.0
    norm = math.sqrt(s[28] * s[28] + s[29] * s[29] + s[30] * s[30])
    for i in range(3):
        s[24 + i] = u * s[12 + i]
        if n > 1:
            s[24 + i] += v * s[15 + i]
        if n > 2:
            s[24 + i] += w * s[18 + i]
        s[28 + i] /= norm
    return distance


@compiled
def _gradient(chain, frames, a, b, normal, witness, gradient):
    """Write the speed of a point of frame `a` along a direction per unit of each joint.

    That is relative to frame `b`: joints that move both change nothing.
    """
    gradient[:] = 0.0
    sign = 1.0
    while a != b:
        if a < b:  # parents come first
            a, b, sign = b, a, -sign
        joint, f = int(chain[a, JOINT]), frames[a]
        if chain[a, PRISMATIC] == 0.0:  # the joint turns about its z
            x, y, z = witness[0] - f[9], witness[1] - f[10], witness[2] - f[11]
            speed = (
                normal[0] * (f[5] * z - f[8] * y)
                + normal[1] * (f[8] * x - f[2] * z)
                + normal[2] * (f[2] * y - f[5] * x)
            )
        else:
            speed = normal[0] * f[2] + normal[1] * f[5] + normal[2] * f[8]
        gradient[joint] += sign * (speed * (0.5 * chain[a, SPAN]))
        a = int(chain[a, PARENT])


@compiled
def _to_base(frames, f, centres, k, s, sign, back, normal, witness):
    """Write normal and witness of `_signed_distance` in the base's frame.

    `sign`: of the normal. `back`: m, from the hull's point to the shape's, which is the witness.
    """
    for i in range(3):
        out = at = 0.0
        for n in range(3):
            out += frames[f, 3 * i + n] * s[28 + n]
            at += frames[f, 3 * i + n] * s[24 + n]
        normal[i], witness[i] = sign * out, centres[k, i] + at - back * out


@compiled
def _cloud_distance(
    bodies, vertices, cells, k, world, frames, centres, pose, s, far, polytope, gaps
):
    """`_signed_distance` from the nearest point of the cloud.

    `gaps`: working memory, two arrays for all groups and all points: their distance (m) from the
    box around the body, a lower bound of their distance from its hull.
    """
    _, points, groups, ball, _ = world
    of_groups, of_points = gaps
    box_gaps(bodies, k, frames, centres, groups, 0, groups.shape[0], of_groups)
    middle = -1
    for g in range(groups.shape[0]):
        of_groups[g] -= groups[g, 3]
        if middle < 0 or of_groups[g] < of_groups[middle]:
            middle = g
    # The point that is probably nearest comes first: it rules out the others.
    first, least = -1, far
    for n in range(groups.shape[0]):
        g = middle if n == 0 else n - 1 if n <= middle else n
        begin, end = int(groups[g, 4]), int(groups[g, 5])
        of_points[begin] = -1.0  # not computed yet
        if of_groups[g] < least:
            box_gaps(bodies, k, frames, centres, points, begin, end, of_points)
            for j in range(begin, end):
                if of_points[j] < least:
                    first, least = j, of_points[j]
    nearest = FAR
    # Two planes with the whole hull behind them: through the witness of the nearest point so far,
    # and of the last point that turned out to be farther away.
    ax = ay = az = bx = by = bz = 0.0
    a = b = -FAR
    x = y = z = 0.0  # the witness
    for g in range(-1 if first >= 0 else groups.shape[0], groups.shape[0]):
        begin, end = first, first + 1
        if g >= 0:
            begin, end = int(groups[g, 4]), int(groups[g, 5])
            # (Inside of the box, the gap does not bound the depth.)
            if of_groups[g] + groups[g, 3] > 0.0 and of_groups[g] >= far:
                continue
            if of_points[begin] < 0.0:
                box_gaps(bodies, k, frames, centres, points, begin, end, of_points)
        for j in range(begin, end):
            if (g >= 0 and j == first) or (of_points[j] > 0.0 and of_points[j] >= far):
                continue
            box_gap(bodies, k, frames, centres, points, j, pose)
            u, v, w = pose[9], pose[10], pose[11]
            if max(a - (ax * u + ay * v + az * w), b - (bx * u + by * v + bz * w)) >= far:
                continue
            core = _core_distance(vertices, cells, k, ball, 0, pose, s, far, polytope)
            if core < far:
                nearest = far = core
                x, y, z, ax, ay, az = s[24], s[25], s[26], s[28], s[29], s[30]
                a = ax * x + ay * y + az * z + GJK_TOLERANCE if core > 0.0 else -FAR
            else:
                norm = math.sqrt(s[28] * s[28] + s[29] * s[29] + s[30] * s[30])
                bx, by, bz = s[28] / norm, s[29] / norm, s[30] / norm
                b = s[31] + bx * u + by * v + bz * w
    s[24], s[25], s[26], s[28], s[29], s[30] = x, y, z, ax, ay, az
    return nearest


@compiled
def signed_distances_batch(
    states,
    self_collisions,
    within,
    arm,
    world,
    distance,
    normal,
    witness,
    gradient,
    geometry,
):
    """Write `CollisionChecker.signed_distances` of states (m, n).

    `geometry`: the index of a row, or the number of rows for another link, one more for a point,
    two more for nothing.
    """
    chain, bodies, pairs, vertices, cells = arm
    rows, points, groups, ball, _ = world
    frames, centres, pose, s, other = working_memory(chain, bodies)
    polytope = (
        np.empty((_EPA_VERTICES, 6)),
        np.empty((_EPA_FACES, 7)),
        np.empty((_EPA_FACES, 2), np.int64),
    )
    gaps = np.empty(groups.shape[0]), np.empty(points.shape[0])
    of_arm, touching = rows.shape[0], rows.shape[1] > ROW
    columns = rows_of_block(rows)[1]
    capacity = columns.shape[0] // ROW
    near = np.empty(capacity, np.float32)
    distance[:], normal[:], witness[:], geometry[:] = within, 0.0, 0.0, of_arm + 2
    for i in range(states.shape[0]):
        place_arm(states[i], chain, bodies, frames, centres)
        for k in range(bodies.shape[0]):
            f, link = int(bodies[k, FRAME]), int(bodies[k, LINK_ROW])
            if link < 0:  # the base
                continue
            # The shape that is probably nearest comes first: it rules out the others.
            x, y, z = F32(centres[k, 0]), F32(centres[k, 1]), F32(centres[k, 2])
            row_gaps(columns, capacity, x, y, z, near)
            first = 0
            for j in range(1, rows.shape[0]):
                if near[j] < near[first]:
                    first = j
            for n in range(rows.shape[0]):
                j = first if n == 0 else n - 1 if n <= first else n
                rounding = rows[j, 16] + bodies[k, ROUNDING]
                far = min(distance[i, link] + rounding, FAR)
                # (What is farther than `near` says, which is rounded, is so by the slack.)
                reach = bodies[k, RADIUS] + far + columns[17 * capacity + j] + _NEAR_SLACK
                if near[j] >= reach * reach and reach > 0.0:
                    continue
                core = _signed_distance(
                    bodies, vertices, cells, k, rows, j, frames, centres, pose, s, far, polytope
                )
                if core < far and not (touching and rows[j, ROW + k] != 0.0):
                    distance[i, link], geometry[i, link] = core - rounding, j
                    _to_base(frames, f, centres, k, s, 1.0, 0.0, normal[i, link], witness[i, link])
            rounding = ball[0, 16] + bodies[k, ROUNDING]
            far = min(distance[i, link] + rounding, FAR)
            core = _cloud_distance(
                bodies, vertices, cells, k, world, frames, centres, pose, s, far, polytope, gaps
            )
            if core < far:
                distance[i, link], geometry[i, link] = core - rounding, of_arm + 1
                _to_base(frames, f, centres, k, s, 1.0, 0.0, normal[i, link], witness[i, link])
            _gradient(chain, frames, f, 0, normal[i, link], witness[i, link], gradient[i, link])
        for j in range(pairs.shape[0] if self_collisions else 0):
            a, b = pairs[j, 0], pairs[j, 1]
            rounding = bodies[a, ROUNDING] + bodies[b, ROUNDING]
            far = -FAR
            for body in (a, b):
                if bodies[body, LINK_ROW] >= 0.0:
                    far = max(far, distance[i, int(bodies[body, LINK_ROW])])
            far = min(far + rounding, FAR)
            write_body_row(bodies, b, frames, centres, other)
            core = _signed_distance(
                bodies, vertices, cells, a, other, 0, frames, centres, pose, s, far, polytope
            )
            fa, fb = int(bodies[a, FRAME]), int(bodies[b, FRAME])
            for body, sign, back in ((a, 1.0, 0.0), (b, -1.0, core)):
                link = int(bodies[body, LINK_ROW])
                if link >= 0 and core < FAR and core - rounding < distance[i, link]:
                    distance[i, link], geometry[i, link] = core - rounding, of_arm
                    there, at = normal[i, link], witness[i, link]
                    _to_base(frames, fa, centres, a, s, sign, back, there, at)
                    moved, other_frame = (fa, fb) if body == a else (fb, fa)
                    _gradient(chain, frames, moved, other_frame, there, at, gradient[i, link])
        for link in range(distance.shape[1]):
            if geometry[i, link] == of_arm + 2:
                distance[i, link] = np.inf


@compiled
def link_distances_batch(states, rows, self_collisions, within, arm, world):
    """Write `CollisionChecker.link_distances` of states (m, n) to `rows` (m, l, 1 + n).

    Returns False, and writes nothing, if a state is NaN.
    """
    clipped = np.empty(states.shape)
    for i in range(states.shape[0]):
        for j in range(states.shape[1]):
            if math.isnan(states[i, j]):
                return False
            clipped[i, j] = min(max(states[i, j], -1.0), 1.0)
    batch = rows.shape[0], rows.shape[1]
    distance, geometry = np.empty(batch), np.empty(batch, np.int64)
    normal, witness = np.empty((batch[0], batch[1], 3)), np.empty((batch[0], batch[1], 3))
    gradient = np.empty((batch[0], batch[1], states.shape[1]))
    signed_distances_batch(
        clipped, self_collisions, within, arm, world, distance, normal, witness, gradient, geometry
    )
    for i in range(batch[0]):
        for link in range(batch[1]):
            rows[i, link, 0] = min(distance[i, link], within)
            for j in range(states.shape[1]):
                rows[i, link, 1 + j] = gradient[i, link, j]
    return True


@compiled
def end_distances(states, within, links, arm, world):
    """Distances (m) of states (m, n) from everything, and from the scene: (2, m).

    Infinite beyond `within`. `links`: those that may collide.
    """
    m, n = states.shape
    distance, geometry = np.empty((1, links)), np.empty((1, links), np.int64)
    normal, witness = np.empty((1, links, 3)), np.empty((1, links, 3))
    gradient = np.empty((1, links, n))
    least = np.empty((2, m))
    rule, no_endpoints = np.zeros(4), np.empty((0, n + 1))
    rule[0] = within
    memory = working_memory(arm[0], arm[1])
    for i in range(m):
        least[0, i] = least[1, i] = np.inf
        if is_free(states[i], rule, no_endpoints, arm, world, memory):  # which is much quicker
            continue
        for k in range(2):
            signed_distances_batch(
                states[i : i + 1],
                k == 0,
                within,
                arm,
                world,
                distance,
                normal,
                witness,
                gradient,
                geometry,
            )
            for link in range(links):
                least[k, i] = min(least[k, i], distance[0, link])
    return least
