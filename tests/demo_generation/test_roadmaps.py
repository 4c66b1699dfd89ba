"""Roadmaps: paths with a margin, labels of any configuration, and files that repeat exactly."""

from dataclasses import replace

import numpy as np
import pytest
from paths import LIBRARY

from roboarm_nmp import envs
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.datasets.roadmap_paths import load_roadmap_paths
from roboarm_nmp.datasets.shards import shard_path
from roboarm_nmp.demo_generation.place_configurations import place_configurations
from roboarm_nmp.demo_generation.roadmaps import Args, Roadmap, collect
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Scene, to_array

SMALL = {"scenes": 5, "paths_per_scene": 6, "num_nodes": 150, "shard_size": 2, "workers": 1}


def hard_scene(number):
    return envs.get_task("random_boxes_hard").scene.sample(np.random.default_rng(number))


def distances(scene, states):
    return CollisionChecker(scene).signed_distances(states).distance.min(-1)


def along(path, spacing=0.02):
    """Points on a path."""
    pieces = [
        np.linspace(a, b, 1 + int(np.ceil(np.linalg.norm(b - a) / spacing)))
        for a, b in zip(path[:-1], path[1:], strict=True)
    ]
    return np.concatenate(pieces)


@pytest.fixture(scope="module")
def roadmap():
    return Roadmap(hard_scene(3), np.random.default_rng(0))


def test_paths_keep_the_margin(roadmap):
    paths = roadmap.random_paths(60, np.random.default_rng(1))
    assert len(paths) == 60
    assert all(path.dtype == np.float32 and path.shape == (len(path), 7) for path in paths)
    near = [distances(roadmap.scene, along(path)) for path in paths]
    assert min(x.min() for x in near) > -1e-4
    assert (np.concatenate(near) < roadmap.margin - 0.001).mean() < 0.1
    # Where both ends and the whole path have room, the full margin is kept.
    roomy = [x for x in near if min(x[0], x[-1]) > 0.016 and x.min() > 0.006]
    assert len(roomy) > 20
    assert np.mean([x.min() > roadmap.margin - 0.001 for x in roomy]) > 0.9


def test_free_straight_motion_is_the_path():
    roadmap = Roadmap(Scene(), np.random.default_rng(0), num_nodes=100)
    start, goal = np.array([[0.1] * 7, [-0.1] * 7])
    (path,) = roadmap.paths([start], [goal], np.random.default_rng(0))
    np.testing.assert_allclose(path, [start, goal], atol=1e-6)


def colliding(roadmap, depth):
    """Configurations in contact with this depth (m), found on straight lines into obstacles."""
    rng, found = np.random.default_rng(4), []
    starts = roadmap.sample(30, rng, 0.003)
    ends = starts + 0.3 * rng.standard_normal(starts.shape)
    for line in np.linspace(starts, np.clip(ends, -1, 1), 1000, axis=1):
        near = distances(roadmap.scene, line)
        inside = np.flatnonzero(near < -depth)
        if len(inside) and near[inside[0]] > -depth - 0.0005:
            found.append(line[inside[0]])
    return np.array(found[:10])


def test_paths_from_states_in_contact_lead_out_along_the_gradient(roadmap):
    states = colliding(roadmap, 0.008)
    assert len(states) >= 5
    goals = np.repeat(roadmap.sample(1, np.random.default_rng(5), 0.015), len(states), axis=0)
    paths = roadmap.paths(states, goals, np.random.default_rng(6))
    assert sum(path is not None for path in paths) >= 0.7 * len(states)
    for state, path in zip(states, paths, strict=True):
        if path is None:
            continue
        direction = (path[1] - path[0]) / np.linalg.norm(path[1] - path[0])
        before = distances(roadmap.scene, state)
        assert distances(roadmap.scene, path[1:]).min() > -1e-4
        # No random direction is much better than the first one of the path.
        rng = np.random.default_rng(7)
        others = rng.standard_normal((50, 7))
        others /= np.linalg.norm(others, axis=1, keepdims=True)
        gain = distances(roadmap.scene, np.clip(state + 0.002 * direction, -1, 1)) - before
        other = distances(roadmap.scene, np.clip(state + 0.002 * others, -1, 1)) - before
        assert gain > 0
        assert gain > other.max() - 1e-5


# --- Places


def test_place_configurations_are_near_surfaces_with_the_hand_in_a_place():
    task, inside = envs.get_task("containers").scene, 0
    for seed in range(3):
        scene, places = task.sample_with_places(np.random.default_rng([1, seed]))
        ends, on_ways = place_configurations(scene, places, np.random.default_rng(seed), 6)
        assert 3 <= len(ends) <= min(6, len(on_ways))  # not all places are within reach
        assert distances(scene, ends).min() > 0.003 - 1e-4
        for state in ends:
            at = PANDA.forward_kinematics(PANDA.denormalise(state))
            for place in places:
                local = (at - place.centre) @ place.rotation
                inside += (np.abs(local) <= place.size / 2 + 2e-4).all()
    assert inside >= 5  # the others have retreated


