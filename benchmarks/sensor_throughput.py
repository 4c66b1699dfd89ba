"""Time and memory that looking takes: one image, one point cloud, four cameras beside an env.

    python benchmarks/sensor_throughput.py

Scenes are those of `random_boxes_hard`; medians on one core, beside nothing else.
"""

import argparse
import time

import numpy as np
import psutil

from roboarm_nmp import envs
from roboarm_nmp.envs.perception.sensors import OUTPUTS, PointCloud, SensorWorld, cardinal
from roboarm_nmp.envs.wrappers import SensorWrapper

TASK = "random_boxes_hard"


def median_ms(sensors, repeats):
    """Median milliseconds that one of `sensors` (a dict) takes, over random scenes and arms."""
    env, world, rng = envs.make(TASK), SensorWorld(), np.random.default_rng(0)
    times = []
    for _ in range(repeats):
        env.sample_scene(rng)
        world.show(env.scene, env.sample_feasible(rng))
        for sensor in sensors.values():
            started = time.perf_counter()
            sensor.observe(world)
            times.append(time.perf_counter() - started)
    env.close()
    world.close()
    return 1e3 * np.median(times)


def growth(episodes):
    """MB the process grows by in `episodes` episodes of one step, four cameras looking."""
    env = SensorWrapper(envs.make(TASK), cardinal(size=(64, 64)))
    for episode in range(episodes + 200):
        if episode == 200:  # by then everything that is made once has been
            before = psutil.Process().memory_info().rss
        env.reset(seed=episode)
        env.step(np.zeros(7))
    grown = psutil.Process().memory_info().rss - before
    env.close()
    return grown / 1e6


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=100, help="scenes (100)")
    parser.add_argument("--episodes", type=int, default=5000, help="for the memory (5,000)")
    args = parser.parse_args()
    for name, sensors in [
        ("RGB image, 224 x 224", cardinal()),
        ("RGB, depth, segmentation, 224 x 224", cardinal(outputs=OUTPUTS)),
        ("RGB image, 64 x 64", cardinal(size=(64, 64))),
        ("point cloud, 10,000 samples", cardinal(PointCloud)),
        ("point cloud, 2,500 samples", cardinal(PointCloud, num_samples=2500)),
    ]:
        print(f"{name}: {median_ms(sensors, args.repeats):.1f} ms", flush=True)
    print(f"{args.episodes} episodes with four cameras: {growth(args.episodes):.1f} MB more")


if __name__ == "__main__":
    main()
