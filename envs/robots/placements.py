"""Where links are: rotations and positions from a URDF's joints."""

import math
from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np

from roboarm_nmp.envs.robots.body import parsed_urdf
from roboarm_nmp.envs.robots.robot import Robot


def link_placement(robot: Robot, link: str) -> tuple[str | None, np.ndarray, np.ndarray]:
    """Where a link is in the frame of the `Robot` that moves it.

    Returns:
        the name of the joint of that frame, None for the base; rotation (3, 3); position (3,), m.

    Raises:
        ValueError: the robot has no such link.
    """
    if link not in robot.link_names.values():
        raise ValueError(f"{robot.name} has no link {link!r}")
    joints, held = joints_by_child(robot), robot.held
    moving = {*robot.joint_names, *(robot.bullet_joint_names[mimic[0]] for mimic in robot.mimics)}
    rotation, position = np.eye(3), np.zeros(3)
    while link in joints:
        joint = joints[link]
        name, kind = joint.get("name", ""), joint.get("type")
        if name in moving:
            aligned = aligning(joint_axis(joint))
            return name, aligned.T @ rotation, aligned.T @ position
        if name in held and kind == "prismatic":
            position = position + joint_axis(joint) * held[name]
        elif name in held:
            turn = about(joint_axis(joint), held[name])
            rotation, position = turn @ rotation, turn @ position
        at, turn = joint_origin(joint)
        rotation, position = turn @ rotation, at + turn @ position
        link = joint_end(joint, "parent")
    return None, rotation, position


def link_steps(rotation: np.ndarray, position: np.ndarray) -> tuple:
    """`Link.placements` of one transform."""
    if (rotation == np.eye(3)).all() and not position.any():
        return ()
    return ((tuple(position.tolist()), tuple(rotation.ravel().tolist())),)


def joints_by_child(robot: Robot) -> dict[str, ElementTree.Element]:
    """The URDF's joints, XML elements, by the link that each moves."""
    return {joint_end(joint, "child"): joint for joint in parsed_urdf(robot).findall("joint")}


def held_above(link: str, joints: dict[str, ElementTree.Element], held) -> Iterator[str]:
    """Names of the held joints between a link and the base; `joints` as of `joints_by_child`."""
    while link in joints:
        joint = joints[link]
        if joint.get("name") in held:
            yield joint.get("name", "")
        link = joint_end(joint, "parent")


# --- A joint, an XML element


def joint_end(joint: ElementTree.Element, end: str) -> str:
    """The name of the link at an end of a joint: its "parent" or its "child"."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def joint_axis(joint: ElementTree.Element) -> np.ndarray:
    """The direction (3,) about or along which a joint moves."""
    element = joint.find("axis")
    text = "1 0 0" if element is None else element.get("xyz", "1 0 0")  # the default of URDF
    return np.array([float(x) for x in text.split()])


def joint_origin(joint: ElementTree.Element) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and rotation (3, 3) of a joint in its parent link."""
    element = joint.find("origin")
    xyz = rpy = "0 0 0"
    if element is not None:
        xyz, rpy = element.get("xyz", xyz), element.get("rpy", rpy)
    position = np.array([float(x) for x in xyz.split()])
    roll, pitch, yaw = [float(x) for x in rpy.split()]
    return position, _rotation_z(yaw) @ _rotation_y(pitch) @ _rotation_x(roll)


# --- Rotation matrices


def aligning(axis: np.ndarray) -> np.ndarray:
    """A rotation matrix whose third column is `axis`."""
    if np.allclose(axis, (0.0, 0.0, 1.0), atol=1e-12):
        return np.eye(3)
    other = np.eye(3)[np.abs(axis).argmin()]
    x = np.cross(other, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    """The rotation by an angle about an axis."""
    aligned = aligning(axis)
    return aligned @ _rotation_z(angle) @ aligned.T


def _rotation_x(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _rotation_y(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _rotation_z(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
