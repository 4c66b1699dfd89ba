"""Robots from URDFs: what they contain, compared with PyBullet, and what is refused."""

import dataclasses
import itertools
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
import trimesh

import roboarm_nmp.envs.robots.urdf
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.collision.hulls import arm_hulls, link_shapes
from roboarm_nmp.envs.robots.body import Body
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.urdf import RobotError, robot_from_urdf
from roboarm_nmp.envs.robots.variants import with_held
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene, Sphere
from roboarm_nmp.envs.world import World
from roboarm_nmp.utils.bullet import pybullet as p

INERTIAL = (
    '<inertial><origin xyz="0.02 0 0.1" rpy="0.3 0.2 0.1"/><mass value="1"/>'
    '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def link(name, *shapes):
    """A URDF link with shapes, each (xyz, rpy, geometry)."""
    collisions = "".join(
        f'<collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{geometry}</geometry></collision>'
        for xyz, rpy, geometry in shapes
    )
    return f'<link name="{name}">{INERTIAL}{collisions}</link>'


def joint(name, parent, child, kind="revolute", axis="0 0 1", xyz="0 0 0.3", more=None):
    """A URDF joint; `more` replaces its limit."""
    limit = '<limit lower="-1.5" upper="1.5" effort="50" velocity="2"/>' if more is None else more
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="0.2 0.1 -0.4"/><axis xyz="{axis}"/>{limit}</joint>'
    )


def chain(number):
    """Links one after another, with joints between them."""
    joints = (joint(f"j{i}", f"l{i - 1}", f"l{i}") for i in range(1, number))
    return "".join([*(link(f"l{i}", BAR) for i in range(number)), *joints])


BAR = "0 0 0.15", "0.1 0 0", '<box size="0.05 0.06 0.2"/>'
# A box and a cylinder, a capsule and a sphere; a sliding joint, one that mimics the first, a finger
# that is held.
ARM = "".join(
    [
        link("base", BAR, ("0.1 0 0", "0 0 0.5", '<cylinder radius="0.05" length="0.1"/>')),
        link("one", BAR, ("0 0.05 0.1", "1 0 0", '<cylinder radius="0.03" length="0.2"/>')),
        link("two", ("0 0 0.1", "0.4 0 0", '<capsule radius="0.03" length="0.1"/>')),
        link("three", ("0 0.02 0.1", "0 0 0", '<sphere radius="0.05"/>'), BAR),
        link("four", BAR),
        link("tool"),
        link("finger", ("0 0 0.02", "0 0 0", '<box size="0.01 0.02 0.05"/>')),
        joint("turn", "base", "one", axis="0 2 0"),
        joint("slide", "one", "two", "prismatic", "1 1 0"),
        joint("roll", "two", "three", axis="0 0 1"),
        joint(
            "follow",
            "three",
            "four",
            axis="1 0 0",
            more='<limit lower="-3" upper="3" effort="50" velocity="2"/>'
            '<mimic joint="turn" multiplier="-0.5" offset="0.2"/>',
        ),
        joint("weld", "four", "tool", "fixed"),
        joint("grip", "four", "finger", "prismatic", "0 1 0", "0 0 0.3"),
    ]
)


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    """A function from URDF elements to a file."""
    folder, numbers = tmp_path_factory.mktemp("urdf"), itertools.count()

    def write(elements, name="arm"):
        path = folder / f"{next(numbers)}.urdf"
        path.write_text(f'<robot name="{name}">{elements}</robot>')
        return path

    return write


@pytest.fixture(scope="module")
def arm(urdf):
    return robot_from_urdf(urdf(ARM), end_effector="tool", fixed={"grip": 0.02})


def test_joints_limits_and_held_joints_are_those_of_the_file(arm):
    assert arm.joint_names == ("turn", "slide", "roll")
    assert arm.lower.tolist() == [-1.5] * 3 and arm.upper.tolist() == [1.5] * 3
    assert arm.effort.tolist() == [50] * 3 and arm.velocity.tolist() == [2] * 3
    assert arm.held_positions == (0.02,)
    [(_, leader, multiplier, offset)] = arm.mimics
    assert (leader, multiplier, offset) == (0, -0.5, 0.2)


