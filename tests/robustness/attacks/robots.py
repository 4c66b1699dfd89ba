"""Robots: URDFs, their meshes and YAML files with one to three random changes."""

import copy
import functools
import random
from xml.etree import ElementTree

import numpy as np

from attacks.children import RAN, REFUSED
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots import control, self_collisions, urdf
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.untrusted import RobotError
from roboarm_nmp.envs.scenes.primitives import Scene

ODD = ("", "0", "-1", "nan", "inf", "1e300", "1e-300", "-1e6", "1e6", "1e5 1e5 1e5", "0 0 0", "1 2")
ODD += ("nan nan nan", "a", "base", "tool", "turn", "slide", "fixed", "continuous", "prismatic")
ODD += ("floating", "../../x.stl", "/dev/zero", "box.obj", "ball.stl", "file:///etc/passwd")
ODD += ("\u202e",)
INERTIAL = (
    '<inertial><origin xyz="0.02 0 0.1" rpy="0.3 0.2 0.1"/><mass value="1"/>'
    '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
)
SHAPE = '<{} name="s"><origin xyz="0 0 0.1" rpy="0 0 0"/><geometry>{}</geometry></{}>'
BOX = '<box size="0.05 0.05 0.1"/>'
GEOMETRIES = {
    "base": BOX,
    "one": '<mesh filename="box.obj" scale="1 1 1"/>',
    "two": '<cylinder radius="0.04" length="0.2"/>',
    "three": '<mesh filename="ball.stl"/>',
    "tool": '<sphere radius="0.03"/>',
    "finger": BOX,
}
JOINTS = (
    ("turn", "base", "one", "revolute", "0 0 1", ""),
    ("slide", "one", "two", "prismatic", "0 1 0", ""),
    ("roll", "two", "three", "revolute", "1 0 0", ""),
    ("weld", "three", "tool", "fixed", "0 0 1", ""),
    ("grip", "tool", "finger", "revolute", "0 0 1", '<mimic joint="roll" multiplier="0.5"/>'),
)
YAML = """urdf: arm.urdf
end_effector: tool
limits: {turn: [-1, 1]}
gain: 0.5
joints: [turn, roll]
"""


def arm_urdf():
    """The URDF before changes, an XML element."""
    links = [
        f'<link name="{name}">{INERTIAL}{SHAPE.format("visual", shape, "visual")}'
        f"{SHAPE.format('collision', shape, 'collision')}</link>"
        for name, shape in GEOMETRIES.items()
    ]
    joints = [
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 0.2" rpy="0 0 0"/><axis xyz="{axis}"/>{more}'
        '<limit lower="-1.5" upper="1.5" effort="50" velocity="2"/></joint>'
        for name, parent, child, kind, axis, more in JOINTS
    ]
    return ElementTree.fromstring(f'<robot name="arm">{"".join(links + joints)}</robot>')


def meshes():
    """Contents of the mesh files before changes, dict of bytes."""
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    lines = [f"v {x * 0.05} {y * 0.05} {z * 0.05}" for x, y, z in corners]
    triangles = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7)]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles]
    facets = np.zeros(len(triangles), [("numbers", "<f4", 12), ("attribute", "<u2")])
    facets["numbers"][:, 3:] = 0.05 * np.array(corners)[np.array(triangles)].reshape(-1, 9)
    count = np.array([len(triangles)], "<u4").tobytes()
    return {"box.obj": "\n".join(lines).encode(), "ball.stl": bytes(80) + count + facets.tobytes()}


def hostile(rng):
    """Contents of the files, dict of bytes, with one to three changes; `rng` is `Random`."""
    root, files, yaml = arm_urdf(), meshes(), YAML
    for _ in range(rng.randint(1, 3)):
        kind, elements = rng.random(), list(root.iter())
        if kind < 0.4:
            element = rng.choice([candidate for candidate in elements if candidate.attrib])
            element.set(rng.choice(sorted(element.attrib)), rng.choice(ODD))
        elif kind < 0.6:
            parent = rng.choice([candidate for candidate in elements if len(candidate)])
            child = rng.choice(list(parent))
            if rng.random() < 0.5:
                parent.remove(child)
            else:
                rng.choice(elements).append(copy.deepcopy(child))  # itself would be a cycle
        elif kind < 0.8:
            name = rng.choice(sorted(files))
            contents = bytearray(files[name])
            for _ in range(rng.choice((1, 1, 10))):
                contents[rng.randrange(len(contents))] = rng.randrange(256)
            files[name] = bytes(contents[: rng.choice((len(contents), rng.randrange(400)))])
        else:
            line = rng.choice(yaml.splitlines())
            key = line.partition(":")[0]
            value = rng.choice((*ODD, "[]", "{}", "[1]", "{turn: [nan, 1]}", "{a: 5}", "-.inf"))
            yaml = yaml.replace(line, f"{rng.choice((key, 'fixed', 'packages'))}: {value}")
    text = ElementTree.tostring(root)
    if rng.random() < 0.05:
        text = text[: rng.randrange(len(text))]
    return files | {"arm.urdf": text, "arm.yaml": yaml.encode()}


def attempts(seed, folder):
    """A function from a number to the outcome of loading such a robot and checking a state."""

    def attempt(number):
        # In the attempt's own process, so that robots elsewhere stay as they are.
        urdf.sample_pairs = functools.partial(self_collisions.sample_pairs, samples=200)
        control.NUM_POSES = 2
        here = folder / str(number)
        here.mkdir()
        for name, contents in hostile(random.Random(f"{seed} {number}")).items():
            (here / name).write_bytes(contents)
        try:
            robot = load_robot(here / "arm.yaml")
        except RobotError as error:
            assert "/" in str(error) and "\n" not in str(error)  # one line that names a file
            return REFUSED
        assert np.isfinite(robot.forward_kinematics(robot.contact_free)).all()
        CollisionChecker(Scene(robot=robot)).is_free(robot.normalise(robot.contact_free))
        return RAN

    return attempt
