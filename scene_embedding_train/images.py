"""Camera images for the trainers of image encoders: loading, batches, errors, comparisons.

Images are averaged down to save time: `load_images` averages those of a training set once,
`average_down` is a part of the exported encoder.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.envs.perception.sensors import Camera
from roboarm_nmp.scene_embedding_train.training_data import unpack
from roboarm_nmp.training.arguments import fail


def load_images(observations: Observations, size: int) -> tuple[np.ndarray, list[str]]:
    """The camera images of `Observations`, averaged down to `size` pixels.

    They are unpacked once into a file beside the shards, which is memory-mapped.

    Returns:
        Images, uint8 (scenes, cameras, size, size, 3), and the names of the cameras.

    Raises:
        SystemExit: there are no images, or their size does not fit.
    """
    cameras = {
        name: sensor for name, sensor in observations.sensors.items() if isinstance(sensor, Camera)
    }
    if not cameras:
        fail(f"--observations: {observations.folder} has no images (collect with --sensors)")
    sizes = {camera.size for camera in cameras.values()}
    if len(sizes) > 1 or any("rgb" not in camera.outputs for camera in cameras.values()):
        fail(f"--observations: {observations.folder}: the cameras differ in size, or lack rgb")
    width, height = sizes.pop()
    if width != height or width % size:
        fail(f"--image-size {size}: the observations' images have {width} x {height} pixels")
    shards = (
        {"rgb": _images_of_shard(observations, shard, cameras, size)}
        for shard in range(len(observations.offsets) - 1)
    )
    arrays = {"rgb": (np.uint8, (len(cameras), size, size, 3))}
    return unpack(observations, f"images_{size}", arrays, shards)["rgb"], list(cameras)


def _images_of_shard(observations, shard, cameras, size):
    """`load_images`'s rows of one shard."""
    averaged = []
    for name in cameras:
        images = observations.read(shard, f"{name}/rgb")
        block = images.shape[1] // size
        blocks = images.reshape(-1, size, block, size, block, 3)
        averaged.append(blocks.mean((2, 4)).round().astype(np.uint8))
    return np.stack(averaged, axis=1)


def example_images(observations: Observations, cameras: list[str]) -> dict[str, Tensor]:
    """Two scenes' images in full size, as an encoder receives them: camera -> (2, h, w, 3)."""
    last = len(observations.offsets) - 2
    return {name: torch.from_numpy(observations.read(last, f"{name}/rgb")[:2]) for name in cameras}


def batch_of(images: np.ndarray, rows: np.ndarray, device: torch.device | str) -> Tensor:
    """Rows of `load_images`'s array as float32 (n, cameras, 3, size, size) in [0, 1]."""
    chosen = torch.from_numpy(images[np.sort(rows)]).to(device)
    return chosen.permute(0, 1, 4, 2, 3).float() / 255.0


def average_down(images: Tensor, size: int) -> Tensor:
    """uint8 (n, cameras, height, width, 3) -> float32 (n, cameras, 3, size, size) in [0, 1]."""
    flat = images.flatten(0, 1).permute(0, 3, 1, 2).float() / 255.0
    return F.avg_pool2d(flat, images.shape[2] // size).unflatten(0, images.shape[:2])


def mean_of_images(images: np.ndarray, num_training: int, device: torch.device | str) -> Tensor:
    """The mean of at most 1,000 of the first `num_training` rows: (cameras, 3, size, size)."""
    rows = np.linspace(0, num_training - 1, min(num_training, 1000)).astype(int)
    return batch_of(images, rows, device).mean(0)


def foreground(batch: Tensor, mean_image: Tensor) -> Tensor:
    """Which pixels differ from the mean image: bool (n, cameras, 1, size, size)."""
    return (batch - mean_image).abs().amax(2, keepdim=True) > 0.1


@torch.no_grad()
def reconstruction_errors(
    model: nn.Module,
    images: np.ndarray,
    rows: np.ndarray,
    mean_image: Tensor,
    batch_size: int,
    device: torch.device | str,
) -> dict[str, float]:
    """Mean squared errors of `model(batch)` and of the mean image on scenes `rows`.

    Returns:
        A dict: `error` and `mean_image_error` of all pixels, and `error_foreground` and
        `mean_image_error_foreground` of those that differ from the mean image.
    """
    model.eval()
    sums = torch.zeros(2, 2, dtype=torch.float64)  # of the model and of the mean image
    counts = torch.zeros(2, dtype=torch.float64)  # of all pixels and of the foreground
    for start in range(0, len(rows), batch_size):
        batch = batch_of(images, rows[start : start + batch_size], device)
        differs = foreground(batch, mean_image).float()
        errors = (
            (model(batch) - batch).square().mean(2, keepdim=True),
            (mean_image - batch).square().mean(2, keepdim=True),
        )
        for j, mask in enumerate((torch.ones_like(differs), differs)):
            counts[j] += mask.sum().item()
            for i, error in enumerate(errors):
                sums[i, j] += (error * mask).sum().item()
    model.train()
    (ours, ours_foreground), (mean, mean_foreground) = (sums / counts).tolist()
    return {
        "error": ours,
        "error_foreground": ours_foreground,
        "mean_image_error": mean,
        "mean_image_error_foreground": mean_foreground,
    }


@torch.no_grad()
def comparison(model: nn.Module, batch: Tensor) -> np.ndarray:
    """A figure, uint8 (2 height, cameras * width, 3): a scene's images above their reconstruction.

    `batch` is of one scene, (1, cameras, 3, height, width).
    """
    rows = [torch.cat(list(images), dim=2) for images in (batch[0], model(batch)[0])]
    return (torch.cat(rows, dim=1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
