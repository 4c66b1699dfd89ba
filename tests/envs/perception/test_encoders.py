"""The scene encoders' trainers: their mathematics, and runs on a few small pictures."""

import copy
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import h5py
import numpy as np
import pybullet as p
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from one_type import OneType
from paths import ROOT
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainers import GPU, run_here

from roboarm_nmp import envs
from roboarm_nmp.envs.datasets.demonstrations import load_demos
from roboarm_nmp.envs.datasets.observations import Observations
from roboarm_nmp.envs.datasets.queries import load_queries
from roboarm_nmp.envs.networks.exported_networks import load_network, save_network
from roboarm_nmp.envs.networks.operations import NetworkError
from roboarm_nmp.envs.perception.encoders import (
    MAX_OBSTACLES,
    PRETRAINED,
    SceneEncoder,
    oracle,
    pretrained_encoders,
)
from roboarm_nmp.envs.perception.sensors import OBSTACLE, PointCloud
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene, Sphere, from_array
from roboarm_nmp.envs.wrappers import SceneEncodingWrapper
from roboarm_nmp.scene_embedding_train import clouds, collect, pictures
from roboarm_nmp.scene_embedding_train.training_data import load_obstacles

FOLDER = ROOT / "scene_embedding_train"
SCRIPTS = ("vae", "vqvae", "pointnet2", "field")
OF_CLOUDS = ("pointnet2", "field")
TINY = ["--total-updates", "8", "--eval-every", "4", "--eval-scenes", "6", "--batch-size", "8"]
TINY += ["--width", "4", "--validation-share", "0.3"]
TINY_CLOUDS = ["--num-points", "64", "--num-queries", "50"]
TINY_POINTNET = ["--num-centres", "8", "4", "--num-neighbours", "4"]


def load(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


vae, vqvae, pointnet2, field = (load(name) for name in SCRIPTS)


@pytest.fixture(scope="module")
def observations(tmp_path_factory):
    folder = tmp_path_factory.mktemp("observations")
    options = {"num": 20, "shard_size": 8, "image_size": 32, "num_samples": 400, "workers": 1}
    collect.collect(collect.Args(output=folder, **options), progress=False)
    return folder


def command(name, observations, folder, *flags):
    script = [sys.executable, str(FOLDER / f"{name}.py"), "--observations", str(observations)]
    tiny = [*TINY, *(TINY_CLOUDS if name in OF_CLOUDS else ["--picture-size", "16"])]
    tiny += TINY_POINTNET if name == "pointnet2" else []
    return [*script, "--runs-dir", str(folder), *tiny, *flags]


@pytest.fixture(scope="module", params=SCRIPTS)
def run(request, observations, tmp_path_factory):
    """(name, folder) of a finished run."""
    folder = tmp_path_factory.mktemp(request.param)
    run_here(*command(request.param, observations, folder)[1:])
    return request.param, next(folder.iterdir())


# --- Mathematics


def test_kl_divergence():
    mean, log_variance = torch.randn(5, 7), torch.randn(5, 7)
    normal = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    expected = torch.distributions.kl_divergence(normal, torch.distributions.Normal(0.0, 1.0))
    torch.testing.assert_close(vae.kl_divergence(mean, log_variance), expected)


def test_quantisation_takes_the_nearest_code():
    codebook = vqvae.Codebook(vqvae.Args(num_codes=20, code_size=3))
    vectors = torch.randn(4, 5, 3)
    quantised, numbers = codebook(vectors)
    for vector, code, number in zip(
        vectors.flatten(0, 1), quantised.flatten(0, 1), numbers, strict=True
    ):
        distances = [float((vector - one).square().sum()) for one in codebook.codes]
        assert number == np.argmin(distances)
        torch.testing.assert_close(code, codebook.codes[number])


def test_the_gradient_goes_straight_through():
    latent = torch.randn(6, 3, requires_grad=True)
    quantised = torch.randn(6, 3, requires_grad=True)
    out = vqvae.straight_through(latent, quantised)
    torch.testing.assert_close(out, quantised)
    weights = torch.randn(6, 3)
    (out * weights).sum().backward()
    torch.testing.assert_close(latent.grad, weights)
    assert quantised.grad is None or not quantised.grad.any()


def test_unused_codes_start_again_as_vectors():
    codebook = vqvae.Codebook(vqvae.Args(num_codes=6, code_size=2))
    before, vectors = codebook.codes.detach().clone(), torch.randn(50, 2)
    codebook.uses += torch.tensor([1.0, 0, 2, 0, 0, 5])
    codebook.restart(vectors)
    for number in (0, 2, 5):
        torch.testing.assert_close(codebook.codes[number], before[number])
    for number in (1, 3, 4):
        assert (codebook.codes[number] == vectors).all(1).any()
    assert not codebook.uses.any()


def one_update(module, model, batch, args, *inputs):
    """What `module.update` returns, with Adam."""
    optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)
    return module.update(model, optimizer, batch, *inputs, args)


def check_step(model, before, loss, lr):
    """`model` is where Adam's first step leads from the weights `before`, whose loss was `loss`.

    That is by the learning rate against the sign of the gradient.
    """
    gradients = torch.autograd.grad(loss, list(before.parameters()), allow_unused=True)
    checked = 0
    for old, new, gradient in zip(before.parameters(), model.parameters(), gradients, strict=True):
        gradient = torch.zeros_like(old) if gradient is None else gradient
        clear = (gradient.abs() > 1e-5) | (gradient == 0)  # beside Adam's epsilon
        expected = (old - lr * gradient.sign())[clear]
        torch.testing.assert_close(new[clear], expected, rtol=0, atol=0.02 * lr)
        checked += int((gradient.abs() > 1e-5).sum())
    assert checked > 100


