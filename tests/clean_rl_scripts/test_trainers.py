"""All trainers of policies: their files, interrupted and resumed runs, bad flags."""

import io
import json
import math
import os
import signal

import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainers import (
    GPU,
    PATHS,
    TRAINERS,
    command,
    load,
    refusal,
    run_here,
    run_script,
    shared_blocks,
    short_evaluations,
    stopped_run,
)

from roboarm_nmp import envs
from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.training import runs
from roboarm_nmp.training.final_test import RESULTS
from roboarm_nmp.utils.signals import Terminated


@pytest.fixture(params=TRAINERS)
def trainer(request):
    return request.param


FINISHED = {
    "sac_her_mp": ["--goal-type", "combined", "--velocities"],
    "td3_her_mp": ["--goal-type", "config", "--capture-video", "--policy-average", "1"],
    "crl_mp": ["--goal-type", "ee"],
    "bc": ["--goal-type", "pose", "--policy-average", "0.01"],
    "gciql": ["--goal-type", "config"],
    "diffusion": ["--goal-type", "config", "--num-blocks", "1"],
}
LOSSES = {"bc": ["negative_log_likelihood"], "diffusion": ["denoising_loss"]}
LOSSES["crl_mp"] = ["critic_loss", "actor_loss"]


@pytest.fixture(scope="module")
def finished_runs(tmp_path_factory):
    with short_evaluations(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("roboarm_nmp.viewer.images.MAX_FRAMES", 4)
        return {
            name: run_script(name, tmp_path_factory.mktemp(name), *flags)
            for name, flags in FINISHED.items()
        }


@pytest.fixture
def finished_run(finished_runs, trainer):
    return finished_runs[trainer]


# --- Shared blocks


def test_shared_blocks_are_the_same_in_all_trainers():
    trainers = {}  # block -> trainer -> lines
    for trainer, path in PATHS.items():
        for name, lines in shared_blocks(path).items():
            trainers.setdefault(name, {})[trainer] = lines
    assert trainers
    for name, versions in trainers.items():
        assert len(versions) > 1, f"{name} is only in {list(versions)}"
        first, *others = versions.values()
        assert all(lines == first for lines in others), f"{name} of {list(versions)}"


# --- Real runs


def test_run_writes_result_policy_and_tensorboard_events(finished_run, trainer):
    goal_type = FINISHED[trainer][1]
    result = json.loads((finished_run / "result.json").read_text())
    first, last = (300, 600) if "mp" in trainer else (100, 200)
    assert result["steps"] == last and result["num_queries"] == 2
    assert 0 <= result["collision_free_success_rate"] <= result["success_rate"] <= 1
    assert result["goal_type"] == result["args"]["goal_type"] == goal_type
    assert isinstance(json.loads((finished_run / "args.json").read_text())["bf16"], bool)
    progress = torch.load(finished_run / "checkpoint.pt", weights_only=True)["progress"]
    assert (progress["evaluated"], progress["best_step"]) == (last, result["policy_step"])
    if "mp" in trainer:
        assert progress["updates"] == (600 - 200) * 0.1  # after --learning-starts

    events = EventAccumulator(str(finished_run)).Reload()
    scalars = set(events.Tags()["scalars"])
    if "mp" in trainer:
        assert {
            f"charts/{tag}"
            for tag in ("episodic_return", "episodic_length", "success", "contact_share")
        } <= scalars
    for tag in LOSSES.get(trainer, ["qf_loss", "actor_loss"]):
        assert math.isfinite(events.Scalars(f"losses/{tag}")[0].value)
    assert events.Scalars("charts/SPS")[0].value > 0
    for tag in RESULTS[:-1]:  # but for the mean steps of successes
        assert [event.step for event in events.Scalars(f"eval/{tag}")] == [first, last]
    gifs = {path.name for path in finished_run.glob("*.gif")}
    if trainer == "td3_her_mp":  # with --capture-video
        assert gifs == {"eval_episode_300.gif", "eval_episode_600.gif"}
        images = events.Images("eval/episode")
        assert [image.step for image in images] == [300, 600]
        with Image.open(io.BytesIO(images[-1].encoded_image_string)) as gif:
            assert gif.n_frames > 1 and gif.size == (images[-1].width, images[-1].height)
    else:
        assert not gifs
    assert "hyperparameters/text_summary" in events.Tags()["tensors"]


def test_where_contacts_cost_something_the_best_policy_makes_the_fewest(tmp_path, monkeypatch):
    zeros, rates = dict.fromkeys(RESULTS, 0.0), ((0.5, 0.1), (0.4, 0.2))
    found = (zeros | {"success_rate": a, "collision_free_success_rate": b} for a, b in rates)
    monkeypatch.setattr("roboarm_nmp.evaluation.evaluate.evaluate", lambda *_, **__: next(found))
    run = run_script("td3_her_mp", tmp_path, "--contact-cost", "1", "--test-queries", "0")
    result = json.loads((run / "result.json").read_text())
    assert (result["policy_step"], result["validation_success_rate"]) == (600, 0.4)


def test_saved_policy_is_the_running_average_and_acts_without_the_script(
    finished_run, trainer, short_episodes
):
    policy = load_network(finished_run / "policy.onnx")
    metadata = {"kind": "policy", "task": "no_obstacles", "script": trainer, "seed": 1}
    assert metadata.items() <= policy.metadata.items()
    env = envs.make(policy.metadata["task"], **policy.metadata["env"])
    observation, _ = env.reset(seed=0)
    inputs = {name: torch.tensor(value[None]) for name, value in observation.items()}
    if recurrent_size := policy.metadata.get("recurrent_size"):
        inputs["recurrent_state"] = torch.zeros(1, recurrent_size)
    action = policy(**inputs)[0] if recurrent_size else policy(**inputs)
    assert action.shape == (1, 7) and action.abs().max() <= 0.06
    env.step(action[0].numpy())
    if trainer == "bc":
        module = load(trainer)
        state = torch.load(finished_run / "checkpoint.pt", weights_only=True)
        args = module.Args(hidden_size=16, goal_type="pose")
        actor, average = (module.Actor(args, env).eval() for _ in range(2))
        actor.load_state_dict(state["actor"])
        average.load_state_dict(state["actor_average"])
        if policy.metadata["step"] == 200:
            torch.testing.assert_close(action, average(**inputs))
        assert (average(**inputs) - actor(**inputs)).abs().max() > 1e-4
        assert evaluate(finished_run, num_queries=1)["goal_type"] == "pose"
    if trainer in ("sac_her_mp", "td3_her_mp"):
        agent = torch.load(finished_run / "checkpoint.pt", weights_only=True)["agent"]
        trained, average = agent["actor.mlp.0.weight"], agent["actor_average.mlp.0.weight"]
        if trainer == "td3_her_mp":  # --policy-average 1
            assert torch.equal(average, trained)
        else:  # the average forgets the untrained policy soon
            torch.manual_seed(1)
            untrained = load(trainer).Actor(load(trainer).Args(hidden_size=16), env).mlp[0].weight
            assert 0 < (average - trained).norm() < 0.5 * (untrained - trained).norm() < 1


def assert_same(one, other):
    """Of two checkpoints."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one.keys() - {"seconds"}:
            assert_same(one[key], other[key])
    elif isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    else:
        assert one == other


def assert_same_checkpoints(*folders):
    assert_same(*(torch.load(run / "checkpoint.pt", weights_only=True) for run in folders))


@pytest.mark.parametrize("device", ["cpu", GPU])
@pytest.mark.parametrize(
    "name",
    ["sac_her_mp", "crl_mp", "bc"]
    + [pytest.param(name, marks=pytest.mark.slow) for name in ("gciql", "diffusion")],
)
def test_stopped_and_resumed_run_is_bit_identical_to_an_uninterrupted_one(
    tmp_path, name, device, finished_runs, short_episodes
):
    flags, whole = [*FINISHED[name], "--device", device], finished_runs[name]
    if device != "cpu":
        whole = run_script(name, tmp_path / "whole", *flags)
    folder = tmp_path / "stopped"
    stopped = stopped_run(folder, *command(name, folder, *flags)[1:])
    run_here(PATHS[name], "--resume", stopped)
    assert_same_checkpoints(whole, stopped)
    results = [json.loads((run / "result.json").read_text()) for run in (whole, stopped)]
    assert results[0]["success_rate"] == results[1]["success_rate"]


def test_signal_between_evaluations_keeps_the_transitions_of_running_episodes(
    tmp_path, monkeypatch, short_episodes
):
    advance = runs.Run.advance

    def advance_and_signal(run, count=1):
        advance(run, count)
        if run.step == 351:
            os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(runs.Run, "advance", advance_and_signal)
        run_script("sac_her_mp", tmp_path, *FINISHED["sac_her_mp"])
    assert end.value.code == 143
    (run,) = tmp_path.iterdir()
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    assert state["counts"]["step"] == len(state["buffer"]["arrays"]["remaining"]) == 351
    run_here(PATHS["sac_her_mp"], "--resume", run)
    assert json.loads((run / "result.json").read_text())["steps"] == 600


def test_evaluation_that_a_signal_ends_is_repeated_by_the_resumed_run(
    tmp_path, monkeypatch, finished_runs, short_episodes
):
    def interrupted_evaluation(*_, **__):
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("the evaluation went on")

    with monkeypatch.context() as patch, pytest.raises(Terminated):
        patch.setattr("roboarm_nmp.evaluation.evaluate.evaluate", interrupted_evaluation)
        run_script("bc", tmp_path, *FINISHED["bc"])
    (run,) = tmp_path.iterdir()
    assert not (run / "policy.onnx").exists()
    run_here(PATHS["bc"], "--resume", run)
    assert_same_checkpoints(finished_runs["bc"], run)


def test_run_stops_at_a_success_rate(tmp_path, monkeypatch):
    success = dict.fromkeys(RESULTS, 1.0)
    monkeypatch.setattr("roboarm_nmp.evaluation.evaluate.evaluate", lambda *_, **__: success)
    flags = ["--updates-per-step", "0", "--stop-at-success", "1.0", "--test-queries", "0"]
    run = run_script("sac_her_mp", tmp_path, *FINISHED["sac_her_mp"], *flags)
    assert json.loads((run / "result.json").read_text())["steps"] == 300


def test_diverged_run_ends(tmp_path):
    with pytest.raises(FloatingPointError, match="the parameters of `actor` are no longer finite"):
        run_here(*command("bc", tmp_path, "--learning-rate", "1e30")[1:])
    assert not list(tmp_path.glob("*/policy.onnx")) and not list(tmp_path.glob("*/checkpoint.pt"))


@pytest.mark.parametrize(
    "flags, message",
    [
        (["--task", "walls"], "unknown task 'walls': did you mean wall?"),
        (["--task", "narrow_shelves"], "narrow_shelves is for testing only"),
        (["--demo-prob", "1", "--velocities"], "demonstrations have no velocities"),
        (["--demos", "demos.h5"], "--demos and --bc-weight go with --demo-prob"),
        (["--link-distances"], "--link-distances: link_distances needs a geometry_source"),
    ],
)
def test_bad_flags_are_rejected(tmp_path, flags, message, capsys):  # by a shared block
    assert message in refusal("sac_her_mp", capsys, tmp_path, *flags)
