"""Camera images for the trainers: unpacking, averaging, batches, reconstruction errors."""

import numpy as np
import pytest
import torch

from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.scene_embedding_train import images


def test_reconstruction_errors_equal_their_definitions(observations):
    data, cameras = images.load_images(Observations(observations), 16)
    assert data.shape == (20, 4, 16, 16, 3) and cameras == ["front", "left", "back", "right"]
    rows = np.arange(3, 10)
    truth = torch.from_numpy(data[rows]).permute(0, 1, 4, 2, 3) / 255.0
    mean_image = torch.rand(4, 3, 16, 16)
    model = torch.nn.Module()
    model.forward = lambda batch: batch * 0.5
    found = images.reconstruction_errors(model, data, rows, mean_image, 2, "cpu")
    unlike = (truth - mean_image).abs().amax(2) > 0.1
    for name, guess in (("error", truth * 0.5), ("mean_image_error", mean_image)):
        error = (truth - guess).square().mean(2)
        assert found[name] == pytest.approx(error.mean().item(), rel=1e-5)
        assert found[f"{name}_foreground"] == pytest.approx(error[unlike].mean().item(), rel=1e-5)


def test_loaded_images_are_averages_of_the_stored_ones(observations):
    read = Observations(observations)
    whole, cameras = images.load_images(read, 32)
    averaged, _ = images.load_images(read, 16)
    for shard in range(3):
        rows = slice(*read.offsets[shard : shard + 2])
        for i, name in enumerate(cameras):
            taken = read.read(shard, f"{name}/rgb")
            np.testing.assert_array_equal(whole[rows, i], taken)
            corner = taken[:, 6:8, 10:12].mean((1, 2))
            assert np.abs(averaged[rows, i, 3, 5] - corner).max() <= 0.5
    rows = np.arange(20)
    np.testing.assert_allclose(
        images.average_down(torch.from_numpy(whole.copy()), 16),
        images.batch_of(averaged, rows, "cpu"),
        atol=0.51 / 255,
    )