def test_one_update_of_the_vae():
    torch.manual_seed(0)
    args = vae.Args(width=4, kl_weight=0.7, foreground_weight=3.0, learning_rate=0.01)
    model, mean_image = vae.VAE(2, 16, args), torch.full((2, 3, 16, 16), 0.5)
    images = 0.35 + 0.3 * torch.rand(5, 2, 3, 16, 16)  # some within 0.1 of the mean picture
    before = copy.deepcopy(model)
    torch.manual_seed(1)
    losses = one_update(vae, model, images, args, mean_image)
    torch.manual_seed(1)
    mean, log_variance = before.encode(images)
    normal = torch.distributions.Normal(mean, (log_variance / 2).exp())
    decoded = before.decode(mean + normal.stddev * torch.randn(5, 32))
    far = ((images - 0.5).abs() > 0.1).any(2, keepdim=True).expand_as(images)
    assert 0.1 < far.float().mean() < 0.99
    errors = (decoded - images) ** 2
    error = (errors.sum() + 3.0 * errors[far].sum()) / (far.numel() + 3.0 * far.sum())
    standard = torch.distributions.Normal(0.0, 1.0)
    kl = torch.distributions.kl_divergence(normal, standard).mean()
    torch.testing.assert_close(losses["reconstruction"], error)
    torch.testing.assert_close(losses["kl"], kl)
    torch.testing.assert_close(losses["loss"], error + 0.7 * kl)
    check_step(model, before, error + 0.7 * kl, args.learning_rate)


def test_one_update_of_the_vqvae():
    torch.manual_seed(0)
    options = {"width": 4, "num_codes": 8, "commitment": 0.6, "foreground_weight": 0.0}
    args = vqvae.Args(**options, learning_rate=0.01)
    model, images = vqvae.VQVAE(2, 16, args), torch.rand(5, 2, 3, 16, 16)
    before = copy.deepcopy(model)
    losses, latents = one_update(vqvae, model, images, args, torch.zeros(2, 3, 16, 16))
    error = codes = commitment = 0.0
    for i in range(2):
        z, book = before.encoders[i](images[:, i]), before.codebooks[i].codes
        nearest = (z.unsqueeze(2) - book).square().sum(3).argmin(2)
        torch.testing.assert_close(latents[i], z.detach())
        assert model.codebooks[i].uses.tolist() == [(nearest == k).sum() for k in range(8)]
        quantised = book[nearest]
        # The value of the codes; the gradient goes to z only.
        through = quantised.detach() + z - z.detach()
        decoded = before.decoders[i](through.flatten(1))
        error = error + (decoded - images[:, i]).square().mean() / 2
        codes = codes + (quantised - z.detach()).square().mean() / 2
        commitment = commitment + (quantised.detach() - z).square().mean()
    loss = error + codes + 0.6 * commitment / 2
    torch.testing.assert_close(losses["reconstruction"], error)
    torch.testing.assert_close(losses["commitment"], commitment)
    torch.testing.assert_close(losses["loss"], loss)
    check_step(model, before, loss, args.learning_rate)


def test_one_update_of_pointnet2():
    torch.manual_seed(0)
    sizes = {"num_points": 20, "num_centres": (8, 4), "num_neighbours": 4, "num_queries": 30}
    args = pointnet2.Args(width=4, learning_rate=0.01, **sizes)
    model = pointnet2.PointNet2(2, args)
    before, batch = copy.deepcopy(model), []
    for _ in range(2):
        points, labels = torch.rand(3, 2, 20, 3), torch.randint(4, (3, 2, 20))
        batch.append((points, labels, points.flatten(1, 2)))
    torch.manual_seed(1)
    loss = one_update(pointnet2, model, batch, args)
    torch.manual_seed(1)
    surprise = []
    for (points, labels, whole), encoder, decoder in zip(
        batch, before.encoders, before.decoders, strict=True
    ):
        queries, classes = pointnet2.queries_of(points, labels, whole, 30)
        chances = decoder(encoder(points[:, 1]), queries).softmax(2)
        for scene, row in zip(chances, classes.tolist(), strict=True):
            surprise += [-scene[j, k].log() for j, k in enumerate(row) if k != pointnet2.IGNORED]
    expected = sum(surprise) / len(surprise)
    torch.testing.assert_close(loss, expected)
    check_step(model, before, expected, args.learning_rate)


OBSTACLES = (
    Box((0.3, 0.2, 0.5), (0.2, 0.1, 0.3), (0.5, 0.5, -0.1, 0.7)),
    Cylinder((-0.3, 0.2, 0.6), 0.1, 0.3, (0.1, -0.7, 0.1, 0.7)),
    Sphere((0.0, -0.4, 0.3), 0.12),
)


def test_distances_are_pybullets():
    client = p.connect(p.DIRECT)
    tip = p.createCollisionShape(p.GEOM_SPHERE, radius=1e-4, physicsClientId=client)
    tip = p.createMultiBody(0, tip, physicsClientId=client)
    box, cylinder, sphere = OBSTACLES
    half = [edge / 2 for edge in box.size]
    size = {"radius": cylinder.radius, "height": cylinder.length}
    shapes = [
        p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client),
        p.createCollisionShape(p.GEOM_CYLINDER, **size, physicsClientId=client),
        p.createCollisionShape(p.GEOM_SPHERE, radius=sphere.radius, physicsClientId=client),
    ]
    turns = [box.orientation, cylinder.orientation, (0.0, 0.0, 0.0, 1.0)]
    bodies = [
        p.createMultiBody(0, shape, -1, obstacle.position, turn, physicsClientId=client)
        for obstacle, shape, turn in zip(OBSTACLES, shapes, turns, strict=True)
    ]
    points = np.random.default_rng(0).uniform([-0.6, -0.6, 0.0], [0.6, 0.6, 1.0], (2_000, 3))
    expected = []
    for point in points:
        p.resetBasePositionAndOrientation(tip, point, (0, 0, 0, 1), physicsClientId=client)
        found = (p.getClosestPoints(tip, body, 0.5, physicsClientId=client) for body in bodies)
        expected.append(min((one[8] + 1e-4 for some in found for one in some), default=0.5))
    p.disconnect(client)
    rows = oracle(Scene(OBSTACLES)).reshape(1, MAX_OBSTACLES, 12)
    points = torch.tensor(points[None], dtype=torch.float32)
    found = field.distances(torch.from_numpy(rows), points)[0].numpy()
    assert (found < 0.0).sum() > 20 and (found == field.FARTHEST).sum() > 20
    # (Bullet's boxes and cylinders have rounded edges, and its depths are those of GJK and EPA.)
    np.testing.assert_allclose(found, np.clip(expected, -0.05, 0.4), atol=1.5e-3)


