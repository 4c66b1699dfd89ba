"""td3_her_mp.py: runs with flags of its own. (Its update: test_updates.py.)"""

import numpy as np
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainers import ONE_EVALUATION, load, panda_env, run_script

td3 = load("td3_her_mp")


def test_policy_and_targets_are_updated_with_delay(tmp_path):
    """With a delay longer than the run, they move once, at the first update."""
    common = ["--updates-per-step", "0.05", "--policy-average", "1", "--tau", "1", *ONE_EVALUATION]
    often = run_script("td3_her_mp", tmp_path / "often", *common, "--policy-frequency", "1")
    once = run_script("td3_her_mp", tmp_path / "once", *common, "--policy-frequency", "1000")
    for run, same in ((often, True), (once, False)):
        state = torch.load(run / "checkpoint.pt", weights_only=True)
        assert state["counts"]["updates"] == 50
        for key, value in state["actor"].items():
            torch.testing.assert_close(state["actor_target"][key], value, rtol=0, atol=0)
        # With tau 1 the targets are what the critics were at the last update of the policy.
        equal = [torch.equal(state["critics_target"][k], v) for k, v in state["critics"].items()]
        assert all(equal) == same


def test_losses_are_logged(tmp_path):
    flags = ["--updates-per-step", "1", "--goal-type", "config", *ONE_EVALUATION]
    run = run_script("td3_her_mp", tmp_path, *flags)
    events = EventAccumulator(str(run))
    events.Reload()
    for tag in ("qf1_values", "qf1_loss", "qf2_loss", "qf_loss", "actor_loss"):
        assert np.isfinite([event.value for event in events.Scalars(f"losses/{tag}")]).all()
    assert events.Scalars("charts/SPS")[-1].value > 0


def test_exploration_noise_has_the_given_size(tmp_path):
    flags = ["--updates-per-step", "0", "--exploration-noise", "0.2", *ONE_EVALUATION]
    run = run_script("td3_her_mp", tmp_path, *flags)
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    actor = td3.Actor(td3.Args(hidden_size=16, bf16=False), panda_env()).eval()
    actor.load_state_dict(state["actor"])
    # The first 200 steps are random.
    arrays = {name: array[-900:] for name, array in state["buffer"]["arrays"].items()}
    with torch.no_grad():
        noise = arrays["action"] - actor(arrays["observation"], None, arrays["desired_goal"])
    assert 0.19 < noise.std() / 0.06 < 0.21
    assert noise.mean().abs() < 0.02 * 0.06


def test_penalty_keeps_the_tanh_from_saturating(tmp_path):
    sizes = {}
    for penalty in ("0", "100"):
        flags = ["--updates-per-step", "0.5", "--preactivation-penalty", penalty]
        run = run_script("td3_her_mp", tmp_path / penalty, *flags, *ONE_EVALUATION)
        state = torch.load(run / "checkpoint.pt", weights_only=True)
        actor = td3.Actor(td3.Args(hidden_size=16, bf16=False), panda_env()).eval()
        actor.load_state_dict(state["actor"])
        observation = state["buffer"]["arrays"]["observation"]
        goal = state["buffer"]["arrays"]["desired_goal"]
        with torch.no_grad():
            preactivation = actor.mlp(actor.features(observation, goal))
            action = actor(observation, None, goal)
        torch.testing.assert_close(action, 0.06 * torch.tanh(preactivation))
        sizes[penalty] = preactivation.square().mean()
    assert sizes["100"] < 0.01 * sizes["0"]
