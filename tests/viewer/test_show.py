"""viewer.show: its images and animations, the policy in them, and its errors."""

import os
import re
import socket
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from paths import ROOT
from PIL import Image
from torch import nn

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.queries import Query, load_queries, write_queries
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.motions import Presence
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene, Sphere
from roboarm_nmp.envs.tasks import TASKS, Task
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.motions.trajectories import load_joint_path
from roboarm_nmp.networks.exported_networks import save_network
from roboarm_nmp.policies.registry import find_policy, make_policy
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.viewer import demo, show

SMALL = (96, 72)
SIZE = ["--size", "96", "72"]
BENT = np.array([0.0, -0.3, 0.0, -1.8, 0.0, 1.6, 0.0], np.float32)
AT_THE_SIDE = np.array([1.5, 0.6, 0.0, -1.8, 0.0, 1.6, 0.0], np.float32)


@pytest.fixture(scope="module")
def env():
    env = env_of("no_obstacles")
    yield env
    env.close()


def env_of(task, goal_type="combined"):
    return envs.make(task, render_mode="rgb_array", goal_type=goal_type)


def green(pixels):
    """Which pixels are green rather than grey, brown or blue."""
    pixels = pixels.astype(int)
    return pixels[..., 1] > 30 + np.maximum(pixels[..., 0], pixels[..., 2])


def run(*arguments):
    return show.main([str(argument) for argument in arguments])


def frames_of(path):
    """The frames (n, h, w, 3) of an animation, and their durations in ms."""
    frames, durations = [], []
    with Image.open(path) as image:
        for number in range(image.n_frames):
            image.seek(number)
            frames.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
    return np.stack(frames), durations


# --- Images


def test_environment_without_render_mode_is_drawn_for_images():
    scene = Scene((Sphere((0.5, 0.3, 0.4), 0.1), Cylinder((0.5, -0.3, 0.3), 0.05, 0.3)))
    query, task = Query(BENT, BENT + 0.1, scene), "random_boxes_hard"
    plain, drawn = envs.make(task, goal_type="combined"), env_of(task)
    expected = show.render_query(drawn, query, SMALL)
    assert not np.array_equal(expected, show.render_query(drawn, Query(BENT, BENT, Scene()), SMALL))
    plain.reset_specific(*query)
    found = [show.render_query(plain, query, SMALL) for _ in range(2)]
    for one in found:
        different = (one != expected).any(-1) & ~green(expected)  # which is the goal's ball
        assert different.sum() < 20
    plain.close()
    drawn.close()


def test_image_shows_the_goal_as_a_ball_and_a_goal_configuration_as_a_ghost_too(env):
    ball = PANDA.forward_kinematics(AT_THE_SIDE).astype(np.float32)
    with_ghost = show.render_query(env, Query(BENT, AT_THE_SIDE, Scene()), (160, 120))
    position = env_of("no_obstacles", "ee")
    ball_only = show.render_query(position, Query(BENT, ball, Scene()), (160, 120))
    same = show.render_query(position, Query(BENT, AT_THE_SIDE, Scene()), (160, 120))
    np.testing.assert_array_equal(ball_only, same)
    position.close()
    assert with_ghost.shape == ball_only.shape == (120, 160, 3)
    assert with_ghost.dtype == ball_only.dtype == np.uint8
    assert 5 < green(ball_only).sum() < 60
    assert green(with_ghost).sum() > 300
    # The other way round, the ghost is where the arm was.
    swapped = show.render_query(env, Query(AT_THE_SIDE, BENT, Scene()), (160, 120))
    assert (
        np.abs(np.argwhere(green(with_ghost)).mean(0) - np.argwhere(green(swapped)).mean(0)).max()
        > 5
    )


