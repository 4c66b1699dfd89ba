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

What is saved, `encoder.onnx`, is a network from the clouds to z_E, the sensors' latent
codes side by side. To make an encoder of your own, copy this file and change the parts under
`# MODEL`.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from roboarm_nmp.envs.perception.sensors import NOTHING
from roboarm_nmp.networks.export import save_network
from roboarm_nmp.scene_embedding_train import training_data
from roboarm_nmp.scene_embedding_train.clouds import (
    IGNORED,
    batch_of,
    classification_scores,
    comparison,
    example_clouds,
    gather,
    hits,
    load_clouds,
    queries_of,
    scene_cloud,
    thin_out,
)
from roboarm_nmp.training.arguments import fail, parse_args
from roboarm_nmp.training.devices import seed_torch
from roboarm_nmp.training.errors import check_finite
from roboarm_nmp.training.runs import Run
from roboarm_nmp.utils.flags import PositiveFloat, PositiveInt, Width


@dataclass
class Args(training_data.EncoderFlags):
    # More flags are in `training_data.py` and `src/roboarm_nmp/training/runs.py`.

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
    num_query_points: PositiveInt = 192
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
        self.args = args
        width = args.width
        self.levels = nn.ModuleList([mlp(3, width, 2 * width), mlp(2 * width + 3, 4 * width)])
        self.top = mlp(4 * width + 3 + 6 * args.num_waves, 8 * width)
        self.head = nn.Linear(8 * width, args.latent_size)

    def forward(self, points):
        features: torch.Tensor | None = None
        for level, number, radius in zip(
            self.levels, self.args.num_centres, self.args.radii, strict=True
        ):
            centres = gather(points, farthest_point_sampling(points, number))
            neighbours = ball_query(points, centres, radius, self.args.num_neighbours)
            # Positions relative to the centre, in units of the radius.
            inputs = (gather(points, neighbours) - centres.unsqueeze(2)) / radius
            if features is not None:
                inputs = torch.cat([inputs, gather(features, neighbours)], dim=3)
            features = level(inputs).amax(2)
            points = centres
        assert features is not None
        positions = waves(points, self.args.num_waves)
        return self.head(self.top(torch.cat([positions, features], dim=2)).amax(1))


class Decoder(nn.Module):
    """Feature propagation: a latent (n, latent), points (n, p, 3) -> logits (n, p, classes + 1).

    The last class is that nothing is there. The levels are sampled from the points to classify;
    those of the encoder would reveal where the cloud is.
    """

    def __init__(self, args):
        super().__init__()
        self.args = args
        width = args.width
        inputs = args.latent_size + 3 + 6 * args.num_waves
        self.top = mlp(inputs, 4 * width, 4 * width)
        coarse = mlp(inputs + 4 * width, 4 * width, 4 * width)
        fine = mlp(inputs + 4 * width, 4 * width, 2 * width)
        self.levels = nn.ModuleList([coarse, fine])
        self.head = nn.Linear(2 * width, NOTHING + 1)

    def forward(self, latent, points):
        levels = [points]
        for number in self.args.num_centres:
            levels.append(gather(levels[-1], farthest_point_sampling(levels[-1], number)))
        *finer, points = levels
        features = self.top(self.inputs(latent, points))
        for level, onto in zip(self.levels, reversed(finer), strict=True):
            near = interpolate(features, points, onto)
            features = level(torch.cat([self.inputs(latent, onto), near], dim=2))
            points = onto
        return self.head(features)

    def inputs(self, latent, points):
        """Each point's position and the latent code, (n, p, 3 + 6 waves + latent)."""
        spread = latent.unsqueeze(1).expand(-1, points.shape[1], -1)
        return torch.cat([waves(points, self.args.num_waves), spread], dim=2)


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
        logits = []
        truth = []
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
    logits, truth = model(batch, args.num_query_points)
    loss = F.cross_entropy(
        torch.cat(logits).flatten(0, 1), torch.cat(truth).flatten(), ignore_index=IGNORED
    )
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return loss


if __name__ == "__main__":
    args = parse_args(Args, may_change={"observations"})
    many, few = args.num_centres
    if not args.num_points >= many >= max(few, args.num_neighbours):
        fail("--num-points must be at least --num-centres, and these --num-neighbours")
    if few < NEAREST:
        fail(f"--num-centres must be at least {NEAREST}")
    observations, num_training, validation = training_data.load_observations(args)
    clouds = load_clouds(observations, args.num_points)
    example = example_clouds(observations, clouds.sensors)
    metadata = training_data.encoder_metadata(args, observations, clouds.sensors)
    device = seed_torch(args)
    rng = np.random.default_rng(args.seed)

    # MODEL: network and optimiser
    model = PointNet2(len(clouds.sensors), args).to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)
    shown, classes = scene_cloud(observations, validation[0], next(iter(clouds.sensors)))
    shown = shown.to(device).unsqueeze(0)

    best: dict[str, float] = {"step": 0}  # the best evaluation
    state = {"model": model, "optimizer": optimizer, "rng": rng, "best": best}
    run = Run(args, observations.task, state)
    run.start(args.total_updates, "update")

    while run.step < args.total_updates:
        # MODEL: learn
        remaining = 1.0 - run.step / args.total_updates
        optimizer.param_groups[0]["lr"] = args.learning_rate * remaining
        batch = batch_of(clouds, rng.integers(num_training, size=args.batch_size), device)
        loss = update(model, optimizer, batch, args)
        run.advance()
        step = run.step
        if step % 100 == 0:
            run.log({"losses/loss": loss, "charts/updates_per_second": run.rate})

        # Evaluate, keep the best encoder, checkpoint
        evaluating = step % args.eval_every == 0 or step == args.total_updates
        if evaluating:
            check_finite("the losses", loss)
            result = classification_scores(model, clouds, validation, args.batch_size, device)
            run.log({f"eval/{name}": value for name, value in result.items()})
            with torch.no_grad():
                points = batch_of(clouds, validation[:1], device)[0][0]
                predicted = model.decoders[0](model.encoders[0](points[:, 1]), shown).argmax(2)
            run.log_image("eval/classification", comparison(shown[0], classes, predicted[0]))
            iou, absent = f"{result['iou_obstacle']:.3f}", f"{result['absent']:.3f}"
            run.show(validation_iou=iou, validation_absent=absent)
            error = 1 - (result["iou_obstacle"] + result["absent"]) / 2
            if error <= best.get("error", math.inf):
                best.update(result, error=error, step=step)
                encoder = ExportedEncoder(model, tuple(clouds.sensors))
                details = metadata | {"step": step} | result
                save_network(run.folder / "encoder.onnx", encoder, example, details, ["latent"])
        if evaluating or run.interrupted:
            run.save()
    run.close()

    result = training_data.write_result(run, best, num_training)
    summary = "accuracy {accuracy:.4f}; IoU robot {iou_robot:.3f}, table and floor "
    summary += "{iou_static:.3f}, obstacles {iou_obstacle:.3f}; absent points {absent:.3f}"
    print(f"{summary.format(**result)}. {run.folder / 'result.json'}")
