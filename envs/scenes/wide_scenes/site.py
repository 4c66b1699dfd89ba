"""A site: what stands at a place, piece by piece, and where a hand goes there.

    site = Site(rng)
    site.box((0.3, 0.0, 0.88), (0.6, 1.4, 0.04))      # a worktop
    site.thing((0.2, 0.1, 0.9))                       # a jar, perhaps, and grasps of it
    obstacles, places = site.placed(rotation, offset)

In a site's own frame (m) the arm comes from -x; y is to the left, z up, and the ground at z = 0.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from roboarm_nmp.envs.robots.rotations import quaternions
from roboarm_nmp.envs.scenes.places import Place
from roboarm_nmp.envs.scenes.primitives import Box, ConvexHull, Cylinder, Obstacle, Sphere

Point = Sequence[float] | np.ndarray
FORWARD, DOWN = (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
INTO = (0.8, 0.0, -0.6)  # forward and down
SLIM = 0.03  # m, half of the widest thing that the open fingers close around
# m, beyond the top of a thing, of the point between the fingertips; negative: below.
GRIP = (-0.035, 0.0)
BESIDE = 0.012  # m, along a thing's side, that this point may be off its middle


class Part(NamedTuple):
    """A convex body.

    Attributes:
        kind: `Box`, `Cylinder`, `Sphere` or `ConvexHull`.
        centre: m, (3,).
        rotation: (3, 3).
        lengths: m: full edges of a box, radius and length of a cylinder, radius of a sphere, (3,),
            (2,), (1,); vertices of a hull, (n, 3).
    """

    kind: type
    centre: np.ndarray
    rotation: np.ndarray
    lengths: np.ndarray


class Site:
    """Parts and places, which the methods add; `rng` draws what is left open."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self.parts: list[Part] = []
        self.places: list[Place] = []

    # --- Numbers

    def between(self, low: float, high: float) -> float:
        """A number that is uniform between two."""
        return float(self.rng.uniform(low, high))

    def count(self, fewest: int, most: int) -> int:
        """A whole number, from `fewest` to `most`."""
        return int(self.rng.integers(fewest, most + 1))

    def chance(self, share: float) -> bool:
        """Whether something is there that a share of the sites has."""
        return bool(self.rng.random() < share)

    def spots(
        self, number: int, x: tuple[float, float], y: tuple[float, float], apart: float
    ) -> list[tuple[float, float]]:
        """Up to `number` points (x, y) of a rectangle, at least `apart` (m) from each other."""
        found: list[tuple[float, float]] = []
        for _ in range(8 * number):
            spot = self.between(*x), self.between(*y)
            if len(found) < number and all(math.dist(spot, other) > apart for other in found):
                found.append(spot)
        return found

    # --- Parts

    def box(
        self, centre: Point, size: Point, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
    ) -> None:
        """A box, turned (rad) about x, then y, then z."""
        self._add(Box, centre, turned(yaw, pitch, roll), size)

    def rod(self, start: Point, end: Point, radius: float) -> None:
        """A cylinder from one point to another."""
        start, end = np.asarray(start, float), np.asarray(end, float)
        length = float(np.linalg.norm(end - start))
        self._add(Cylinder, (start + end) / 2, along(end - start), (radius, length))

    def rods(self, points: Iterable[Point], radius: float) -> None:
        """Cylinders from point to point, with a ball at each bend."""
        points = list(points)
        for start, end in zip(points, points[1:], strict=False):
            self.rod(start, end, radius)
        for bend in points[1:-1]:
            self.ball(bend, radius)

    def can(self, foot: Point, radius: float, height: float) -> None:
        """An upright cylinder that stands at a point."""
        x, y, z = foot
        self.rod((x, y, z), (x, y, z + height), radius)

    def ball(self, centre: Point, radius: float) -> None:
        """A sphere."""
        self._add(Sphere, centre, np.eye(3), (radius,))

    def hull(self, points: Any) -> None:
        """The convex hull of points (n, 3)."""
        points = np.asarray(points, float)
        centre = points.mean(axis=0)
        self._add(ConvexHull, centre, np.eye(3), points - centre)

    def prism(self, outline: Sequence[tuple[float, float]], low: float, high: float) -> None:
        """A convex outline (x, z), from y = `low` to `high`."""
        self.hull([(x, y, z) for x, z in outline for y in (low, high)])

    def lump(self, centre: Point, size: Point, corners: int = 12) -> None:
        """A stone: a hull of random points on an ellipsoid of a size (full lengths)."""
        points = self.rng.standard_normal((corners, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        corners_at = points * np.asarray(size) / 2
        self.hull(np.asarray(centre) + corners_at @ turned(self.between(0.0, 3.0)).T)

    def _add(self, kind: type, centre: Point, rotation: np.ndarray, lengths: Any) -> None:
        self.parts.append(Part(kind, np.array(centre, float), rotation, np.array(lengths, float)))

    def turn_parts(self, first: int, rotation: np.ndarray, offset: Point) -> None:
        """Turn all places, and the parts from number `first` on, about 0, then move them."""
        for i, part in enumerate(self.parts[first:], first):
            centre = rotation @ part.centre + offset
            self.parts[i] = part._replace(centre=centre, rotation=rotation @ part.rotation)
        for i, place in enumerate(self.places):
            across = None if place.across is None else rotation @ place.across
            self.places[i] = Place(
                rotation @ place.centre + offset,
                place.size,
                rotation @ place.rotation,
                rotation @ place.approach,
                across,
            )

    # --- Boards and boxes

    def case(self, low: Point, high: Point, board: float, without: str = "") -> None:
        """A box of boards between two corners, `without` some of its sides.

        Sides are `f` (front, towards -x), `k` (back), `l`, `r`, `t` (top) and `b` (bottom).
        """
        low, high = np.asarray(low, float), np.asarray(high, float)
        for letter, axis, at_high in zip("fkrlbt", (0, 0, 1, 1, 2, 2), (0, 1) * 3, strict=True):
            if letter not in without:
                start, end = low.copy(), high.copy()
                if at_high:
                    start[axis] = end[axis] - board
                else:
                    end[axis] = start[axis] + board
                self.box((start + end) / 2, end - start)

    # --- Places

    def place(
        self, centre: Point, size: Point, approach: Point = FORWARD, across: Point | None = None
    ) -> None:
        """A region for the end effector, a box of a size, and how the hand enters it."""
        towards = np.asarray(approach, float) / np.linalg.norm(approach)
        fingers = None if across is None else np.asarray(across, float) / np.linalg.norm(across)
        sizes = np.maximum(np.asarray(size, float), 0.004)
        self.places.append(Place(np.array(centre, float), sizes, np.eye(3), towards, fingers))

    def grasp_from_above(self, foot: Point, width: float, height: float, yaw: float) -> None:
        """Fingers around the top of a thing, which is `width` wide along the yaw."""
        x, y, z = foot
        middle = z + height + sum(GRIP) / 2
        across = (math.cos(yaw), math.sin(yaw), 0.0)
        self.place((x, y, middle), (0.01, 0.01, GRIP[1] - GRIP[0]), DOWN, across)

    def grasp_from_the_side(self, foot: Point, height: float) -> None:
        """Fingers around an upright rod, from the front, and not near its ends."""
        x, y, z = foot
        side = self.between(-0.7, 0.7)
        approach = (math.cos(side), math.sin(side), self.between(-0.4, 0.1))
        across = (-math.sin(side), math.cos(side), 0.0)
        low = min(0.05, height / 2)
        self.place((x, y, z + (low + height) / 2), (BESIDE, BESIDE, height - low), approach, across)

    def grasp_rod(self, start: Point, end: Point) -> None:
        """Fingers around a rod of any direction, from the front or from above."""
        start, end = np.asarray(start, float), np.asarray(end, float)
        axis = (end - start) / np.linalg.norm(end - start)
        approach = np.array(FORWARD if abs(axis[2]) > 0.7 or self.chance(0.6) else DOWN)
        if abs(axis[0]) > 0.7:
            approach = np.array(DOWN)
        approach = approach - (approach @ axis) * axis
        across = np.cross(axis, approach)
        for share in (0.3, 0.5, 0.7):
            self.place(start + share * (end - start), (BESIDE,) * 3, approach, across)

    def thing(self, foot: Point, most: float = 0.3) -> None:
        """A thing that stands at a point, at most `most` high; if it is slim, grasps of it."""
        x, y, z = foot
        height = self.between(0.05, max(0.06, min(most, 0.32)))
        kind, yaw = self.count(0, 4), self.between(-math.pi, math.pi)
        if kind <= 1:  # a bottle, a jar
            radius = self.between(0.015, 0.05)
            self.can(foot, radius, height)
            if kind == 1 and height > 0.15:
                height += 0.06
                self.can((x, y, z + height - 0.06), 0.4 * radius, 0.06)
            if radius < SLIM:
                self.grasp_from_above(foot, 2 * radius, height, yaw)
                self.grasp_from_the_side(foot, height)
        elif kind == 2:  # a package
            width, length = self.between(0.02, 0.12), self.between(0.04, 0.2)
            self.box((x, y, z + height / 2), (width, length, height), yaw)
            if width < 2 * SLIM:
                self.grasp_from_above(foot, width, height, yaw)
        elif kind == 3:  # a fruit
            radius = self.between(0.02, 0.05)
            self.ball((x, y, z + radius), radius)
            if radius < SLIM:
                self.place((x, y, z + 1.2 * radius), (BESIDE,) * 3, DOWN, (1.0, 0.0, 0.0))
        else:  # a stone, a crumpled bag
            size = np.array([self.between(0.05, 0.18), self.between(0.05, 0.18), height])
            self.lump((x, y, z + height / 2), size)

    def things(
        self, number: int, x: tuple[float, float], y: tuple[float, float], z: float, most: float
    ) -> None:
        """Up to `number` things on a rectangle at a height, apart from each other."""
        for spot in self.spots(number, x, y, 0.16):
            self.thing((*spot, z), most)

    # --- The finished site

    def placed(
        self, rotation: np.ndarray, offset: np.ndarray, scale: float, mirrored: bool
    ) -> tuple[list[Obstacle], list[Place]]:
        """Obstacles and places after mirroring left and right, scaling, turning and moving."""
        flip = np.diag([1.0, -1.0 if mirrored else 1.0, 1.0])
        linear = rotation @ flip
        obstacles: list[Obstacle] = []
        turns = quaternions(linear @ np.array([part.rotation for part in self.parts]) @ flip)
        for part, quaternion in zip(self.parts, map(_floats, turns), strict=True):
            centre = _floats(scale * linear @ part.centre + offset)
            lengths = scale * part.lengths
            if part.kind is Sphere:
                obstacles.append(Sphere(centre, float(lengths[0])))
            elif part.kind is Box:
                obstacles.append(Box(centre, _floats(lengths), quaternion))
            elif part.kind is Cylinder:
                radius, length = _floats(lengths)
                obstacles.append(Cylinder(centre, radius, length, quaternion))
            else:
                obstacles.append(
                    ConvexHull(centre, tuple(map(_floats, lengths @ flip)), quaternion)
                )
        places = []
        for place in self.places:
            across = None if place.across is None else linear @ place.across
            centre = scale * linear @ place.centre + offset
            approach = linear @ place.approach
            turn = linear @ place.rotation @ flip
            places.append(Place(centre, scale * place.size, turn, approach, across))
        return obstacles, places


def _floats(numbers: np.ndarray) -> Any:
    return tuple(numbers.tolist())


def turned(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """The rotation (3, 3) about x by the roll, then y by the pitch, then z by the yaw, rad."""
    a, b, c = math.cos(yaw), math.cos(pitch), math.cos(roll)
    u, v, w = math.sin(yaw), math.sin(pitch), math.sin(roll)
    about_z = np.array([[a, -u, 0.0], [u, a, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[b, 0.0, v], [0.0, 1.0, 0.0], [-v, 0.0, b]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -w], [0.0, w, c]])
    return about_z @ about_y @ about_x


def along(direction: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) whose z axis has a direction."""
    z = direction / np.linalg.norm(direction)
    x = np.cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0), z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
