"""Render the figures of the sensors in docs/figures.

    python docs/make_sensor_figures.py

The places of the four default sensors (purple balls), and the outputs of each kind for the same
scene: one column per place; from above: RGB, depth (near is bright), segmentation, point cloud.
Classes: robot red, table and floor orange, obstacles yellow (as in the paper's figure).
"""

from pathlib import Path

import numpy as np
from PIL import Image

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.perception.sensors import (
    NOTHING,
    OUTPUTS,
    Camera,
    PointCloud,
    SensorWorld,
    cardinal,
)
from roboarm_nmp.utils.bullet import pybullet as p

FOLDER = Path(__file__).parent / "figures"
COLOURS = np.array([[210, 50, 40], [240, 140, 40], [245, 210, 60], [255, 255, 255]], np.uint8)


def placement(query):
    """The scene with a purple ball where each sensor is."""
    env = envs.make("random_boxes_hard", render_mode="rgb_array")
    env.reset_specific(*query)
    for sensor in cardinal().values():
        ball = p.createVisualShape(
            p.GEOM_SPHERE, radius=0.07, rgbaColor=(0.5, 0.1, 0.7, 1), physicsClientId=env.client
        )
        p.createMultiBody(
            baseVisualShapeIndex=ball, basePosition=sensor.eye, physicsClientId=env.client
        )
    view = p.computeViewMatrixFromYawPitchRoll((0.0, 0.0, 0.2), 5.0, 40, -30, 0, 2)
    projection = p.computeProjectionMatrixFOV(45, 4 / 3, 0.1, 20)
    _, _, pixels, _, _ = p.getCameraImage(
        640, 480, view, projection, lightDirection=(1, 1, 2.5), physicsClientId=env.client
    )
    env.close()
    return np.reshape(pixels, (480, 640, 4))[..., :3].astype(np.uint8)


def cloud_image(cloud, size=224):
    """Points from above, x up and y to the left, coloured by class."""
    image = np.full((size, size, 3), 255, np.uint8)
    hit = cloud["labels"] != NOTHING
    points, labels = cloud["points"][hit], cloud["labels"][hit]
    order = np.argsort(points[:, 2])  # the highest is drawn last
    pixels = ((1.2 - points[order, :2]) / 2.4 * size).astype(int)
    inside = ((pixels >= 0) & (pixels < size - 1)).all(1)
    for shift in ((0, 0), (0, 1), (1, 0), (1, 1)):
        image[tuple((pixels[inside] + shift).T)] = COLOURS[labels[order][inside]]
    return image


def main():
    query = load_queries("random_boxes_hard")[0]
    Image.fromarray(placement(query)).quantize(64).save(FOLDER / "sensors_placement.png")
    world = SensorWorld()
    world.show(query.scene, query.start)
    columns = []
    for name, camera in cardinal(Camera, outputs=OUTPUTS).items():
        observed = camera.observe(world)
        depth = 255 * (1 - observed["depth"] / camera.far)
        column = [observed["rgb"], np.repeat(depth[..., None], 3, 2).astype(np.uint8)]
        column += [COLOURS[observed["segmentation"]]]
        column += [cloud_image(cardinal(PointCloud)[name].observe(world))]
        columns.append(np.concatenate(column))
    world.close()
    outputs = Image.fromarray(np.concatenate(columns, axis=1))
    outputs.quantize(128).save(FOLDER / "sensors_outputs.png", optimize=True)


if __name__ == "__main__":
    main()
