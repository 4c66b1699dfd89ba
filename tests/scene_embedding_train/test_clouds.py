"""Point clouds for the trainers: thinning, against the stored clouds."""

import numpy as np
import torch

from roboarm_nmp.envs.datasets.observations import Observations
from roboarm_nmp.envs.perception.sensors import NOTHING
from roboarm_nmp.scene_embedding_train import clouds


def test_thinned_points_are_evenly_spaced():
    mask = torch.zeros(3, 50, dtype=torch.bool)
    mask[0, 5:45], mask[1, [3, 9, 20, 40]] = True, True
    chosen = clouds.thin_out(mask, 8)
    assert chosen[:2].tolist() == [
        [5, 10, 15, 20, 25, 30, 35, 40],
        [3, 3, 9, 9, 20, 20, 40, 40],
    ]
    assert chosen[2].tolist() == [0] * 8


def test_loaded_clouds_are_thinned_stored_ones(observations):
    read = Observations(observations)
    sensors, points, labels, depths = clouds.load_clouds(read, 64)
    assert points.shape == (20, 4, 2, 64, 3) and labels.shape == (20, 4, 2, 64)
    for i, name in enumerate(sensors):
        cloud, classes = (one[3].numpy() for one in clouds.whole_clouds(read, 1, name))
        hit = classes != NOTHING
        for half, mask in enumerate((hit, hit & (cloud[:, 2] > clouds.TABLE_TOP))):
            chosen = np.flatnonzero(mask)[np.arange(64) * mask.sum() // 64]
            np.testing.assert_array_equal(points[11, i, half], cloud[chosen])
            np.testing.assert_array_equal(labels[11, i, half], classes[chosen])
        stored = torch.from_numpy(depths[11:12, i].astype(np.float32))
        ends = clouds.ends_of_rays(sensors[name], stored)[0]
        near = ends.norm(dim=1) < 100.0
        np.testing.assert_allclose(ends[near], cloud[hit], atol=1e-5)
