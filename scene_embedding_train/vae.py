"""VAE of what four cameras see: a scene latent z_E of 64 numbers. Read it from the top.

    python -m scene_embedding_train.collect --sensors images --image-size 128 --num 20000
    python scene_embedding_train/vae.py --observations observations

A variational autoencoder (Kingma and Welling, 2013) as in the paper's appendix "Training and
verifying the encoders": each camera has an encoder to 16 numbers and a decoder, and every decoder
sees all 64. What is saved, `encoder.pt`, is a program (`envs/programs.py`) from the images to the
means of z_E. To make an encoder of your own, copy this file and change the parts under `# MODEL`.
Parts between `# SHARED` and `# END SHARED` are those of `vqvae.py`.
"""

import json
import math
import os
import sys
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from envs.datasets import DatasetError
from envs.observations import Observations, sensors_to_json
from envs.programs import save_program
from envs.sensors import Camera


@dataclass
class Args:
    # The run
    exp_name: str = "vae"
    """name of the experiment, part of the run's folder"""
    # SHARED: the run and the data
    seed: int = 1
    """seed of everything random; the same seed gives the same run on the same machine and device"""
    runs_dir: Path = Path("runs")
    """the run's folder is made in here: TensorBoard events, checkpoint, encoder.pt, result.json"""
    resume: Path | None = None
    """continue the run in this folder from its last checkpoint; its own flags are used"""
    device: str = "cpu"
    """`cpu` or `cuda`"""
    threads: int = 1
    """torch threads"""

    # The data
    observations: Path = Path("observations")
    """folder that `scene_embedding_train.collect` wrote"""
    validation_share: float = 0.05
    """share of the scenes, the last ones, that is not trained on"""
    # END SHARED

    # The algorithm
    total_updates: int = 20_000
    """batches of the whole run"""
    batch_size: int = 32
    """scenes per batch"""
    picture_size: int = 64
    """width and height (pixels) that pictures are averaged down to, as part of the encoder"""
    learning_rate: float = 1e-3
    """learning rate (Adam) at the start; it falls linearly to zero"""
    latent_size: int = 16
    """numbers per camera (paper: 16)"""
    width: int = 12
    """channels of the first convolution; each further one has twice as many"""
    kl_weight: float = 0.001
    """weight of the KL divergence, per latent number, beside the squared error of a picture (with
    50 times as much, obstacles are not seen)"""
    foreground_weight: float = 10.0
    """weight of pixels that differ from the mean picture, beside 1 for the others: obstacles are
    few pixels (0: all pixels count the same)"""

    # SHARED: bookkeeping
    eval_every: int = 2_000
    """batches between evaluations on validation scenes; the best encoder is kept"""
    eval_scenes: int = 512
    """validation scenes per evaluation"""
    # END SHARED


# SHARED: arguments
def configuration_of(args):
    """The fields that define what is computed: a run can only be resumed with the same."""
    free = {"resume", "runs_dir", "threads", "observations"}
    return {k: v for k, v in asdict(args).items() if k not in free}


# END SHARED


# SHARED: images
def load_images(observations, size):
    """What the cameras saw, averaged down: uint8 (scenes, cameras, size, size, 3); cameras' names.

    Unpacked once into a file beside the shards, which is then mapped into memory: it may be larger
    than the memory.
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
    path = observations.folder / f"images_{len(observations)}_{size}.npy"
    if not path.exists():
        temporary = path.with_suffix(".part")
        shape = (len(observations), len(cameras), size, size, 3)
        unpacked = np.lib.format.open_memmap(temporary, "w+", np.uint8, shape)
        for shard in tqdm(range(len(observations.offsets) - 1), desc="unpacking", unit="shard"):
            rows = slice(*observations.offsets[shard : shard + 2])
            for i, name in enumerate(cameras):
                pictures = observations.read(shard, f"{name}/rgb")
                blocks = pictures.reshape(-1, size, width // size, size, width // size, 3)
                unpacked[rows, i] = blocks.mean((2, 4)).round()
        unpacked.flush()
        os.replace(temporary, path)
    return np.load(path, mmap_mode="r"), cameras


def batch_of(images, rows, device):
    """Rows of `load_images`'s array as float32 (n, cameras, 3, height, width) in [0, 1]."""
    chosen = torch.from_numpy(images[np.sort(rows)]).to(device)
    return chosen.permute(0, 1, 4, 2, 3).float() / 255.0


