"""The robot: Franka Panda joint limits, normalisation, forward kinematics, and its PyBullet body.

A configuration `c` is 7 joint angles in radians; `s` is the same in the normalised
configuration space [-1, 1]^7 (paper, appendix "Extended NMP goal-conditioned MDP description").
"""

import tempfile
from pathlib import Path

import numpy as np
import pybullet_data

from roboarm_nmp.envs.utils.bullet import pybullet as p

NUM_JOINTS = 7
# Joint limits (rad) and torque limits (N m) as in pybullet_data's franka_panda/panda.urdf.
LOWER = np.array([-2.9671, -1.8326, -2.9671, -3.1416, -2.9671, -0.0873, -2.9671])
UPPER = np.array([2.9671, 1.8326, 2.9671, 0.0, 2.9671, 3.8223, 2.9671])
MAX_TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
_MID = UPPER + LOWER
_RANGE = UPPER - LOWER

ARM_JOINTS = (0, 1, 2, 3, 4, 5, 6)
FINGER_JOINTS = (9, 10)
EE_LINK = 11  # panda_grasptarget, the point between the fingertips
COLLISION_LINKS = (0, 1, 2, 3, 4, 5, 6, 8, 9, 10)
"""PyBullet's indices of the links that may collide: the seven that the joints move, the hand, the
two fingers. Arrays with a row per link have this order."""
LINK_DISTANCES_SHAPE = (len(COLLISION_LINKS), 1 + NUM_JOINTS)
"""Of link distances: for each link, its signed distance (m) and the gradient of that."""
FINGER_OPENING = 0.04  # m, each finger; constant

# The pairs of links that may collide, by PyBullet link index (-1 is the base, 8 the hand, 9 and 10
# the fingers). Left out: neighbours, hand-link7 and finger-finger, whose meshes always overlap, and
# every pair without an overlap in 1,000,000 random configurations. Without this list the arm would
# collide with itself everywhere, and a physics step would cost twice as much.
SELF_COLLISION_PAIRS = (
    *((-1, link) for link in (4, 5, 6, 8, 9, 10)),
    *((0, link) for link in (4, 5, 6, 8, 9, 10)),
    *((1, link) for link in (4, 5, 6, 8, 9, 10)),
    *((4, link) for link in (6, 8, 9, 10)),
)


def normalise(configuration):
    """Joint angles in rad, shape (..., 7) -> normalised configuration in [-1, 1], same shape."""
    return (2.0 * np.asarray(configuration) - _MID) / _RANGE


def denormalise(state):
    """Normalised configuration, shape (..., 7) -> joint angles in rad, same shape."""
    return (np.asarray(state) * _RANGE + _MID) / 2.0


_MID_AND_RANGE = list(zip(_MID.tolist(), _RANGE.tolist(), strict=True))


def denormalise_one(state):
    """`denormalise` of one configuration, seven floats, as a list: faster than NumPy."""
    pairs = zip(state, _MID_AND_RANGE, strict=True)
    return [(value * width + mid) / 2.0 for value, (mid, width) in pairs]


# Fixed transforms between joint frames in the URDF: (x, y, z, roll about x), then the joint turns
# about its own z.
JOINT_FRAMES = (
    (0.0, 0.0, 0.333, 0.0),
    (0.0, 0.0, 0.0, -np.pi / 2),
    (0.0, -0.316, 0.0, np.pi / 2),
    (0.0825, 0.0, 0.0, np.pi / 2),
    (-0.0825, 0.384, 0.0, -np.pi / 2),
    (0.0, 0.0, 0.0, np.pi / 2),
    (0.088, 0.0, 0.0, np.pi / 2),
)
# Fixed to joint 7: the hand, in m along that joint's axis and turned about it (rad); in the hand's
# frame the fingers, which open along y; the grasp target, between the fingertips.
FLANGE_LENGTH, HAND_YAW = 0.107, -np.pi / 4
HAND_TO_FINGER = (0.0, 0.0, 0.0584)
_FLANGE_TO_EE = FLANGE_LENGTH + 0.105


