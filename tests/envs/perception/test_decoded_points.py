"""Obstacles decoded from the latent code: points, link distances, and policies that use them."""

import numpy as np
import pytest
import torch

from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.encoders import (
    DECODED_CELL,
    DECODED_HIGH,
    DECODED_LOW,
    DECODED_REACH,
    make_encoder,
)
from roboarm_nmp.envs.perception.geometry_source import (
    DECODED_RADIUS,
    find_geometry_source,
    ground_truth_checker,
    observed_checker,
)
from roboarm_nmp.envs.perception.sensors import PointCloud, cardinal, sensors_to_json
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.evaluation.evaluate import EvaluationError, evaluate
from roboarm_nmp.networks.export import save_network
from roboarm_nmp.networks.untrusted import NetworkError

BALL = (0.45, 0.1, 0.6, 0.15)  # decoded from every z_E, whatever the scene: position and radius, m
POLICY = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"


class Constant(torch.nn.Module):
    def forward(self, front_points):
        return torch.tensor(BALL) + 0.0 * front_points[:, 0, :1]


class DistanceFromBall(torch.nn.Module):
    def forward(self, latent, points):
        offset = points - latent[:, None, :3]
        return offset.square().sum(2).sqrt() - latent[:, 3:]


def save_encoder(path, decoder):
    """The path of an encoder, as a string, with a decoder beside it."""
    sensors = {"front": cardinal(PointCloud, num_samples=100)["front"]}
    metadata = {"kind": "encoder", "sensors": sensors_to_json(sensors)}
    save_network(path, Constant(), {"front_points": torch.zeros(2, 100, 3)}, metadata, ["latent"])
    inputs = {"latent": torch.rand(2, 4), "points": torch.rand(2, 5, 3)}
    save_network(
        path.with_suffix(".decoder.onnx"),
        decoder,
        inputs,
        {"kind": "field"},
        ["distance"],
        {"points": [1]},
    )
    return str(path)


@pytest.fixture(scope="module")
def encoder(tmp_path_factory):
    return save_encoder(tmp_path_factory.mktemp("decoded") / "encoder.onnx", DistanceFromBall())


def test_decoded_points_are_the_grid_points_near_decoded_obstacles(encoder):
    points = make_encoder(encoder).decoded_points(Scene())
    axes = [
        np.arange(low + DECODED_CELL / 2, high, DECODED_CELL)
        for low, high in zip(DECODED_LOW, DECODED_HIGH, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    near = np.linalg.norm(grid - BALL[:3], axis=1) - BALL[3] < DECODED_REACH
    assert points.dtype == np.float32 and near.sum() > 500
    expected = {tuple(row) for row in np.round(grid[near], 4).tolist()}
    assert {tuple(row) for row in np.round(points.astype(float), 4).tolist()} == expected
    assert len(points) == len(expected)


def test_signed_distances_of_a_decoding_source_are_those_of_its_points(encoder):
    geometry_source = find_geometry_source(encoder)
    checker = geometry_source(Scene())
    states = np.random.default_rng(0).uniform(-1, 1, (200, 7))
    points = make_encoder(encoder).decoded_points(Scene())
    expected = CollisionChecker(Scene(), points, DECODED_RADIUS).signed_distances(states).distance
    np.testing.assert_array_equal(checker.signed_distances(states).distance, expected)
    assert find_geometry_source(encoder)(Scene()) is checker  # cached
    # The ground-truth obstacles change nothing.
    boxed = Scene((Box((0.0, 0.5, 0.4), (0.3, 0.3, 0.3)),))
    np.testing.assert_array_equal(
        geometry_source(boxed).signed_distances(states).distance, expected
    )


def test_geometry_sources_are_found_by_name():
    assert find_geometry_source("ground_truth") is ground_truth_checker
    assert find_geometry_source("point_cloud") is observed_checker
    for name in ("points", "obstacles", "nowhere"):
        with pytest.raises(ValueError, match=f"a geometry source is .*no such encoder: {name}"):
            find_geometry_source(name)


class NotANumber(DistanceFromBall):
    def forward(self, latent, points):
        return super().forward(latent, points) * float("nan")


def test_decoder_without_valid_distances_is_rejected(tmp_path):
    """It must not count as a scene without obstacles."""
    path = save_encoder(tmp_path / "encoder.onnx", NotANumber())
    with pytest.raises(NetworkError, match=r"encoder.decoder.onnx: its output is not"):
        make_encoder(path).decoded_points(Scene())


def test_policy_of_observed_points_can_use_decoded_points(encoder):
    options = {"split": "validation", "num_queries": 1}
    observed = evaluate(POLICY, "random_boxes_hard", **options)
    decoded = evaluate(POLICY, "random_boxes_hard", geometry_source=encoder, **options)
    assert decoded["env"]["geometry_source"] == encoder and decoded["geometry_source"] == encoder
    assert decoded["env"]["encoder"] == "point_cloud" and decoded["env"]["num_points"] == 32
    assert decoded["safety_filter"] == observed["safety_filter"]
    assert decoded["mean_steps"] != observed["mean_steps"]
    planned = evaluate("planner", "random_boxes_hard", geometry_source=encoder, **options)
    assert planned["geometry_source"] == encoder


@pytest.mark.parametrize("policy", ["bc-ee-double_walls-s1", "go-to-goal"])
def test_policy_without_scene_geometry_rejects_a_geometry_source(policy, encoder):
    with pytest.raises(EvaluationError, match="geometry"):
        evaluate(policy, "double_walls", geometry_source=encoder, num_queries=1)