def test_points_are_asked_about_around_all_obstacles_alike():
    torch.manual_seed(0)
    rows = torch.zeros(2, MAX_OBSTACLES, 12)
    rows[0] = torch.from_numpy(oracle(Scene(OBSTACLES)).reshape(MAX_OBSTACLES, 12))
    asked = field.queries(rows, 6_000, 1e-3)  # (the second scene is empty)
    assert asked.shape == (2, 6_000, 3) and asked.isfinite().all()
    anywhere = asked[:, 3_000:]
    low, high = torch.tensor([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.5]])
    assert ((anywhere >= low) & (anywhere <= high)).all()
    assert (anywhere.mean((0, 1)) - (low + high) / 2).abs().max() < 0.05
    alone = [rows[:1, i : i + 1] for i in range(3)]
    near = torch.stack([field.distances(one, asked[:1, :3_000]) for one in alone])
    # That much of the box around the cylinder, or around half of the sphere, is inside of them.
    shares = (near < 0.003).float().mean((1, 2)) * 3
    np.testing.assert_allclose(shares, [1.0, np.pi / 4, np.pi / 4 * 11 / 12], atol=0.06)


def test_turned_scenes_keep_their_distances_from_points():
    torch.manual_seed(0)
    places, others = torch.randn(5, 7, 3), torch.randn(5, 9, 3)
    turned, turned_others = field.augment(places, others)
    torch.testing.assert_close(torch.cdist(turned, turned_others), torch.cdist(places, others))
    torch.testing.assert_close(turned[..., 2], places[..., 2])
    assert (turned - places).abs().amax((1, 2)).min() > 0.01
    edges = turned[:, 1:4, :2] - turned[:, :1, :2]
    before = places[:, 1:4, :2] - places[:, :1, :2]
    signs = torch.linalg.det(edges[:, :2]) / torch.linalg.det(before[:, :2])
    assert set(signs.round().tolist()) == {-1.0, 1.0}  # some are mirrored


def test_cells_around_the_axis():
    """A point is in the cells whose middles it is between, all around the circle."""
    angle = torch.tensor([0.0, 1.0, 3.14, -3.14, -2.0])
    points = torch.stack([0.4 * angle.cos(), 0.4 * angle.sin(), torch.full((5,), 0.3)], dim=1)
    angles, radii, heights = field.cylindrical(points)
    for cells in (angles, radii, heights):
        torch.testing.assert_close(cells.sum(1), torch.ones(5))
    middles = (np.arange(field.ANGLES) + 0.5) / field.ANGLES * 2 * np.pi - np.pi
    found = (angles.numpy() * np.exp(1j * middles)).sum(1)
    np.testing.assert_allclose(np.angle(found * np.exp(-1j * angle.numpy())), 0.0, atol=1e-3)
    radius = (radii @ ((torch.arange(field.RADII) + 0.5) / field.RADII * field.REACH)).numpy()
    np.testing.assert_allclose(radius, 0.4, atol=1e-6)


def test_sectors_that_turn_give_parts_of_the_latent_that_turn():
    torch.manual_seed(0)
    args = field.Args(width=8, latent_size=16)
    model, eighth = field.Field(4, args).eval(), 2 * np.pi / field.SECTORS
    points, there = torch.rand(3, 20, 3) - 0.5, torch.rand(3, 20) < 0.8
    c, s = np.cos(eighth), np.sin(eighth)
    turn = torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float32)
    z, turned = model.encode(points, there), model.encode(points @ turn, there)
    expected = z.unflatten(1, (field.SECTORS, -1)).roll(1, 1).flatten(1)
    torch.testing.assert_close(turned, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        model.decoder(turned, points @ turn), model.decoder(z, points), rtol=1e-4, atol=1e-5
    )
    nowhere = model.encode(points + ~there.unsqueeze(2) * 0.3, there)
    torch.testing.assert_close(nowhere, z)  # what is not there is not seen


def test_one_update_of_the_field():
    torch.manual_seed(0)
    args = field.Args(width=8, learning_rate=0.01, num_queries=30, latent_noise=0.1)
    model = field.Field(4, args)
    before, rows = copy.deepcopy(model), oracle(Scene(OBSTACLES)).reshape(1, MAX_OBSTACLES, 12)
    obstacles = torch.from_numpy(rows).expand(3, -1, -1)
    points, there = torch.rand(3, 20, 3) - 0.5, torch.rand(3, 20) < 0.8
    torch.manual_seed(1)
    losses = one_update(field, model, (points, there), args, obstacles)
    torch.manual_seed(1)
    asked = field.queries(obstacles, 30, args.spread)
    truth = field.distances(obstacles, asked)
    turned, turned_asked = field.augment(points, asked)
    z = before.encode(turned, there)
    errors = (before.decoder(z + 0.1 * torch.randn_like(z), turned_asked) - truth).abs()
    total = weight = near = count = 0.0
    for error, distance in zip(errors.flatten(), truth.flatten().tolist(), strict=True):
        is_near = distance < 0.1
        total, weight = (
            total + (5.0 if is_near else 1.0) * error,
            weight + (5.0 if is_near else 1.0),
        )
        near, count = near + is_near * error, count + is_near
    torch.testing.assert_close(losses["loss"], total / weight)
    torch.testing.assert_close(losses["near"], near / count)
    check_step(model, before, total / weight, args.learning_rate)


