"""A distance field in 64 numbers: z_E of what four sensors see. Read it from the top.

    python -m roboarm_nmp.scene_embedding_train.collect --task mixed_scenes --sensors clouds --num 40000
    python scene_embedding_train/field.py --observations observations

What a policy needs to know of a scene is where the arm would touch something. So z_E is trained to
tell, for any point around the robot, how far the nearest obstacle is (a distance field, as in
DeepSDF, Park et al., 2019). The truth comes from the true obstacles; what is seen are four point
clouds, or four pictures (`--sees`). Points are asked about near obstacles, all of which count the
same, however thin, and anywhere.

Of clouds, each of eight sectors around the robot has an eighth of z_E, as obstacles stand all
around it; and since nothing there depends on the direction, scenes are turned and mirrored at
random. (Without sectors, by convolutions over a grid seen from above and one layer to all of z_E,
the error was twice as large after as many updates: docs/sensors.md.)

What is saved: `encoder.pt`, an exported network from what is seen to z_E, and
`encoder.decoder.pt`, one from z_E and points to distances. To make an encoder of your own, copy
this file and change the parts under `# MODEL`. Parts between `# SHARED` and `# END SHARED` are
those of `vae.py`.
"""

import contextlib
import math
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

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
    check_finite,
    elapsed,
    load_checkpoint,
    parse_args,
    progress_bar,
    rate,
    resolve_bf16,
    run_folder,
    save_checkpoint,
    seed_torch,
    summary_writer,
    write_json,
)
from roboarm_nmp.scene_embedding_train.clouds import (
    load_obstacle_points,
    on_obstacles,
    whole_clouds,
)
from roboarm_nmp.scene_embedding_train.pictures import averaged, load_images
from roboarm_nmp.scene_embedding_train.pictures import batch_of as pictures_of
from roboarm_nmp.scene_embedding_train.training_data import load_obstacles, open_observations, split

# The field: around the robot's axis, m. Distances are clipped at both ends.
REACH, HEIGHT = 1.0, 1.5
DEEPEST, FARTHEST = -0.05, 0.4
ACTIVATION_DISTANCE = 0.1  # m: the distances that matter most
# Cells of angle, distance from the axis, and height; sectors, each with as much of z_E.
ANGLES, RADII, HEIGHTS = 64, 16, 12
SECTORS = 8


@dataclass
class Args(RunFlags):  # those of the run's folder are in `envs/training/runs.py`
    exp_name: str = "field"
    """name of the experiment, part of the run's folder"""

    # SHARED: the data
    # The data
    observations: Path = Path("observations")
    """folder that `scene_embedding_train.collect` wrote"""
    validation_share: Share = 0.05
    """share of the scenes, the last ones, that is not trained on"""
    # END SHARED
    sees: Literal["clouds", "images"] = "clouds"
    """point clouds, of which the points on obstacles are used, or pictures"""

    # The algorithm
    total_updates: PositiveInt = 20_000
    """batches of the whole run"""
    batch_size: PositiveInt = 32
    """scenes per batch"""
    num_queries: PositiveInt = 256
    """points per scene and batch whose distance is asked for; half of them near obstacles"""
    spread: PositiveFloat = 0.05
    """m, standard deviation of the latter from where they are in an obstacle"""
    near_weight: NonNegativeFloat = 4.0
    """weight of what is within 10 cm of an obstacle, in addition to 1"""
    learning_rate: PositiveFloat = 1e-3
    """learning rate (Adam) at the start; it falls linearly to zero"""
    latent_size: Width = 64
    """numbers of z_E (paper: 64), a multiple of 8"""
    latent_noise: NonNegativeFloat = 0.02
    """standard deviation of noise that is added to them in training; theirs is 1"""
    num_points: PositiveInt = 96
    """points on obstacles that it gets of each cloud"""
    picture_size: Width = 64
    """width and height (pixels) that pictures are averaged down to, as part of the encoder"""
    width: Width = 128
    """features of a sector; of pictures, an eighth of it is the channels of the first convolution,
    and each further one has twice as many"""
    bf16: bool | None = None
    """train with products in bfloat16; by default where the hardware has it"""

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


