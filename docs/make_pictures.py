"""Render the pictures of the tasks in docs/pictures.

    python docs/make_pictures.py

For each task: one test query, the arm at its start, a green ball at the goal.
"""

from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

import envs
from envs.datasets import load_queries

QUERY = 2  # its start and goal lie on two sides of the walls
FOLDER = Path(__file__).parent / "pictures"


def main():
    pictures = {}
    for task in tqdm(envs.TASKS, unit="task"):
        env = envs.make(task, render_mode="rgb_array", render_size=(960, 720))
        env.reset_specific(*load_queries(task)[QUERY])
        # Twice the size, then averaged: PyBullet's software renderer has jagged edges.
        pictures[task] = Image.fromarray(env.render()).resize((480, 360), Image.LANCZOS)
        pictures[task].quantize(64).save(FOLDER / f"{task}.png", optimize=True)
        env.close()
    strip = Image.fromarray(np.concatenate([np.asarray(p) for p in pictures.values()], axis=1))
    strip.resize((strip.width // 2, strip.height // 2), Image.LANCZOS).quantize(64).save(
        FOLDER / "fixed_tasks.png", optimize=True
    )


if __name__ == "__main__":
    main()