@pytest.mark.parametrize("name", SCRIPTS)
def test_an_encoder_learns_something_tiny(name, observations):
    """On the scenes that it is trained on, its error falls to a part of what it was."""
    torch.manual_seed(0)
    read, rows = Observations(observations), np.arange(20)
    if name == "pointnet2":
        sizes = {"num_points": 32, "num_centres": (12, 6), "num_neighbours": 4, "num_queries": 60}
        module, args = pointnet2, pointnet2.Args(width=8, **sizes)
        model, data = pointnet2.PointNet2(4, args), clouds.load_clouds(read, 32)
        batch, inputs = clouds.batch_of(data, rows, "cpu"), ()

        def error():
            found = pointnet2.evaluate(model, data, rows, 20, "cpu")
            return 1 - (found["iou_obstacle"] + found["absent"]) / 2

    elif name == "field":
        module, args = field, field.Args(width=64, num_points=32)
        model = field.Field(4, args)
        data = [*clouds.load_obstacle_points(read, 32)[1:], load_obstacles(read)]
        *batch, obstacles = field.batch_of(data, rows, args, "cpu")
        inputs, asked = (obstacles,), field.queries(obstacles, 400, 0.05)

        def error():
            return field.evaluate(model, data, asked, rows, args, "cpu")["error_20cm"]

    else:
        module, kind = (vae, vae.VAE) if name == "vae" else (vqvae, vqvae.VQVAE)
        args = module.Args(width=8)
        model, (data, _) = kind(4, 16, args), pictures.load_images(read, 16)
        batch = pictures.batch_of(data, rows, "cpu")
        inputs = (pictures.mean_picture(data, 20, "cpu"),)

        def error():
            measured = (model, data, rows, *inputs, 20, "cpu")
            return pictures.reconstruction_errors(*measured)["error_foreground"]

    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3, fused=True)
    before = error()
    for _ in range(300 if name == "field" else 150):
        module.update(model, optimizer, batch, *inputs, args)
    assert error() < 0.4 * before


@pytest.mark.parametrize(("size", "halvings"), [(224, 5), (64, 4), (112, 4), (16, 2), (8, 1)])
def test_sizes(size, halvings):
    assert vae.num_halvings(size) == halvings
    args = vae.Args(width=2)
    model = vae.VAE(4, size, args)
    images = torch.rand(3, 4, 3, size, size)
    assert model(images).shape == images.shape
    assert model.encode(images)[0].shape == (3, 64)


def test_each_decoder_of_the_vae_sees_all_cameras_and_of_the_vqvae_its_own():
    images = torch.rand(1, 4, 3, 16, 16)
    changed = images.clone()
    changed[:, 2] = torch.rand(3, 16, 16)
    for module, kind in ((vae, vae.VAE), (vqvae, vqvae.VQVAE)):
        torch.manual_seed(0)
        model = kind(4, 16, module.Args(width=4))
        different = (model(images) != model(changed)).flatten(2).any(2)[0].tolist()
        expected = [True] * 4 if kind is vae.VAE else [False, False, True, False]
        assert different == expected


def test_errors_of_the_evaluation(observations):
    images, cameras = pictures.load_images(Observations(observations), 16)
    assert images.shape == (20, 4, 16, 16, 3) and cameras == ["front", "left", "back", "right"]
    rows = np.arange(3, 10)
    truth = torch.from_numpy(images[rows]).permute(0, 1, 4, 2, 3) / 255.0
    mean_image = torch.rand(4, 3, 16, 16)
    model = torch.nn.Module()
    model.forward = lambda batch: batch * 0.5
    found = pictures.reconstruction_errors(model, images, rows, mean_image, 2, "cpu")
    unlike = (truth - mean_image).abs().amax(2) > 0.1
    for name, guess in (("error", truth * 0.5), ("mean_image_error", mean_image)):
        error = (truth - guess).square().mean(2)
        assert found[name] == pytest.approx(error.mean().item(), rel=1e-5)
        assert found[f"{name}_foreground"] == pytest.approx(error[unlike].mean().item(), rel=1e-5)


def test_images_are_those_of_the_shards(observations):
    read = Observations(observations)
    whole, cameras = pictures.load_images(read, 32)
    averaged, _ = pictures.load_images(read, 16)
    for shard in range(3):
        rows = slice(*read.offsets[shard : shard + 2])
        for i, name in enumerate(cameras):
            taken = read.read(shard, f"{name}/rgb")
            np.testing.assert_array_equal(whole[rows, i], taken)
            corner = taken[:, 6:8, 10:12].mean((1, 2))
            assert np.abs(averaged[rows, i, 3, 5] - corner).max() <= 0.5
    rows = np.arange(20)
    np.testing.assert_allclose(
        pictures.averaged(torch.from_numpy(whole.copy()), 16),
        pictures.batch_of(averaged, rows, "cpu"),
        atol=0.51 / 255,
    )


