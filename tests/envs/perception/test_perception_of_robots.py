"""Sensors, point clouds and encoders around another arm than the Panda: xArm6, 6 joints."""

from dataclasses import replace

import numpy as np
import pytest
from paths import ROOT

from roboarm_nmp import envs
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.geometry_source import find_geometry_source
from roboarm_nmp.envs.perception.point_clouds import observed_points
from roboarm_nmp.envs.perception.sensors import OBSTACLE, ROBOT, PointCloud, cardinal, observe_scene
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.scenes.primitives import Box, Scene

XARM6 = ROOT / "examples" / "robots" / "xarm6.yaml"
TASK = f"random_boxes_hard@{XARM6}"
BOX = Box((0.45, 0.1, 0.3), (0.1, 0.4, 0.6))


@pytest.fixture(scope="module")
def robot():
    return load_robot(XARM6)


def distances_from(box, points):
    """m, (n,), of points from the surface of an upright box."""
    beyond = np.abs(points - np.array(box.position)) - np.array(box.size) / 2
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.abs(outside + np.minimum(beyond.max(1), 0.0))


def test_points_of_the_arm_are_labelled_and_not_observed(robot):
    empty, scene = Scene(robot=robot), Scene((BOX,), robot=robot)
    assert not len(observed_points(empty))
    points = observed_points(scene)
    assert len(points) > 50 and distances_from(BOX, points).max() < 0.005
    clouds = observe_scene(scene, cardinal(PointCloud, robot)).values()
    of_arm = np.concatenate([one["points"][one["labels"] == ROBOT] for one in clouds])
    # Around the links in the pose in which scenes are observed, and nowhere else.
    frames = [position for position, _ in robot.frame_poses(np.array(robot.observed_pose))]
    line = np.concatenate(
        [np.linspace(a, b, 20) for a, b in zip([np.zeros(3), *frames], frames, strict=False)]
    )
    assert len(of_arm) > 500
    assert np.linalg.norm(of_arm[:, None] - line, axis=2).min(1).max() < 0.2
    assert all((one["labels"] == OBSTACLE).any() for one in clouds)


def test_observed_points_keep_the_arm_from_the_obstacles(robot):
    rng = np.random.default_rng(0)
    states = rng.uniform(-1.0, 1.0, (400, robot.num_joints))
    scene = envs.get_task(TASK).scene.sample(rng)
    truth = CollisionChecker(scene).signed_distances(states, False).distance.min(1)
    observed = find_geometry_source("point_cloud", robot)(scene)
    found = observed.signed_distances(states, False).distance.min(1)
    nothing = CollisionChecker(replace(scene, obstacles=())).signed_distances(states, False)
    decided_by_obstacles = nothing.distance.min(1) > truth + 0.01
    assert decided_by_obstacles.sum() > 50
    assert np.median(np.abs(found - truth)[decided_by_obstacles & (truth > 0.0)]) < 0.02
    assert (found <= 0.01)[truth < -0.02].mean() > 0.9


def test_environment_of_another_arm_has_the_sizes_of_its_observations(robot):
    flags = {"goal_type": "combined", "encoder": "point_cloud", "num_points": 16}
    flags |= {"geometry_source": "point_cloud", "link_distances": True}
    env = envs.make(TASK, **flags)
    observation, _ = env.reset(seed=0)
    assert observation["observation"].shape == (6 + 3 + 16 * 3,)
    assert observation["desired_goal"].shape == (9,)
    assert observation["link_distances"].shape == robot.link_distances_shape
    assert env.observation_space.contains(observation)
    env.close()


def test_encoder_of_the_panda_is_rejected_for_another_arm():
    message = "field: it was trained for the robot 'panda' .*, not for 'xarm6'"
    for flags in (
        {"encoder": "field"},
        {"geometry_source": "field", "link_distances": True},
        {"geometry_source": "field", "encoder": "point_cloud"},
    ):
        with pytest.raises(ValueError, match=message):
            envs.make(TASK, **flags)
