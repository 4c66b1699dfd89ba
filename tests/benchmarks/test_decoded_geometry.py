"""Benchmark of geometry in latent codes: cells by hand, probes on latents with all information."""

import importlib.util
import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from paths import ROOT

from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.encoders import make_encoder
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Box, Scene, Sphere

oracle = make_encoder("oracle")
spec = importlib.util.spec_from_file_location(
    "decoded_geometry", ROOT / "benchmarks" / "decoded_geometry.py"
)
benchmark = importlib.util.module_from_spec(spec)
spec.loader.exec_module(benchmark)


def test_occupied_cells_by_hand():
    # A pole inside one column of cells: from x, y = 0.2 to 0.4, five cells high.
    pole = Box((0.3, 0.3, 0.45), (0.05, 0.05, 0.9))
    cells = benchmark.occupied([pole])
    assert cells.sum() == 5 and cells[5, 5, :5].all()
    # A board of 0.6 x 0.1, turned by 45 degrees around the middle between cells.
    turned = (0.0, 0.0, math.sin(math.pi / 8), math.cos(math.pi / 8))
    board = benchmark.occupied([Box((0.0, 0.0, 0.5), (0.6, 0.1, 0.02), turned)])
    assert board.sum(axis=(0, 1)).tolist() == [0, 0, board.sum(), 0, 0, 0, 0, 0]
    # Its ends are at (0.18, 0.25) and (0.25, 0.18), and opposite.
    expected = {(4, 4), (4, 5), (5, 4), (5, 5), (3, 3), (2, 3), (3, 2), (2, 2), (3, 4), (4, 3)}
    assert set(zip(*board.any(2).nonzero(), strict=True)) == expected
    ball = benchmark.occupied([Sphere((0.3, 0.3, 0.5), 0.09)])
    assert ball.sum() == 1 and ball[5, 5, 2]
    assert (benchmark.occupied([pole, Box((-0.5, 0, 0.1), (0.1, 0.1, 0.1))]) | ~cells).all()


def test_occupied_cells_contain_the_points_of_a_box():
    rng = np.random.default_rng(0)
    half = rng.uniform(0, math.pi)
    box = Box((0.1, -0.2, 0.7), (0.5, 0.3, 0.2), (0.0, 0.0, math.sin(half), math.cos(half)))
    edges = [
        np.linspace(-0.5, 0.5, number) * size
        for number, size in zip((250, 150, 30), box.size, strict=True)
    ]
    points = np.stack(np.meshgrid(*edges), axis=-1).reshape(-1, 3)  # 2 mm apart, 7 in height
    cos, sin = math.cos(2 * half), math.sin(2 * half)
    points = points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + box.position
    inside = np.zeros(benchmark.SHAPE, bool)
    inside[tuple(((points - benchmark.LOW) / benchmark.CELL).astype(int).T)] = True
    np.testing.assert_array_equal(benchmark.occupied([box]), inside)


def test_scores_of_perfect_predictions_and_of_the_mean():
    rng = np.random.default_rng(0)
    cells = rng.random((100, 30)) < 0.3
    means = cells.mean(0)
    perfect = benchmark.scores(cells.astype(float), means, cells)
    assert perfect["iou"] == 1 and perfect["information"] == pytest.approx(1, abs=1e-4)
    none = benchmark.scores(np.tile(means, (100, 1)), means, cells)
    assert none == {"information": 0, "iou": 0}


@pytest.mark.parametrize("is_set", [False, True])
def test_probe_predicts_cells_from_informative_latents(is_set):
    rng = np.random.default_rng(0)
    if is_set:
        places = [rng.uniform(-0.6, 0.6, (rng.integers(1, 4), 2)) for _ in range(1500)]
        scenes = [Scene(tuple(Box((*xy, 0.1), (0.1, 0.1, 0.1)) for xy in one)) for one in places]
        latents = np.stack([oracle(scene) for scene in scenes])
        cells = np.stack([benchmark.occupied(scene.obstacles).ravel() for scene in scenes])
        cells = cells[:, cells.any(0)]
    else:
        latents = rng.normal(size=(1500, 6)).astype(np.float32)
        cells = latents > 0
    probabilities = benchmark.probe(latents[:1200], cells[:1200], latents[1200:], is_set)
    found = benchmark.scores(probabilities, cells[:1200].mean(0), cells[1200:])
    assert found["information"] > 0.6 and found["iou"] > 0.5


