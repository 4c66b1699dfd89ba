"""Turn recorded motions into demonstrations, and train a network of PyTorch on them.

    python examples/06_own_demonstrations.py --motions 1000 --epochs 5
    roboarm train bc --task wall --demos teleop.h5

The recordings are planned motions with noise, in place of yours (docs/customise/motions.md).
"""

import argparse

import numpy as np
import torch
from torch import nn

import roboarm_nmp
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.episodes import demo_episode
from roboarm_nmp.datasets.recordings import Recording, write_demonstrations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motions", type=int, default=1000)
    parser.add_argument("--epochs", type=int, default=5)
    parser.add_argument("--queries", type=int, default=50)
    args = parser.parse_args()
    torch.manual_seed(0)
    rng, recordings = np.random.default_rng(0), []
    for demo in load_demos("wall")[: args.motions]:
        angles = demo.configurations + rng.normal(0, 1e-3, demo.states.shape)  # (m, 7), rad
        recordings.append(Recording(angles, np.arange(len(angles)) / 25))  # at 25 Hz
    refused = write_demonstrations("teleop.h5", recordings, "wall")
    print(f"teleop.h5: {len(recordings) - len(refused)} demonstrations, {len(refused)} refused")

    env = roboarm_nmp.make("wall", goal_type="config")
    episodes = [demo_episode(demo, env) for demo in load_demos("teleop.h5")]
    rows = [np.hstack([e.observation[:-1], 0 * e.action + e.desired_goal]) for e in episodes]
    inputs = torch.from_numpy(np.concatenate(rows))  # observation (10) and goal (7)
    actions = torch.from_numpy(np.concatenate([e.action for e in episodes])) / 0.03
    network = nn.Sequential(nn.Linear(17, 256), nn.ReLU(), nn.Linear(256, 7))
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    for epoch in range(args.epochs):
        for batch in torch.randperm(len(inputs)).split(256):
            loss = nn.functional.mse_loss(network(inputs[batch]), actions[batch])
            network.zero_grad()
            loss.backward()
            optimiser.step()
        print(f"epoch {epoch + 1}: loss {loss.item():.4f}")

    @torch.no_grad()
    def policy(observation: dict[str, np.ndarray]) -> np.ndarray:
        row = np.concatenate([observation["observation"], observation["desired_goal"]])
        return 0.03 * network(torch.from_numpy(row)).numpy().clip(-1, 1)

    result = roboarm_nmp.evaluate(policy, "wall", goal_type="config", num_queries=args.queries)
    print("success", result["success_rate"])


if __name__ == "__main__":
    main()
