"""An arm in PyBullet: loading, placing, commanding and reading it; and its URDF's XML."""

import contextlib
import copy
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from roboarm_nmp.envs.robots.attached_xml import attached_elements, obj_of_glb
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.rotations import matrix, signed
from roboarm_nmp.utils.bullet import load_urdf
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.utils.files import temporary_file


class Body:
    """An arm with its base fixed in its pose; held joints stay where they are held.

    Args:
        robot: the `Robot`.
        client: PyBullet's number of the physics engine.
        drawn: give it visual shapes, which take 50 MB for the Panda.

    Attributes:
        robot, client: as above.
        id: PyBullet's number of the body.
        movable: PyBullet's indices of all movable joints.
        gains: of the position controllers, of the n joints and then of those that mimic them.
    """

    def __init__(self, robot: Robot, client: int, drawn: bool = True):
        flags = p.URDF_USE_SELF_COLLISION
        if not drawn:
            flags |= p.URDF_IGNORE_VISUAL_SHAPES
        with _readable_urdf(robot) as urdf:
            self._load(robot, client, urdf, flags)
        links = range(-1, p.getNumJoints(self.id, physicsClientId=client))
        for a in links:
            for b in range(a + 1, links.stop):
                may_collide = int((a, b) in robot.self_collision_pairs)
                p.setCollisionFilterPair(
                    self.id, self.id, a, b, may_collide, physicsClientId=client
                )
        self._widen_limits()
        if robot.held_indices:
            p.setJointMotorControlArray(
                self.id,
                robot.held_indices,
                p.POSITION_CONTROL,
                targetPositions=robot.held_positions,
                forces=robot.held_effort,
                physicsClientId=client,
            )

    @classmethod
    def coarse(cls, robot: Robot, client: int, colour) -> "Body":
        """The arm for images only: its collision shapes, in one colour.

        `colour`: (red, green, blue, alpha) in [0, 1].
        """
        root = _without_glb(parsed_urdf(robot))
        for link in root.iter("link"):
            for visual in link.findall("visual"):
                link.remove(visual)
            for collision in link.findall("collision"):
                visual = copy.deepcopy(collision)
                visual.tag = "visual"
                link.append(visual)
        body = cls.__new__(cls)
        with temporary_file(ElementTree.tostring(root, "unicode"), ".urdf") as urdf:
            body._load(robot, client, urdf)
        for link in range(-1, p.getNumJoints(body.id, physicsClientId=client)):
            p.changeVisualShape(body.id, link, rgbaColor=colour, physicsClientId=client)
        return body

    def _load(self, robot, client, urdf, flags=0):
        self.robot, self.client = robot, client
        self.id = load_urdf(
            urdf,
            robot.base_position,
            robot.base_orientation,
            useFixedBase=True,
            flags=flags,
            physicsClientId=client,
        )
        followers = [index for index, _, _, _ in robot.mimics]
        leaders = [joint for _, joint, _, _ in robot.mimics]
        self.movable = (*robot.joint_indices, *robot.held_indices, *followers)
        self._held = [[position] for position in robot.held_positions]
        self._at_rest = [[0.0]] * len(self.movable)
        self._commanded = (*robot.joint_indices, *followers)
        self._forces = [*robot.effort.tolist(), *(float(robot.effort[joint]) for joint in leaders)]
        self.gains = [*robot.gains, *(robot.gains[joint] for joint in leaders)]
        self._has_offset = any(robot.end_effector_offset)

    def _widen_limits(self):
        """Widen those limits of joints in PyBullet that would stop one inside the robot's range."""
        for index, least, most in _ranges(self.robot):
            lower, upper = p.getJointInfo(self.id, index, physicsClientId=self.client)[8:10]
            if lower <= upper and not lower <= least <= most <= upper:
                p.changeDynamics(
                    self.id,
                    index,
                    jointLowerLimit=min(lower, least),
                    jointUpperLimit=max(upper, most),
                    physicsClientId=self.client,
                )

    def _with_followers(self, configuration):
        """The configuration as a list, and where the joints are that mimic one of its joints."""
        positions = list(configuration)
        for _, joint, scale, offset in self.robot.mimics:
            positions.append(scale * configuration[joint] + offset)
        return positions

    def set_configuration(self, configuration: np.ndarray | Sequence[float]) -> None:
        """Teleport the arm to joint angles (n, rad), at rest."""
        positions = [[position] for position in self._with_followers(configuration)]
        joints = self.robot.num_joints
        p.resetJointStatesMultiDof(
            self.id,
            self.movable,
            positions[:joints] + self._held + positions[joints:],
            self._at_rest,
            physicsClientId=self.client,
        )

    def command(self, configuration: Sequence[float]) -> None:
        """Set the targets of the position controllers: joint angles (n, rad)."""
        p.setJointMotorControlArray(
            self.id,
            self._commanded,
            p.POSITION_CONTROL,
            targetPositions=self._with_followers(configuration),
            forces=self._forces,
            positionGains=self.gains,
            physicsClientId=self.client,
        )

    def read_end_effector(self) -> np.ndarray:
        """The end effector's position, float64 (3,), m."""
        return self._read_end_effector()[0]

    def read_end_effector_pose(self) -> np.ndarray:
        """The end effector's pose, float64 (7,), as of `Robot.end_effector_pose`."""
        position, quaternion = self._read_end_effector()
        return np.concatenate([position, signed(np.array(quaternion))])

    def _read_end_effector(self):
        link = p.getLinkState(
            self.id,
            self.robot.end_effector_link,
            computeForwardKinematics=1,
            physicsClientId=self.client,
        )
        position = np.array(link[4])
        if self._has_offset:
            position = position + matrix(link[5]) @ np.array(self.robot.end_effector_offset)
        return position, link[5]


