"""Motions of obstacles as values: where an obstacle is at each time, and what is rejected."""

import copy
import dataclasses
import json
import math
import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from roboarm_nmp.datasets.format import DatasetError, read_scenes, scene_arrays
from roboarm_nmp.envs.scenes.files import load_scene, save_scene
from roboarm_nmp.envs.scenes.motions import (
    MAX_SPEED,
    MAX_WAYPOINTS,
    Oscillation,
    Presence,
    Waypoints,
)
from roboarm_nmp.envs.scenes.primitives import (
    Box,
    Cylinder,
    Scene,
    Sphere,
    convex_hull,
    from_lists,
    padded_rows,
    scene_from_json,
    scene_to_json,
    to_lists,
)
from roboarm_nmp.utils.documents import DocumentError

pytestmark = pytest.mark.fast

PLACE, SIZE = (0.5, 0.1, 0.3), (0.1, 0.2, 0.3)
TURN = (0.0, 0.0, math.sin(0.3), math.cos(0.3))
QUARTER = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
CORNERS = np.array([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)])
VISIT = Waypoints((1, 2, 3), ((0, 0, 0), (0.0, 0.4, 0.0), (0.0, 0.4, 0.2)))


def box_at(motion, t):
    """The only obstacle at a time; None: it is not there."""
    scene = Scene((Box(PLACE, SIZE, TURN, motion),)).at(t)
    assert scene.is_static
    return scene.obstacles[0] if scene.obstacles else None


def displacement(motion, t):
    return np.subtract(box_at(motion, t).position, PLACE)


def test_oscillation_is_a_sine_about_the_obstacles_own_pose():
    motion = Oscillation((0.0, 0.2, 0.1), 4.0)
    for t, share in ((0, 0), (1, 1), (2, 0), (3, -1), (0.5, math.sqrt(0.5)), (4001, 1)):
        np.testing.assert_allclose(
            displacement(motion, t), [0, 0.2 * share, 0.1 * share], atol=1e-9
        )
    ahead = Oscillation((0.0, 0.2, 0.1), 4.0, phase=math.pi / 2)
    np.testing.assert_allclose(displacement(ahead, 0), [0, 0.2, 0.1])


def test_oscillation_turns_about_an_axis_of_the_base():
    motion = Oscillation(period=2.0, axis=(0, 3, 0), angle=0.8)
    found = box_at(motion, 0.5)
    expected = Rotation.from_rotvec([0, 0.8, 0]) * Rotation.from_quat(TURN)
    np.testing.assert_allclose(
        Rotation.from_quat(found.orientation).as_matrix(), expected.as_matrix(), atol=1e-12
    )
    assert found.position == PLACE


@pytest.mark.parametrize(
    ("repeat", "t", "expected"),
    [
        ("once", 1.25, (0, 0.1, 0)),
        ("once", 2.5, (0, 0.4, 0.1)),
        ("back_and_forth", 3.5, (0, 0.4, 0.1)),
        ("back_and_forth", 4.75, (0, 0.1, 0)),
    ],
)
def test_waypoints_once_and_back_and_forth(repeat, t, expected):
    motion = Waypoints(VISIT.times, VISIT.displacements, repeat=repeat)
    np.testing.assert_allclose(displacement(motion, t), expected, atol=1e-9)


def test_cyclic_waypoints_begin_again():
    motion = Waypoints((1, 2, 4), ((0, 0, 0), (0, 0.4, 0), (0, 0, 0)), repeat="cyclic")
    for t, y in ((0, 0), (1.5, 0.2), (3, 0.2), (4, 0), (4.5, 0.2), (4.5 + 300, 0.2)):
        np.testing.assert_allclose(displacement(motion, t), [0, y, 0], atol=1e-9)


def test_waypoints_turn_the_shorter_way_round():
    backwards = tuple(-n for n in QUARTER)  # the same rotation as QUARTER
    motion = Waypoints((0, 2), ((0, 0, 0),) * 2, ((0, 0, 0, 1), backwards))
    for t in (0.0, 0.3, 1.0, 2.0, 5.0):
        between = Slerp([0, 2], Rotation.from_quat([(0, 0, 0, 1), QUARTER]))(min(t, 2))
        expected = between * Rotation.from_quat(TURN)
        found = Rotation.from_quat(box_at(motion, t).orientation)
        assert (found * expected.inv()).magnitude() < 1e-7


def test_obstacle_waits_visits_and_leaves():
    motion = Presence(((0, 5), (6, math.inf)), VISIT)
    for t, there in ((0, True), (4.999, True), (5, False), (5.9, False), (6, True), (1e9, True)):
        assert (box_at(motion, t) is not None) == there
    np.testing.assert_allclose(displacement(motion, 2.0), [0, 0.4, 0])
    standing = Presence(((1, 2),))
    assert box_at(standing, 0) is None
    assert box_at(standing, 1) == Box(PLACE, SIZE, TURN)