def test_joint_without_a_velocity_limit_does_not_drop_the_limits_of_others(urdf):
    elements = ARM.replace('velocity="2"', 'velocity="0"', 1)
    with pytest.warns(UserWarning, match="no positive velocity limit of .*: 1 rad/s"):
        robot = robot_from_urdf(urdf(elements), end_effector="tool", fixed={"grip": 0.02})
    assert sorted(robot.velocity.tolist()) == [1, 2, 2]


def test_forward_kinematics_agree_with_pybullet(arm):
    world = World(Scene(table=None, floor=None, robot=arm), drawn=False)
    for configuration in np.random.default_rng(0).uniform(-1.5, 1.5, (50, 3)):
        world.arm.set_configuration(configuration.tolist())
        position = world.read_arm()[2]
        np.testing.assert_allclose(arm.forward_kinematics(configuration), position, atol=1e-6)
    world.close()


def scene_of(rng, robot):
    def place():
        return tuple(rng.uniform(-0.5, 0.5, 3).tolist())

    obstacles = [Box(place(), tuple(rng.uniform(0.05, 0.4, 3).tolist())) for _ in range(3)]
    obstacles += [Cylinder(place(), 0.1, 0.3), Sphere(place(), 0.15)]
    return Scene(tuple(obstacles), robot=robot)


@pytest.mark.parametrize("name", ["of the test", "iiwa", "xarm6"])
def test_compiled_checks_agree_with_pybullet(arm, name):
    files = {"iiwa": "kuka_iiwa/model.urdf", "xarm6": "xarm/xarm6_robot.urdf"}
    robot = arm if name not in files else load_robot(pybullet_file(files[name]))
    rng, free = np.random.default_rng(1), 0
    for _ in range(5):
        scene = scene_of(rng, robot)
        world, checker = World(scene, drawn=False), CollisionChecker(scene)
        states = rng.uniform(-1, 1, (400, robot.num_joints))
        theirs = [not world.in_collision(robot.denormalise(s).tolist()) for s in states]
        world.close()
        np.testing.assert_array_equal(checker.is_free(states), theirs)
        for margin in (0.0005, 0.01):
            far = checker.signed_distances(states).distance.min(-1) >= margin
            np.testing.assert_array_equal(checker.is_free(states, margin), far)
        free += np.mean(theirs)
    assert 0.5 < free < 4.5


def pybullet_file(name):
    import pybullet_data

    return f"{pybullet_data.getDataPath()}/{name}"


@pytest.mark.parametrize("self_collisions", [False, True])
def test_gradients_of_link_distances_agree_with_differences(arm, self_collisions):
    """Also of a sliding joint, and of one that another joint follows."""
    rng = np.random.default_rng(2)
    checker = CollisionChecker(scene_of(rng, arm))
    states = rng.uniform(-0.9, 0.9, (40, 3))
    found = checker.signed_distances(states, self_collisions)
    step, agree = 1e-5, []
    for number in range(3):
        ahead, behind = states.copy(), states.copy()
        ahead[:, number] += step
        behind[:, number] -= step
        ends = [checker.signed_distances(s, self_collisions).distance for s in (ahead, behind)]
        slope = (ends[0] - ends[1]) / (2 * step)
        agree.append(np.abs(slope - found.gradient[..., number]) < 1e-3)
    # Elsewhere the nearest obstacle changes between the two ends.
    assert np.mean(agree) > 0.97


