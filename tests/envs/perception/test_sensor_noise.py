"""Sensor noise: its statistics, the same numbers for the same seed, latency and rates."""

from dataclasses import replace

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.envs.perception.noise import SensorNoise
from roboarm_nmp.envs.perception.point_clouds import observed_points
from roboarm_nmp.envs.perception.ray_kernels import pixels_with_neighbours
from roboarm_nmp.envs.perception.sensors import (
    NOTHING,
    OBSTACLE,
    Camera,
    PointCloud,
    SceneObservation,
    SensorWorld,
    cardinal,
)
from roboarm_nmp.envs.scenes.motions import Oscillation, Presence
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.evaluation.evaluate import EvaluationError, evaluate

HOME = np.array([0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8])
WALL = Box((-0.5, 0.0, 0.5), (0.1, 8.0, 8.0))
BOX = Box((0.5, 0.2, 0.3), (0.1, 0.1, 0.6))
FACING = Camera(
    (2.5, 0.0, 0.5), (0.0, 0.0, 0.5), size=(100, 100), outputs=("depth", "segmentation")
)
MOVING = Scene((Box((0.5, 0.2, 0.3), (0.1, 0.1, 0.6), motion=Oscillation((0.0, 0.3, 0.0), 1.0)),))


def image(noise, key=1, number=0, sensor=FACING, cameras=1):
    """Depth and classes of the wall in front of the camera."""
    world = SensorWorld(noise)
    world.begin_episode(key, cameras)
    world.show(Scene((WALL,), table=None, floor=None), HOME, number)
    return world.cast(sensor, sensor.size)


def errors(noise, **options):
    depth, classes = image(noise, **options)
    truth, whole = image(SensorNoise())
    wall = (classes == OBSTACLE) & (whole == OBSTACLE)
    return (depth - truth)[wall], (classes == NOTHING).mean()


def test_each_noise_has_its_statistics():
    error, _ = errors(SensorNoise(gaussian=0.004))
    assert abs(error.std() - 0.004) < 0.0002 and abs(error.mean()) < 0.0002
    error, _ = errors(SensorNoise(per_metre=0.002))
    assert abs(error.std() - 0.002 * 2.95) < 0.0003  # the wall is 2.95 m away
    depth, classes = image(SensorNoise(quantisation=0.02))
    steps = depth[classes == OBSTACLE] / 0.02
    assert np.abs(steps - steps.round()).max() < 1e-3
    error, missing = errors(SensorNoise(dropout=0.1))
    assert abs(missing - 0.1) < 0.01 and not error.any()


def test_flying_pixels_are_between_front_and_back():
    depth, classes = image(SensorNoise(flying_pixels=0.5))
    truth, _ = image(SensorNoise())
    flying = np.abs(depth - truth) > 1e-6
    grid = np.pad(truth, 1, mode="edge")
    around = np.stack(
        [grid[1:-1, 1:-1], grid[:-2, 1:-1], grid[2:, 1:-1], grid[1:-1, :-2], grid[1:-1, 2:]]
    )
    low, high = around.min(0), around.max(0)
    at_edge = high - low > 0.05
    assert flying.sum() > 50 and not (flying & ~at_edge).any()
    assert 0.4 < flying.sum() / at_edge.sum() < 0.6
    assert ((depth >= low - 1e-6) & (depth <= high + 1e-6)).all()


def test_edge_filter_removes_flying_pixels_and_keeps_faces():
    truth, whole = image(SensorNoise())
    depth, classes = image(SensorNoise(flying_pixels=1.0))
    flying = np.abs(depth - truth) > 0.05
    filtered, left = image(SensorNoise(flying_pixels=1.0, edge_filter=0.03))
    assert flying.sum() > 100
    assert (left[flying] != NOTHING).mean() < 0.1 < (classes[flying] != NOTHING).mean()
    kept = left != NOTHING
    np.testing.assert_array_equal(filtered[kept], depth[kept])
    _, alone = image(SensorNoise(edge_filter=0.03))
    assert (alone == whole).mean() > 0.99
    lone = pixels_with_neighbours(np.eye(3, dtype=np.float32), np.eye(3) > 0, np.float32(0.1), 3)
    assert not lone.any()


def test_calibration_error_moves_and_turns_a_cloud_rigidly():
    sensor = PointCloud(FACING.eye, FACING.target, num_samples=100**2)
    for noise, limit in (
        (SensorNoise(calibration_mm=5), 0.02),
        (SensorNoise(calibration_degrees=0.5), 0.1),
    ):
        depth, classes = image(noise, sensor=sensor)
        points = sensor.points_of_class(depth, classes, OBSTACLE)
        off = points[:, 0] + 0.45  # the wall is the plane x = -0.45
        assert 1e-4 < np.abs(off).max() < limit
        # It is a plane still.
        plane = np.linalg.lstsq(np.c_[points[:, 1:], np.ones(len(points))], off, rcond=None)[0]
        assert np.abs(np.c_[points[:, 1:], np.ones(len(points))] @ plane - off).max() < 1e-4
        later = image(noise, sensor=sensor, number=7)[0]  # all through an episode
        np.testing.assert_array_equal(depth, later)
        assert (image(noise, sensor=sensor, key=2)[0] != depth).any()


