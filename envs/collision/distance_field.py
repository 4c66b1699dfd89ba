"""Distances of an arm from observed points, as networks and gradients need them: 2 us each.

    field = DistanceField(robot)
    numbers = field.of_scene(points, scene)                      # once per scene, uint8
    distances, uphill = field.distances(states, numbers[None])   # of many configurations

A field is a grid of distances around the arm, of 3 cm for the Panda, between which distances are
interpolated; the arm is a few spheres in each link. For exact checks: `envs.collision.checker`.
"""

import functools

import numpy as np

from roboarm_nmp.envs.collision.arm_kernels import CENTRE, FRAME, LINK_ROW, RADIUS
from roboarm_nmp.envs.collision.field_kernels import (
    box_field,
    fill_field,
    sphere_centres,
    sphere_distances,
)
from roboarm_nmp.envs.collision.hulls import arm_hulls, vertex_counts
from roboarm_nmp.envs.collision.spheres import hull_spheres
from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Box, Scene, floor_box

HINGE = 0.08
"""m: by default, the way out is that of spheres nearer than this."""
_CELL, _SIZES = 0.03, (65, 65, 47)
_LOW = np.array([-0.96, -0.96, -0.12])  # m, from the base; cell and place scale with the arm
_PER_BODY = 2  # spheres


@functools.lru_cache(64)
def arm_spheres(robot: Robot) -> np.ndarray:
    """The largest spheres in each moving link's hulls: (s, 5): frame, centre there (m), radius."""
    _, bodies, _, vertices, _ = arm_hulls(robot)
    ends = np.cumsum(vertex_counts(robot))
    spheres = []
    for body, end, number in zip(bodies, ends, vertex_counts(robot), strict=False):
        if body[LINK_ROW] < 0:
            continue
        _, inner = hull_spheres(vertices[end - number : end])
        for sphere in inner[:_PER_BODY]:
            spheres.append([body[FRAME], *(sphere[:3] + body[CENTRE:RADIUS]), sphere[3]])
    return np.array(spheres)


class DistanceField:
    """The grid of a robot's surroundings, and its spheres.

    Attributes:
        num_joints: n.
        num_spheres: s.
        shape: of a field, (x, y, z).
    """

    shape = _SIZES

    def __init__(self, robot: Robot):
        self._robot = robot
        self._chain = arm_hulls(robot)[0]
        self._spheres = arm_spheres(robot)
        self.num_joints = robot.num_joints
        self.num_spheres = len(self._spheres)
        self._low, self._cell = _place_of_grid(robot)
        numbers = self._low, self._cell, self._chain, self._spheres
        self._single = [np.float32(one) for one in numbers]

    def of_scene(self, points: np.ndarray, scene: Scene) -> np.ndarray:
        """The field of points (n, 3), m, and a scene's table and floor: uint8, `shape`."""
        known = _field_of_known(self._robot, scene.table, scene.floor)
        points = np.require(points, np.float32, ("C", "W"))
        return fill_field(points, known, self._low, self._cell)

    def distances(
        self,
        states: np.ndarray,
        fields: np.ndarray,
        rows: np.ndarray | None = None,
        hinge: float = HINGE,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distances of the arm's spheres, and the way out.

        Args:
            states: (m, n), normalised.
            fields: uint8 (f, *`shape`).
            rows: int64 (m,): which field is that of each state; None: the first.
            hinge: m.

        Returns:
            `distances`: float32 (m, s), m, from -0.05 m to 0.2 m less the sphere's radius.
            `uphill`: float32 (m, n), m per unit of normalised configuration: the gradient of the
            sum of the distances below `hinge`.
        """
        low, cell, chain, spheres = self._single
        states = np.require(states, np.float32, ("C", "W"))
        rows = np.zeros(len(states), np.int64) if rows is None else rows
        distances = np.empty((len(states), self.num_spheres), np.float32)
        uphill = np.empty(states.shape, np.float32)
        sphere_distances(
            states,
            np.require(rows, np.int64, ("C", "W")),
            fields,
            low,
            cell,
            chain,
            spheres,
            np.float32(hinge),
            distances,
            uphill,
        )
        return distances, uphill

    def centres(self, states: np.ndarray) -> np.ndarray:
        """The centres of the arm's spheres in configurations (m, n), m: float32 (m, s, 3)."""
        states = np.require(states, np.float32, ("C", "W"))
        centres = np.empty((len(states), self.num_spheres, 3), np.float32)
        sphere_centres(states, self._chain, self._spheres, centres)
        return centres


def _place_of_grid(robot):
    """Where the first place of a robot's grid is (3,), and how far the others are apart, m."""
    return np.array(robot.base_position) + scale_of(robot) * _LOW, scale_of(robot) * _CELL


@functools.lru_cache(8)
def _field_of_known(robot: Robot, table: Box | None, floor: float | None) -> np.ndarray:
    """The field of a scene's table and floor."""
    known = [] if table is None else [table]
    if floor is not None:
        known.append(floor_box(floor))
    boxes = np.empty((len(known), 2, 3))
    for corners, box in zip(boxes, known, strict=True):
        corners[:] = box.position
        corners += np.array([[-0.5], [0.5]]) * box.size
    return box_field(boxes, *_place_of_grid(robot), _SIZES)
