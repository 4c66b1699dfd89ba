"""Ray casting for sensors, and depth images as points, compiled."""

import math

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import FAR, place_arm, write_row
from roboarm_nmp.utils.numba_cache import compiled

# Columns of a surface: its shape, the frame that moves it (-1: none), its position there 3, its
# rotation 9 (row-major), its size 3, the polyhedron, the class that its pixels get. A polyhedron is
# scaled by the size. A cylinder's size is (radius, radius, half length); a sphere's, its radius.
POLYHEDRON, ROUND, BALL = range(3)
SHAPE, MOVED_BY, PLACE, TURN, SIZE, MESH, CLASS, SURFACE_COLUMNS = 0, 1, 2, 5, 14, 17, 18, 19
# Numbers of a view: eye 3, right 3, up 3, forward 3, the tangents of half the angles across and
# upwards, nearest and farthest visible distance along the viewing direction (m).
EYE, AXES, ACROSS, UPWARDS, NEAREST, FARTHEST, VIEW = 0, 3, 12, 13, 14, 15, 16
_ON_EDGE = 1e-9  # pixels: a ray on the edge of two faces hits at least one of them


@compiled
def cast_rays(view, q, chain, bodies, surfaces, polyhedra, inverse, classes):
    """Write a sensor's depth image, as 1 / depth (1/m), and the classes of its pixels.

    The result is that of one ray per pixel. As each surface is convex, its faces that are turned to
    the eye are filled row by row instead: along a row, 1 / depth of a plane is linear.

    Args:
        view: float64 (`VIEW`,).
        q: normalised configuration (n,).
        chain, bodies: as in `place_arm`; `bodies` may be empty.
        surfaces: float64 (s, `SURFACE_COLUMNS`).
        polyhedra: `vertices` float64 (v, 3), m; `vertex_ends` int64 (p + 1,), where the vertices of
            each begin; `face_ends` int64 (p + 1,), likewise; `corners` int64 (f, 4), of each face,
            counterclockwise from outside; three of them where the last is -1.
        inverse: float64 (height, width): 1 / depth; of a ray without a hit, 1 / farthest.
        classes: uint8 (height, width), unchanged where a ray hits nothing.
    """
    vertices, vertex_ends, face_ends, corners = polyhedra
    frames, centres = np.empty((chain.shape[0], 12)), np.empty((bodies.shape[0], 3))
    place_arm(q, chain, bodies, frames, centres)
    most = 0
    for i in range(vertex_ends.shape[0] - 1):
        most = max(most, vertex_ends[i + 1] - vertex_ends[i])
    # A vertex: its position along right, up and forward (m), its column and row.
    seen, polygon, pose = np.empty((max(most, 8), 5)), np.empty((2, 8, 5)), np.empty(12)
    height, width = inverse.shape
    inverse[:] = 1.0 / view[FARTHEST]
    for s in range(surfaces.shape[0]):
        surface = surfaces[s]
        _pose_in_view(view, surface, frames, pose)
        kind, label = int(surface[SHAPE]), np.uint8(surface[CLASS])
        if kind != POLYHEDRON:
            area = _pixels_around(view, surface, pose, seen, height, width)
            if kind == BALL:
                _draw_ball(view, surface[SIZE], pose, area, label, inverse, classes)
            else:
                _draw_cylinder(view, surface, pose, area, label, inverse, classes)
            continue
        mesh = int(surface[MESH])
        first, behind, outside = vertex_ends[mesh], 0, 0
        number = vertex_ends[mesh + 1] - first
        for i in range(number):
            x = vertices[first + i, 0] * surface[SIZE]
            y = vertices[first + i, 1] * surface[SIZE + 1]
            z = vertices[first + i, 2] * surface[SIZE + 2]
            for j in range(3):
                seen[i, j] = pose[9 + j] + pose[3 * j] * x + pose[3 * j + 1] * y
                seen[i, j] += pose[3 * j + 2] * z
            behind += seen[i, 2] < view[NEAREST]
            _project(view, height, width, seen[i])
        if behind == number:
            continue
        if behind == 0:
            left = top = FAR
            right = bottom = -FAR
            for i in range(number):
                left, right = min(left, seen[i, 3]), max(right, seen[i, 3])
                top, bottom = min(top, seen[i, 4]), max(bottom, seen[i, 4])
            outside = right < 0.0 or left > width - 1 or bottom < 0.0 or top > height - 1
        if outside:
            continue
        for face in range(face_ends[mesh], face_ends[mesh + 1]):
            a, b, c = seen[corners[face, 0]], seen[corners[face, 1]], seen[corners[face, 2]]
            ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            away = nx * a[0] + ny * a[1] + nz * a[2]
            if away <= 0.0:  # turned away from the eye (right, up, forward are left-handed)
                continue
            n = 0
            for i in range(4):
                if corners[face, i] >= 0:
                    write_row(polygon[0], n, seen[corners[face, i]])
                    n += 1
            outline = polygon[0]
            if behind > 0:
                n = _clip(view, height, width, polygon, n)
                outline = polygon[1]
            plane = nx / away, ny / away, nz / away
            _fill(view, outline, n, plane, label, inverse, classes)


