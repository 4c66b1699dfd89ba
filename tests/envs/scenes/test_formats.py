"""Worlds in other programs' formats: obstacles where the files have them; mistakes with lines."""

import numpy as np
import pytest
from problem_files import (
    CUROBO,
    MOVEIT_SCENE,
    MOVEIT_TOUCHING,
    OLD_SCENE_TEXT,
    SCENE_TEXT,
    write_file,
)

from roboarm_nmp.envs import make
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.variants import with_attached
from roboarm_nmp.envs.scenes.formats import load_world
from roboarm_nmp.envs.scenes.primitives import Attached, Box, Cylinder, Scene, Sphere
from roboarm_nmp.envs.tasks import get_task

HALF = 0.7071067811865476
# A quarter turn about z and a move of (0.5, -0.5, 0.2) put (0.1, 0, 0) at (0.5, -0.4, 0.2).
SHELF = Box((0.5, -0.4, 0.2), (0.3, 0.04, 0.5), (0, 0, HALF, HALF))
EXPECTED = {
    "scene.yaml": (
        MOVEIT_SCENE,
        (Cylinder((0.6, 0.5, 0.07), 0.03, 0.14), SHELF, Sphere((0.5, -0.5, 0.5), 0.05)),
    ),
    "curobo.yml": (CUROBO, (Box((0.4, 0.0, -0.1), (2.0, 1.5, 0.2)), Sphere((0, 0.6, 0.5), 0.1))),
    "new.scene": (SCENE_TEXT, (SHELF, Cylinder((0.5, -0.5, 0.5), 0.03, 0.14, (0, 0, HALF, HALF)))),
    "old.scene": (OLD_SCENE_TEXT, (SHELF, Sphere((0.5, -0.5, 0.5), 0.05))),
}


def assert_same(found, expected):
    assert [type(one) for one in found] == [type(one) for one in expected]
    for one, other in zip(found, expected, strict=True):
        assert one.motion is other.motion is None
        numbers = {name: value for name, value in vars(one).items() if name != "motion"}
        for name, value in numbers.items():
            np.testing.assert_allclose(value, getattr(other, name), atol=1e-12)


@pytest.mark.parametrize("name", EXPECTED)
def test_obstacles_are_those_of_the_file(name, tmp_path):
    content, obstacles = EXPECTED[name]
    scene = load_world(write_file(tmp_path / name, content))
    assert_same(scene.obstacles, obstacles)
    assert scene.table is None and scene.floor is None


@pytest.mark.parametrize("name", ["scene.yaml", "new.scene"])
def test_file_can_be_a_task(name, tmp_path):
    path = write_file(tmp_path / name, EXPECTED[name][0])
    assert get_task(path).scene == load_world(path)
    env = make(str(path))
    assert env.scene == load_world(path)
    env.close()


def test_attached_objects_and_allowed_collisions_are_those_of_the_file(tmp_path):
    """The matrix allows the can and the hand, and what the hand carries and link 5."""
    scene = load_world(write_file(tmp_path / "scene.yaml", MOVEIT_TOUCHING))
    box = Box((0, 0, 0.15), (0.04, 0.05, 0.1))
    tool = Attached(box, "panda_hand", ("panda_link5", "panda_link6"))
    assert scene.robot == with_attached(PANDA, [tool])
    assert [one.may_touch for one in scene.obstacles] == [("panda_hand",), (), ()]
    every = MOVEIT_TOUCHING.replace("default_entry_values: [false]", "default_entry_values: [true]")
    shelf = load_world(write_file(tmp_path / "scene.yaml", every)).obstacles[1]
    assert set(shelf.may_touch) == set(PANDA.link_names.values())


def test_own_scene_files_are_worlds_too(tmp_path):
    path = write_file(tmp_path / "own.yaml", "floor: false\ntable: false\n")
    assert load_world(path) == Scene(table=None, floor=None)
    with pytest.raises(ValueError, match="own.yaml:1: unknown key flor"):
        load_world(write_file(path, "flor: false"))


def edited(text, old, new):
    assert old in text
    return text.replace(old, new, 1)


MISTAKES = [
    ("a.yaml", edited(MOVEIT_TOUCHING, "frame_id: panda_hand", "frame_id: world"), 11,
     "the frame 'world' is not panda_hand, the object's link"),
    ("a.yaml", edited(MOVEIT_TOUCHING, "- [false, true, false, true]", "- [false, true]"), 43,
     "4 entry_names have a row of 2 values"),
    ("a.yaml", edited(MOVEIT_SCENE, "type: cylinder", "type: cone"), 15,
     "cones are not supported"),
    ("a.yaml", edited(MOVEIT_SCENE, "translation: [0, 0, 0]", "translation: [0, 1, 0]"), 5,
     "a fixed frame's transform must be the identity"),
    ("b.yml", edited(CUROBO, "mesh: {}", "mesh: {cup: {file_path: cup.obj}}"), 7,
     "mesh cup lacks pose"),
    ("c.scene", edited(SCENE_TEXT, "0.3 0.04 0.5", "0.3 0.04"), 7,
     "the dimensions of a box must be a list of 3 numbers, got 2"),
    ("c.scene", edited(SCENE_TEXT, "\n.\n", "\n"), 19, "the file ends before the last line, a dot"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "line", "reason"), MISTAKES)
def test_mistake_is_rejected_with_its_line(name, content, line, reason, tmp_path):
    path = write_file(tmp_path / name, content)
    with pytest.raises(ValueError) as caught:
        load_world(path)
    assert str(caught.value).startswith(f"{path}:{line}: {reason}")
