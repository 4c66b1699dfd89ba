import pytest
from encoder_trainers import two_sensors

from roboarm_nmp.scene_embedding_train import collect


@pytest.fixture(scope="session")
def observations(tmp_path_factory):
    """A folder of observations of 20 scenes, in three shards."""
    folder = tmp_path_factory.mktemp("observations")
    options = {"num": 20, "shard_size": 8, "image_size": 32, "num_samples": 400, "workers": 1}
    with two_sensors():
        collect.collect(collect.Args(output=folder, **options), progress=False)
    return folder
