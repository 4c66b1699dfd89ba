"""Poses of the end effector against PyBullet and SciPy, and inverse kinematics against both."""

import numpy as np
import pytest
import torch
from paths import ROOT
from scipy.spatial.transform import Rotation

from roboarm_nmp import envs
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.inverse_kinematics import MAX_ANGLE, MAX_DISTANCE, inverse_kinematics
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.rotations import quaternions, rotation_angle
from roboarm_nmp.envs.robots.urdf import robot_from_urdf
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.world import World
from roboarm_nmp.training.network_parts import JacobianTranspose
from roboarm_nmp.utils.bullet import pybullet as p

# A turning joint, a sliding one, one that mimics the first, and a turned tool, all askew.
LINK = (
    '<link name="{}"><inertial><mass value="1"/>'
    '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
    '<collision><geometry><box size="0.02 0.02 0.02"/></geometry></collision></link>'
)
JOINT = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/>'
    '<origin xyz="0.1 0 0.2" rpy="0.2 0.7 -0.4"/><axis xyz="{4}"/>'
    '<limit lower="-1.5" upper="1.2" effort="50" velocity="2"/>{5}</joint>'
)
MIMIC = '<mimic joint="turn" multiplier="-0.5" offset="0.2"/>'
URDF = "".join(
    [
        '<robot name="askew">',
        *(LINK.format(name) for name in ("base", "one", "two", "three", "four", "tool")),
        JOINT.format("turn", "revolute", "base", "one", "0 2 0", ""),
        JOINT.format("slide", "prismatic", "one", "two", "1 1 0", ""),
        JOINT.format("follow", "revolute", "two", "three", "1 0 0", MIMIC),
        JOINT.format("roll", "revolute", "three", "four", "0 0 1", ""),
        JOINT.format("weld", "fixed", "four", "tool", "0 0 1", ""),
        "</robot>",
    ]
)


@pytest.fixture(scope="module", params=["panda", "iiwa", "xarm6", "askew"])
def robot(request, tmp_path_factory):
    if request.param == "panda":
        return PANDA
    if request.param != "askew":
        return load_robot(ROOT / "examples" / "robots" / f"{request.param}.yaml")
    path = tmp_path_factory.mktemp("urdf") / "askew.urdf"
    path.write_text(URDF)
    base = {"base_position": (0.1, -0.2, 0.3), "base_orientation": (0.0, 0.6, 0.0, 0.8)}
    offset = (0.01, 0.02, 0.03)
    return robot_from_urdf(path, end_effector="tool", end_effector_position=offset, **base)


