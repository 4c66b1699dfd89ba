"""What an arm is: its joints, limits, kinematics, and the links that may collide.

A configuration `c` is an arm's n joint angles in rad (m for a prismatic joint); `s` is the same in
the normalised configuration space [-1, 1]^n (paper, appendix "Extended NMP goal-conditioned MDP
description"). `PANDA` (`envs.robots.panda`) is the paper's arm, and
`envs.robots.urdf.robot_from_urdf` makes others. `envs.robots.variants` holds a gripper elsewhere or
attaches objects, and `envs.robots.body.Body` is the arm in PyBullet.
"""

import functools
import hashlib
import json
from collections.abc import Collection
from dataclasses import dataclass, fields
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from roboarm_nmp.envs.robots.rotations import matrix, quaternions

DEFAULT_VELOCITY = 1.0
"""rad/s (or m/s), of joints without a limit, as in MoveIt."""
# Fields that do not change what an arm is. Limits of trajectories are handled in `fingerprint`.
NOT_IN_FINGERPRINT = (
    *("urdf", "source", "xml", "described", "datasheet_lower", "datasheet_upper", "urdf_velocity"),
    *("bullet_joint_names", "link_names", "end_effector_rotation"),
)


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
    position: tuple[float, ...]
    rotation: tuple[float, ...]
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
    """An arm: its joints, limits, links and end effector. It's a value: you can compare arms.

    Attributes:
        name: for messages and files.
        urdf: path of the URDF.
        joint_names, joint_indices: the n actuated joints from base to end effector: their names in
            the URDF, and their indices in PyBullet.
        bullet_joint_names: names of all joints, in PyBullet's order.
        link_names: names of all links, by PyBullet's index; -1 is the base.
        lower, upper: position limits (n,), rad or m.
        velocity, acceleration, jerk: limits (n,), rad/s, rad/s^2, rad/s^3 (or m); None if unknown.
        effort: limits of the torques (n,), N m (or forces, N).
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
        end_effector_rotation: the end effector's axes, columns of a matrix (3, 3), in that frame,
            as PyBullet has them.
        gains: of the position controllers (n,).
        contact_free: a configuration without contacts (n,).
        observed_pose: the configuration (n,) in which sensors observe a scene: always the same, so
            that an encoded scene depends on the scene alone.
        base_position, base_orientation: pose of the base in the world, m and quaternion (xyzw).
        mesh_digest: SHA-256 (hex) of the URDF's collision shapes; empty for `PANDA`.
        source: the file that names the robot, for scene files; empty for `PANDA`.
        xml: the URDF's text, with absolute paths of meshes; empty if PyBullet can read the file.
        described: of the arms in `envs.robots.variants`: the arm with its held joints where its
            description has them, and without objects; None for that arm itself.
        datasheet_lower, datasheet_upper: position limits (n,) of the manufacturer's datasheet, rad
            or m, where they are others than the URDF's; None otherwise.
        attached: the `envs.scenes.primitives.Attached` objects, whose links are the last of
            `links`.
        carriers: PyBullet's index of the link whose row of link distances each of them shares.
        urdf_velocity: limits of the velocity (n,) in the URDF, None if it has none, or for `PANDA`.
        acceleration_steps: environment steps in which a plan's sub-goals reach full speed after a
            waypoint, and slow down before the next.
    """

    name: str
    urdf: str
    joint_names: tuple[str, ...]
    joint_indices: tuple[int, ...]
    bullet_joint_names: tuple[str, ...]
    link_names: dict[int, str]
    lower: np.ndarray
    upper: np.ndarray
    velocity: np.ndarray | None
    acceleration: np.ndarray | None
    jerk: np.ndarray | None
    effort: np.ndarray
    held_indices: tuple[int, ...]
    held_positions: tuple[float, ...]
    held_effort: tuple[float, ...]
    mimics: tuple[tuple[int, int, float, float], ...]
    frames: tuple[Frame, ...]
    links: tuple[Link, ...]
    self_collision_pairs: tuple[tuple[int, int], ...]
    end_effector_link: int
    end_effector_offset: tuple[float, ...]
    end_effector_frame: int
    end_effector_position: tuple[float, ...]
    end_effector_rotation: np.ndarray
    gains: tuple[float, ...]
    contact_free: tuple[float, ...]
    observed_pose: tuple[float, ...]
    base_position: tuple[float, ...] = (0.0, 0.0, 0.0)
    base_orientation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    mesh_digest: str = ""
    source: str = ""
    xml: str = ""
    described: "Robot | None" = None
    datasheet_lower: np.ndarray | None = None
    datasheet_upper: np.ndarray | None = None
    attached: tuple = ()
    carriers: tuple[int, ...] = ()
    urdf_velocity: list[float] | None = None
    acceleration_steps: int = 1

    def __post_init__(self):
        names = ("lower", "upper", "velocity", "acceleration", "jerk", "effort")
        for name in (*names, "datasheet_lower", "datasheet_upper", "end_effector_rotation"):
            if getattr(self, name) is not None:
                array = np.array(getattr(self, name), dtype=np.float64)
                array.flags.writeable = False
                object.__setattr__(self, name, array)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Robot) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    def __repr__(self) -> str:
        return f"Robot({self.name!r}, {self.fingerprint[:12]})"

    @functools.cached_property
    def fingerprint(self) -> str:
        """SHA-256 (hex) of the description: all that kinematics and collisions depend on.

        Numbers are rounded to 1e-9: the last bits of sines and cosines differ between machines.
        """
        content = {f.name: getattr(self, f.name) for f in fields(self)}
        for name in NOT_IN_FINGERPRINT:
            content.pop(name)
        if self.xml:  # limits of a robot's file concern trajectories alone: files stay valid
            content["velocity"] = self.urdf_velocity
            content["acceleration"] = None
            content["jerk"] = None
        content["attached"] = [attached.described() for attached in self.attached]
        if not self.attached:
            del content["attached"], content["carriers"]
        if self.acceleration_steps == 1:
            del content["acceleration_steps"]
        text = json.dumps(_rounded(content), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    # --- Held joints and attached objects

    @property
    def arm(self) -> "Robot":
        """The arm as its description has it, without objects: what files name."""
        return self.described or self

    def same_arm(self, other: "Robot") -> bool:
        """Whether `other` is this arm, possibly with other held joints or attached objects."""
        return self.arm == other.arm

    @property
    def held(self) -> dict[str, float]:
        """The positions of the held joints, rad or m, by name."""
        names = [self.bullet_joint_names[index] for index in self.held_indices]
        return dict(zip(names, self.held_positions, strict=True))

    @functools.cached_property
    def hand_links(self) -> tuple[str, ...]:
        """Names of the hand's links: those that move with the end effector and may collide.

        The link that the last joint moves is among them only if there are no others.
        """
        frame = self.end_effector_frame
        links = [link.index for link in self._own_links if link.frame == frame >= 0]
        last = self.joint_indices[self.frames[frame].joint]
        hand = [link for link in links if link != last] or links
        return tuple(self.link_names[link] for link in hand)

    def links_called(self, names: Collection[str] | bool) -> frozenset[int]:
        """PyBullet's indices of links by their names, and of the objects attached to them.

        `names`: a sequence, or True for the `hand_links`. Raises ValueError: there is no such link.
        """
        if not names:
            return frozenset()
        index = {name: link for link, name in self.link_names.items()}
        chosen = self.hand_links if isinstance(names, bool) else names
        for name in chosen:
            if name not in index:
                raise ValueError(f"{self.name} has no link {name!r}")
        links = {index[name] for name in chosen}
        carried = {link.index for link, carrier in self._attached_links() if carrier in links}
        return frozenset(links | carried)

    def _attached_links(self):
        """Pairs of an attached object's `Link` and PyBullet's index of its carrier."""
        return zip(self.links[len(self._own_links) :], self.carriers, strict=True)

    # --- Sizes and normalisation

    @property
    def num_joints(self) -> int:
        """n."""
        return len(self.joint_indices)

    def position_limits(
        self, limits: Literal["urdf", "datasheet"] = "urdf"
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper position limits, two arrays (n,), rad or m.

        `limits` is "urdf" or "datasheet". Raises ValueError if it's something else, or if the arm
        has no limits of a datasheet.
        """
        if limits == "urdf":
            return self.lower, self.upper
        if limits != "datasheet":
            raise ValueError(f"limits must be 'urdf' or 'datasheet', got {limits!r}")
        if self.datasheet_lower is None or self.datasheet_upper is None:
            raise ValueError(f"{self.name} has no position limits of a datasheet")
        return self.datasheet_lower, self.datasheet_upper

    def is_within(
        self, configuration: np.ndarray, limits: Literal["urdf", "datasheet"] = "urdf"
    ) -> np.ndarray | np.bool_:
        """Whether joint angles (..., n) are inside the `position_limits`: bool (...)."""
        lower, upper = self.position_limits(limits)
        return ((configuration >= lower) & (configuration <= upper)).all(-1)

    @property
    def collision_links(self) -> tuple[int, ...]:
        """PyBullet's indices of the moving links that may collide: the rows of link distances."""
        return tuple(link.index for link in self._own_links if link.frame >= 0)

    @property
    def _own_links(self):
        """`links` without those of attached objects."""
        return self.links[: len(self.links) - len(self.attached)]

    @functools.cached_property
    def link_rows(self) -> dict[int, int]:
        """The row of link distances of each moving link that may collide: dict from its index.

        An attached object has the row of the link that carries it.
        """
        rows = {link: row for row, link in enumerate(self.collision_links)}
        for link, carrier in self._attached_links():
            rows[link.index] = rows[carrier]
        return rows

    @property
    def link_distances_shape(self) -> tuple[int, int]:
        """The shape of link distances: per link, its signed distance (m) and the gradient of it."""
        return len(self.collision_links), 1 + self.num_joints

    @functools.cached_property
    def reach(self) -> float:
        """The end effector's largest distance (m) from the base in 10,000 random configurations."""
        rng = np.random.default_rng(0)
        configurations = rng.uniform(self.lower, self.upper, (10_000, self.num_joints))
        positions = self.forward_kinematics(configurations) - np.array(self.base_position)
        return float(np.linalg.norm(positions, axis=1).max())

    @functools.cached_property
    def _middle_and_half_range(self):
        return (self.upper + self.lower) / 2.0, (self.upper - self.lower) / 2.0

    @functools.cached_property
    def _middle_and_half_range_of_joints(self):
        middle, half_range = self._middle_and_half_range
        return list(zip(middle.tolist(), half_range.tolist(), strict=True))

    def normalise(self, configuration: ArrayLike) -> np.ndarray:
        """Joint angles in rad, (..., n) -> normalised configuration in [-1, 1], same shape."""
        middle, half_range = self._middle_and_half_range
        return (np.asarray(configuration) - middle) / half_range

    def denormalise(self, state: ArrayLike) -> np.ndarray:
        """Normalised configuration, (..., n) -> joint angles in rad, same shape."""
        middle, half_range = self._middle_and_half_range
        return np.asarray(state) * half_range + middle

    def denormalise_one(self, state) -> list[float]:
        """`denormalise` of one configuration, n floats, as a list: faster than NumPy."""
        joints = zip(state, self._middle_and_half_range_of_joints, strict=True)
        return [value * half_range + middle for value, (middle, half_range) in joints]

    # --- Kinematics

    def forward_kinematics(self, configuration: ArrayLike) -> np.ndarray:
        """Joint angles in rad, (..., n) -> end-effector position in m in the world, (..., 3)."""
        position, rotation = self.frame_poses(configuration)[self.end_effector_frame]
        return position + rotation @ np.array(self.end_effector_position)

    def end_effector_pose(self, configuration: ArrayLike) -> np.ndarray:
        """Joint angles in rad, (..., n) -> pose of the end effector in the world, (..., 7).

        Position (m), then quaternion (xyzw), whose largest component is positive. The rotation is
        that of the link `end_effector_link`, as PyBullet's `getLinkState` reports it (the URDF's
        link frame): for the Panda that of `panda_hand`, whose z points from the wrist to the
        fingertips and whose y is the direction in which the fingers open.
        """
        position, rotation = self.frame_poses(configuration)[self.end_effector_frame]
        position = position + rotation @ np.array(self.end_effector_position)
        quaternion = quaternions(rotation @ self.end_effector_rotation)
        return np.concatenate([position, quaternion], axis=-1)

    def frame_poses(self, configuration: ArrayLike) -> list[tuple[np.ndarray, np.ndarray]]:
        """Joint angles in rad, (..., n) -> per frame position (..., 3), m, and axes (..., 3, 3).

        The axes are columns; a joint turns about the third, or moves along it.
        """
        configuration = np.asarray(configuration, dtype=np.float64)
        batch = configuration.shape[:-1]
        base_position = np.broadcast_to(np.array(self.base_position), (*batch, 3))
        base_rotation = np.broadcast_to(matrix(self.base_orientation), (*batch, 3, 3))
        poses = []
        for frame in self.frames:
            position, rotation = base_position, base_rotation
            if frame.parent >= 0:
                position, rotation = poses[frame.parent]
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


def _rounded(value):
    if isinstance(value, dict):
        return {name: _rounded(entry) for name, entry in value.items()}
    if isinstance(value, (tuple, list, np.ndarray)):
        return [_rounded(entry) for entry in value]
    return round(float(value), 9) + 0.0 if isinstance(value, float) else value  # no -0.0
