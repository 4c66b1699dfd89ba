"""VAE of what four cameras see: a scene latent z_E of 64 numbers. Read it from the top.

    python -m roboarm_nmp.scene_embedding_train.collect --sensors images --image-size 128 --num 20000
    python scene_embedding_train/vae.py --observations observations

A variational autoencoder (Kingma and Welling, 2013) as in the paper's appendix "Training and
verifying the encoders": each camera has an encoder to 16 numbers and a decoder, and every decoder
sees all 64. What is saved, `encoder.pt`, is an exported network from the images to the
means of z_E. To make an encoder of your own, copy this file and change the parts under `# MODEL`.
Parts between `# SHARED` and `# END SHARED` are those of `vqvae.py`.
"""

import math
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn as nn

from roboarm_nmp.envs.networks.exported_networks import save_network
from roboarm_nmp.envs.perception.sensors import sensors_to_json
from roboarm_nmp.envs.training.flags import (
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Share,
    Width,
)
from roboarm_nmp.envs.training.runs import (
    RunFlags,
    elapsed,
    load_checkpoint,
    parse_args,
    progress_bar,
    rate,
    run_folder,
    save_checkpoint,
    seed_torch,
    summary_writer,
    write_json,
)
from roboarm_nmp.scene_embedding_train.pictures import (
    averaged,
    batch_of,
    comparison,
    foreground,
    load_images,
    mean_picture,
    reconstruction_errors,
)
from roboarm_nmp.scene_embedding_train.training_data import open_observations, split


@dataclass
class Args(RunFlags):  # those of the run's folder are in `envs/training/runs.py`
    exp_name: str = "vae"
    """name of the experiment, part of the run's folder"""

    # SHARED: the data
    # The data
    observations: Path = Path("observations")
    """folder that `scene_embedding_train.collect` wrote"""
    validation_share: Share = 0.05
    """share of the scenes, the last ones, that is not trained on"""
    # END SHARED

    # The algorithm
    total_updates: PositiveInt = 20_000
    """batches of the whole run"""
    batch_size: PositiveInt = 32
    """scenes per batch"""
    picture_size: Width = 64
    """width and height (pixels) that pictures are averaged down to, as part of the encoder"""
    learning_rate: PositiveFloat = 1e-3
    """learning rate (Adam) at the start; it falls linearly to zero"""
    latent_size: Width = 16
    """numbers per camera (paper: 16)"""
    width: Width = 12
    """channels of the first convolution; each further one has twice as many"""
    kl_weight: NonNegativeFloat = 0.001
    """weight of the KL divergence, per latent number, beside the squared error of a picture (with
    50 times as much, obstacles are not seen)"""
    foreground_weight: NonNegativeFloat = 10.0
    """weight of pixels that differ from the mean picture, beside 1 for the others: obstacles are
    few pixels (0: all pixels count the same)"""

    # SHARED: bookkeeping
    eval_every: PositiveInt = 2_000
    """batches between evaluations on validation scenes; the best encoder is kept"""
    eval_scenes: PositiveInt = 512
    """validation scenes per evaluation"""
    # END SHARED


# SHARED: networks for pictures
def num_halvings(size):
    """How often pictures of `size` pixels can be halved until at most 7 are left."""
    halvings = 0
    while size > 7 and size % 2 == 0:
        size, halvings = size // 2, halvings + 1
    return halvings


def convolutions(size, width):
    """Pictures (n, 3, size, size) -> features (n, k), and k."""
    halvings = num_halvings(size)
    channels = [3, *(width * 2**i for i in range(halvings))]
    layers = []
    for a, b in zip(channels, channels[1:], strict=False):
        layers += [nn.Conv2d(a, b, 4, stride=2, padding=1), nn.ReLU()]
    return nn.Sequential(*layers, nn.Flatten()), channels[-1] * (size // 2**halvings) ** 2


# END SHARED


# SHARED: a decoder of pictures
class Decoder(nn.Module):
    """A latent (n, inputs) -> one camera's pictures (n, 3, size, size) in [0, 1]."""

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


# END SHARED


# MODEL
class Encoder(nn.Module):
    """One camera's pictures (n, 3, size, size) -> means and log variances, each (n, latent)."""

    def __init__(self, size, args):
        super().__init__()
        self.convolutions, features = convolutions(size, args.width)
        self.head = nn.Linear(features, 2 * args.latent_size)

    def forward(self, pictures):
        return self.head(self.convolutions(pictures)).chunk(2, dim=1)


class VAE(nn.Module):
    """An encoder and a decoder per camera; every decoder sees all cameras' latents."""

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
        """Images as they come back from z_E's mean."""
        return self.decode(self.encode(images)[0])


def kl_divergence(mean, log_variance):
    """Of the normal distributions from the standard one, per latent number: (n, 64)."""
    return 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance)


