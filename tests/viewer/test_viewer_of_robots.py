"""The viewer with other arms than the Panda: what is drawn, dragging the goal, saved scenes."""

import numpy as np
import pytest
from paths import ROOT

from roboarm_nmp.envs.robots.body import Body  # noqa: E402
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.urdf import robot_from_urdf
from roboarm_nmp.envs.scenes.files import load_scene
from roboarm_nmp.envs.scenes.primitives import Sphere
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.viewer.episodes import task_episodes
from roboarm_nmp.viewer.simulation import PolicyArm, Simulation

pytest.importorskip("viser")
from roboarm_nmp.viewer.meshes import arm_joints, link_meshes  # noqa: E402

trimesh = pytest.importorskip("trimesh")
XARM6 = ROOT / "examples" / "robots" / "xarm6.yaml"
INERTIAL = (
    '<inertial><mass value="1"/>'
    '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def of_shapes(folder):
    """The path of the URDF of an arm with every kind of visual shape; `turn` leads `follow`."""
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.export(folder / "box.stl")
    box.export(folder / "box.obj")
    shapes = {
        "base": '<box size="0.2 0.1 0.1"/>',
        "one": '<mesh filename="box.stl" scale="1 1 2"/>',
        "two": '<cylinder radius="0.05" length="0.4"/>',
        "three": '<mesh filename="box.obj"/>',
        "four": '<sphere radius="0.1"/>',
        "five": '<capsule radius="0.05" length="0.1"/>',
    }
    links = "".join(
        f'<link name="{name}">{INERTIAL}<visual><origin xyz="0 0 0.1" rpy="0 0 1.5707963"/>'
        f'<geometry>{shape}</geometry><material name="blue"/></visual>'
        '<collision><geometry><box size="0.01 0.01 0.01"/></geometry></collision></link>'
        for name, shape in shapes.items()
    )
    names, joints = list(shapes), ""
    for i, (name, kind, more) in enumerate(
        [
            ("turn", "revolute", ""),
            ("slide", "prismatic", ""),
            ("weld", "fixed", ""),
            ("roll", "revolute", ""),
            ("follow", "revolute", '<mimic joint="turn" multiplier="-0.5" offset="0.2"/>'),
        ]
    ):
        joints += (
            f'<joint name="{name}" type="{kind}"><parent link="{names[i]}"/>'
            f'<child link="{names[i + 1]}"/><origin xyz="0.1 0 0.3" rpy="0.3 -0.2 0.5"/>'
            f'<axis xyz="0 3 1"/><limit lower="-1" upper="1" effort="50" velocity="2"/>{more}'
            "</joint>"
        )
    blue = '<material name="blue"><color rgba="0 0 1 1"/></material>'
    (folder / "arm.urdf").write_text(f'<robot name="arm">{blue}{links}{joints}</robot>')
    return folder / "arm.urdf"


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    return robot_from_urdf(of_shapes(folder), end_effector="five", base_position=(0.5, 0.0, 0.2))


@pytest.fixture(scope="module", params=["panda", "xarm6", "shapes"])
def robot(request, arm):
    files = {"panda": "panda", "xarm6": XARM6}
    return arm if request.param == "shapes" else load_robot(files[request.param])


def transform(position, wxyz):
    matrix = trimesh.transformations.quaternion_matrix(wxyz)
    matrix[:3, 3] = position
    return matrix


def test_links_are_drawn_where_pybullet_has_them(robot):
    client = p.connect(p.DIRECT)
    body = Body(robot, client, drawn=False)
    base = p.getBasePositionAndOrientation(body.id, client)
    for state in np.random.default_rng(0).uniform(-1, 1, (5, robot.num_joints)):
        configuration = robot.denormalise(state)
        body.set_configuration(configuration.tolist())
        x, y, z, w = robot.base_orientation
        drawn = {-1: transform(robot.base_position, (w, x, y, z))}
        for joint in arm_joints(robot):
            at = drawn[joint.parent] @ transform(joint.position, joint.wxyz)
            drawn[joint.link] = at @ transform(*joint.pose(configuration))
        for link in range(p.getNumJoints(body.id, client)):
            state = p.getLinkState(
                body.id, link, computeForwardKinematics=1, physicsClientId=client
            )
            expected = np.reshape(p.getMatrixFromQuaternion(state[5]), (3, 3))
            np.testing.assert_allclose(drawn[link][:3, 3], state[4], atol=1e-5)
            np.testing.assert_allclose(drawn[link][:3, :3], expected, atol=1e-5)
    assert p.getBasePositionAndOrientation(body.id, client) == base
    p.disconnect(client)


def test_every_kind_of_visual_shape_is_drawn_at_its_origin_in_its_colour(arm):
    expected = {  # full edges, turned by a quarter about z
        -1: (0.1, 0.2, 0.1),
        0: (0.2, 0.1, 0.6),
        1: (0.1, 0.1, 0.4),
        2: (0.2, 0.1, 0.3),
        3: (0.2, 0.2, 0.2),
        4: (0.1, 0.1, 0.2),
    }
    meshes = link_meshes(arm, 0.005)
    assert set(meshes) == set(expected)
    for link, edges in expected.items():
        [(colour, vertices, faces)] = meshes[link]
        assert colour == (0, 0, 255) and faces.max() < len(vertices)
        np.testing.assert_allclose(np.ptp(vertices, axis=0), edges, atol=0.005)
        np.testing.assert_allclose((vertices.max(0) + vertices.min(0)) / 2, (0, 0, 0.1), atol=1e-3)


def test_planner_moves_another_arm_and_its_scene_can_be_edited_and_saved(tmp_path):
    task = f"random_boxes_hard@{XARM6}"
    shown = Simulation(task_episodes(task))
    shown.add(PolicyArm(task, "planner"))
    [moved], robot = shown.arms, load_robot(XARM6)
    for _ in range(5):
        shown.step()
    assert moved.steps == 5 and moved.state.shape == (6,)
    shown.add_obstacle(Sphere((0.0, 0.0, 1.5), 0.1))
    assert moved.kinematic
    shown.move_goal(robot.forward_kinematics(shown.query.goal) + [0.0, 0.0, -0.01])
    shown.step()
    path = shown.save_scene(tmp_path / "mine")
    shown.close()
    assert load_scene(path) == shown.query.scene and load_scene(path).robot == robot


def test_saving_a_scene_never_replaces_a_file(tmp_path):
    shown = Simulation(task_episodes("no_obstacles"))
    first = shown.save_scene(tmp_path / "mine.yaml")
    before = first.read_bytes()
    shown.add_obstacle(Sphere((0.0, 0.0, 1.5), 0.1))
    names = [shown.save_scene(tmp_path / "mine.yaml").name for _ in range(2)]
    assert names == ["mine_2.yaml", "mine_3.yaml"] and first.read_bytes() == before
    assert load_scene(tmp_path / "mine_2.yaml") == shown.query.scene
    shown.close()
