"""docs/customise/scene.md from top to bottom with tiny numbers, and what it says of errors."""

import json
import math
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from paths import ROOT
from PIL import Image
from trainers import outcome_of, roboarm, run_here, short_evaluations

from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.scenes.files import load_scene
from roboarm_nmp.envs.scenes.primitives import FLOOR, TABLE

PAGE = (ROOT / "docs/customise/scene.md").read_text()
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```", PAGE, re.S | re.M)
COMMANDS = [
    line.partition("#")[0].strip()
    for kind, text in BLOCKS
    for line in text.splitlines()
    if kind == "" and line.startswith(("python ", "roboarm "))
]
COMMANDS = [command for command in COMMANDS if "roboarm view" not in command]  # in the browser
YAML = next(text for kind, text in BLOCKS if kind == "yaml")
POSTS = [text for kind, text in BLOCKS if kind == "python"][-1]

# Numbers of the page -> of this test, and flags that the page leaves at their defaults.
FEWER = {"1000": "3"}
ONE_WORKER = ["--workers", "1"]
TINY = {
    "queries": ["--num-validation", "2", *ONE_WORKER],
    "collect": ONE_WORKER,
    "verify": ONE_WORKER,
    "show": ["--size", "80", "60"],
    "sac_her_mp.py": shlex.split(
        "--hidden-size 16 --batch-size 16 --updates-per-step 0.1 --learning-starts 200 "
        "--num-envs 2 --horizon 50 --eval-every 400 --eval-queries 1 --test-queries 2 "
        "--total-timesteps 400"
    ),
}


def run(command):
    """A command as one would type it in the repository's folder, but in the current one."""
    if "runs/RUN" in command and Path("runs").exists():
        command = command.replace("runs/RUN", str(next(Path("runs").iterdir())))
    program, name, *arguments = [FEWER.get(word, word) for word in shlex.split(command)]
    arguments += TINY.get(Path(name).name, [])
    if program == "roboarm":
        return roboarm(name, *arguments)
    return outcome_of(run_here, ROOT / name, *arguments)


def error_of(command):
    """The one line of a command that must fail."""
    result = run(command)
    lines = [line for line in result.stderr.splitlines() if line and "0%, " not in line]  # its bar
    lines = [line for line in lines if not line.startswith("pybullet build time")]
    assert result.returncode in (1, 2) and len(lines) == 1, result.stderr
    return lines[0]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The folder after the page was followed, and the results of its commands."""
    folder, results, names = tmp_path_factory.mktemp("page"), {}, {}
    with pytest.MonkeyPatch.context() as patch, short_evaluations(120):
        patch.chdir(folder)
        patch.setattr("roboarm_nmp.viewer.images.MAX_FRAMES", 4)
        for kind, text in BLOCKS:
            if kind == "yaml":
                name = Path(text.split()[1])  # its first line: "# NAME"
                if name.exists():
                    Path("from_python.yaml").write_bytes(name.read_bytes())
                name.write_text(text)
            elif kind == "python":
                exec(text, names)
            for line in text.splitlines():
                command = line.partition("#")[0].strip()
                if command in COMMANDS:
                    results[command] = run(command)
    return folder, results


def result_of(page, part):
    [result] = [result for command, result in page[1].items() if part in command]
    return result


# --- The page


def test_commands_of_the_page_work(page):
    assert len(page[1]) == len(COMMANDS) == 14
    for command, result in page[1].items():
        assert result.returncode == 0, (command, result.stderr)
        assert "Traceback" not in result.stderr
    assert sorted(path.name for path in page[0].iterdir()) == [
        "episode.gif",
        "from_python.yaml",
        "moving.gif",
        "moving.yaml",
        "my_scene.yaml",
        "my_scene_demos.h5",
        "my_scene_queries.h5",
        "runs",
        "scene.png",
        "scenes.png",
    ]


def test_obstacles_of_the_page_move(page):
    scene = load_scene(page[0] / "moving.yaml")
    swinging, sphere, turning, cylinder = scene.obstacles
    assert scene.at(0.0).obstacles[0] == replace(swinging, motion=None)
    assert [round(scene.at(t).obstacles[0].position[1], 9) for t in (1, 3)] == [0.2, -0.2]
    assert scene.at(5.0).obstacles[1].position == pytest.approx((0.4, -0.5, 0.7))
    assert [len(scene.at(t).obstacles) for t in (0, 1, 4, 6, 100)] == [3, 4, 3, 4, 4]
    with Image.open(page[0] / "moving.gif") as animation:
        assert animation.n_frames > 1


def test_queries_and_demonstrations_are_beside_the_scene(page):
    task = str(page[0] / "my_scene.yaml")
    scene = load_scene(task)
    test, validation = load_queries(task, "test"), load_queries(task, "validation")
    demos = load_demos(task)
    assert (len(test), len(validation), len(demos)) == (3, 2, 3)
    assert test.task == demos.task == "my_scene"
    assert test[2].scene == demos[2].scene == scene
    assert "3 test and 2 validation queries for my_scene" in result_of(page, "validate").stdout
    assert "(0.000)" in result_of(page, "roboarm queries").stdout  # not solved
    assert "3 good, 0 changed" in result_of(page, "verify").stdout
    assert "demonstrations | 3\n" in result_of(page, "describe").stdout
    images = [np.asarray(Image.open(page[0] / f"{name}.png")) for name in ("scene", "scenes")]
    assert [image.shape for image in images] == [(60, 80, 3), (120, 160, 3)]


def test_run_of_the_page_is_trained_and_evaluated(page):
    [run_folder] = (page[0] / "runs").iterdir()
    assert run_folder.name.startswith("my_scene__sac_her_mp__1__")
    result = json.loads((run_folder / "result.json").read_text())
    assert (result["task"], result["num_queries"], result["steps"]) == ("my_scene.yaml", 2, 400)
    checkpoint = torch.load(run_folder / "checkpoint.pt", weights_only=True)
    assert checkpoint["progress"]["demos_injected"] > 0
    for policy in ("runs/RUN", "go-to-goal", "via-points", "planner"):
        text = result_of(page, f"roboarm evaluate --task my_scene.yaml --policy {policy}").stdout
        assert "on my_scene.yaml: 3 test queries" in text
        if policy == "planner":  # the queries are solvable
            assert re.search(r"success +1\.0000", text)
    assert f"runs/{run_folder.name}: " in result_of(page, "--policy runs/RUN --output").stdout


# --- What is refused


def test_malformed_scene_file_is_rejected_with_its_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my_scene.yaml").write_text(YAML.replace("length:", "height:"))
    [message] = [text.strip() for kind, text in BLOCKS if kind == "" and "unknown key" in text]
    assert message in error_of(COMMANDS[0])
    assert [path.name for path in tmp_path.iterdir()] == ["my_scene.yaml"]


def test_files_of_a_changed_scene_are_out_of_date(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("my_scene_queries.h5", "my_scene_demos.h5"):
        Path(name).write_bytes((page[0] / name).read_bytes())
    [message] = [text.strip() for kind, text in BLOCKS if kind == "" and "out of date" in text]
    Path("my_scene.yaml").write_text(YAML.replace("radius: 0.1}", "radius: 0.11}"))
    queries = re.escape(message.removesuffix("..."))
    demos = queries.replace("_queries", "_demos").replace("roboarm queries", "roboarm collect")
    for command, expected in (
        ("roboarm evaluate --task my_scene.yaml --policy go-to-goal", queries),
        ("roboarm verify my_scene.yaml", demos),
        ("python clean_rl_scripts/sac_her_mp.py --task my_scene.yaml", queries),
    ):
        assert re.search(expected, error_of(command)), command
    assert not Path("runs").exists()


# --- Random scenes


def test_distribution_of_the_page_draws_a_scene_every_three_episodes():
    names = {}
    exec(POSTS, names)
    env = names["env"]
    scenes = [env.scene]
    for _ in range(6):
        env.reset()
        scenes.append(env.scene)
        assert not env.in_collision(env.start_configuration)
    same = [scene == before for before, scene in zip(scenes, scenes[1:], strict=False)]
    assert same == [True, True, False, True, True, False]
    for scene in scenes:
        assert (scene.table, scene.floor, len(scene.obstacles)) == (TABLE, FLOOR, 3)
        for post in scene.obstacles:
            assert math.hypot(*post.position[:2]) == pytest.approx(0.5)
            assert (post.position[2], post.radius, post.length) == (0.5, 0.04, 1.0)
