"""Sensors: their agreement with PyBullet, their time, and the time of whole steps.

    python benchmarks/sensor_throughput.py

Scenes are those of `random_boxes_hard`, with the arm in feasible configurations. Times are medians
of processor time on one core. Agreement is that with PyBullet's renderer: the share of rays that
hit the same class, and whose point is within 1 mm; rays to the arm also count, of which PyBullet
draws a concave link that here, as in collision checks, is its convex hull.
"""

import argparse
import time

import numpy as np

from roboarm_nmp import envs
from roboarm_nmp.envs.perception.geometry_source import observed_checker
from roboarm_nmp.envs.perception.point_clouds import farthest_points, observed_points
from roboarm_nmp.envs.perception.sensors import (
    NOTHING,
    OBSTACLE,
    OUTPUTS,
    ROBOT,
    STATIC,
    PointCloud,
    SceneObservation,
    SensorWorld,
    cardinal,
    deproject,
)
from roboarm_nmp.policies.registry import find_policy, make_policy
from roboarm_nmp.utils.bullet import pybullet as p

TASK = "random_boxes_hard"
POLICY = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"


def scenes(number):
    """Yield scenes and feasible configurations (7,), rad."""
    env, rng = envs.make(TASK), np.random.default_rng(0)
    for _ in range(number):
        env.sample_scene(rng)
        yield env.scene, env.sample_feasible(rng)
    env.close()


def median_ms(sensors, repeats, together=False):
    """Median milliseconds of one of `sensors` (a dict), or of all `together`."""
    world, times = SensorWorld(), []
    for scene, configuration in scenes(repeats):
        world.show(scene, configuration)
        if together:
            started = time.thread_time()
        for sensor in sensors.values():
            if not together:
                world.show(scene, configuration)
                started = time.thread_time()
            sensor.observe(world)
            if not together:
                times.append(time.thread_time() - started)
        if together:
            times.append(time.thread_time() - started)
    world.close()
    return 1e3 * np.median(times)


def bullet_image(world, sensor):
    """Depth (m) and classes as PyBullet's renderer draws them."""
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
    bodies, scene = np.reshape(bodies, (height, width)), world.scene
    # Bodies are numbered as they are made: the arm, floor and table, obstacles.
    numbers = np.unique(
        [
            p.getBodyUniqueId(i, physicsClientId=world.client)
            for i in range(p.getNumBodies(physicsClientId=world.client))
        ]
    )
    known = (scene.floor is not None) + (scene.table is not None)
    classes = np.full((height, width), OBSTACLE, np.uint8)
    classes[bodies == numbers[0]] = ROBOT
    classes[np.isin(bodies, numbers[1 : 1 + known])] = STATIC
    classes[bodies < 0] = NOTHING
    return depth, classes


def agreement(number):
    """Shares of rays with the same class, and of these with points within 1 mm; without the arm."""
    rays = same = near = others = 0
    world = SensorWorld()
    for scene, configuration in scenes(number):
        world.show(scene, configuration)
        for sensor in cardinal(PointCloud).values():
            depth, classes = world.cast(sensor, sensor.size)
            expected, of_bullet = bullet_image(world, sensor)
            alike = classes == of_bullet
            apart = np.linalg.norm(deproject(sensor, depth) - deproject(sensor, expected), axis=-1)
            close = alike & ((apart <= 1e-3) | (classes == NOTHING))
            rays, same, near = rays + alike.size, same + alike.sum(), near + close.sum()
            others += (close | (classes == ROBOT)).sum()
    world.close()
    return same / rays, near / rays, others / rays


def steps(number):
    """Median milliseconds of the parts of a step with four clouds, dict."""
    names = ("four clouds, one point per cell", "checker", "link distances", "64 farthest points")
    times = []
    for scene, configuration in scenes(number):
        state = scene.robot.normalise(configuration)
        marks = [time.thread_time()]
        observation = SceneObservation.of(scene, configuration)
        points = observed_points(observation)
        marks.append(time.thread_time())
        checker = observed_checker(observation)
        marks.append(time.thread_time())
        checker.link_distances(state)
        marks.append(time.thread_time())
        farthest_points(points, 64)
        marks.append(time.thread_time())
        times.append(np.diff(marks))
    times = 1e3 * np.array(times)
    return dict(
        zip((*names, "together"), (*np.median(times, 0), np.median(times.sum(1))), strict=True)
    )


def policy_step(queries):
    """Median milliseconds of a step of the point-cloud policy with its filter, which observes in
    every step: of sensing and observations, and of policy and filter."""
    policy, arguments = find_policy(POLICY)
    env = envs.make(TASK, **arguments, observe_every=1)
    begin, sensing, acting = make_policy(policy, env), [], []
    for number in range(queries):
        observation, _ = env.reset(seed=number)
        act = begin(number, None).act
        for _ in range(60):
            started = time.thread_time()
            action = act(observation)
            acting.append(time.thread_time() - started)
            began = time.thread_time()
            env.unwrapped.step(action)
            simulated = time.thread_time()
            observation, _, done, late, _ = env.step(action)  # and the simulation of a second step
            sensing.append((time.thread_time() - simulated) - (simulated - began))
            if done or late:
                break
    env.close()
    return 1e3 * np.median(sensing), 1e3 * np.median(acting)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=100, help="scenes (100)")
    args = parser.parse_args()
    observed_checker(SceneObservation.of(*next(scenes(1))))  # compiled functions are loaded
    same, near, others = agreement(args.repeats)
    print(f"rays of the same class as PyBullet's: {same:.5f}")
    print(f"... and within 1 mm: {near:.5f}; those to the arm only of the same class: {others:.5f}")
    for name, sensors, together in [
        ("RGB image, 224 x 224", cardinal(), False),
        ("RGB, depth, segmentation, 224 x 224", cardinal(outputs=OUTPUTS), False),
        ("depth image, 224 x 224", cardinal(outputs=("depth",)), False),
        ("RGB image, 64 x 64", cardinal(size=(64, 64)), False),
        ("point cloud, 10,000 rays", cardinal(PointCloud), False),
        ("four point clouds, 10,000 rays", cardinal(PointCloud), True),
        ("point cloud, 2,500 rays", cardinal(PointCloud, num_samples=2500), False),
    ]:
        print(f"{name}: {median_ms(sensors, args.repeats, together):.2f} ms", flush=True)
    for name, milliseconds in steps(args.repeats).items():
        print(f"step, {name}: {milliseconds:.2f} ms", flush=True)
    sensing, acting = policy_step(10)
    print(f"{POLICY}: sensing and observation {sensing:.2f} ms, policy and filter {acting:.2f} ms")


if __name__ == "__main__":
    main()