def random_configurations(robot, number, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(robot.lower, robot.upper, (number, robot.num_joints))


def bullet_poses(robot, configurations):
    """Position and rotation of the end effector as PyBullet has them."""
    world = World(Scene(table=None, floor=None, robot=robot), drawn=False)
    for configuration in configurations:
        world.arm.set_configuration(configuration.tolist())
        link = p.getLinkState(
            *(world.body, robot.end_effector_link),
            computeForwardKinematics=1,
            physicsClientId=world.client,
        )
        rotation = Rotation.from_quat(link[5])
        yield link[4] + rotation.apply(robot.end_effector_offset), rotation
    world.close()


def test_poses_of_the_end_effector_are_pybullets(robot):
    configurations = random_configurations(robot, 20)
    poses = robot.end_effector_pose(configurations)
    assert poses.shape == (20, 7)
    np.testing.assert_allclose(poses[:, :3], robot.forward_kinematics(configurations))
    for pose, (position, rotation) in zip(poses, bullet_poses(robot, configurations), strict=True):
        np.testing.assert_allclose(pose[:3], position, atol=1e-6)
        assert (Rotation.from_quat(pose[3:]) * rotation.inv()).magnitude() < 1e-6
        assert pose[3:][np.abs(pose[3:]).argmax()] > 0


def test_jacobian_transpose_is_the_change_of_the_pose(robot):
    rng, step = np.random.default_rng(2), 1e-5
    states = rng.uniform(-1.0, 1.0, (30, robot.num_joints))
    vectors = rng.standard_normal((30, 6))
    expected, angular = np.empty_like(states), np.empty_like(states)
    for i, unit in enumerate(np.eye(robot.num_joints)):
        after, before = (
            robot.end_effector_pose(robot.denormalise(states + sign * step / 2 * unit))
            for sign in (1.0, -1.0)
        )
        turns = Rotation.from_quat(after[:, 3:]) * Rotation.from_quat(before[:, 3:]).inv()
        change = np.hstack([after[:, :3] - before[:, :3], turns.as_rotvec()])
        expected[:, i] = (change * vectors).sum(1) / step
        angular[:, i] = (turns.as_rotvec() * vectors[:, 3:]).sum(1) / step
    positions = robot.forward_kinematics(robot.denormalise(states))
    given = [torch.tensor(array, dtype=torch.float32) for array in (states, positions, vectors)]
    whole = JacobianTranspose(robot, rotates=True)(*given).numpy()
    np.testing.assert_allclose(whole, expected, atol=2e-5)
    linear = JacobianTranspose(robot)(given[0], given[1], given[2][:, :3]).numpy()
    np.testing.assert_allclose(linear, expected - angular, atol=2e-5)


def test_quaternions_and_angles_are_those_of_scipy():
    one, other = (Rotation.random(500, random_state=seed) for seed in (1, 2))
    np.testing.assert_allclose(
        rotation_angle(one.as_quat(), -other.as_quat()), (one * other.inv()).magnitude(), atol=1e-9
    )
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    for matrices in (one.as_matrix(), half_turns):
        again = Rotation.from_quat(quaternions(matrices)).as_matrix()
        np.testing.assert_allclose(again, matrices, atol=1e-12)


def test_solutions_have_the_pose_within_the_limits(robot):
    poses = robot.end_effector_pose(random_configurations(robot, 60))
    batch = inverse_kinematics(robot, poses)
    assert np.mean([len(solutions) > 0 for solutions in batch]) > 0.96
    for pose, solutions in zip(poses, batch, strict=True):
        reached = robot.end_effector_pose(solutions.astype(np.float32))
        assert (np.linalg.norm(reached[:, :3] - pose[:3], axis=1) <= MAX_DISTANCE).all()
        assert (rotation_angle(reached[:, 3:], pose[3:]) <= MAX_ANGLE).all()
        assert ((solutions >= robot.lower) & (solutions <= robot.upper)).all()
    pose, solutions = next(pair for pair in zip(poses, batch, strict=True) if len(pair[1]))
    for position, rotation in bullet_poses(robot, solutions):
        assert np.linalg.norm(position - pose[:3]) <= MAX_DISTANCE
        assert (rotation * Rotation.from_quat(pose[3:]).inv()).magnitude() <= MAX_ANGLE


def test_solutions_are_sorted_by_distance_from_a_configuration():
    goal, near = random_configurations(PANDA, 2)
    pose = PANDA.end_effector_pose(goal)
    solutions = inverse_kinematics(PANDA, pose, num_seeds=64, near=near)
    states = PANDA.normalise(solutions)
    distances = np.linalg.norm(states - PANDA.normalise(near), axis=1)
    assert len(solutions) > 5 and (np.diff(distances) >= 0).all()
    apart = np.linalg.norm(states[:, None] - states, axis=-1) + np.eye(len(states))
    assert apart.min() > 0.01
    # A configuration that has the pose itself is found.
    np.testing.assert_allclose(inverse_kinematics(PANDA, pose, near=goal)[0], goal)


def test_pose_has_the_same_solutions_alone_and_in_a_batch_and_for_the_negative_quaternion():
    poses = PANDA.end_effector_pose(random_configurations(PANDA, 5))
    batch = inverse_kinematics(PANDA, poses, seed=3)
    for pose, solutions in zip(poses, batch, strict=True):
        turned = np.r_[pose[:3], -2.0 * pose[3:]]
        np.testing.assert_array_equal(inverse_kinematics(PANDA, pose, seed=3), solutions)
        np.testing.assert_allclose(inverse_kinematics(PANDA, turned, seed=3), solutions, atol=1e-9)
    others = inverse_kinematics(PANDA, poses[0], seed=4)
    assert batch[0].shape != others.shape or not np.allclose(batch[0], others)


def test_solutions_are_free_of_collisions():
    scene = envs.get_task("double_walls").scene
    checker, removed = CollisionChecker(scene), 0
    for pose in PANDA.end_effector_pose(random_configurations(PANDA, 10)):
        every = inverse_kinematics(PANDA, pose)
        free = inverse_kinematics(PANDA, pose, checker=checker, margin=0.01)
        assert checker.is_free(PANDA.normalise(free), margin=0.01).all()
        removed += len(every) - len(free)
    assert removed > 25


def test_pose_out_of_reach_has_no_solution():
    pose = np.array([2.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0])
    assert inverse_kinematics(PANDA, pose).shape == (0, 7)
    assert inverse_kinematics(PANDA, np.empty((0, 7))) == []


@pytest.mark.parametrize(
    ("pose", "options", "message"),
    [
        (np.ones(6), {}, "a pose is 7 numbers"),
        (np.r_[np.nan, np.ones(6)], {}, "must be finite"),
        (np.r_[np.ones(3), np.zeros(4)], {}, "quaternion that is not zero"),
        (np.ones(7), {"num_seeds": 0}, "num_seeds must be at least 1"),
        (np.ones(7), {"near": np.ones(6)}, "near must be 7 finite numbers"),
    ],
)
def test_bad_arguments_are_rejected(pose, options, message):
    with pytest.raises(ValueError, match=message):
        inverse_kinematics(PANDA, pose, **options)