def test_other_observations_in_the_same_folder_are_unpacked_anew(observations, tmp_path):
    for path in observations.glob("shard_*.h5"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    before, _ = pictures.load_images(Observations(tmp_path), 16)
    thinned = clouds.load_clouds(Observations(tmp_path), 64)
    with h5py.File(tmp_path / "shard_00001.h5", "r+") as file:
        file["left/rgb"][2] = 255 - file["left/rgb"][2]
        file["left_cloud/segmentation"][2] = OBSTACLE
    after, _ = pictures.load_images(Observations(tmp_path), 16)
    changed = np.argwhere((before != after).any((2, 3, 4)))
    np.testing.assert_array_equal(changed, [[10, 1]])
    other = clouds.load_clouds(Observations(tmp_path), 64)
    changed = np.argwhere((thinned.labels != other.labels).any((2, 3)))
    np.testing.assert_array_equal(changed, [[10, 1]])


def test_two_trainers_may_unpack_at_once(observations, tmp_path):
    for path in observations.glob("shard_*.h5"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    one, other = Observations(tmp_path), Observations(tmp_path)
    made = []

    def read(number, name):
        if number == 1 and not made:  # one has begun, and the other does it all meanwhile
            made.append(pictures.load_images(other, 16)[0])
        return Observations.read(one, number, name)

    one.read = read
    expected, _ = pictures.load_images(Observations(observations), 16)
    np.testing.assert_array_equal(pictures.load_images(one, 16)[0], expected)
    np.testing.assert_array_equal(made[0], expected)
    assert len([path for path in tmp_path.iterdir() if path.suffix != ".h5"]) == 1


def test_points_are_thinned_out_evenly():
    mask = torch.zeros(3, 50, dtype=torch.bool)
    mask[0, 5:45], mask[1, [3, 9, 20, 40]] = True, True
    chosen = pointnet2.thin_out(mask, 8)
    assert chosen[:2].tolist() == [
        [5, 10, 15, 20, 25, 30, 35, 40],
        [3, 3, 9, 9, 20, 20, 40, 40],
    ]
    assert chosen[2].tolist() == [0] * 8


def test_clouds_are_thinned_out_once(observations):
    read = Observations(observations)
    sensors, points, labels, depths = clouds.load_clouds(read, 64)
    assert points.shape == (20, 4, 2, 64, 3) and labels.shape == (20, 4, 2, 64)
    for i, name in enumerate(sensors):
        cloud, classes = (one[3].numpy() for one in clouds.whole_clouds(read, 1, name))
        hit = classes != pointnet2.NOTHING
        for half, mask in enumerate((hit, hit & (cloud[:, 2] > clouds.TABLE_TOP))):
            chosen = np.flatnonzero(mask)[np.arange(64) * mask.sum() // 64]
            np.testing.assert_array_equal(points[11, i, half], cloud[chosen])
            np.testing.assert_array_equal(labels[11, i, half], classes[chosen])
        stored = torch.from_numpy(depths[11:12, i].astype(np.float32))
        ends = clouds.ends_of_rays(sensors[name], stored)[0]
        near = ends.norm(dim=1) < 100.0
        np.testing.assert_allclose(ends[near], cloud[hit], atol=1e-5)


def test_what_is_asked_about():
    points, labels = torch.rand(3, 2, 5, 3) + 1.0, torch.full((3, 2, 5), 1)
    labels[0, 1, :3], labels[0, 0, 0] = pointnet2.OBSTACLE, pointnet2.NOTHING
    points[0, 1, 0] = -4.0  # far from scene 1
    points[0, 1, 1] = points[1, 1, 4] + torch.tensor([0.0, 0.03, 0.0])  # near it
    points[0, 1, 2] = points[1, 0, 4] + torch.tensor([0.0, 9.0, 0.0])
    queries, classes = pointnet2.queries_of(points, labels, points.flatten(1, 2))
    assert torch.equal(queries[:, :10], points.flatten(1, 2))
    assert torch.equal(queries[1, 10:], points[0, 1]) and torch.equal(queries[0, 10:], points[2, 1])
    nothing, ignored = pointnet2.NOTHING, pointnet2.IGNORED
    assert classes[0].tolist() == [ignored, 1, 1, 1, 1, 2, 2, 2, 1, 1] + [ignored] * 5
    assert classes[1].tolist() == [1] * 10 + [nothing, ignored, nothing, ignored, ignored]
    assert classes[2].tolist() == [1] * 10 + [ignored] * 5


def test_nothing_is_where_nothing_of_the_whole_cloud_is(observations):
    """Also on what thinning left out, such as thin poles; against a loop over all of it."""
    read = Observations(observations)
    thinned = clouds.load_clouds(read, 16)
    batch = clouds.batch_of(thinned, np.arange(8), "cpu")
    told_by_thinned_alone = 0
    for name, (points, labels, whole) in zip(thinned.sensors, batch, strict=True):
        _, classes = pointnet2.queries_of(points, labels, whole)
        _, of_thinned = pointnet2.queries_of(points, labels, points.flatten(1, 2))
        cloud, kinds = clouds.whole_clouds(read, 0, name)
        for i in range(8):
            seen = cloud[i][kinds[i] != pointnet2.NOTHING].numpy()
            for j, point in enumerate(points[i - 1, 1].numpy()):
                distance = np.linalg.norm(seen - point, axis=1).min()
                absent = labels[i - 1, 1, j] == OBSTACLE and distance > pointnet2.APART
                if abs(distance - pointnet2.APART) > 1e-4:
                    expected = pointnet2.NOTHING if absent else pointnet2.IGNORED
                    assert classes[i, 32 + j] == expected
        told_by_thinned_alone += (classes != of_thinned).sum()
    assert told_by_thinned_alone > 0


def test_queries_by_chance_are_some_of_all():
    points, labels = torch.rand(3, 2, 20, 3), torch.randint(4, (3, 2, 20))
    cloud = (points, labels, points.flatten(1, 2))
    queries, classes = pointnet2.queries_of(*cloud)
    some, theirs = pointnet2.queries_of(*cloud, 12)
    assert some.shape == (3, 12, 3) and theirs.shape == (3, 12)
    for i in range(3):
        found = [queries[i].tolist().index(point) for point in some[i].tolist()]
        assert len(set(found)) == 12 and [one >= 40 for one in found] == [False] * 8 + [True] * 4
        assert torch.equal(theirs[i], classes[i, found])


def test_waves_of_places():
    places = torch.tensor([[0.5, -0.25, 2.0]])
    found = pointnet2.waves(places, 2)[0]
    angles = np.concatenate([np.pi * places[0].numpy(), 2 * np.pi * places[0].numpy()])
    expected = np.concatenate([places[0].numpy(), np.sin(angles), np.cos(angles)])
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_farthest_point_sampling_against_a_loop():
    points = torch.rand(3, 40, 3)
    found = pointnet2.farthest_point_sampling(points, 12)
    for row, cloud in zip(found.tolist(), points, strict=True):
        expected = [0]
        while len(expected) < 12:
            nearest = [min(float((point - cloud[i]).norm()) for i in expected) for point in cloud]
            expected.append(int(np.argmax(nearest)))
        assert row == expected


def test_ball_query_against_a_loop():
    points, centres = torch.rand(2, 60, 3), torch.rand(2, 9, 3)
    centres[:, 0] = 5.0  # nothing is near it
    found = pointnet2.ball_query(points, centres, 0.3, 6)
    for cloud, middles, rows in zip(points, centres, found.tolist(), strict=True):
        for middle, row in zip(middles, rows, strict=True):
            distances = [float((point - middle).norm()) for point in cloud]
            order = np.argsort(distances)
            inside = [int(i) for i in order if distances[i] <= 0.3][:6]
            assert row == inside + [int(order[0])] * (6 - len(inside))


def test_interpolation_is_exact_at_centres_and_a_mean_between():
    centres = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 9, 0], [0, 0, 99]]])
    values = torch.tensor([[[1.0], [3.0], [5.0], [7.0]]])
    at = torch.tensor([[[0.0, 0, 0], [0.5, 0, 0], [0.0, 9, 0]]])
    found = pointnet2.interpolate(values, centres, at)[0, :, 0]
    assert found[0] == pytest.approx(1, abs=1e-3) and found[2] == pytest.approx(5, abs=1e-3)
    weights = 1 / np.array([0.5, 0.5, np.hypot(0.5, 9)])
    assert found[1] == pytest.approx(weights @ [1, 3, 5] / weights.sum(), rel=1e-4)