def test_arm_whose_held_joint_moves_is_as_if_described_so(urdf):
    options = {"end_effector": "tool", "gain": 0.6}
    expected = robot_from_urdf(urdf(ARM), fixed={"grip": 0.02}, **options)
    moved = with_held(robot_from_urdf(urdf(ARM), fixed={"grip": 0.01}, **options), {"grip": 0.02})
    assert moved.held_positions == expected.held_positions == (0.02,)
    for one, other in zip(moved.links, expected.links, strict=True):
        for placement, expected_placement in zip(one.placements, other.placements, strict=True):
            for array, expected_array in zip(placement, expected_placement, strict=True):
                np.testing.assert_allclose(array, expected_array, atol=1e-12)
    arm = robot_from_urdf(urdf(ARM), joints=["turn", "roll"], **options)
    with pytest.raises(ValueError, match="slide carries joints that move"):
        with_held(arm, {"slide": 0.1})


def test_panda_from_its_urdf_is_the_panda():
    robot = robot_from_urdf(
        PANDA.urdf, end_effector="panda_grasptarget", fixed={"panda_finger_joint1": 0.04}
    )
    configurations = np.random.default_rng(0).uniform(PANDA.lower, PANDA.upper, (100, 7))
    np.testing.assert_allclose(
        robot.forward_kinematics(configurations),
        PANDA.forward_kinematics(configurations),
        atol=1e-9,
    )
    assert set(robot.self_collision_pairs) <= set(PANDA.self_collision_pairs)
    assert robot.collision_links == PANDA.collision_links
    for ours, theirs in zip(arm_hulls(robot)[1], arm_hulls(PANDA)[1], strict=True):
        np.testing.assert_allclose(ours[4:], theirs[4:], atol=1e-6)  # radius, edges, rounding, row


def test_robots_are_values(arm):
    again = pickle.loads(pickle.dumps(arm))
    assert again == arm and hash(again) == hash(arm) and arm != PANDA
    assert dataclasses.replace(arm, lower=[-1.0] * 3) != arm
    rounded = dataclasses.replace(arm, lower=arm.lower * (1 + 1e-15))  # as on another machine
    assert (rounded.lower != arm.lower).any() and rounded == arm and hash(rounded) == hash(arm)
    assert dataclasses.replace(arm, lower=arm.lower * (1 + 1e-6)) != arm
    with pytest.raises(ValueError):
        arm.lower[0] = 0


def test_srdf_disables_pairs(tmp_path):
    path, srdf = pybullet_file("kuka_iiwa/model.urdf"), tmp_path / "iiwa.srdf"
    disabled = "<robot name='iiwa'><disable_collisions link1='{}' link2='lbr_iiwa_link_0'/></robot>"
    srdf.write_text(disabled.format("lbr_iiwa_link_6"))
    robot, less = load_robot(path), robot_from_urdf(path, srdf=srdf)
    assert set(robot.self_collision_pairs) - set(less.self_collision_pairs) == {(-1, 5)}
    srdf.write_text(disabled.format("hand"))
    with pytest.raises(ValueError, match="the URDF has no link 'hand'"):
        robot_from_urdf(path, srdf=srdf)


TWO = link("a", BAR) + link("b", BAR)
LOOP = TWO + link("c") + joint("1", "a", "b") + joint("2", "b", "c") + joint("3", "c", "b")
MESH = "0 0 0", "0 0 0", '<mesh filename="{}"/>'


@pytest.mark.parametrize(
    ("elements", "reason"),
    [
        (TWO + joint("1", "a", "b", "fixed"), "no joint can move"),
        (LOOP, "kinematic loop"),
        (TWO + joint("1", "a", "c"), "no child link 'c'"),
        (TWO + joint("1", "a", "b", "continuous", more=""), "has no limits: give some"),
        (TWO + joint("1", "a", "b", axis="0 0 0"), "has no direction"),
        (TWO + joint("1", "a", "b", more='<mimic joint="9"/>'), "mimics '9'"),
        (link("a", (*MESH[:2], MESH[2].format("missing.stl"))), "no such file"),
        (link("a", (*MESH[:2], MESH[2].format("package://x/m.stl"))), "its folder in `packages`"),
        (link("a", (*MESH[:2], MESH[2].format("/etc/passwd"))), "outside of"),
        ("<link name='a'>" * 300_000, "nested more than"),
        (chain(110), "109 movable joints, at most 100"),  # PyBullet has no states of more
    ],
)
def test_unusable_urdf_is_rejected_with_its_reason(urdf, elements, reason):
    path = urdf(elements)
    with pytest.raises(RobotError, match=reason) as error:
        robot_from_urdf(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("contents", "reason"),
    [
        (b"", "malformed XML"),
        (b'<!DOCTYPE r [<!ENTITY a "aaaa">]><robot name="&a;"/>', "entities"),
        (b"<robot name='a'>" + b" " * 5_000_000 + b"</robot>", "more than 5 MB"),
        (b'<robot name="x" xmlns:xacro="u"><xacro:macro name="m"/></robot>', "run `xacro`"),
    ],
)
def test_malformed_file_is_rejected_with_its_reason(tmp_path, contents, reason):
    path = tmp_path / "bad.urdf"
    path.write_bytes(contents)
    with pytest.raises(RobotError, match=reason):
        robot_from_urdf(path)


