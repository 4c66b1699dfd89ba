"""`PANDA`: the Franka Panda of `pybullet_data`, with its hand (paper, section 4)."""

import math
from pathlib import Path

import numpy as np
import pybullet_data

from roboarm_nmp.envs.robots.robot import Frame, Link, Robot

FINGER_OPENING = 0.04  # m, each finger; constant
# Fixed transforms between joint frames in the URDF: (x, y, z, roll about x), then the joint turns
# about its own z.
JOINT_FRAMES = (
    (0.0, 0.0, 0.333, 0.0),
    (0.0, 0.0, 0.0, -math.pi / 2),
    (0.0, -0.316, 0.0, math.pi / 2),
    (0.0825, 0.0, 0.0, math.pi / 2),
    (-0.0825, 0.384, 0.0, -math.pi / 2),
    (0.0, 0.0, 0.0, math.pi / 2),
    (0.088, 0.0, 0.0, math.pi / 2),
)
# Fixed to joint 7: the hand, in m along that joint's axis and turned about it (rad); in the hand's
# frame the fingers, which open along y; the grasp target, between the fingertips.
FLANGE_LENGTH, HAND_YAW, HAND_TO_GRASP = 0.107, -math.pi / 4, 0.105
HAND_TO_FINGER = 0.0584


def _roll(angle):
    c, s = math.cos(angle), math.sin(angle)
    return (1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c)


def _yaw(angle):
    c, s = math.cos(angle), math.sin(angle)
    return (c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0)


_HAND = (0.0, 0.0, FLANGE_LENGTH), _yaw(HAND_YAW)
_LEFT = (0.0, FINGER_OPENING, HAND_TO_FINGER), _yaw(0.0)
_RIGHT = (0.0, -FINGER_OPENING, HAND_TO_FINGER), _yaw(0.0)
_JOINTS = (
    *(f"panda_joint{joint}" for joint in range(1, 9)),
    *("panda_hand_joint", "panda_finger_joint1", "panda_finger_joint2", "panda_grasptarget_hand"),
)
_LINKS = (
    *(f"panda_link{link}" for link in range(9)),
    *("panda_hand", "panda_leftfinger", "panda_rightfinger", "panda_grasptarget"),
)
# Of the end effector; the URDF's angles have few digits.
_AXES = [
    [0.7071067695421219, 0.7071068540717813, -9.327597671130554e-08],
    [-0.7071068540717818, 0.707107031179925, 1.189380493216533e-08],
    [7.616287378725753e-09, 2.989713741086413e-08, 1.0000002616378],
]
_LOWER = (-2.9671, -1.8326, -2.9671, -3.1416, -2.9671, -0.0873, -2.9671)
_UPPER = (2.9671, 1.8326, 2.9671, 0.0, 2.9671, 3.8223, 2.9671)

PANDA = Robot(
    name="panda",
    urdf=str(Path(pybullet_data.getDataPath(), "franka_panda", "panda.urdf")),
    joint_names=_JOINTS[:7],
    joint_indices=(0, 1, 2, 3, 4, 5, 6),
    bullet_joint_names=_JOINTS,
    link_names=dict(enumerate(_LINKS, -1)),
    # Limits of positions and torques as in the URDF. Those of velocity, acceleration and jerk, and
    # `datasheet_lower` and `datasheet_upper`, as in Franka's documentation of the Panda ("Robot and
    # interface specifications", limits in the joint space; libfranka's `rate_limiting.h`).
    lower=np.array(_LOWER),
    upper=np.array(_UPPER),
    velocity=np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]),
    acceleration=np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]),
    jerk=np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0]),
    effort=np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0]),
    held_indices=(9, 10),
    held_positions=(FINGER_OPENING, FINGER_OPENING),
    held_effort=(20.0, 20.0),
    mimics=(),
    frames=tuple(
        Frame(joint - 1, joint, (x, y, z), _roll(roll))
        for joint, (x, y, z, roll) in enumerate(JOINT_FRAMES)
    ),
    # The base, the seven links that the joints move, the hand, the two fingers.
    links=(
        Link(-1, -1),
        *(Link(joint, joint) for joint in range(7)),
        Link(8, 6, (_HAND,)),
        Link(9, 6, (_LEFT, _HAND)),
        Link(10, 6, (_RIGHT, _HAND)),
    ),
    # By PyBullet's link index: -1 is the base, 8 the hand, 9 and 10 the fingers. Left out:
    # neighbours, hand-link7 and finger-finger, whose meshes always overlap, and every pair without
    # an overlap in 1,000,000 random configurations. Without this list the arm would collide with
    # itself everywhere, and a physics step would cost twice as much.
    self_collision_pairs=(
        *((-1, link) for link in (4, 5, 6, 8, 9, 10)),
        *((0, link) for link in (4, 5, 6, 8, 9, 10)),
        *((1, link) for link in (4, 5, 6, 8, 9, 10)),
        *((4, link) for link in (6, 8, 9, 10)),
    ),
    end_effector_link=11,  # panda_grasptarget, the point between the fingertips
    end_effector_offset=(0.0, 0.0, 0.0),
    end_effector_frame=6,
    end_effector_position=(0.0, 0.0, FLANGE_LENGTH + HAND_TO_GRASP),
    end_effector_rotation=np.array(_AXES),
    gains=(0.6,) * 7,
    observed_pose=(0.0, -0.5, 0.0, -1.5, 0.0, 1.0, 0.8),
    contact_free=tuple((low + high) / 2 for low, high in zip(_LOWER, _UPPER, strict=True)),
    datasheet_lower=np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]),
    datasheet_upper=np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]),
)


def scale_of(robot: Robot) -> float:
    """A robot's reach as a share of the Panda's: what its random scenes and sensors scale with."""
    return 1.0 if robot.arm == PANDA else robot.reach / PANDA.reach
