"""PointNet++ of four point clouds: a 64-dimensional latent code z_E. Read it from the top.

    roboarm observations --sensors clouds --num 20000
    roboarm train pointnet2 --observations observations

PointNet++ (Qi et al., 2017) as in the paper's appendix "Training and verifying the encoders": a
network per sensor classifies each point: robot, table or floor, or another obstacle. Set
abstraction (farthest point sampling, ball query) encodes a cloud in 16 dimensions. Feature
propagation classifies points from these and the points' positions alone, without the usual skip
connections, which would bypass the latent code.

A point's position determines most of its class without the latent code. So the network also
receives points of another scene's obstacles and has to predict that nothing is there. Positions
also enter as sines and cosines (as in NeRF), without which the network hardly learns.

What is saved, `encoder.pt`, is an exported network from the clouds to z_E, the sensors' latent
codes side by side. To make an encoder of your own, copy this file and change the parts under
`# MODEL`. Parts between `# SHARED` and `# END SHARED` are those of `vae.py`.
"""

import math
import sys
from dataclasses import asdict, dataclass

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from roboarm_nmp.envs.networks.exported_networks import save_network
from roboarm_nmp.envs.perception.sensors import NOTHING, OBSTACLE
from roboarm_nmp.envs.training.flags import PositiveFloat, PositiveInt, Width
from roboarm_nmp.envs.training.runs import (
    check_finite,
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
from roboarm_nmp.scene_embedding_train.clouds import (
    batch_of,
    comparison,
    example_clouds,
    gather,
    hits,
    load_clouds,
    thin_out,
    whole_clouds,
)
from roboarm_nmp.scene_embedding_train.training_data import (
    EncoderFlags,
    encoder_metadata,
    load_observations,
)

ABSENT_DISTANCE = 0.05  # m: a point is absent from a cloud whose points are all further away
IGNORED = -100  # label of points that have no class


@dataclass
class Args(EncoderFlags):  # flags of the run, the data and evaluations are in `training_data.py`
    exp_name: str = "pointnet2"
    """name of the experiment, part of the run's folder"""

    # The algorithm
    total_updates: PositiveInt = 10_000
    """batches of the whole run"""
    batch_size: PositiveInt = 32
    """scenes per batch"""
    learning_rate: PositiveFloat = 1e-3
    """learning rate (Adam) at the start; it falls linearly to zero"""
    latent_size: Width = 16
    """dimensions of z_E per sensor (paper: 16)"""
    num_points: PositiveInt = 256
    """points that the network receives, evenly spaced among those of a cloud above the table"""
    num_queries: PositiveInt = 192
    """points that it classifies per cloud and batch"""
    num_centres: tuple[PositiveInt, PositiveInt] = (32, 12)
    """points that farthest point sampling leaves, level by level"""
    radii: tuple[PositiveFloat, PositiveFloat] = (0.15, 0.4)
    """radius (m) of the ball query around each of them"""
    num_neighbours: PositiveInt = 16
    """points that a ball query finds at most"""
    num_waves: PositiveInt = 4
    """wavelengths of the sines and cosines of positions: 2 m, 1 m, ..."""
    width: Width = 32
    """features at the first level; further ones have more"""


# MODEL
def farthest_point_sampling(points, number):
    """Indices (n, number) of points (n, p, 3): the first, then the one farthest from all chosen."""
    chosen = [torch.zeros_like(points[:, 0, 0], dtype=torch.int64)]
    distance = torch.full_like(points[:, :, 0], math.inf)
    for _ in range(number - 1):
        latest = gather(points, chosen[-1].unsqueeze(1))
        distance = torch.minimum(distance, (points - latest).square().sum(2))
        chosen.append(distance.argmax(1))
    return torch.stack(chosen, dim=1)


def ball_query(points, centres, radius, number):
    """Indices (n, c, number) of points (n, p, 3) within `radius` of each centre (n, c, 3).

    The nearest ones; where there are fewer, the nearest is repeated.
    """
    distances, indices = torch.cdist(centres, points).topk(number, dim=2, largest=False)
    return torch.where(distances <= radius, indices, indices[:, :, :1])


NEAREST = 3  # centres that a point's features are interpolated from


def interpolate(values, centres, points):
    """Values (n, c, f) at centres (n, c, 3) -> at points (n, p, 3): of the three nearest centres.

    Weighted by the inverse of the distance: (n, p, f).
    """
    distances, indices = torch.cdist(points, centres).topk(NEAREST, dim=2, largest=False)
    weights = 1.0 / (distances + 1e-6)
    weights = weights / weights.sum(2, keepdim=True)
    return (gather(values, indices) * weights.unsqueeze(-1)).sum(2)


def mlp(*sizes):
    layers = []
    for a, b in zip(sizes, sizes[1:], strict=False):
        layers += [nn.Linear(a, b), nn.LayerNorm(b), nn.ReLU()]
    return nn.Sequential(*layers)


def waves(positions, number):
    """Positions (..., 3), m, their sines and cosines, wavelengths 2, 1, ... m: 3 + 6 number."""
    angles = torch.cat([positions * (math.pi * 2**k) for k in range(number)], dim=-1)
    return torch.cat([positions, angles.sin(), angles.cos()], dim=-1)


class Encoder(nn.Module):
    """Set abstraction: a cloud (n, p, 3), m -> its latent code (n, latent)."""

    def __init__(self, args):
        super().__init__()
        self.args, width = args, args.width
        self.levels = nn.ModuleList([mlp(3, width, 2 * width), mlp(2 * width + 3, 4 * width)])
        self.top = mlp(4 * width + 3 + 6 * args.num_waves, 8 * width)
        self.head = nn.Linear(8 * width, args.latent_size)

    def forward(self, points):
        features = None
        for level, number, radius in zip(
            self.levels, self.args.num_centres, self.args.radii, strict=True
        ):
            centres = gather(points, farthest_point_sampling(points, number))
            neighbours = ball_query(points, centres, radius, self.args.num_neighbours)
            # Positions relative to the centre, in units of the radius.
            inputs = (gather(points, neighbours) - centres.unsqueeze(2)) / radius
            if features is not None:
                inputs = torch.cat([inputs, gather(features, neighbours)], dim=3)
            features, points = level(inputs).amax(2), centres
        positions = waves(points, self.args.num_waves)
        return self.head(self.top(torch.cat([positions, features], dim=2)).amax(1))


class Decoder(nn.Module):
    """Feature propagation: a latent (n, latent), points (n, p, 3) -> logits (n, p, classes + 1).

    The last class is that nothing is there. The levels are sampled from the points to classify;
    those of the encoder would reveal where the cloud is.
    """

    def __init__(self, args):
        super().__init__()
        self.args, width = args, args.width
        inputs = args.latent_size + 3 + 6 * args.num_waves
        self.top = mlp(inputs, 4 * width, 4 * width)
        sizes = inputs + 4 * width, 4 * width
        self.levels = nn.ModuleList([mlp(*sizes, 4 * width), mlp(*sizes, 2 * width)])
        self.head = nn.Linear(2 * width, NOTHING + 1)

    def forward(self, latent, points):
        levels = [points]
        for number in self.args.num_centres:
            levels.append(gather(levels[-1], farthest_point_sampling(levels[-1], number)))
        *finer, points = levels
        features = self.top(self.inputs(latent, points))
        for level, onto in zip(self.levels, reversed(finer), strict=True):
            near = interpolate(features, points, onto)
            features, points = level(torch.cat([self.inputs(latent, onto), near], dim=2)), onto
        return self.head(features)

    def inputs(self, latent, points):
        """Each point's position and the latent code, (n, p, 3 + 6 waves + latent)."""
        spread = latent.unsqueeze(1).expand(-1, points.shape[1], -1)
        return torch.cat([waves(points, self.args.num_waves), spread], dim=2)


def distances_to(points, clouds):
    """From points (n, p, 3) to the nearest of each scene's cloud (n, q, 3): distances (n, p)."""
    squares = [  # without those of the points; a scene at a time, for the CPU's cache
        torch.addmm(cloud.square().sum(1), scene, cloud.T, alpha=-2).amin(1)
        for scene, cloud in zip(points, clouds, strict=True)
    ]
    return (torch.stack(squares) + points.square().sum(2)).clamp(min=0).sqrt()


def queries_of(points, labels, whole, number=None):
    """Points to classify (n, q, 3) and their classes (n, q), from one sensor's of `batch_of`.

    They are the scene's own, (n, 2, p), and those above the table of the scene before it in the
    batch. Of the latter, points of obstacles with nothing near them in the whole cloud have the
    class `NOTHING`. Points without a class are `IGNORED`. There are all 3p, or a random sample of
    `number`, a third of it from the other scene.
    """
    own, classes = points.flatten(1, 2), labels.flatten(1, 2)
    others, other_labels = points[:, 1].roll(1, dims=0), labels[:, 1].roll(1, dims=0)
    if number is not None:
        chosen = torch.randperm(own.shape[1], device=own.device)[: number - number // 3]
        own, classes = own[:, chosen], classes[:, chosen]
        chosen = torch.randperm(others.shape[1], device=own.device)[: number // 3]
        others, other_labels = others[:, chosen], other_labels[:, chosen]
    absent = (other_labels == OBSTACLE) & (distances_to(others, whole) > ABSENT_DISTANCE)
    truth = [torch.where(classes == NOTHING, IGNORED, classes)]
    truth.append(torch.where(absent, NOTHING, IGNORED))
    return torch.cat([own, others], dim=1), torch.cat(truth, dim=1)


class PointNet2(nn.Module):
    """An encoder and a decoder per sensor."""

    def __init__(self, num_sensors, args):
        super().__init__()
        self.num_points = args.num_points
        self.encoders = nn.ModuleList(Encoder(args) for _ in range(num_sensors))
        self.decoders = nn.ModuleList(Decoder(args) for _ in range(num_sensors))

    def forward(self, clouds, num_queries=None):
        """`batch_of`'s list -> per sensor, lists of logits (n, q, 4) and classes (n, q).

        They are of all points of `queries_of`, or of `num_queries` of them.
        """
        logits, truth = [], []
        for (points, labels, whole), encoder, decoder in zip(
            clouds, self.encoders, self.decoders, strict=True
        ):
            queries, classes = queries_of(points, labels, whole, num_queries)
            logits.append(decoder(encoder(points[:, 1]), queries))
            truth.append(classes)
        return logits, truth


class ExportedEncoder(nn.Module):
    """What is saved: each sensor's points and labels -> z_E (n, 64).

    The inputs are `<sensor>_points` (n, samples, 3), m, and `<sensor>_labels` (n, samples), uint8.
    The labels only serve to drop points that hit nothing.
    """

    def __init__(self, model, names):
        super().__init__()
        self.encoders, self.num_points, self.names = model.encoders, model.num_points, names

    def forward(self, **clouds):
        latents = []
        for name, encoder in zip(self.names, self.encoders, strict=True):
            points = clouds[f"{name}_points"]
            _, above = hits(points, clouds[f"{name}_labels"])
            latents.append(encoder(gather(points, thin_out(above, self.num_points))))
        return torch.cat(latents, dim=1)


def update(model, optimizer, batch, args):
    """One step on a batch of `batch_of`. Returns its loss, a scalar."""
    logits, truth = model(batch, args.num_queries)
    loss = F.cross_entropy(
        torch.cat(logits).flatten(0, 1), torch.cat(truth).flatten(), ignore_index=IGNORED
    )
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return loss


@torch.no_grad()
def evaluate(model, clouds, rows, batch_size, device):
    """How well points of scenes `rows` are classified.

    Returns:
        `accuracy` and the intersection over union of each class, `iou_robot`, `iou_static`,
        `iou_obstacle`, over points evenly spaced among those that hit something; and `absent`, the
        share of other scenes' obstacle points that are predicted to be absent.
    """
    model.eval()
    number = clouds.points.shape[3]
    confusion = torch.zeros(NOTHING, NOTHING + 1, dtype=torch.int64)  # truth, prediction
    predicted_absent = all_absent = 0
    for start in range(0, len(rows), batch_size):
        batch = batch_of(clouds, rows[start : start + batch_size], device)
        for logits, truth in zip(*model(batch), strict=True):
            predicted = logits.argmax(2)
            one_hot = F.one_hot(predicted, NOTHING + 1)[:, :number]
            own = [(truth[:, :number] == label).unsqueeze(2) for label in range(NOTHING)]
            confusion += torch.stack([(one * one_hot).sum((0, 1)) for one in own]).cpu()
            absent = truth == NOTHING
            all_absent += absent.sum().item()
            predicted_absent += (absent & (predicted == NOTHING)).sum().item()
    model.train()
    both = confusion.diagonal()
    iou = both / (confusion[:, :NOTHING].sum(0) + confusion.sum(1) - both).clamp(min=1)
    result = {"accuracy": (both.sum() / confusion.sum().clamp(min=1)).item()}
    result["absent"] = predicted_absent / max(1, all_absent)
    names = ("iou_robot", "iou_static", "iou_obstacle")
    return result | dict(zip(names, iou.tolist(), strict=True))


if __name__ == "__main__":
    args = parse_args(Args, may_change={"observations"})
    many, few = args.num_centres
    if not args.num_points >= many >= max(few, args.num_neighbours):
        sys.exit("--num-points must be at least --num-centres, and these --num-neighbours")
    if few < NEAREST:
        sys.exit(f"--num-centres must be at least {NEAREST}")
    observations, num_training, validation = load_observations(args)
    clouds = load_clouds(observations, args.num_points)
    example = example_clouds(observations, clouds.sensors)
    metadata = encoder_metadata(args, observations, clouds.sensors)
    run, device = run_folder(args, observations.task), seed_torch(args)
    rng = np.random.default_rng(args.seed)

    # MODEL: network and optimiser
    model = PointNet2(len(clouds.sensors), args).to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)
    # For the figure: the first sensor's whole cloud of the first validation scene.
    shard = np.searchsorted(observations.offsets, validation[0], side="right") - 1
    cloud = whole_clouds(observations, shard, next(iter(clouds.sensors)))
    row = validation[0] - observations.offsets[shard]
    hit = cloud[1][row] != NOTHING
    shown, classes = (one[row][hit].unsqueeze(0).to(device) for one in cloud)

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
        batch = batch_of(clouds, rng.integers(num_training, size=args.batch_size), device)
        loss = update(model, optimizer, batch, args)
        progress["updates"] = step = progress["updates"] + 1
        bar.update()
        if step % 100 == 0:
            writer.add_scalar("losses/loss", loss.item(), step)
            writer.add_scalar("charts/updates_per_second", rate(bar), step)

        # Evaluate, keep the best encoder
        if step % args.eval_every == 0 or step == args.total_updates:
            check_finite("the losses", loss)
            result = evaluate(model, clouds, validation, args.batch_size, device)
            for name, value in result.items():
                writer.add_scalar(f"eval/{name}", value, step)
            with torch.no_grad():
                points = batch_of(clouds, validation[:1], device)[0][0]
                predicted = model.decoders[0](model.encoders[0](points[:, 1]), shown).argmax(2)
            figure = comparison(*(a[0].cpu().numpy() for a in (shown, classes, predicted)))
            writer.add_image("eval/classification", figure, step, dataformats="HWC")
            error = 1 - (result["iou_obstacle"] + result["absent"]) / 2
            if error < progress["best_error"]:
                progress["best_error"], progress["best_update"] = error, step
                progress["best"] = result
                encoder = ExportedEncoder(model, tuple(clouds.sensors))
                described = metadata | {"step": step} | result
                save_network(run / "encoder.pt", encoder, example, described)
            bar.set_postfix(iou=f"{result['iou_obstacle']:.3f}", absent=f"{result['absent']:.3f}")
            # SHARED: checkpoint and result
            progress["seconds"] = seconds_before + elapsed(bar)
            save_checkpoint(run, checkpoint_state, device)
    bar.close()

    result = progress["best"] | {"scenes": num_training, "encoder": str(run / "encoder.pt")}
    result |= {name: progress[name] for name in ("updates", "best_update")}
    result["seconds"] = round(progress["seconds"])
    write_json(run / "result.json", result | {"args": asdict(args)})
    # END SHARED
    summary = "accuracy {accuracy:.4f}; IoU robot {iou_robot:.3f}, table and floor "
    summary += "{iou_static:.3f}, obstacles {iou_obstacle:.3f}; absent points {absent:.3f}"
    print(f"{summary.format(**result)}. {run / 'result.json'}")
    writer.close()
