"""The types of goals: what a goal consists of, how far the arm is from it, when it is reached.

Paper: section 4 (`ee`, `config`, `combined`); `pose` adds the end effector's rotation.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.rotations import rotation_angle

GoalTypeName = Literal["ee", "config", "combined", "pose"]


@dataclass(frozen=True)
class Tolerances:
    """How near is near enough: `ee` in m, `config` in the normalised space (L2), `angle` in rad."""

    ee: float
    config: float
    angle: float


@dataclass(frozen=True)
class GoalType:
    """A type of goal for an arm of n joints.

    Attributes:
        name: as in `GOAL_TYPES`.
        has_configuration: a goal begins with the normalised configuration (n).
        has_position: a goal has the end effector's position (3, m), after the configuration.
        has_rotation: after the position, the end effector's quaternion (4, xyzw). `observation`
            has it, too.
        measured: the part of a goal whose L2 distance counts; None for all of it.
    """

    name: str
    has_configuration: bool
    has_position: bool
    has_rotation: bool
    measured: slice | None = None

    @property
    def end_effector_size(self) -> int:
        """Numbers of the end effector in `observation`: its position, or its pose."""
        return 7 if self.has_rotation else 3

    def size(self, num_joints: int) -> int:
        """Numbers of a goal."""
        size = num_joints if self.has_configuration else 0
        if self.has_position:
            size += self.end_effector_size
        return size

    def end_effector(self, robot: Robot, configuration: np.ndarray) -> np.ndarray:
        """The end effector in `observation`: joint angles (..., n), rad -> (..., 3 or 7)."""
        if self.has_rotation:
            return robot.end_effector_pose(configuration)
        return robot.forward_kinematics(configuration)

    def achieved(self, state: np.ndarray, end_effector: np.ndarray) -> np.ndarray:
        """What an arm achieves: its state (..., n) and `end_effector` (..., 3 or 7) as a goal."""
        if not self.has_configuration:
            return end_effector
        if not self.has_position:
            return state
        return np.concatenate([state, end_effector], axis=-1)

    def compare(
        self, achieved: np.ndarray, desired: np.ndarray, tolerances: Tolerances
    ) -> tuple[np.ndarray, np.ndarray]:
        """The distance between goals (..., d) in their own metric, and whether it is near enough.

        In metres, or for `config` in the normalised space. With a rotation, the angle counts as
        the share of its tolerance, in metres.
        """
        apart = achieved - desired
        if self.measured is not None:
            apart = apart[..., self.measured]
        distance = np.sqrt(np.add.reduce(apart * apart, axis=-1))
        reached = distance <= (tolerances.ee if self.has_position else tolerances.config)
        if self.has_rotation:
            angle = rotation_angle(achieved[..., 3:], desired[..., 3:])
            reached = reached & (angle <= tolerances.angle)
            distance = distance + angle * (tolerances.ee / tolerances.angle)
        return distance, reached


GOAL_TYPES = {
    goal_type.name: goal_type
    for goal_type in (
        GoalType("ee", False, True, False),
        GoalType("config", True, False, False),
        GoalType("combined", True, True, False, measured=slice(-3, None)),  # reached like `ee`
        GoalType("pose", False, True, True, measured=slice(0, 3)),
    )
}
