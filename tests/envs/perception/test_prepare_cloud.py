"""Clouds of a user's own: what is left out of them, and scenes, checkers and policies with them."""

import copy
import pickle

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.point_clouds import (
    ARM_DISTANCE,
    CELL,
    farthest_points,
    observed_points,
    one_per_cell,
    prepare_cloud,
)
from roboarm_nmp.envs.perception.sensors import PointCloud, SensorWorld, cardinal
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.files import save_scene
from roboarm_nmp.envs.scenes.primitives import ObservedScene, Scene, scene_to_json
from roboarm_nmp.envs.tasks import get_task

CONFIGURATION = np.array([0.0, -0.5, 0.0, -1.5, 0.0, 1.0, 0.8])  # rad


def surface(low, high, spacing=0.005):
    """Points of a regular grid in a thin box."""
    axes = [np.arange(a, b + 1e-9, spacing) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


WALL = surface((0.6, -0.1, 0.3), (0.6, 0.1, 0.5))


def test_each_step_leaves_its_points_out_and_counts_them():
    others = {
        "not finite": [[np.nan, 0, 0], [np.inf, 0.5, 0.5], [0.5, 0.5, -np.inf]],
        "outside the workspace": [[9.0, 0, 0.5], [0.5, 0, -4.0]],
        "of table or floor": [[0.5, 0.3, 0.005], [0.3, -0.3, -0.03], [1.2, 1.0, -0.595]],
        "of the arm": [*PANDA.frame_poses(CONFIGURATION)[4][0][None], [0.0, 0.0, 0.1]],
        "outliers": [[0.5, 0.5, 0.5], [0.505, 0.5, 0.5]],
    }
    points = np.concatenate([WALL, *map(np.array, others.values())])
    points = points[np.random.default_rng(0).permutation(len(points))]
    kept, removed = prepare_cloud(points, configuration=CONFIGURATION)
    thinned = one_per_cell(np.float32(WALL))
    assert removed == {name: len(rows) for name, rows in others.items()} | {
        "thinned out": len(WALL) - len(thinned)
    }
    assert kept.dtype == np.float32 and len(kept) == len(thinned)
    rows = {tuple(row) for row in np.float32(WALL)}
    assert all(tuple(row) in rows for row in kept)


def test_points_of_the_arm_are_those_near_its_hulls():
    rng = np.random.default_rng(3)
    places = np.concatenate([position[None] for position, _ in PANDA.frame_poses(CONFIGURATION)])
    points = (places[rng.integers(2, 7, 400)] + rng.normal(0, 0.07, (400, 3))).astype(np.float32)
    empty = {"table": None, "floor": None}
    kept, _ = prepare_cloud(points, configuration=CONFIGURATION, cell=1e-4, min_points=0, **empty)
    state = PANDA.normalise(CONFIGURATION)
    distances = [
        CollisionChecker.from_points([point], 0.0, **empty)
        .signed_distances(state, self_collisions=False)
        .distance.min()
        for point in points
    ]
    far = points[np.array(distances) >= ARM_DISTANCE]
    assert 50 < len(far) < 350 and kept.tolist() == far.tolist()


def test_one_point_per_cell_is_the_first_of_each():
    rng = np.random.default_rng(1)
    for kind in (np.float32, np.float64):
        points = rng.uniform(-1, 1, (4000, 3)).astype(kind)
        points[2000:] = np.round(points[2000:] / kind(CELL)) * kind(CELL)  # on edges of cells
        cells = np.floor(points / CELL).astype(int)
        _, first = np.unique(cells, axis=0, return_index=True)
        assert len(first) > 2000
        assert one_per_cell(points).tobytes() == points[np.sort(first)].tobytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": np.zeros((3, 2))}, r"points must be numbers of shape \(n, 3\)"),
        ({"points": WALL, "cell": 0.0}, "cell must be in"),
        ({"points": WALL, "workspace": [0, 1]}, "workspace must be"),
        ({"points": WALL, "configuration": [0.0] * 6}, "configuration must be"),
    ],
)
def test_invalid_arguments_are_rejected(arguments, message):
    with pytest.raises(ValueError, match=message):
        prepare_cloud(**arguments)


def test_observed_scene_is_a_value_that_cannot_be_changed_or_written(tmp_path):
    points = np.float32(WALL)
    scene = ObservedScene(points=points)
    points[0] = 9.0  # of the caller
    assert scene.points[0, 0] == np.float32(0.6)
    with pytest.raises(ValueError, match="read-only"):
        scene.points[0] = 1.0
    assert scene == ObservedScene(points=WALL) and hash(scene) == hash(ObservedScene(points=WALL))
    assert scene != ObservedScene(points=points) and scene != Scene() and Scene() != scene
    assert scene != ObservedScene(points=WALL, point_radius=0.02)
    for other in (copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        assert other == scene and other.points.tobytes() == scene.points.tobytes()
    with pytest.raises(ValueError, match="has points"):
        save_scene(scene, tmp_path / "scene.yaml")
    with pytest.raises(ValueError, match="points"):
        scene_to_json(scene)
    assert not [*tmp_path.iterdir()]


def test_environment_of_points_observes_them():
    points, _ = prepare_cloud(WALL)
    scene = ObservedScene(points=points)
    assert observed_points(scene) is scene.points
    env = envs.make(
        scene,
        goal_type="config",
        encoder="point_cloud",
        num_points=16,
        geometry_source="point_cloud",
        link_distances=True,
    )
    observation, _ = env.reset_specific(CONFIGURATION, CONFIGURATION + 0.1)
    encoded = observation["observation"][-48:].reshape(16, 3)
    assert encoded.tobytes() == farthest_points(points, 16).tobytes()
    distances = CollisionChecker(scene).link_distances(observation["observation"][:7])
    np.testing.assert_array_equal(observation["link_distances"], distances)
    # The next cloud, in the same environment.
    moved = ObservedScene(points=points + np.float32([-0.2, 0.0, 0.2]))
    other, _ = env.reset_specific(CONFIGURATION, CONFIGURATION + 0.1, moved)
    assert np.abs(other["link_distances"] - observation["link_distances"]).max() > 0.01
    env.close()


def test_cloud_of_a_scene_gives_the_verdicts_of_its_obstacles():
    """A wall as four depth sensors record it, with arm, table and floor."""
    scene, world = get_task("wall").scene, SensorWorld()
    world.show(scene, CONFIGURATION)
    cloud = [s.observe(world)["points"] for s in cardinal(PointCloud).values()]
    points, removed = prepare_cloud(np.concatenate(cloud), configuration=CONFIGURATION)
    assert removed["of the arm"] > 300 and removed["of table or floor"] > 10_000
    states = np.random.default_rng(0).uniform(-1, 1, (10_000, 7))
    true = CollisionChecker(scene).signed_distances(states, self_collisions=False).distance.min(1)
    found = CollisionChecker.from_points(points).is_free(states)
    truly_free = CollisionChecker(scene).is_free(states)
    near = np.abs(true) < 0.02
    # Points are on surfaces only: an arm deep inside an obstacle may be free of them.
    wrong = (found != truly_free) & ~near
    assert 0.1 < truly_free.mean() < 0.9 and near.mean() < 0.2 and wrong.mean() < 0.002
    world.close()
