"""Compiled ray casting: against PyBullet's images and ray tests, and against formulas."""

import numpy as np

from roboarm_nmp import envs
from roboarm_nmp.envs.perception.point_clouds import farthest_points
from roboarm_nmp.envs.perception.sensors import (
    NOTHING,
    OBSTACLE,
    ROBOT,
    STATIC,
    Camera,
    PointCloud,
    SensorWorld,
    cardinal,
    deproject,
)
from roboarm_nmp.envs.robots.urdf import robot_from_urdf
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene, Sphere
from roboarm_nmp.utils.bullet import pybullet as p

HOME = np.array([0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8])
EDGE = 60
# Capsule, sphere, box and a box's mesh, each on a joint of its own.
SHAPES_URDF = """<robot name="shapes"><link name="base"/>{links}</robot>"""
LINK_URDF = """<link name="l{i}"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 0.15" rpy="0.3 0.2 0.1"/><geometry>{shape}</geometry></collision></link>
<joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="l{i}"/>
<origin xyz="0 0 0.3"/><axis xyz="1 0 0"/>
<limit lower="-2" upper="2" effort="50" velocity="2"/></joint>"""


def images_of_pybullet(scene, configuration, sensor):
    """Depth (m) and class of a sensor's pixels as PyBullet's renderer has them."""
    world = SensorWorld()
    world.show(scene, configuration)
    width, height = sensor.size
    _, _, _, depth, bodies = p.getCameraImage(
        width,
        height,
        p.computeViewMatrix(sensor.eye, sensor.target, sensor.up),
        p.computeProjectionMatrixFOV(sensor.field_of_view, width / height, sensor.near, sensor.far),
        renderer=p.ER_TINY_RENDERER,
        physicsClientId=world.client,
    )
    depth = np.reshape(depth, (height, width)).astype(np.float64)
    depth = sensor.far * sensor.near / (sensor.far - (sensor.far - sensor.near) * depth)
    bodies = np.reshape(bodies, (height, width))
    known = (scene.floor is not None) + (scene.table is not None)
    classes = np.full((height, width), OBSTACLE)
    classes[bodies == world._drawn.body] = ROBOT
    classes[np.isin(bodies, world._drawn._bodies[:known])] = STATIC
    classes[bodies < 0] = NOTHING
    world.close()
    return depth, classes


def cast(scene, configuration, sensor):
    world = SensorWorld()
    world.show(scene, configuration)
    return world.cast(sensor, sensor.size)


def apart(sensor, depth, other):
    """m, between the points of two depth images."""
    return np.linalg.norm(deproject(sensor, depth) - deproject(sensor, other), axis=-1)


def test_points_and_classes_are_those_of_pybullet():
    env, rng = envs.make("random_boxes_hard"), np.random.default_rng(0)
    off = wrong = rays = 0
    for _ in range(2):
        env.sample_scene(rng)
        configuration = env.sample_feasible(rng)
        for sensor in cardinal(PointCloud, num_samples=EDGE**2).values():
            depth, classes = cast(env.scene, configuration, sensor)
            expected, of_bullet = images_of_pybullet(env.scene, configuration, sensor)
            same = classes == of_bullet
            # PyBullet draws a concave link of the Panda, of which physics has the convex hull.
            compared = same & (classes != NOTHING) & (classes != ROBOT)
            off += (apart(sensor, depth, expected)[compared] > 1e-3).sum()
            wrong, rays = wrong + (~same).sum(), rays + same.size
    env.close()
    assert off + wrong <= 0.001 * rays


def test_depths_are_exact():
    """Seen from above: a sphere, an upright cylinder, the rim of its lid, the table, the floor."""
    scene = Scene((Sphere((0.5, 0.0, 0.3), 0.1), Cylinder((-0.5, 0.0, 0.2), 0.2, 0.4)))
    camera = Camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 40.0, (200, 200))
    depth, classes = cast(scene, HOME, camera)
    points = deproject(camera, depth)
    x, y, z = np.moveaxis(points, -1, 0)
    ball = (classes == OBSTACLE) & (x > 0)
    lid = (classes == OBSTACLE) & (x < 0)
    assert ball.sum() > 100 and lid.sum() > 500
    assert np.abs(np.linalg.norm(points[ball] - [0.5, 0.0, 0.3], axis=1) - 0.1).max() < 1e-6
    on_top, on_side = np.abs(z[lid] - 0.4) < 1e-6, np.abs(np.hypot(x + 0.5, y)[lid] - 0.2) < 1e-6
    assert (on_top | on_side).all() and on_top.sum() > 300
    static = z[classes == STATIC]
    assert (np.isclose(static, 0.0, atol=1e-6) | np.isclose(static, -0.6, atol=1e-6)).mean() > 0.99
    assert (depth[classes == NOTHING] == np.float32(camera.far)).all()


