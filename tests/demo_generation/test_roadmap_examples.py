"""demo_generation/roadmap_examples.py: examples by hand."""

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.roadmap_paths import load_roadmap_paths, shard_bytes
from roboarm_nmp.datasets.shards import shard_path
from roboarm_nmp.demo_generation.roadmap_examples import RoadmapExamples
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.encoders import make_encoder
from roboarm_nmp.envs.perception.geometry_source import ground_truth_checker

HARD = "random_boxes_hard"
# A path along two axes, whose remaining length is easily computed.
CORNER = np.zeros((3, 7), np.float32)
CORNER[1:, 0], CORNER[2, 1] = 0.5, 0.5


def examples_of(paths, count, noise):
    return RoadmapExamples(
        HARD, paths, make_encoder("oracle"), ground_truth_checker, 1, count=count, noise=noise
    )


def write_paths(folder, scenes, paths):
    folder.mkdir(exist_ok=True)
    shard_path(folder, 0).write_bytes(shard_bytes(HARD, 0, 0, scenes, paths, "a test"))
    return folder


def test_examples_continue_paths_to_either_end(tmp_path):
    scene = envs.get_task(HARD).scene.sample(np.random.default_rng(3))
    paths = load_roadmap_paths(write_paths(tmp_path, [scene], [[CORNER, CORNER + 0.25]]))
    code, drawn = examples_of(paths, 96, 0.0)(5)
    np.testing.assert_array_equal(code, make_encoder("oracle")(scene))
    states, goals = drawn["observation"][:, :7], drawn["desired_goal"][:, :7]
    offset = states[:, 6:]  # of the second path
    assert set(offset.ravel().round(5)) == {0.0, 0.25}
    travelled = (states - offset).sum(1)  # from the path's first point
    forwards = goals[:, 1] - offset[:, 0] > 0.25
    assert 20 < forwards.sum() < 76
    np.testing.assert_allclose(goals - offset, np.where(forwards[:, None], CORNER[2], 0), atol=1e-6)

    def at(travelled):
        points = np.zeros((len(travelled), 7))
        points[:, 0], points[:, 1] = np.minimum(travelled, 0.5), np.maximum(travelled - 0.5, 0.0)
        return points

    np.testing.assert_allclose(states - offset, at(travelled), atol=1e-6)
    assert travelled.min() < 0.15 and travelled.max() > 0.85 and np.ptp(travelled[forwards]) > 0.7
    after = np.clip(np.where(forwards, travelled + 0.1, travelled - 0.1), 0.0, 1.0)
    moves = at(after) - at(travelled)
    lengths = np.linalg.norm(moves, axis=1)
    np.testing.assert_allclose(drawn["direction"] * lengths[:, None], moves, atol=1e-5)
    left = np.where(forwards, 1.0 - after, after)
    np.testing.assert_allclose(drawn["length"], lengths + left, atol=1e-5)

    checker = CollisionChecker(scene)
    for name, where in (("link_distances", states), ("goal_link_distances", goals)):
        nearest = checker.signed_distances(where, self_collisions=False)
        near = np.minimum(nearest.distance, 0.3)
        np.testing.assert_allclose(drawn[name][..., 0], near, atol=1e-5)
        gradient = np.where(near[..., None] < 0.3, nearest.gradient, 0.0)
        # (Rounded to float32, another point of the same face may be the nearest.)
        assert (np.abs(drawn[name][..., 1:] - gradient) < 1e-4).mean() > 0.99


def test_directions_of_noisy_states_lead_back_to_the_path(tmp_path):
    scene = envs.get_task(HARD).base_scene
    paths = load_roadmap_paths(write_paths(tmp_path, [scene], [[CORNER]]))
    examples = examples_of(paths, 4000, 0.03)
    (_, one), (_, again), (_, other) = (examples(number) for number in (1, 1, 2))
    assert all(np.array_equal(one[name], again[name]) for name in one)
    assert not np.array_equal(one["observation"], other["observation"])
    off = one["observation"][:, 2:7]  # in these joints the path is zero
    assert off.std() == pytest.approx(0.03, rel=0.05)
    back = one["direction"][:, 2:]
    assert (back * off <= 1e-6).all() and np.linalg.norm(back, axis=1).mean() > 0.2
