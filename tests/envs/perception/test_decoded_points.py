"""What an encoder with a decoder tells of obstacles: points, distances, policies that use them."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from paths import ROOT

from roboarm_nmp import envs
from roboarm_nmp.clean_rl_scripts.evaluate import EvaluationError, evaluate
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.networks.exported_networks import save_network
from roboarm_nmp.envs.networks.operations import NetworkError
from roboarm_nmp.envs.perception.encoders import (
    DECODED_CELL,
    DECODED_HIGH,
    DECODED_LOW,
    DECODED_RADIUS,
    DECODED_REACH,
    SceneEncoder,
    decoded_checker,
    decoded_points,
    with_decoded,
)
from roboarm_nmp.envs.perception.point_clouds import (
    geometry_source,
    ground_truth_checker,
    observed_checker,
)
from roboarm_nmp.envs.perception.sensors import PointCloud, cardinal, sensors_to_json
from roboarm_nmp.envs.scenes.primitives import Box, Scene, Sphere

BALL = (0.45, 0.1, 0.6, 0.15)  # what the encoder tells of, whatever the scene: place and radius, m
POLICY = "dagger-combined-point_cloud-random_boxes_hard-s1"


class AlwaysTheSame(torch.nn.Module):
    def forward(self, front_points):
        return torch.tensor(BALL) + 0.0 * front_points[:, 0, :1]


class DistanceFromTheBall(torch.nn.Module):
    def forward(self, latent, points):
        offset = points - latent[:, None, :3]
        return offset.square().sum(2).sqrt() - latent[:, 3:]


@pytest.fixture(scope="module")
def encoder(tmp_path_factory):
    """An encoder's path, with a decoder beside it."""
    path = tmp_path_factory.mktemp("told") / "encoder.pt"
    sensors = {"front": cardinal(PointCloud, num_samples=100)["front"]}
    metadata = {"kind": "encoder", "sensors": sensors_to_json(sensors)}
    save_network(path, AlwaysTheSame(), {"front_points": torch.zeros(2, 100, 3)}, metadata)
    inputs = {"latent": torch.rand(2, 4), "points": torch.rand(2, 5, 3)}
    save_network(path.with_suffix(".decoder.pt"), DistanceFromTheBall(), inputs, {"kind": "field"})
    return str(path)