def test_obstacle_in_front_hides_the_ghost_from_one_side_only(env, monkeypatch):
    half = np.deg2rad(-35.0 / 2)  # turned to the first of the camera's places
    wall = Box((0.8, -0.56, 0.7), (0.02, 2.4, 2.4), (0.0, 0.0, np.sin(half), np.cos(half)))
    query = Query(BENT, AT_THE_SIDE, Scene((wall,), None, None))
    assert green(show.render_query(env, query, SMALL)).sum() > 20
    monkeypatch.setattr(show, "YAWS", show.YAWS[:1])
    assert green(show.render_query(env, query, SMALL)).sum() == 0


def test_camera_is_as_near_as_the_whole_scene_allows(env):
    scene = Scene(
        (Box((1.3, 0.0, 0.1), (1.2, 1.0, 1.6)), Sphere((-0.5, 0.9, 0.3), 0.1)), None, None
    )
    # Corners of the box and the sphere's ends, by hand.
    points = [[x, y, z] for x in (0.7, 1.9) for y in (-0.5, 0.5) for z in (-0.7, 0.9)]
    points += [[-0.6, 0.9, 0.3], [-0.5, 1.0, 0.3], [-0.5, 0.9, 0.4]]
    env.set_scene(scene)
    for slopes in ((0.5, 0.4), (0.2, 0.6)):
        camera = show._camera(env, show._extent(env, [BENT, AT_THE_SIDE]), slopes)
        view = p.computeViewMatrixFromYawPitchRoll(
            camera.target.tolist(), camera.distance, camera.yaw, camera.pitch, 0, 2
        )
        for configuration in (BENT, AT_THE_SIDE):
            points.append(PANDA.forward_kinematics(configuration))
        homogeneous = np.column_stack([points, np.ones(len(points))])
        projected = homogeneous @ np.reshape(view, (4, 4))
        projected = projected[:, :2] / -projected[:, 2:3] / slopes
        assert 0.8 < np.abs(projected).max() < 1
    env.set_scene(Scene())


def test_camera_is_where_it_is_told_to_be(env):
    query = Query(BENT, AT_THE_SIDE, Scene())

    def ball(camera):
        """Row and column of the goal's ball in an image of 192 x 144 pixels; its pixels."""
        goal = PANDA.forward_kinematics(AT_THE_SIDE).astype(np.float32)
        image = show.render_query(position, Query(BENT, goal, Scene()), (192, 144), (), camera)
        places = np.argwhere(green(image))
        return places.mean(0), len(places)

    position = env_of("no_obstacles", "ee")
    # The goal is to the arm's left (+y), in front of it (+x) only a little.
    x, y, z = PANDA.forward_kinematics(AT_THE_SIDE)
    assert y > 0.3 > x > -0.1
    (_, front), _ = ball("front")
    (_, side), _ = ball("side")
    (top_row, top), near = ball("top")
    assert front > 110 and abs(side - 96) < 40 and top < 80 and abs(top_row - 72) < 40
    # Numbers: yaw 90 is the front; twice as far away, the ball is smaller and nearer to the middle.
    (_, close), large = ball((2.0, 90.0, -15.0))
    (_, far), small = ball((4.0, 90.0, -15.0))
    assert close > far > 96 and large > 1.5 * small
    position.close()
    images = [show.render_query(env, query, SMALL, (), view) for view in (None, "front", "top")]
    assert not np.array_equal(images[0], images[1]) and not np.array_equal(*images[1:])


def test_camera_is_where_obstacles_do_not_hide_the_arm(env):
    views = {}
    for task in ("boxes", "benchmaker_bookshelf_tall", "benchmaker_bookshelf_thin"):
        env.set_scene(TASKS[task].scene)
        views[task] = show._camera(env, np.zeros((1, 3)), (0.5, 0.5)).yaw
    env.set_scene(TASKS["wall"].scene)
    yaws = set()
    for query in load_queries("wall")[:5]:
        env.reset_specific(*query)
        yaws.add(show._camera(env, np.zeros((1, 3)), (0.5, 0.5)).yaw)
    assert len(yaws) == 1
    env.set_scene(Scene())
    # From behind the arm: the shelves stand in front of it.
    assert views == {
        "boxes": 55.0,
        "benchmaker_bookshelf_tall": -55.0,
        "benchmaker_bookshelf_thin": -55.0,
    }


