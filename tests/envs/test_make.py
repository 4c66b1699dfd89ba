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


@pytest.mark.parametrize("options", [{"num_points": 8}, {}])
def test_point_cloud_encoder_appends_the_observed_points(options):
    env = envs.make("boxes", encoder="point_cloud", **options)
    observation = env.reset(seed=0)[0]["observation"]
    num_points = options.get("num_points", 64)
    assert observation.shape == env.observation_space["observation"].shape == (10 + 3 * num_points,)
    expected = PointCloudEncoder(num_points)(envs.TASKS["boxes"].scene)
    np.testing.assert_array_equal(observation[10:], expected)
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
        ({"encoder": "no_such_encoder"}, "no_such_encoder"),
        ({"encoder": "point_cloud", "num_points": 0}, "num_points must be 1 to 9,999, got 0"),
        ({"link_distances": 1, "geometry_source": "ground_truth"}, "link_distances must be a bool"),
        ({"link_distances": True}, "link_distances needs a geometry_source: ground_truth, point_c"),
        (
            {"append_link_distances": True, "geometry_source": "ground_truth"},
            "append_link_distances needs link_distances",
        ),
        ({"geometry_source": "ground_truth"}, "geometry_source needs link_distances or the e"),
        ({"encoder": "point_cloud", "geometry_source": "vae"}, "vae has no decoder"),
    ],
)
def test_wrong_argument_is_rejected_with_the_reason(arguments, message):
    with pytest.raises(ValueError, match=message):
        envs.make("boxes", **arguments)
