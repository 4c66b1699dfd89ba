"""`roboarm view` and `roboarm demo`: their errors, each in one line, and the replay."""

import contextlib
import signal
import socket
import subprocess
import sys

import pytest

from roboarm_nmp.viewer import app, demo

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
        (["wall", "--record", "replay.gif"], "--record must end in .html"),
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
