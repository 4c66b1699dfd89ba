"""Render the figures of the tasks in docs/figures.

    python docs/make_figures.py

For each task, `mixed_scenes` and `containers`: one test query (where scenes vary, six draws), the
arm at its start and as a ghost at the goal; and where the scene is fixed, the end-effector paths of
the first demonstrations, from light (start) to dark (goal). `task_gallery.webp` shows all tasks
with names, and `wide_families.webp` a scene of each family of wide scenes, which `--wide` renders
alone.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import demo_path, load_demos
from roboarm_nmp.datasets.queries import Query, load_queries
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.envs.scenes.wide_scenes.distribution import WideScenes
from roboarm_nmp.envs.scenes.wide_scenes.names import FAMILIES, HELD_OUT
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.viewer.images import render_query

SIZE = (480, 360)
QUERY = 2  # its start and goal lie on two sides of the walls
ROWS, COLUMNS = 2, 3  # of scenes that vary
GALLERY_COLUMNS, LABEL = 5, 22  # of all tasks; height (pixels) of names
NUM_DEMOS = 24
# Directions of view, (yaw, pitch) in degrees: from the front, the width of the gap is seen.
CAMERAS = dict.fromkeys(("double_walls", "double_walls_wide_gap"), (90, -20))
FAMILY_SEEDS = {}  # of figures of families of wide scenes, where the first one shows little
COLOURS = ((0.85, 0.30, 0.25), (0.20, 0.45, 0.80), (0.95, 0.65, 0.15), (0.25, 0.60, 0.35))
FOLDER = Path(__file__).parent / "figures"


def save(pixels, name):
    Image.fromarray(pixels).save(FOLDER / name, quality=65, method=6)


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


def save_gallery(tiles, file, columns=GALLERY_COLUMNS):
    """Images of one size in a grid, with their names: a dict from names to images."""
    height, width, _ = next(iter(tiles.values())).shape
    rows = -(-len(tiles) // columns)
    grid = Image.new("RGB", (columns * width, rows * (height + LABEL)), "white")
    draw, font = ImageDraw.Draw(grid), ImageFont.load_default(15)
    for i, (name, tile) in enumerate(tiles.items()):
        left = i % columns * width
        top = i // columns * (height + LABEL)
        grid.paste(Image.fromarray(tile), (left, top))
        draw.text((left + width // 2, top + height + 3), name, "black", font, anchor="ma")
    save(np.asarray(grid), file)


def save_wide_families():
    """A scene of each family, without the ground, which would hide too much."""
    tiles = {}
    for name in tqdm(FAMILIES, unit="family"):
        env = envs.RoboArmEnv(WideScenes((name,)), render_mode="rgb_array", goal_type="combined")
        rng = np.random.default_rng(FAMILY_SEEDS.get(name, 0))
        env.sample_scene(rng)
        query = env.sample_query(rng)
        obstacles = [o for o in env.scene.obstacles if not is_ground(o)]
        scene = replace(env.scene, obstacles=tuple(obstacles))
        pixels = render_query(env, Query(*query, scene), SIZE)
        tiles[name] = pixels[::2, ::2]
        env.close()
    held_out = {f"{name} (held out)": tiles.pop(name) for name in HELD_OUT}
    save_gallery(tiles | held_out, "wide_families.webp", 6)


def is_ground(obstacle):
    return isinstance(obstacle, Box) and min(obstacle.size[:2]) > 2.5


def main():
    gallery = {}
    for task in tqdm([*envs.TASKS, "mixed_scenes", "containers"], unit="task"):
        env = envs.make(task, render_mode="rgb_array", goal_type="combined")
        if not isinstance(envs.get_task(task).scene, Scene):
            pixels = []
            rng = np.random.default_rng(0)
            for _ in range(ROWS * COLUMNS):
                env.sample_scene(rng)
                query = Query(*env.sample_query(rng), env.scene)
                pixels.append(render_query(env, query, SIZE)[::2, ::2])
            height, width, channels = pixels[0].shape
            if task in envs.TASKS:
                gallery[task] = pixels[0]
            grid = np.reshape(pixels, (ROWS, COLUMNS, height, width, channels)).swapaxes(1, 2)
            save(grid.reshape(ROWS * height, COLUMNS * width, channels), f"{task}.webp")
            env.close()
            continue
        query = load_queries(task)[QUERY]
        pixels = render_query(env, query, SIZE, camera=CAMERAS.get(task))
        save(pixels, f"{task}.webp")
        gallery[task] = pixels[::2, ::2]
        if demo_path(task).exists():
            demos, everywhere = load_demos(task), []
            for i in range(NUM_DEMOS):
                positions = PANDA.forward_kinematics(PANDA.denormalise(demos[i].states))
                draw_path(env.client, positions, COLOURS[i % len(COLOURS)])
                everywhere.append(positions)
            pixels = render_query(env, query, SIZE, np.concatenate(everywhere))
            save(pixels, f"{task}_demos.webp")
        env.close()
    gallery = dict(sorted(gallery.items(), key=lambda item: item[0].startswith("random")))
    save_gallery(gallery, "task_gallery.webp")
    save_wide_families()


if __name__ == "__main__":
    save_wide_families() if "--wide" in sys.argv else main()