# MODEL
def hat_weights(places, low, high, number):
    """How much of each cell's middle is in places (...): (..., number), linear between neighbours.

    There are `number` cells from `low` to `high`; what is beyond counts as in the outermost one.
    """
    middles = torch.arange(number, device=places.device) + 0.5
    at = ((places - low) * (number / (high - low))).clamp(0.5, number - 0.5)
    return F.relu(1.0 - (at.unsqueeze(-1) - middles).abs())


def cylindrical(points):
    """Of points (..., 3), m, how much is in each cell of angle, distance from the axis, and height.

    (..., ANGLES), (..., RADII), (..., HEIGHTS), as `hat_weights` has it; angles go around and around.
    """
    x, y, z = points.unbind(-1)
    middles = torch.arange(ANGLES, device=points.device) + (0.5 - ANGLES / 2)
    apart = (torch.atan2(y, x).unsqueeze(-1) * (ANGLES / (2 * math.pi)) - middles).abs()
    angles = F.relu(1.0 - torch.minimum(apart, ANGLES - apart))
    radius = (x.square() + y.square()).sqrt()
    return angles, hat_weights(radius, 0.0, REACH, RADII), hat_weights(z, 0.0, HEIGHT, HEIGHTS)


class CircularConv(nn.Module):
    """A linear layer and ReLU for each sector and its two neighbours: (n, sectors, features)."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.linear = nn.Linear(3 * inputs, outputs)

    def forward(self, x):
        before, after = torch.cat([x[:, -1:], x[:, :-1]], 1), torch.cat([x[:, 1:], x[:, :1]], 1)
        return F.relu(self.linear(torch.cat([before, x, after], dim=2)))


class SeesClouds(nn.Module):
    """Points on obstacles (n, p, 3), m, and which of them are there (n, p) -> z_E, unscaled.

    How many points are in each cell; then sectors are joined in twos, until there are `SECTORS`.
    """

    def __init__(self, args):
        super().__init__()
        self.first = CircularConv(RADII * HEIGHTS, args.width)
        halvings = int(math.log2(ANGLES // SECTORS))
        self.layers = nn.ModuleList(
            CircularConv(2 * args.width, args.width) for _ in range(halvings)
        )
        self.last = nn.Linear(args.width, args.latent_size // SECTORS)

    def forward(self, points, there):
        angles, radii, heights = cylindrical(points)
        place = (radii * there.unsqueeze(2)).unsqueeze(3) * heights.unsqueeze(2)
        counts = torch.bmm(angles.transpose(1, 2), place.flatten(2))
        x = self.first(counts / (counts + 1.0))
        for layer in self.layers:
            x = layer(x.unflatten(1, (-1, 2)).flatten(2))
        return self.last(x).flatten(1)


class SeesPictures(nn.Module):
    """Pictures (n, cameras, 3, size, size) in [0, 1] -> z_E, unscaled."""

    def __init__(self, num_cameras, args):
        super().__init__()
        self.cameras, inputs = nn.ModuleList(), 0
        for _ in range(num_cameras):
            camera, features = convolutions(args.picture_size, max(1, args.width // 8))
            self.cameras.append(camera)
            inputs += features
        layers = nn.Linear(inputs, 256), nn.ReLU(), nn.Linear(256, args.latent_size)
        self.head = nn.Sequential(*layers)

    def forward(self, pictures):
        seen = [camera(pictures[:, i]) for i, camera in enumerate(self.cameras)]
        return self.head(torch.cat(seen, dim=1))


class Decoder(nn.Module):
    """z_E (n, latent), points (n, q, 3), m -> how far (m) the nearest obstacle is, (n, q).

    Sectors, with a part of z_E each, are split in two until there are `ANGLES`. A small network has
    the features where a point is, its distance from the axis and its height.
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
        here = torch.bmm(angles, x)
        return self.last(torch.cat([here, radii, heights], dim=2)).squeeze(2)


class Field(nn.Module):
    """The encoder and the decoder."""

    def __init__(self, num_sensors, args):
        super().__init__()
        self.encoder = (
            SeesClouds(args) if args.sees == "clouds" else SeesPictures(num_sensors, args)
        )
        self.decoder = Decoder(args)

    def encode(self, *seen):
        """What is seen -> z_E (n, latent), each scene's with mean 0 and standard deviation 1."""
        z = self.encoder(*seen)
        return F.layer_norm(z, z.shape[1:])


