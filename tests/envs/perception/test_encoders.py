"""Scene encoders: z_E by hand, in environments, by name, cached, copied, and rejected files."""

import copy
import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.perception.encoders import (
    MAX_OBSTACLES,
    PRETRAINED,
    NetworkEncoder,
    OracleEncoder,
    PointCloudEncoder,
    make_encoder,
    pretrained_encoders,
)
from roboarm_nmp.envs.perception.geometry_source import find_geometry_source
from roboarm_nmp.envs.perception.point_clouds import farthest_points, observed_points
from roboarm_nmp.envs.perception.sensors import Camera, PointCloud, sensors_to_json
from roboarm_nmp.envs.scenes.primitives import Scene, Sphere, from_array
from roboarm_nmp.envs.wrappers import SceneEncodingWrapper
from roboarm_nmp.networks.export import save_network
from roboarm_nmp.networks.untrusted import NetworkError

FRONT = (1.6, 0.0, 0.8)
SENSORS = {"front": Camera(FRONT, size=(8, 8)), "cloud": PointCloud(FRONT, num_samples=400)}
BALL = Scene((Sphere((0.45, 0.1, 0.6), 0.15),))


class Means(torch.nn.Module):
    """z_E: the mean colour of the image, and the mean of the points (zeros included)."""

    def forward(self, front, cloud_points):
        return torch.cat([front.float().mean((1, 2)) / 255, cloud_points.mean(1)], 1)


INPUTS = {"front": torch.zeros(2, 8, 8, 3).byte(), "cloud_points": torch.zeros(2, 400, 3)}


def save_encoder(path, **changes):
    metadata = {"kind": "encoder", "sensors": sensors_to_json(SENSORS)} | changes
    save_network(path, Means(), INPUTS, metadata, ["latent"])
    return path


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """The path of an encoder's network."""
    return save_encoder(tmp_path_factory.mktemp("encoder") / "encoder.onnx")


# --- z_E


def test_oracle_is_the_padded_obstacles():
    scene, oracle = envs.TASKS["boxes"].scene, make_encoder("oracle")
    rows = oracle(scene).reshape(MAX_OBSTACLES, 12)
    assert oracle.size == 384 and oracle.token_size == 12
    assert rows[:, 0].tolist() == [1.0] * 6 + [0.0] * (MAX_OBSTACLES - 6)
    assert from_array(rows[:6, 1:].astype(np.float64))[2].position == pytest.approx(
        scene.obstacles[2].position
    )
    assert not rows[6:].any()


def test_oracle_rejects_too_many_obstacles():
    with pytest.raises(ValueError, match="room for 32"):
        make_encoder("oracle")(Scene((Sphere((0.0, 0.0, 2.0), 0.1),) * 33))


def test_point_cloud_is_the_farthest_observed_points():
    encoder = make_encoder("point_cloud", 5)
    assert isinstance(encoder, PointCloudEncoder) and encoder.token_size == 3
    expected = farthest_points(observed_points(BALL), 5)
    assert encoder(BALL).tobytes() == expected.tobytes() and expected.any()
    assert make_encoder("point_cloud")(BALL).shape == (64 * 3,)


def test_network_encodes_what_its_sensors_observe(network):
    encoder = make_encoder(network)
    assert encoder.sensors == SENSORS and encoder.size == encoder.token_size == 6
    observed = encoder.observe(BALL)
    assert observed["front"].shape == (8, 8, 3) and observed["cloud_points"].shape == (400, 3)
    colour = observed["front"].mean((0, 1)) / 255
    expected = np.concatenate([colour, observed["cloud_points"].mean(0)])
    np.testing.assert_allclose(encoder(BALL), expected, rtol=1e-6)
    assert (encoder(BALL) != encoder(Scene(()))).all()


# --- In an environment


@pytest.mark.parametrize("kind", ["oracle", "network"])
def test_environment_appends_z_encoded_once_per_scene(kind, network):
    encoder = OracleEncoder() if kind == "oracle" else NetworkEncoder(network)
    env = SceneEncodingWrapper(envs.make("random_boxes_easy", horizon=6), encoder)
    plain = envs.make("random_boxes_easy", horizon=6)
    check_env(env, skip_render_check=True)
    scenes = []
    for seed in (1, 2, 1):
        before = encoder._cached.cache_info().misses
        expected, _ = plain.reset(seed=seed)
        observation, _ = env.reset(seed=seed)
        for _ in range(4):
            assert env.observation_space.contains(observation)
            np.testing.assert_array_equal(
                observation["observation"], [*expected["observation"], *encoder(plain.scene)]
            )
            np.testing.assert_array_equal(observation["desired_goal"], expected["desired_goal"])
            observation = env.step(np.zeros(7, np.float32))[0]
            expected = plain.step(np.zeros(7, np.float32))[0]
        assert encoder._cached.cache_info().misses - before == (plain.scene not in scenes)
        scenes.append(plain.scene)
    query = (plain.start_configuration, plain.goal_configuration, plain.scene)
    for one, other in zip(
        env.reset_specific(*query)[0].items(), env.reset(seed=1)[0].items(), strict=True
    ):
        np.testing.assert_array_equal(one[1], other[1])
    goals = observation["achieved_goal"], observation["desired_goal"]
    assert env.compute_reward(*goals, {}) == plain.compute_reward(*goals, {}) == -1
    env.close()
    plain.close()


