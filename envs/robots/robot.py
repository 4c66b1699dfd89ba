"""What an arm is: joints, limits, kinematics, links that may collide, and its PyBullet body.

A configuration `c` is an arm's n joint angles in rad (m for a prismatic joint); `s` is the same in
the normalised configuration space [-1, 1]^n (paper, appendix "Extended NMP goal-conditioned MDP
description"). `PANDA` (`envs.robots.panda`) is the paper's arm; `Robot.from_urdf` makes others.
"""

import contextlib
import copy
import functools
import hashlib
import importlib
import json
import tempfile
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from roboarm_nmp.utils.bullet import pybullet as p

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
MAX_HELD = 10.0  # rad or m, of a held joint


class Frame(NamedTuple):
    """A frame that a joint moves: about its z axis, or along it.

    Attributes:
        parent: index of another frame of the robot; -1 for the base.
        joint: index of the joint, 0 to n - 1.
        position: m, of the frame in its parent's, with the joint at 0.
        rotation: row-major (9,), likewise.
        is_prismatic: whether the joint moves the frame along z instead of about it.
        multiplier, offset: of a mimic joint: its value is multiplier * joint + offset.
    """

    parent: int
    joint: int
    position: tuple
    rotation: tuple
    is_prismatic: bool = False
    multiplier: float = 1.0
    offset: float = 0.0


class Link(NamedTuple):
    """A link that may collide.

    Attributes:
        index: PyBullet's, -1 for the base.
        frame: index of the frame that moves it; -1 for the base.
        placements: ((position (3,), rotation (9,)), ...): transforms from the link's own frame to
            that frame, to be applied one after the other.
    """

    index: int
    frame: int
    placements: tuple = ()


