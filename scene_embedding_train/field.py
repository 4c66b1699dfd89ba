"""Distance field of four point clouds: a 64-dimensional latent code z_E. Read it from the top.

    roboarm observations --task mixed_scenes --sensors clouds --num 40000
    roboarm train field --observations observations

A policy needs to avoid contact, so z_E is trained as the code of a distance field (as in DeepSDF,
Park et al., 2019): a decoder predicts the distance from any point around the robot to the nearest
obstacle. The true distances come from the ground-truth obstacles; the encoder receives the observed
points on obstacles. Half of the queried points are near obstacles, each of which counts the same,
however thin; the others are anywhere.

Obstacles stand all around the robot, so each of eight sectors has an eighth of z_E. No weight
depends on the direction, so scenes are rotated and mirrored at random. (Convolutions over a grid
seen from above, and one layer to all of z_E, had twice the error after as many updates:
docs/lab_notebook.md, "Encoders".)

What is saved: `encoder.onnx`, a network from the clouds to z_E, and `encoder.decoder.onnx`, one
from z_E and points to distances. To make an encoder of your own, copy this file and change the
parts under `# MODEL`.
"""

import contextlib
import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from roboarm_nmp.networks.export import save_network
from roboarm_nmp.scene_embedding_train.clouds import (
    example_clouds,
    load_obstacle_points,
    obstacle_points,
)
from roboarm_nmp.scene_embedding_train.obstacles import (
    MAX_DISTANCE,
    MIN_DISTANCE,
    comparison,
    distances,
    load_obstacles,
    rotation_matrices,
)
from roboarm_nmp.scene_embedding_train.training_data import (
    EncoderFlags,
    encoder_metadata,
    load_observations,
    write_result,
)
from roboarm_nmp.training.arguments import fail, parse_args
from roboarm_nmp.training.devices import seed_torch
from roboarm_nmp.training.errors import check_finite
from roboarm_nmp.training.runs import Run
from roboarm_nmp.utils.flags import NonNegativeFloat, PositiveFloat, PositiveInt, Width

# The field is around the robot's axis, m.
REACH, HEIGHT = 1.0, 1.5
NEAR = 0.1  # m: the distances that matter most
# Cells of angle, distance from the axis, and height; sectors, each with an equal part of z_E.
ANGLES, RADII, HEIGHTS = 64, 16, 12
SECTORS = 8


@dataclass
class Args(EncoderFlags):  # whose flags are in `training_data.py`
    # The algorithm
    total_updates: PositiveInt = 20_000
    """batches of the whole run"""
    batch_size: PositiveInt = 32
    """scenes per batch"""
    num_query_points: PositiveInt = 256
    """points per scene and batch whose distance is predicted; half of them near obstacles"""
    spread: PositiveFloat = 0.05
    """standard deviation (m) of the noise that moves the latter away from an obstacle's inside"""
    near_weight: NonNegativeFloat = 4.0
    """additional weight of points within 10 cm of an obstacle"""
    learning_rate: PositiveFloat = 1e-3
    """learning rate (Adam) at the start; it falls linearly to zero"""
    latent_size: Width = 64
    """dimensions of z_E (paper: 64), a multiple of 8"""
    latent_noise: NonNegativeFloat = 0.02
    """standard deviation of noise that is added to z_E in training; z_E's own is 1"""
    num_points: PositiveInt = 96
    """points on obstacles that the encoder receives of each cloud"""
    width: Width = 128
    """features of a sector"""
    bf16: bool | None = None
    """train with products in bfloat16; by default where that is faster"""


# MODEL
def hat_weights(values, high, number):
    """Linear interpolation weights of values (...) between the middles of cells: (..., number).

    There are `number` cells from 0 to `high`; values beyond the outermost middle belong to it.
    """
    middles = torch.arange(number, device=values.device) + 0.5
    at = (values * (number / high)).clamp(0.5, number - 0.5)
    return F.relu(1.0 - (at.unsqueeze(-1) - middles).abs())


