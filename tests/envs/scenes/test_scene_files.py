"""Scene files: exact round trips, and every mistake is rejected with its line."""

import math
import re
import textwrap

import numpy as np
import pytest

from roboarm_nmp.envs.scenes import files as scene_files
from roboarm_nmp.envs.scenes.files import load_scene, save_scene
from roboarm_nmp.envs.scenes.primitives import (
    FLOOR,
    TABLE,
    Box,
    ConvexHull,
    Cylinder,
    Scene,
    Sphere,
)
from roboarm_nmp.utils.documents import DocumentError

DOCUMENTED = textwrap.dedent(
    re.search(r"(    table:.*\n)\nAn obstacle", scene_files.__doc__, re.S)[1]
)
EXAMPLE = Scene(
    (
        Box((0.5, 0.0, 0.3), (0.3, 0.04, 0.6)),
        Box(
            (0.5, 0.3, 0.3),
            (0.3, 0.04, 0.6),
            (0.0, 0.0, math.sin(math.pi / 8), math.cos(math.pi / 8)),
        ),
        Cylinder((0.4, 0.4, 0.25), 0.05, 0.5),
        Sphere((0.3, -0.4, 0.5), 0.1),
        ConvexHull((-0.4, 0.4, 0.2), ((0, 0, 0), (0.2, 0, 0), (0, 0.2, 0), (0, 0, 0.2))),
    )
)


@pytest.fixture
def load(tmp_path):
    """load(text or bytes): the scene in a file with these contents."""

    def load(contents):
        path = tmp_path / "scene.yaml"
        path.write_bytes(contents if isinstance(contents, bytes) else contents.encode())
        return load_scene(path)

    return load


