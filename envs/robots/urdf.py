"""A `Robot` from a URDF, which is untrusted input: everything in it is checked first."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from roboarm_nmp.envs.robots.body import bullets_xml, end_effector_rotation
from roboarm_nmp.envs.robots.cache import cached
from roboarm_nmp.envs.robots.control import GAINS, calibrate
from roboarm_nmp.envs.robots.placements import (
    about,
    aligning,
    joint_axis,
    joint_end,
    joint_origin,
    link_steps,
)
from roboarm_nmp.envs.robots.robot import DEFAULT_VELOCITY, Frame, Link, Robot
from roboarm_nmp.envs.robots.self_collisions import SAMPLES, disabled_pairs, sample_pairs
from roboarm_nmp.envs.robots.untrusted import RobotError, bullet_indices
from roboarm_nmp.envs.robots.urdf_tree import MAX_NUMBER, UrdfTree

MAX_JOINTS, MAX_MOVABLE = 32, 100  # actuated ones, and all: PyBullet has states of 128
WIDENED = "limits of joints, where the file has wider ones"  # since then, gains are others


# --- What options must be


def _is_text(value):
    return isinstance(value, (str, Path))


def _is_number(value):
    is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    return is_number and bool(abs(value) <= MAX_NUMBER)


def _is_vector(value, size=3):
    is_sequence = isinstance(value, (list, tuple, np.ndarray))
    return is_sequence and len(value) == size and all(map(_is_number, value))


def _is_by_name(value, is_entry):
    is_mapping = isinstance(value, Mapping)
    return is_mapping and all(_is_text(name) and is_entry(value[name]) for name in value)


def _is_positive(value):
    return _is_number(value) and value > 0


_LIMIT = (
    lambda limit: _is_positive(limit) or _is_by_name(limit, _is_positive),
    "a positive number, or one for each joint",
)
_RANGE = (
    lambda limits: _is_by_name(limits, lambda limit: _is_vector(limit, 2)),
    "2 numbers for each joint",
)
OPTIONS = {
    "urdf": (_is_text, "text"),
    "name": (_is_text, "text"),
    "joints": (
        lambda names: isinstance(names, (list, tuple)) and all(map(_is_text, names)),
        "a list of names",
    ),
    "end_effector": (_is_text, "text"),
    "end_effector_position": (_is_vector, "3 numbers"),
    "fixed": (lambda positions: _is_by_name(positions, _is_number), "a number for each joint"),
    "limits": _RANGE,
    "srdf": (_is_text, "text"),
    "packages": (lambda folders: _is_by_name(folders, _is_text), "a folder for each package"),
    "base_position": (_is_vector, "3 numbers"),
    "base_orientation": (
        lambda turn: _is_vector(turn, 4) and abs(np.linalg.norm(turn) - 1) <= 0.01,
        "a quaternion of norm 1",
    ),
    "gain": (lambda gain: _is_number(gain) and 0 < gain <= 1, "a number in (0, 1]"),
    "acceleration_steps": (
        lambda steps: isinstance(steps, int) and _is_number(steps) and 1 <= steps <= 100,
        "an integer from 1 to 100",
    ),
    "velocity": _LIMIT,
    "acceleration": _LIMIT,
    "jerk": _LIMIT,
    "datasheet_limits": _RANGE,
}
"""The options of a robot, in Python and in its file: a check of each, and what it must be."""


def check_options(path, options: Mapping) -> None:
    """Raise RobotError for options that do not exist or cannot be used; None is a default."""
    for name, value in options.items():
        if name not in OPTIONS:
            raise RobotError(f"{path}: unknown key {name!r}: known are {', '.join(OPTIONS)}")
        is_valid, kind = OPTIONS[name]
        if value is not None and not is_valid(value):
            raise RobotError(f"{path}: {name} must be {kind}, got {value!r}")


# --- The robot


def robot_from_urdf(
    path: str | Path,
    joints: Sequence[str] | None = None,
    end_effector: str | None = None,
    end_effector_position: Sequence[float] = (0.0, 0.0, 0.0),
    fixed: Mapping[str, float] | None = None,
    limits: Mapping[str, Sequence[float]] | None = None,
    srdf: str | Path | None = None,
    packages: Mapping[str, str | Path] | None = None,
    name: str | None = None,
    base_position: Sequence[float] = (0.0, 0.0, 0.0),
    base_orientation: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    gain: float | None = None,
    acceleration_steps: int = 1,
    velocity: float | Mapping[str, float] | None = None,
    acceleration: float | Mapping[str, float] | None = None,
    jerk: float | Mapping[str, float] | None = None,
    datasheet_limits: Mapping[str, Sequence[float]] | None = None,
) -> Robot:
    """The arm that a URDF describes, as PyBullet loads it.

    The kinematic chain, axes, limits and collision shapes are the URDF's. Joints that mimic
    another one follow it.

    Args:
        path: of the URDF.
        joints: names of the n actuated joints; by default all movable joints between the base
            and the end effector.
        end_effector: name of the link that has the end effector; by default the link at the end
            of the longest chain of turning joints.
        end_effector_position: m, (3,), in that link's frame.
        fixed: dict from names of other joints, such as fingers, to where they are held (rad or
            m); by default 0, or the limit that is nearest to it.
        limits: dict from names of joints to (lower, upper), rad or m, where the URDF has none,
            or others.
        srdf: path of an SRDF, whose `disable_collisions` pairs of links do not collide. More
            pairs are left out by sampling (`envs.robots.self_collisions`).
        packages: dict from names of packages to folders, for `package://` paths of meshes.
        name: of the robot; by default the URDF's.
        base_position, base_orientation: pose of the base in the world, m and quaternion (xyzw).
        gain: of the position controllers; by default from a calibration
            (`envs.robots.control`).
        acceleration_steps: environment steps, 1 to 100, in which the sub-goals of a plan reach
            full speed after a waypoint, and slow down before the next.
        velocity, acceleration, jerk: limits of trajectories, rad/s, rad/s^2, rad/s^3 (or m): a
            number, or a dict from names of joints. By default the velocities are the URDF's, if
            it has some, and the others are unknown.
        datasheet_limits: dict from names of joints to (lower, upper), rad or m, inside the
            position limits: those of the manufacturer's datasheet (`position_limits`). Joints
            without have their position limits.

    Raises:
        RobotError: the file cannot be used; a ValueError that names it and the reason.
    """
    check_options(path, {name: value for name, value in locals().items() if name != "path"})
    tree = UrdfTree(Path(path), packages)
    fixed, limits, datasheet_limits = fixed or {}, limits or {}, datasheet_limits or {}
    movable = [joint for joint in tree.joints if tree.is_movable(joint)]
    if not movable:
        raise tree.error("no joint can move: give one the type revolute, continuous or prismatic")
    if len(movable) > MAX_MOVABLE:
        raise tree.error(f"{len(movable)} movable joints, at most {MAX_MOVABLE}")
    end_effector = end_effector or tree.likely_end_effector()
    joints = _actuated(tree, joints, end_effector)
    others = [joint for joint in movable if joint not in joints]
    for option, names, known in (
        ("fixed", fixed, others),
        ("limits", limits, list(tree.joints)),
        ("datasheet_limits", datasheet_limits, joints),
    ):
        for joint in names:
            if joint not in known:
                raise tree.error(f"{option}: {joint!r} is none of the joints {', '.join(known)}")
    bounds = np.array([tree.limits(joint, limits) for joint in joints])
    positions = {joint: tree.held_at(joint, fixed) for joint in others}
    mimics = _mimics(tree, joints, positions)
    frames, placements = _frames(tree, joints, positions, mimics)
    for joint in tree.joints.values():
        if joint.get("type") != "fixed" and joint.find("limit") is None:
            ElementTree.SubElement(joint, "limit")  # PyBullet loads no joint without
    ElementTree.indent(tree.root)  # PyBullet breaks lines of more than 8,191 letters
    xml = ElementTree.tostring(tree.root, "unicode")
    joint_index, link_index, shapes = bullet_indices(path, bullets_xml(xml))
    for link, element in tree.elements.items():
        if shapes[link] < len(element.findall("collision")):
            raise tree.error(
                f"link {link!r}: PyBullet cannot use one of its collision shapes: export its mesh "
                f"again, or take a box, a cylinder or a sphere"
            )
    links = []
    for link in filter(tree.is_solid, tree.links):
        frame, rotation, position = placements[link]
        links.append(Link(link_index[link], frame, link_steps(rotation, position)))
    links.sort(key=lambda link: (link.frame >= 0, link.index))  # those that do not move come first
    held = [joint for joint in positions if joint in tree.joints]
    frame, rotation, position = placements[end_effector]
    urdf_velocity = _urdf_velocity(tree, joints)
    datasheet = _datasheet_limits(tree, joints, bounds, datasheet_limits)
    middle = tuple(bounds.mean(1))
    turn = np.array(base_orientation)
    robot = Robot(
        name=name or tree.root.get("name") or Path(path).stem,
        urdf=str(path),
        xml=xml,
        mesh_digest=tree.mesh_digest,
        joint_names=tuple(joints),
        joint_indices=tuple(joint_index[joint] for joint in joints),
        bullet_joint_names=tuple(joint_index),
        link_names={index: link for link, index in link_index.items()},
        lower=bounds[:, 0],
        upper=bounds[:, 1],
        velocity=_motion_limits(tree, "velocity", velocity, joints, urdf_velocity),
        acceleration=_motion_limits(tree, "acceleration", acceleration, joints),
        jerk=_motion_limits(tree, "jerk", jerk, joints),
        urdf_velocity=urdf_velocity,
        effort=np.array([tree.effort(joint) for joint in joints]),
        held_indices=tuple(joint_index[joint] for joint in held),
        held_positions=tuple(positions[joint] for joint in held),
        held_effort=tuple(tree.effort(joint) for joint in held),
        mimics=tuple(
            (joint_index[joint], joints.index(leader), multiplier, offset)
            for joint, (leader, multiplier, offset) in mimics.items()
        ),
        frames=tuple(frames),
        links=tuple(links),
        self_collision_pairs=(),
        end_effector_link=link_index[end_effector],
        end_effector_offset=tuple(map(float, end_effector_position)),
        end_effector_frame=frame,
        end_effector_position=tuple(position + rotation @ np.array(end_effector_position)),
        end_effector_rotation=np.eye(3),  # PyBullet is asked below
        gains=(gain or 0.6,) * len(joints),
        acceleration_steps=acceleration_steps,
        contact_free=middle,
        observed_pose=middle,
        base_position=tuple(map(float, base_position)),
        base_orientation=tuple((turn / np.linalg.norm(turn)).tolist()),
        datasheet_lower=datasheet[:, 0] if datasheet_limits else None,
        datasheet_upper=datasheet[:, 1] if datasheet_limits else None,
    )
    disabled = disabled_pairs(srdf, link_index) if srdf else set()
    for before, link in tree.neighbours():
        a, b = sorted((link_index[before], link_index[link]))
        disabled.add((a, b))
    pairs, contact_free = cached(
        "pairs", robot, [SAMPLES, sorted(disabled)], lambda: sample_pairs(robot, disabled)
    )
    robot = dataclasses.replace(
        robot,
        self_collision_pairs=tuple(map(tuple, pairs)),
        contact_free=tuple(contact_free),
        observed_pose=tuple(contact_free),
    )
    if gain is None:
        gain = cached("gain", robot, [GAINS, WIDENED], lambda: calibrate(robot)[0])
        robot = dataclasses.replace(robot, gains=(gain,) * len(joints))
    axes = cached("end effector", robot, [], lambda: end_effector_rotation(robot).tolist())
    return dataclasses.replace(robot, end_effector_rotation=np.array(axes))


def _actuated(tree, joints, end_effector):
    """The names of the actuated joints, from the base to the end effector; None: all of them."""
    if end_effector not in tree.links:
        raise tree.error(f"no link {end_effector!r}, but {', '.join(tree.links)}")
    on_chain = [joint for joint in tree.chain(end_effector) if tree.is_movable(joint)]
    joints = on_chain if joints is None else joints
    if not len(joints):
        raise tree.error(f"no joint moves {end_effector!r}")
    for joint in joints:
        if joint not in on_chain:
            raise tree.error(
                f"{joint!r} is no movable joint between the base and {end_effector!r}; those are "
                f"{', '.join(on_chain)}"
            )
    if len(joints) > MAX_JOINTS:
        raise tree.error(f"{len(joints)} actuated joints, at most {MAX_JOINTS}")
    return sorted(joints, key=on_chain.index)


def _mimics(tree, joints, positions):
    """The (leader, multiplier, offset) of joints that follow one of `joints`: dict from names.

    Those that follow a held joint get their places in `positions`.
    """
    mimics = {}
    for joint in tree.joints:
        mimic = tree.mimic(joint)
        if mimic is None:
            continue
        leader, multiplier, offset = mimic
        passed = {joint}
        while leader not in positions and leader not in joints:  # it may be a mimic, too
            mimic = tree.mimic(leader)
            if mimic is None:
                break
            if leader in passed:
                raise tree.error(f"{joint!r} mimics itself")
            passed.add(leader)
            leader, scale, shift = mimic
            offset = multiplier * shift + offset
            multiplier = multiplier * scale
        if leader in positions:
            positions[joint] = multiplier * positions[leader] + offset
        elif leader in joints:
            mimics[joint] = leader, multiplier, offset
        else:
            raise tree.error(f"{joint!r} mimics {leader!r}, which cannot move")
    return mimics


def _datasheet_limits(tree, joints, bounds, datasheet_limits):
    """Position limits (n, 2) of a datasheet; joints without have their `bounds` (n, 2)."""
    limits = bounds.copy()
    for row, joint, (least, most) in zip(limits, joints, bounds, strict=True):
        row[:] = datasheet_limits.get(joint, row)
        if not least <= row[0] < row[1] <= most:
            raise tree.error(
                f"joint {joint!r}: datasheet_limits from {row[0]} to {row[1]} are not inside the "
                f"limits from {least} to {most}"
            )
    return limits


def _urdf_velocity(tree, joints):
    """Limits of the velocity in the URDF (n,), where it has none `DEFAULT_VELOCITY`; None: none."""
    velocities = [tree.velocity(joint) for joint in joints]
    without = [joint for joint, limit in zip(joints, velocities, strict=True) if not limit > 0]
    if len(without) == len(joints):
        return None
    if without:
        warnings.warn(
            f"{tree.path}: no positive velocity limit of {', '.join(without)}: "
            f"{DEFAULT_VELOCITY:g} rad/s (or m/s) is assumed",
            stacklevel=3,
        )
    return [limit if limit > 0 else DEFAULT_VELOCITY for limit in velocities]


def _motion_limits(tree, name, limits, joints, urdf_limits=None):
    """Limits (n,) of velocity, acceleration or jerk, or None: an option, or else the URDF's."""
    if limits is None:
        return None if urdf_limits is None else np.array(urdf_limits)
    if not isinstance(limits, Mapping):
        return np.full(len(joints), limits, dtype=np.float64)
    for joint in limits:
        if joint not in joints:
            raise tree.error(f"{name}: {joint!r} is none of the joints {', '.join(joints)}")
    limit_of = dict(zip(joints, urdf_limits or (), strict=False)) | dict(limits)
    if missing := [joint for joint in joints if joint not in limit_of]:
        raise tree.error(f"{name}: no limit of {', '.join(missing)}")
    return np.array([limit_of[joint] for joint in joints])


