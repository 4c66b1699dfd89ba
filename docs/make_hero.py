"""README's animation: the query of `roboarm demo` as the viewer shows it in headless Chromium.

    python docs/make_hero.py

It needs `.[test,viewer]` and Chromium, and takes minutes without a GPU. The left arm has the
pretrained point-cloud policy, the right one goes straight to the goal; red links are in contact.
"""

import io
import shutil
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from playwright.sync_api import sync_playwright
from tqdm import tqdm

from roboarm_nmp.utils.files import write_atomically
from roboarm_nmp.viewer import app, demo
from roboarm_nmp.viewer.drawing import Drawing
from roboarm_nmp.viewer.episodes import task_episodes
from roboarm_nmp.viewer.simulation import PolicyArm, Simulation

OUTPUT = Path(__file__).parent / "figures" / "hero.gif"
PORT, SIZE = 8191, (760, 400)
STEPS, COLOURS = 2, 128  # steps between two frames; colours
PAUSE = 1500  # ms, after the last frame
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
NAMES = ("policy that observes points", "straight to the goal")
EYE, TARGET = (2.6, 1.3, 1.35), (0.0, 1.1, 0.52)


def frames(server, page):
    """Images of the episode of the first arm."""
    simulation = Simulation(task_episodes(demo.TASK))
    for policy in (demo.POLICY, "go-to-goal"):
        simulation.add(PolicyArm(demo.TASK, policy))
    simulation.select("test", demo.QUERY)
    for arm, name in zip(simulation.arms, NAMES, strict=True):
        arm.name = name
    drawing = Drawing(server, simulation)
    drawing.show = {"goal"}
    server.initial_camera.position, server.initial_camera.look_at = EYE, TARGET
    server.initial_camera.fov = np.deg2rad(43)
    drawing.update()
    page.goto(f"http://127.0.0.1:{PORT}")
    page.add_style_tag(content=".mantine-Notifications-root { display: none }")
    page.wait_for_selector("canvas[data-engine]")
    page.wait_for_timeout(5000)
    [client] = server.get_clients().values()
    bar = tqdm(desc="rendering", disable=None)
    while True:
        drawing.update()
        server.flush()
        page.wait_for_timeout(1000)  # labels are drawn late
        image = Image.fromarray(client.get_render(SIZE[1], SIZE[0], transport_format="png"))
        white = Image.new("RGBA", image.size, "white")
        yield Image.alpha_composite(white, image.convert("RGBA")).convert("RGB")
        bar.update()
        if simulation.arms[0].ended:
            break
        for _ in range(STEPS):
            simulation.step()
    simulation.close()


def main():
    """Write the animation."""
    torch.set_num_threads(1)
    server = app._server("127.0.0.1", PORT)
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        width, height = SIZE
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(300_000)
        images = list(frames(server, page))
        browser.close()
    app._stop(server)
    # One palette and no dithering: still parts of the scene have the same pixels in all frames.
    palette = images[-1].quantize(COLOURS, Image.Quantize.MEDIANCUT)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    contents = io.BytesIO()
    duration = [round(1000 * STEPS / app.STEPS_PER_SECOND)] * (len(images) - 1) + [PAUSE]
    images[0].save(
        contents, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0
    )
    write_atomically(OUTPUT, contents.getbuffer())
    print(f"{OUTPUT}: written, {len(contents.getbuffer()) / 1000:.0f} kB, {len(images)} frames")


if __name__ == "__main__":
    main()