def test_nearest_and_farthest_distance_limit_what_is_observed():
    box = Box((1.0, 0.0, 0.5), (0.2, 0.2, 0.2))
    scene = Scene((box,), table=None, floor=None)
    for near, far, seen in ((0.1, 5.0, 1.1), (1.15, 5.0, None), (0.1, 1.05, None)):
        camera = Camera((2.2, 0.0, 0.5), (1.0, 0.0, 0.5), size=(9, 9), near=near, far=far)
        depth, classes = cast(scene, HOME, camera)
        if seen is None:
            assert OBSTACLE not in classes
        else:
            assert classes[4, 4] == OBSTACLE and abs(depth[4, 4] - seen) < 1e-6


def test_arm_of_spheres_capsules_boxes_and_meshes_is_that_of_ray_tests(tmp_path):
    mesh = tmp_path / "box.obj"
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    faces = [(1, 2, 4), (1, 4, 3), (5, 7, 8), (5, 8, 6), (1, 5, 6), (1, 6, 2)]
    faces += [(3, 4, 8), (3, 8, 7), (1, 3, 7), (1, 7, 5), (2, 6, 8), (2, 8, 4)]
    text = "".join(f"v {0.05 * x} {0.06 * y} {0.07 * z}\n" for x, y, z in corners)
    mesh.write_text(text + "".join(f"f {a} {b} {c}\n" for a, b, c in faces))
    shapes = [
        '<capsule radius="0.06" length="0.1"/>',
        '<sphere radius="0.08"/>',
        '<box size="0.1 0.12 0.14"/>',
        f'<mesh filename="{mesh}"/>',
        '<cylinder radius="0.06" length="0.16"/>',
    ]
    links = "".join(
        LINK_URDF.format(i=i, shape=shape, parent=f"l{i - 1}" if i else "base")
        for i, shape in enumerate(shapes)
    )
    urdf = tmp_path / "shapes.urdf"
    urdf.write_text(SHAPES_URDF.format(links=links))
    robot = robot_from_urdf(urdf)
    scene, configuration = Scene(table=None, floor=None, robot=robot), np.full(5, 0.3)
    sensor = PointCloud((2.0, 0.5, 0.8), (0.0, 0.0, 0.8), field_of_view=45.0, num_samples=EDGE**2)
    depth, classes = cast(scene, configuration, sensor)
    world = SensorWorld()
    world.show(scene, configuration)
    ends = deproject(sensor, np.full((EDGE, EDGE), sensor.far)).reshape(-1, 3)
    hits = p.rayTestBatch([sensor.eye] * len(ends), ends.tolist(), physicsClientId=world.client)
    hit = np.array([one[0] >= 0 for one in hits]).reshape(EDGE, EDGE)
    assert (hit != (classes == ROBOT)).mean() < 0.02  # outlines: 1 mm of margin around meshes
    both = hit & (classes == ROBOT)
    points = np.array([one[3] for one in hits]).reshape(EDGE, EDGE, 3)
    errors = np.linalg.norm(points - deproject(sensor, depth), axis=-1)[both]
    assert both.sum() > 80 and np.quantile(errors, 0.9) < 0.004
    assert {one[1] for one in hits if one[0] >= 0} == set(range(5))
    world.close()


def test_farthest_points_equal_a_loop_bit_for_bit():
    rng = np.random.default_rng(0)
    for number in (0, 1, 5, 900):
        points = rng.uniform(-1, 1, (number, 3)).astype(np.float32)
        if number == 900:
            points = np.round(points, 1)  # ties
        chosen, nearest = np.zeros((64, 3), np.float32), np.linalg.norm(points, axis=1)
        distance = np.full(number, np.inf)
        for row in chosen[:number]:
            row[:] = points[nearest.argmax()]
            distance = np.minimum(distance, np.linalg.norm(points - row, axis=1))
            nearest = distance
        assert farthest_points(points, 64).tobytes() == chosen.tobytes()
