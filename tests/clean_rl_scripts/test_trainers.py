"""All trainers of policies: their files, interrupted and resumed runs, bad flags."""

import json
import os
import signal
import subprocess
import time

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainers import (
    GPU,
    PATHS,
    TRAINERS,
    command,
    error_here,
    load,
    panda_env,
    refusal,
    run_here,
    run_script,
)

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import demo_path
from roboarm_nmp.envs.perception.encoders import SceneEncoder
from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.networks.exported_networks import load_network
from roboarm_nmp.training import protocol, runs


@pytest.fixture(params=TRAINERS)
def trainer(request):
    return request.param


FINISHED = {
    **dict.fromkeys(("sac_her_mp", "td3_her_mp"), ["--goal-type", "combined", "--velocities"]),
    "bc": ["--goal-type", "combined", "--eval-queries", "1", "--test-queries", "2"],
}
FEW_QUERIES = ["--eval-queries", "1", "--test-queries", "1"]


@pytest.fixture(scope="module")
def finished_runs(tmp_path_factory):
    return {
        name: run_script(name, tmp_path_factory.mktemp(name), *flags)
        for name, flags in FINISHED.items()
    }


@pytest.fixture
def finished_run(finished_runs, trainer):
    return finished_runs[trainer]


# --- Shared blocks


def shared_blocks(trainer):
    """Name -> lines of a trainer's blocks from `# SHARED: name` to `# END SHARED`."""
    blocks, name = {}, None
    for line in PATHS[trainer].read_text().splitlines():
        if line.strip().startswith("# SHARED: "):
            assert name is None, f"{line} inside {name}"
            name = line.strip().removeprefix("# SHARED: ")
            assert name not in blocks
            blocks[name] = []
        elif line.strip() == "# END SHARED":
            assert name is not None
            name = None
        elif name is not None:
            blocks[name].append(line)
    assert name is None
    return blocks


def test_shared_blocks_are_the_same_in_all_trainers():
    trainers = {}  # block -> trainer -> lines
    for trainer in PATHS:
        for name, lines in shared_blocks(trainer).items():
            trainers.setdefault(name, {})[trainer] = lines
    assert trainers
    for name, versions in trainers.items():
        assert len(versions) > 1, f"{name} is only in {list(versions)}"
        first, *others = versions.values()
        assert all(lines == first for lines in others), f"{name} of {list(versions)}"


# --- Real runs


def test_run_writes_result_policy_and_tensorboard_events(finished_run, trainer):
    result = json.loads((finished_run / "result.json").read_text())
    assert result["steps"] == 1200 and result["num_queries"] == (2 if trainer == "bc" else 4)
    assert 0 <= result["collision_free_success_rate"] <= result["success_rate"] <= 1
    assert result["args"]["goal_type"] == "combined"
    assert isinstance(json.loads((finished_run / "args.json").read_text())["bf16"], bool)

    events = EventAccumulator(str(finished_run))
    events.Reload()
    scalars = set(events.Tags()["scalars"])
    tags = ("episodic_return", "episodic_length", "success")
    for tag in ("learning_rate", "SPS") if trainer == "bc" else tags:
        assert f"charts/{tag}" in scalars
    for tag in ("success_rate", "collision_free_success_rate", "episode_length", "collision_rate"):
        assert [event.step for event in events.Scalars(f"eval/{tag}")] == [600, 1200]
    assert "eval/rollout" in events.Tags()["images"]
    assert "hyperparameters/text_summary" in events.Tags()["tensors"]


def test_saved_policy_acts_without_the_script(finished_run, trainer):
    policy = load_network(finished_run / "policy.pt")
    assert policy.metadata["kind"] == "policy" and policy.metadata["task"] == "no_obstacles"
    env = envs.make(policy.metadata["task"], **policy.metadata["env"])
    observation, _ = env.reset(seed=0)
    action = policy(**protocol.stack([observation], "cpu"))[0].numpy()
    assert action.shape == (7,) and np.abs(action).max() <= 0.06
    env.step(action)


def test_running_average_of_the_policy_is_saved(tmp_path, trainer, short_episodes):
    module = load(trainer)
    length = "--total-updates" if trainer == "bc" else "--total-timesteps"
    flags = [length, "600", "--policy-average", "0.01", "--goal-type", "ee"]
    run = run_script(trainer, tmp_path, *flags, "--test-queries", "0")
    assert "success_rate" not in json.loads((run / "result.json").read_text())
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    args = module.Args(hidden_size=16, bf16=False, goal_type="ee")
    actor, average = (module.Actor(args, panda_env()).eval() for _ in range(2))
    actor.load_state_dict(state["actor"])
    average.load_state_dict(state["actor_average"])
    observation, goal = torch.randn(8, 10), torch.randn(8, 3)
    saved = load_network(run / "policy.pt")(
        observation=observation, achieved_goal=goal, desired_goal=goal
    )
    torch.testing.assert_close(saved, average(observation, goal, goal))
    assert (saved - actor(observation, goal, goal)).abs().max() > 1e-4


