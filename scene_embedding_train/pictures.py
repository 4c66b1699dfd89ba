"""Cameras' pictures, as the trainers of image encoders use them: batches, errors, comparisons.

Pictures are averaged down, to save time. `load_images` does it once for what is trained on,
`averaged` in the encoder that is saved.
"""

import sys

import numpy as np
import torch
import torch.nn.functional as F

from roboarm_nmp.envs.perception.sensors import Camera
from roboarm_nmp.scene_embedding_train.training_data import unpacked


def load_images(observations, size):
    """What the cameras saw, averaged down: uint8 (scenes, cameras, size, size, 3); cameras' names.

    Unpacked once into a file beside the shards, which is then mapped into memory.
    """
    cameras = [name for name, one in observations.sensors.items() if isinstance(one, Camera)]
    if not cameras:
        sys.exit(f"--observations: {observations.folder} has no images (collect with --sensors)")
    sizes = {observations.sensors[name].size for name in cameras}
    if len(sizes) > 1 or any("rgb" not in observations.sensors[name].outputs for name in cameras):
        sys.exit(f"--observations: {observations.folder}: the cameras differ in size, or lack rgb")
    width, height = sizes.pop()
    if width != height or width % size:
        sys.exit(f"--picture-size {size}: the pictures have {width} x {height} pixels")
    shards = (
        {"rgb": shrunk_pictures(observations, shard, cameras, size)}
        for shard in range(len(observations.offsets) - 1)
    )
    arrays = {"rgb": (np.uint8, (len(cameras), size, size, 3))}
    return unpacked(observations, f"pictures_{size}", arrays, shards)["rgb"], cameras


def shrunk_pictures(observations, shard, cameras, size):
    """`load_images`'s rows of one shard."""
    shrunk = []
    for name in cameras:
        pictures = observations.read(shard, f"{name}/rgb")
        block = pictures.shape[1] // size
        blocks = pictures.reshape(-1, size, block, size, block, 3)
        shrunk.append(blocks.mean((2, 4)).round().astype(np.uint8))
    return np.stack(shrunk, axis=1)


def batch_of(images, rows, device):
    """Rows of `load_images`'s array as float32 (n, cameras, 3, size, size) in [0, 1]."""
    chosen = torch.from_numpy(images[np.sort(rows)]).to(device)
    return chosen.permute(0, 1, 4, 2, 3).float() / 255.0


def averaged(images, size):
    """uint8 (n, cameras, height, width, 3) -> float32 (n, cameras, 3, size, size) in [0, 1]."""
    pictures = images.flatten(0, 1).permute(0, 3, 1, 2).float() / 255.0
    return F.avg_pool2d(pictures, images.shape[2] // size).unflatten(0, images.shape[:2])


def mean_picture(images, num_training, device):
    """The mean of the first `num_training` rows (of some 1,000 of them), as `batch_of` has one."""
    rows = np.linspace(0, num_training - 1, min(num_training, 1000)).astype(int)
    return batch_of(images, rows, device).mean(0)


def foreground(batch, mean_image):
    """Which pixels are unlike the mean picture: bool (n, cameras, 1, size, size)."""
    return (batch - mean_image).abs().amax(2, keepdim=True) > 0.1


@torch.no_grad()
def reconstruction_errors(model, images, rows, mean_image, batch_size, device):
    """Mean squared errors of `model(batch)` and of the mean picture, on scenes `rows`: a dict.

    `error` and `mean_image_error`, of all pixels, and, of those that are unlike the mean picture,
    `error_foreground` and `mean_image_error_foreground`.
    """
    model.eval()
    sums, counts = torch.zeros(2, 2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    for start in range(0, len(rows), batch_size):
        batch = batch_of(images, rows[start : start + batch_size], device)
        unlike = foreground(batch, mean_image).float()
        errors = [(model(batch) - batch).square().mean(2, keepdim=True)]
        errors.append((mean_image - batch).square().mean(2, keepdim=True))
        for j, mask in enumerate((torch.ones_like(unlike), unlike)):
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
def comparison(model, batch):
    """For TensorBoard, uint8 (2 height, cameras * width, 3): a scene above, `model`'s of it below.

    `batch` is of one scene, (1, cameras, 3, height, width).
    """
    rows = [torch.cat(list(one), dim=2) for one in (batch[0], model(batch)[0])]
    return (torch.cat(rows, dim=1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