def averaged(images, size):
    """uint8 (n, cameras, height, width, 3) -> float32 (n, cameras, 3, size, size) in [0, 1]."""
    pictures = images.flatten(0, 1).permute(0, 3, 1, 2).float() / 255.0
    return F.avg_pool2d(pictures, images.shape[2] // size).unflatten(0, images.shape[:2])


def pixel_weights(images, mean_image, foreground_weight):
    """Weights (n, cameras, 1, height, width) of pixels: larger where a picture is unlike the mean.

    `images` (n, cameras, 3, height, width); `mean_image` the same without n.
    """
    unlike = (images - mean_image).abs().amax(2, keepdim=True) > 0.1
    return 1.0 + foreground_weight * unlike


def num_halvings(size):
    """How often pictures of `size` pixels can be halved until at most 7 are left."""
    halvings = 0
    while size > 7 and size % 2 == 0:
        size, halvings = size // 2, halvings + 1
    return halvings


# END SHARED


# MODEL
class Encoder(nn.Module):
    """One camera's pictures (n, 3, size, size) -> means and log variances, each (n, latent)."""

    def __init__(self, size, args):
        super().__init__()
        channels = [3, *(args.width * 2**i for i in range(num_halvings(size)))]
        layers = []
        for a, b in zip(channels, channels[1:], strict=False):
            layers += [nn.Conv2d(a, b, 4, stride=2, padding=1), nn.ReLU()]
        self.convolutions = nn.Sequential(*layers)
        features = channels[-1] * (size // 2 ** num_halvings(size)) ** 2
        self.head = nn.Linear(features, 2 * args.latent_size)

    def forward(self, pictures):
        return self.head(self.convolutions(pictures).flatten(1)).chunk(2, dim=1)


# SHARED: decoder
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


# SHARED: files and resuming
def write_atomically(path, write):
    """`write(temporary)`, then rename: whoever reads `path` sees the old file or the new one."""
    temporary = path.with_name(path.name + ".part")
    write(temporary)
    with open(temporary, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(temporary, path)


def parse_args():
    """Flags, or with --resume those of the run, which must not be contradicted."""
    args = tyro.cli(Args)
    if args.resume is None:
        return args
    saved_file = args.resume / "args.json"
    if not saved_file.exists():
        sys.exit(f"--resume: {args.resume} is no run's folder (it has no args.json)")
    saved = json.loads(saved_file.read_text())
    defaults = Args(**{f.name: saved[f.name] for f in fields(Args) if f.name in saved})
    defaults.resume, defaults.runs_dir = args.resume, Path(defaults.runs_dir)
    defaults.observations = Path(defaults.observations)
    args = tyro.cli(Args, default=defaults)
    contradicted = [
        f"--{name.replace('_', '-')} is {value!r} now, the run had {saved.get(name)!r}"
        for name, value in configuration_of(args).items()
        if value != saved.get(name)
    ]
    if contradicted:
        sys.exit("--resume: the run has another configuration: " + "; ".join(contradicted))
    return args


# END SHARED


# SHARED: errors and pictures
def comparison(images, reconstructed):
    """A picture, uint8: the cameras' images of one scene above, their reconstructions below."""
    rows = [torch.cat(list(one), dim=2) for one in (images, reconstructed)]
    return (torch.cat(rows, dim=1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()


@torch.no_grad()
def evaluate(model, images, rows, mean_image, batch_size, device):
    """Mean squared errors of the reconstructions and of the mean image, on scenes `rows`.

    All pixels, and those that are unlike the mean image (`foreground`).
    """
    model.eval()
    sums, counts = torch.zeros(2, 2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    for start in range(0, len(rows), batch_size):
        batch = batch_of(images, rows[start : start + batch_size], device)
        unlike = pixel_weights(batch, mean_image, 1.0) - 1.0
        everything = torch.ones_like(unlike)
        errors = [(model(batch) - batch).square().mean(2, keepdim=True)]
        errors.append((mean_image - batch).square().mean(2, keepdim=True))
        for j, mask in enumerate((everything, unlike)):
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


# END SHARED


if __name__ == "__main__":
    # SHARED: checks
    args = parse_args()
    if args.device == "cuda" and not torch.cuda.is_available():
        sys.exit("--device cuda: PyTorch sees no CUDA device here")
    try:
        observations = Observations(args.observations)
    except DatasetError as error:
        sys.exit(f"--observations: {error}")
    # END SHARED
    # SHARED: images to train on
    size = args.picture_size
    if num_halvings(size) == 0:
        sys.exit(f"--picture-size {size}: 8, 16, 32, 64, 128, ... pixels")
    images, cameras = load_images(observations, size)
    # END SHARED

    # SHARED: folder and seeds
    num_training = len(observations) - max(1, round(args.validation_share * len(observations)))
    validation = np.arange(num_training, len(observations))[: args.eval_scenes]
    if num_training < 1:
        sys.exit(f"--observations: {len(observations)} scenes are too few")
    if args.resume is not None:
        run = args.resume
    else:
        name = f"{observations.task}__{args.exp_name}__{args.seed}__{int(time.time())}"
        run = args.runs_dir / name
        run.mkdir(parents=True)
        text = json.dumps(asdict(args), indent=2, default=str)
        write_atomically(run / "args.json", lambda path: path.write_text(text))
    torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # or cuBLAS is not deterministic
    torch.use_deterministic_algorithms(True)
    device = torch.device(args.device)
    rng = np.random.default_rng(args.seed)
    # END SHARED

    # SHARED: the mean image
    some = np.linspace(0, num_training - 1, min(num_training, 1000)).astype(int)
    mean_image = batch_of(images, some, device).mean(0)
    # END SHARED

    # MODEL: network and optimiser
    model = VAE(len(cameras), size, args).to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)

    # SHARED: checkpoints
    saved_parts = {"model": model, "optimizer": optimizer}
    progress = {"updates": 0, "seconds": 0.0, "best_error": math.inf, "best_update": 0}
    progress["best"] = {}

    def save_checkpoint():
        state = {name: part.state_dict() for name, part in saved_parts.items()}
        state |= {"progress": progress, "torch_rng": torch.get_rng_state()}
        state["rng"] = json.dumps(rng.bit_generator.state)
        if device.type == "cuda":
            state["cuda_rng"] = torch.cuda.get_rng_state()
        write_atomically(run / "checkpoint.pt", lambda path: torch.save(state, path))

    if args.resume is not None and (run / "checkpoint.pt").exists():
        try:
            state = torch.load(run / "checkpoint.pt", map_location=device, weights_only=True)
        except Exception as error:  # whatever a damaged file leads to
            sys.exit(f"--resume: {run / 'checkpoint.pt'} is damaged: {error}")
        for name, part in saved_parts.items():
            part.load_state_dict(state[name])
        progress.update(state["progress"])
        rng.bit_generator.state = json.loads(state["rng"])
        torch.set_rng_state(state["torch_rng"].cpu())
        if device.type == "cuda":
            torch.cuda.set_rng_state(state["cuda_rng"].cpu())
        del state

    writer = SummaryWriter(run, purge_step=progress["updates"] + 1)
    writer.add_text(
        "hyperparameters",
        "|param|value|\n|-|-|\n" + "\n".join(f"|{k}|{v}|" for k, v in asdict(args).items()),
    )
    started, seconds_before = time.time(), progress["seconds"]
    updates_before = progress["updates"]
    bar = tqdm(
        total=args.total_updates,
        initial=updates_before,
        unit="update",
        smoothing=0.05,
        mininterval=0.2 if sys.stderr.isatty() else 30,  # seconds; a log file needs fewer lines
    )
    # END SHARED

    while progress["updates"] < args.total_updates:
        # MODEL: learn
        remaining = 1.0 - progress["updates"] / args.total_updates
        optimizer.param_groups[0]["lr"] = args.learning_rate * remaining
        batch = batch_of(images, rng.integers(num_training, size=args.batch_size), device)
        mean, log_variance = model.encode(batch)
        latent = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
        weights = pixel_weights(batch, mean_image, args.foreground_weight)
        error = (weights * (model.decode(latent) - batch).square()).sum() / (3 * weights.sum())
        kl = kl_divergence(mean, log_variance).mean()
        loss = error + args.kl_weight * kl
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        progress["updates"] += 1
        bar.update()

        step = progress["updates"]
        if step % 100 == 0:
            writer.add_scalar("losses/reconstruction", error.item(), step)
            writer.add_scalar("losses/kl", kl.item(), step)
            writer.add_scalar("losses/loss", loss.item(), step)
            ups = (step - updates_before) / (time.time() - started)
            writer.add_scalar("charts/updates_per_second", ups, step)

        # SHARED: evaluate, keep the best encoder
        if step % args.eval_every == 0 or step == args.total_updates:
            result = evaluate(model, images, validation, mean_image, args.batch_size, device)
            for name, value in result.items():
                writer.add_scalar(f"eval/{name}", value, step)
            shown = batch_of(images, validation[:1], device)
            with torch.no_grad():
                picture = comparison(shown[0], model(shown)[0])
            writer.add_image("eval/reconstruction", picture, step, dataformats="HWC")
            if result["error_foreground"] < progress["best_error"]:
                progress["best_error"], progress["best_update"] = result["error_foreground"], step
                last = len(observations.offsets) - 2
                example = {
                    name: torch.from_numpy(observations.read(last, f"{name}/rgb")[:2])
                    for name in cameras
                }
                metadata = {"kind": "encoder", "script": args.exp_name, "task": observations.task}
                metadata |= {
                    "sensors": sensors_to_json({k: observations.sensors[k] for k in cameras})
                }
                metadata |= {"seed": args.seed, "step": step, **result}
                encoder = SceneEncoder(model, tuple(cameras), size)
                save_program(run / "encoder.pt", encoder, example, metadata)
                progress["best"] = result
            bar.set_postfix(error=f"{result['error_foreground']:.4f}")
            # END SHARED
            # SHARED: checkpoint
            progress["seconds"] = seconds_before + time.time() - started
            save_checkpoint()
    bar.close()

    result = progress["best"] | {"scenes": num_training, "encoder": str(run / "encoder.pt")}
    result |= {"updates": progress["updates"], "best_update": progress["best_update"]}
    result |= {"seconds": round(progress["seconds"])}
    text = json.dumps(result | {"args": asdict(args)}, indent=2, default=str)
    write_atomically(run / "result.json", lambda path: path.write_text(text))
    # END SHARED
    shown = "error {error:.5f} (mean image {mean_image_error:.5f}); of what differs from it "
    shown += "{error_foreground:.4f} ({mean_image_error_foreground:.4f})"
    print(f"{shown.format(**result)}. {run / 'result.json'}")
    writer.close()
