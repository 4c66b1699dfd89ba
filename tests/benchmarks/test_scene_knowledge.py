"""What z_E knows of a scene: the cells by hand, the probe on latents that say everything."""

import importlib.util
import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from paths import ROOT

from roboarm_nmp.envs import panda
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.datasets.demonstrations import load_demos
from roboarm_nmp.envs.perception.encoders import oracle, scene_encoder
from roboarm_nmp.envs.scenes.primitives import Box, Scene, Sphere

spec = importlib.util.spec_from_file_location(
    "scene_knowledge", ROOT / "benchmarks" / "scene_knowledge.py"
)
knowledge = importlib.util.module_from_spec(spec)
spec.loader.exec_module(knowledge)


def test_cells_by_hand():
    # A pole inside one column of cells: from x, y = 0.2 to 0.4, five cells high.
    pole = Box((0.3, 0.3, 0.45), (0.05, 0.05, 0.9))
    cells = knowledge.occupied([pole])
    assert cells.sum() == 5 and cells[5, 5, :5].all()
    # A board of 0.6 x 0.1, turned by 45 degrees around the middle between cells.
    turned = (0.0, 0.0, math.sin(math.pi / 8), math.cos(math.pi / 8))
    board = knowledge.occupied([Box((0.0, 0.0, 0.5), (0.6, 0.1, 0.02), turned)])
    assert board.sum(axis=(0, 1)).tolist() == [0, 0, board.sum(), 0, 0, 0, 0, 0]
    # Its ends are at (0.18, 0.25) and (0.25, 0.18), and opposite.
    expected = {(4, 4), (4, 5), (5, 4), (5, 5), (3, 3), (2, 3), (3, 2), (2, 2), (3, 4), (4, 3)}
    assert set(zip(*board.any(2).nonzero(), strict=True)) == expected
    ball = knowledge.occupied([Sphere((0.3, 0.3, 0.5), 0.09)])
    assert ball.sum() == 1 and ball[5, 5, 2]
    assert (knowledge.occupied([pole, Box((-0.5, 0, 0.1), (0.1, 0.1, 0.1))]) | ~cells).all()


def test_against_points():
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
    inside = np.zeros(knowledge.SHAPE, bool)
    inside[tuple(((points - knowledge.LOW) / knowledge.CELL).astype(int).T)] = True
    np.testing.assert_array_equal(knowledge.occupied([box]), inside)


def test_figures_of_perfect_and_no_knowledge():
    rng = np.random.default_rng(0)
    cells = rng.random((100, 30)) < 0.3
    means = cells.mean(0)
    perfect = knowledge.figures(cells.astype(float), means, cells)
    assert perfect["iou"] == 1 and perfect["information"] == pytest.approx(1, abs=1e-4)
    none = knowledge.figures(np.tile(means, (100, 1)), means, cells)
    assert none == {"information": 0, "iou": 0}


@pytest.mark.parametrize("is_set", [False, True])
def test_the_probe_finds_what_the_codes_say(is_set):
    rng = np.random.default_rng(0)
    if is_set:
        places = [rng.uniform(-0.6, 0.6, (rng.integers(1, 4), 2)) for _ in range(1500)]
        scenes = [Scene(tuple(Box((*xy, 0.1), (0.1, 0.1, 0.1)) for xy in one)) for one in places]
        latents = np.stack([oracle(scene) for scene in scenes])
        cells = np.stack([knowledge.occupied(scene.obstacles).ravel() for scene in scenes])
        cells = cells[:, cells.any(0)]
    else:
        latents = rng.normal(size=(1500, 6)).astype(np.float32)
        cells = latents > 0
    probabilities = knowledge.probe(latents[:1200], cells[:1200], latents[1200:], is_set)
    found = knowledge.figures(probabilities, cells[:1200].mean(0), cells[1200:])
    assert found["information"] > 0.6 and found["iou"] > 0.5


def test_a_set_of_obstacles_is_their_union():
    class Fixed(torch.nn.Module):
        def forward(self, rows):
            return rows[..., 2:4]  # logits of two cells: the position's x and y

    latents = torch.as_tensor(
        oracle(Scene((Sphere((0.5, -1.0, 0), 0.1), Sphere((2.0, -0.5, 0), 0.1))))
    )
    logits = knowledge.AnyObstacle(Fixed())(latents[None])[0]
    one, other = torch.sigmoid(torch.tensor([[0.5, -1.0], [2.0, -0.5]]))
    torch.testing.assert_close(torch.sigmoid(logits), 1 - (1 - one) * (1 - other))