@pytest.mark.parametrize("name", ["sac_her_mp", "bc"])
def test_goal_poses_are_trained_saved_and_evaluated(name, tmp_path, short_episodes):
    length = "--total-updates" if name == "bc" else "--total-timesteps"
    few = [length, "600", "--eval-queries", "1", "--test-queries", "1"]
    run = run_script(name, tmp_path, "--goal-type", "pose", *few)
    assert json.loads((run / "result.json").read_text())["goal_type"] == "pose"
    policy = load_network(run / "policy.pt")
    observation, _ = envs.make("no_obstacles", **policy.metadata["env"]).reset(seed=0)
    assert observation["desired_goal"].shape == (7,)
    action = policy(**protocol.stack([observation], "cpu")).numpy()
    assert action.shape == (1, 7) and np.isfinite(action).all()
    result = evaluate(run, num_queries=1)
    assert result["goal_type"] == "pose"


def same(a, b):
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a.keys() - {"seconds"}:
            same(a[key], b[key])
    elif isinstance(a, list):
        for one, other in zip(a, b, strict=True):
            same(one, other)
    elif isinstance(a, torch.Tensor):
        assert torch.equal(a, b)
    else:
        assert a == b


@pytest.mark.parametrize("device", ["cpu", GPU])
def test_killed_and_resumed_run_is_bit_identical_to_an_uninterrupted_one(
    tmp_path, trainer, device, finished_run
):
    flags, whole = [*FINISHED[trainer], "--device", device], finished_run
    if device != "cpu":
        whole = run_script(trainer, tmp_path / "whole", *flags)
    process = subprocess.Popen(
        command(trainer, tmp_path / "killed", *flags),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.time() + 120
    while not list((tmp_path / "killed").glob("*/checkpoint.pt")) and time.time() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    killed = next((tmp_path / "killed").iterdir())
    assert not (killed / "result.json").exists()
    left = killed / ".checkpoint.pt.0123abcd.tmp"
    left.write_bytes(b"half a checkpoint")

    run_here(PATHS[trainer], "--resume", killed)
    assert not left.exists()
    same(*(torch.load(run / "checkpoint.pt", weights_only=True) for run in (whole, killed)))
    results = [json.loads((run / "result.json").read_text()) for run in (whole, killed)]
    assert results[0]["success_rate"] == results[1]["success_rate"]


def signal_at(monkeypatch, step, number):
    """Send this process a signal when a run has made `step` steps."""
    advance = runs.Run.advance

    def advance_and_signal(run, count=1):
        done = advance(run, count)
        if done == step:
            os.kill(os.getpid(), number)
        return done

    monkeypatch.setattr(runs.Run, "advance", advance_and_signal)


def interrupted_run(trainer, folder, capsys, flags=FEW_QUERIES):
    """The folder of a run that a signal ends, its exit code and its last line."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        run_here(*command(trainer, folder, *flags)[1:])
    (run,) = folder.iterdir()
    return run, end.value.code, capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("number", "code", "word"), [(signal.SIGTERM, 143, "terminated"), (signal.SIGINT, 130, "inter")]
)
def test_signal_between_evaluations_ends_in_a_checkpoint(
    tmp_path, monkeypatch, capsys, trainer, number, code, word, short_episodes
):
    with monkeypatch.context() as patch:
        signal_at(patch, 702, number)
        run, ended, line = interrupted_run(trainer, tmp_path / "stopped", capsys)
    assert ended == code and line.startswith(word)
    assert "702; --resume" in line and str(run) in line
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    assert state["progress"]["step"] == 702
    if trainer != "bc":  # transitions of running episodes are kept
        assert len(state["buffer"]["arrays"]["remaining"]) == 702
    run_here(PATHS[trainer], "--resume", run)
    assert json.loads((run / "result.json").read_text())["steps"] == 1200
    if trainer == "bc":  # it has no episodes, so its numbers stay the same
        whole = run_script(trainer, tmp_path / "whole", *FEW_QUERIES)
        same(*(torch.load(one / "checkpoint.pt", weights_only=True) for one in (whole, run)))


def test_evaluation_that_a_signal_ends_is_repeated_by_the_resumed_run(
    tmp_path, monkeypatch, capsys, trainer, finished_run
):
    def evaluate(*_, **__):
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("the evaluation went on")

    with monkeypatch.context() as patch:
        patch.setattr(protocol, "evaluate", evaluate)
        run, code, line = interrupted_run(trainer, tmp_path, capsys, FINISHED[trainer])
    assert code == 143 and "600; --resume" in line
    assert not (run / "policy.pt").exists()
    run_here(PATHS[trainer], "--resume", run)
    same(*(torch.load(one / "checkpoint.pt", weights_only=True) for one in (finished_run, run)))


@pytest.mark.parametrize("stop, steps", [(None, 1200), (1.0, 600)])
def test_run_stops_at_a_success_rate_only_on_request(tmp_path, monkeypatch, stop, steps):
    success = {"success_rate": 1.0, "collision_free_success_rate": 1.0}
    monkeypatch.setattr(protocol, "evaluate", lambda *_, **__: success)
    flags = [*command("sac_her_mp", tmp_path)[1:], "--updates-per-step", "0", *FEW_QUERIES]
    if stop is not None:
        flags += ["--stop-at-success", stop]
    run_here(*flags)
    (result,) = tmp_path.glob("*/result.json")
    assert json.loads(result.read_text())["steps"] == steps


def test_run_folder_is_printed_before_demonstrations_are_encoded(
    tmp_path, monkeypatch, capsys, trainer
):
    def encode_demos(*_):
        assert capsys.readouterr().out.startswith(f"run folder: {tmp_path}/no_obstacles__")
        raise KeyboardInterrupt

    monkeypatch.setattr(SceneEncoder, "encode_demos", encode_demos)
    flags = ["--encoder", "oracle"] + ["--demo-prob", "1"] * (trainer != "bc")
    with pytest.raises(KeyboardInterrupt):
        run_here(*command(trainer, tmp_path, *flags)[1:])


# --- Bad input


@pytest.mark.parametrize(
    "flags, message",
    [
        (["--task", "walls"], "unknown task 'walls': did you mean wall?"),
        (["--task", "narrow_shelves"], "narrow_shelves is for testing only"),
        (["--resume", "nowhere"], "nowhere is no run's folder"),
        (["--goal-type", "poses"], "goal-type"),
        (["--horizon", "1000001"], "--horizon must be in [1, 1000000], got 1000001"),
        (["--demo-prob", "1.5"], "--demo-prob must be in [0, 1], got 1.5"),
        (["--demo-prob", "1", "--velocities"], "demonstrations have no velocities"),
        (["--demo-prob", "1", "--max-step", "0.02"], "steps up to 0.03"),
        (["--demo-prob", "1", "--demos", "nowhere.h5"], "nowhere.h5: no such file"),
        (
            ["--demo-prob", "1", "--demos", str(demo_path("wall"))],
            "this file is for the task 'wall', not 'no_obstacles'",
        ),
        (["--demos", "demos.h5"], "--demos goes with --demo-prob"),
        (["--bc-weight", "5"], "--bc-weight goes with --demo-prob"),
    ],
)
def test_bad_flags_are_rejected(tmp_path, flags, message, capsys):  # by a shared block
    assert message in refusal("sac_her_mp", capsys, tmp_path, *flags)


@pytest.mark.parametrize(
    ("name", "flags"),
    [
        ("sac_her_mp", ["--policy-lr", "1e30", "--q-lr", "1e30"]),
        ("td3_her_mp", ["--policy-lr", "1e30", "--q-lr", "1e30"]),
        ("bc", ["--learning-rate", "1e30"]),
    ],
)
def test_diverged_run_ends(name, flags, tmp_path):
    with pytest.raises(FloatingPointError, match="the policy's actions are no longer finite"):
        run_here(*command(name, tmp_path, *flags)[1:])
    assert not list(tmp_path.glob("*/policy.pt")) and not list(tmp_path.glob("*/checkpoint.pt"))


def test_resuming_with_other_flags_or_a_damaged_checkpoint_is_rejected(
    finished_run, tmp_path, trainer, capsys
):
    script = PATHS[trainer]
    message = error_here(capsys, script, "--resume", finished_run, "--hidden-size", "8")
    assert "--hidden-size is 8 now, the run had 16" in message and "task" not in message

    (tmp_path / "args.json").write_bytes((finished_run / "args.json").read_bytes())
    checkpoint = (finished_run / "checkpoint.pt").read_bytes()
    (tmp_path / "checkpoint.pt").write_bytes(checkpoint[: len(checkpoint) // 2])
    assert "checkpoint.pt is damaged" in error_here(capsys, script, "--resume", tmp_path)
