"""Point clouds, as the trainer of PointNet++ uses them: all that was seen, and a picture of it."""

import numpy as np
import torch

# Of the classes, robot, table and floor, obstacle, nothing (as in the paper's figure).
COLOURS = np.array([[210, 50, 40], [240, 140, 40], [245, 210, 60], [150, 150, 150]], np.uint8)


def whole_clouds(observations, shard, name):
    """All that a sensor saw in the scenes of a shard, as `envs.sensors.PointCloud.points` has it.

    Points, float32 (n, samples, 3), and labels, uint8 (n, samples).
    """
    sensor = observations.sensors[name]
    pictures = (
        observations.read(shard, f"{name}/{output}") for output in ("depth", "segmentation")
    )
    seen = [
        sensor.points(depth * (sensor.far / 65_535), segmentation)
        for depth, segmentation in zip(*pictures, strict=True)
    ]
    return tuple(
        torch.from_numpy(np.stack([one[key] for one in seen])) for key in ("points", "labels")
    )


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