def cylindrical(points):
    """Interpolation weights of points (..., 3), m, in cells of angle, radius and height.

    (..., ANGLES), (..., RADII), (..., HEIGHTS), as from `hat_weights`; angles wrap around.
    """
    x, y, z = points.unbind(-1)
    middles = torch.arange(ANGLES, device=points.device) + (0.5 - ANGLES / 2)
    away = (torch.atan2(y, x).unsqueeze(-1) * (ANGLES / (2 * math.pi)) - middles).abs()
    angles = F.relu(1.0 - torch.minimum(away, ANGLES - away))
    radius = (x.square() + y.square()).sqrt()
    return angles, hat_weights(radius, REACH, RADII), hat_weights(z, HEIGHT, HEIGHTS)


class CircularConv(nn.Module):
    """A linear layer and ReLU for each sector and its two neighbours: (n, sectors, features)."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.linear = nn.Linear(3 * inputs, outputs)

    def forward(self, x):
        before = torch.cat([x[:, -1:], x[:, :-1]], dim=1)
        after = torch.cat([x[:, 1:], x[:, :1]], dim=1)
        return F.relu(self.linear(torch.cat([before, x, after], dim=2)))


class Encoder(nn.Module):
    """Points on obstacles (n, p, 3), m, and which are valid (n, p) -> z_E (n, latent), unscaled.

    Points are counted in cells; then sectors are merged in twos until there are `SECTORS`.
    """

    def __init__(self, args):
        super().__init__()
        self.first = CircularConv(RADII * HEIGHTS, args.width)
        halvings = int(math.log2(ANGLES // SECTORS))
        self.layers = nn.ModuleList(
            CircularConv(2 * args.width, args.width) for _ in range(halvings)
        )
        self.last = nn.Linear(args.width, args.latent_size // SECTORS)

    def forward(self, points, valid):
        angles, radii, heights = cylindrical(points)
        cells = (radii * valid.unsqueeze(2)).unsqueeze(3) * heights.unsqueeze(2)
        counts = torch.bmm(angles.transpose(1, 2), cells.flatten(2))
        x = self.first(counts / (counts + 1.0))
        for layer in self.layers:
            x = layer(x.unflatten(1, (-1, 2)).flatten(2))
        return self.last(x).flatten(1)


class Decoder(nn.Module):
    """z_E (n, latent), points (n, q, 3), m -> distance (m) to the nearest obstacle (n, q).

    Sectors, each with its part of z_E, are split in two until there are `ANGLES`. A small network
    receives the features at a point, interpolated, and the point's radius and height.
    """

    def __init__(self, args):
        super().__init__()
        self.first = CircularConv(args.latent_size // SECTORS, args.width)
        doublings = int(math.log2(ANGLES // SECTORS))
        self.layers = nn.ModuleList(
            CircularConv(args.width, 2 * args.width) for _ in range(doublings)
        )
        self.last = nn.Sequential(
            nn.Linear(args.width + RADII + HEIGHTS, 128), nn.ReLU(),
            nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, 1),
        )  # fmt: skip

    def forward(self, latent, points):
        x = self.first(latent.unflatten(1, (SECTORS, -1)))
        for layer in self.layers:
            x = layer(x).unflatten(2, (2, -1)).flatten(1, 2)
        angles, radii, heights = cylindrical(points)
        features = torch.bmm(angles, x)
        return self.last(torch.cat([features, radii, heights], dim=2)).squeeze(2)


class Field(nn.Module):
    """The encoder and the decoder."""

    def __init__(self, args):
        super().__init__()
        self.encoder = Encoder(args)
        self.decoder = Decoder(args)

    def encode(self, points, valid):
        """Observed points -> z_E (n, latent), each scene's with mean 0 and standard deviation 1."""
        z = self.encoder(points, valid)
        return F.layer_norm(z, z.shape[1:])

    def forward(self, points, valid, queries):
        """Observed points, queried points (n, q, 3), m -> distances (n, q), m."""
        return self.decoder(self.encode(points, valid), queries)


