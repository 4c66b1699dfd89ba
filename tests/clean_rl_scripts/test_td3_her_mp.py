"""td3_her_mp.py: runs with flags of its own. (Its update: test_updates.py.)"""

import torch
from trainers import ONE_EVALUATION, load, panda_env, run_script

td3 = load("td3_her_mp")


def test_exploration_noise_has_the_given_size(tmp_path):
    flags = ["--updates-per-step", "0", "--exploration-noise", "0.2", *ONE_EVALUATION]
    run = run_script("td3_her_mp", tmp_path, *flags)
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    actor = td3.Actor(td3.Args(hidden_size=16, bf16=False), panda_env()).eval()
    actor.load_state_dict(state["actor"])
    # The first 200 steps are random.
    arrays = {name: array[-300:] for name, array in state["buffer"]["arrays"].items()}
    with torch.no_grad():
        noise = arrays["action"] - actor(arrays["observation"], None, arrays["desired_goal"])
    assert 0.18 < noise.std() / 0.06 < 0.22
    assert noise.mean().abs() < 0.03 * 0.06