class SceneEncoder(nn.Module):
    """What is saved: each camera's pictures uint8 (n, height, width, 3), by name -> z_E."""

    def __init__(self, vae, cameras, size):
        super().__init__()
        self.vae, self.cameras, self.size = vae, cameras, size

    def forward(self, **pictures):
        images = averaged(torch.stack([pictures[name] for name in self.cameras], 1), self.size)
        return self.vae.encode(images)[0]


def update(model, optimizer, batch, mean_image, args):
    """One step on a batch (n, cameras, 3, size, size); its losses, a dict of scalars."""
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

    # SHARED: pictures to train on
    observations = open_observations(args.observations)
    size = args.picture_size
    if num_halvings(size) == 0:
        sys.exit(f"--picture-size {size}: 8, 16, 32, 64, 128, ... pixels")
    num_training, validation = split(observations, args)
    images, cameras = load_images(observations, size)
    run, device = run_folder(args, observations.task), seed_torch(args)
    rng = np.random.default_rng(args.seed)
    mean_image = mean_picture(images, num_training, device)
    # What the encoder that is saved gets: pictures as the cameras took them.
    last = len(observations.offsets) - 2
    example = {
        name: torch.from_numpy(observations.read(last, f"{name}/rgb")[:2]) for name in cameras
    }
    # END SHARED

    # MODEL: network and optimiser
    model = VAE(len(cameras), size, args).to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)

    # SHARED: checkpoint and log
    progress = {"updates": 0, "seconds": 0.0, "best_error": math.inf, "best_update": 0, "best": {}}
    checkpoint_state = {"model": model, "optimizer": optimizer, "rng": rng, "progress": progress}
    load_checkpoint(args, checkpoint_state)
    seconds_before = progress["seconds"]
    writer = summary_writer(run, args, progress["updates"])
    bar = progress_bar(args.total_updates, progress["updates"], "update")
    # END SHARED

    while progress["updates"] < args.total_updates:
        # MODEL: learn
        remaining = 1.0 - progress["updates"] / args.total_updates
        optimizer.param_groups[0]["lr"] = args.learning_rate * remaining
        batch = batch_of(images, rng.integers(num_training, size=args.batch_size), device)
        losses = update(model, optimizer, batch, mean_image, args)
        progress["updates"] = step = progress["updates"] + 1
        bar.update()
        if step % 100 == 0:
            for name, value in losses.items():
                writer.add_scalar(f"losses/{name}", value.item(), step)
            writer.add_scalar("charts/updates_per_second", rate(bar), step)

        # SHARED: evaluate, keep the best encoder
        if step % args.eval_every == 0 or step == args.total_updates:
            errors = (model, images, validation, mean_image, args.batch_size, device)
            result = reconstruction_errors(*errors)
            for name, value in result.items():
                writer.add_scalar(f"eval/{name}", value, step)
            picture = comparison(model, batch_of(images, validation[:1], device))
            writer.add_image("eval/reconstruction", picture, step, dataformats="HWC")
            if result["error_foreground"] < progress["best_error"]:
                progress["best_error"], progress["best_update"] = result["error_foreground"], step
                progress["best"] = result
                metadata = {"kind": "encoder", "script": args.exp_name, "task": observations.task}
                sensors = {name: observations.sensors[name] for name in cameras}
                metadata |= {"sensors": sensors_to_json(sensors), "seed": args.seed, "step": step}
                encoder = SceneEncoder(model, tuple(cameras), size)
                save_network(run / "encoder.pt", encoder, example, metadata | result)
            bar.set_postfix(error=f"{result['error_foreground']:.4f}")
            # END SHARED
            # SHARED: checkpoint and result
            progress["seconds"] = seconds_before + elapsed(bar)
            save_checkpoint(run, checkpoint_state, device)
    bar.close()

    result = progress["best"] | {"scenes": num_training, "encoder": str(run / "encoder.pt")}
    result |= {name: progress[name] for name in ("updates", "best_update")}
    result["seconds"] = round(progress["seconds"])
    write_json(run / "result.json", result | {"args": asdict(args)})
    # END SHARED
    shown = "error {error:.5f} (mean image {mean_image_error:.5f}); of what differs from it "
    shown += "{error_foreground:.4f} ({mean_image_error_foreground:.4f})"
    print(f"{shown.format(**result)}. {run / 'result.json'}")
    writer.close()