def test_missing_cameras_are_as_many_as_given_and_others_in_each_episode():
    missing = set()
    for key in range(12):
        world = SensorWorld(SensorNoise(missing_cameras=1))
        world.begin_episode(key, 4)
        world.show(Scene((BOX,)), HOME)
        clouds = [sensor.observe(world) for sensor in cardinal(PointCloud).values()]
        silent = [i for i, one in enumerate(clouds) if (one["labels"] == NOTHING).all()]
        assert len(silent) == 1
        missing |= set(silent)
    assert missing == {0, 1, 2, 3}
    world = SensorWorld(SensorNoise(missing_cameras=1))
    world.begin_episode(0, 1)
    world.show(Scene((BOX,)), HOME)
    assert not world.render(FACING, (8, 8)).any()


def test_same_seed_gives_the_same_noise_in_any_order():
    noise = SensorNoise(0.005, 0.002, 0.001, 0.1, 0.3, 1, 3.0, 0.2, seed=4)
    scenes = [
        SceneObservation.of(Scene((BOX,)), HOME, noise, key, number)
        for key in (1, 2)
        for number in (0, 1)
    ]
    clouds = [observed_points(scene).tobytes() for scene in scenes]
    assert len(set(clouds)) == 4
    other = SceneObservation.of(Scene((BOX,)), HOME, SensorNoise(gaussian=0.005, seed=5), 1)
    again = SceneObservation.of(Scene((BOX,)), HOME, SensorNoise(gaussian=0.005, seed=6), 1)
    assert observed_points(other).tobytes() != observed_points(again).tobytes()
    from roboarm_nmp.envs.perception import point_clouds

    point_clouds._observe.cache_clear(), point_clouds._clouds.cache_clear()
    assert [observed_points(scene).tobytes() for scene in reversed(scenes)] == clouds[::-1]


def make(scene, **options):
    return envs.make(scene, link_distances=True, geometry_source="point_cloud", **options)


def scenes_of(env, steps):
    """What is observed after each of some steps, as numbers of observations."""
    numbers = []
    for _ in range(steps):
        env.step(np.full(7, 0.01))
        numbers.append(env.get_wrapper_attr("observed_scene").number)
    return numbers


def test_rate_and_latency_of_observations():
    query = {"start": HOME, "goal": HOME + 0.3}
    for options, expected in (
        ({"observe_every": 3}, [0, 0, 1, 1, 1, 2]),
        ({"sensor_noise": SensorNoise(latency=2), "observe_every": 1}, [0, 0, 1, 2, 3, 4]),
        ({"sensor_noise": SensorNoise(latency=1), "observe_every": 2}, [0, 0, 1, 1, 2, 2]),
        ({"sensor_noise": SensorNoise(gaussian=0.01)}, [0] * 6),
    ):
        env = make(Scene((BOX,)), **options)
        env.reset(options=query)
        assert scenes_of(env, 6) == expected, options
        env.close()


def test_moving_obstacles_are_observed_in_every_step_where_they_are():
    env = make(MOVING, encoder="point_cloud", num_points=16)
    observation, _ = env.reset(options={"start": HOME, "goal": HOME + 0.3})
    clouds = []
    for step in range(8):
        scene = env.get_wrapper_attr("observed_scene")
        assert scene.number == step and scene.obstacles == env.unwrapped.current_scene.obstacles
        points, box = observed_points(scene), scene.obstacles[0]
        beyond = np.abs(points - np.array(box.position)) - np.array(box.size) / 2
        assert len(points) > 20 and np.abs(beyond.max(1)).max() < 1e-5
        clouds.append(observation["observation"][10:].tobytes())
        observation, *_ = env.step(np.zeros(7))
    assert len(set(clouds)) == 8
    env.close()


def test_sensors_need_a_scene_at_one_time():
    """Of a scene with motions they would observe obstacles where they never are."""
    late = Presence(((1.0, 2.0),), MOVING.obstacles[0].motion)
    scene = Scene((replace(BOX, motion=late),))
    for observe in (
        observed_points,
        lambda scene: observed_points(SceneObservation.of(scene, HOME)),
        lambda scene: SensorWorld().show(scene, HOME),
    ):
        with pytest.raises(ValueError, match=r"observe scene\.at\(t\)"):
            observe(scene)
    assert len(observed_points(scene.at(0.0))) == 0 < len(observed_points(scene.at(1.5)))


def test_evaluation_with_noise_does_not_depend_on_earlier_episodes():
    noise = SensorNoise(gaussian=0.01, missing_cameras=1)
    options = {"task": "random_boxes_hard", "split": "validation", "sensor_noise": noise}
    options |= {"geometry_source": "point_cloud", "measure_clearance": True}
    results = [evaluate("via-points", num_queries=n, **options) for n in (2, 2)]
    assert results[0]["sensor_noise"] == {"gaussian": 0.01, "missing_cameras": 1}
    assert results[0]["success_rate"] == results[1]["success_rate"]
    assert results[0]["path_length"] == results[1]["path_length"]
    with pytest.raises(EvaluationError, match="this policy observes nothing of the scene"):
        evaluate("go-to-goal", "wall", sensor_noise=noise, num_queries=1)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (["gausian=0.1"], "did you mean gaussian"),
        (["gaussian=nan"], "gaussian must be a number from 0 to 1000"),
        (["dropout=1.5"], "a number from 0 to 1,"),
        (["latency=100000"], "latency must be a whole number from 0 to 1000"),
    ],
)
def test_invalid_noise_is_rejected(settings, complaint):
    with pytest.raises(ValueError, match=complaint):
        SensorNoise.parse(settings)


def test_invalid_rate_is_rejected():
    for every in (0, -1, 1.5, True):
        with pytest.raises(ValueError, match="observe_every"):
            make(Scene(), observe_every=every)
    with pytest.raises(ValueError, match="sensor_noise"):
        make(Scene(), sensor_noise=0.1)
