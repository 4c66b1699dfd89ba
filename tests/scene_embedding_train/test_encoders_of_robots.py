"""Observations and encoders of another arm than the Panda: xArm6."""

import pytest
from encoder_trainers import command, two_sensors
from paths import ROOT
from trainers import error_here, run_here

from roboarm_nmp import envs
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.envs.perception.sensors import PointCloud, cardinal
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.scene_embedding_train import collect

XARM6 = ROOT / "examples" / "robots" / "xarm6.yaml"


@pytest.fixture(scope="module")
def observations(tmp_path_factory):
    folder = tmp_path_factory.mktemp("observations")
    options = {"num": 12, "sensors": "clouds", "num_samples": 400, "workers": 1}
    args = collect.Args(f"random_boxes_hard@{XARM6}", output=folder, **options)
    with two_sensors():
        made = collect.collect(args, progress=False)
    sensors = cardinal(PointCloud, load_robot(XARM6), num_samples=400)
    assert made.sensors["front_cloud"] == sensors["front"]
    return folder


def test_observations_are_of_their_arm(observations):
    robot = load_robot(XARM6)
    found = Observations(observations, robot)
    assert len(found) == 12 and found.read(0, "configuration").shape == (12, 6)
    assert all(scene.robot == robot for scene in found.scenes(0))
    with pytest.raises(DatasetError, match="made for the robot 'xarm6' .*, not for 'panda'"):
        Observations(observations)


def test_encoder_is_for_its_arm(observations, tmp_path, capsys):
    words = command("field", observations, tmp_path)[1:]
    assert "made for the robot 'xarm6' " in error_here(capsys, *words)
    run_here(*words, "--robot", XARM6)
    encoder = next(tmp_path.glob("*/encoder.onnx"))
    assert load_network(encoder).metadata["robot"] == ["xarm6", load_robot(XARM6).fingerprint]
    env = envs.make(f"random_boxes_hard@{XARM6}", encoder=encoder)
    assert env.reset(seed=0)[0]["observation"].shape == (6 + 3 + 64,)
    with pytest.raises(ValueError, match="trained for the robot 'xarm6' .*, not for 'panda'"):
        envs.make("random_boxes_hard", encoder=encoder)
