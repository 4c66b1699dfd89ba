"""Trainers of policies on a GPU, and with the `meta` device in its place.

On that, as on a GPU, tensors of two devices do not mix and `.numpy()` raises. It executes no
kernels, so a separate test finds tensors of two dtypes in one kernel.
"""

import json

import pytest
import torch
from one_type import OneType
from trainers import PATHS, command, run_here

TRAINERS = ("sac_her_mp", "bc")  # TD3 differs from SAC in its losses: test_updates.py
ONCE = "--total-timesteps 60 --horizon 30 --eval-every 30 --learning-starts 15 --num-envs 3"
ONCE_BC = "--total-updates 2 --eval-every 2"
ENCODED = ["--task", "random_boxes_hard", "--encoder", "oracle", "--goal-type", "combined"]


def flags(trainer):
    few = (ONCE_BC if trainer == "bc" else ONCE).split()
    return [*few, "--eval-queries", "1", "--test-queries", "1"]


def devices(state):
    """Of the weights in a checkpoint."""
    return {tensor.device.type for tensor in state.get("agent", state.get("actor")).values()}


def num_updates(state):
    """Of a checkpoint."""
    return state["progress"].get("updates", state["counts"]["step"])


@pytest.mark.parametrize("trainer", TRAINERS)
def test_update_evaluation_and_resume_on_another_device(
    trainer, tmp_path, another_device, short_episodes, few_demos
):
    more = [*ENCODED, "--demos", few_demos]
    if trainer != "bc":
        more += ["--demo-prob", "1", "--bc-weight", "2"]
    run_here(*command(trainer, tmp_path, *flags(trainer), "--device", another_device, *more)[1:])
    (run,) = tmp_path.iterdir()
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    assert num_updates(state) > 0
    assert devices(state) == {another_device}
    (run / "result.json").unlink()
    longer, steps = ("--total-updates", 4) if trainer == "bc" else ("--total-timesteps", 120)
    run_here(PATHS[trainer], "--resume", run, longer, steps)
    assert json.loads((run / "result.json").read_text())["steps"] == steps
    resumed = torch.load(run / "checkpoint.pt", weights_only=True)
    assert num_updates(resumed) > num_updates(state)
    assert devices(resumed) == {another_device}


@pytest.mark.parametrize("trainer", TRAINERS)
def test_no_kernel_receives_two_dtypes(trainer, tmp_path, short_episodes):
    given = command(
        trainer, tmp_path, *flags(trainer), "--bf16", *(["True"] if trainer != "bc" else [])
    )[1:]
    with OneType():
        run_here(*given)
