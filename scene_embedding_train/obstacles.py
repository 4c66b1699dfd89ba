"""Ground-truth obstacles for the trainer of the distance field: loading, and distances from points.

Obstacles are float32 (n, k, 12), n scenes with room for k. An obstacle's row is 1 and its row of
`envs.scenes.primitives.to_array`; unused rows are zeros.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.envs.scenes.primitives import padded_rows

MIN_DISTANCE, MAX_DISTANCE = -0.05, 0.4  # m: distances are clipped to this range


def load_obstacles(observations: Observations) -> np.ndarray:
    """The ground-truth obstacles: float32 (scenes, n, 12), n of the scene that has most.

    An obstacle's row is 1 and its row of `to_array`, with a quaternion of length 1; the rows after
    a scene's last obstacle are zeros.
    """
    shards = range(len(observations.offsets) - 1)
    scenes = [scene for shard in shards for scene in observations.scenes(shard)]
    most = max(len(scene.obstacles) for scene in scenes)
    obstacles = np.stack([padded_rows(scene.obstacles, most) for scene in scenes])
    quaternions = obstacles[..., 5:9]
    quaternions /= np.maximum(np.linalg.norm(quaternions, axis=-1, keepdims=True), 1e-9)
    return obstacles


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4), x, y, z, w."""
    x, y, z, w = quaternions.unbind(-1)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def distances(obstacles: Tensor, points: Tensor) -> Tensor:
    """Distances (n, q), m, from points (n, q, 3), m, to the nearest of obstacles (n, k, 12).

    Obstacles are rows of `load_obstacles`. Distances are negative inside an obstacle, and clipped
    to [`MIN_DISTANCE`, `MAX_DISTANCE`].
    """
    exists, kind, position, quaternion, size = obstacles.split((1, 1, 3, 4, 3), dim=2)
    # Into the obstacles' own frames, all in one product.
    axes = rotation_matrices(quaternion)
    offset = (points @ axes.transpose(1, 2).flatten(2)).unflatten(2, (-1, 3))
    offset = offset - (position.unsqueeze(2) @ axes).transpose(1, 2)
    exists, kind, size = exists.unsqueeze(1), kind.unsqueeze(1), size.unsqueeze(1)
    x, y, z = offset.unbind(-1)
    # A cylinder is a rectangle in radius and height; the second of three axes is always inside.
    flat = torch.stack([(x.square() + y.square()).sqrt(), torch.zeros_like(x), z], dim=-1)
    half_flat = size * size.new_tensor([1.0, 0.0, 0.5]) + size.new_tensor([0.0, 1.0, 0.0])
    cylinder = kind == 1.0
    beyond = torch.where(cylinder, flat, offset).abs() - torch.where(cylinder, half_flat, size / 2)
    distance = beyond.clamp(min=0.0).norm(dim=-1) + beyond.amax(dim=-1).clamp(max=0.0)
    distance = torch.where(kind[..., 0] == 2.0, offset.norm(dim=-1) - size[..., 0], distance)
    distance = torch.where(exists[..., 0] > 0.0, distance, MAX_DISTANCE)
    return distance.amin(dim=2).clamp(MIN_DISTANCE, MAX_DISTANCE)


@torch.no_grad()
def comparison(obstacles: Tensor, field: Callable, reach: float, size: int = 96) -> np.ndarray:
    """A figure of a distance field at three heights, truth above: uint8 (2 size, 3 size, 3).

    Seen from above, x up. Dark is near, and the inside of obstacles is red.

    Args:
        obstacles: of one scene, (1, k, 12).
        field: a function from points (1, q, 3), m, to distances (1, q), m.
        reach: half the edge (m) of the square around the robot that is shown.
    """
    device = obstacles.device
    axis = torch.linspace(reach, -reach, size, device=device)  # x is up, y to the left
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    red = torch.tensor([200.0, 30.0, 30.0], device=device)
    rows = []
    for distances_at in (lambda at: distances(obstacles, at), field):
        images = []
        for height in (0.2, 0.5, 0.8):
            at = torch.stack([x, y, torch.full_like(x, height)], dim=2).reshape(1, -1, 3)
            shares = (distances_at(at) / MAX_DISTANCE).clamp(0.0, 1.0)
            grey = (255 * shares).reshape(size, size, 1)
            images.append(torch.where(grey > 0.0, grey, red))
        rows.append(torch.cat(images, dim=1))
    return torch.cat(rows).byte().cpu().numpy()
