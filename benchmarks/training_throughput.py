"""SAC+HER training steps per second: `sac_her_mp.py` against Stable-Baselines3 on the same env.

    pip install -c constraints.txt -e ".[bench]"
    python benchmarks/training_throughput.py

Both train on `no_obstacles` with goal `ee`, one torch thread, the same number of envs, batches of
256, two hidden layers of 256, one update of critics, policy, entropy coefficient and targets per
environment step, and hindsight for 0.8 of the samples. They take turns, each in a process of its
own; the rate is that of the steps after learning started, without evaluations. Medians are
compared. `ours` has the networks of Stable-Baselines3; `ours, default networks` has more inputs and
LayerNorm, which cost time and learn faster. The last line is JSON.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
SCRIPT = Path(__file__).parents[1] / "clean_rl_scripts" / "sac_her_mp.py"
LEARNING_STARTS = 2000
PLAIN = ["--plain-networks"]


def ours(num_envs, steps, flags):
    """Steps per second of our script, from the times of its TensorBoard events."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(SCRIPT), "--runs-dir", folder, "--task", "no_obstacles"]
        command += ["--num-envs", str(num_envs), "--learning-starts", str(LEARNING_STARTS)]
        command += ["--total-timesteps", str(LEARNING_STARTS + steps), "--updates-per-step", "1"]
        command += ["--policy-frequency", "1", "--eval-queries", "1", "--test-queries", "1"]
        subprocess.run(command + flags, check=True, capture_output=True)
        events = EventAccumulator(str(next(Path(folder).iterdir())))
        events.Reload()
        rates = events.Scalars("charts/SPS")
    return (rates[-1].step - rates[0].step) / (rates[-1].wall_time - rates[0].wall_time)


def stable_baselines3(num_envs, steps):
    """Steps per second of Stable-Baselines3's SAC with its HerReplayBuffer."""
    import torch
    from stable_baselines3 import SAC, HerReplayBuffer
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env

    from roboarm_nmp import envs

    torch.set_num_threads(1)

    class Clock(BaseCallback):
        def _on_step(self):
            if self.num_timesteps >= LEARNING_STARTS + 500 and not hasattr(self, "began"):
                self.began = time.time(), self.num_timesteps
            return True

    model = SAC(
        "MultiInputPolicy",
        make_vec_env(envs.gymnasium_id("no_obstacles"), num_envs),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        policy_kwargs={"net_arch": [256, 256]},
        batch_size=256,
        learning_starts=LEARNING_STARTS,
        train_freq=1,
        gradient_steps=-1,
        device="cpu",
    )
    clock = Clock()
    model.learn(LEARNING_STARTS + steps, callback=clock)
    began, steps_then = clock.began
    return (model.num_timesteps - steps_then) / (time.time() - began)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=4000, help="environment steps per round")
    parser.add_argument("--num-envs", type=int, default=4)
    parser.add_argument("--only-sb3", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.only_sb3:
        print(stable_baselines3(args.num_envs, args.steps))
        return

    rates = {"ours": [], "ours, default networks": [], "stable-baselines3": []}
    for i in range(args.rounds):
        rates["ours"].append(ours(args.num_envs, args.steps, PLAIN))
        rates["ours, default networks"].append(ours(args.num_envs, args.steps, []))
        command = [sys.executable, __file__, "--only-sb3", "--steps", str(args.steps)]
        command += ["--num-envs", str(args.num_envs)]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        rates["stable-baselines3"].append(float(output.split()[-1]))
        now = ", ".join(f"{name} {values[-1]:.0f}" for name, values in rates.items())
        print(f"round {i + 1} of {args.rounds}, steps/s: {now}", flush=True)

    medians = {name: statistics.median(values) for name, values in rates.items()}
    peer = medians["stable-baselines3"]
    print(f"\n{'':24}{'steps/s':>10}{'ratio':>10}")
    for name, rate in medians.items():
        print(f"{name:24}{rate:10.0f}{rate / peer:10.2f}")
    result = {
        "steps_per_second": medians["ours"],
        "sb3_steps_per_second": peer,
        "ratio_to_sb3": medians["ours"] / peer,
        "ratio_to_sb3_default_networks": medians["ours, default networks"] / peer,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
