"""Point clouds for the trainers of point-cloud encoders: loading, thinning, classes, a figure.

Clouds are thinned out to save time: the loaders thin out those of a training set once, and
`thin_out` is a part of the exported encoders.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.envs.perception.sensors import NOTHING, OBSTACLE, PointCloud, deproject
from roboarm_nmp.scene_embedding_train.training_data import unpack
from roboarm_nmp.training.arguments import fail

MAX_RADIUS = 1.1  # m from the robot's axis: the arm does not reach further
TABLE_TOP = 0.01  # m: table and floor are most of a cloud, so points above it are sampled apart
NO_HIT = 65_535  # a stored depth: `far` of the sensor, where its ray hits nothing
ABSENT_DISTANCE = 0.05  # m: a point is absent from a cloud whose points are all further away
IGNORED = -100  # label of points that have no class
# Of the classes robot, table and floor, obstacle, nothing (as in the paper's figure).
COLOURS = np.array([[210, 50, 40], [240, 140, 40], [245, 210, 60], [150, 150, 150]], np.uint8)


class Clouds(NamedTuple):
    """Observed point clouds, in memory-mapped arrays.

    Attributes:
        sensors: dict of name -> `PointCloud`.
        points: float32 (scenes, sensors, 2, num_points, 3), m: evenly spaced among those that hit
            something, and among those of them above the table.
        labels: the points' classes, uint8 (scenes, sensors, 2, num_points).
        depths: of all samples, uint16 (scenes, sensors, samples), see `ray_ends`.
    """

    sensors: dict[str, PointCloud]
    points: np.ndarray
    labels: np.ndarray
    depths: np.ndarray


def load_clouds(observations: Observations, num_points: int) -> Clouds:
    """The `Clouds` of `Observations`, thinned out to `num_points` points once.

    Raises:
        SystemExit: there are no clouds, or they differ in size.
    """
    sensors = {
        name: sensor
        for name, sensor in observations.sensors.items()
        if isinstance(sensor, PointCloud)
    }
    samples = {sensor.num_samples for sensor in sensors.values()}
    if len(samples) != 1:
        why = "the clouds differ in size" if sensors else "no clouds (collect with --sensors)"
        fail(f"--observations: {observations.folder}: {why}")
    shards = (
        _clouds_of_shard(observations, shard, sensors, num_points)
        for shard in range(len(observations.offsets) - 1)
    )
    arrays = {
        "points": (np.float32, (len(sensors), 2, num_points, 3)),
        "labels": (np.uint8, (len(sensors), 2, num_points)),
        "depths": (np.uint16, (len(sensors), samples.pop())),
    }
    return Clouds(sensors, **unpack(observations, f"clouds_{num_points}", arrays, shards))


def _clouds_of_shard(observations, shard, names, num_points):
    """`load_clouds`'s arrays of one shard, a dict."""
    rows = {"points": [], "labels": [], "depths": []}
    for name in names:
        points, labels = whole_clouds(observations, shard, name)
        chosen = torch.stack([thin_out(mask, num_points) for mask in hits(points, labels)], dim=1)
        rows["points"].append(gather(points, chosen))
        rows["labels"].append(gather(labels.unsqueeze(2), chosen).squeeze(-1))
        depths = torch.from_numpy(observations.read(shard, f"{name}/depth"))
        rows["depths"].append(depths.flatten(1))
    return {output: torch.stack(parts, dim=1).numpy() for output, parts in rows.items()}


def batch_of(clouds: Clouds, rows: np.ndarray, device: torch.device | str) -> list[tuple]:
    """Rows of `Clouds`: a list of (points, labels, whole) per sensor.

    Labels are int64; `whole`, (n, samples, 3), are the points before thinning.
    """
    rows = np.sort(rows)
    points = torch.as_tensor(clouds.points[rows], device=device)
    labels = torch.as_tensor(clouds.labels[rows], device=device).long()
    depths = torch.as_tensor(clouds.depths[rows].astype(np.float32), device=device)
    return [
        (points[:, i], labels[:, i], ray_ends(sensor, depths[:, i]))
        for i, sensor in enumerate(clouds.sensors.values())
    ]