@pytest.mark.parametrize(
    ("face", "kind"),
    [("1 2 9", "visual"), ("1/1/1 2/2/2 9/3/3", "collision"), ("1 2 x", "collision")],
)
def test_face_with_a_missing_vertex_is_rejected(urdf, face, kind):
    path = urdf(TWO + joint("1", "a", "b") + link("c", (*MESH[:2], MESH[2].format("x.obj"))))
    text = path.read_text().replace("</robot>", joint("2", "b", "c") + "</robot>")
    path.write_text(text.replace("collision", kind))
    tetrahedron = (
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1/1 3/2 4/3\nf -1 -2 -3\n"
    )
    (path.parent / "x.obj").write_text(f"{tetrahedron}f {face}\n")
    with pytest.raises(RobotError, match="has a vertex that is not there"):
        robot_from_urdf(path)
    (path.parent / "x.obj").write_text(tetrahedron)
    assert robot_from_urdf(path).num_joints == 2


def test_arm_of_glb_meshes_is_that_of_the_same_obj_meshes(urdf):
    path = urdf(TWO + joint("1", "a", "b") + link("c", (*MESH[:2], MESH[2].format("m.obj"))))
    text = path.read_text().replace("</robot>", joint("2", "b", "c") + "</robot>")
    scene = trimesh.Scene()
    for height in (0.1, 0.4):  # the hull of both is not the arm
        place = trimesh.transformations.translation_matrix((0.0, 0.0, height))
        scene.add_geometry(trimesh.creation.box((0.1, 0.2, 0.05)), transform=place)
    corners = []
    for name in ("m.obj", "m.GLB"):
        scene.export(str(path.parent / name), file_type=name[-3:].lower())
        path.write_text(text.replace("m.obj", name))
        shapes = [shape for _, shape, *_ in link_shapes(robot_from_urdf(path))]
        corners.append(sorted(np.unique(shape.round(5), axis=0).tolist() for shape in shapes))
    assert len(corners[0]) == 4
    np.testing.assert_allclose(*corners, atol=2e-5)


@pytest.mark.parametrize(
    "options",
    [
        {"gain": float("nan")},
        {"base_orientation": (0, 0, 0, 2)},
        {"limits": {"turn": (float("nan"), 1)}},
        {"velocity": {"turn": "fast"}},
    ],
)
def test_options_of_other_types_are_rejected(urdf, options):
    with pytest.raises(RobotError, match=f"{next(iter(options))} must be"):
        robot_from_urdf(urdf(ARM), end_effector="tool", **options)


def test_options_that_do_not_fit_are_rejected(urdf):
    elements = TWO + link("c") + joint("1", "a", "b") + joint("2", "a", "c")
    with pytest.raises(RobotError, match="name one: b, c"):
        robot_from_urdf(urdf(elements))
    path = urdf(ARM)
    with pytest.raises(RobotError, match="no link 'hand'"):
        robot_from_urdf(path, end_effector="hand")
    with pytest.raises(RobotError, match="fixed: 'turn' is none of the joints grip"):
        robot_from_urdf(path, end_effector="tool", fixed={"turn": 0.0})
    with pytest.raises(RobotError, match="acceleration: no limit of slide, roll"):
        robot_from_urdf(path, end_effector="tool", acceleration={"turn": 5})
    with pytest.raises(
        RobotError, match="'roll': datasheet_limits from -2.0 to 1.0 are not inside"
    ):
        robot_from_urdf(path, end_effector="tool", datasheet_limits={"roll": (-2, 1)})


