"""Demonstrations into PyTorch code of your own: a Dataset, a DataLoader, a training loop.

    python examples/own_pytorch_loop.py --task wall --demos 2000 --epochs 5

Prints the loss of each epoch, then the success rate of the network on 50 validation queries. The
network receives the observation and the goal configuration, and imitates the directions.
"""

import argparse

import numpy as np
import torch
from torch import nn
from torch.utils.data import ConcatDataset, DataLoader, Dataset

import roboarm_nmp
from roboarm_nmp.datasets.demonstrations import Demo, load_demos
from roboarm_nmp.datasets.episodes import demo_episode
from roboarm_nmp.envs import RoboArmEnv


class DemoSteps(Dataset):
    """The steps of one demonstration, as `env` would have observed them."""

    def __init__(self, demo: Demo, env: RoboArmEnv) -> None:
        episode = demo_episode(demo, env)  # observation (T + 1, 10), action (T, 7), goal (g,)
        goals = np.tile(episode.desired_goal, (len(episode.action), 1))
        self.inputs = np.hstack([episode.observation[:-1], goals])
        # Actions are displacements (normalised) of at most 0.03: learn their direction.
        length = np.linalg.norm(episode.action, axis=1, keepdims=True)
        self.targets = episode.action / np.maximum(length, 1e-6)

    def __len__(self) -> int:
        return len(self.inputs)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        return self.inputs[index], self.targets[index]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="wall")
    parser.add_argument("--demos", type=int, default=2000)
    parser.add_argument("--epochs", type=int, default=5)
    parser.add_argument("--queries", type=int, default=50)
    args = parser.parse_args()
    torch.manual_seed(0)

    env = roboarm_nmp.make(args.task, goal_type="config")
    demos = load_demos(args.task)[: args.demos]
    steps = ConcatDataset([DemoSteps(demo, env) for demo in demos])
    loader = DataLoader(steps, batch_size=256, shuffle=True)
    print(f"{len(demos)} demonstrations, {len(steps)} steps")

    layers = [nn.Linear(17, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 7)]
    network = nn.Sequential(*layers)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    for epoch in range(args.epochs):
        losses = []
        for inputs, targets in loader:
            loss = nn.functional.mse_loss(network(inputs), targets)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(loss.item())
        print(f"epoch {epoch + 1}: loss {np.mean(losses):.4f}")

    def policy(observation: dict[str, np.ndarray]) -> np.ndarray:
        inputs = np.concatenate([observation["observation"], observation["desired_goal"]])
        with torch.no_grad():
            direction = network(torch.from_numpy(inputs)).numpy()
        return 0.03 * direction / max(np.linalg.norm(direction), 1e-6)

    result = roboarm_nmp.evaluate(
        policy, args.task, goal_type="config", split="validation", num_queries=args.queries
    )
    print(f"success {result['success_rate']:.2f} of {result['num_queries']} validation queries")


if __name__ == "__main__":
    main()