@dataclass(frozen=True, eq=False)
class Robot:
    """An arm. Equal robots have the same numbers and the same files.

    Attributes:
        name: for messages and files.
        urdf: path of the URDF.
        joint_names, joint_indices: of the n actuated joints, from base to end effector, in the URDF
            and in PyBullet.
        lower, upper: position limits (n,), rad or m.
        velocity, acceleration, jerk: limits (n,), rad/s, rad/s^2, rad/s^3 (or m); None if unknown.
        effort: limits of the torques (n,), N m (or N).
        held_indices, held_positions, held_effort: the other movable joints, for example fingers:
            PyBullet's indices, where a controller holds them, and its largest force (N, or N m).
        mimics: PyBullet's (index, joint, multiplier, offset) of joints that follow one of the n.
        frames: the `Frame`s that the joints move, parents first.
        links: the `Link`s that may collide. Those that no joint moves come first: they collide
            with the arm only. The others are in the order of the rows of link distances.
        self_collision_pairs: pairs of PyBullet's link indices that may collide.
        end_effector_link: PyBullet's index of the link that has the end effector.
        end_effector_offset: m, (3,), the end effector's position in that link's frame.
        end_effector_frame: index of the frame that moves it.
        end_effector_position: m, (3,), the end effector's position in that frame.
        base_position, base_orientation: pose of the base in the world, m and quaternion (xyzw).
        mesh_digest: SHA-256 (hex) of the URDF's collision shapes; empty for `PANDA`.
        source: the file that names the robot, for scene files; empty for `PANDA`.
        xml: the URDF's text, with absolute paths of meshes; empty if PyBullet can read the file.
        datasheet_lower, datasheet_upper: position limits (n,) of the manufacturer's datasheet, rad
            or m, where they are others than the URDF's; None otherwise.
        urdf_velocity: limits of the velocity (n,) in the URDF, None if it has none, or for `PANDA`.
        gains: of the position controllers (n,).
        acceleration_steps: environment steps in which a plan's sub-goals reach full speed after a
            waypoint, and slow down before the next.
        contact_free: a configuration without contacts (n,).
        observed_pose: the configuration (n,) in which sensors observe a scene: always the same, so
            that an encoded scene depends on the scene alone.
        described: of `with_held` and `with_attached`: the arm with its held joints where its
            description has them, and without objects; None for that arm itself.
        attached: the `envs.scenes.primitives.Attached` objects, whose links are the last of
            `links`.
        carriers: PyBullet's index of the link whose row of link distances each of them shares.
    """

    name: str
    urdf: str
    joint_names: tuple
    joint_indices: tuple
    lower: np.ndarray
    upper: np.ndarray
    velocity: np.ndarray | None
    acceleration: np.ndarray | None
    jerk: np.ndarray | None
    effort: np.ndarray
    held_indices: tuple
    held_positions: tuple
    held_effort: tuple
    mimics: tuple
    frames: tuple
    links: tuple
    self_collision_pairs: tuple
    end_effector_link: int
    end_effector_offset: tuple
    end_effector_frame: int
    end_effector_position: tuple
    gains: tuple
    contact_free: tuple
    observed_pose: tuple
    base_position: tuple = (0.0, 0.0, 0.0)
    base_orientation: tuple = (0.0, 0.0, 0.0, 1.0)
    mesh_digest: str = ""
    source: str = ""
    xml: str = ""
    described: "Robot | None" = None
    datasheet_lower: np.ndarray | None = None
    datasheet_upper: np.ndarray | None = None
    attached: tuple = ()
    carriers: tuple = ()
    urdf_velocity: list | None = None
    acceleration_steps: int = 1

    def __post_init__(self):
        names = ("lower", "upper", "velocity", "acceleration", "jerk", "effort")
        for name in (*names, "datasheet_lower", "datasheet_upper"):
            if getattr(self, name) is not None:
                array = np.array(getattr(self, name), dtype=np.float64)
                array.flags.writeable = False
                object.__setattr__(self, name, array)

    def __eq__(self, other):
        return isinstance(other, Robot) and self.fingerprint == other.fingerprint

    def __hash__(self):
        return hash(self.fingerprint)

    def __repr__(self):
        return f"Robot({self.name!r}, {self.fingerprint[:12]})"

    @functools.cached_property
    def fingerprint(self):
        """SHA-256 (hex) of the description: all that kinematics and collisions depend on.

        Numbers are rounded to 1e-9: the last bits of sines and cosines differ between machines.
        """
        content = {f.name: getattr(self, f.name) for f in fields(self)}
        velocity = content.pop("urdf_velocity")
        if self.xml:  # limits of a robot's file concern trajectories alone: files stay valid
            content |= {"velocity": velocity, "acceleration": None, "jerk": None}
        for name in ("urdf", "source", "xml", "described", "datasheet_lower", "datasheet_upper"):
            content.pop(name)
        content["attached"] = [one.described() for one in self.attached]
        if not self.attached:
            del content["attached"], content["carriers"]
        if self.acceleration_steps == 1:
            del content["acceleration_steps"]
        text = json.dumps(_rounded(content), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    @classmethod
    def from_urdf(cls, path, **options):
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
        # By name, because that module is built on this one.
        urdf = importlib.import_module("roboarm_nmp.envs.robots.urdf")
        return urdf.robot_from_urdf(path, **options)

    # --- Held joints and attached objects

    @property
    def arm(self):
        """The arm as its description has it, without objects: what files name."""
        return self.described or self

    def same_arm(self, other):
        """Whether another `Robot` is this arm, wherever held joints are, whatever is attached."""
        return self.arm == other.arm

    @property
    def held(self):
        """Where the held joints are, rad or m: dict from names to positions."""
        names = [self.bullet_names[0][index] for index in self.held_indices]
        return dict(zip(names, self.held_positions, strict=True))

    def with_held(self, positions):
        """This arm with held joints, such as a gripper's, elsewhere.

        Args:
            positions: dict from names of held joints to positions, rad or m, which may be beyond
                the joints' limits. Joints that mimic one of them follow it, unless they are named.

        Raises:
            ValueError: no such held joint, a position that is not finite or too large, or a joint
                that carries one of the n joints.
        """
        # By name, because that module is built on this one.
        urdf = importlib.import_module("roboarm_nmp.envs.robots.urdf")
        held, arm = self.held, self.arm
        for name, position in positions.items():
            if name not in held:
                known = ", ".join(held) or "none"
                raise ValueError(f"{self.name}: {name!r} is no held joint; those are {known}")
            if not abs(position) <= MAX_HELD:  # or NaN
                raise ValueError(f"{self.name}: {name} cannot be held at {position!r}")
        held |= urdf.followers(arm, positions)
        held |= {name: float(position) for name, position in positions.items()}
        return urdf.held_at(arm, tuple(held.values())).with_attached(self.attached)

    def with_attached(self, objects):
        """This arm with objects attached to its links, as parts of these; `()` detaches all.

        The objects collide with the scene, and with those links that move against their own. Their
        distances are in the rows of the links that carry them, so policies and encoders of the arm
        accept it. In the simulator they weigh 1 g.

        Args:
            objects: `envs.scenes.primitives.Attached` objects, in the place of present ones.

        Raises:
            TypeError: objects of another type.
            ValueError: no such link, one that does not move, too many objects, or one with which
                the arm collides with itself everywhere.
        """
        # By name, because those modules are built on this one.
        urdf = importlib.import_module("roboarm_nmp.envs.robots.urdf")
        attached = importlib.import_module("roboarm_nmp.envs.robots.attached")
        robot, objects = urdf.held_at(self.arm, self.held_positions), tuple(objects)
        return attached.attach(robot, objects) if objects else robot

    @functools.cached_property
    def hand_links(self):
        """Names of the hand's links: those that move with the end effector and may collide.

        The link that the last joint moves is among them only if there are no others.
        """
        names, frame = self.bullet_names[1], self.end_effector_frame
        found = [link.index for link in self._own_links if link.frame == frame >= 0]
        last = self.joint_indices[self.frames[frame].joint]
        return tuple(names[index] for index in [i for i in found if i != last] or found)

    def links_called(self, names):
        """PyBullet's indices of links by their names, and of the objects attached to them.

        `names`: a sequence, or True for the `hand_links`. Raises ValueError: there is no such link.
        """
        if not names:
            return frozenset()
        index = {name: link for link, name in self.bullet_names[1].items()}
        names = self.hand_links if names is True else names
        if unknown := [name for name in names if name not in index]:
            raise ValueError(f"{self.name} has no link {unknown[0]!r}")
        found = {index[name] for name in names}
        objects = zip(self.links[len(self._own_links) :], self.carriers, strict=True)
        return frozenset(found | {link.index for link, carrier in objects if carrier in found})

    # --- Sizes and normalisation

    @property
    def num_joints(self):
        """n."""
        return len(self.joint_indices)

    def position_limits(self, limits="urdf"):
        """Lower and upper position limits, two arrays (n,), rad or m.

        `limits`: "urdf" or "datasheet". Raises ValueError: another one, or an arm without the
        limits of a datasheet.
        """
        if limits == "urdf":
            return self.lower, self.upper
        if limits != "datasheet":
            raise ValueError(f"limits must be 'urdf' or 'datasheet', got {limits!r}")
        if self.datasheet_lower is None:
            raise ValueError(f"{self.name} has no position limits of a datasheet")
        return self.datasheet_lower, self.datasheet_upper

    def is_within(self, configuration, limits="urdf"):
        """Whether joint angles (..., n) are inside the `position_limits`: bool (...)."""
        lower, upper = self.position_limits(limits)
        return ((configuration >= lower) & (configuration <= upper)).all(-1)

    @property
    def collision_links(self):
        """PyBullet's indices of the moving links that may collide: the rows of link distances."""
        return tuple(link.index for link in self._own_links if link.frame >= 0)

    @property
    def _own_links(self):
        """`links` without those of attached objects."""
        return self.links[: len(self.links) - len(self.attached)]

    @functools.cached_property
    def link_rows(self):
        """The row of link distances of each moving link that may collide: dict from its index.

        An attached object has the row of the link that carries it.
        """
        rows = {link: row for row, link in enumerate(self.collision_links)}
        objects = zip(self.links[len(self._own_links) :], self.carriers, strict=True)
        return rows | {link.index: rows[carrier] for link, carrier in objects}

    @property
    def link_distances_shape(self):
        """Of link distances: for each link, its signed distance (m) and the gradient of that."""
        return len(self.collision_links), 1 + self.num_joints

    @functools.cached_property
    def reach(self):
        """m: the end effector's largest distance from the base, of 10,000 random configurations."""
        rng = np.random.default_rng(0)
        configurations = rng.uniform(self.lower, self.upper, (10_000, self.num_joints))
        positions = self.forward_kinematics(configurations) - np.array(self.base_position)
        return float(np.linalg.norm(positions, axis=1).max())

    @functools.cached_property
    def _mid_and_range(self):
        return self.upper + self.lower, self.upper - self.lower

    @functools.cached_property
    def _mid_and_range_lists(self):
        return list(zip(*(x.tolist() for x in self._mid_and_range), strict=True))

    def normalise(self, configuration):
        """Joint angles in rad, (..., n) -> normalised configuration in [-1, 1], same shape."""
        mid, span = self._mid_and_range
        return (2.0 * np.asarray(configuration) - mid) / span

    def denormalise(self, state):
        """Normalised configuration, (..., n) -> joint angles in rad, same shape."""
        mid, span = self._mid_and_range
        return (np.asarray(state) * span + mid) / 2.0

    def denormalise_one(self, state):
        """`denormalise` of one configuration, n floats, as a list: faster than NumPy."""
        pairs = zip(state, self._mid_and_range_lists, strict=True)
        return [(value * width + mid) / 2.0 for value, (mid, width) in pairs]

    # --- Kinematics

    def forward_kinematics(self, configuration):
        """Joint angles in rad, (..., n) -> end-effector position in m in the world, (..., 3)."""
        position, rotation = self.frame_poses(configuration)[self.end_effector_frame]
        return position + rotation @ np.array(self.end_effector_position)

    def end_effector_pose(self, configuration):
        """Joint angles in rad, (..., n) -> pose of the end effector in the world, (..., 7).

        Position (m), then quaternion (xyzw), whose largest component is positive. The rotation is
        that of the link `end_effector_link`, as PyBullet's `getLinkState` reports it (the URDF's
        link frame): for the Panda that of `panda_hand`, whose z points from the wrist to the
        fingertips and whose y is the direction in which the fingers open.
        """
        position, rotation = self.frame_poses(configuration)[self.end_effector_frame]
        position = position + rotation @ np.array(self.end_effector_position)
        return np.concatenate(
            [position, quaternions(rotation @ self.end_effector_rotation)], axis=-1
        )

    @functools.cached_property
    def end_effector_rotation(self):
        """The end effector's axes (3, 3), columns, in the frame that moves it."""
        # PyBullet is asked: a field would change the fingerprints in files.
        client = p.connect(p.DIRECT)
        try:
            body = self.load(client, drawn=False)
            self.set_configuration(client, body, self.contact_free)
            quaternion = self.read_end_effector_pose(client, body)[3:]
        finally:
            p.disconnect(physicsClientId=client)
        _, axes = self.frame_poses(self.contact_free)[self.end_effector_frame]
        return axes.T @ matrix(quaternion)

    def frame_poses(self, configuration):
        """Joint angles in rad, (..., n) -> per frame position (..., 3), m, and axes (..., 3, 3).

        The axes are columns; a joint turns about the third, or moves along it.
        """
        configuration = np.asarray(configuration, dtype=np.float64)
        batch = configuration.shape[:-1]
        base = np.broadcast_to(np.array(self.base_position), (*batch, 3))
        base = base, np.broadcast_to(matrix(self.base_orientation), (*batch, 3, 3))
        poses = []
        for frame in self.frames:
            position, rotation = base if frame.parent < 0 else poses[frame.parent]
            position = position + rotation @ np.array(frame.position)
            value = configuration[..., frame.joint]
            if (frame.multiplier, frame.offset) != (1.0, 0.0):
                value = frame.multiplier * value + frame.offset
            placed = np.reshape(frame.rotation, (3, 3))
            if frame.is_prismatic:
                rotation = rotation @ placed
                position = position + value[..., None] * rotation[..., :, 2]
            else:
                c, s = np.cos(value)[..., None], np.sin(value)[..., None]
                x, y = placed[:, 0], placed[:, 1]
                z = np.broadcast_to(placed[:, 2], (*batch, 3))
                rotation = rotation @ np.stack([c * x + s * y, c * y - s * x, z], axis=-1)
            poses.append((position, rotation))
        return poses

    # --- The body in PyBullet

    def load(self, client, drawn=True):
        """Load the arm with its base fixed in its pose; returns its body id.

        Other joints stay where they are held. Without `drawn` it has no visual shapes, which take
        50 MB for the Panda.
        """
        flags = p.URDF_USE_SELF_COLLISION
        if not drawn:
            flags |= p.URDF_IGNORE_VISUAL_SHAPES
        with self._readable_urdf() as urdf:
            body = self._load(client, urdf, flags)
        links = range(-1, p.getNumJoints(body, physicsClientId=client))
        for a in links:
            for b in range(a + 1, links.stop):
                may_collide = int((a, b) in self.self_collision_pairs)
                p.setCollisionFilterPair(body, body, a, b, may_collide, physicsClientId=client)
        for index, least, most in self._ranges():
            lower, upper = p.getJointInfo(body, index, physicsClientId=client)[8:10]
            if lower <= upper and not lower <= least <= most <= upper:  # it would stop the joint
                p.changeDynamics(
                    body,
                    index,
                    jointLowerLimit=min(lower, least),
                    jointUpperLimit=max(upper, most),
                    physicsClientId=client,
                )
        if self.held_indices:
            p.setJointMotorControlArray(
                body,
                self.held_indices,
                p.POSITION_CONTROL,
                targetPositions=self.held_positions,
                forces=self.held_effort,
                physicsClientId=client,
            )
        return body

    def _ranges(self):
        """PyBullet's index of each movable joint, and its least and largest position."""
        yield from zip(self.held_indices, self.held_positions, self.held_positions, strict=True)
        yield from zip(self.joint_indices, self.lower.tolist(), self.upper.tolist(), strict=True)
        for index, joint, scale, offset in self.mimics:
            yield index, *sorted(scale * x[joint] + offset for x in (self.lower, self.upper))

    def load_coarse(self, client, colour):
        """Load the arm for images only: its collision shapes, in one colour. Returns its body id.

        `colour`: (red, green, blue, alpha) in [0, 1].
        """
        root = self.parsed_urdf()
        for link in root.iter("link"):
            for visual in link.findall("visual"):
                link.remove(visual)
            for collision in link.findall("collision"):
                visual = copy.deepcopy(collision)
                visual.tag = "visual"
                link.append(visual)
        with temporary_file(ElementTree.tostring(root, "unicode"), ".urdf") as urdf:
            body = self._load(client, urdf)
        for link in range(-1, p.getNumJoints(body, physicsClientId=client)):
            p.changeVisualShape(body, link, rgbaColor=colour, physicsClientId=client)
        return body

    def _load(self, client, urdf, flags=0):
        return p.loadURDF(
            urdf,
            self.base_position,
            self.base_orientation,
            useFixedBase=True,
            flags=flags,
            physicsClientId=client,
        )

    @functools.cached_property
    def bullet_names(self):
        """Names of joints and of links by PyBullet's index, two dicts; -1 is the base link."""
        client = p.connect(p.DIRECT)
        try:
            with self._readable_urdf() as urdf:
                body = self._load(client, urdf, p.URDF_IGNORE_VISUAL_SHAPES)
            number = p.getNumJoints(body, physicsClientId=client)
            infos = [p.getJointInfo(body, i, physicsClientId=client) for i in range(number)]
            base = p.getBodyInfo(body, physicsClientId=client)[0].decode()
        finally:
            p.disconnect(client)
        joints = {info[0]: info[1].decode() for info in infos}
        return joints, {-1: base} | {info[0]: info[12].decode() for info in infos}

    def parsed_urdf(self):
        """The URDF's XML element, with absolute paths of meshes, and with attached objects."""
        root = ElementTree.fromstring(self.xml or Path(self.urdf).read_text())
        for mesh in root.iter("mesh"):
            mesh.set("filename", resolve(mesh.get("filename"), self.urdf))
        if self.attached:
            # By name, because that module is built on this one.
            attached = importlib.import_module("roboarm_nmp.envs.robots.attached")
            root.extend(attached.elements(self.attached))
        return root

    def collision_elements(self, link):
        """The URDF's `collision` elements of a link, by its name."""
        links = self.parsed_urdf().findall("link")
        return next(one for one in links if one.get("name") == link).findall("collision")

    @contextlib.contextmanager
    def _readable_urdf(self):
        if self.attached:
            with temporary_file(
                ElementTree.tostring(self.parsed_urdf(), "unicode"), ".urdf"
            ) as urdf:
                yield urdf
        elif self.xml:
            with temporary_file(self.xml, ".urdf") as urdf:
                yield urdf
        else:
            yield self.urdf

    @functools.cached_property
    def _reset(self):
        """Indices of all movable joints, the values of those that are held, and zeros."""
        indices = (*self.joint_indices, *self.held_indices, *(mimic[0] for mimic in self.mimics))
        return indices, [[x] for x in self.held_positions], [[0.0]] * len(indices)

    @property
    def reset_indices(self):
        """PyBullet's indices of all movable joints."""
        return self._reset[0]

    def _followers(self, configuration):
        return [scale * configuration[joint] + offset for _, joint, scale, offset in self.mimics]

    def set_configuration(self, client, body, configuration):
        """Teleport the arm to joint angles (n, rad), at rest."""
        indices, held, at_rest = self._reset
        p.resetJointStatesMultiDof(
            body,
            indices,
            [[angle] for angle in configuration]
            + held
            + [[value] for value in self._followers(configuration)],
            at_rest,
            physicsClientId=client,
        )

    @functools.cached_property
    def _commanded(self):
        """Indices, largest forces and gains of the position controllers."""
        joints = [mimic[1] for mimic in self.mimics]
        effort = self.effort.tolist()
        return (
            (*self.joint_indices, *(mimic[0] for mimic in self.mimics)),
            effort + [effort[joint] for joint in joints],
            [*self.gains, *(self.gains[joint] for joint in joints)],
        )

    def command(self, client, body, configuration):
        """Set the targets of the position controllers: joint angles (list of n, rad)."""
        indices, forces, gains = self._commanded
        p.setJointMotorControlArray(
            body,
            indices,
            p.POSITION_CONTROL,
            targetPositions=[*configuration, *self._followers(configuration)],
            forces=forces,
            positionGains=gains,
            physicsClientId=client,
        )

    def read_end_effector(self, client, body):
        """The end effector's position, float64 (3,), m, as PyBullet has it."""
        return self._read_link(client, body)[0]

    def read_end_effector_pose(self, client, body):
        """The end effector's pose, float64 (7,), as of `end_effector_pose`, as PyBullet has it."""
        position, quaternion = self._read_link(client, body)
        return np.concatenate([position, signed(np.array(quaternion))])

    def _read_link(self, client, body):
        link = p.getLinkState(
            body, self.end_effector_link, computeForwardKinematics=1, physicsClientId=client
        )
        position = np.array(link[4])
        if any(self.end_effector_offset):
            position = position + matrix(link[5]) @ np.array(self.end_effector_offset)
        return position, link[5]


def _rounded(value):
    if isinstance(value, dict):
        return {name: _rounded(one) for name, one in value.items()}
    if isinstance(value, (tuple, list, np.ndarray)):
        return [_rounded(one) for one in value]
    return round(float(value), 9) + 0.0 if isinstance(value, float) else value  # no -0.0


def matrix(quaternion):
    """A quaternion (xyzw) of norm 1 as a rotation matrix (3, 3)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternions(rotations):
    """Rotation matrices (..., 3, 3) as quaternions (..., 4), xyzw; the largest number is positive.

    Its row of 4 q q^T is q times a positive number.
    """
    m = rotations
    x, y, z = (m[..., i, i] for i in range(3))
    xy, xz, yz = (m[..., i, j] + m[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    xw, yw, zw = (m[..., i, j] - m[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    rows = [
        [1 + x - y - z, xy, xz, xw],
        [xy, 1 - x + y - z, yz, yw],
        [xz, yz, 1 - x - y + z, zw],
        [xw, yw, zw, 1 + x + y + z],
    ]
    rows = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    largest = np.argmax(np.stack([rows[..., i, i] for i in range(4)], axis=-1), axis=-1)
    row = np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    return row / np.linalg.norm(row, axis=-1, keepdims=True)


def signed(quaternion):
    """A quaternion (4,) or its negative, the same rotation, whose largest number is positive."""
    return -quaternion if quaternion[np.argmax(np.abs(quaternion))] < 0.0 else quaternion


def rotation_angle(quaternion, other):
    """The angle between rotations, quaternions (..., 4) of norm 1: rad, (...), from 0 to pi.

    From the shorter one of two chords: accurate for small angles, unlike the arc cosine.
    """
    quaternion, other = (np.asarray(q, dtype=np.float64) for q in (quaternion, other))
    chords = (np.square(quaternion + sign * other).sum(-1) for sign in (1.0, -1.0))
    return 4.0 * np.arcsin(np.minimum(np.sqrt(np.minimum(*chords)) / 2.0, 1.0))


def resolve(filename, urdf, packages=None):
    """The absolute path of a mesh in a URDF, `package://name/...` or relative to the URDF.

    Args:
        filename: as the URDF has it.
        urdf: path of the URDF.
        packages: dict from names to folders. Any other name may be that of a folder above the
            URDF, or be missing.
    """
    folder = Path(urdf).absolute().parent
    for scheme in ("package://", "model://"):
        if filename.startswith(scheme):
            name, _, rest = filename.removeprefix(scheme).partition("/")
            if name in (packages or {}):
                return str(Path(packages[name]).absolute() / rest)
            above = [up for up in (folder, *folder.parents) if up.name == name]
            candidates = [*(up / rest for up in above), folder / name / rest, folder / rest]
            return str(next((path for path in candidates if path.exists()), candidates[0]))
    return str(folder / filename.removeprefix("file://"))


@contextlib.contextmanager
def temporary_file(text, suffix):
    """A context: the path of a file with this text."""
    with tempfile.NamedTemporaryFile("w", suffix=suffix) as file:
        file.write(text)
        file.flush()
        yield file.name