def test_scores_of_the_classification(observations):
    thinned = clouds.load_clouds(Observations(observations), 64)
    nothing, ignored = pointnet2.NOTHING, pointnet2.IGNORED

    class Guess(torch.nn.Module):
        """Says `obstacle` of every third point, `nothing` of every fifth, of others the truth."""

        def forward(self, batch):
            logits, truth = [], []
            for cloud in batch:
                _, classes = pointnet2.queries_of(*cloud)
                guess = classes.clamp(min=0)
                guess[:, ::5] = nothing
                guess[:, ::3] = 2
                logits.append(torch.nn.functional.one_hot(guess, 4).float())
                truth.append(classes)
            return logits, truth

    found = pointnet2.evaluate(Guess(), thinned, np.arange(6), 3, "cpu")
    truths, guesses = [], []
    for rows in (np.arange(3), np.arange(3, 6)):
        for one, truth in zip(*Guess()(clouds.batch_of(thinned, rows, "cpu")), strict=True):
            guesses.append(one.argmax(2))
            truths.append(truth)
    truth, guess = torch.cat(truths), torch.cat(guesses)
    absent = truth == nothing
    assert 0 < found["absent"] < 1 and absent.sum() > 50
    assert found["absent"] == pytest.approx((guess == nothing)[absent].float().mean().item())
    truth, guess = truth[:, :64], guess[:, :64]
    hit = truth != ignored
    assert found["accuracy"] == pytest.approx((guess == truth)[hit].float().mean().item())
    for number, name in enumerate(("robot", "static", "obstacle")):
        both = ((guess == number) & (truth == number))[hit].sum()
        either = ((guess == number) | (truth == number))[hit].sum()
        assert found[f"iou_{name}"] == pytest.approx((both / either).item())


# --- Runs


def shared_blocks(name):
    blocks, block = {}, None
    for line in (FOLDER / f"{name}.py").read_text().splitlines():
        if line.strip().startswith("# SHARED: "):
            assert block is None
            block = blocks.setdefault(line.strip(), [])
        elif line.strip() == "# END SHARED":
            block = None
        elif block is not None:
            block.append(line)
    return blocks


def test_shared_blocks_have_not_drifted_apart():
    blocks = shared_blocks("vae")
    assert shared_blocks("vqvae") == blocks and len(blocks) == 8
    of_clouds = shared_blocks("pointnet2")
    assert len(of_clouds) == 4 and all(blocks[name] == of_clouds[name] for name in of_clouds)
    of_field = shared_blocks("field")
    assert of_field.keys() - of_clouds.keys() == {"# SHARED: networks for pictures"}
    assert len(of_field) == 5 and all(blocks[name] == of_field[name] for name in of_field)


def test_a_run_leaves_an_encoder_a_result_and_events(run):
    name, folder = run
    result = json.loads((folder / "result.json").read_text())
    assert result["updates"] == 8 and result["scenes"] == 14
    assert result["best_update"] in (4, 8)
    events = EventAccumulator(str(folder), size_guidance={"images": 0}).Reload()
    scalars = set(events.Tags()["scalars"])
    (picture,) = events.Tags()["images"]
    image = events.Images(picture)[0]
    if name == "pointnet2":
        figures = {"accuracy", "iou_robot", "iou_static", "iou_obstacle", "absent"}
        assert (image.width, image.height) == (2 * 160, 160)
    elif name == "field":
        figures = {"error_near", "error_5cm", "error_10cm", "error_20cm", "error_40cm"}
        assert (image.width, image.height) == (3 * 96, 2 * 96)
    else:
        figures = {"error", "error_foreground", "mean_image_error", "mean_image_error_foreground"}
        assert (image.width, image.height) == (4 * 16, 2 * 16)
    assert {f"eval/{figure}" for figure in figures} <= scalars
    assert all(0 <= result[figure] <= 1 for figure in figures)
    assert [event.step for event in events.Scalars(f"eval/{min(figures)}")] == [4, 8]