def test_robot_file_says_what_the_urdf_lacks(urdf, tmp_path):
    path = urdf(ARM)
    file = tmp_path / "arm.yaml"
    file.write_text(
        f"urdf: {path}\nend_effector: tool\nend_effector_position: [0, 0, 0.1]\n"
        "fixed: {grip: 0.01}\nlimits: {roll: [-1, 1]}\ngain: 0.5\n"
    )
    robot = load_robot(file)
    assert robot.name == "arm" and robot.gains == (0.5,) * 3 and robot.held_positions == (0.01,)
    assert robot.upper.tolist() == [1.5, 1.5, 1.0] and robot.end_effector_offset == (0, 0, 0.1)
    assert load_robot(file) == robot
    file.write_text(file.read_text() + "acceleration_steps: 5\n")
    slower = load_robot(file)
    assert slower.acceleration_steps == 5 and slower != robot  # demonstrations differ


def test_robot_file_adds_limits_of_trajectories_and_the_datasheet(urdf, tmp_path):
    path = urdf(ARM)
    plain, file = robot_from_urdf(path, end_effector="tool", gain=0.5), tmp_path / "arm.yaml"
    file.write_text(
        f"urdf: {path}\nname: arm\nend_effector: tool\ngain: 0.5\nvelocity: {{slide: 0.4}}\n"
        "acceleration: 3\njerk: {turn: 30, slide: 10, roll: 50}\n"
        "datasheet_limits: {roll: [-1, 1.2]}\n"
    )
    robot = load_robot(file)
    assert robot.velocity.tolist() == [2.0, 0.4, 2.0]  # the others are the URDF's
    assert robot.acceleration.tolist() == [3.0] * 3
    assert robot.jerk.tolist() == [30.0, 10.0, 50.0]
    lower, upper = robot.position_limits("datasheet")
    assert lower.tolist() == [-1.5, -1.5, -1.0] and upper.tolist() == [1.5, 1.5, 1.2]
    assert robot.upper.tolist() == [1.5, 1.5, 1.5]
    # Demonstrations and policies of the arm stay valid.
    assert robot == plain and plain.acceleration is None and plain.datasheet_lower is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("urdf: x.urdf\ncolour: red", "unknown key 'colour'"),
        ("urdf: x.urdf", "No such file"),
        ("urdf: package:no_such_package/x.urdf", "not installed"),
        ("urdf: x.urdf\ngain: true", "gain must be a number"),
    ],
)
def test_malformed_robot_file_is_rejected_with_its_reason(tmp_path, text, reason):
    file = tmp_path / "robot.yaml"
    file.write_text(text)
    with pytest.raises(RobotError, match=reason):
        load_robot(file)


