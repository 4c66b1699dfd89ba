"""The viewer in a real browser: Debian's Chromium, driven by Playwright. Skipped without them."""

import contextlib
import io
import re
import shutil
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

from roboarm_nmp.envs.scenes.files import load_scene

pytest.importorskip("viser")
playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium"),
]
# Without a GPU, and without traffic of its own.
FLAGS = [
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox", "--disable-quic"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update"),
    "--disable-sync",
]
SIZE = {"width": 900, "height": 500}
CANVAS = "canvas[data-engine]"
TIMEOUT = 120  # s: a software renderer on a busy machine is slow


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@contextlib.contextmanager
def viewer(*arguments, cwd=None):
    """The command `roboarm view`, and its address."""
    port = str(free_port())
    command = [sys.executable, "-m", "roboarm_nmp", "view", *arguments, "--port", port, "--no-open"]
    process = subprocess.Popen(
        command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        line = ""
        while "http://" not in line:
            line = process.stdout.readline()
            assert line, process.stderr.read()
        yield line.split()[0], process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def open_page(browser, url, requests=None):
    """A page, once it has drawn something; `requests`, a list, gets the addresses it asks for."""
    page = browser.new_page(viewport=SIZE)
    page.set_default_timeout(1000 * TIMEOUT)
    if requests is not None:
        page.on("request", lambda request: requests.append(request.url))
    page.goto(url)
    page.wait_for_selector(CANVAS)
    # viser's note that there is no GPU hides the arm.
    page.add_style_tag(content=".mantine-Notifications-root { display: none }")
    return page


def screenshot(page):
    """The page as a float array (h, w, 3)."""
    with Image.open(io.BytesIO(page.screenshot())) as image:
        return np.asarray(image.convert("RGB")).astype(float)


def wait_for(condition):
    """Wait until a function returns a true value."""
    until = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < until, "it did not happen"
        time.sleep(0.2)


def text(page):
    return page.locator("body").inner_text()


def step_of(page):
    """The number of the step that the page shows; None where the episode is over."""
    found = re.search(r"step (\d+)", text(page))
    return found and int(found[1])


def test_arm_moves_and_an_edited_scene_is_saved(browser, tmp_path):
    with viewer("no_obstacles", "--speed", "0.1", cwd=tmp_path) as (url, process):
        page = open_page(browser, url)
        wait_for(lambda: (step_of(page) or 0) > 0)
        assert screenshot(page).std() > 10  # it is not blank
        page.get_by_role("button", name="Pause").click()

        # Add an obstacle, save the scene.
        page.get_by_text("sphere", exact=True).click()
        wait_for(lambda: "0: sphere" in page.content())
        page.get_by_role("button", name="Save the scene").click()
        wait_for((tmp_path / "my_scene.yaml").exists)
        assert len(load_scene(tmp_path / "my_scene.yaml").obstacles) == 1
        page.close()

        # The lost connection is one line, and so is Ctrl-C.
        assert process.stdout.readline() == "my_scene.yaml: written\n"
        assert url in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=TIMEOUT)
        assert process.returncode == 130
        assert errors.splitlines()[-1] == "interrupted; the same command starts again"
        assert "Traceback" not in output + errors


@pytest.mark.slow
def test_replay_plays_without_a_server(browser, tmp_path):
    path = tmp_path / "replay.html"
    command = [sys.executable, "-m", "roboarm_nmp", "view", "no_obstacles", "--record", str(path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert path.stat().st_size < 1_000_000
    requests = []
    page = open_page(browser, path.as_uri(), requests)
    images = [screenshot(page)]
    wait_for(lambda: images.append(screenshot(page)) or np.abs(images[-1] - images[0]).max() > 100)
    assert images[-1].std() > 10
    assert all(url.startswith(("file:", "data:", "blob:")) for url in requests), requests
    page.close()
