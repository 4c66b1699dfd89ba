"""Describe a scene, save it as a file for the command line, and evaluate two policies in it.

    python examples/03_own_scene.py
    roboarm view my_scene.yaml --policy planner

docs/customise/scene.md goes on from here, to queries, demonstrations and training.
"""

import argparse
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import roboarm_nmp
from roboarm_nmp.envs.scenes.files import save_scene
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene, Sphere


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("my_scene.yaml"))
    parser.add_argument("--queries", type=int, default=20)
    args = parser.parse_args()

    scene = Scene(  # lengths in m, in the frame of the robot's base; table and floor are there, too
        (
            Box(position=(0.5, 0.0, 0.3), size=(0.3, 0.04, 0.6)),
            Cylinder(position=(0.3, -0.5, 0.25), radius=0.05, length=0.5),
            Sphere(position=(-0.1, 0.55, 0.5), radius=0.1),
        )
    )
    save_scene(scene, args.output)
    print(f"{args.output}: {len(scene.obstacles)} obstacles")

    # Random starts and goals that are free of collisions and held by the controller.
    env = roboarm_nmp.make(scene)
    rng = np.random.default_rng(0)
    queries = [env.sample_query(rng) for _ in range(args.queries)]
    starts = np.array([start for start, _ in queries], np.float32)  # (n, 7), rad
    goals = np.array([goal for _, goal in queries], np.float32)
    env.close()

    for policy in ("go-to-goal", "planner"):
        result = roboarm_nmp.evaluate(
            policy, str(args.output), queries=SimpleNamespace(start=starts, goal=goals)
        )
        free = result["collision_free_success_rate"]
        print(f"{policy}: success {result['success_rate']:.2f}, without contact {free:.2f}")


if __name__ == "__main__":
    main()