@compiled
def _pose_in_view(view, surface, frames, pose):
    """Write a surface's rotation (row-major) and position along right, up and forward to `pose`."""
    frame = int(surface[MOVED_BY])
    for i in range(3):
        a, b, c = view[AXES + 3 * i], view[AXES + 3 * i + 1], view[AXES + 3 * i + 2]
        place = -(a * view[EYE] + b * view[EYE + 1] + c * view[EYE + 2])
        if frame >= 0:
            f = frames[frame]
            place += a * f[9] + b * f[10] + c * f[11]
            a, b, c = (
                a * f[0] + b * f[3] + c * f[6],
                a * f[1] + b * f[4] + c * f[7],
                a * f[2] + b * f[5] + c * f[8],
            )
        pose[9 + i] = place + a * surface[PLACE] + b * surface[PLACE + 1] + c * surface[PLACE + 2]
        for j in range(3):
            pose[3 * i + j] = a * surface[TURN + j] + b * surface[TURN + 3 + j]
            pose[3 * i + j] += c * surface[TURN + 6 + j]


@compiled
def _project(view, height, width, point):
    """Write a point's column and row behind its position. PyBullet's pixels: see `deproject`."""
    point[3] = (point[0] / (point[2] * view[ACROSS]) + 1.0) * (0.5 * width)
    point[4] = (1.0 - point[1] / (point[2] * view[UPWARDS])) * (0.5 * height) - 1.0


@compiled
def _clip(view, height, width, polygon, n):
    """Write the part of `polygon[0]`, n corners, that is not too near to `polygon[1]`."""
    corners, left, count = polygon[0], polygon[1], 0
    for i in range(n):
        one, other = corners[i], corners[(i + 1) % n]
        if one[2] >= view[NEAREST]:
            write_row(left, count, one)
            count += 1
        if (one[2] >= view[NEAREST]) != (other[2] >= view[NEAREST]):
            share = (view[NEAREST] - one[2]) / (other[2] - one[2])
            for j in range(3):
                left[count, j] = one[j] + share * (other[j] - one[j])
            left[count, 2] = view[NEAREST]
            _project(view, height, width, left[count])
            count += 1
    return count


@compiled
def _fill(view, outline, n, plane, label, inverse, classes):
    """Draw a convex polygon of n corners in a plane, of which `plane` is 1 / depth per ray."""
    height, width = inverse.shape
    top, bottom = FAR, -FAR
    for i in range(n):
        top, bottom = min(top, outline[i, 4]), max(bottom, outline[i, 4])
    begin = int(math.ceil(max(top - _ON_EDGE, 0.0)))
    end = int(math.floor(min(bottom + _ON_EDGE, height - 1.0))) + 1
    along = plane[0] * view[ACROSS] * (2.0 / width)
    for row in range(begin, end):
        y, left, right = float(row), FAR, -FAR
        for i in range(n):
            j = i + 1 if i + 1 < n else 0
            if outline[i, 4] > outline[j, 4]:
                i, j = j, i  # the same numbers for the face on the other side
            ya, yb = outline[i, 4], outline[j, 4]
            if y < ya - _ON_EDGE or y > yb + _ON_EDGE:
                continue
            xa, xb = outline[i, 3], outline[j, 3]
            if yb - ya < _ON_EDGE:
                left, right = min(left, xa, xb), max(right, xa, xb)
            else:
                x = xa + (y - ya) * ((xb - xa) / (yb - ya))
                left, right = min(left, x), max(right, x)
        first = int(math.ceil(max(left - _ON_EDGE, 0.0)))
        last = int(math.floor(min(right + _ON_EDGE, width - 1.0)))
        upward = (1.0 - 2.0 * (row + 1) / height) * view[UPWARDS]
        start = plane[1] * upward + plane[2] - plane[0] * view[ACROSS]
        for column in range(first, last + 1):
            value = start + along * column
            if value > inverse[row, column]:
                inverse[row, column], classes[row, column] = value, label


