"""VAE of four camera images: a 64-dimensional latent code z_E. Read it from the top.

    roboarm observations --sensors images --image-size 128 --num 20000
    roboarm train vae --observations observations

A variational autoencoder (Kingma and Welling, 2013) as in the paper's appendix "Training and
verifying the encoders": each camera has an encoder to 16 dimensions and a decoder, and every
decoder receives all 64. What is saved, `encoder.onnx`, is a network from the images to the
mean of z_E. To make an encoder of your own, copy this file and change the parts under `# MODEL`.
Parts under `# SHARED` are those of `vqvae.py`.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn as nn

from roboarm_nmp.networks.export import save_network
from roboarm_nmp.scene_embedding_train.images import (
    average_down,
    batch_of,
    comparison,
    example_images,
    foreground,
    load_images,
    mean_of_images,
    reconstruction_errors,
)
from roboarm_nmp.scene_embedding_train.training_data import (
    EncoderFlags,
    encoder_metadata,
    load_observations,
    write_result,
)
from roboarm_nmp.training.arguments import fail, parse_args
from roboarm_nmp.training.devices import seed_torch
from roboarm_nmp.training.runs import Run
from roboarm_nmp.utils.flags import NonNegativeFloat, PositiveFloat, PositiveInt, Width


@dataclass
class Args(EncoderFlags):  # whose flags are in `training_data.py`
    # The algorithm
    total_updates: PositiveInt = 20_000
    """batches of the whole run"""
    batch_size: PositiveInt = 32
    """scenes per batch"""
    image_size: Width = 64
    """width and height (pixels) that images are averaged down to, as part of the encoder"""
    learning_rate: PositiveFloat = 1e-3
    """learning rate (Adam) at the start; it falls linearly to zero"""
    latent_size: Width = 16
    """dimensions of z_E per camera (paper: 16)"""
    width: Width = 12
    """channels of the first convolution; each further one has twice as many"""
    kl_weight: NonNegativeFloat = 0.001
    """weight of the KL divergence per latent dimension, beside the squared error of an image (with
    50 times as much, z_E ignores obstacles)"""
    foreground_weight: NonNegativeFloat = 10.0
    """additional weight of pixels that differ from the mean image, as obstacles are few pixels
    (0: all pixels count the same)"""


# SHARED: networks for images
def num_halvings(size):
    """How often images of `size` pixels can be halved until at most 7 are left."""
    halvings = 0
    while size > 7 and size % 2 == 0:
        size, halvings = size // 2, halvings + 1
    return halvings


def convolutions(size, width):
    """Images (n, 3, size, size) -> features (n, k), and k."""
    halvings = num_halvings(size)
    channels = [3, *(width * 2**i for i in range(halvings))]
    layers = []
    for a, b in zip(channels, channels[1:], strict=False):
        layers += [nn.Conv2d(a, b, 4, stride=2, padding=1), nn.ReLU()]
    return nn.Sequential(*layers, nn.Flatten()), channels[-1] * (size // 2**halvings) ** 2


# SHARED: a decoder of images
class Decoder(nn.Module):
    """A latent (n, inputs) -> one camera's images (n, 3, size, size) in [0, 1]."""

    def __init__(self, inputs, size, args):
        super().__init__()
        halvings = num_halvings(size)
        self.smallest = size // 2**halvings
        channels = [*(args.width * 2**i for i in reversed(range(halvings))), 3]
        self.head = nn.Linear(inputs, channels[0] * self.smallest**2)
        layers = []
        for a, b in zip(channels, channels[1:], strict=False):
            layers += [nn.ReLU(), nn.ConvTranspose2d(a, b, 4, stride=2, padding=1)]
        self.convolutions = nn.Sequential(*layers)

    def forward(self, latent):
        features = self.head(latent).unflatten(1, (-1, self.smallest, self.smallest))
        return torch.sigmoid(self.convolutions(features))


# MODEL
class Encoder(nn.Module):
    """One camera's images (n, 3, size, size) -> means and log variances, each (n, latent)."""

    def __init__(self, size, args):
        super().__init__()
        self.convolutions, features = convolutions(size, args.width)
        self.head = nn.Linear(features, 2 * args.latent_size)

    def forward(self, images):
        return self.head(self.convolutions(images)).chunk(2, dim=1)


