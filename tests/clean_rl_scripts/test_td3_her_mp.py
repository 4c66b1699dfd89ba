"""td3_her_mp.py: its numbers against formulas by hand, and what only it does in a run."""

import numpy as np
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainers import load, run_script

td3 = load("td3_her_mp")


def test_td_target_by_hand():
    target = td3.td_target(
        torch.tensor([-1.0, 0.0]),
        torch.tensor([0.0, 1.0]),
        torch.tensor([[-3.0, -9.0], [-4.0, -8.0]]),
        gamma=0.5,
    )
    # -1 + 0.5 min(-3, -4); a terminal state has no value
    torch.testing.assert_close(target, torch.tensor([-3.0, 0.0]))


def test_target_smoothing_by_hand():
    action = torch.tensor([[0.0, 0.02, -0.05, 0.06]])
    noise = torch.tensor([[0.3, -2.0, -0.4, 0.1]])
    # Noise is clipped to 0.5, scaled by 0.06, and the sum stays in [-0.06, 0.06].
    expected = torch.tensor([[0.018, 0.02 - 0.03, -0.06, 0.06]])
    torch.testing.assert_close(td3.smoothed(action, noise, 0.5, 0.06), expected)


def test_policy_and_targets_are_updated_with_delay(tmp_path):
    """With a delay longer than the run, they move once, at the first update."""
    common = ["--updates-per-step", "0.05", "--policy-average", "1", "--tau", "1"]
    often = run_script("td3_her_mp", tmp_path / "often", *common, "--policy-frequency", "1")
    once = run_script("td3_her_mp", tmp_path / "once", *common, "--policy-frequency", "1000")
    for run, same in ((often, True), (once, False)):
        state = torch.load(run / "checkpoint.pt", weights_only=True)
        assert state["progress"]["updates"] == 50
        for key, value in state["actor"].items():
            torch.testing.assert_close(state["actor_target"][key], value, rtol=0, atol=0)
        # With tau 1 the targets are what the critics were at the last update of the policy.
        equal = [torch.equal(state["critics_target"][k], v) for k, v in state["critics"].items()]
        assert all(equal) == same


def test_losses_are_logged(tmp_path):
    run = run_script("td3_her_mp", tmp_path, "--updates-per-step", "1", "--goal-type", "config")
    events = EventAccumulator(str(run))
    events.Reload()
    for tag in ("qf1_values", "qf1_loss", "qf2_loss", "qf_loss", "actor_loss"):
        assert np.isfinite([event.value for event in events.Scalars(f"losses/{tag}")]).all()
    assert events.Scalars("charts/SPS")[-1].value > 0


def test_exploration_adds_noise_of_the_size_asked_for(tmp_path):
    flags = ["--updates-per-step", "0", "--exploration-noise", "0.2"]
    run = run_script("td3_her_mp", tmp_path, *flags)
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    actor = td3.Actor(td3.Args(hidden_size=16, bf16=False), 10).eval()
    actor.load_state_dict(state["actor"])
    rows = state["buffer"]["rows"][-900:]  # the first 200 steps are random
    with torch.no_grad():
        noise = rows[:, 10:17] - actor(rows[:, :10], None, rows[:, -4:-1])
    assert 0.19 < noise.std() / 0.06 < 0.21
    assert noise.mean().abs() < 0.02 * 0.06


def test_the_penalty_keeps_the_tanh_from_saturating(tmp_path):
    sizes = {}
    for penalty in ("0", "100"):
        flags = ["--updates-per-step", "0.5", "--preactivation-penalty", penalty]
        run = run_script("td3_her_mp", tmp_path / penalty, *flags)
        state = torch.load(run / "checkpoint.pt", weights_only=True)
        actor = td3.Actor(td3.Args(hidden_size=16, bf16=False), 10).eval()
        actor.load_state_dict(state["actor"])
        rows = state["buffer"]["rows"]
        with torch.no_grad():
            preactivation = actor.mlp(actor.features(rows[:, :10], rows[:, -4:-1]))
            action = actor(rows[:, :10], None, rows[:, -4:-1])
        torch.testing.assert_close(action, 0.06 * torch.tanh(preactivation))
        sizes[penalty] = preactivation.square().mean()
    assert sizes["100"] < 0.01 * sizes["0"]