def load_obstacle_points(
    observations: Observations, num_points: int
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Evenly spaced points on obstacles, `num_points` of each cloud, thinned out once.

    Returns:
        The sensors' names; points, float32 (scenes, sensors * num_points, 3), m; and which of them
        are valid, bool (scenes, sensors * num_points): none of a cloud without obstacles. The
        arrays are memory-mapped.

    Raises:
        SystemExit: there are no clouds.
    """
    sensors = [
        name for name, sensor in observations.sensors.items() if isinstance(sensor, PointCloud)
    ]
    if not sensors:
        fail(f"--observations: {observations.folder}: no clouds (collect with --sensors)")

    def rows(shard):
        clouds = [whole_clouds(observations, shard, name) for name in sensors]
        points, valid = obstacle_points(clouds, num_points)
        return {"points": points.numpy(), "valid": valid.numpy()}

    count = len(sensors) * num_points
    arrays = {"points": (np.float32, (count, 3)), "valid": (np.bool_, (count,))}
    shards = (rows(shard) for shard in range(len(observations.offsets) - 1))
    name = f"obstacle_points_{num_points}_{MAX_RADIUS}"
    unpacked = unpack(observations, name, arrays, shards)
    return sensors, unpacked["points"], unpacked["valid"]


def obstacle_points(clouds: list[tuple], num_points: int) -> tuple[Tensor, Tensor]:
    """Of each cloud `num_points` points on obstacles within `MAX_RADIUS`, evenly spaced.

    Args:
        clouds: list of a sensor's points (n, p, 3), m, and labels (n, p).

    Returns:
        Points (n, sensors * num_points, 3), and which are valid: bool (n, sensors * num_points),
        none of a cloud without such points.
    """
    all_points = []
    all_valid = []
    for points, labels in clouds:
        wanted = (labels == OBSTACLE) & (points[..., :2].square().sum(2) < MAX_RADIUS**2)
        chosen = thin_out(wanted, num_points)
        all_points.append(gather(points, chosen))
        all_valid.append(gather(wanted.unsqueeze(2), chosen).squeeze(2))
    return torch.cat(all_points, dim=1), torch.cat(all_valid, dim=1)


def example_clouds(observations: Observations, names: Iterable[str]) -> dict[str, Tensor]:
    """Two scenes' whole clouds, as an encoder receives them: a dict of tensors.

    `<name>_points`, float32 (2, samples, 3), m, and `<name>_labels`, uint8 (2, samples).
    """
    example = {}
    for name in names:
        points, labels = whole_clouds(observations, 0, name)
        example[f"{name}_points"] = points[:2].clone()
        example[f"{name}_labels"] = labels[:2].clone()
    return example


def scene_cloud(observations: Observations, scene: int, name: str) -> tuple[Tensor, Tensor]:
    """A sensor's whole cloud of one scene: points (p, 3), m, that hit something, and labels (p)."""
    shard = int(np.searchsorted(observations.offsets, scene, side="right")) - 1
    row = scene - observations.offsets[shard]
    points, labels = whole_clouds(observations, shard, name)
    hit = labels[row] != NOTHING
    return points[row][hit], labels[row][hit]


def whole_clouds(observations: Observations, shard: int, name: str) -> tuple[Tensor, Tensor]:
    """A sensor's clouds of the scenes of a shard, as the environment's `PointCloud` returns them.

    Points, float32 (n, samples, 3), m, and labels, uint8 (n, samples).
    """
    sensor = observations.sensors[name]
    assert isinstance(sensor, PointCloud)
    depths = observations.read(shard, f"{name}/depth")
    segmentations = observations.read(shard, f"{name}/segmentation")
    clouds = [
        sensor.points(depth * (sensor.far / NO_HIT), segmentation)
        for depth, segmentation in zip(depths, segmentations, strict=True)
    ]
    points = np.stack([cloud["points"] for cloud in clouds])
    labels = np.stack([cloud["labels"] for cloud in clouds])
    return torch.from_numpy(points), torch.from_numpy(labels)


def ray_ends(sensor: PointCloud, depths: Tensor) -> Tensor:
    """Where a `PointCloud`'s rays end: float32 (n, samples, 3), m; far away if they hit nothing.

    `depths` (n, samples), float32, are in the units in which they are stored.
    """
    edge = math.isqrt(sensor.num_samples)
    eye = torch.tensor(sensor.eye, device=depths.device)
    rays = deproject(sensor, np.ones((edge, edge))).reshape(-1, 3) - sensor.eye
    metres = torch.where(depths < NO_HIT, depths * (sensor.far / NO_HIT), 1e6)
    return eye + metres.unsqueeze(2) * torch.as_tensor(rays, dtype=torch.float32, device=eye.device)


def gather(values: Tensor, indices: Tensor) -> Tensor:
    """Rows of values (n, p, f) at indices (n, ...), each scene's at its own: (n, ..., f)."""
    flat = indices.flatten(1).unsqueeze(-1).expand(-1, -1, values.shape[2])
    return torch.gather(values, 1, flat).unflatten(1, indices.shape[1:])


def hits(points: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Which points (n, p, 3), labels (n, p), hit something, and which of them above the table."""
    hit = labels != NOTHING
    return hit, hit & (points[:, :, 2] > TABLE_TOP)


def thin_out(mask: Tensor, number: int) -> Tensor:
    """Indices (n, number) evenly spaced among those where mask (n, p) is true.

    Fewer are repeated; where none is true, all are the first index.
    """
    index = torch.arange(mask.shape[1], device=mask.device)
    keys = index + mask.shape[1] * ~mask
    order = keys.topk(mask.shape[1], dim=1, largest=False).indices  # true ones first
    steps = torch.arange(number, device=mask.device)
    counts = mask.sum(1, keepdim=True).clamp(min=1)
    return order.gather(1, (steps * counts).div(number, rounding_mode="floor"))


def distances_to(points: Tensor, clouds: Tensor) -> Tensor:
    """From points (n, p, 3) to the nearest of each scene's cloud (n, q, 3): distances (n, p)."""
    squares = [  # without those of the points; a scene at a time, for the CPU's cache
        torch.addmm(cloud.square().sum(1), scene, cloud.T, alpha=-2).amin(1)
        for scene, cloud in zip(points, clouds, strict=True)
    ]
    return (torch.stack(squares) + points.square().sum(2)).clamp(min=0).sqrt()


def queries_of(
    points: Tensor, labels: Tensor, whole: Tensor, number: int | None = None
) -> tuple[Tensor, Tensor]:
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
    classes = torch.where(classes == NOTHING, IGNORED, classes)
    other_classes = torch.where(absent, NOTHING, IGNORED)
    return torch.cat([own, others], dim=1), torch.cat([classes, other_classes], dim=1)


@torch.no_grad()
def classification_scores(
    model: nn.Module, clouds: Clouds, rows: np.ndarray, batch_size: int, device: torch.device | str
) -> dict[str, float]:
    """How well points of scenes `rows` are classified.

    Returns:
        `accuracy` and the intersection over union of each class, `iou_robot`, `iou_static`,
        `iou_obstacle`, over points evenly spaced among those that hit something; and `absent`, the
        share of other scenes' obstacle points that are predicted to be absent.
    """
    model.eval()
    number = clouds.points.shape[3]
    confusion = torch.zeros(NOTHING, NOTHING + 1, dtype=torch.int64)  # truth, prediction
    predicted_absent = 0
    all_absent = 0
    for start in range(0, len(rows), batch_size):
        batch = batch_of(clouds, rows[start : start + batch_size], device)
        for logits, truth in zip(*model(batch), strict=True):
            predicted = logits.argmax(2)
            one_hot = F.one_hot(predicted, NOTHING + 1)[:, :number]
            masks = [(truth[:, :number] == label).unsqueeze(2) for label in range(NOTHING)]
            confusion += torch.stack([(mask * one_hot).sum((0, 1)) for mask in masks]).cpu()
            absent = truth == NOTHING
            all_absent += absent.sum().item()
            predicted_absent += (absent & (predicted == NOTHING)).sum().item()
    model.train()
    both = confusion.diagonal()
    iou = both / (confusion[:, :NOTHING].sum(0) + confusion.sum(1) - both).clamp(min=1)
    robot, static, obstacle = iou.tolist()
    return {
        "accuracy": (both.sum() / confusion.sum().clamp(min=1)).item(),
        "absent": predicted_absent / max(1, all_absent),
        "iou_robot": robot,
        "iou_static": static,
        "iou_obstacle": obstacle,
    }


def comparison(points: Tensor, truth: Tensor, predicted: Tensor, size: int = 160) -> np.ndarray:
    """A figure, uint8 (size, 2 size, 3): points (p, 3), m, from above, true classes on the left.

    Robot red, table and floor orange, obstacles yellow, as in the paper's figure; nothing grey.
    """
    places = points.cpu().numpy()
    order = np.argsort(places[:, 2])  # the highest is drawn last
    pixels = ((1.2 - places[order, :2]) / 2.4 * size).astype(int)
    inside = ((pixels >= 0) & (pixels < size - 1)).all(1)
    images = []
    for labels in (truth.cpu().numpy(), predicted.cpu().numpy()):
        image = np.full((size, size, 3), 255, np.uint8)
        for shift in ((0, 0), (0, 1), (1, 0), (1, 1)):
            image[tuple((pixels[inside] + shift).T)] = COLOURS[labels[order][inside]]
        images.append(image)
    return np.concatenate(images, axis=1)
