"""Python blocks of docs/guide: each page from top to bottom. (perception.md: test_sensors.py.)"""

import numpy as np
import pytest
from docs_scripts import code_of, names_of

from roboarm_nmp.demo_generation import roadmaps


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_code_of_environment_page_runs():
    names = {}
    for block in code_of("guide/environment.md"):
        exec(block.replace("learn(10_000)", "learn(420)"), names)  # less training
    assert names["free"].shape == (9_999,)
    assert names["nearest"].gradient.shape == (10_000, 10, 7)
    assert issubclass(names["LinkDistancesHerReplayBuffer"], names["HerReplayBuffer"])


def test_code_of_tasks_page_runs():
    names = names_of("guide/tasks.md")
    assert len(names["queries"]) == 10_000 and names["start"].shape == (7,)


def test_code_of_demonstrations_page_runs(folder):
    args = roadmaps.Args(task="wall", scenes=1, paths_per_scene=20, output=folder / "roadmaps")
    roadmaps.main(args)
    names = names_of("guide/demonstrations.md")
    assert names["execution"].reached and not names["execution"].collided
    np.testing.assert_array_equal(names["path"][-1], names["query"].goal)  # its own planner's
    assert len(names["found"]) == 5 and len(names["paths"].of_scene(0)) == 20


def test_code_of_safety_filter_page_runs():
    names = names_of("guide/safety_filter.md")
    assert names["act"](names["observation"]).shape == (7,)


def test_code_of_evaluation_page_runs(short_episodes):
    result = names_of("guide/evaluation.md")["result"]
    assert result["safety_filter"]["margin"] == 0.01 and not result["privileged"]


def test_code_of_trajectories_page_runs(folder):
    names = names_of("guide/trajectories.md")
    assert names["metrics"]["min_clearance"] > 0 and (folder / "motion.yaml").exists()
