"""docs/reference/file_formats.md: arrays, results and limits are those of the code."""

import re

from paths import ROOT

import roboarm_nmp
from roboarm_nmp.envs.scenes.files import load_scene

PAGE = (ROOT / "docs/reference/file_formats.md").read_text()


def section(title):
    """The text below a heading, up to the next one of its level."""
    return PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def code(title, language):
    return re.search(rf"```{language}\n(.*?)```", section(title), re.DOTALL)[1]


def test_code_about_queries_and_demonstrations_runs():
    names = {}
    exec(code("Queries", "python"), names)
    exec(code("Demonstrations", "python"), names)
    assert names["queries"].goal_position.shape == (len(names["queries"]), 3)
    assert len(names["demo"].actions) == len(names["demo"].states) - 1


def test_scene_of_the_page_is_read(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text(code("Scenes", "yaml"))
    assert len(load_scene(path).obstacles) == 5


def test_keys_of_an_evaluation_are_listed():
    result = roboarm_nmp.evaluate("go-to-goal", "no_obstacles", num_queries=1)
    listed = set(re.findall(r"`(\w+)`", section("Results")))
    assert {key for key in result if not key.endswith("_interval")} <= listed
