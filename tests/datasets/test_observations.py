"""Collecting observations: the same files after any interruption, and exact when read back."""

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.datasets.shards import shard_path
from roboarm_nmp.envs.perception.sensors import (
    Camera,
    SensorWorld,
)
from roboarm_nmp.scene_embedding_train import collect
from roboarm_nmp.utils import workers


def args(output, **more):
    small = {"num": 5, "shard_size": 2, "image_size": 16, "num_samples": 100, "workers": 1}
    return collect.Args(task="random_boxes_hard", output=output, **small | more)


def shards(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    collect.collect(args(folder), progress=False)
    return folder


def test_stored_observations_are_those_of_the_sensors(whole):
    observations = Observations(whole)
    assert len(observations) == 5 and observations.offsets.tolist() == [0, 2, 4, 5]
    assert observations.task == "random_boxes_hard"
    world, env = SensorWorld(), envs.make("random_boxes_hard")
    for shard in range(3):
        configurations = observations.read(shard, "configuration")
        for row, scene in enumerate(observations.scenes(shard)):
            env.set_scene(scene)
            assert 4 <= len(scene.obstacles) <= 8 and env.is_feasible(configurations[row])
            world.show(scene, configurations[row])
            for name, sensor in observations.sensors.items():
                observed = sensor.observe(world)
                if isinstance(sensor, Camera):
                    read = {"rgb": observations.read(shard, f"{name}/rgb")[row]}
                else:
                    depth = observations.read(shard, f"{name}/depth")[row] * (5.0 / 65_535)
                    read = sensor.points(
                        depth, observations.read(shard, f"{name}/segmentation")[row]
                    )
                for output, array in observed.items():
                    np.testing.assert_allclose(read[output], array, atol=1e-4)
    world.close()
    env.close()


def test_files_do_not_depend_on_workers_or_on_earlier_shards(whole, tmp_path, monkeypatch):
    made = []
    run = workers.run

    def record(make, arguments, jobs, *more, **others):
        made.extend(jobs)
        return run(make, arguments, jobs, *more, **others)

    for number in (0, 1):
        path = shard_path(tmp_path, number)
        path.write_bytes(shard_path(whole, number).read_bytes())
    collect.collect(args(tmp_path, num=3), progress=False)  # both exist, the last is longer
    shard_path(tmp_path, 1).unlink()
    collect.collect(args(tmp_path, num=3), progress=False)  # now it is shorter
    monkeypatch.setattr(workers, "run", record)
    collect.collect(args(tmp_path, workers=2), progress=False)
    assert made == [(1, 2, 4), (2, 4, 5)] and shards(tmp_path) == shards(whole)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [({"task": "three_shelves"}, "for testing only"), ({"num_samples": 10}, "square number")],
)
def test_bad_flag_is_rejected(tmp_path, change, complaint):
    given = args(tmp_path)
    for name, value in change.items():
        setattr(given, name, value)
    with pytest.raises(ValueError, match=complaint):
        collect.collect(given, progress=False)
    assert not shards(tmp_path)


def test_shards_of_another_collection_are_rejected(whole, tmp_path):
    for name, contents in shards(whole).items():
        (tmp_path / name).write_bytes(contents)
    with pytest.raises(ValueError, match="another command: .*--seed 0"):
        collect.collect(args(tmp_path, seed=1), progress=False)
    assert shards(tmp_path) == shards(whole)


def test_damaged_shard_is_rejected_by_name(whole, tmp_path):
    for name, contents in shards(whole).items():
        (tmp_path / name).write_bytes(contents)
    good = (tmp_path / "shard_00001.h5").read_bytes()
    (tmp_path / "shard_00001.h5").write_bytes(good[: len(good) // 2])
    with pytest.raises(DatasetError, match=r"shard_00001\.h5: truncated or corrupt"):
        Observations(tmp_path)
    bad = bytearray(good)
    at = good.index(Observations(whole).read(1, "configuration").tobytes())
    bad[at + 5] ^= 16
    (tmp_path / "shard_00001.h5").write_bytes(bad)
    with pytest.raises(DatasetError, match=r"shard_00001\.h5: configuration is missing or corrupt"):
        Observations(tmp_path).read(1, "configuration")