def test_pairs_and_gain_are_cached_and_a_damaged_cache_is_made_again(urdf, tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOARM_NMP_CACHE", str(tmp_path))
    arm = {"path": urdf(ARM), "end_effector": "tool"}
    first = robot_from_urdf(**arm)
    files = list((tmp_path / "robots").iterdir())
    assert len(files) == 3  # of the pairs, of the gain and of the end effector
    with monkeypatch.context() as patch:
        patch.setattr(roboarm_nmp.envs.robots.urdf, "sample_pairs", None)
        patch.setattr(roboarm_nmp.envs.robots.urdf, "calibrate", None)
        again = robot_from_urdf(**arm)
        # A box that has another size may collide elsewhere.
        wider = urdf(ARM.replace("0.05 0.06 0.2", "0.05 0.07 0.2"))
        with pytest.raises(TypeError):
            robot_from_urdf(wider, end_effector="tool")
    assert again == first and again.self_collision_pairs == first.self_collision_pairs
    assert again.gains == first.gains and again.contact_free == first.contact_free
    for file in files:
        file.write_bytes(b"[[1, ")
    assert robot_from_urdf(**arm) == first


@pytest.mark.parametrize("limit", ['<limit lower="-1" upper="1" effort="50"/>', ""])
def test_arm_moves_within_limits_that_replace_the_urdfs(urdf, limit):
    mimic = f'{limit}<mimic joint="j1" multiplier="-1"/>'
    joints = joint("j1", "l0", "l1", more=limit) + joint("j2", "l1", "l2", more=mimic)
    path = urdf("".join(link(f"l{i}", BAR) for i in range(3)) + joints)
    robot = robot_from_urdf(path, limits={"j1": (-3.0, 3.0)}, gain=0.6)
    client = p.connect(p.DIRECT)
    body = Body(robot, client, drawn=False)
    for _ in range(200):
        body.command([2.5])
        p.stepSimulation(physicsClientId=client)
    angles = [p.getJointState(body.id, index, physicsClientId=client)[0] for index in (0, 1)]
    p.disconnect(client)
    np.testing.assert_allclose(angles, [2.5, -2.5], atol=0.01)


@pytest.mark.parametrize("order", list(itertools.permutations("abc")), ids="".join)
def test_mimic_of_a_mimic_is_the_same_in_every_order_of_the_file(urdf, order):
    """Of three fingers, `a` follows `b`, which follows `c`."""
    limit = '<limit lower="0" upper="0.1" effort="50" velocity="2"/>'
    more = {
        "a": f'{limit}<mimic joint="b" multiplier="2" offset="0.01"/>',
        "b": f'{limit}<mimic joint="c" multiplier="-0.5" offset="0.02"/>',
        "c": limit,
    }
    fingers = [joint(name, "l2", f"f{name}", "prismatic", more=more[name]) for name in order]
    links = [link(f"f{name}") for name in order]
    path = urdf("".join([chain(3), *links, *fingers]))
    fixed = robot_from_urdf(path, end_effector="l2", fixed={"c": 0.03})
    expected = {"a": 0.02, "b": 0.005, "c": 0.03}
    assert fixed.held == pytest.approx(expected)
    opened = robot_from_urdf(path, end_effector="l2", fixed={"c": 0.0})
    assert with_held(opened, {"c": 0.03}).held == pytest.approx(expected)


def test_soft_limits_that_are_not_used_are_named(urdf):
    soft = '<safety_controller soft_lower_limit="-1" soft_upper_limit="1.2" k_velocity="1"/>'
    limit = '<limit lower="-1.5" upper="1.5" effort="50" velocity="2"/>'
    elements = "".join(
        [link("l0", BAR), link("l1", BAR), joint("j1", "l0", "l1", more=limit + soft)]
    )
    with pytest.warns(UserWarning, match=r"soft limits .* to use them: limits={'j1': \(-1, 1.2\)}"):
        assert robot_from_urdf(urdf(elements)).lower.tolist() == [-1.5]


def test_file_urls_capital_endings_and_other_alphabets_are_read(tmp_path):
    mesh = tmp_path / "my arm" / "meshes" / "a mesh.obj"
    mesh.parent.mkdir(parents=True)
    mesh.write_text(
        "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    shape = "0 0 0", "0 0 0", f'<mesh filename="{mesh.as_uri()}"/>'
    path = tmp_path / "my arm" / "ARM.URDF"
    elements = link("l0", BAR) + link("l1", BAR, shape) + joint("j1", "l0", "l1")
    path.write_text(f'<robot name="ärm">{elements}</robot>', encoding="utf-8")
    script = f"from roboarm_nmp.envs.robots.files import load_robot; load_robot({str(path)!r})"
    environment = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    subprocess.run([sys.executable, "-c", script.encode()], check=True, env=environment)
    assert load_robot(path).name == "ärm"
