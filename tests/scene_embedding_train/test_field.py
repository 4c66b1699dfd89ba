"""The trainer of the field: queries, symmetries, and one update by hand."""

import copy

import numpy as np
import torch
from encoder_trainers import check_step, load, obstacle_rows, one_update
from one_type import OneType

from roboarm_nmp.envs.perception.encoders import MAX_OBSTACLES
from roboarm_nmp.scene_embedding_train.obstacles import distances

field = load("field")


def test_queries_are_uniform_and_around_all_obstacles_equally():
    torch.manual_seed(0)
    rows = torch.zeros(2, MAX_OBSTACLES, 12)
    rows[0] = obstacle_rows()[0]
    queries = field.sample_queries(rows, 6_000, 1e-3)  # (the second scene is empty)
    assert queries.shape == (2, 6_000, 3) and queries.isfinite().all()
    anywhere = queries[:, 3_000:]
    low, high = torch.tensor([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.5]])
    assert ((anywhere >= low) & (anywhere <= high)).all()
    assert (anywhere.mean((0, 1)) - (low + high) / 2).abs().max() < 0.05
    alone = [rows[:1, i : i + 1] for i in range(3)]
    near = torch.stack([distances(one, queries[:1, :3_000]) for one in alone])
    # That much of the box around the cylinder, or around half of the sphere, is inside of them.
    shares = (near < 0.003).float().mean((1, 2)) * 3
    np.testing.assert_allclose(shares, [1.0, np.pi / 4, np.pi / 4 * 11 / 12], atol=0.06)


def test_augmented_scenes_have_the_same_distances():
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


def test_rotation_by_a_sector_rolls_the_latent_code():
    torch.manual_seed(0)
    args = field.Args(width=8, latent_size=16)
    model, eighth = field.Field(args).eval(), 2 * np.pi / field.SECTORS
    points, valid = torch.rand(3, 20, 3) - 0.5, torch.rand(3, 20) < 0.8
    c, s = np.cos(eighth), np.sin(eighth)
    turn = torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float32)
    z, turned = model.encode(points, valid), model.encode(points @ turn, valid)
    expected = z.unflatten(1, (field.SECTORS, -1)).roll(1, 1).flatten(1)
    torch.testing.assert_close(turned, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        model.decoder(turned, points @ turn), model.decoder(z, points), rtol=1e-4, atol=1e-5
    )
    changed = model.encode(points + ~valid.unsqueeze(2) * 0.3, valid)
    torch.testing.assert_close(changed, z)  # points that are not valid change nothing


def test_one_update_follows_the_losses_written_out():
    torch.manual_seed(0)
    args = field.Args(width=8, learning_rate=0.01, num_query_points=30, latent_noise=0.1)
    model = field.Field(args)
    before, obstacles = copy.deepcopy(model), obstacle_rows().expand(3, -1, -1)
    points, valid = torch.rand(3, 20, 3) - 0.5, torch.rand(3, 20) < 0.8
    torch.manual_seed(1)
    losses = one_update(field, model, (points, valid, obstacles), args)
    torch.manual_seed(1)
    queries = field.sample_queries(obstacles, 30, args.spread)
    truth = distances(obstacles, queries)
    turned, turned_queries = field.augment(points, queries)
    z = before.encode(turned, valid)
    errors = (before.decoder(z + 0.1 * torch.randn_like(z), turned_queries) - truth).abs()
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


def test_no_kernel_receives_two_floating_point_types():
    args = field.Args(width=8, num_query_points=12, bf16=True)
    points, valid = torch.rand(3, 20, 3) - 0.5, torch.rand(3, 20) < 0.8
    batch = points, valid, obstacle_rows().expand(3, -1, -1)
    with OneType():
        losses = one_update(field, field.Field(args), batch, args)
    assert losses["loss"].isfinite()