def test_a_run_is_kept_with_its_figures_and_picture(run, tmp_path):
    name, folder = run
    script = FOLDER.parent / "benchmarks" / "keep_encoders.py"
    where = ["--encoders", str(tmp_path), "--pictures", str(tmp_path)]
    command = [sys.executable, str(script), str(folder), *where]
    command += ["--halve"] if name == "field" else []
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if name == "field":
        for ending in ("", ".decoder"):
            kept, whole = tmp_path / f"{name}{ending}.pt", folder / f"encoder{ending}.pt"
            assert kept.stat().st_size < whole.stat().st_size
            assert load_network(kept).metadata == load_network(whole).metadata
    else:
        kept = (tmp_path / f"{name}.pt").read_bytes()
        assert kept == (folder / "encoder.pt").read_bytes()
    assert Image.open(tmp_path / f"encoder_{name}.png").height > 0
    text = (tmp_path / f"{name}.json").read_text()
    result = json.loads(text)
    assert result["scenes"] == 14 and result["args"]["seed"] == 1 and str(folder.parent) not in text
    assert "roboarm_nmp.scene_embedding_train.collect" in result["observations"]
    unfinished = subprocess.run([*command[:2], str(tmp_path)], capture_output=True, text=True)
    assert unfinished.returncode != 0 and "no finished run" in unfinished.stderr


def test_the_saved_encoder_needs_no_script(run, observations):
    name, folder = run
    encoder = load_network(folder / "encoder.pt")
    assert encoder.metadata["kind"] == "encoder"
    read = Observations(observations)
    if name in OF_CLOUDS:
        inputs = {}
        for sensor in read.sensors:
            if isinstance(read.sensors[sensor], PointCloud):
                shards = [clouds.whole_clouds(read, shard, sensor) for shard in range(3)]
                points, labels = (torch.cat(one) for one in zip(*shards, strict=True))
                inputs |= {f"{sensor}_points": points, f"{sensor}_labels": labels}
    else:
        images, cameras = pictures.load_images(read, 32)
        inputs = {one: torch.from_numpy(images[:, i].copy()) for i, one in enumerate(cameras)}
    together = encoder(**inputs)
    assert together.shape == (20, 64) and together.dtype == torch.float32
    alone = [encoder(**{key: value[i : i + 1] for key, value in inputs.items()}) for i in range(20)]
    torch.testing.assert_close(torch.cat(alone), together, rtol=1e-4, atol=1e-5)
    assert together.std(0).max() > 0


def test_a_field_of_pictures(observations, tmp_path):
    flags = ["--sees", "images", "--picture-size", "16", "--latent-size", "16"]
    run_here(*command("field", observations, tmp_path, *flags)[1:])
    (folder,) = tmp_path.iterdir()
    encoder = SceneEncoder(folder / "encoder.pt")
    assert set(encoder.sensors) == {"front", "left", "back", "right"} and encoder.size == 16
    scene = Observations(observations).scenes(0)[0]
    at = torch.rand(1, 7, 3)
    assert encoder.decoder(torch.from_numpy(encoder(scene))[None], at).shape == (1, 7)
    encoder.close()
    with pytest.raises(SystemExit, match="--latent-size must be a multiple of 8, got 12"):
        run_here(*command("field", observations, tmp_path, "--latent-size", "12")[1:])