def axes_of(quaternions):
    """Quaternions (..., 4), x, y, z, w, as rotation matrices (..., 3, 3)."""
    x, y, z, w = quaternions.unbind(-1)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def distances(obstacles, points):
    """How far points (n, q, 3), m, are from the nearest of obstacles (n, k, 12): m, (n, q).

    Obstacles as `load_obstacles` has them. Negative inside; clipped to [`DEEPEST`, `FARTHEST`].
    """
    there, kind, place, turn, size = obstacles.split((1, 1, 3, 4, 3), dim=2)
    # Into the obstacles' own axes, all in one product.
    axes = axes_of(turn)
    offset = (points @ axes.transpose(1, 2).flatten(2)).unflatten(2, (-1, 3))
    offset = offset - (place.unsqueeze(2) @ axes).transpose(1, 2)
    there, kind, size = there.unsqueeze(1), kind.unsqueeze(1), size.unsqueeze(1)
    x, y, z = offset.unbind(-1)
    # A cylinder is a rectangle, from its axis outwards; its y is always inside and says nothing.
    flat = torch.stack([(x.square() + y.square()).sqrt(), torch.zeros_like(x), z], dim=-1)
    half_flat = size * size.new_tensor([1.0, 0.0, 0.5]) + size.new_tensor([0.0, 1.0, 0.0])
    cylinder = kind == 1.0
    beyond = torch.where(cylinder, flat, offset).abs() - torch.where(cylinder, half_flat, size / 2)
    found = beyond.clamp(min=0.0).norm(dim=-1) + beyond.amax(dim=-1).clamp(max=0.0)
    found = torch.where(kind[..., 0] == 2.0, offset.norm(dim=-1) - size[..., 0], found)
    found = torch.where(there[..., 0] > 0.0, found, FARTHEST)
    return found.amin(dim=2).clamp(DEEPEST, FARTHEST)


def queries(obstacles, number, spread):
    """Points to ask about (n, number, 3), m: the first half around obstacles, the others anywhere.

    Those around obstacles are somewhere in one of them (in the box around a cylinder, or around the
    middle half of a sphere), and a random way of standard deviation `spread` from there. What is
    beyond `REACH` comes anywhere between that and the robot's axis.
    """
    n, half, device = len(obstacles), number // 2, obstacles.device
    which = (torch.rand(n, half, device=device) * obstacles[..., 0].sum(1, keepdim=True)).long()
    chosen = obstacles.gather(1, which.unsqueeze(2).expand(-1, -1, obstacles.shape[2]))
    _, kind, place, turn, size = chosen.split((1, 1, 3, 4, 3), dim=2)
    size = torch.where(kind == 0.0, size, size * size.new_tensor([2.0, 2.0, 1.0]))  # radii
    inside = size * (torch.rand_like(size) - 0.5)
    near = place + (axes_of(turn) @ inside.unsqueeze(3)).squeeze(3)
    near = near + spread * torch.randn_like(near)
    low, high = obstacles.new_tensor([[-REACH, -REACH, 0.0], [REACH, REACH, HEIGHT]])
    anywhere = low + (high - low) * torch.rand(n, number - half, 3, device=device)
    points = torch.cat([near, anywhere], dim=1)
    radius = points[..., :2].norm(dim=2, keepdim=True)
    inwards = REACH * torch.rand_like(radius).sqrt() / radius.clamp(min=REACH)
    points[..., :2] *= torch.where(radius > REACH, inwards, 1.0)
    return points


def augment(*points):
    """Points (n, p, 3) of scenes, each scene turned about the robot's axis and perhaps mirrored."""
    n, device = len(points[0]), points[0].device
    angle = 2 * math.pi * torch.rand(n, 1, device=device)
    mirror = 2.0 * (torch.rand(n, 1, device=device) < 0.5) - 1.0
    c, s = angle.cos(), angle.sin()
    for one in points:
        x, y, z = one.unbind(2)
        y = mirror * y
        yield torch.stack([c * x - s * y, s * x + c * y, z], dim=2)


