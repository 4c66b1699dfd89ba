"""`roboarm show` and `roboarm robot check` with other arms than the Panda."""

import runpy
import sys

import numpy as np
import pytest
from paths import ROOT
from PIL import Image

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.robots.urdf import robot_from_urdf
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.viewer import show

XARM6 = ROOT / "examples" / "robots" / "xarm6.yaml"
SHAPE = (
    '<{0}><origin xyz="0 0 {1}"/><geometry><cylinder radius="{2}" length="{3}"/></geometry></{0}>'
)


def arm_of_size(folder, size):
    """A `Robot` of two bars, each `size` metres long."""
    links = "".join(
        f'<link name="{name}">'
        + "".join(SHAPE.format(kind, size / 2, size / 20, 0.8 * size) for kind in kinds)
        + "</link>"
        for name, kinds in (
            ("base", ()),
            ("one", ("visual", "collision")),
            ("two", ("visual", "collision")),
        )
    )
    joints = "".join(
        f'<joint name="{number}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 {height}"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="50" velocity="2"/></joint>'
        for number, (parent, child, height) in enumerate([("base", "one", 0), ("one", "two", size)])
    )
    path = folder / f"{size}.urdf"
    path.write_text(f'<robot name="arm">{links}{joints}</robot>')
    return robot_from_urdf(path, end_effector="two", end_effector_position=(0, 0, size), gain=0.6)


def test_image_of_an_arm_of_any_size_has_it_whole_and_large(tmp_path):
    shares = []
    for size in (0.1, 0.5, 2.5):
        robot = arm_of_size(tmp_path, size)
        scene = Scene(table=None, floor=None, robot=robot)
        env = envs.RoboArmEnv(scene, goal_type="combined", render_mode="rgb_array")
        image = show.render_query(env, Query(np.zeros(2), np.array([0.5, 0.5]), scene), (120, 120))
        drawn = (image < 250).any(-1) | (image.max(-1) - image.min(-1) > 20)
        rows, columns = np.nonzero(drawn)
        assert rows.min() > 0 and columns.min() > 0
        assert rows.max() < 119 and columns.max() < 119
        shares.append(np.ptp(rows) / 120)
        env.close()
    assert min(shares) > 0.5


def test_command_shows_another_arm(tmp_path, capsys):
    path = tmp_path / "image.png"
    size = ["--size", "96", "72"]
    task = ["no_obstacles", "--robot", str(XARM6)]
    assert show.main([*task, "--output", str(path), *size]) == 0
    with Image.open(path) as image:
        assert np.asarray(image).std() > 10
    csv = tmp_path / "episode.csv"
    assert show.main([*task, "--save-trajectory", str(csv)]) == 0
    assert csv.read_text().splitlines()[0].startswith("time,q1,q2,q3,q4,q5,q6,action1")
    path.unlink()
    assert show.main([*task, "--trajectory", str(csv), "--output", str(path), *size]) == 0
    assert path.exists()
    assert show.main(["no_obstacles@a.yaml", "--robot", "b.yaml", "--output", str(path)]) == 2
    assert "names a robot already" in capsys.readouterr().err


def test_robot_check_prints_the_pairs_and_draws_them(tmp_path, capsys, monkeypatch):
    image, connected = tmp_path / "check.png", [p.isConnected(client) for client in range(100)]
    arguments = ["check", str(XARM6), "--configurations", "200", "--image", str(image)]
    monkeypatch.setattr(sys, "argv", ["robot", *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("roboarm_nmp.viewer.robot_check", run_name="__main__")
    assert ended.value.code == 0
    output = capsys.readouterr().out
    assert "pairs of links that may collide" in output and output.count("\nok ") == 4
    with Image.open(image) as drawn:
        pixels = np.asarray(drawn.convert("RGB")).astype(int)
    orange = (np.abs(pixels - (235, 120, 40)) < 5).all(-1)
    half = pixels.shape[1] // 2
    assert orange[300:, half:].sum() > 1000  # pairs
    assert connected == [p.isConnected(client) for client in range(100)]
