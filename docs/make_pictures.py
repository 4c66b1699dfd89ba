"""Render the pictures of the tasks in docs/pictures.

    python docs/make_pictures.py

For each task: one test query, the arm at its start, a green ball at the goal; and the end-effector
paths of the first demonstrations, from light (start) to dark (goal).
"""

from pathlib import Path

import numpy as np
import pybullet as p
from PIL import Image
from tqdm import tqdm

import envs
from envs import panda
from envs.datasets import load_demos, load_queries

QUERY = 2  # its start and goal lie on two sides of the walls
NUM_DEMOS = 24
COLOURS = ((0.85, 0.30, 0.25), (0.20, 0.45, 0.80), (0.95, 0.65, 0.15), (0.25, 0.60, 0.35))
FOLDER = Path(__file__).parent / "pictures"


def save(pixels, name):
    # Twice the size, then averaged: PyBullet's software renderer has jagged edges.
    picture = Image.fromarray(pixels).resize((480, 360), Image.LANCZOS)
    picture.quantize(64).save(FOLDER / name, optimize=True)
    return picture


def draw_path(client, positions, colour):
    """A string of beads along end-effector positions (n, 3)."""
    for part in range(4):  # from light to dark
        shade = [(1 - 0.25 * (3 - part)) * c + 0.25 * (3 - part) for c in colour]
        beads = positions[part * len(positions) // 4 : (part + 1) * len(positions) // 4]
        if len(beads):
            bead = p.createVisualShape(
                p.GEOM_SPHERE, radius=0.008, rgbaColor=(*shade, 1), physicsClientId=client
            )
            p.createMultiBody(
                baseVisualShapeIndex=bead, batchPositions=beads.tolist(), physicsClientId=client
            )


def from_afar(client, width=960, height=720):
    """A picture of all the space that the end-effector reaches."""
    pixels = p.getCameraImage(
        width,
        height,
        p.computeViewMatrixFromYawPitchRoll((0.0, 0.0, 0.35), 3.0, 55, -28, 0, 2),
        p.computeProjectionMatrixFOV(50, width / height, 0.1, 10.0),
        lightDirection=(1.0, 1.0, 2.5),
        renderer=p.ER_TINY_RENDERER,
        physicsClientId=client,
    )[2]
    return np.reshape(pixels, (height, width, 4))[..., :3].astype(np.uint8)


def main():
    tasks = []
    for task in tqdm(envs.TASKS, unit="task"):
        env = envs.make(task, render_mode="rgb_array", render_size=(960, 720))
        query = load_queries(task)[QUERY]
        env.reset_specific(*query)
        tasks.append(np.asarray(save(env.render(), f"{task}.png")))
        demos = load_demos(task)
        for i in range(NUM_DEMOS):
            configurations = panda.denormalise(demos[i].states)
            colour = COLOURS[i % len(COLOURS)]
            draw_path(env.client, panda.forward_kinematics(configurations), colour)
        save(from_afar(env.client), f"{task}_demos.png")
        env.close()
    strip = Image.fromarray(np.concatenate(tasks, axis=1))
    strip.resize((strip.width // 2, strip.height // 2), Image.LANCZOS).quantize(64).save(
        FOLDER / "fixed_tasks.png", optimize=True
    )


if __name__ == "__main__":
    main()