def test_images_of_several_queries_form_a_grid(tmp_path, capsys):
    assert run("wall", "--output", tmp_path / "a.png", "--draws", 3, "--query", 5, *SIZE) == 0
    assert "test query 5 to 7" in capsys.readouterr().out
    grid = np.asarray(Image.open(tmp_path / "a.png"))
    assert grid.shape == (2 * 72, 2 * 96, 3)
    tiles = [grid[y : y + 72, x : x + 96] for y in (0, 72) for x in (0, 96)]
    env = env_of("wall")
    queries = load_queries("wall")
    for tile, number in zip(tiles, (5, 6, 7), strict=False):
        assert np.array_equal(tile, show.render_query(env, queries[number], SMALL))
        assert green(tile).any()
    env.close()
    assert not np.array_equal(tiles[0], tiles[1]) and (tiles[3] == 255).all()


# --- Animations


class Straight(nn.Module):
    """The go-to-goal policy as a network, for goals that are configurations."""

    def forward(self, observation, achieved_goal, desired_goal):
        return torch.clamp(desired_goal - observation[:, :7], -1, 1)


class NoAction(nn.Module):
    def forward(self, observation, achieved_goal, desired_goal):
        return observation + 0 * (achieved_goal + desired_goal).sum(1, keepdim=True)


def save(path, module=None, **metadata):
    sizes = {"observation": 10, "achieved_goal": 7, "desired_goal": 7}
    inputs = {name: torch.zeros(1, size) for name, size in sizes.items()}
    metadata = {"kind": "policy", "task": "wall", "env": {"goal_type": "config"}} | metadata
    save_network(path, module or Straight(), inputs, metadata)
    return path


