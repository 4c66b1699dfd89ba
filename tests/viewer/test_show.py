"""`roboarm show`: images and animations, the policy in them, and errors."""

import os

import numpy as np
import pytest
from PIL import Image
from straight_policy import save

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.queries import Query, load_queries, write_queries
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.motions.trajectories import load_joint_path, save_joint_path
from roboarm_nmp.viewer import images, show

SMALL = (96, 72)
SIZE = ["--size", "96", "72"]
BENT = np.array([0.0, -0.3, 0.0, -1.8, 0.0, 1.6, 0.0], np.float32)
AT_THE_SIDE = np.array([1.5, 0.6, 0.0, -1.8, 0.0, 1.6, 0.0], np.float32)


@pytest.fixture(scope="module")
def env():
    env = envs.make("no_obstacles", goal_type="combined")
    yield env
    env.close()


@pytest.fixture(autouse=True)
def few_frames(monkeypatch):
    monkeypatch.setattr(images, "MAX_FRAMES", 2)


def run(*arguments):
    return show.main([str(argument) for argument in arguments])


def pixels_of(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


# --- Images


def test_images_of_several_queries_form_a_grid(tmp_path, capsys):
    assert run("wall", "--output", tmp_path / "a.png", "--draws", 3, "--query", 5, *SIZE) == 0
    assert "test query 5 to 7" in capsys.readouterr().out
    grid = pixels_of(tmp_path / "a.png")
    assert grid.shape == (2 * 72, 2 * 96, 3)
    tiles = [grid[y : y + 72, x : x + 96] for y in (0, 72) for x in (0, 96)]
    with envs.make("wall", goal_type="combined") as env:
        for tile, number in zip(tiles, (5, 6, 7), strict=False):
            query = load_queries("wall")[number]
            assert np.array_equal(tile, images.render_query(env, query, SMALL))
    assert (tiles[3] == 255).all()


def test_what_was_left_out_of_a_cloud_is_counted(tmp_path, capsys):
    rng = np.random.default_rng(0)
    wall = rng.uniform((0.55, -0.4, 0.02), (0.56, 0.4, 0.6), (3000, 3))
    far = rng.uniform((0.5, -0.9, 2.0), (0.9, 0.9, 2.02), (500, 3))
    np.save(tmp_path / "cloud.npy", np.concatenate([wall, far]).astype(np.float32))
    save_joint_path(tmp_path / "a.csv", np.linspace(BENT, AT_THE_SIDE, 30), np.arange(30) / 30)
    cloud = ["--cloud", tmp_path / "cloud.npy", "--output", tmp_path / "a.png", *SIZE]
    assert run(*cloud, "--trajectory", tmp_path / "a.csv") == 0
    assert "500 outside the workspace" in capsys.readouterr().out
    assert pixels_of(tmp_path / "a.png").std() > 10
    assert run("wall", *cloud) == 2 and "wall has obstacles" in capsys.readouterr().err
    assert run("wall", "--units", "mm", "--output", "a.png") == 2
    assert "--units goes with --cloud" in capsys.readouterr().err


# --- Animations


def test_animation_shows_the_episode_of_a_policy(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(images, "MAX_FRAMES", 5)
    save(tmp_path / "policy.onnx")
    arguments = ["--query", 2, *SIZE, "--policy", tmp_path]
    assert run("wall", "--output", tmp_path / "a.gif", *arguments) == 0
    text = capsys.readouterr().out
    assert f"test query 2, {tmp_path}: reached the goal in " in text
    steps = int(text.split(" steps")[0].split()[-1])
    with Image.open(tmp_path / "a.gif") as animation:
        assert 5 <= animation.n_frames <= 6
        assert animation.info["duration"] == pytest.approx(1000 * -(-steps // 5) / 30, abs=10)


def test_demonstration_is_shown(tmp_path, capsys):
    recorded = load_demos("wall")[7]
    arguments = ["--policy", "demo", "--query", 7, *SIZE]
    assert run("wall", "--output", tmp_path / "a.gif", *arguments) == 0
    assert f"demonstration 7: {len(recorded.states) - 1} steps" in capsys.readouterr().out


# --- Trajectories


def test_saved_trajectory_plays_as_the_episode(tmp_path, capsys):
    file = tmp_path / "episode.csv"
    arguments = ["--query", 2, "--save-trajectory", file]
    assert run("wall", *arguments, "--output", tmp_path / "a.gif", *SIZE) == 0
    size = file.stat().st_size
    assert run("wall", *arguments) == 0  # without an animation
    output = capsys.readouterr().out
    assert f"{file}: written, wall, test query 2, go-to-goal: reached the goal in " in output
    assert file.stat().st_size == pytest.approx(size, rel=0.1)
    assert run("wall", "--trajectory", file, "--output", tmp_path / "b.gif", *SIZE) == 0
    steps = int(output.split(" steps")[0].split()[-1])
    assert f"{file}: {steps / 30:.1f} s, collision-free" in capsys.readouterr().out
    times, configurations = load_joint_path(file, PANDA)
    np.testing.assert_allclose(configurations[0], load_queries("wall")[2].start, atol=1e-6)
    np.testing.assert_allclose(times, np.arange(steps + 1) / 30)


def test_path_of_ones_own_is_played_with_its_collisions(tmp_path, capsys):
    file, gif = tmp_path / "mine.csv", ["--output", tmp_path / "a.gif"]
    inside = np.array([0.0, 1.2, 0.0, -1.0, 0.0, 1.6, 0.0])  # in the wall
    np.savetxt(file, [BENT, inside], delimiter=",", header="q1,q2,q3,q4,q5,q6,q7", comments="")
    assert run("wall", "--trajectory", file, *gif, *SIZE) == 0
    text = capsys.readouterr().out
    assert f"{file}: " in text and "in collision in " in text
    # With times, as long as they say: from 2 s to 3.5 s. Where scenes vary, in that of a query.
    rows = np.column_stack([[2.0, 3.5], [BENT, AT_THE_SIDE]])
    header = "time,q1,q2,q3,q4,q5,q6,q7"
    np.savetxt(file, rows, delimiter=",", header=header, comments="")
    query = ["--query", 6, "--split", "validation"]
    assert run("random_boxes_hard", "--trajectory", file, *gif, *SIZE, *query) == 0
    assert f"{file}: 1.5 s, " in capsys.readouterr().out


# --- Where the queries come from


def write_two_queries(task):
    """A query file beside a scene file: from BENT to AT_THE_SIDE, and back."""
    start, goal = np.stack([BENT, AT_THE_SIDE]), np.stack([AT_THE_SIDE, BENT])
    splits = {"test": (start, goal), "validation": (start + np.float32(0.1), goal)}
    write_queries(task.with_name("mine_queries.h5"), str(task), 0, splits, "a test", {})


def test_queries_are_random_without_a_query_file(tmp_path, capsys):
    task = tmp_path / "mine.yaml"
    task.write_text("obstacles: [sphere: {position: [0, 0.9, 0], radius: 0.1}]")
    shown = []
    for seed in (0, 0, 1):
        assert run(task, "--output", tmp_path / "a.png", "--seed", seed, *SIZE) == 0
        assert f"no query file: random queries of seed {seed}" in capsys.readouterr().out
        shown.append((tmp_path / "a.png").read_bytes())
    assert shown[0] == shown[1] != shown[2]
    # With a file beside it, those of the file.
    write_two_queries(task)
    assert run(task, "--output", tmp_path / "b.png", "--query", 1, *SIZE) == 0
    assert "test query 1" in capsys.readouterr().out
    with envs.make(str(task), goal_type="combined") as env:
        expected = images.render_query(env, Query(AT_THE_SIDE, BENT, env.scene), SMALL)
    assert np.array_equal(pixels_of(tmp_path / "b.png"), expected)


def test_scene_is_shown_without_queries_that_are_out_of_date(tmp_path, capsys):
    task = tmp_path / "mine.yaml"
    task.write_text("{}")
    write_two_queries(task)
    task.write_text("obstacles: [sphere: {position: [0.3, 0.5, 0.5], radius: 0.2}]")
    assert run(task, "--output", tmp_path / "a.png", *SIZE) == 0
    line, written = capsys.readouterr().out.splitlines()
    left_out = "its queries are out of date and left out: random queries of seed 0"
    assert line == f"{task}: {left_out}"
    assert "random query 0" in written


# --- What goes wrong


def test_errors_are_one_line_and_write_nothing(tmp_path, capsys, monkeypatch):
    unfit = save(tmp_path / "unfit.onnx", env={"goal_type": "ee"})
    (tmp_path / "bad.yaml").write_text("obstacles:\n  - bax: {}\n")
    (tmp_path / "full.yaml").write_text("obstacles: [sphere: {position: [0, 0, 0.3], radius: 0.3}]")
    before = sorted(os.listdir(tmp_path))
    monkeypatch.setattr("roboarm_nmp.envs.world.MAX_SAMPLING_TRIES", 5)
    png, gif = ["--output", tmp_path / "out.png"], ["--output", tmp_path / "out.gif"]
    many = len(load_queries("wall"))
    cases = [
        (["moon", *png], "unknown task 'moon': one of no_obstacles"),
        ([tmp_path / "bad.yaml", *png], "bad.yaml:2: unknown kind of obstacle bax"),
        ([tmp_path / "full.yaml", *png], "no feasible configuration"),
        (["wall"], "give --output FILE.png or --output FILE.gif; `roboarm view`"),
        (["wall", "--output", tmp_path / "out.jpg"], "must end in .png or .gif"),
        (["wall", *png, "--query", many], f"no test query {many}: the numbers are 0 to {many - 1}"),
        (["wall", *gif, "--draws", 2], "--draws goes with --output FILE.png"),
        (["wall", *gif, "--policy", unfit], "unfit.onnx: its input achieved_goal has the shape"),
        (["benchmaker_bookshelf_tall", *gif, "--policy", "demo"], "has no demonstrations"),
        (["wall", *gif, "--trajectory", tmp_path / "none.csv"], "none.csv: No such file"),
        (["wall", *gif, "--save-trajectory", tmp_path / "a.txt"], "must end in .csv, .npz"),
    ]
    for arguments, message in cases:
        assert run(*arguments) == 2, arguments
        output = capsys.readouterr().err
        assert message in output, arguments
        assert output.count("\n") == 1
    assert sorted(os.listdir(tmp_path)) == before