@compiled
def _pixels_around(view, surface, pose, seen, height, width):
    """Rows and columns that a ball or cylinder may cover: first row, end, first column, end."""
    left = top = FAR
    right = bottom = -FAR
    half = surface[SIZE : SIZE + 3]
    for i in range(8):
        x = half[0] if i & 1 else -half[0]
        y = half[1] if i & 2 else -half[1]
        z = half[2] if i & 4 else -half[2]
        for j in range(3):
            seen[i, j] = pose[9 + j] + pose[3 * j] * x + pose[3 * j + 1] * y + pose[3 * j + 2] * z
        if seen[i, 2] < view[NEAREST]:
            return 0, height, 0, width
        _project(view, height, width, seen[i])
        left, right = min(left, seen[i, 3]), max(right, seen[i, 3])
        top, bottom = min(top, seen[i, 4]), max(bottom, seen[i, 4])
    return (
        int(math.ceil(min(max(top, 0.0), float(height)))),
        int(math.floor(min(max(bottom, -1.0), height - 1.0))) + 1,
        int(math.ceil(min(max(left, 0.0), float(width)))),
        int(math.floor(min(max(right, -1.0), width - 1.0))) + 1,
    )


@compiled
def _draw_ball(view, radius, pose, area, label, inverse, classes):
    height, width = inverse.shape
    x, y, z = pose[9], pose[10], pose[11]
    beyond = x * x + y * y + z * z - radius * radius
    for row in range(area[0], area[1]):
        v = (1.0 - 2.0 * (row + 1) / height) * view[UPWARDS]
        for column in range(area[2], area[3]):
            u = (2.0 * column / width - 1.0) * view[ACROSS]
            square, along = u * u + v * v + 1.0, u * x + v * y + z
            under = along * along - square * beyond
            if under < 0.0:
                continue
            depth = (along - math.sqrt(under)) / square
            if depth >= view[NEAREST] and depth * inverse[row, column] < 1.0:
                inverse[row, column], classes[row, column] = 1.0 / depth, label


@compiled
def _draw_cylinder(view, surface, pose, area, label, inverse, classes):
    height, width = inverse.shape
    radius, half = surface[SIZE], surface[SIZE + 2]
    # The eye in the cylinder's own axes.
    ox = -(pose[0] * pose[9] + pose[3] * pose[10] + pose[6] * pose[11])
    oy = -(pose[1] * pose[9] + pose[4] * pose[10] + pose[7] * pose[11])
    oz = -(pose[2] * pose[9] + pose[5] * pose[10] + pose[8] * pose[11])
    beyond = ox * ox + oy * oy - radius * radius
    for row in range(area[0], area[1]):
        v = (1.0 - 2.0 * (row + 1) / height) * view[UPWARDS]
        for column in range(area[2], area[3]):
            u = (2.0 * column / width - 1.0) * view[ACROSS]
            dx = pose[0] * u + pose[3] * v + pose[6]
            dy = pose[1] * u + pose[4] * v + pose[7]
            dz = pose[2] * u + pose[5] * v + pose[8]
            enter, leave = -FAR, FAR
            square, along = dx * dx + dy * dy, ox * dx + oy * dy
            under = along * along - square * beyond
            if under < 0.0 or (square == 0.0 and beyond > 0.0):
                continue
            if square > 0.0:
                root = math.sqrt(under)
                enter, leave = (-along - root) / square, (root - along) / square
            if dz != 0.0:
                one, other = (-half - oz) / dz, (half - oz) / dz
                enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
            elif abs(oz) > half:
                continue
            if view[NEAREST] <= enter <= leave and enter * inverse[row, column] < 1.0:
                inverse[row, column], classes[row, column] = 1.0 / enter, label


@compiled
def points_of_pixels(view, depth, classes, only, nothing, points, labels):
    """Write the points (m) and classes of pixels that hit something, row by row from upper left.

    Args:
        view: float64 (`VIEW`,).
        depth: float32 (height, width), m.
        classes: uint8 (height, width).
        only: the class of which points are written; negative: all but `nothing`.
        nothing: the class of pixels without a hit.
        points, labels: float32 (n, 3) and uint8 (n,), to write to.

    Returns the number of points.
    """
    height, width = depth.shape
    n = 0
    for row in range(height):
        upward = (1 - 2 * (row + 1) / height) * view[UPWARDS]
        for column in range(width):
            label = classes[row, column]
            if label != only if only >= 0 else label == nothing:
                continue
            across = (2 * column / width - 1) * view[ACROSS]
            for i in range(3):
                ray = across * view[AXES + i] + upward * view[AXES + 3 + i] + view[AXES + 6 + i]
                points[n, i] = view[EYE + i] + depth[row, column] * ray
            labels[n] = label
            n += 1
    return n


