"""An entry to the benchmark: SAC and hindsight replay of Stable-Baselines3, trained on one task.

    pip install stable-baselines3
    python stable_baselines3_sac_her.py double_walls 100000
    roboarm benchmark run --function stable_baselines3_sac_her:begin --tasks double_walls \
        --training-data "100,000 steps of double_walls" --output entry

Run the commands in this folder.
"""

import functools
import sys

import torch
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.sac import MultiInputPolicy

import roboarm_nmp

FILE = "sac_her.zip"


def train(task, steps):
    torch.set_num_threads(1)
    env = roboarm_nmp.make(task)
    her = {"n_sampled_goal": 4, "goal_selection_strategy": "future"}
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs=her,
        learning_starts=2_000,  # it needs a whole episode, of 400 steps at most
        seed=1,
        device="cpu",
    )
    model.learn(steps)
    model.policy.save(FILE)


@functools.cache
def policy():
    torch.set_num_threads(1)
    return MultiInputPolicy.load(FILE, device="cpu")


def begin(problem):
    return lambda observation: policy().predict(observation, deterministic=True)[0]


if __name__ == "__main__":
    train(sys.argv[1], int(sys.argv[2]))
