"""The go-to-goal policy as a network file, for goals that are configurations."""

import torch
from torch import nn

from roboarm_nmp.networks.export import save_network


class Straight(nn.Module):
    def forward(self, observation, achieved_goal, desired_goal):
        return torch.clamp(desired_goal - observation[:, :7], -1, 1)


def save(path, module=None, goal_size=7, observation_size=10, **metadata):
    sizes = {"observation": observation_size, "achieved_goal": goal_size, "desired_goal": goal_size}
    inputs = {name: torch.zeros(1, size) for name, size in sizes.items()}
    metadata = {"kind": "policy", "task": "wall", "env": {"goal_type": "config"}} | metadata
    save_network(path, module or Straight(), inputs, metadata, ["action"])
    return path