@compiled
def edge_pixels(depth, classes, nothing, edge):
    """Of pixels at edges, the least and the largest depth of the pixel and its four neighbours.

    At an edge they are more than `edge` (m) apart; neighbours of the class `nothing` do not count.

    Returns two arrays, float32 (height, width), m; zeros where there is no edge.
    """
    height, width = depth.shape
    front = np.zeros((height, width), np.float32)
    back = np.zeros((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            if classes[row, column] == nothing:
                continue
            least = most = depth[row, column]
            for i in range(4):
                r, c = row + (i == 0) - (i == 1), column + (i == 2) - (i == 3)
                if 0 <= r < height and 0 <= c < width and classes[r, c] != nothing:
                    least, most = min(least, depth[r, c]), max(most, depth[r, c])
            if most - least > edge:
                front[row, column], back[row, column] = least, most
    return front, back


@compiled
def pixels_with_neighbours(depth, hit, distance, least):
    """Which pixels that hit have at least so many of their eight neighbours near: bool, as `hit`.

    A neighbour is near if it hits, too, and its depth (m) is at most `distance` away.
    """
    height, width = depth.shape
    kept = np.zeros((height, width), np.bool_)
    for row in range(height):
        for column in range(width):
            near = -1  # the pixel itself
            for r in range(max(row - 1, 0), min(row + 2, height)):
                for c in range(max(column - 1, 0), min(column + 2, width)):
                    near += hit[r, c] and abs(depth[r, c] - depth[row, column]) <= distance
            kept[row, column] = hit[row, column] and near >= least
    return kept


@compiled
def pixels_of_points(points, view, width, height, pixels, ahead):
    """Write the pixel through which a sensor looks at each point, and how far ahead the point is.

    Args:
        points: float64 (n, 3), m.
        view: float64 (`VIEW`,).
        width, height: of the image.
        pixels: int32 (n,): row * width + column; -1 where the point is outside of the image.
        ahead: float64 (n,), m.
    """
    across, upwards = 0.5 * width / view[ACROSS], 0.5 * height / view[UPWARDS]
    for i in range(points.shape[0]):
        pixels[i] = -1
        x, y, z = (
            points[i, 0] - view[EYE],
            points[i, 1] - view[EYE + 1],
            points[i, 2] - view[EYE + 2],
        )
        ahead[i] = x * view[AXES + 6] + y * view[AXES + 7] + z * view[AXES + 8]
        if ahead[i] <= view[NEAREST]:
            continue
        right = x * view[AXES] + y * view[AXES + 1] + z * view[AXES + 2]
        up = x * view[AXES + 3] + y * view[AXES + 4] + z * view[AXES + 5]
        share = 1.0 / ahead[i]
        column = int(math.floor(0.5 * width + right * across * share))
        row = int(math.floor(0.5 * height - up * upwards * share))
        if 0 <= column < width and 0 <= row < height:
            pixels[i] = row * width + column


@compiled
def mark_seen(pixels, ahead, depth, behind, seen):
    """Mark in `seen`, bool (n,), which points are not hidden behind what a sensor sees.

    Args:
        pixels, ahead: of `pixels_of_points`.
        depth: of the sensor's pixels, float32 (height * width,), m.
        behind: m: a point so far behind what a pixel shows is seen.
    """
    for i in range(pixels.shape[0]):
        if not seen[i] and pixels[i] >= 0:
            seen[i] = ahead[i] <= depth[pixels[i]] + behind


@compiled
def next_to_seen(seen, cells, sizes):
    """Which cells of a grid are not seen, but one of the six around them is: bool (n,).

    Args:
        seen: bool (n,).
        cells: int32 (n,), row-major indices in the grid, at whose border there are none.
        sizes: three ints, of the grid.
    """
    row, slab = sizes[2], sizes[1] * sizes[2]
    grid = np.zeros(sizes[0] * slab, np.bool_)
    for i in range(seen.shape[0]):
        grid[cells[i]] = seen[i]
    chosen = np.zeros(seen.shape[0], np.bool_)
    for i in range(seen.shape[0]):
        if not seen[i]:
            c = cells[i]
            chosen[i] = (grid[c - 1] or grid[c + 1] or grid[c - row] or grid[c + row]) or (
                grid[c - slab] or grid[c + slab]
            )
    return chosen
