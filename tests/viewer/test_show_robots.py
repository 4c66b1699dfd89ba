"""`roboarm show` and `roboarm robot check` with other arms than the Panda."""

import runpy
import sys

import numpy as np
import pytest
from paths import ROOT
from PIL import Image

from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.viewer import robot_check, show

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
        runpy.run_path(robot_check.__file__, run_name="__main__")
    assert ended.value.code == 0
    output = capsys.readouterr().out
    assert "pairs of links that may collide" in output and output.count("\nok ") == 4
    with Image.open(image) as drawn:
        assert drawn.size == (1080, 750)


def test_robot_check_names_the_links_whose_checks_differ(monkeypatch):
    is_free = CollisionChecker.is_free
    monkeypatch.setattr(CollisionChecker, "is_free", lambda *states: ~is_free(*states))
    robot = load_robot(str(XARM6))
    differences = robot_check.compare_checks(robot, np.random.default_rng(0), 20).differences
    assert len(differences) == 20
    for name, distance in differences:
        link, _, other = name.partition(" and ")
        assert link in robot.link_names.values() and abs(distance) > 5e-5
        others = {"the table", "the floor", "the base", "a Box", *robot.link_names.values()}
        assert other.partition(" and ")[0] in others