def random_scene(seed):
    """A scene with all kinds, turned or not, numbers of many magnitudes, to the last bit."""
    rng = np.random.default_rng(seed)

    def numbers(count):
        return tuple((rng.normal(size=count) * 10.0 ** rng.integers(-12, 3)).tolist())

    def sizes(count):
        return tuple(abs(number) for number in numbers(count))

    def orientation():
        quaternion = rng.normal(size=4)
        return tuple((quaternion / np.linalg.norm(quaternion)).tolist())

    def box():
        return Box(numbers(3), sizes(3), *[orientation()][: rng.integers(2)])

    def cylinder():
        return Cylinder(numbers(3), *sizes(2), *[orientation()][: rng.integers(2)])

    def sphere():
        return Sphere(numbers(3), *sizes(1))

    kinds = (box, cylinder, sphere)
    order = rng.permutation([0, 1, 2, *rng.integers(3, size=9)])
    obstacles = tuple(kinds[kind]() for kind in order)
    table = (TABLE, None, box())[seed % 3]
    return Scene(obstacles, table, (FLOOR, None, *numbers(1))[seed // 3 % 3])


# --- Reading


def test_documented_example_equals_the_scene_written_in_python(load):
    assert load(DOCUMENTED) == EXAMPLE
    assert load("table: true\nfloor: -0.6\nobstacles: []\n") == Scene()


@pytest.mark.parametrize(
    ("text", "scene"),
    [
        ("{}", Scene()),
        (
            "\ufefftable: false\r\nfloor: false\r\n",
            Scene(table=None, floor=None),
        ),  # byte order mark
        (
            "obstacles:\n- sphere:\n    radius: 1e-2\n    position:\n"
            "    - 1E1\n    - +.5\n    - -3.\n",
            Scene((Sphere((10.0, 0.5, -3.0), 0.01),)),
        ),
        (
            "obstacles: [{cylinder: {position: [1, 2, 3], radius: 1, length: 2, "
            "orientation: [0.6, 0, -0.8, 0]}}]",
            Scene((Cylinder((1.0, 2.0, 3.0), 1.0, 2.0, (0.6, 0.0, -0.8, 0.0)),)),
        ),
        (
            "obstacles:\n"
            "  - box: {position: &here [1, 2, 3], size: *here}\n"
            "  - &ball {sphere: {position: *here, radius: 1}}\n"
            "  - *ball\n",
            Scene((Box((1, 2, 3), (1, 2, 3)), Sphere((1, 2, 3), 1), Sphere((1, 2, 3), 1))),
        ),
    ],
)
def test_text_is_read_as_scene(load, text, scene):
    assert load(text) == scene


# --- Writing


@pytest.mark.parametrize("seed", range(9))
def test_round_trip_is_exact(tmp_path, seed):
    scene = random_scene(seed)
    save_scene(scene, tmp_path / "scene.yaml")
    assert load_scene(tmp_path / "scene.yaml") == scene


# --- Mistakes


def obstacle(text):
    """A file with a good obstacle in line 2 and this one from line 3 on."""
    return f"obstacles:\n  - sphere: {{position: [0, 0, 1], radius: 1}}\n  - {text}\n"


def box(text):
    """A good box with more fields in line 5."""
    return obstacle(f"box:\n      position: [1, 2, 3]\n      {text}\n      size: [1, 1, 1]")


def sphere(position="[0, 0, 0]", radius="1"):
    return obstacle(f"sphere:\n      position: {position}\n      radius: {radius}")


@pytest.mark.parametrize(
    ("contents", "line", "reason"),
    [
        # Not YAML
        ("floor: 0\ntable: a: b", 2, "mapping values are not allowed"),
        ("floor: 0\n# caf\xe9\n".encode("latin-1"), 2, "byte 0xe9 is not UTF-8 text"),
        # Dangerous
        ("floor: 0\ntable: !!python/object/apply:os.abort []", 2, "tags .* are not allowed"),
        ("floor: 0\nobstacles:\n  " + "- " * 100_000, 3, "nested too deeply"),
        ("floor: 0\nobstacles: &all [*all]", 2, "the alias 'all' stands for a value that contains"),
        (
            "obstacles: [&a {sphere: {position: [0, 0, 0], radius: 1}}" + ", *a" * 50_000 + "]",
            1,
            "a scene has at most 10,000 obstacles",
        ),
        # Whole
        ("\n- floor: 0", 2, "a scene must be a mapping .* obstacles, got a list"),
        ("floor: 0\nflor: 0", 2, "unknown key flor in a scene: known are robot, held, att"),
        ("floor: 0\ntable: true\n'floor': 0", 3, "the key 'floor' stands twice"),
        # Floor and table
        ("\nfloor: true", 2, "floor must be a height in metres or false, got true"),
        ("table:\n  size: [1, 1, 1]", 2, "table lacks position"),
        # Obstacles
        (obstacle("box:\n    size: 1"), 3, "exactly one key, its kind .*: box, size"),
        (obstacle("cube: {}"), 3, "unknown kind of obstacle cube: one of box, cylinder, sphere"),
        (box("radius: 1"), 5, "unknown key radius in box: known are position, size, orient.*, yaw"),
        # Numbers
        (sphere("[1, -2e9, 3]"), 4, "position of sphere must be at most 1000, got -2e9"),
        (sphere("[1,\n 2,\n left]"), 6, "position of sphere must be a finite number, got left"),
        # Orientation
        (box("orientation: [0, 0, 1, 1]"), 5, r"norm 1 \(within 1 %\), got norm 1.41421356$"),
        (box("orientation: [0, 0, 0, 1]\n      yaw: 0"), 6, "box has both yaw and orientation"),
    ],
)
def test_mistake_is_rejected_with_its_line(load, tmp_path, contents, line, reason):
    with pytest.raises(DocumentError) as caught:
        load(contents)
    message = str(caught.value)
    start = f"{tmp_path / 'scene.yaml'}:{line}: "
    assert message.startswith(start)
    assert re.search(reason, message.removeprefix(start))
    assert "\n" not in message and len(message.removeprefix(start)) < 200


def test_unreadable_file_is_reported(tmp_path):
    for path, reason in ((tmp_path / "none.yaml", "No such file"), (tmp_path, "no regular file")):
        with pytest.raises(DocumentError, match=f"^{path}: {reason}"):
            load_scene(path)
