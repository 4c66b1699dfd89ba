"""The scripts in examples/ run as their docstrings say, and print what these say."""

import json
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from paths import ROOT
from trainers import TINY_BC, roboarm, run_here

import roboarm_nmp
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.evaluation import benchmark
from roboarm_nmp.motions.trajectories import load_joint_path
from roboarm_nmp.policies import __main__ as policies
from roboarm_nmp.policies.registry import make_policy
from roboarm_nmp.viewer import show


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run an example in this process, in an empty folder; its output."""
    monkeypatch.chdir(tmp_path)

    def run_example(name, *arguments):
        run_here(ROOT / "examples" / name, *arguments)
        return capsys.readouterr().out

    return run_example


@pytest.mark.parametrize(
    "example, arguments, printed",
    [
        ("01_step_an_environment.py", "--query 2", r"goal (not )?reached in \d+ steps, with"),
        ("03_own_scene.py", "--queries 3", r"planner: success 1.00, without contact 1.00"),
        ("04_own_robot.py", "", r"iiwa: 7 joints(.|\n)*goal reached in \d+ steps, without contact"),
        (
            "06_own_demonstrations.py",
            "--motions 20 --epochs 2 --queries 2",
            r"teleop.h5: (1\d|20) demonstrations(.|\n)*epoch 2: loss \S+\nsuccess",
        ),
        (
            "09_moving_obstacles.py",
            "",
            r"after 1 s(.|\n)*y = 0.20 m(.|\n)*replanning: goal",
        ),
    ],
)
def test_example_prints_what_it_did(run, example, arguments, printed):
    assert re.search(printed, run(example, *arguments.split()))


def test_notebook_trains_and_shows_a_policy(tmp_path, monkeypatch, capsys, short_episodes):
    monkeypatch.chdir(tmp_path)
    names = {}
    for cell in json.loads((ROOT / "examples" / "first_policy.ipynb").read_text())["cells"]:
        source = "".join(cell["source"])
        assert not cell.get("outputs")
        if source.startswith("!roboarm "):
            words = shlex.split(source.replace("\\\n", ""))
            assert roboarm(*words[1:], *TINY_BC.split()).returncode == 0
        elif cell["cell_type"] == "code":
            exec(source.replace("num_queries=100", "num_queries=2"), names)
    assert len(re.findall(r"reaches \d+% of the goals", capsys.readouterr().out)) == 2
    assert len(names["trajectory"]) > 0 and names["picture"].size == (640, 480)


def test_entry_of_the_example_is_verified(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    program = f"{sys.executable} {ROOT / 'examples' / '10_benchmark_entry.py'}"
    arguments = "--observes point_cloud --searches --tasks wall --num-queries 2 --workers 1"
    run = ["run", "--program", program, *arguments.split(), "--output", "entry"]
    assert benchmark.main(run) == 0
    assert benchmark.main(["verify", "entry"]) == 0


def test_planned_path_is_checked_exported_and_can_be_shown(run, tmp_path, capsys, monkeypatch):
    file = "path.npz"
    output = run("02_plan_a_path.py", "--query", 2, "--output", file)
    free, motions = re.search(r"(\d+) of (\d+) motions are free", output).groups()
    assert free == motions and "goal reached" in output and "collision-free" in output
    times, configurations = load_joint_path(tmp_path / file, PANDA)
    query = load_queries("double_walls")[2]
    np.testing.assert_allclose(configurations[[0, -1]], [query.start, query.goal], atol=1e-6)
    np.testing.assert_allclose(np.diff(times), 1 / 30)
    monkeypatch.setattr("roboarm_nmp.viewer.images.MAX_FRAMES", 1)
    shown = ["--trajectory", tmp_path / file, "--output", tmp_path / "a.gif", "--size", 80, 60]
    assert show.main(["double_walls", *map(str, shown)]) == 0
    assert "collision-free" in capsys.readouterr().out


def test_own_points_lead_to_actions_that_avoid_them(run, tmp_path):
    output = run("05_own_point_cloud.py")
    assert "the straight motion to the goal is blocked" in output and "goal reached" in output
    assert float(re.search(r"smallest distance from a point: (\S+) mm", output)[1]) > 0
    # Points of one's own, far from the arm.
    np.save(tmp_path / "cloud.npy", np.full((10, 3), 3.0))
    output = run("05_own_point_cloud.py", "--points", "cloud.npy")
    assert "0 points; the straight motion to the goal is free" in output  # out of reach


# Importing a module that is None raises ImportError.
BLOCKED = 'import sys; sys.modules.update(dict.fromkeys(("roboarm_nmp", "torch", "pybullet")))\n'


def test_policy_runs_with_onnx_runtime_alone(tmp_path, capsys):
    """The first step is the environment's, and the guide shows the example as it is."""
    name, file = "bc-config-double_walls-s1", tmp_path / "policy.onnx"
    assert policies.main([name, "--export", str(file)]) == 0
    table = capsys.readouterr().out
    script = ROOT / "examples" / "08_policy_elsewhere.py"
    code = BLOCKED + script.read_text()
    process = subprocess.run(
        [sys.executable, "-c", code, file], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    env = roboarm_nmp.make("no_obstacles", goal_type="config")
    start = np.array([0.0, -0.4, 0.0, -2.2, 0.0, 1.8, 0.8])
    goal = np.array([1.2, 0.1, 0.2, -1.9, 0.1, 2.0, 0.9])
    observation, _ = env.reset_specific(start, goal)
    act, *_ = make_policy(file, env)(0, None)
    action = act(observation)
    action *= min(1.0, env.max_step / np.linalg.norm(action))
    expected = env.robot.denormalise(env.robot.normalise(start) + action)
    np.testing.assert_allclose(np.array(process.stdout.split(), float), expected, atol=1e-4)
    page = (ROOT / "docs" / "guide" / "run_elsewhere.md").read_text()
    lines = script.read_text().partition('"""\n\n')[2]
    assert f"```python\n{lines}```" in page
    assert table.partition("\n")[2] in page
    assert len([line for line in lines.splitlines() if line]) <= 25
