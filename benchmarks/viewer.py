"""Frames per second of the viewer's simulation and drawing on one core, with a page connected.

    python benchmarks/viewer.py

The pretrained point-cloud policy on test queries of `random_boxes_hard`: as it moves, while the
goal is dragged, and while an obstacle is dragged, a change in every frame. The browser, a headless
Chromium with a software renderer, has another core. (Install `.[test,viewer]` and Chromium.)
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import torch

from roboarm_nmp.viewer import app, demo
from roboarm_nmp.viewer.drawing import Drawing
from roboarm_nmp.viewer.simulation import PolicyArm, Simulation, task_episodes

FRAMES, PORT = 200, 8190
CORES = sorted(os.sched_getaffinity(0))
FLAGS = [
    *("--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--remote-debugging-port=0",  # or it ends
]


def move(simulation):
    """No edit: the next query where the episode is over."""
    if simulation.ended:
        simulation.select("test", simulation.number + 1)


def drag_goal(simulation):
    """Move the goal by 5 mm, to and fro."""
    position = simulation.robot.forward_kinematics(simulation.query.goal)
    simulation.move_goal(position + [0.0, 0.005 * np.sign(np.sin(time.monotonic())), 0.0])


def drag_obstacle(simulation):
    """Move an obstacle by 5 mm, to and fro."""
    box = simulation.query.scene.obstacles[0]
    x, y, z = box.position
    moved = (x, y + 0.005 * np.sign(np.sin(time.monotonic())), z)
    simulation.replace_obstacle(0, replace(box, position=moved))


def frames_per_second(server, simulation, drawing, edit):
    """Of so many frames, as fast as they go; and per second of processor time of this process."""
    simulation.select("test", 0)
    began = time.perf_counter(), time.process_time()
    for _ in range(FRAMES):
        edit(simulation)
        simulation.step()
        with server.atomic():
            drawing.update()
        time.sleep(0)  # the server's thread sends
    return FRAMES / (time.perf_counter() - began[0]), FRAMES / (time.process_time() - began[1])


def main():
    """Print a table."""
    argparse.ArgumentParser(description=__doc__.split("\n")[0]).parse_args()
    torch.set_num_threads(1)
    chromium = shutil.which("chromium") or sys.exit("there is no Chromium")
    server = app._server("127.0.0.1", PORT)
    simulation = Simulation(task_episodes(demo.TASK))
    simulation.add(PolicyArm(demo.TASK, demo.POLICY))
    simulation.select("test", 0)
    drawing = Drawing(server, simulation)
    drawing.update()
    browser = subprocess.Popen(
        [chromium, *FLAGS, f"http://127.0.0.1:{PORT}"], stderr=subprocess.DEVNULL
    )
    os.sched_setaffinity(browser.pid, CORES[1:] or CORES)
    try:
        while not server.get_clients():
            time.sleep(0.1)
        time.sleep(5.0)  # it reads the meshes
        for thread in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(thread), CORES[:1])
        for edit in (move, drag_goal, drag_obstacle):
            rate, of_processor = frames_per_second(server, simulation, drawing, edit)
            numbers = f"{rate:6.1f} frames/s, {of_processor:6.1f} per processor second"
            print(f"{edit.__name__:<14} {numbers}", flush=True)
        print(f"pages connected: {len(server.get_clients())}")
    finally:
        browser.kill()
        app._stop(server)


if __name__ == "__main__":
    main()