# --- By name


def test_pretrained_encoders_are_found_by_name():
    assert pretrained_encoders() == ["field", "pointnet2", "vae", "vqvae"]
    queries = load_queries("random_boxes_hard")
    for name in pretrained_encoders():
        encoder, path = make_encoder(name), PRETRAINED / f"{name}.onnx"
        assert encoder.name == name and encoder.path == path
        latents = np.stack([encoder(queries.scenes[i]) for i in (0, 9_999)])
        assert latents.shape == (2, 64) and np.isfinite(latents).all()
        assert np.abs(latents[0] - latents[1]).max() > 0.1
        result = json.loads(path.with_suffix(".json").read_text())
        assert result["scenes"] >= 19_000
        if name == "pointnet2":
            assert result["iou_obstacle"] >= 0.8
        elif name == "field":
            assert result["error_near"] <= 0.01
        else:
            assert result["error_foreground"] < result["mean_image_error_foreground"] / 3


# --- Demonstrations


def test_demonstrations_are_encoded_once_into_the_cache_folder(
    network, tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("ROBOARM_NMP_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "encoder.onnx"
    path.write_bytes(network.read_bytes())
    demos = replace(load_demos("random_boxes_hard"), start=np.zeros((5, 7)))  # the first 5
    latents = NetworkEncoder(path).encode_demos(demos)
    assert latents.shape == (5, 6) and latents.dtype == np.float32
    np.testing.assert_array_equal(latents[3], NetworkEncoder(path)(demos.scenes[3]))
    (stored,) = tmp_path.glob("cache/encodings/*")
    assert f"encoding random_boxes_hard with {path}, once; kept in {stored}" in (
        capsys.readouterr().err
    )
    assert sorted(one.name for one in tmp_path.iterdir()) == ["cache", "encoder.onnx"]
    observe, observed = NetworkEncoder.observe, []

    def counted(self, scene):
        observed.append(scene)
        return observe(self, scene)

    monkeypatch.setattr(NetworkEncoder, "observe", counted)
    encoder = NetworkEncoder(path)
    observed.clear()
    np.testing.assert_array_equal(encoder.encode_demos(demos), latents)
    np.testing.assert_array_equal(encoder(demos.scenes[3]), latents[3])
    assert not observed and not capsys.readouterr().err
    stored.write_bytes(stored.read_bytes()[:-40])  # damaged
    encoder = NetworkEncoder(path)
    observed.clear()
    np.testing.assert_array_equal(encoder.encode_demos(demos), latents)
    assert len(observed) == 5


# --- Copies


def test_copies_and_unpickled_encoders_encode_equally(network):
    made = [make_encoder(name) for name in ("oracle", "vae", network)]
    made += [make_encoder("point_cloud", 7), make_encoder("point_cloud", 7, "field")]
    for encoder in made:
        assert copy.deepcopy(encoder) is pickle.loads(pickle.dumps(encoder)) is encoder


# --- Rejected


@pytest.mark.parametrize("name", ["points", "nowhere/encoder.onnx"])
def test_unknown_encoder_is_rejected_with_the_known_names(name):
    with pytest.raises(NetworkError) as error:
        make_encoder(name)
    assert name in str(error.value) and "path" in str(error.value)
    if "did you mean" not in str(error.value):
        for part in ("oracle", "point_cloud", "field, pointnet2, vae, vqvae"):
            assert part in str(error.value)


@pytest.mark.parametrize("source", ["vae", "oracle"])
def test_encoder_without_decoder_is_no_source_of_points(source):
    with pytest.raises(NetworkError, match=f"{source} has no decoder"):
        make_encoder("point_cloud", 8, source)
    with pytest.raises(ValueError, match=f"a geometry source is .*{source} has no decoder"):
        find_geometry_source(source)
    with pytest.raises(NetworkError, match="vae has no decoder"):
        make_encoder("vae").distances(BALL, np.zeros((1, 3)))


def test_network_that_is_no_encoder_is_rejected(tmp_path):
    with pytest.raises(NetworkError, match="not an encoder"):
        make_encoder(save_encoder(tmp_path / "policy.onnx", kind="policy"))


@pytest.mark.parametrize(
    "sensors",
    [
        "[1",
        '{"front": {"kind": "camera", "eye": [1, 0, 1], "smell": 1}}',
        sensors_to_json({"other": Camera(FRONT)}),
        sensors_to_json(SENSORS | {"front": Camera(FRONT, size=(8, 8), outputs=("depth",))}),
    ],
)
def test_encoder_with_invalid_sensors_is_rejected(sensors, tmp_path):
    path = save_encoder(tmp_path / "encoder.onnx", sensors=sensors)
    with pytest.raises(NetworkError, match=r"encoder.onnx: its sensors are invalid"):
        make_encoder(path)
