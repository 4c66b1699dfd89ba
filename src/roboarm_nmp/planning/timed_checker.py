"""Compiled collision checks in time, with obstacles whose motions are known.

    checker = TimedChecker(env.unwrapped.scene, num_steps=400, step_seconds=STEP_SECONDS)
    checker.is_free(states, steps)                        # normalised (m, n), int (m,) -> bool (m,)
    checker.first_departure(start, end, length, 0, 100)   # when a straight motion may begin

Steps are multiples of `step_seconds` from time 0 on. A configuration counts as free at a step if it
is free then and one step later: a simulated arm is a little late.
"""

import numpy as np
from numpy.typing import ArrayLike

from roboarm_nmp.envs.collision.checker import CollisionChecker, EndpointMargins
from roboarm_nmp.envs.collision.hulls import (
    group_points,
    shape_centres,
    world_shapes,
)
from roboarm_nmp.envs.collision.moving import motion_arrays
from roboarm_nmp.envs.scenes.primitives import Scene, floor_box
from roboarm_nmp.planning.timed_kernels import first_departure, free_in_time, rows_in_time


class TimedChecker:
    """Collisions of the arm with a `Scene` of moving obstacles, and with itself.

    Args:
        scene: a `Scene`.
        num_steps: the last step.
        step_seconds: s.
        margin: m, from the scene, and between links.
        clearance: m, from the scene, in addition.
        endpoint_margins: as for `CollisionChecker.is_free`.
    """

    def __init__(
        self,
        scene: Scene,
        num_steps: int,
        step_seconds: float,
        margin: float = 0.0,
        clearance: float = 0.0,
        endpoint_margins: EndpointMargins | None = None,
    ):
        shapes = [*scene.obstacles]
        if scene.table is not None:
            shapes.append(scene.table)
        if scene.floor is not None:
            shapes.append(floor_box(scene.floor))
        rows, self._arm = world_shapes(shapes, scene.robot)
        times = step_seconds * np.arange(num_steps + 1)
        self._rows = np.empty((len(times), *rows.shape))
        rows_in_time(
            motion_arrays(scene.obstacles), shape_centres(scene.obstacles), rows, times, self._rows
        )
        self._cloud = group_points((), 0.0)
        at_start = CollisionChecker(scene.at(0.0))
        rule, endpoints = at_start._rule(margin, clearance, endpoint_margins)
        self._rule = rule, endpoints[0]

    def is_free(self, states: ArrayLike, steps: ArrayLike) -> np.ndarray:
        """Which normalised configurations (m, n) are free at steps (m,): bool (m,)."""
        states = np.ascontiguousarray(states, np.float64)
        steps = np.ascontiguousarray(steps, np.int64)
        free = np.empty(len(states), np.bool_)
        free_in_time(states, steps, *self._rule, self._arm, self._rows, self._cloud, free)
        return free

    def first_departure(
        self, start: np.ndarray, end: np.ndarray, length: int, first: int, last: int
    ) -> int | None:
        """The first step at which a straight motion may begin; None if there is none.

        Args:
            start, end: (n,), normalised. The start is free.
            length: steps that the motion takes, >= 1.
            first, last: the steps at which it may begin.
        """
        departure = first_departure(
            start, end, length, first, last, *self._rule, self._arm, self._rows, self._cloud
        )
        return None if departure < 0 else departure
