"""Variants of an arm: a gripper held elsewhere, and objects attached to links."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping

import numpy as np

from roboarm_nmp.envs.robots.attached_xml import attached_name
from roboarm_nmp.envs.robots.body import (
    body_alone,
    end_effector_rotation,
    names_in_bullet,
    parsed_urdf,
)
from roboarm_nmp.envs.robots.placements import (
    held_above,
    joint_end,
    joints_by_child,
    link_placement,
    link_steps,
)
from roboarm_nmp.envs.robots.robot import Link, Robot
from roboarm_nmp.utils.bullet import pybullet as p

MAX_HELD = 10.0  # rad or m, of a held joint
MAX_ATTACHED = 100
JOINT_VALUES, NEAR = 200, 0.005  # of a joint between neighbours; m, between these
SAMPLES = 1_000  # configurations among which one without contacts is looked for


def with_held(robot: Robot, positions: Mapping[str, float]) -> Robot:
    """An arm with held joints, such as a gripper's, elsewhere.

    Args:
        robot: the `Robot`; attached objects stay attached.
        positions: dict from names of held joints to positions, rad or m, which may be beyond the
            joints' limits. Joints that mimic one of them follow it, unless they are named.

    Raises:
        ValueError: no such held joint, a position that is not finite or too large, or a joint that
            carries one of the n joints.
    """
    held, arm = robot.held, robot.arm
    for name, position in positions.items():
        if name not in held:
            known = ", ".join(held) or "none"
            raise ValueError(f"{robot.name}: {name!r} is no held joint; those are {known}")
        if not abs(position) <= MAX_HELD:  # or NaN
            raise ValueError(f"{robot.name}: {name} cannot be held at {position!r}")
    held.update(_followers(arm, positions))
    held.update((name, float(position)) for name, position in positions.items())
    return with_attached(_held_at(arm, tuple(held.values())), robot.attached)


def with_attached(robot: Robot, objects: Iterable) -> Robot:
    """An arm with objects attached to its links, as parts of these; `()` detaches all.

    The objects collide with the scene, and with those links that move against their own. Their
    distances are in the rows of the links that carry them, so policies and encoders of the arm
    accept it. In the simulator they weigh 1 g.

    Args:
        robot: the `Robot`.
        objects: `envs.scenes.primitives.Attached` objects, in the place of present ones.

    Raises:
        TypeError: objects of another type.
        ValueError: no such link, one that does not move, too many objects, or one with which the
            arm collides with itself everywhere.
    """
    alone, objects = _held_at(robot.arm, robot.held_positions), tuple(objects)
    return _attach(alone, objects) if objects else alone


# --- Held joints


def _followers(robot, positions):
    """Where held joints are that mimic those in `positions`, a dict: likewise.

    Joints that are in `positions` themselves are left out.
    """
    following = {}
    joints = parsed_urdf(robot).findall("joint")
    for _ in joints:  # a leader may follow another joint, and stand after it in the file
        for joint in joints:
            name = joint.get("name", "")
            mimic = joint.find("mimic")
            if mimic is None or name in positions or name not in robot.held:
                continue
            leader = mimic.get("joint", "")
            position = positions.get(leader, following.get(leader))
            if position is not None:
                scale = float(mimic.get("multiplier", 1))
                following[name] = scale * position + float(mimic.get("offset", 0))
    return following


@functools.lru_cache(64)
def _held_at(arm, positions):
    """An arm without objects, with its held joints at other positions, a tuple."""
    if positions == arm.held_positions:
        return arm
    robot = dataclasses.replace(arm, held_positions=positions, described=arm)
    joints, held = joints_by_child(robot), robot.held
    changed = {name for name, position in arm.held.items() if held[name] != position}

    def is_moved(link):
        return bool(changed & set(held_above(link, joints, held)))

    for index in (*robot.joint_indices, *(mimic[0] for mimic in robot.mimics)):
        name = robot.bullet_joint_names[index]
        joint = next(joint for joint in joints.values() if joint.get("name") == name)
        if carriers := changed & set(held_above(joint_end(joint, "parent"), joints, held)):
            raise ValueError(
                f"{arm.name}: {min(carriers)} carries joints that move: hold it elsewhere in the "
                f"robot's file"
            )
    links = list(robot.links)
    for i, link in enumerate(links):
        if is_moved(robot.link_names[link.index]):
            _, rotation, position = link_placement(robot, robot.link_names[link.index])
            links[i] = link._replace(placements=link_steps(rotation, position))
    robot = dataclasses.replace(robot, links=tuple(links))
    end = robot.link_names[robot.end_effector_link]
    if is_moved(end):
        _, rotation, position = link_placement(robot, end)
        position = position + rotation @ np.array(robot.end_effector_offset)
        robot = dataclasses.replace(
            robot,
            end_effector_position=tuple(position.tolist()),
            end_effector_rotation=end_effector_rotation(robot),
        )
    return robot


# --- Attached objects


@functools.lru_cache(64)
def _attach(robot, objects):
    """`with_attached` of a robot without objects; `objects` is a tuple that is not empty."""
    if not all(hasattr(attached, "described") for attached in objects):
        raise TypeError(f"attached objects must be of the type Attached, got {objects!r}")
    if len(objects) > MAX_ATTACHED:
        raise ValueError(f"an arm has at most {MAX_ATTACHED} attached objects, got {len(objects)}")
    end = robot.link_names[robot.end_effector_link]
    objects = tuple(
        dataclasses.replace(attached, link=attached.link or end) for attached in objects
    )
    carriers = [_carrier(robot, attached.link) for attached in objects]
    touched = [robot.links_called(attached.touch_links) for attached in objects]
    carrying = dataclasses.replace(
        robot, attached=objects, carriers=tuple(carriers), described=robot.arm
    )
    joint_names, link_names = names_in_bullet(carrying)
    # The new links may change PyBullet's indices of those after them.
    index = {name: link for link, name in link_names.items()}
    new = {link: index[name] for link, name in robot.link_names.items()}
    links = [link._replace(index=new[link.index]) for link in robot.links]
    frames = {link.index: link.frame for link in links}
    own_pairs = [(new[a], new[b]) for a, b in robot.self_collision_pairs]
    pairs = []
    for i, attached in enumerate(objects):
        link, frame = index[attached_name(i)], frames[new[carriers[i]]]
        touching = {new[link] for link in touched[i]}
        for other, other_frame in frames.items():
            if other_frame != frame and other not in touching:
                pairs.append((min(link, other), max(link, other)))
        frames[link] = frame
        _, rotation, position = link_placement(robot, attached.link)
        links.append(Link(link, frame, link_steps(rotation, position)))
    carrying = dataclasses.replace(
        carrying,
        bullet_joint_names=joint_names,
        link_names=link_names,
        carriers=tuple(new[link] for link in carriers),
        joint_indices=tuple(new[joint] for joint in robot.joint_indices),
        held_indices=tuple(new[joint] for joint in robot.held_indices),
        mimics=tuple((new[mimic[0]], *mimic[1:]) for mimic in robot.mimics),
        end_effector_link=new[robot.end_effector_link],
        links=tuple(links),
        self_collision_pairs=(*own_pairs, *pairs),
    )
    pairs = _without_distant_neighbours(carrying, pairs)
    carrying = dataclasses.replace(carrying, self_collision_pairs=(*own_pairs, *pairs))
    return dataclasses.replace(carrying, contact_free=_contact_free(carrying))


def _carrier(robot, link):
    """PyBullet's index of the link that shares its row of link distances with what `link` carries.

    That is `link` itself, or, where it has no collision shape, another one that moves with it.
    """
    joint = link_placement(robot, link)[0]
    if joint is None:
        raise ValueError(f"{robot.name}: {link!r} does not move: make the object an obstacle")
    beside = {
        robot.link_names[other]: other
        for other in robot.collision_links
        if link_placement(robot, robot.link_names[other])[0] == joint
    }
    if not beside:
        raise ValueError(f"{robot.name}: no link that may collide moves with {link!r}")
    joints, above = joints_by_child(robot), link
    while above in joints and above not in beside:
        above = joint_end(joints[above], "parent")
    return beside.get(above, max(beside.values()))


def _without_distant_neighbours(robot, pairs):
    """The pairs without those of neighbours that never come near each other.

    A single joint moves neighbours against each other, so its range says it all. Their distance
    hardly changes, so a safety filter could do nothing about it.
    """
    frame_of, near_pairs = {link.index: link.frame for link in robot.links}, []
    with body_alone(robot) as body:
        for a, b in pairs:
            before, after = sorted((frame_of[a], frame_of[b]))
            if before < 0 or robot.frames[after].parent != before:
                near_pairs.append((a, b))
                continue
            joint, configuration = robot.frames[after].joint, list(robot.contact_free)
            for angle in np.linspace(robot.lower[joint], robot.upper[joint], JOINT_VALUES):
                configuration[joint] = angle
                body.set_configuration(configuration)
                if p.getClosestPoints(body.id, body.id, NEAR, a, b, physicsClientId=body.client):
                    near_pairs.append((a, b))
                    break
    return near_pairs


def _contact_free(robot):
    """A configuration (n,) without contacts of the arm with itself, a tuple."""
    rng, candidate = np.random.default_rng(0), np.array(robot.contact_free)
    with body_alone(robot) as body:
        for _ in range(SAMPLES):
            body.set_configuration(candidate.tolist())
            p.performCollisionDetection(physicsClientId=body.client)
            if not p.getContactPoints(body.id, body.id, physicsClientId=body.client):
                return tuple(candidate.tolist())
            candidate = rng.uniform(robot.lower, robot.upper)
    raise ValueError(
        f"{robot.name}: with the attached objects the arm collides with itself in each of "
        f"{SAMPLES} configurations: touch_links names links that an object may be in contact with"
    )
