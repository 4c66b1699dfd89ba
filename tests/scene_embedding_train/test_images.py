"""Camera images for the trainers: their reconstruction errors."""

import numpy as np
import pytest
import torch

from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.scene_embedding_train import images


def test_reconstruction_errors_equal_their_definitions(observations):
    data, cameras = images.load_images(Observations(observations), 16)
    assert data.shape == (20, 2, 16, 16, 3) and cameras == ["front", "left"]
    rows = np.arange(3, 10)
    truth = torch.from_numpy(data[rows]).permute(0, 1, 4, 2, 3) / 255.0
    mean_image = torch.rand(2, 3, 16, 16)
    model = torch.nn.Module()
    model.forward = lambda batch: batch * 0.5
    found = images.reconstruction_errors(model, data, rows, mean_image, 2, "cpu")
    unlike = (truth - mean_image).abs().amax(2) > 0.1
    for name, guess in (("error", truth * 0.5), ("mean_image_error", mean_image)):
        error = (truth - guess).square().mean(2)
        assert found[name] == pytest.approx(error.mean().item(), rel=1e-5)
        assert found[f"{name}_foreground"] == pytest.approx(error[unlike].mean().item(), rel=1e-5)