class VAE(nn.Module):
    """An encoder and a decoder per camera; every decoder receives all cameras' latents."""

    def __init__(self, num_cameras, size, args):
        super().__init__()
        self.encoders = nn.ModuleList(Encoder(size, args) for _ in range(num_cameras))
        inputs = num_cameras * args.latent_size
        self.decoders = nn.ModuleList(Decoder(inputs, size, args) for _ in range(num_cameras))

    def encode(self, images):
        """(n, cameras, 3, size, size) -> means and log variances of z_E, each (n, 64)."""
        parts = [encoder(images[:, i]) for i, encoder in enumerate(self.encoders)]
        return tuple(torch.cat(part, dim=1) for part in zip(*parts, strict=True))

    def decode(self, latent):
        """z_E (n, 64) -> images (n, cameras, 3, size, size)."""
        return torch.stack([decoder(latent) for decoder in self.decoders], dim=1)

    def forward(self, images):
        """Images as they are decoded from z_E's mean."""
        return self.decode(self.encode(images)[0])


def kl_divergence(mean, log_variance):
    """Of the normal distributions from the standard one, per latent number: (n, 64)."""
    return 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance)


class ExportedEncoder(nn.Module):
    """What is saved: each camera's images, uint8 (n, height, width, 3), by name -> z_E (n, 64)."""

    def __init__(self, vae, cameras, size):
        super().__init__()
        self.vae, self.cameras, self.size = vae, cameras, size

    def forward(self, **images):
        stacked = torch.stack([images[name] for name in self.cameras], dim=1)
        return self.vae.encode(average_down(stacked, self.size))[0]


def update(model, optimizer, batch, mean_image, args):
    """One step on a batch (n, cameras, 3, size, size). Returns its losses, a dict of scalars."""
    mean, log_variance = model.encode(batch)
    latent = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
    weights = 1.0 + args.foreground_weight * foreground(batch, mean_image)
    error = (weights * (model.decode(latent) - batch).square()).sum() / (3 * weights.sum())
    kl = kl_divergence(mean, log_variance).mean()
    loss = error + args.kl_weight * kl
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return {"reconstruction": error, "kl": kl, "loss": loss}


if __name__ == "__main__":
    args = parse_args(Args, may_change={"observations"})

    # SHARED: images to train on
    size = args.image_size
    if num_halvings(size) == 0:
        fail(f"--image-size {size}: 8, 16, 32, 64, 128, ... pixels")
    observations, num_training, validation = load_observations(args)
    images, cameras = load_images(observations, size)
    example = example_images(observations, cameras)
    metadata = encoder_metadata(args, observations, cameras)
    device = seed_torch(args)
    rng = np.random.default_rng(args.seed)
    mean_image = mean_of_images(images, num_training, device)

    # MODEL: network and optimiser
    model = VAE(len(cameras), size, args).to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)
    best: dict[str, float] = {"step": 0}  # the best evaluation
    state = {"model": model, "optimizer": optimizer, "rng": rng, "best": best}
    run = Run(args, observations.task, state)
    run.start(args.total_updates, "update")

    while run.step < args.total_updates:
        # MODEL: learn
        remaining = 1.0 - run.step / args.total_updates
        optimizer.param_groups[0]["lr"] = args.learning_rate * remaining
        batch = batch_of(images, rng.integers(num_training, size=args.batch_size), device)
        losses = update(model, optimizer, batch, mean_image, args)
        run.advance()
        step = run.step
        if step % 100 == 0:
            run.log({f"losses/{name}": value for name, value in losses.items()})
            run.log({"charts/updates_per_second": run.rate})

        # SHARED: evaluate, keep the best encoder, checkpoint
        evaluating = step % args.eval_every == 0 or step == args.total_updates
        if evaluating:
            result = reconstruction_errors(
                model, images, validation, mean_image, args.batch_size, device
            )
            run.log({f"eval/{name}": value for name, value in result.items()})
            figure = comparison(model, batch_of(images, validation[:1], device))
            run.log_image("eval/reconstruction", figure)
            run.show(validation_error=f"{result['error_foreground']:.4f}")
            if result["error_foreground"] <= best.get("error_foreground", math.inf):
                best.update(result, step=step)
                encoder = ExportedEncoder(model, tuple(cameras), size)
                details = metadata | {"step": step} | result
                save_network(run.folder / "encoder.onnx", encoder, example, details, ["latent"])
        if evaluating or run.interrupted:
            run.save()
    run.close()

    result = write_result(run, best, num_training)
    summary = "error {error:.5f} (mean image {mean_image_error:.5f}); foreground "
    summary += "{error_foreground:.4f} ({mean_image_error_foreground:.4f})"
    print(f"{summary.format(**result)}. {run.folder / 'result.json'}")