def test_set_probe_combines_obstacles_as_their_union():
    class Fixed(torch.nn.Module):
        def forward(self, rows):
            return rows[..., 2:4]  # logits of two cells: the position's x and y

    latents = torch.as_tensor(
        oracle(Scene((Sphere((0.5, -1.0, 0), 0.1), Sphere((2.0, -0.5, 0), 0.1))))
    )
    logits = benchmark.AnyObstacle(Fixed())(latents[None])[0]
    one, other = torch.sigmoid(torch.tensor([[0.5, -1.0], [2.0, -0.5]]))
    torch.testing.assert_close(torch.sigmoid(logits), 1 - (1 - one) * (1 - other))


def test_link_places_and_distances_equal_kinematics_and_checker():
    scenes = [Scene((Sphere((0.5, 0.0, 0.5), 0.1),)), Scene(())]
    places, distances, states = benchmark.link_distances(scenes, 3)
    assert places.shape == (2, benchmark.POSES, 63) and distances.shape == (2, benchmark.POSES, 10)
    # The end-effector is 0.212 m along the last joint's axis.
    tips = places[..., 54:57] + 0.212 * places[..., 60:63]
    np.testing.assert_allclose(tips, PANDA.forward_kinematics(PANDA.denormalise(states)), atol=1e-5)
    assert (distances[1] == np.float32(benchmark.FAR)).all()  # no table, no floor
    bare = Scene(scenes[0].obstacles, table=None, floor=None)
    expected = CollisionChecker(bare).signed_distances(states[0], self_collisions=False).distance
    np.testing.assert_allclose(distances[0], np.minimum(expected, benchmark.FAR), atol=1e-6)


def test_set_probe_predicts_the_distance_of_the_nearest_obstacle():
    class Fixed(torch.nn.Module):
        def forward(self, rows):
            return rows[..., 2:4] + rows[..., -1:]  # the position's x and y, and a link's place

    spheres = Sphere((0.2, 0.3, 0), 0.1), Sphere((0.1, 0.35, 0), 0.1)
    inputs = torch.as_tensor([*oracle(Scene(spheres)), 0.01])[None]
    found = benchmark.NearestObstacle(Fixed())(inputs)[0]
    torch.testing.assert_close(found, torch.tensor([0.11, 0.31]))


@pytest.mark.parametrize("is_set", [False, True])
def test_distance_probe_predicts_distances_from_informative_latents(is_set):
    rng = np.random.default_rng(0)
    middles = rng.uniform([-0.5, -0.5, 0.2], [0.5, 0.5, 0.8], (400, 3))
    scenes = [Scene((Sphere(tuple(middle), 0.1),)) for middle in middles.tolist()]
    latents = middles.astype(np.float32)
    if is_set:
        latents = np.stack([oracle(scene) for scene in scenes])
    data = benchmark.link_distances(scenes[:300], 0), benchmark.link_distances(scenes[300:], 1)
    data = latents[:300], data[0], latents[300:], data[1]
    informed = benchmark.distance_probe(*data, is_set, epochs=40)
    nothing = np.zeros((400, 1), np.float32)
    guesses = benchmark.distance_probe(nothing[:300], data[1], nothing[300:], data[3], epochs=40)
    assert 0.0 < informed < 0.75 * guesses


def test_latents_equal_the_encoders_and_decoded_errors_are_small():
    demos = load_demos("random_boxes_hard")
    scenes = [demos.scenes[i] for i in range(12)]
    found = benchmark.latents(["vae", "field", "vqvae"], scenes[:3])
    for name, z in found.items():
        np.testing.assert_array_equal(z, [make_encoder(name)(scene) for scene in scenes[:3]])
    cells = np.stack([benchmark.occupied(scene.obstacles).ravel() for scene in scenes])
    data = benchmark.link_distances(scenes[6:], 0)
    decoded = benchmark.decoded("field", scenes[:6], cells[:6], scenes[6:], cells[6:], data)
    assert 0.7 < decoded["decoded_iou"] < 1 and 0.1 < decoded["decoded_cm"] < 3
    # Decoded points of other scenes do not fit.
    other = benchmark.decoded("field", scenes[:6], cells[:6], scenes[:6], cells[6:], data)
    assert other["decoded_iou"] < 0.5 and other["decoded_cm"] > 5


def test_inference_times(tmp_path):
    command = [sys.executable, str(ROOT / "benchmarks" / "inference_time.py"), "--num", "3"]
    policy = "bc-combined-no_obstacles-s1"
    done = subprocess.run([*command, policy], capture_output=True, text=True, check=True)
    times = json.loads(done.stdout.splitlines()[-1])
    assert times["num_queries"] == 3 and times[policy]["encoding"] == 0
    assert 0 < times[policy]["action"] < times[policy]["total"] < 60
    assert times["RRT-Connect"]["rendering"] == 0 < times["RRT-Connect"]["planning"] < 5.5
    seen = times["RRT-Connect, point_cloud"]
    assert seen["rendering"] > 0.001 and seen["total"] > seen["planning"]