def sample_queries(obstacles, number, spread):
    """Random points (n, number, 3), m: the first half near obstacles, the others anywhere.

    A point near an obstacle is drawn inside it (in the box around a cylinder, or around the middle
    half of a sphere), with normal noise of standard deviation `spread`. Points beyond `REACH` are
    moved to a random distance below it from the robot's axis.
    """
    n, device = len(obstacles), obstacles.device
    half = number // 2
    which = (torch.rand(n, half, device=device) * obstacles[..., 0].sum(1, keepdim=True)).long()
    chosen = obstacles.gather(1, which.unsqueeze(2).expand(-1, -1, obstacles.shape[2]))
    _, kind, position, quaternion, size = chosen.split((1, 1, 3, 4, 3), dim=2)
    size = torch.where(kind == 0.0, size, size * size.new_tensor([2.0, 2.0, 1.0]))  # radii
    inside = size * (torch.rand_like(size) - 0.5)
    near = position + (rotation_matrices(quaternion) @ inside.unsqueeze(3)).squeeze(3)
    near = near + spread * torch.randn_like(near)
    low, high = obstacles.new_tensor([[-REACH, -REACH, 0.0], [REACH, REACH, HEIGHT]])
    anywhere = low + (high - low) * torch.rand(n, number - half, 3, device=device)
    points = torch.cat([near, anywhere], dim=1)
    radius = points[..., :2].norm(dim=2, keepdim=True)
    inwards = REACH * torch.rand_like(radius).sqrt() / radius.clamp(min=REACH)
    points[..., :2] *= torch.where(radius > REACH, inwards, 1.0)
    return points


def augment(*points):
    """Points (n, p, 3), each scene's rotated about the robot's axis and mirrored at random."""
    n, device = len(points[0]), points[0].device
    angle = 2 * math.pi * torch.rand(n, 1, device=device)
    mirror = 2.0 * (torch.rand(n, 1, device=device) < 0.5) - 1.0
    c, s = angle.cos(), angle.sin()
    for part in points:
        x, y, z = part.unbind(2)
        y = mirror * y
        yield torch.stack([c * x - s * y, s * x + c * y, z], dim=2)


class ExportedEncoder(nn.Module):
    """What is saved: each sensor's points and labels -> z_E (n, latent).

    The inputs are `<sensor>_points` (n, samples, 3), m, and `<sensor>_labels` (n, samples), uint8.
    """

    def __init__(self, model, names, num_points):
        super().__init__()
        self.model, self.names, self.num_points = model, names, num_points

    def forward(self, **clouds):
        pairs = [(clouds[f"{name}_points"], clouds[f"{name}_labels"]) for name in self.names]
        return self.model.encode(*obstacle_points(pairs, self.num_points))


def update(model, optimizer, batch, args):
    """One step on a batch of `batch_of`.

    Returns a dict of scalars: the weighted error, and the mean error near obstacles, m.
    """
    points, valid, obstacles = batch
    queries = sample_queries(obstacles, args.num_query_points, args.spread)
    truth = distances(obstacles, queries)
    points, queries = augment(points, queries)
    device = queries.device.type
    with torch.autocast(device, torch.bfloat16) if args.bf16 else contextlib.nullcontext():
        z = model.encode(points, valid)
        predicted = model.decoder(z + args.latent_noise * torch.randn_like(z), queries)
    error = (predicted.float() - truth).abs()
    near = truth < NEAR
    weights = 1.0 + args.near_weight * near
    loss = (weights * error).sum() / weights.sum()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return {"loss": loss, "near": (error * near).sum() / near.sum().clamp(min=1)}


@torch.no_grad()
def evaluate(model, data, queries, rows, batch_size, device):
    """Mean errors (m) of predicted distances in scenes `rows` at points `queries` (rows, q, 3).

    Returns:
        A dict: `error_near` of points within `NEAR` of an obstacle, and `error_5cm`, `error_10cm`,
        `error_20cm`, `error_40cm` of those up to that distance, from the previous one on. An error
        is 0 where there are no points.
    """
    spans = {
        "near": (-1.0, NEAR),
        "5cm": (-1.0, 0.05),
        "10cm": (0.05, 0.1),
        "20cm": (0.1, 0.2),
        "40cm": (0.2, 0.4),
    }
    sums = dict.fromkeys(spans, 0.0)
    counts = dict.fromkeys(spans, 0.0)
    for first in range(0, len(rows), batch_size):
        part = slice(first, first + batch_size)
        points, valid, obstacles = batch_of(data, rows[part], device)
        at = queries[part].to(device)
        truth = distances(obstacles, at)
        predicted = model(points, valid, at)
        error = (predicted.clamp(MIN_DISTANCE, MAX_DISTANCE) - truth).abs()
        for name, (low, high) in spans.items():
            inside = (truth > low) & (truth <= high)
            sums[name] += (error * inside).sum().item()
            counts[name] += inside.sum().item()
    return {f"error_{name}": sums[name] / max(1.0, counts[name]) for name in spans}


