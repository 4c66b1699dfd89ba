"""Point clouds, as the trainer of PointNet++ uses them: batches, thinning, a picture.

Clouds are thinned out, to save time. `load_clouds` does it once for what is trained on, `thin_out`
in the encoder that is saved.
"""

import math
import sys
from typing import NamedTuple

import numpy as np
import torch

from roboarm_nmp.envs.perception.sensors import NOTHING, OBSTACLE, PointCloud, deproject
from roboarm_nmp.scene_embedding_train.training_data import unpacked

WITHIN = 1.1  # m from the robot's axis: what is further away it does not reach
TABLE_TOP = 0.01  # m: what is higher is seen better, because most of a cloud is table and floor
DEEPEST = 65_535  # how far a sensor sees, in the units of stored depths: there was nothing
# Of the classes, robot, table and floor, obstacle, nothing (as in the paper's figure).
COLOURS = np.array([[210, 50, 40], [240, 140, 40], [245, 210, 60], [150, 150, 150]], np.uint8)


class Clouds(NamedTuple):
    """What point cloud sensors saw, in arrays that are mapped into memory.

    Attributes:
        sensors: dict of name -> `PointCloud`.
        points: float32 (scenes, sensors, 2, num_points, 3), m: evenly spaced among those that hit
            something, and among those of them above the table.
        labels: theirs, uint8 (scenes, sensors, 2, num_points).
        depths: all that was seen, uint16 (scenes, sensors, samples), see `ends_of_rays`.
    """

    sensors: dict
    points: np.ndarray
    labels: np.ndarray
    depths: np.ndarray


def load_clouds(observations, num_points):
    """The `Clouds` of `Observations`, thinned out to `num_points` points once."""
    sensors = {k: one for k, one in observations.sensors.items() if isinstance(one, PointCloud)}
    samples = {one.num_samples for one in sensors.values()}
    if len(samples) != 1:
        why = "the clouds differ in size" if sensors else "no clouds (collect with --sensors)"
        sys.exit(f"--observations: {observations.folder}: {why}")
    shards = (
        thinned_clouds(observations, shard, sensors, num_points)
        for shard in range(len(observations.offsets) - 1)
    )
    shape = (len(sensors), 2, num_points)
    arrays = {"points": (np.float32, (*shape, 3)), "labels": (np.uint8, shape)}
    arrays["depths"] = (np.uint16, (len(sensors), samples.pop()))
    return Clouds(sensors, **unpacked(observations, f"clouds_{num_points}", arrays, shards))


def load_obstacle_points(observations, num_points):
    """What the sensors saw of obstacles: their names, and `points` and `there`, mapped into memory.

    `points`: float32 (scenes, sensors * num_points, 3), m, evenly spaced among a sensor's points on
    obstacles `WITHIN` reach; `there`: bool (scenes, sensors * num_points), false where a sensor saw
    none.
    """
    sensors = [k for k, one in observations.sensors.items() if isinstance(one, PointCloud)]
    if not sensors:
        sys.exit(f"--observations: {observations.folder}: no clouds (collect with --sensors)")

    def rows(shard):
        seen = [whole_clouds(observations, shard, name) for name in sensors]
        points, there = on_obstacles(seen, num_points)
        return {"points": points.numpy(), "there": there.numpy()}

    count = len(sensors) * num_points
    arrays = {"points": (np.float32, (count, 3)), "there": (np.bool_, (count,))}
    shards = (rows(shard) for shard in range(len(observations.offsets) - 1))
    found = unpacked(observations, f"obstacle_points_{num_points}_{WITHIN}", arrays, shards)
    return sensors, found["points"], found["there"]


def on_obstacles(clouds, num_points):
    """Of each cloud `num_points` points on obstacles `WITHIN` reach, evenly spaced among those.

    Args:
        clouds: list of a sensor's points (n, p, 3), m, and labels (n, p).

    Returns:
        Points (n, sensors * num_points, 3), and where there are any: bool (n, sensors *
        num_points).
    """
    all_points, all_there = [], []
    for points, labels in clouds:
        wanted = (labels == OBSTACLE) & (points[..., :2].square().sum(2) < WITHIN**2)
        chosen = thin_out(wanted, num_points)
        all_points.append(gather(points, chosen))
        all_there.append(gather(wanted.unsqueeze(2), chosen).squeeze(2))
    return torch.cat(all_points, dim=1), torch.cat(all_there, dim=1)