@pytest.mark.parametrize("device", ["cpu", GPU])
def test_killed_and_resumed_is_bit_identical_to_uninterrupted(run, observations, tmp_path, device):
    name, finished = run
    if device != "cpu":
        whole = tmp_path / "whole"
        run_here(*command(name, observations, whole, "--device", device)[1:])
        (finished,) = whole.iterdir()
    if name == "field":  # wherever it goes on
        assert isinstance(json.loads((finished / "args.json").read_text())["bf16"], bool)
    killed = tmp_path / "killed"
    process = subprocess.Popen(
        command(name, observations, killed, "--device", device),
        start_new_session=True,
        stderr=subprocess.DEVNULL,
    )
    until = time.time() + 120
    while not list(killed.glob("*/checkpoint.pt")):
        assert time.time() < until
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    folder = next(killed.iterdir())
    assert not (folder / "result.json").exists()
    resume = [sys.executable, str(FOLDER / f"{name}.py"), "--resume", str(folder)]
    done = subprocess.run(resume, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    one, other = (
        torch.load(path / "checkpoint.pt", weights_only=True)["model"]
        for path in (folder, finished)
    )
    for key in one:
        assert torch.equal(one[key], other[key]), key
    refused = subprocess.run([*resume, "--width", "8"], capture_output=True, text=True)
    assert refused.returncode == 1 and "--width is 8 now, the run had 4" in refused.stderr


@pytest.mark.parametrize("name", SCRIPTS)
def test_nothing_of_a_run_needs_the_cpu(name, observations, tmp_path, another_device):
    """One update, one evaluation and one resume on another device."""
    _, script, *flags = command(name, observations, tmp_path, "--device", another_device)
    flags += ["--total-updates", "1", "--eval-every", "1"]
    flags += ["--restart-every", "1"] if name == "vqvae" else []
    if name == "field" and another_device == "meta":  # which autocast does not know
        flags += ["--bf16", "False"]
    run_here(script, *flags)
    (folder,) = tmp_path.iterdir()
    assert load_network(folder / "encoder.pt").metadata["step"] == 1
    args = json.loads((folder / "args.json").read_text())
    (folder / "args.json").write_text(json.dumps(args | {"total_updates": 2}))
    run_here(script, "--resume", str(folder))
    assert json.loads((folder / "result.json").read_text())["updates"] == 2
    weights = torch.load(folder / "checkpoint.pt", weights_only=True)["model"].values()
    assert {tensor.device.type for tensor in weights} == {another_device}


@pytest.mark.parametrize("sees", ["clouds", "images"])
def test_no_kernel_of_the_field_gets_two_types(sees):
    args = field.Args(width=8, sees=sees, picture_size=16, num_queries=12, bf16=True)
    model = field.Field(4, args)
    clouds_seen = torch.rand(3, 20, 3) - 0.5, torch.rand(3, 20) < 0.8
    seen = clouds_seen if sees == "clouds" else (torch.rand(3, 4, 3, 16, 16),)
    rows = oracle(Scene(OBSTACLES)).reshape(1, MAX_OBSTACLES, 12)
    with OneType():
        losses = one_update(field, model, seen, args, torch.from_numpy(rows).expand(3, -1, -1))
    assert losses["loss"].isfinite()


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_diverged_run_ends(name, observations, tmp_path):
    flags = ("--learning-rate", "1e30", "--total-updates", "3", "--eval-every", "3")
    with pytest.raises(FloatingPointError, match="are no longer finite"):
        run_here(*command(name, observations, tmp_path, *flags)[1:])
    assert not list(tmp_path.glob("*/encoder*.pt")) and not list(tmp_path.glob("*/checkpoint.pt"))


# --- In an environment


def test_the_oracle_knows_the_obstacles():
    scene = envs.TASKS["boxes"].scene
    rows = oracle(scene).reshape(MAX_OBSTACLES, 12)
    assert rows[:, 0].tolist() == [1.0] * 6 + [0.0] * (MAX_OBSTACLES - 6)
    assert from_array(rows[:6, 1:].astype(np.float64))[2].position == pytest.approx(
        scene.obstacles[2].position
    )
    assert not rows[6:].any()
    with pytest.raises(ValueError, match="room for 32"):
        oracle(Scene((Sphere((0.0, 0.0, 2.0), 0.1),) * 33))


def check_wrapped(encoder, calls):
    """An environment with the encoder; `calls()` counts what was encoded."""
    env = SceneEncodingWrapper(envs.make("random_boxes_easy", horizon=6), encoder)
    plain = envs.make("random_boxes_easy", horizon=6)
    check_env(env, skip_render_check=True)
    scenes = []
    for seed in (1, 2, 1):
        before = calls()
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
        assert calls() - before == (plain.scene not in scenes)  # once for each scene
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


def test_the_oracle_in_an_environment(monkeypatch):
    encoder = SceneEncoder("oracle")
    assert encoder.size == 384
    check_wrapped(encoder, lambda: encoder._cached.cache_info().misses)


def test_a_trained_encoder_in_an_environment(run, observations):
    name, folder = run
    encoder = SceneEncoder(folder / "encoder.pt")
    assert encoder.size == 64
    check_wrapped(encoder, lambda: encoder._cached.cache_info().misses)
    scenes = Observations(observations).scenes(0)
    fresh = SceneEncoder(folder / "encoder.pt")
    for scene in reversed(scenes):
        encoder(scene)
    for scene in scenes:
        np.testing.assert_array_equal(fresh(scene), encoder(scene))
    encoder.close()
    fresh.close()


def test_pretrained_encoders_are_found_by_name():
    assert pretrained_encoders() == sorted(SCRIPTS)
    assert sum(path.stat().st_size for path in PRETRAINED.glob("*.[pj]*")) < 7e6
    queries = load_queries("random_boxes_hard")
    for name in SCRIPTS:
        encoder, path = SceneEncoder(name), PRETRAINED / f"{name}.pt"
        latents = np.stack([encoder(queries.scenes[i]) for i in (0, 9_999)])
        assert latents.shape == (2, 64) and np.isfinite(latents).all()
        assert np.abs(latents[0] - latents[1]).max() > 0.1  # it sees the difference
        result = json.loads(path.with_suffix(".json").read_text())
        assert result["scenes"] >= 19_000
        if path.stem == "pointnet2":
            assert result["iou_obstacle"] >= 0.8
        elif path.stem == "field":
            assert result["error_near"] <= 0.01
        else:
            assert result["error_foreground"] < result["mean_image_error_foreground"] / 3
        encoder.close()


def test_demonstrations_are_encoded_once(run, tmp_path, monkeypatch):
    path = tmp_path / "encoder.pt"
    path.write_bytes((run[1] / "encoder.pt").read_bytes())
    demos = replace(load_demos("random_boxes_hard"), start=np.zeros((5, 7)))  # the first 5
    encoder = SceneEncoder(path)
    latents = encoder.encode_demos(demos)
    assert latents.shape == (5, 64) and latents.dtype == np.float32
    np.testing.assert_array_equal(latents[3], SceneEncoder(path)(demos.scenes[3]))
    kept = tmp_path / "encoder.random_boxes_hard.npz"
    look, looked = SceneEncoder.look, []
    monkeypatch.setattr(
        SceneEncoder, "look", lambda self, scene: looked.append(1) or look(self, scene)
    )
    again = SceneEncoder(path)
    looked.clear()
    np.testing.assert_array_equal(again.encode_demos(demos), latents)
    np.testing.assert_array_equal(again(demos.scenes[3]), latents[3])
    assert not looked
    fresh = SceneEncoder(path)
    looked.clear()
    fresh.encode_demos(replace(demos, start=np.zeros((4, 7))))  # other scenes: looked at again
    assert len(looked) == 4
    kept.write_bytes(kept.read_bytes()[:-40])  # damaged: the same
    fresh = SceneEncoder(path)
    looked.clear()
    np.testing.assert_array_equal(fresh.encode_demos(demos), latents)
    assert len(looked) == 5
    np.testing.assert_array_equal(
        SceneEncoder("oracle").encode_demos(demos)[2], oracle(demos.scenes[2])
    )


def test_what_is_no_encoder_is_refused(tmp_path):
    with pytest.raises(NetworkError, match="cannot be read"):
        SceneEncoder(tmp_path / "encoder.pt")
    inputs = {"x": torch.zeros(2, 3)}
    save_network(tmp_path / "policy.pt", Double(), inputs, {"kind": "policy"})
    with pytest.raises(NetworkError, match="not an encoder"):
        SceneEncoder(tmp_path / "policy.pt")
    save_network(tmp_path / "e.pt", Double(), inputs, {"kind": "encoder", "sensors": "[1"})
    with pytest.raises(NetworkError, match="sensors make no sense"):
        SceneEncoder(tmp_path / "e.pt")


class Double(torch.nn.Module):
    def forward(self, x):
        return 2 * x


@pytest.mark.parametrize("name", SCRIPTS)
def test_what_cannot_be_trained_on_is_refused(name, tmp_path):
    done = subprocess.run(command(name, tmp_path, tmp_path), capture_output=True, text=True)
    assert done.returncode == 1 and "no observations" in done.stderr
    assert "Traceback" not in done.stderr
