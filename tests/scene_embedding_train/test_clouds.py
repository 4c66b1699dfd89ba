"""Point clouds for the trainers: thinning, points to classify, scores."""

import numpy as np
import pytest
import torch

from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.envs.perception.sensors import NOTHING, OBSTACLE
from roboarm_nmp.scene_embedding_train import clouds


def test_loaded_clouds_are_thinned_stored_ones(observations):
    read = Observations(observations)
    sensors, points, labels, depths = clouds.load_clouds(read, 64)
    assert points.shape == (20, 2, 2, 64, 3) and labels.shape == (20, 2, 2, 64)
    for i, name in enumerate(sensors):
        cloud, classes = (one[3].numpy() for one in clouds.whole_clouds(read, 1, name))
        hit = classes != NOTHING
        for half, mask in enumerate((hit, hit & (cloud[:, 2] > clouds.TABLE_TOP))):
            chosen = np.flatnonzero(mask)[np.arange(64) * mask.sum() // 64]
            np.testing.assert_array_equal(points[11, i, half], cloud[chosen])
            np.testing.assert_array_equal(labels[11, i, half], classes[chosen])
        stored = torch.from_numpy(depths[11:12, i].astype(np.float32))
        ends = clouds.ray_ends(sensors[name], stored)[0]
        near = ends.norm(dim=1) < 100.0
        np.testing.assert_allclose(ends[near], cloud[hit], atol=1e-5)


def test_queries_are_points_of_all_scenes_labelled_by_hand():
    points, labels = torch.rand(3, 2, 5, 3) + 1.0, torch.full((3, 2, 5), 1)
    labels[0, 1, :3], labels[0, 0, 0] = OBSTACLE, NOTHING
    points[0, 1, 0] = -4.0  # far from scene 1
    points[0, 1, 1] = points[1, 1, 4] + torch.tensor([0.0, 0.03, 0.0])  # near it
    points[0, 1, 2] = points[1, 0, 4] + torch.tensor([0.0, 9.0, 0.0])
    queries, classes = clouds.queries_of(points, labels, points.flatten(1, 2))
    assert torch.equal(queries[:, :10], points.flatten(1, 2))
    assert torch.equal(queries[1, 10:], points[0, 1]) and torch.equal(queries[0, 10:], points[2, 1])
    ignored = clouds.IGNORED
    assert classes[0].tolist() == [ignored, 1, 1, 1, 1, 2, 2, 2, 1, 1] + [ignored] * 5
    assert classes[1].tolist() == [1] * 10 + [NOTHING, ignored, NOTHING, ignored, ignored]
    assert classes[2].tolist() == [1] * 10 + [ignored] * 5


def test_scores_of_the_evaluation_equal_their_definitions(observations):
    thinned = clouds.load_clouds(Observations(observations), 64)
    ignored = clouds.IGNORED

    class Guess(torch.nn.Module):
        """`obstacle` for every third point, `nothing` for every fifth, otherwise the truth."""

        def forward(self, batch):
            logits, truth = [], []
            for cloud in batch:
                _, classes = clouds.queries_of(*cloud)
                guess = classes.clamp(min=0)
                guess[:, ::5] = NOTHING
                guess[:, ::3] = 2
                logits.append(torch.nn.functional.one_hot(guess, 4).float())
                truth.append(classes)
            return logits, truth

    found = clouds.classification_scores(Guess(), thinned, np.arange(6), 3, "cpu")
    truths, guesses = [], []
    for rows in (np.arange(3), np.arange(3, 6)):
        for one, truth in zip(*Guess()(clouds.batch_of(thinned, rows, "cpu")), strict=True):
            guesses.append(one.argmax(2))
            truths.append(truth)
    truth, guess = torch.cat(truths), torch.cat(guesses)
    absent = truth == NOTHING
    assert 0 < found["absent"] < 1 and absent.sum() > 50
    assert found["absent"] == pytest.approx((guess == NOTHING)[absent].float().mean().item())
    truth, guess = truth[:, :64], guess[:, :64]
    hit = truth != ignored
    assert found["accuracy"] == pytest.approx((guess == truth)[hit].float().mean().item())
    for number, name in enumerate(("robot", "static", "obstacle")):
        both = ((guess == number) & (truth == number))[hit].sum()
        either = ((guess == number) | (truth == number))[hit].sum()
        assert found[f"iou_{name}"] == pytest.approx((both / either).item())
