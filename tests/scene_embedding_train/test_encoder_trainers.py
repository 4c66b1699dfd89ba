"""Runs of the encoders' trainers on a few scenes: files, resume, devices, errors."""

import json

import numpy as np
import pytest
import torch
from encoder_trainers import FOLDER, OF_CLOUDS, SCRIPTS, command
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainers import GPU, error_here, run_here, shared_blocks, stopped_run

from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.envs.perception.encoders import make_encoder
from roboarm_nmp.envs.perception.sensors import PointCloud
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.scene_embedding_train import clouds, images


@pytest.fixture(scope="module", params=SCRIPTS)
def run(request, observations, tmp_path_factory):
    """(name, folder) of a finished run."""
    folder = tmp_path_factory.mktemp(request.param)
    run_here(*command(request.param, observations, folder)[1:])
    return request.param, next(folder.iterdir())


def test_shared_blocks_have_not_drifted_apart():
    blocks = shared_blocks(FOLDER / "vae.py")
    assert shared_blocks(FOLDER / "vqvae.py") == blocks and len(blocks) == 4


def test_run_writes_an_encoder_a_result_and_events(run):
    name, folder = run
    result = json.loads((folder / "result.json").read_text())
    assert result["updates"] == 8 and result["scenes"] == 14
    assert result["best_update"] in (4, 8)
    events = EventAccumulator(str(folder), size_guidance={"images": 0}).Reload()
    scalars = set(events.Tags()["scalars"])
    (tag,) = events.Tags()["images"]
    image = events.Images(tag)[0]
    if name == "pointnet2":
        scores = {"accuracy", "iou_robot", "iou_static", "iou_obstacle", "absent"}
        assert (image.width, image.height) == (2 * 160, 160)
    elif name == "field":
        scores = {"error_near", "error_5cm", "error_10cm", "error_20cm", "error_40cm"}
        assert (image.width, image.height) == (3 * 96, 2 * 96)
    else:
        scores = {"error", "error_foreground", "mean_image_error", "mean_image_error_foreground"}
        assert (image.width, image.height) == (2 * 16, 2 * 16)
    assert {f"eval/{name}" for name in scores} <= scalars
    assert all(0 <= result[name] <= 1 for name in scores)
    assert [event.step for event in events.Scalars(f"eval/{min(scores)}")] == [4, 8]


def test_saved_encoder_runs_without_its_script(run, observations):
    name, folder = run
    encoder = load_network(folder / "encoder.onnx")
    assert encoder.metadata["kind"] == "encoder"
    encode = make_encoder(folder / "encoder.onnx")
    read = Observations(observations)
    if name in OF_CLOUDS:
        inputs = {}
        for sensor in read.sensors:
            if isinstance(read.sensors[sensor], PointCloud):
                shards = [clouds.whole_clouds(read, shard, sensor) for shard in range(3)]
                points, labels = (torch.cat(one) for one in zip(*shards, strict=True))
                inputs |= {f"{sensor}_points": points, f"{sensor}_labels": labels}
    else:
        data, cameras = images.load_images(read, 32)
        inputs = {one: torch.from_numpy(data[:, i].copy()) for i, one in enumerate(cameras)}
    together = encoder(**inputs)
    size = 64 if name == "field" else 32  # of two sensors
    assert together.shape == (20, size) and together.dtype == torch.float32
    alone = [encoder(**{key: value[i : i + 1] for key, value in inputs.items()}) for i in range(20)]
    torch.testing.assert_close(torch.cat(alone), together, rtol=1e-4, atol=1e-5)
    assert together.std(0).max() > 0
    scenes = read.scenes(0)
    assert encode.size == size and (encode(scenes[0]) != encode(scenes[1])).any()
    if name == "field":
        assert encode.distances(scenes[0], np.random.rand(7, 3)).shape == (7,)


@pytest.mark.parametrize("device", ["cpu", GPU])
def test_stopped_and_resumed_is_bit_identical_to_uninterrupted(
    run, observations, tmp_path, device, capsys
):
    name, finished = run
    if name not in ("vqvae", "field"):  # one of images, and one of point clouds
        pytest.skip("resumes as the others do")
    if device != "cpu":
        whole = tmp_path / "whole"
        run_here(*command(name, observations, whole, "--device", device)[1:])
        (finished,) = whole.iterdir()
    parts = tmp_path / "parts"
    folder = stopped_run(parts, *command(name, observations, parts, "--device", device)[1:])
    run_here(FOLDER / f"{name}.py", "--resume", folder)
    one, other = (
        torch.load(path / "checkpoint.pt", weights_only=True)["model"]
        for path in (folder, finished)
    )
    for key in one:
        assert torch.equal(one[key], other[key]), key


# (PointNet++ takes half a minute to export.)
@pytest.mark.parametrize("name", ["vae", "vqvae", "field"])
def test_update_evaluation_and_resume_run_on_another_device(
    name, observations, tmp_path, another_device
):
    """One update and one evaluation on another device; of one trainer a resume, too."""
    _, script, *flags = command(name, observations, tmp_path, "--device", another_device)
    flags += ["--total-updates", "1", "--eval-every", "1"]
    flags += ["--restart-every", "1"] if name == "vqvae" else []
    if name == "field" and another_device == "meta":  # which autocast does not know
        flags += ["--bf16", "False"]
    run_here(script, *flags)
    (folder,) = tmp_path.iterdir()
    assert load_network(folder / "encoder.onnx").metadata["step"] == 1
    if name != "vae":  # all resume alike, and each evaluation exports a network
        return
    args = json.loads((folder / "args.json").read_text())
    (folder / "args.json").write_text(json.dumps(args | {"total_updates": 2}))
    run_here(script, "--resume", str(folder))
    assert json.loads((folder / "result.json").read_text())["updates"] == 2
    weights = torch.load(folder / "checkpoint.pt", weights_only=True)["model"].values()
    assert {tensor.device.type for tensor in weights} == {another_device}


def test_folder_without_observations_is_rejected(tmp_path, capsys):
    message = error_here(capsys, *command("vae", tmp_path, tmp_path)[1:])
    last = message.splitlines()[-1]
    assert last.startswith("vae.py: --observations: ") and "no observations" in last
