"""`roboarm show` and `roboarm robot check` with other arms than the Panda."""

import runpy
import sys

import numpy as np
import pytest
from paths import ROOT
from PIL import Image

from roboarm_nmp.viewer import show

XARM6 = ROOT / "examples" / "robots" / "xarm6.yaml"


def test_command_shows_another_arm(tmp_path):
    path = tmp_path / "image.png"
    size = ["--size", "96", "72"]
    task = [f"no_obstacles@{XARM6}"]
    assert show.main([*task, "--output", str(path), *size]) == 0
    with Image.open(path) as image:
        assert np.asarray(image).std() > 10
    csv = tmp_path / "episode.csv"
    assert show.main([*task, "--save-trajectory", str(csv)]) == 0
    assert csv.read_text().splitlines()[0].startswith("time,q1,q2,q3,q4,q5,q6,action1")
    path.unlink()
    assert show.main([*task, "--trajectory", str(csv), "--output", str(path), *size]) == 0
    assert path.exists()


def test_robot_check_prints_the_pairs_and_draws_them(tmp_path, capsys, monkeypatch):
    image = tmp_path / "check.png"
    arguments = ["check", str(XARM6), "--configurations", "200", "--image", str(image)]
    monkeypatch.setattr(sys, "argv", ["robot", *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("roboarm_nmp.viewer.robot_check", run_name="__main__")
    assert ended.value.code == 0
    output = capsys.readouterr().out
    assert "pairs of links that may collide" in output and output.count("\nok ") == 4
    with Image.open(image) as drawn:
        assert drawn.size == (1080, 750)