def forward_kinematics(configuration):
    """Joint angles in rad, (..., 7) -> end-effector position in m from the base, (..., 3)."""
    for position, rotation in joint_frames(configuration):  # noqa: B007 (the last one counts)
        pass
    return position + _FLANGE_TO_EE * rotation[..., :, 2]


def joint_frames(configuration):
    """Joint angles in rad, (..., 7) -> per joint, its position (..., 3), m, and axes (..., 3, 3).

    A generator. The axes are columns, and a joint turns about the third.
    """
    configuration = np.asarray(configuration, dtype=np.float64)
    position = np.zeros((*configuration.shape[:-1], 3))
    rotation = np.broadcast_to(np.eye(3), (*configuration.shape[:-1], 3, 3))
    for joint, (x, y, z, roll) in enumerate(JOINT_FRAMES):
        position = position + rotation @ np.array([x, y, z])
        cr, sr = np.cos(roll), np.sin(roll)
        c, s = np.cos(configuration[..., joint]), np.sin(configuration[..., joint])
        zero = np.zeros_like(c)
        turn = np.stack(
            [c, -s, zero, cr * s, cr * c, zero - sr, sr * s, sr * c, zero + cr], axis=-1
        ).reshape(*c.shape, 3, 3)
        rotation = rotation @ turn
        yield position, rotation


_FOLDER = Path(pybullet_data.getDataPath(), "franka_panda")


def load(client, drawn=True):
    """Load the arm with its base fixed at the origin; returns its body id. Fingers stay open.

    Without `drawn` it has no visual shapes, which take 50 MB.
    """
    flags = p.URDF_USE_SELF_COLLISION
    if not drawn:
        flags |= p.URDF_IGNORE_VISUAL_SHAPES
    robot = p.loadURDF(
        str(_FOLDER / "panda.urdf"), useFixedBase=True, flags=flags, physicsClientId=client
    )
    links = range(-1, p.getNumJoints(robot, physicsClientId=client))
    for a in links:
        for b in range(a + 1, links.stop):
            may_collide = int((a, b) in SELF_COLLISION_PAIRS)
            p.setCollisionFilterPair(robot, robot, a, b, may_collide, physicsClientId=client)
    p.setJointMotorControlArray(
        robot,
        FINGER_JOINTS,
        p.POSITION_CONTROL,
        targetPositions=[FINGER_OPENING] * 2,
        forces=[20.0] * 2,
        physicsClientId=client,
    )
    return robot


def load_coarse(client, colour):
    """Load the arm for images only: its collision meshes, with a tenth of the faces, in one colour.

    `colour`: (red, green, blue, alpha) in [0, 1].
    """
    urdf = (_FOLDER / "panda.urdf").read_text()
    urdf = urdf.replace("package://meshes/visual", "package://meshes/collision")
    with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
        file.write(urdf.replace("package://", f"{_FOLDER}/"))
        file.flush()
        robot = p.loadURDF(file.name, useFixedBase=True, physicsClientId=client)
    for link in range(-1, p.getNumJoints(robot, physicsClientId=client)):
        p.changeVisualShape(robot, link, rgbaColor=colour, physicsClientId=client)
    return robot


RESET_JOINTS = ARM_JOINTS + FINGER_JOINTS
_FINGER_POSITIONS = [[FINGER_OPENING]] * 2
_AT_REST = [[0.0]] * len(RESET_JOINTS)
_FORCES = MAX_TORQUE.tolist()


def set_configuration(client, robot, configuration):
    """Teleport the arm to joint angles (7, rad), at rest."""
    p.resetJointStatesMultiDof(
        robot,
        RESET_JOINTS,
        [[angle] for angle in configuration] + _FINGER_POSITIONS,
        _AT_REST,
        physicsClientId=client,
    )


def command(client, robot, configuration, gains):
    """Set the targets of the seven position controllers: joint angles (list of 7, rad)."""
    p.setJointMotorControlArray(
        robot,
        ARM_JOINTS,
        p.POSITION_CONTROL,
        targetPositions=configuration,
        forces=_FORCES,
        positionGains=gains,
        physicsClientId=client,
    )
