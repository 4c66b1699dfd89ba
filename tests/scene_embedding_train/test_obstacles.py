"""Ground-truth obstacles for the trainers: distances against PyBullet's."""

import numpy as np
import torch
from encoder_trainers import OBSTACLES, obstacle_rows

from roboarm_nmp.scene_embedding_train import obstacles
from roboarm_nmp.utils.bullet import pybullet as p


def test_distances_equal_those_of_pybullet():
    client = p.connect(p.DIRECT)
    tip = p.createCollisionShape(p.GEOM_SPHERE, radius=1e-4, physicsClientId=client)
    tip = p.createMultiBody(0, tip, physicsClientId=client)
    box, cylinder, sphere = OBSTACLES
    half = [edge / 2 for edge in box.size]
    size = {"radius": cylinder.radius, "height": cylinder.length}
    shapes = [
        p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client),
        p.createCollisionShape(p.GEOM_CYLINDER, **size, physicsClientId=client),
        p.createCollisionShape(p.GEOM_SPHERE, radius=sphere.radius, physicsClientId=client),
    ]
    orientations = [box.orientation, cylinder.orientation, (0.0, 0.0, 0.0, 1.0)]
    bodies = [
        p.createMultiBody(0, shape, -1, obstacle.position, orientation, physicsClientId=client)
        for obstacle, shape, orientation in zip(OBSTACLES, shapes, orientations, strict=True)
    ]
    points = np.random.default_rng(0).uniform([-0.6, -0.6, 0.0], [0.6, 0.6, 1.0], (2_000, 3))
    expected = []
    for point in points:
        p.resetBasePositionAndOrientation(tip, point, (0, 0, 0, 1), physicsClientId=client)
        found = (p.getClosestPoints(tip, body, 0.5, physicsClientId=client) for body in bodies)
        expected.append(min((one[8] + 1e-4 for pairs in found for one in pairs), default=0.5))
    p.disconnect(client)
    points = torch.tensor(points[None], dtype=torch.float32)
    found = obstacles.distances(obstacle_rows(), points)[0].numpy()
    assert (found < 0.0).sum() > 20 and (found == obstacles.MAX_DISTANCE).sum() > 20
    # (Bullet's boxes and cylinders have rounded edges, and its depths are those of GJK and EPA.)
    np.testing.assert_allclose(found, np.clip(expected, -0.05, 0.4), atol=1.5e-3)
