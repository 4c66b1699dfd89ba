"""VQ-VAE of four camera images: a 64-dimensional latent code z_E. Read it from the top.

    roboarm observations --sensors images --image-size 128 --num 20000
    roboarm train vqvae --observations observations

A vector-quantised autoencoder (van den Oord et al., 2017) as in the paper's appendix "Training and
verifying the encoders": each camera has an encoder to 16 dimensions, which consist of vectors from
a codebook, and a decoder that receives these 16. What is saved, `encoder.onnx`, is a
network from the images to z_E, the cameras' latent codes side by side. To make an encoder of your
own, copy this file and change the parts under `# MODEL`. Parts under `# SHARED` are
those of `vae.py`.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

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
    code_size: PositiveInt = 2
    """dimensions of a codebook's vectors; latent_size / code_size of them are a camera's code"""
    num_codes: PositiveInt = 256
    """vectors in each camera's codebook"""
    commitment: NonNegativeFloat = 0.25
    """weight of the loss that draws latents to their codes, beside 1 for the one of the codes"""
    restart_every: PositiveInt = 500
    """updates after which codes that were not used since are replaced by outputs of the encoder"""
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
class Codebook(nn.Module):
    """Quantises vectors: each becomes the nearest of `num_codes` codes."""

    uses: torch.Tensor  # of each code, since the last restart

    def __init__(self, args):
        super().__init__()
        self.codes = nn.Parameter(torch.empty(args.num_codes, args.code_size).uniform_(-1.0, 1.0))
        self.register_buffer("uses", torch.zeros(args.num_codes))

    def forward(self, vectors):
        """(..., code_size) -> the nearest codes, the same shape, and their indices (...,)."""
        indices = torch.cdist(vectors.flatten(0, -2), self.codes).argmin(1)
        return self.codes[indices].unflatten(0, vectors.shape[:-1]), indices

    @torch.no_grad()
    def restart(self, vectors):
        """Replace codes not used since the last call by random ones of `vectors` (n, code_size).

        Returns the share of the codes that were used.
        """
        used = (self.uses > 0).float().mean().item()
        unused = torch.nonzero(self.uses == 0).flatten()
        chosen = torch.randint(len(vectors), (len(unused),), device=vectors.device)
        self.codes[unused] = vectors[chosen]
        self.uses.zero_()
        return used


def straight_through(latent, quantised):
    """The quantised latent, whose gradient goes to the latent as if it was not quantised."""
    return latent + (quantised - latent).detach()


class Encoder(nn.Module):
    """One camera's images (n, 3, size, size) -> its latent (n, vectors, code_size)."""

    def __init__(self, size, args):
        super().__init__()
        self.convolutions, features = convolutions(size, args.width)
        self.head = nn.Linear(features, args.latent_size)
        self.code_size = args.code_size

    def forward(self, images):
        latent = self.head(self.convolutions(images))
        return latent.unflatten(1, (-1, self.code_size))


class VQVAE(nn.Module):
    """An encoder, a codebook and a decoder per camera."""

    def __init__(self, num_cameras, size, args):
        super().__init__()
        self.encoders = nn.ModuleList(Encoder(size, args) for _ in range(num_cameras))
        self.codebooks = nn.ModuleList(Codebook(args) for _ in range(num_cameras))
        self.decoders = nn.ModuleList(
            Decoder(args.latent_size, size, args) for _ in range(num_cameras)
        )

    def encode(self, images):
        """(n, cameras, 3, size, size) -> each camera's latent, codes and their indices, a list."""
        latents = [encoder(images[:, i]) for i, encoder in enumerate(self.encoders)]
        return [(z, *codebook(z)) for z, codebook in zip(latents, self.codebooks, strict=True)]

    def decode(self, latents):
        """Cameras' latents, a list of (n, vectors, code_size) -> images."""
        pairs = zip(self.decoders, latents, strict=True)
        return torch.stack([decoder(latent.flatten(1)) for decoder, latent in pairs], dim=1)

    def restart_codes(self, latents):
        """`Codebook.restart` with the cameras' latents; the mean share of used codes."""
        used = []
        for codebook, vectors in zip(self.codebooks, latents, strict=True):
            assert isinstance(codebook, Codebook)
            used.append(codebook.restart(vectors.flatten(0, 1)))
        return np.mean(used)

    def forward(self, images):
        """Images as they are decoded from z_E."""
        return self.decode([quantised for _, quantised, _ in self.encode(images)])


class ExportedEncoder(nn.Module):
    """What is saved: each camera's images, uint8 (n, height, width, 3), by name -> z_E (n, 64)."""

    def __init__(self, vqvae, cameras, size):
        super().__init__()
        self.vqvae, self.cameras, self.size = vqvae, cameras, size

    def forward(self, **images):
        stacked = torch.stack([images[name] for name in self.cameras], dim=1)
        encoded = self.vqvae.encode(average_down(stacked, self.size))
        return torch.cat([quantised.flatten(1) for _, quantised, _ in encoded], dim=1)


def update(model, optimizer, batch, mean_image, args):
    """One step on a batch (n, cameras, 3, size, size).

    Returns its losses, a dict of scalars, and the cameras' latents before quantisation, a list of
    (n, vectors, code_size).
    """
    latents, quantised, indices = zip(*model.encode(batch), strict=True)
    weights = 1.0 + args.foreground_weight * foreground(batch, mean_image)
    pairs = list(zip(latents, quantised, strict=True))
    decoded = model.decode([straight_through(z, code) for z, code in pairs])
    error = (weights * (decoded - batch).square()).sum() / (3 * weights.sum())
    codes = sum((z.detach() - code).square().mean() for z, code in pairs)
    commitment = sum((z - code.detach()).square().mean() for z, code in pairs)
    loss = error + (codes + args.commitment * commitment) / len(pairs)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    for codebook, chosen in zip(model.codebooks, indices, strict=True):
        codebook.uses += F.one_hot(chosen, args.num_codes).sum(0)
    losses = {"reconstruction": error, "commitment": commitment, "loss": loss}
    return losses, [z.detach() for z in latents]


if __name__ == "__main__":
    args = parse_args(Args, may_change={"observations"})
    if args.latent_size % args.code_size:
        fail(f"--latent-size {args.latent_size} is no multiple of --code-size {args.code_size}")

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
    model = VQVAE(len(cameras), size, args).to(device)
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
        losses, latents = update(model, optimizer, batch, mean_image, args)
        run.advance()
        step = run.step
        if step % args.restart_every == 0:
            run.log({"charts/codes_used": model.restart_codes(latents)})
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