def test_paths_lead_out_of_places_and_into_them(tmp_path):
    options = SMALL | {"task": "containers", "scenes": 1, "paths_per_scene": 12}
    found = collect(Args(tmp_path, **options), progress=False).of_scene(0)
    goals = np.unique([path[-1] for path in found], axis=0)
    starts = np.array([path[0] for path in found])
    assert len(found) == 12 and len(goals) <= 3  # one in five is anywhere
    assert (starts[:, None] == goals).all(2).any()
    assert all(np.linalg.norm(np.diff(path, axis=0), axis=1).all() for path in found)


# --- Collections


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("roadmaps")
    collect(Args(folder, **SMALL), progress=False)
    return folder


def test_collection_has_its_scenes_and_free_paths(collected):
    paths = load_roadmap_paths(collected)
    assert len(paths) == 5 and paths.task == "random_boxes_hard" and paths.seed == 0
    np.testing.assert_array_equal(paths.path_offsets, np.arange(6) * 6)
    assert len({paths.scenes[i] for i in range(5)}) == 5
    for i in range(5):
        for path in paths.of_scene(i):
            assert distances(paths.scenes[i], along(path)).min() > -1e-4
    assert sum(len(p) for i in range(5) for p in paths.of_scene(i)) == len(paths.points)
    assert paths.offsets[-1] == len(paths.points)


def test_no_scene_is_that_of_a_query(collected):
    paths = load_roadmap_paths(collected)
    mine = {to_array(paths.scenes[i].obstacles).tobytes() for i in range(len(paths))}
    for split in ("test", "validation"):
        scenes = load_queries("random_boxes_hard", split).scenes
        ends = scenes.offsets
        rows = {scenes.rows[a:b].tobytes() for a, b in zip(ends[:-1], ends[1:], strict=True)}
        assert len(rows) > 10 and not mine & rows


def test_files_do_not_depend_on_the_workers(collected, tmp_path):
    collect(replace(Args(tmp_path, **SMALL), workers=2), progress=False)
    assert files(tmp_path) == files(collected)


@pytest.mark.slow
def test_cluster_makes_the_same_files(collected, tmp_path, cluster):
    collect(Args(tmp_path, **SMALL, ray_address=cluster.address), progress=False)
    assert files(tmp_path) == files(collected)


def test_joined_collections_have_the_paths_of_both(collected, tmp_path):
    collect(Args(tmp_path, **SMALL | {"task": "containers", "scenes": 1}), progress=False)
    parts = [load_roadmap_paths(tmp_path), load_roadmap_paths(collected)]
    joined = load_roadmap_paths([tmp_path, collected])
    assert len(joined) == 6 and joined.task == "containers"
    whole = [(part.scenes[i], part.of_scene(i)) for part in parts for i in range(len(part))]
    for i, (scene, paths) in enumerate(whole):
        assert joined.scenes[i] == scene
        assert all(map(np.array_equal, joined.of_scene(i), paths)) and len(paths) == 6
    assert joined.scenes[0].table is None and joined.scenes[1].table is not None


def test_more_scenes_extend_a_collection(collected, tmp_path):
    collect(Args(tmp_path, **SMALL | {"scenes": 3}), progress=False)
    collect(Args(tmp_path, **SMALL), progress=False)
    assert files(tmp_path) == files(collected)


def test_corrupt_shard_is_rejected_by_name(collected, tmp_path):
    for name, contents in files(collected).items():
        (tmp_path / name).write_bytes(contents)
    (tmp_path / "shard_00000.h5.bak").write_bytes(b"")  # no shard
    path = shard_path(tmp_path, 1)
    good = path.read_bytes()
    points = load_roadmap_paths(tmp_path).of_scene(2)[0]
    place = good.index(points.tobytes())
    path.write_bytes(good[: place + 5] + bytes([good[place + 5] ^ 1]) + good[place + 6 :])
    with pytest.raises(DatasetError, match="shard_00001.h5: points is missing or corrupt"):
        load_roadmap_paths(tmp_path)
    path.write_bytes(good[:2000])
    with pytest.raises(DatasetError, match="shard_00001.h5: truncated or corrupt"):
        load_roadmap_paths(tmp_path)
    with pytest.raises(ValueError, match="shard_00001.h5"):
        collect(Args(tmp_path, **SMALL), progress=False)
    path.unlink()
    with pytest.raises(DatasetError, match="shard_00001.h5: no such file, but later ones exist"):
        load_roadmap_paths(tmp_path)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"seed": 1}, "made by another command"),
        ({"task": "pole_shelves"}, "for testing only"),
        ({"output": LIBRARY / "datasets" / "demos" / "new"}, "repository"),
        ({"margin": 0.0}, "--margin"),
    ],
)
def test_bad_flag_is_rejected(collected, changes, message):
    before = files(collected)
    with pytest.raises(ValueError, match=message):
        collect(replace(Args(collected, **SMALL), **changes), progress=False)
    assert files(collected) == before
    assert not (LIBRARY / "datasets" / "demos" / "new").exists()