def test_where_links_are_and_how_far_from_obstacles():
    scenes = [Scene((Sphere((0.5, 0.0, 0.5), 0.1),)), Scene(())]
    places, distances, states = knowledge.link_distances(scenes, 3)
    assert places.shape == (2, knowledge.POSES, 63) and distances.shape == (2, knowledge.POSES, 10)
    # The end-effector is 0.212 m along the last joint's axis.
    tips = places[..., 54:57] + 0.212 * places[..., 60:63]
    np.testing.assert_allclose(tips, panda.forward_kinematics(panda.denormalise(states)), atol=1e-5)
    assert (distances[1] == np.float32(knowledge.FAR)).all()  # no table, no floor
    bare = Scene(scenes[0].obstacles, table=None, floor=None)
    expected = CollisionChecker(bare).signed_distances(states[0], self_collisions=False).distance
    np.testing.assert_allclose(distances[0], np.minimum(expected, knowledge.FAR), atol=1e-6)


def test_the_nearest_of_a_set_of_obstacles_counts():
    class Fixed(torch.nn.Module):
        def forward(self, rows):
            return rows[..., 2:4] + rows[..., -1:]  # the position's x and y, and a link's place

    spheres = Sphere((0.2, 0.3, 0), 0.1), Sphere((0.1, 0.35, 0), 0.1)
    inputs = torch.as_tensor([*oracle(Scene(spheres)), 0.01])[None]
    found = knowledge.NearestObstacle(Fixed())(inputs)[0]
    torch.testing.assert_close(found, torch.tensor([0.11, 0.31]))


@pytest.mark.parametrize("is_set", [False, True])
def test_the_second_probe_finds_what_the_codes_say(is_set):
    rng = np.random.default_rng(0)
    middles = rng.uniform([-0.5, -0.5, 0.2], [0.5, 0.5, 0.8], (400, 3))
    scenes = [Scene((Sphere(tuple(middle), 0.1),)) for middle in middles.tolist()]
    latents = middles.astype(np.float32)
    if is_set:
        latents = np.stack([oracle(scene) for scene in scenes])
    data = knowledge.link_distances(scenes[:300], 0), knowledge.link_distances(scenes[300:], 1)
    data = latents[:300], data[0], latents[300:], data[1]
    knows = knowledge.distance_probe(*data, is_set, epochs=40)
    nothing = np.zeros((400, 1), np.float32)
    guesses = knowledge.distance_probe(nothing[:300], data[1], nothing[300:], data[3], epochs=40)
    assert 0.0 < knows < 0.75 * guesses


def test_encoders_with_the_same_sensors_look_together_and_what_a_decoder_tells():
    demos = load_demos("random_boxes_hard")
    scenes = [demos.scenes[i] for i in range(12)]
    found = knowledge.latents(["vae", "field", "vqvae"], scenes[:3])
    for name, z in found.items():
        np.testing.assert_array_equal(z, [scene_encoder(name)(scene) for scene in scenes[:3]])
    cells = np.stack([knowledge.occupied(scene.obstacles).ravel() for scene in scenes])
    data = knowledge.link_distances(scenes[6:], 0)
    told = knowledge.decoded("field", scenes[:6], cells[:6], scenes[6:], cells[6:], data)
    assert 0.7 < told["decoded_iou"] < 1 and 0.1 < told["decoded_cm"] < 3
    # Of other scenes they tell nothing.
    other = knowledge.decoded("field", scenes[:6], cells[:6], scenes[:6], cells[6:], data)
    assert other["decoded_iou"] < 0.5 and other["decoded_cm"] > 5


def test_inference_times(tmp_path):
    command = [sys.executable, str(ROOT / "benchmarks" / "inference_time.py"), "--num", "3"]
    policy = "bc-combined-no_obstacles-s1"
    done = subprocess.run([*command, policy], capture_output=True, text=True, check=True)
    times = json.loads(done.stdout.splitlines()[-1])
    assert times["num_queries"] == 3 and times[policy]["encoding"] == 0
    assert 0 < times[policy]["action"] < times[policy]["total"] < 60
    assert times["RRT-Connect"]["rendering"] == 0 < times["RRT-Connect"]["planning"] < 5.5
    seen = times["RRT-Connect, points"]
    assert seen["rendering"] > 0.001 and seen["total"] > seen["planning"]
