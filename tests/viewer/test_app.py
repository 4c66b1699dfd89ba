"""`roboarm view` and `roboarm demo`: their errors, each in one line, and the replay."""

import contextlib
import io
import signal
import socket
import subprocess
import sys
import tempfile
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from roboarm_nmp.envs.world import World
from roboarm_nmp.viewer import app, demo, images
from roboarm_nmp.viewer.simulation import PolicyArm

pytest.importorskip("viser")


@pytest.fixture(autouse=True)
def own_signals(monkeypatch):
    """Signals stay as they are in the test run."""
    monkeypatch.setattr(app, "end_with_one_line", lambda advice: None)


@contextlib.contextmanager
def port_in_use():
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def error_of(capfd, *arguments, main=app.main):
    """The one line on stderr of a command that ends with 2."""
    assert main([str(argument) for argument in arguments]) == 2
    output, errors = capfd.readouterr()
    assert output == "" and len(errors.splitlines()) == 1, errors
    return errors


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nothing"], "unknown task 'nothing'"),
        (["wall", "--policy", "nothing"], "no such policy: nothing"),
        (["wall", "--query", "10000"], "no test query 10000: the numbers are 0 to 9999"),
        (["three_shelves", "--policy", "demo"], "three_shelves has no demonstrations"),
        (["wall", "--trajectory", "a.csv"], "a.csv: No such file"),
    ],
)
def test_arguments_that_cannot_be_used_give_one_line(
    capfd, tmp_path, monkeypatch, arguments, words
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(app, "_server", lambda *arguments: pytest.fail("a server was started"))
    assert words in error_of(capfd, *arguments)
    assert not list(tmp_path.iterdir())


def test_port_in_use_gives_one_line(capfd):
    with port_in_use() as port:
        message = error_of(capfd, "--port", port, "--no-open", main=demo.main)
    assert f"port {port}" in message and "--port" in message


def test_missing_viser_gives_one_line_with_the_command_that_installs_it(capfd, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install viser" in error_of(capfd, "wall")


def test_sigterm_ends_the_command_with_one_line():
    with port_in_use() as port:
        pass
    command = [sys.executable, "-m", "roboarm_nmp", "view", "no_obstacles", "--no-open"]
    process = subprocess.Popen(
        [*command, "--port", str(port)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline().startswith("http://127.0.0.1")
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 143
    assert errors.splitlines() == ["terminated; the same command starts again"] and output == ""


def test_recordings_of_demonstrations_and_of_policies_are_written(capfd, tmp_path):
    path = tmp_path / "replay.html"
    arguments = ["wall", "--policy", "demo", "go-to-goal", "--query", "3", "--record", str(path)]
    assert app.main(arguments) == 0
    written, *arms = capfd.readouterr().out.splitlines()
    assert written.startswith(f"{path}: written")
    assert [arm.split(":")[0].strip() for arm in arms] == ["demonstration", "go-to-goal"]
    contents = path.read_text()
    assert "__VISER_EMBED_DATA__" in contents and len(contents) < 1_000_000


# --- What the page's controls do


@pytest.fixture(scope="module")
def page():
    args = app.Args(task="wall")
    simulation = app._simulation(args)
    for _ in range(2):
        simulation.add(PolicyArm("wall", "go-to-goal"))
    server = app._server("127.0.0.1", 0)
    choices = app._choices(args, simulation)[1]
    with tempfile.TemporaryDirectory(prefix=app.UPLOADS) as folder:
        yield app._Page(server, simulation, args, choices, lambda *_: None, folder)
    simulation.close()
    app._stop(server)


def event(value, client=None):
    """As viser's, of a control that a page has changed."""
    return SimpleNamespace(target=SimpleNamespace(value=value), client=client or object())


def do(page):
    page._do_work(0.0)
    page._update_controls()
    page._update_status()


def drop(page, name, contents):
    page._file_chosen(event(SimpleNamespace(name=name, content=contents)))
    do(page)


def test_dropped_scene_and_cloud_are_opened_and_a_bad_file_loses_nothing(page):
    before = page.simulation.query
    bad = [
        ("a.yaml", b"obstacles:\n  - bax: {}\n", ">a.yaml:2: unknown kind of obstacle bax"),
        ("a.docx", b"", "a.docx: a scene ends in .yaml"),
        ("a.npy", b"no", "a.npy"),
    ]
    for name, contents, message in bad:
        drop(page, name, contents)
        assert message in page._status.content and page._folder not in page._status.content
        assert page.simulation.query is before and page._opened is None
    drop(page, "a.yaml", b"obstacles: [sphere: {position: [0, 0.9, 0], radius: 0.1}]")
    args, simulation = page.run()
    assert len(simulation.query.scene.obstacles) == 1 and args.task.endswith("/a.yaml")
    simulation.close()
    page._opened, cloud = None, io.BytesIO()
    np.save(cloud, np.random.default_rng(0).uniform((0.5, -0.4, 0.1), (0.6, 0.4, 0.5), (3000, 3)))
    drop(page, "cloud.npy", cloud.getvalue())
    args, simulation = page.run()
    assert len(simulation.query.scene.points) > 100 and args.task == "no_obstacles"
    simulation.close()
    page._opened = None


def test_sliders_show_contacts_and_make_starts_and_goals(page):
    world = World(page.simulation.query.scene, drawn=False)
    page._angles_typed(event("0 0 0 -1 0 1.6 0"))
    do(page)
    for angle in (1.2, -1.0):  # of the second joint: into the wall, and back
        page._slider_moved(event(angle), 1)
        do(page)
        configuration = np.array(page._angles.value.split(", "), float)
        assert configuration.tolist() == [0, angle, 0, -1, 0, 1.6, 0] and not page.playing
        in_contact = world.in_collision(configuration)
        assert ("**contact**" in page._clearance.content) == in_contact == (angle > 0.0)
    world.close()
    page._use_pose("start")
    assert np.allclose(page.simulation.query.start, configuration, atol=1e-4)
    page._angles_typed(event("0, -0.5, 0, -2, 0, 1.6"))
    do(page)
    assert "joint angles must be 7 finite numbers" in page._clearance.content
    page._angles_typed(event("0 -0.5 0 -2 0 1.6 0"))
    do(page)
    assert page._sliders[3].value == -2.0
    page._use_pose("goal")
    assert np.allclose(page.simulation.query.goal, [0, -0.5, 0, -2, 0, 1.6, 0])
    page.simulation.select("test", 0)


def test_motion_is_exported_as_gif_with_all_arms_side_by_side(page, monkeypatch):
    monkeypatch.setattr(images, "MAX_FRAMES", 1)
    for _ in range(3):
        page.simulation.step()
    saved = {}
    client = SimpleNamespace(
        camera=SimpleNamespace(position=(2, 0, 1), look_at=(0, 0, 0.4)),
        send_file_download=lambda name, contents, **_: saved.update({name: contents}),
    )
    monkeypatch.setattr(app.threading.Thread, "start", app.threading.Thread.run)
    page._export_motion(client)
    with Image.open(io.BytesIO(saved["motion.gif"])) as animation:
        width, height = images.SIZE
        assert animation.size == (2 * width, height) and animation.n_frames == 2