def test_animation_has_as_many_frames_as_steps_or_as_allowed(tmp_path, capsys, monkeypatch):
    save(tmp_path / "policy.pt")
    arguments = ["--query", 2, *SIZE]
    assert run("wall", "--output", tmp_path / "a.gif", "--policy", tmp_path, *arguments) == 0
    text = capsys.readouterr().out
    assert f"test query 2, {tmp_path}: reached the goal in " in text
    steps = int(text.split(" steps")[0].split()[-1])
    stride = -(-steps // show.MAX_FRAMES)
    frames, durations = frames_of(tmp_path / "a.gif")
    assert frames.shape == (-(-steps // stride) + 1, 72, 96, 3)
    assert len(frames) > 10 and durations[0] == pytest.approx(1000 * stride / 30, abs=10)
    assert durations[-1] == 1000 * show.PAUSE
    changes = np.abs(np.diff(frames.astype(int), axis=0)).sum((1, 2, 3))
    assert (changes > 0).mean() > 0.9
    still = show.render_query(env_of("wall"), load_queries("wall")[2], SMALL)
    assert green(frames[0]).sum() == pytest.approx(green(still).sum(), rel=0.5)

    # Fewer frames of more steps each.
    monkeypatch.setattr(show, "MAX_FRAMES", 4)
    assert run("wall", "--output", tmp_path / "b.gif", *arguments) == 0
    assert "test query 2, go-to-goal: reached the goal in " in capsys.readouterr().out
    few, _ = frames_of(tmp_path / "b.gif")
    assert 4 <= len(few) <= 5


def test_obstacles_move_in_an_animation():
    """A box that disappears after 1 s is not in the image of that time."""
    env = env_of("no_obstacles")
    box = Box((0.6, -0.3, 0.2), (0.2, 0.2, 0.2), motion=Presence(((0.0, 1.0),)))
    query = Query(BENT, BENT, Scene((box,)))
    options = {"times": (0.0, 1.0), "size": SMALL}
    there, gone = show.render_configurations(env, query, [BENT, BENT], **options)
    still = Query(BENT, BENT, Scene((replace(box, motion=None),)))
    same, without = show.render_configurations(env, still, [BENT, BENT], size=SMALL)
    assert np.array_equal(there, same) and not np.array_equal(gone, without)
    env.close()


def test_random_actions_depend_on_the_seed(tmp_path, monkeypatch):
    monkeypatch.setattr(show, "MAX_FRAMES", 3)
    files = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        files.append(tmp_path / f"{name}.gif")
        policy = ["--policy", "random", "--seed", seed]
        assert run("no_obstacles", "--output", files[-1], *policy, *SIZE) == 0
    first, same, other = (file.read_bytes() for file in files)
    assert first == same != other


@pytest.mark.parametrize(
    ("policy", "contact"),
    [
        ("go-to-goal", "with contact"),
        ("via-points", "collision-free"),
        ("planner", "collision-free"),
        ("bc-config-double_walls-s1", "with contact"),
    ],
)
def test_outcome_of_a_policy_is_printed(policy, contact, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(show, "MAX_FRAMES", 1)
    # Straight to this goal the arm slides along a wall; there is a way around.
    arguments = ["--policy", policy, "--query", 11, "--split", "validation", *SIZE]
    assert run("double_walls", "--output", tmp_path / "a.gif", *arguments) == 0
    text = capsys.readouterr().out
    assert f"{policy}: reached the goal in " in text and contact in text


def test_animation_of_a_policy_with_a_safety_filter(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(show, "MAX_FRAMES", 1)
    policy = "dagger-combined-point_cloud-random_boxes_hard-s1"
    arguments = ["--policy", policy, "--query", 1, "--split", "validation", *SIZE]
    assert run("random_boxes_hard", "--output", tmp_path / "a.gif", *arguments) == 0
    text = capsys.readouterr().out
    assert f"{policy}: reached the goal in " in text and "collision-free" in text


def test_first_animation_of_the_quickstart_is_collision_free(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(show, "MAX_FRAMES", 1)
    monkeypatch.chdir(tmp_path)
    commands = re.findall(
        r"^roboarm show (.* --output \S+\.gif)", (ROOT / "docs/quickstart.md").read_text(), re.M
    )
    assert run(*commands[0].split(), *SIZE) == 0
    text = capsys.readouterr().out
    assert "reached the goal" in text and "collision-free" in text


def test_policy_in_the_animation_of_the_readme_is_collision_free():
    """docs/make_hero.py shows the query of `roboarm demo`."""
    policy, arguments = find_policy(demo.POLICY)
    env, query = envs.make(demo.TASK, **arguments), load_queries(demo.TASK)[demo.QUERY]
    trajectory = rollout(env, query, make_policy(policy, env)(demo.QUERY, query).act)
    assert trajectory.success and not trajectory.collides
    env.close()


def test_demonstration_is_shown(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(show, "MAX_FRAMES", 3)
    demo = load_demos("wall")[7]
    arguments = ["--policy", "demo", "--query", 7, *SIZE]
    assert run("wall", "--output", tmp_path / "a.gif", *arguments) == 0
    assert f"demonstration 7: {len(demo.states) - 1} steps" in capsys.readouterr().out
    frames, _ = frames_of(tmp_path / "a.gif")
    assert len(frames) in (4, 5) and green(frames[0]).sum() > 2 * green(frames[-1]).sum()
    # The still image is of the demonstration's query.
    assert run("wall", "--output", tmp_path / "a.png", *arguments) == 0
    image = show.render_query(env_of("wall"), Query(demo.start, demo.goal, demo.scene), SMALL)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), image)


def test_ghost_is_left_out_where_the_goal_is_a_position(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(show, "MAX_FRAMES", 1)

    def greens(*flags):
        suffix = ".gif" if "--gif" in flags else ".png"
        arguments = [flag for flag in flags if flag != "--gif"]
        assert run("wall", "--output", tmp_path / f"a{suffix}", *arguments, *SIZE) == 0
        return green(np.asarray(Image.open(tmp_path / f"a{suffix}").convert("RGB"))).sum()

    assert greens("--goal-type", "ee") < 40 < 150 < greens() == greens("--goal-type", "config")
    # A trained policy has a goal type of its own.
    assert greens("--policy", "sac-ee-wall-p1-s1") < 40
    assert greens("--policy", "sac-ee-wall-p1-s1", "--gif") < 40
    wrong = ["--policy", "sac-ee-wall-p1-s1", "--goal-type", "config"]
    assert run("wall", "--output", tmp_path / "b.gif", *wrong) == 2
    assert "was trained with the goal type 'ee'" in capsys.readouterr().err


# --- The camera


def test_camera_flag_takes_a_name_or_three_numbers(tmp_path):
    images = []
    for name, camera in (("a", ["top"]), ("b", [2.5, 90, -15]), ("c", [2.5, -90, -15]), ("d", [])):
        flags = ["--camera", *camera] if camera else []
        assert run("wall", "--output", tmp_path / f"{name}.png", *SIZE, *flags) == 0
        images.append(np.asarray(Image.open(tmp_path / f"{name}.png")))
    query = load_queries("wall")[0]
    env = env_of("wall")
    for image, view in zip(images, ("top", (2.5, 90, -15), (2.5, -90, -15), None), strict=True):
        np.testing.assert_array_equal(image, show.render_query(env, query, SMALL, (), view))
    env.close()
    assert len({image.tobytes() for image in images}) == 4


# --- Trajectories


def test_saved_trajectory_plays_as_the_episode(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(show, "MAX_FRAMES", 4)
    monkeypatch.delenv("DISPLAY", raising=False)
    for ending in (".csv", ".npz", ".yaml"):
        file = tmp_path / f"episode{ending}"
        arguments = ["--query", 2, "--save-trajectory", file]
        assert run("wall", *arguments, "--output", tmp_path / "a.gif", *SIZE) == 0
        episode = file.read_bytes()
        assert run("wall", *arguments) == 0  # without a window
        output = capsys.readouterr().out
        assert f"{file}: written, wall, test query 2, go-to-goal: reached the goal in " in output
        assert len(file.read_bytes()) == pytest.approx(len(episode), rel=0.1)
        assert run("wall", "--trajectory", file, "--output", tmp_path / "b.gif", *SIZE) == 0
        steps = int(output.split(" steps")[0].split()[-1])
        assert f"{file}: {steps / 30:.1f} s, collision-free" in capsys.readouterr().out
        (played, durations), (shown, before) = (frames_of(tmp_path / f"{n}.gif") for n in "ba")
        assert durations == before
        # The same arm; the ghost stands at the end of the file, a little off the goal.
        assert np.mean(np.abs(played.astype(int) - shown.astype(int)).max(-1) > 20) < 0.02
        times, configurations = load_joint_path(file, PANDA)
        query = load_queries("wall")[2]
        np.testing.assert_allclose(configurations[0], query.start, atol=1e-6)
        np.testing.assert_allclose(times, np.arange(steps + 1) / 30)


def test_path_of_ones_own_is_played_with_its_collisions(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(show, "MAX_FRAMES", 2)
    file, gif = tmp_path / "mine.csv", ["--output", tmp_path / "a.gif"]
    inside = np.array([0.0, 1.2, 0.0, -1.0, 0.0, 1.6, 0.0])  # in the wall
    np.savetxt(file, [BENT, inside], delimiter=",", header="q1,q2,q3,q4,q5,q6,q7", comments="")
    assert run("wall", "--trajectory", file, *gif, *SIZE) == 0
    text = capsys.readouterr().out
    assert f"{file}: " in text and "in collision in " in text
    assert run("no_obstacles", "--trajectory", file, "--output", tmp_path / "a.png", *SIZE) == 0
    # With times, as long as they say: from 2 s to 3.5 s.
    rows = np.column_stack([[2.0, 3.5], [BENT, AT_THE_SIDE]])
    header = "time,q1,q2,q3,q4,q5,q6,q7"
    np.savetxt(file, rows, delimiter=",", header=header, comments="")
    assert run("no_obstacles", "--trajectory", file, *gif, *SIZE) == 0
    assert f"{file}: 1.5 s, collision-free" in capsys.readouterr().out
    # Where scenes vary, in that of a query.
    other = ["--query", 6, "--split", "validation"]
    assert run("random_boxes_hard", "--trajectory", file, *gif, *SIZE, *other) == 0


# --- Where the queries come from


def write_two_queries(task):
    """A query file beside a scene file: from BENT to AT_THE_SIDE, and back."""
    start, goal = np.stack([BENT, AT_THE_SIDE]), np.stack([AT_THE_SIDE, BENT])
    splits = {"test": (start, goal), "validation": (start + np.float32(0.1), goal)}
    write_queries(task.with_name("mine_queries.h5"), str(task), 0, splits, "a test", {})


def test_queries_are_random_without_a_query_file(tmp_path, capsys):
    (tmp_path / "mine.yaml").write_text("obstacles: [sphere: {position: [0, 0.9, 0], radius: 0.1}]")
    task = tmp_path / "mine.yaml"
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        assert run(task, "--output", tmp_path / f"{name}.png", "--seed", seed, *SIZE) == 0
        assert f"no query file: random queries of seed {seed}" in capsys.readouterr().out
    a, b, c = ((tmp_path / f"{name}.png").read_bytes() for name in "abc")
    assert a == b != c
    # With a file beside it, those of the file.
    write_two_queries(task)
    assert run(task, "--output", tmp_path / "d.png", "--query", 1, *SIZE) == 0
    assert "test query 1" in capsys.readouterr().out
    env = env_of(str(task))
    expected = show.render_query(env, Query(AT_THE_SIDE, BENT, env.scene), SMALL)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "d.png")), expected)


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
    pixels = np.asarray(Image.open(tmp_path / "a.png")).astype(int)
    assert (pixels[..., 2] > 30 + pixels[..., 0]).sum() > 100  # the sphere is blue


class OneSphere:
    """A distribution of scenes."""

    base = Scene()

    def sample(self, rng):
        return Scene((Sphere((rng.uniform(-1, 1), 0.9, 0.3), 0.1),))


def test_queries_of_varying_scenes_show_their_scenes(tmp_path, monkeypatch):
    monkeypatch.setitem(TASKS, "one_sphere", Task(OneSphere(), "for a test"))
    assert run("one_sphere", "--output", tmp_path / "a.png", "--draws", 2, *SIZE) == 0
    grid = np.asarray(Image.open(tmp_path / "a.png")).astype(int)
    blue = grid[..., 2] > 30 + grid[..., 0]
    columns = [np.argwhere(half)[:, 1].mean() for half in (blue[:, :96], blue[:, 96:])]
    assert abs(columns[0] - columns[1]) > 3


# --- The window


@pytest.fixture
def window(monkeypatch):
    """The window's loop without a window; returns the sleeps that it makes between episodes."""
    sleeps = []
    make = show.envs.make

    def without_window(task, render_mode, **arguments):
        assert render_mode == "human"
        sleeps.append(make(task, **arguments))
        return sleeps[0]

    def camera(physicsClientId):
        return [640, 480, None, np.eye(4).ravel().tolist()]

    monkeypatch.setattr(show, "why_no_window", lambda: None)
    monkeypatch.setattr(show.envs, "make", without_window)
    monkeypatch.setattr(show.p, "getDebugVisualizerCamera", camera)
    return sleeps


def test_window_continues_until_ctrl_c(window, tmp_path, capsys, monkeypatch):
    def sleep(seconds):
        window.append(seconds)
        if len(window) == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr(show.time, "sleep", sleep)
    (tmp_path / "mine.yaml").write_text("{}")
    write_two_queries(tmp_path / "mine.yaml")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "mine.yaml", "--query", 1)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Ctrl-C ends")
    assert [line.split(",")[0] for line in lines[1:]] == [f"test query {i}" for i in (1, 0, 1)]
    assert window[1:] == [show.PAUSE] * 3


def test_display_that_does_not_answer_is_an_error(monkeypatch, capsys):
    monkeypatch.setattr("roboarm_nmp.envs.world.DISPLAY_SECONDS", 2)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert port > 6000  # a display's number is that of its port, less 6000
        monkeypatch.setenv("DISPLAY", f"127.0.0.1:{port - 6000}")
        began = time.monotonic()
        assert run("wall") == 2
        assert time.monotonic() - began < 10
    assert f"DISPLAY is 127.0.0.1:{port - 6000}, which " in capsys.readouterr().err
    env = envs.make("wall", render_mode="human")  # warns
    env.reset(seed=0)
    env.close()


def test_window_ends_with_escape(window, monkeypatch):
    monkeypatch.setattr(show.time, "sleep", lambda seconds: p.disconnect(window[0].client))
    assert run("wall", "--policy", "demo") == 0


# --- What goes wrong


def test_errors_are_one_line_and_write_nothing(tmp_path, capsys, monkeypatch):
    def never(*arguments):
        raise AssertionError("work was done")

    monkeypatch.setattr(show, "_shoot", never)
    monkeypatch.delenv("DISPLAY", raising=False)
    policy = save(tmp_path / "policy.pt")
    (tmp_path / "broken.pt").write_bytes(policy.read_bytes()[:500])
    encoder = save(tmp_path / "encoder.pt", kind="encoder")
    unfit = save(tmp_path / "unfit.pt", env={"goal_type": "ee"})
    no_action = save(tmp_path / "no_action.pt", NoAction())
    strange = save(tmp_path / "strange.pt", env={"goal_type": "poses"})
    (tmp_path / "bad.yaml").write_text("obstacles:\n  - bax: {}\n")
    (tmp_path / "full.yaml").write_text("obstacles: [sphere: {position: [0, 0, 0.3], radius: 0.3}]")
    (tmp_path / "empty").mkdir()
    before = sorted(os.listdir(tmp_path))
    monkeypatch.setattr("roboarm_nmp.envs.world.MAX_SAMPLING_TRIES", 5)
    png, gif = ["--output", tmp_path / "out.png"], ["--output", tmp_path / "out.gif"]
    many = len(load_queries("wall"))
    not_a_scene = "scene files are .yaml or .scene (docs/customise/scene.md), got "
    cases = [
        (["moon", *png], "unknown task 'moon': one of no_obstacles"),
        *((["part" + kind, *png], f"{not_a_scene}part{kind}") for kind in (".stl", ".ply", ".obj")),
        ([tmp_path / "a.txt", *png], f"{not_a_scene}{tmp_path / 'a.txt'}"),
        ([tmp_path / "empty", *png], f"{not_a_scene}{tmp_path / 'empty'}"),
        ([tmp_path / "bad.yaml", *png], "bad.yaml:2: unknown kind of obstacle bax"),
        ([tmp_path / "none.yaml", *png], "none.yaml: No such file"),
        ([tmp_path / "full.yaml", *png], "no feasible configuration"),
        (["wall"], "a window needs a display (DISPLAY is not set); --output FILE.png"),
        (["wall", "--output", tmp_path / "out.jpg"], "must end in .png or .gif"),
        (["wall", "--output", tmp_path / "none" / "out.png"], "cannot write"),
        (["wall", *png, "--query", many], f"no test query {many}: the numbers are 0 to {many - 1}"),
        (["wall", *png, "--query", many - 1, "--draws", 2], f"no test query {many}"),
        (["wall", *png, "--query", -1], "--query must be at least 0, got -1"),
        (["wall", *png, "--draws", 0], "--draws must be at least 1, got 0"),
        (["wall", *gif, "--draws", 2], "--draws goes with --output FILE.png"),
        (["wall", *png, "--seed", -1], "--seed must be in [0, 2^32)"),
        (["wall", *png, "--size", 0, 10], "--size must be in [1, 4096], got 0"),
        (["wall", *png, "--split", "original"], "has no original queries"),
        (["wall", *gif, "--policy", "go-to-gaol"], "no such policy: go-to-gaol"),
        (["wall", *gif, "--policy", tmp_path / "empty"], "no such policy"),
        (["wall", *gif, "--policy", tmp_path / "broken.pt"], "broken.pt: not a network file"),
        (["wall", *gif, "--policy", encoder], "encoder.pt: a network, but not a policy"),
        (["wall", *gif, "--policy", unfit], "unfit.pt: aten.sub.Tensor failed"),
        (["wall", *gif, "--policy", no_action], "no_action.pt: its output is not float32"),
        (["wall", *gif, "--policy", strange], "goal_type must be one of"),
        (["benchmaker_bookshelf_tall", *gif, "--policy", "demo"], "has no demonstrations"),
        (["wall", *png, "--camera", 0, 90, -15], "--camera DISTANCE YAW PITCH: at most 15 m"),
        (["wall", *png, "--camera", 2, 90, -95], "-90 to 90 degrees, got 2 90 -95"),
        (["wall", *gif, "--trajectory", tmp_path / "none.csv"], "none.csv: No such file"),
        (["wall", *gif, "--trajectory", policy], "a trajectory's file must end in .csv, .npz"),
        (["wall", *gif, "--trajectory", "a.csv", "--policy", "planner"], "give one of them"),
        (["wall", *png, "--trajectory", "a.csv", "--draws", 2], "not with --trajectory"),
        (["wall", *gif, "--save-trajectory", tmp_path / "a.txt"], "must end in .csv, .npz"),
        (["wall", *png, "--save-trajectory", tmp_path / "a.csv"], "--output FILE.gif, or without"),
        (["wall", "--save-trajectory", tmp_path / "none" / "a.csv"], "cannot write"),
        (["wall", "--policy", "demo", "--save-trajectory", tmp_path / "a.csv"], "with a policy"),
    ]
    for arguments, message in cases:
        assert run(*arguments) == 2, arguments
        output = capsys.readouterr().err
        assert message in output, arguments
        assert output.startswith("error: ") and output.count("\n") == 1
    assert sorted(os.listdir(tmp_path)) == before


def test_old_image_stays_until_the_new_one_is_whole(tmp_path, capsys, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")

    def full(descriptor):
        raise OSError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(
            os, "fsync", full
        )  # after a part of the image was written to a temporary file
        assert run("wall", "--output", path, *SIZE) == 2
    assert "the disk is full" in capsys.readouterr().err
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.png"]
    assert run("wall", "--output", path, *SIZE) == 0
    assert path.read_bytes().startswith(b"\x89PNG") and os.listdir(tmp_path) == ["a.png"]


def test_interrupt_writes_nothing(tmp_path, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(show, "_shoot", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run("wall", "--output", tmp_path / "a.png", *SIZE)
    assert os.listdir(tmp_path) == []


def test_images_of_tasks_do_not_import_torch(tmp_path):
    code = (
        "import sys; from roboarm_nmp.viewer import show; code = show.main(sys.argv[1:]);"
        "assert 'torch' not in sys.modules; sys.exit(code)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, "wall", "--output", str(tmp_path / "a.png"), *SIZE],
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert f"{tmp_path / 'a.png'}: written, wall, test query 0" in result.stdout