def test_scenes_with_motions_are_values():
    def scene(period=2.0):
        motion = Presence([[0, 5]], Oscillation([0, 0.1, 0], period))
        return Scene([Box(PLACE, SIZE, motion=motion)])

    assert scene() == scene() == copy.deepcopy(scene()) == pickle.loads(pickle.dumps(scene()))
    assert hash(scene()) == hash(scene())
    assert scene() != scene(3.0)
    assert scene() != Scene([Box(PLACE, SIZE)])


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: Oscillation((0, 0.1, 0), period=0), "period .* at least 0.001 s"),
        (lambda: Oscillation(axis=(0, 0, 0)), "axis"),
        (lambda: Oscillation((0, 1, 0), period=1), "too fast: 6.28 m/s"),
        (lambda: Waypoints(range(MAX_WAYPOINTS + 1), ()), "1 to 1,000 waypoints"),
        (lambda: Waypoints((0, 0), ((0, 0, 0),) * 2), "ascend"),
        (lambda: Waypoints((0, 1), ((0, 0, 0),)), "2 times, but 1 displacements"),
        (lambda: Waypoints((0, 1), ((0, 0, 0), (0, 0.1, 0)), repeat="cyclic"), "end where"),
        (lambda: Waypoints((0, 0.1), ((0, 0, 0), (0, MAX_SPEED, 0))), "waypoint 1 is too fast"),
        (lambda: Waypoints((0, 0.05), ((0, 0, 0),) * 2, ((0, 0, 0, 1), QUARTER)), "turns too fast"),
        (lambda: Presence(((0, 2), (1, 3))), "ascend"),
    ],
)
def test_impossible_motion_is_rejected(make, reason):
    with pytest.raises(ValueError, match=reason):
        make()


def test_motion_of_another_type_is_rejected():
    with pytest.raises(TypeError, match="motion must be"):
        Box(PLACE, SIZE, motion=lambda t: t)
    with pytest.raises(TypeError, match="motion must be"):
        Presence(((0, 1),), Presence(((0, 1),)))
    with pytest.raises(ValueError, match="table cannot move"):
        Scene(table=Box(PLACE, SIZE, motion=VISIT))
    with pytest.raises(ValueError, match="finite number of seconds"):
        Scene((Box(PLACE, SIZE, motion=VISIT),)).at(math.nan)


# --- Files

TURNING = Oscillation((0.1, 0.0, 1 / 3), 1.7, 0.3, (0.1, 0.2, 0.3), 0.7)
CYCLE = Waypoints(
    (0.1, 1.0, 2.0),
    ((0, 0, 0), (0, 0.4, 0), (0, 0, 0)),
    ((0, 0, 0, 1), QUARTER, (0, 0, 0, 1)),
    "cyclic",
)
MOTIONS = [
    TURNING,
    CYCLE,
    VISIT,
    Waypoints((1.0,), ((0.1, 0.2, 1 / 3),)),
    Waypoints(VISIT.times, VISIT.displacements, repeat="back_and_forth"),
    Presence(((0.1, 1 / 3), (2, 4)), TURNING),
    Presence(((0.1, math.inf),), VISIT),
    Presence(((0, 1), (2, math.inf))),
]
HULL = dataclasses.replace(convex_hull(CORNERS, PLACE), motion=TURNING)
MOVING = Scene(
    (
        *(Box(PLACE, SIZE, TURN, motion) for motion in MOTIONS),
        Cylinder(PLACE, 0.1, 0.2, motion=CYCLE),
        Box(PLACE, SIZE),
        HULL,
        Sphere(PLACE, 0.1, VISIT),
    )
)


def test_scene_file_of_moving_obstacles_is_exact(tmp_path):
    save_scene(MOVING, tmp_path / "scene.yaml")
    assert load_scene(tmp_path / "scene.yaml") == MOVING


def test_json_of_moving_obstacles_is_exact():
    assert scene_from_json(scene_to_json(MOVING)) == MOVING
    assert from_lists(json.loads(json.dumps(to_lists(MOVING.obstacles)))) == MOVING.obstacles


def test_query_file_of_moving_scenes_is_exact(tmp_path):
    path = tmp_path / "queries.h5"
    scenes = [MOVING, Scene(MOVING.obstacles[:2]), MOVING]
    still = [Scene((Box(PLACE, SIZE),))] * 3
    arrays = scene_arrays(path, scenes, Scene())
    found = read_scenes(path, Scene(), arrays)
    assert [found[i] for i in range(3)] == scenes
    assert [found.take(np.array([1, 0]))[i] for i in range(2)] == [scenes[1], MOVING]
    assert not {"motions", "motion_count"} & scene_arrays(path, still, Scene()).keys()


@pytest.mark.parametrize(
    "change",
    [
        lambda arrays: arrays["motions"].__setitem__(0, 7.0),
        lambda arrays: arrays["motions"].__setitem__(1, np.nan),
        lambda arrays: arrays["motion_count"].__setitem__(0, 9),
    ],
)
def test_damaged_motions_are_rejected(tmp_path, change):
    arrays = scene_arrays(tmp_path / "q.h5", [MOVING], Scene())
    change(arrays)
    with pytest.raises(DatasetError, match="q.h5: motion"):
        read_scenes(tmp_path / "q.h5", Scene(), arrays)


def test_rows_for_encoders_have_no_place_for_motions():
    with pytest.raises(ValueError, match=r"scene\.at\(t\)"):
        padded_rows(MOVING.obstacles[:1], 4)


BOX = "obstacles:\n- box: {position: [0.5, 0, 0.3], size: [0.1, 0.1, 0.1],\n    motion: "


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("2", "motion of box must be a mapping with keys oscillation, waypoints, present"),
        ("{oscillation: {amplitude: [0, 1, 0]}}", "oscillation lacks period"),
        ("{oscillation: {amplitude: [0, 9, 0], period: 1}}", "motion of box: .* too fast"),
        ("{present: [[1], [2, 3]]}", "ascend"),
    ],
)
def test_mistake_in_a_motion_is_reported_with_its_line(tmp_path, text, reason):
    path = tmp_path / "scene.yaml"
    path.write_text(BOX + text + "}\n")
    with pytest.raises(DocumentError, match=f"scene.yaml:3: .*{reason}"):
        load_scene(path)