def _frames(tree, joints, positions, mimics):
    """The robot's `Frame`s, and where each link is: (frame, rotation (3, 3), position (3,))."""
    frames, placements = [], {tree.links[0]: (-1, np.eye(3), np.zeros(3))}
    for name, joint in tree.joints.items():
        frame, rotation, position = placements[joint_end(joint, "parent")]
        at, turn = joint_origin(joint)
        position, rotation = position + rotation @ at, rotation @ turn
        kind, link = joint.get("type"), joint_end(joint, "child")
        if name in joints or name in mimics:
            leader, multiplier, offset = mimics.get(name, (name, 1.0, 0.0))
            aligned = aligning(joint_axis(joint))
            frames.append(
                Frame(
                    parent=frame,
                    joint=joints.index(leader),
                    position=tuple(position.tolist()),
                    rotation=tuple((rotation @ aligned).ravel().tolist()),
                    is_prismatic=kind == "prismatic",
                    multiplier=multiplier,
                    offset=offset,
                )
            )
            placements[link] = len(frames) - 1, aligned.T, np.zeros(3)
            continue
        if kind == "prismatic":
            position = position + rotation @ (joint_axis(joint) * positions[name])
        elif kind != "fixed":
            rotation = rotation @ about(joint_axis(joint), positions[name])
        placements[link] = frame, rotation, position
    return frames, placements
