"""Cameras and point clouds: what they observe, when, and without side effects."""

import math
import re

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from paths import ROOT

from roboarm_nmp import envs
from roboarm_nmp.envs.perception.sensors import (
    CARDINAL,
    OUTPUTS,
    Camera,
    PointCloud,
    SensorWorld,
    cardinal,
    sensors_from_json,
    sensors_to_json,
)
from roboarm_nmp.envs.wrappers import SensorWrapper

HOME = np.array([0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8])
MIX = {
    "above": Camera((0.1, 0.0, 2.5), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), size=(32, 24)),
    "depth": Camera((1.6, 0.0, 0.8), size=(20, 20), outputs=("depth",)),
    "cloud": PointCloud((0.0, 1.6, 0.8), num_samples=400),
}


@pytest.fixture(scope="module")
def world():
    world = SensorWorld()
    yield world
    world.close()


def test_observations_depend_on_scene_and_arm_only(world):
    sensors = {**cardinal(outputs=OUTPUTS), "cloud": cardinal(PointCloud)["back"]}
    tasks = [envs.TASKS[name].scene for name in ("boxes", "double_walls", "narrow_shelves")]

    def observe(world, scene, configuration):
        world.show(scene, configuration)
        return {name: sensor.observe(world) for name, sensor in sensors.items()}

    first = observe(world, tasks[0], HOME)
    other = observe(world, tasks[1], HOME)
    observe(world, tasks[2], np.zeros(7))
    fresh = SensorWorld()
    for again in (observe(world, tasks[0], HOME), observe(fresh, tasks[0], HOME)):
        for name, outputs in first.items():
            for output, array in outputs.items():
                np.testing.assert_array_equal(again[name][output], array)
    fresh.close()
    assert (first["front"]["rgb"] != other["front"]["rgb"]).any()


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: Camera((0, 0, 1), (0, 0, 0)), "up direction"),
        (lambda: Camera((1, 0, 1), (1, 0, 1)), "from its target"),
        (lambda: Camera((1, 0, math.nan)), "eye must be three"),
        (lambda: Camera((1, 0, 1), outputs=("rgb", "smell")), "outputs"),
        (lambda: PointCloud((1, 0, 1), near=1.0, far=0.5), "near < far"),
        (lambda: PointCloud((1, 0, 1), num_samples=10), "square"),
    ],
)
def test_invalid_sensor_is_rejected(make, complaint):
    with pytest.raises(ValueError, match=complaint):
        make()


def test_sensors_survive_json():
    assert sensors_from_json(sensors_to_json(MIX)) == MIX


# --- The wrapper


def same(one, other):
    return all(
        np.array_equal(one[name][output], other[name][output])
        for name in one
        for output in one[name]
    )


def test_sensor_wrapper_is_a_gymnasium_environment():
    check_env(SensorWrapper(envs.make("random_boxes_easy", horizon=5), MIX), skip_render_check=True)


def test_sensors_observe_once_per_episode_or_in_every_step():
    for every_step in (False, True):
        env = SensorWrapper(envs.make("random_boxes_hard"), MIX, 1 if every_step else None)
        first, _ = env.reset(seed=4)
        assert env.observation_space.contains(first)
        for _ in range(20):
            later = env.step(np.full(7, 0.3, np.float32))[0]
        assert same(first["sensors"], later["sensors"]) == (not every_step)
        query = (env.unwrapped.start_configuration, env.unwrapped.goal_configuration)
        scene = env.unwrapped.scene
        again, _ = env.reset_specific(*query, scene)
        assert same(first["sensors"], again["sensors"])
        assert not same(first["sensors"], env.reset()[0]["sensors"])  # another scene
        env.close()


def test_code_of_perception_page_runs():
    page = (ROOT / "docs/guide/perception.md").read_text()
    names = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)
    assert names["image"].shape == (224, 224, 3) and set(names["sensors"]) == {*CARDINAL, "above"}
    assert names["z"].shape == (64,) and np.isfinite(names["z"]).all() and names["z"].std() > 0
    assert names["observation"]["goal_link_distances"].shape == (10, 8)
    assert names["tokens"].shape == (32, 3)
    assert names["distances"].shape == names["points"].shape[:1]
    assert names["distances"].max() < 0.0151
    observed = names["env"].reset(seed=0)[0]["observation"]
    assert observed.shape == (10 + 3 * 32,)


def test_observing_changes_no_episode():
    plain = envs.make("random_boxes_hard", render_mode="rgb_array")  # with a goal's marker
    wrapped = SensorWrapper(
        envs.make("random_boxes_hard", render_mode="rgb_array"), MIX, observe_every=1
    )
    marked = wrapped.reset(seed=3)[0]["sensors"]
    unmarked = SensorWrapper(envs.make("random_boxes_hard"), MIX)
    assert same(marked, unmarked.reset(seed=3)[0]["sensors"])
    rng = np.random.default_rng(0)
    for episode in range(2):
        expected, observed = plain.reset(seed=episode)[0], wrapped.reset(seed=episode)[0]
        for _ in range(20):
            for name, array in expected.items():
                np.testing.assert_array_equal(observed[name], array)
            action = rng.uniform(-0.05, 0.05, 7)
            expected, observed = plain.step(action)[0], wrapped.step(action)[0]
    for env in (plain, wrapped, unmarked):
        env.close()