class SceneEncoder(nn.Module):
    """What is saved: what the sensors see, by their names, as the environment gives it -> z_E."""

    def __init__(self, model, names, args):
        super().__init__()
        self.model, self.names, self.args = model, names, args

    def forward(self, **seen):
        if self.args.sees == "images":
            pictures = torch.stack([seen[name] for name in self.names], 1)
            return self.model.encode(averaged(pictures, self.args.picture_size))
        clouds = [(seen[f"{name}_points"], seen[f"{name}_labels"]) for name in self.names]
        return self.model.encode(*on_obstacles(clouds, self.args.num_points))


def update(model, optimizer, seen, obstacles, args):
    """One step on what is seen of scenes, a tuple of tensors, and their obstacles (n, k, 12).

    Its losses, a dict of scalars: the error, weighted, and its mean near obstacles (m).
    """
    asked = queries(obstacles, args.num_queries, args.spread)
    truth = distances(obstacles, asked)
    if args.sees == "clouds":
        points, there = seen
        points, asked = augment(points, asked)
        seen = points, there
    device = asked.device.type
    with torch.autocast(device, torch.bfloat16) if args.bf16 else contextlib.nullcontext():
        z = model.encode(*seen)
        predicted = model.decoder(z + args.latent_noise * torch.randn_like(z), asked)
    error = (predicted.float() - truth).abs()
    near = truth < ACTIVATION_DISTANCE
    weights = 1.0 + args.near_weight * near
    loss = (weights * error).sum() / weights.sum()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return {"loss": loss, "near": (error * near).sum() / near.sum().clamp(min=1)}


@torch.no_grad()
def evaluate(model, data, asked, rows, args, device):
    """Mean errors (m) of predicted distances in scenes `rows`, of points `asked`, (rows, q, 3).

    Returns:
        A dict: `error_near` of what is within `ACTIVATION_DISTANCE` of an obstacle, and `error_5cm`, `error_10cm`,
        `error_20cm`, `error_40cm` by distance, up to there (0 where there is none).
    """
    spans = {"near": (-1.0, ACTIVATION_DISTANCE), "5cm": (-1.0, 0.05), "10cm": (0.05, 0.1)}
    spans |= {"20cm": (0.1, 0.2), "40cm": (0.2, 0.4)}
    sums, counts = dict.fromkeys(spans, 0.0), dict.fromkeys(spans, 0)
    for first in range(0, len(rows), args.batch_size):
        some = slice(first, first + args.batch_size)
        *seen, obstacles = batch_of(data, rows[some], args, device)
        points = asked[some].to(device)
        truth = distances(obstacles, points)
        predicted = model.decoder(model.encode(*seen), points).clamp(DEEPEST, FARTHEST)
        for name, (low, high) in spans.items():
            these = (truth > low) & (truth <= high)
            sums[name] += ((predicted - truth).abs() * these).sum().item()
            counts[name] += these.sum().item()
    return {f"error_{name}": sums[name] / max(1, counts[name]) for name in spans}


def batch_of(data, rows, args, device):
    """What is seen of scenes `rows`, one tensor or two, and their obstacles (n, k, 12).

    `data` are arrays with a row per scene, pictures or points and whether they are there, and the
    obstacles.
    """
    rows = np.sort(rows)
    if args.sees == "images":
        images, obstacles = data
        pictures = pictures_of(images, rows, device)
        return [pictures, torch.as_tensor(obstacles[rows], device=device)]
    return [torch.as_tensor(array[rows], device=device) for array in data]


def slices(model, seen, obstacles, size=96):
    """The field of a scene at three heights, truth above, ours below: uint8 (2 size, 3 size, 3).

    Seen from above, x up. Dark is near, and what is inside of an obstacle is red.
    """
    device = obstacles.device
    axis = torch.linspace(REACH, -REACH, size, device=device)  # x is up, y to the left
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    rows = []
    z = model.encode(*seen)
    for tell in (lambda at: distances(obstacles, at), lambda at: model.decoder(z, at)):
        pictures = []
        for height in (0.2, 0.5, 0.8):
            at = torch.stack([x, y, torch.full_like(x, height)], dim=2).reshape(1, -1, 3)
            grey = (255 * (tell(at) / FARTHEST).clamp(0.0, 1.0)).reshape(size, size, 1)
            red = torch.tensor([200.0, 30.0, 30.0], device=device)
            pictures.append(torch.where(grey > 0.0, grey, red))
        rows.append(torch.cat(pictures, dim=1))
    return torch.cat(rows).byte().cpu().numpy()