def test_points_are_those_of_the_grid_where_something_is_said_to_be(encoder):
    points = decoded_points(Scene(), encoder)
    axes = [
        np.arange(low + DECODED_CELL / 2, high, DECODED_CELL)
        for low, high in zip(DECODED_LOW, DECODED_HIGH, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    there = np.linalg.norm(grid - BALL[:3], axis=1) - BALL[3] < DECODED_REACH
    assert points.dtype == np.float32 and there.sum() > 500
    expected = {tuple(row) for row in np.round(grid[there], 4).tolist()}
    assert {tuple(row) for row in np.round(points.astype(float), 4).tolist()} == expected
    assert len(points) == len(expected)


def test_distances_are_those_of_what_is_told(encoder):
    told = geometry_source(encoder)(Scene())
    states = np.random.default_rng(0).uniform(-1, 1, (200, 7))
    points = decoded_points(Scene(), encoder)
    expected = CollisionChecker(Scene(), points, DECODED_RADIUS).signed_distances(states).distance
    np.testing.assert_array_equal(told.signed_distances(states).distance, expected)
    assert geometry_source(encoder)(Scene()) is told  # made once
    assert (
        geometry_source("obstacles") is ground_truth_checker
        and geometry_source("points") is observed_checker
    )
    # The true obstacles count for nothing.
    boxed = Scene((Box((0.0, 0.5, 0.4), (0.3, 0.3, 0.3)),))
    np.testing.assert_array_equal(
        decoded_checker(boxed, encoder).signed_distances(states).distance, expected
    )


class NotANumber(DistanceFromTheBall):
    def forward(self, latent, points):
        return super().forward(latent, points) * float("nan")


class OneNumber(DistanceFromTheBall):
    def forward(self, latent, points):
        return super().forward(latent, points)[:, :1]


@pytest.mark.parametrize("decoder", [NotANumber, OneNumber])
def test_what_tells_nothing_is_refused(decoder, encoder, tmp_path):
    """It must not be taken for a scene without obstacles."""
    path = tmp_path / "encoder.pt"
    path.write_bytes(Path(encoder).read_bytes())
    inputs = {"latent": torch.rand(2, 4), "points": torch.rand(2, 5, 3)}
    save_network(path.with_suffix(".decoder.pt"), decoder(), inputs, {"kind": "field"})
    with pytest.raises(NetworkError, match=r"encoder.decoder.pt: its output is not"):
        decoded_points(Scene(), str(path))


def test_nothing_may_be_there(tmp_path, encoder):
    path = tmp_path / "encoder.pt"
    path.write_bytes(Path(encoder).read_bytes())
    inputs = {"latent": torch.rand(2, 4), "points": torch.rand(2, 5, 3)}
    save_network(path.with_suffix(".decoder.pt"), FarAway(), inputs, {"kind": "field"})
    assert decoded_points(Scene(), str(path)).shape == (0, 3)
    states = np.random.default_rng(0).uniform(-1, 1, (50, 7))
    one, other = (check(Scene(())) for check in (geometry_source(str(path)), ground_truth_checker))
    np.testing.assert_array_equal(one.is_free(states), other.is_free(states))


class FarAway(DistanceFromTheBall):
    def forward(self, latent, points):
        return 5.0 + super().forward(latent, points)


def test_cells_that_are_told(encoder):
    """Those of `benchmarks/scene_knowledge.py`: how many are right, and links' distances."""
    sys.path.append(str(ROOT / "benchmarks"))
    knowledge = importlib.import_module("scene_knowledge")
    points = decoded_points(Scene(), encoder)
    inside = points[np.linalg.norm(points - BALL[:3], axis=1) < BALL[3]]
    cells = knowledge.told_cells(inside)
    at = np.unique(np.floor((inside - knowledge.LOW) / knowledge.CELL).astype(int), axis=0)
    assert 4 <= len(at) == cells.sum() and cells.reshape(knowledge.SHAPE)[tuple(at.T)].all()
    truth = knowledge.occupied([Sphere(BALL[:3], BALL[3])]).ravel()
    assert (truth | ~cells).all()
    scenes, cells = [Scene((Sphere(BALL[:3], BALL[3]),))] * 2, np.stack([truth, truth])
    data = knowledge.link_distances(scenes, 0)
    found = knowledge.decoded(encoder, scenes, cells, scenes, cells, data)
    assert 0.5 < found["decoded_iou"] <= 1.0 and 0.0 < found["decoded_cm"] < 2.0


def test_in_an_environment(encoder):
    env = envs.make(
        "random_boxes_hard",
        goal_type="combined",
        encoder=f"points:8:{encoder}",
        link_distances=encoder,
    )
    observation, _ = env.reset(seed=1)
    assert env.encoder.size == 24 and env.encoder.row_size == 3
    assert env.encoder.link_distances == encoder
    told = observation["observation"][10:].reshape(8, 3)
    away = np.linalg.norm(told - BALL[:3], axis=1)
    assert (away < BALL[3] + DECODED_REACH + 1e-4).all() and away.max() > BALL[3] - DECODED_CELL
    distances = decoded_checker(env.scene, encoder).signed_distances(
        observation["observation"][:7], self_collisions=False
    )
    np.testing.assert_allclose(
        observation["link_distances"][:, 0], distances.distance.clip(max=0.3), atol=1e-5
    )
    env.close()


def test_what_encoders_can_tell():
    assert SceneEncoder("oracle").link_distances == "obstacles"
    assert SceneEncoder("points:5").link_distances == SceneEncoder("vae").link_distances == "points"
    for name in ("points:8:vae", "points:8:oracle"):
        with pytest.raises(NetworkError, match="has no decoder: it cannot tell how far"):
            SceneEncoder(name)
    with pytest.raises(ValueError, match="vae has no decoder"):
        envs.make("wall", link_distances="vae")
    with pytest.raises(ValueError, match="nowhere: cannot be read"):
        geometry_source("nowhere")


def test_only_what_was_seen_is_told():
    seen = {"goal_type": "config", "encoder": "points:32", "link_distances": "points"}
    told = {"goal_type": "config", "encoder": "points:32:field", "link_distances": "field"}
    assert with_decoded("field", seen) == told and seen["encoder"] == "points:32"
    assert with_decoded("field", {"encoder": "points"}) == {"encoder": "points:64:field"}
    assert with_decoded("field", {"link_distances": "points"}) == {"link_distances": "field"}
    fuse = {"encoder": "vae", "link_distances": "points"}
    assert with_decoded("field", fuse) == {"encoder": "vae", "link_distances": "field"}
    true = {"encoder": "oracle", "link_distances": "obstacles"}
    assert with_decoded("field", true) == true and with_decoded("field", {}) == {}


def test_a_policy_of_points_knows_only_what_is_told(encoder):
    options = dict(split="validation", num_queries=2)
    seen = evaluate(POLICY, "random_boxes_hard", **options)
    told = evaluate(POLICY, "random_boxes_hard", encoder=encoder, **options)
    assert (
        told["env"]["encoder"] == f"points:32:{encoder}"
        and told["env"]["link_distances"] == encoder
    )
    assert told["safety_filter"] == seen["safety_filter"] and told["encoder"] == encoder
    assert told["mean_steps"] != seen["mean_steps"]
    alone = evaluate(POLICY, "wall", encoder=encoder, safety_filter=False, **options)
    assert alone["env"]["link_distances"] == encoder and alone["safety_filter"] is None
    planned = evaluate("planner", "random_boxes_hard", encoder=encoder, **options)
    assert planned["encoder"] == encoder
    for policy in ("bc-ee-double_walls-s1", "go-to-goal"):
        with pytest.raises(EvaluationError, match="encoder is for via-points, planner"):
            evaluate(policy, "double_walls", encoder=encoder, **options)
    with pytest.raises(EvaluationError, match="vae has no decoder"):
        evaluate(POLICY, "random_boxes_hard", encoder="vae", **options)