def thinned_clouds(observations, shard, names, num_points):
    """`load_clouds`'s arrays of one shard, a dict."""
    rows = {"points": [], "labels": [], "depths": []}
    for name in names:
        points, labels = whole_clouds(observations, shard, name)
        chosen = torch.stack([thin_out(one, num_points) for one in hits(points, labels)], dim=1)
        rows["points"].append(gather(points, chosen))
        rows["labels"].append(gather(labels.unsqueeze(2), chosen).squeeze(-1))
        depths = torch.from_numpy(observations.read(shard, f"{name}/depth"))
        rows["depths"].append(depths.flatten(1))
    return {output: torch.stack(one, dim=1).numpy() for output, one in rows.items()}


def batch_of(clouds, rows, device):
    """Rows of `Clouds`: a list of (points, labels, whole) per sensor.

    Labels are int64; `whole`, (n, samples, 3), are the points that were not thinned out.
    """
    rows = np.sort(rows)
    points = torch.as_tensor(clouds.points[rows], device=device)
    labels = torch.as_tensor(clouds.labels[rows], device=device).long()
    depths = torch.as_tensor(clouds.depths[rows].astype(np.float32), device=device)
    return [
        (points[:, i], labels[:, i], ends_of_rays(sensor, depths[:, i]))
        for i, sensor in enumerate(clouds.sensors.values())
    ]


def whole_clouds(observations, shard, name):
    """All that a sensor saw in the scenes of a shard, as `envs.perception.sensors.PointCloud.points` has it.

    Points, float32 (n, samples, 3), and labels, uint8 (n, samples).
    """
    sensor = observations.sensors[name]
    pictures = (
        observations.read(shard, f"{name}/{output}") for output in ("depth", "segmentation")
    )
    seen = [
        sensor.points(depth * (sensor.far / DEEPEST), segmentation)
        for depth, segmentation in zip(*pictures, strict=True)
    ]
    return tuple(
        torch.from_numpy(np.stack([one[key] for one in seen])) for key in ("points", "labels")
    )


def ends_of_rays(sensor, depths):
    """Where a `PointCloud`'s rays end: float32 (n, samples, 3), m; far away, if they hit nothing.

    `depths` (n, samples), float32, are in the units in which they are stored.
    """
    edge = math.isqrt(sensor.num_samples)
    eye = torch.tensor(sensor.eye, device=depths.device)
    rays = deproject(sensor, np.ones((edge, edge))).reshape(-1, 3) - sensor.eye
    metres = torch.where(depths < DEEPEST, depths * (sensor.far / DEEPEST), 1e6)
    return eye + metres.unsqueeze(2) * torch.as_tensor(rays, dtype=torch.float32, device=eye.device)


def gather(values, indices):
    """Rows of values (n, p, f) at indices (n, ...), each row with its own: (n, ..., f)."""
    flat = indices.flatten(1).unsqueeze(-1).expand(-1, -1, values.shape[2])
    return torch.gather(values, 1, flat).unflatten(1, indices.shape[1:])


def hits(points, labels):
    """Which points (n, p, 3), labels (n, p), hit something, and which of them above the table."""
    hit = labels != NOTHING
    return hit, hit & (points[:, :, 2] > TABLE_TOP)


def thin_out(mask, number):
    """Indices (n, number) evenly spaced among those where mask (n, p) is true.

    If there are fewer, they are repeated; if there are none, it is the first index.
    """
    index = torch.arange(mask.shape[1], device=mask.device)
    order = (index + mask.shape[1] * ~mask).argsort(1)  # those first
    steps = torch.arange(number, device=mask.device)
    counts = mask.sum(1, keepdim=True).clamp(min=1)
    return order.gather(1, (steps * counts).div(number, rounding_mode="floor"))


def comparison(points, truth, predicted, size=160):
    """A picture, uint8: a sensor's points (p, 3) seen from above; true classes left, ours right.

    Robot red, table and floor orange, obstacles yellow, as in the paper's figure; nothing grey.
    """
    pictures = []
    for labels in (truth, predicted):
        picture = np.full((size, size, 3), 255, np.uint8)
        order = np.argsort(points[:, 2])  # the highest is drawn last
        pixels = ((1.2 - points[order, :2]) / 2.4 * size).astype(int)
        inside = ((pixels >= 0) & (pixels < size - 1)).all(1)
        for shift in ((0, 0), (0, 1), (1, 0), (1, 1)):
            picture[tuple((pixels[inside] + shift).T)] = COLOURS[labels[order][inside]]
        pictures.append(picture)
    return np.concatenate(pictures, axis=1)
