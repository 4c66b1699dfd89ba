"""`make`: its arguments, alone and together, and each of their errors."""

import numpy as np
import pytest

import roboarm_nmp
from roboarm_nmp import envs
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.encoders import PointCloudEncoder, make_encoder
from roboarm_nmp.envs.perception.geometry_source import find_geometry_source


def test_top_level_names_are_those_of_envs():
    assert roboarm_nmp.make is envs.make and roboarm_nmp.TASKS is envs.TASKS
    with pytest.raises(AttributeError, match="no attribute 'mak'"):
        roboarm_nmp.mak  # noqa: B018


@pytest.mark.parametrize("num_points", [1, 8, 64])
def test_point_cloud_encoder_appends_the_observed_points(num_points):
    env = envs.make("boxes", encoder="point_cloud", num_points=num_points)
    observation = env.reset(seed=0)[0]["observation"]
    assert observation.shape == env.observation_space["observation"].shape == (10 + 3 * num_points,)
    expected = PointCloudEncoder(num_points)(envs.TASKS["boxes"].scene)
    np.testing.assert_array_equal(observation[10:], expected)
    env.close()


def test_num_points_defaults_to_64():
    env = envs.make("boxes", encoder="point_cloud")
    assert env.encoder.num_points == 64
    env.close()


def test_link_distances_come_from_the_geometry_source():
    scene = envs.TASKS["boxes"].scene
    states = np.random.default_rng(0).uniform(-1, 1, (20, 7))
    found = {}
    for source in ("ground_truth", "point_cloud", "field"):
        env = envs.make("boxes", link_distances=True, geometry_source=source)
        found[source] = env.link_distances_at(states)
        expected = find_geometry_source(source)(scene).link_distances(states)
        np.testing.assert_array_equal(found[source], expected)
        assert "goal_link_distances" not in env.observation_space.spaces  # the goal is a position
        env.close()
    truth = CollisionChecker(scene).link_distances(states)
    np.testing.assert_array_equal(found["ground_truth"], truth)
    for other in ("point_cloud", "field"):
        assert np.abs(found[other] - truth).max() > 1e-3


def test_point_cloud_encoder_with_a_decoder_encodes_decoded_points():
    env = envs.make("boxes", encoder="point_cloud", num_points=8, geometry_source="field")
    observation = env.reset(seed=0)[0]["observation"]
    expected = make_encoder("point_cloud", 8, "field")(env.scene)
    np.testing.assert_array_equal(observation[10:], expected)
    assert not np.array_equal(expected, make_encoder("point_cloud", 8)(env.scene))
    assert "link_distances" not in env.observation_space.spaces
    env.close()


@pytest.mark.parametrize("source", ["ground_truth", "point_cloud"])
def test_point_cloud_encoder_observes_points_whatever_the_source_without_a_decoder(source):
    arguments = {"link_distances": True, "geometry_source": source}
    env = envs.make("boxes", encoder="point_cloud", num_points=8, **arguments)
    assert env.encoder is make_encoder("point_cloud", 8, None)
    env.close()


def test_encoded_scene_follows_appended_link_distances():
    arguments = {"link_distances": True, "append_link_distances": True}
    arguments |= {"geometry_source": "ground_truth", "encoder": "oracle"}
    env = envs.make("boxes", **arguments)
    observation = env.reset(seed=0)[0]
    parts = np.split(observation["observation"], [10, 90])
    np.testing.assert_array_equal(parts[1], observation["link_distances"].ravel())
    np.testing.assert_array_equal(parts[2], env.encoder(env.scene))
    env.close()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"encoder": 3}, "encoder must be a name or a path, got 3"),
        ({"geometry_source": ["field"]}, r"geometry_source must be a name or a path"),
        ({"encoder": "no_such_encoder"}, "no_such_encoder"),
        ({"encoder": "point_cloud", "num_points": 0}, "num_points must be 1 to 9,999, got 0"),
        ({"encoder": "point_cloud", "num_points": 10_000}, "num_points must be 1 to 9,999"),
        ({"link_distances": 1, "geometry_source": "ground_truth"}, "link_distances must be a bool"),
        ({"append_link_distances": "yes"}, "append_link_distances must be a bool"),
        ({"goal_link_distances": None}, "goal_link_distances must be a bool"),
        ({"link_distances": True}, "link_distances needs a geometry_source: ground_truth, point_c"),
        (
            {"append_link_distances": True, "geometry_source": "ground_truth"},
            "append_link_distances needs link_distances",
        ),
        ({"geometry_source": "ground_truth"}, "geometry_source goes with link_distances, or the e"),
        (
            {"geometry_source": "field", "encoder": "oracle"},
            "geometry_source goes with link_distances, or the encoder point_cloud",
        ),
        (
            {"link_distances": True, "geometry_source": "obstacles"},
            "a geometry source is ground_truth, point_cloud or an encoder with a decoder",
        ),
        (
            {"link_distances": True, "geometry_source": "vae"},
            "an encoder with a decoder: vae has no decoder",
        ),
        ({"encoder": "point_cloud", "geometry_source": "vae"}, "vae has no decoder"),
        ({"goal_type": "poses"}, "goal_type must be one of"),
    ],
)
def test_wrong_argument_is_rejected_with_the_reason(arguments, message):
    with pytest.raises(ValueError, match=message):
        envs.make("boxes", **arguments)


@pytest.mark.parametrize("task", [3, None, ["wall"]])
def test_task_that_is_no_text_is_rejected(task):
    with pytest.raises(ValueError, match="task must be a name or a path"):
        envs.make(task)
