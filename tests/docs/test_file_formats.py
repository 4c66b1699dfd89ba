"""docs/reference/file_formats.md: arrays, results and limits are those of the code."""

import re

import numpy as np
from paths import ROOT

import roboarm_nmp
from roboarm_nmp.datasets.format import (
    DEMO_ARRAYS,
    OPTIONAL_SCENE_ARRAYS,
    QUERY_ARRAYS,
    SCENE_ARRAYS,
    SEED_ARRAYS,
)
from roboarm_nmp.datasets.problems import ARRAYS as PROBLEM_ARRAYS
from roboarm_nmp.envs.scenes.files import load_scene

PAGE = (ROOT / "docs/reference/file_formats.md").read_text()


def section(title):
    """The text below a heading, up to the next one of its level."""
    return PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def code(title, language):
    return re.search(rf"```{language}\n(.*?)```", section(title), re.DOTALL)[1]


def test_arrays_are_listed_with_their_dtypes():
    queries = QUERY_ARRAYS | SCENE_ARRAYS | SEED_ARRAYS
    for arrays in OPTIONAL_SCENE_ARRAYS:
        queries |= arrays
    for title, arrays in (
        ("Queries", queries),
        ("Demonstrations", DEMO_ARRAYS),
        ("Problems", PROBLEM_ARRAYS),
    ):
        rows = re.findall(r"^\| (`.*?) \| (\w+) \((.*?)\)", section(title), re.M)
        listed = {name: row for row in rows for name in re.findall(r"`(\w+)`", row[0])}
        assert listed.keys() == arrays.keys()
        for name, (dtype, width, _) in arrays.items():
            _, shown, shape = listed[name]
            assert np.dtype(shown) == np.dtype(dtype), name
            assert shape.partition(",")[2].strip() == {None: "", "joints": "7"}.get(
                width, str(width)
            ), name


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