def batch_of(data, rows, device):
    """Rows of `data`, memory-mapped arrays: a list of tensors.

    They are observed points (n, p, 3), m, which of them are valid (n, p), and obstacles (n, k, 12).
    """
    rows = np.sort(rows)
    return [torch.as_tensor(array[rows], device=device) for array in data]


if __name__ == "__main__":
    args = parse_args(Args, may_change={"observations"})
    if args.latent_size % SECTORS:
        fail(f"--latent-size must be a multiple of {SECTORS}, got {args.latent_size}")
    observations, num_training, validation = load_observations(args)
    names, *data = load_obstacle_points(observations, args.num_points)
    data.append(load_obstacles(observations))
    example = example_clouds(observations, names)
    metadata = encoder_metadata(args, observations, names)
    device = seed_torch(args)
    rng = np.random.default_rng(args.seed)

    # MODEL: network and optimiser
    model = Field(args).to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)  # the same queries to validate on in all runs
        obstacles = torch.as_tensor(data[-1][validation])
        queries = sample_queries(obstacles, 4 * args.num_query_points, args.spread)

    best: dict[str, float] = {"step": 0}  # the best evaluation
    state = {"model": model, "optimizer": optimizer, "rng": rng, "best": best}
    run = Run(args, observations.task, state)
    run.start(args.total_updates, "update")

    while run.step < args.total_updates:
        # MODEL: learn
        remaining = 1.0 - run.step / args.total_updates
        optimizer.param_groups[0]["lr"] = args.learning_rate * remaining
        batch = batch_of(data, rng.integers(num_training, size=args.batch_size), device)
        losses = update(model, optimizer, batch, args)
        run.advance()
        step = run.step
        if step % 100 == 0:
            run.log({f"losses/{name}": value for name, value in losses.items()})
            run.log({"charts/updates_per_second": run.rate})

        # Evaluate, keep the best encoder and its decoder, checkpoint
        evaluating = step % args.eval_every == 0 or step == args.total_updates
        if evaluating:
            check_finite("the losses", losses["loss"])
            result = evaluate(model, data, queries, validation, args.batch_size, device)
            run.log({f"eval/{name}": value for name, value in result.items()})
            points, valid, obstacles = batch_of(data, validation[:1], device)
            field = functools.partial(model, points, valid)
            run.log_image("eval/slices", comparison(obstacles, field, REACH))
            run.show(validation_error_near=f"{result['error_near']:.4f}")
            if result["error_near"] <= best.get("error_near", math.inf):
                best.update(result, step=step)
                encoder = ExportedEncoder(model, tuple(names), args.num_points)
                details = metadata | {"step": step} | result
                save_network(run.folder / "encoder.onnx", encoder, example, details, ["latent"])
                inputs = {"latent": torch.zeros(2, args.latent_size), "points": queries[:2]}
                details |= {"kind": "field"}
                save_network(
                    run.folder / "encoder.decoder.onnx",
                    model.decoder,
                    inputs,
                    details,
                    output_names=["distance"],
                    variable_axes={"points": [1]},
                )
        if evaluating or run.interrupted:
            run.save()
    run.close()

    result = write_result(run, best, num_training)
    summary = "mean error {error_near:.4f} m within 10 cm of an obstacle; up to 5 cm "
    summary += "{error_5cm:.4f}, 10 cm {error_10cm:.4f}, 20 cm {error_20cm:.4f}, "
    summary += "40 cm {error_40cm:.4f}"
    print(f"{summary.format(**result)}. {run.folder / 'result.json'}")
