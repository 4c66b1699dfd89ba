"""The trainer of PointNet++: its mathematics against loops, one update by hand, a tiny overfit."""

import copy

import numpy as np
import pytest
import torch
from encoder_trainers import check_learning, check_step, load, one_update

from roboarm_nmp.envs.datasets.observations import Observations
from roboarm_nmp.envs.perception.sensors import OBSTACLE
from roboarm_nmp.scene_embedding_train import clouds

pointnet2 = load("pointnet2")


def test_one_update_follows_the_loss_written_out():
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
    terms = []
    for (points, labels, whole), encoder, decoder in zip(
        batch, before.encoders, before.decoders, strict=True
    ):
        queries, classes = pointnet2.queries_of(points, labels, whole, 30)
        probabilities = decoder(encoder(points[:, 1]), queries).softmax(2)
        for scene, row in zip(probabilities, classes.tolist(), strict=True):
            terms += [-scene[j, k].log() for j, k in enumerate(row) if k != pointnet2.IGNORED]
    expected = sum(terms) / len(terms)
    torch.testing.assert_close(loss, expected)
    check_step(model, before, expected, args.learning_rate)


def test_pointnet2_overfits_a_few_scenes(observations):
    torch.manual_seed(0)
    rows = np.arange(20)
    sizes = {"num_points": 32, "num_centres": (12, 6), "num_neighbours": 4, "num_queries": 60}
    args = pointnet2.Args(width=8, **sizes)
    model, data = pointnet2.PointNet2(4, args), clouds.load_clouds(Observations(observations), 32)

    def error():
        found = pointnet2.evaluate(model, data, rows, 20, "cpu")
        return 1 - (found["iou_obstacle"] + found["absent"]) / 2

    check_learning(pointnet2, model, clouds.batch_of(data, rows, "cpu"), (), args, error)


def test_queries_are_points_of_all_scenes_labelled_by_hand():
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


def test_points_far_from_the_whole_cloud_are_labelled_as_nothing(observations):
    """Also far from what thinning left out, such as thin poles; against a loop over the cloud."""
    read = Observations(observations)
    thinned = clouds.load_clouds(read, 16)
    batch = clouds.batch_of(thinned, np.arange(8), "cpu")
    differing = 0
    for name, (points, labels, whole) in zip(thinned.sensors, batch, strict=True):
        _, classes = pointnet2.queries_of(points, labels, whole)
        _, of_thinned = pointnet2.queries_of(points, labels, points.flatten(1, 2))
        cloud, kinds = clouds.whole_clouds(read, 0, name)
        for i in range(8):
            hits = cloud[i][kinds[i] != pointnet2.NOTHING].numpy()
            for j, point in enumerate(points[i - 1, 1].numpy()):
                distance = np.linalg.norm(hits - point, axis=1).min()
                absent = labels[i - 1, 1, j] == OBSTACLE and distance > pointnet2.APART
                if abs(distance - pointnet2.APART) > 1e-4:
                    expected = pointnet2.NOTHING if absent else pointnet2.IGNORED
                    assert classes[i, 32 + j] == expected
        differing += (classes != of_thinned).sum()
    assert differing > 0


def test_random_queries_are_a_subset_with_equal_labels():
    points, labels = torch.rand(3, 2, 20, 3), torch.randint(4, (3, 2, 20))
    cloud = (points, labels, points.flatten(1, 2))
    queries, classes = pointnet2.queries_of(*cloud)
    chosen, labelled = pointnet2.queries_of(*cloud, 12)
    assert chosen.shape == (3, 12, 3) and labelled.shape == (3, 12)
    for i in range(3):
        found = [queries[i].tolist().index(point) for point in chosen[i].tolist()]
        assert len(set(found)) == 12 and [one >= 40 for one in found] == [False] * 8 + [True] * 4
        assert torch.equal(labelled[i], classes[i, found])


def test_waves_are_sines_and_cosines_of_places():
    places = torch.tensor([[0.5, -0.25, 2.0]])
    found = pointnet2.waves(places, 2)[0]
    angles = np.concatenate([np.pi * places[0].numpy(), 2 * np.pi * places[0].numpy()])
    expected = np.concatenate([places[0].numpy(), np.sin(angles), np.cos(angles)])
    np.testing.assert_allclose(found, expected, atol=1e-5)


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


def test_scores_of_the_evaluation_equal_their_definitions(observations):
    thinned = clouds.load_clouds(Observations(observations), 64)
    nothing, ignored = pointnet2.NOTHING, pointnet2.IGNORED

    class Guess(torch.nn.Module):
        """`obstacle` for every third point, `nothing` for every fifth, otherwise the truth."""

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
