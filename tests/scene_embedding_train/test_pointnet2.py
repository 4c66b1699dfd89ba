"""The trainer of PointNet++: its mathematics against loops, and one update by hand."""

import copy

import numpy as np
import pytest
import torch
from encoder_trainers import check_step, load, one_update

from roboarm_nmp.scene_embedding_train import clouds

pointnet2 = load("pointnet2")


def test_one_update_follows_the_loss_written_out():
    torch.manual_seed(0)
    sizes = {"num_points": 20, "num_centres": (8, 4), "num_neighbours": 4, "num_query_points": 30}
    args = pointnet2.Args(width=4, learning_rate=0.01, **sizes)
    model = pointnet2.PointNet2(2, args)
    before, batch = copy.deepcopy(model), []
    for _ in range(2):
        points, labels = torch.rand(3, 2, 20, 3), torch.randint(4, (3, 2, 20))
        batch.append((points, labels, points.flatten(1, 2)))
    torch.manual_seed(1)
    loss = one_update(pointnet2, model, batch, args)
    torch.manual_seed(1)
    terms = []
    for (points, labels, whole), encoder, decoder in zip(
        batch, before.encoders, before.decoders, strict=True
    ):
        queries, classes = clouds.queries_of(points, labels, whole, 30)
        probabilities = decoder(encoder(points[:, 1]), queries).softmax(2)
        for scene, row in zip(probabilities, classes.tolist(), strict=True):
            terms += [-scene[j, k].log() for j, k in enumerate(row) if k != clouds.IGNORED]
    expected = sum(terms) / len(terms)
    torch.testing.assert_close(loss, expected)
    check_step(model, before, expected, args.learning_rate)


def test_farthest_point_sampling_equals_a_loop():
    points = torch.rand(3, 40, 3)
    found = pointnet2.farthest_point_sampling(points, 12)
    for row, cloud in zip(found.tolist(), points, strict=True):
        expected = [0]
        while len(expected) < 12:
            nearest = [min(float((point - cloud[i]).norm()) for i in expected) for point in cloud]
            expected.append(int(np.argmax(nearest)))
        assert row == expected


def test_ball_query_equals_a_loop():
    points, centres = torch.rand(2, 60, 3), torch.rand(2, 9, 3)
    centres[:, 0] = 5.0  # nothing is near it
    found = pointnet2.ball_query(points, centres, 0.3, 6)
    for cloud, places, rows in zip(points, centres, found.tolist(), strict=True):
        for place, row in zip(places, rows, strict=True):
            distances = [float((point - place).norm()) for point in cloud]
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
