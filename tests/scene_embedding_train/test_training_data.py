"""Unpacked observations are made anew when the shards change."""

import h5py
import numpy as np

from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.envs.perception.sensors import OBSTACLE
from roboarm_nmp.scene_embedding_train import clouds, images


def test_changed_observations_are_unpacked_again(observations, tmp_path):
    for path in observations.glob("shard_*.h5"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    before, _ = images.load_images(Observations(tmp_path), 16)
    thinned = clouds.load_clouds(Observations(tmp_path), 64)
    with h5py.File(tmp_path / "shard_00001.h5", "r+") as file:
        file["left/rgb"][2] = 255 - file["left/rgb"][2]
        file["left_cloud/segmentation"][2] = OBSTACLE
    after, _ = images.load_images(Observations(tmp_path), 16)
    changed = np.argwhere((before != after).any((2, 3, 4)))
    np.testing.assert_array_equal(changed, [[10, 1]])
    other = clouds.load_clouds(Observations(tmp_path), 64)
    changed = np.argwhere((thinned.labels != other.labels).any((2, 3)))
    np.testing.assert_array_equal(changed, [[10, 1]])