if __name__ == "__main__":
    args = parse_args(Args, may_change={"observations"})
    if args.latent_size % SECTORS:
        sys.exit(f"--latent-size must be a multiple of {SECTORS}, got {args.latent_size}")
    resolve_bf16(args)
    observations = open_observations(args.observations)
    num_training, validation = split(observations, args)
    if args.sees == "clouds":
        names, *data = load_obstacle_points(observations, args.num_points)
    else:
        pictures, names = load_images(observations, args.picture_size)
        data = [pictures]
    data.append(load_obstacles(observations))
    run, device = run_folder(args, observations.task), seed_torch(args)
    rng = np.random.default_rng(args.seed)

    # MODEL: network and optimiser
    model = Field(len(names), args).to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        obstacles = torch.as_tensor(data[-1][validation])
        asked = queries(obstacles, 4 * args.num_queries, args.spread)
    # What the networks that are saved get.
    if args.sees == "clouds":
        seen = {name: whole_clouds(observations, 0, name) for name in names}
        outputs = "points", "labels"
        example = {
            f"{k}_{o}": x[:2] for k, v in seen.items() for o, x in zip(outputs, v, strict=True)
        }
    else:
        example = {k: torch.from_numpy(observations.read(0, f"{k}/rgb")[:2]) for k in names}

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
        rows = rng.integers(num_training, size=args.batch_size)
        *seen, obstacles = batch_of(data, rows, args, device)
        losses = update(model, optimizer, seen, obstacles, args)
        progress["updates"] = step = progress["updates"] + 1
        bar.update()
        if step % 100 == 0:
            for name, value in losses.items():
                writer.add_scalar(f"losses/{name}", value.item(), step)
            writer.add_scalar("charts/updates_per_second", rate(bar), step)

        # Evaluate, keep the best encoder
        if step % args.eval_every == 0 or step == args.total_updates:
            check_finite("the losses", losses["loss"])
            result = evaluate(model, data, asked, validation, args, device)
            for name, value in result.items():
                writer.add_scalar(f"eval/{name}", value, step)
            with torch.no_grad():
                *seen, obstacles = batch_of(data, validation[:1], args, device)
                picture = slices(model, seen, obstacles)
            writer.add_image("eval/slices", picture, step, dataformats="HWC")
            if result["error_near"] < progress["best_error"]:
                progress["best_error"], progress["best_update"] = result["error_near"], step
                progress["best"] = result
                metadata = {"kind": "encoder", "script": args.exp_name, "task": observations.task}
                sensors = {name: observations.sensors[name] for name in names}
                metadata |= {"sensors": sensors_to_json(sensors), "seed": args.seed, "step": step}
                encoder = SceneEncoder(model, tuple(names), args)
                save_network(run / "encoder.pt", encoder, example, metadata | result)
                inputs = {"latent": torch.zeros(2, args.latent_size), "points": asked[:2]}
                metadata = metadata | {"kind": "field"}
                save_network(run / "encoder.decoder.pt", model.decoder, inputs, metadata | result)
            bar.set_postfix(near=f"{result['error_near']:.4f}")
            # SHARED: checkpoint and result
            progress["seconds"] = seconds_before + elapsed(bar)
            save_checkpoint(run, checkpoint_state, device)
    bar.close()

    result = progress["best"] | {"scenes": num_training, "encoder": str(run / "encoder.pt")}
    result |= {name: progress[name] for name in ("updates", "best_update")}
    result["seconds"] = round(progress["seconds"])
    write_json(run / "result.json", result | {"args": asdict(args)})
    # END SHARED
    shown = (
        "mean error {error_near:.4f} m within 10 cm of an obstacle; up to 5 cm {error_5cm:.4f}, "
    )
    shown += "10 cm {error_10cm:.4f}, 20 cm {error_20cm:.4f}, 40 cm {error_40cm:.4f}"
    print(f"{shown.format(**result)}. {run / 'result.json'}")
    writer.close()