@contextlib.contextmanager
def body_alone(robot: Robot) -> Iterator[Body]:
    """A context: the arm in a physics engine of its own, without visual shapes."""
    client = p.connect(p.DIRECT)
    try:
        yield Body(robot, client, drawn=False)
    finally:
        p.disconnect(physicsClientId=client)


def _ranges(robot):
    """PyBullet's index of each movable joint, and its least and largest position."""
    yield from zip(robot.held_indices, robot.held_positions, robot.held_positions, strict=True)
    yield from zip(robot.joint_indices, robot.lower.tolist(), robot.upper.tolist(), strict=True)
    for index, joint, scale, offset in robot.mimics:
        yield (
            index,
            *sorted(scale * limits[joint] + offset for limits in (robot.lower, robot.upper)),
        )


def end_effector_rotation(robot: Robot) -> np.ndarray:
    """`Robot.end_effector_rotation` as PyBullet has it, (3, 3)."""
    with body_alone(robot) as body:
        body.set_configuration(robot.contact_free)
        quaternion = body.read_end_effector_pose()[3:]
    _, axes = robot.frame_poses(robot.contact_free)[robot.end_effector_frame]
    return axes.T @ matrix(quaternion)


def names_in_bullet(robot: Robot) -> tuple[tuple[str, ...], dict[int, str]]:
    """`Robot.bullet_joint_names` and `Robot.link_names` as PyBullet has them."""
    client = p.connect(p.DIRECT)
    try:
        with _readable_urdf(robot) as urdf:
            body = load_urdf(urdf, flags=p.URDF_IGNORE_VISUAL_SHAPES, physicsClientId=client)
        number = p.getNumJoints(body, physicsClientId=client)
        infos = [p.getJointInfo(body, i, physicsClientId=client) for i in range(number)]
        links = {-1: p.getBodyInfo(body, physicsClientId=client)[0].decode()}
    finally:
        p.disconnect(physicsClientId=client)
    for info in infos:
        links[info[0]] = info[12].decode()
    return tuple(info[1].decode() for info in infos), links


# --- The URDF's XML


def parsed_urdf(robot: Robot) -> ElementTree.Element:
    """The URDF's XML element, with absolute paths of meshes, and with attached objects."""
    root = ElementTree.fromstring(robot.xml or Path(robot.urdf).read_text())
    for mesh in root.iter("mesh"):
        mesh.set("filename", resolve(mesh.get("filename", ""), robot.urdf))
    root.extend(attached_elements(robot.attached))
    return root


def collision_elements(robot: Robot, link: str) -> list[ElementTree.Element]:
    """The URDF's `collision` elements of a link, by its name, as PyBullet reads them."""
    for element in parsed_urdf(robot).findall("link"):
        if element.get("name") == link:
            return _without_glb(element).findall("collision")
    raise ValueError(f"{robot.name} has no link {link!r}")


@contextlib.contextmanager
def _readable_urdf(robot):
    """A context: the path of a URDF that PyBullet can read."""
    if not (robot.attached or robot.xml):
        yield robot.urdf
        return
    text = robot.xml
    if robot.attached:
        text = ElementTree.tostring(parsed_urdf(robot), "unicode")
    with temporary_file(bullets_xml(text), ".urdf") as urdf:
        yield urdf


def bullets_xml(text: str) -> str:
    """The text of a URDF with absolute paths, with OBJ files in the place of GLB files."""
    if ".glb" not in text.lower():
        return text
    return ElementTree.tostring(_without_glb(ElementTree.fromstring(text)), "unicode")


def _without_glb(element):
    for mesh in element.iter("mesh"):
        path = mesh.get("filename", "")
        if path.lower().endswith(".glb"):
            mesh.set("filename", obj_of_glb(path))
    return element


def resolve(
    filename: str, urdf: str | Path, packages: Mapping[str, str | Path] | None = None
) -> str:
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
            if packages and name in packages:
                return str(Path(packages[name]).absolute() / rest)
            above = [up for up in (folder, *folder.parents) if up.name == name]
            candidates = [*(up / rest for up in above), folder / name / rest, folder / rest]
            return str(next((path for path in candidates if path.exists()), candidates[0]))
    if filename.startswith("file://"):
        filename = unquote(filename.removeprefix("file://"))
    return str(folder / filename)
