"""Behavioural cloning (BC) of demonstrations. One file: read it top to bottom.

    python bc_script/bc.py --task no_obstacles --goal-type combined
    python bc_script/bc.py --task double_walls --goal-type config --demos a.h5 b.h5

Maximum likelihood of the demonstrated actions under a Gaussian policy, or with `--num-modes` a
mixture of Gaussians (paper, sections 2 and 5, appendix "Parameter sweeps"). To make an algorithm of
your own, copy this file and change the parts under `# ALGO LOGIC`. Parts between `# SHARED` and
`# END SHARED` are those of `clean_rl_scripts/sac_her_mp.py`.
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from roboarm_nmp.envs import panda
from roboarm_nmp.envs.datasets.demonstrations import load_demos
from roboarm_nmp.envs.datasets.episodes import observed
from roboarm_nmp.envs.datasets.format import DatasetError
from roboarm_nmp.envs.subgoals import MAX_STEP
from roboarm_nmp.envs.training import flags, protocol, runs


@dataclass
class Args(runs.RunFlags):  # those of the run's folder are in `envs/training/runs.py`
    exp_name: str = "bc"
    """name of the experiment, part of the run's folder"""

    # The task (the paper's MDP; `docs/environment.md`)
    task: str = "no_obstacles"
    """task to train on, one of `envs.TASKS`, or a scene file (docs/your_own_scene.md)"""
    goal_type: Literal["ee", "config", "combined"] = "combined"
    """what the goal is: end-effector position, configuration, or both"""
    demos: tuple[Path, ...] = ()
    """demonstration files of the task; by default the task's own"""
    num_demos: flags.PositiveInt | None = None
    """only the first so many demonstrations of each file"""

    # The algorithm
    total_updates: flags.PositiveInt = 1_000_000
    """batches of the whole run (paper: 1,000,000); a resumed run may have more, and has then the
    learning rate of that longer run"""
    batch_size: flags.PositiveInt = 256
    """transitions per batch"""
    learning_rate: flags.PositiveFloat = 1e-3
    """learning rate (Adam) at the start"""
    anneal: bool = True
    """let the learning rate fall linearly, to zero at the end"""
    num_modes: flags.Width = 1
    """Gaussians of the policy's mixture; the most likely one's mean is the action in evaluation"""
    policy_average: flags.PositiveShare = 0.001
    """share of the policy that moves into its running average per update; the average is what is
    evaluated and saved (1: no averaging)"""
    hidden_size: flags.Width = 256
    """width of the hidden layers"""
    num_hidden_layers: flags.Layers = 2
    """number of hidden layers"""
    relative_goal: bool = True
    """add goal minus end-effector position, times 5, to the network's inputs"""
    relative_configuration: bool = False
    """add goal minus configuration, times 5, to the network's inputs, where goals have one"""
    trigonometric: bool = True
    """add the joint angles' sines and cosines to the network's inputs"""
    bf16: bool = False
    """train with hidden layers in bfloat16 (first layer, head and weights stay in float32)"""
    encoder: str | None = None
    """what the policy sees of the scene, appended to the observation: a trained encoder (`vae`,
    `vqvae`, `pointnet2`, `field`, or the path of your own `encoder.pt`, docs/sensors.md), `points`
    of what sensors see (docs/safety_filter.md), or `oracle`, the obstacles themselves; by default
    nothing"""
    num_points: flags.PositiveInt = 64
    """points of the encoder `point_cloud`"""
    velocities: ClassVar[bool] = False  # demonstrations have none
    link_distances: ClassVar[str | None] = None

    # Evaluation and bookkeeping
    eval_every: flags.PositiveInt = 50_000
    """updates between evaluations on validation queries; the best policy is kept"""
    eval_queries: flags.PositiveInt = 200
    """validation queries per evaluation"""
    test_queries: flags.PositiveInt = 1_000
    """test queries for the best policy at the end"""


# ALGO LOGIC: the policy
# SHARED: features and layers
class Features(nn.Module):
    """Network inputs: observation, desired goal, and functions of them that speed up learning."""

    def __init__(self, args, observation_size):
        super().__init__()
        self.relative_goal = args.relative_goal and args.goal_type != "config"
        self.relative_configuration = args.relative_configuration and args.goal_type != "ee"
        self.trigonometric = args.trigonometric
        low, high = torch.tensor(panda.LOWER), torch.tensor(panda.UPPER)
        self.register_buffer("middle", ((high + low) / 2).float())
        self.register_buffer("half_range", ((high - low) / 2).float())
        goal_size = {"ee": 3, "config": 7, "combined": 10}[args.goal_type]
        self.ee = slice(7 + 7 * args.velocities, 10 + 7 * args.velocities)  # end-effector
        self.near = slice(self.ee.stop, self.ee.stop + 80, 8) if args.link_distances else None
        self.size = observation_size + goal_size + 14 * args.trigonometric + 10 * bool(self.near)
        self.size += 3 * self.relative_goal + 7 * self.relative_configuration

    def forward(self, observation, desired_goal):
        """(N, o), (N, g) -> (N, size)."""
        inputs = [observation, desired_goal]
        if self.trigonometric:
            angles = observation[:, :7] * self.half_range + self.middle
            inputs += [torch.sin(angles), torch.cos(angles)]
        if self.relative_goal:
            inputs.append(5.0 * (desired_goal[:, -3:] - observation[:, self.ee]))
        if self.relative_configuration:
            inputs.append(5.0 * (desired_goal[:, :7] - observation[:, :7]))
        if self.near is not None:
            inputs.append(10.0 * observation[:, self.near])  # the links' distances, which are small
        return torch.cat(inputs, dim=1)


class MLP(nn.Module):
    def __init__(self, num_inputs, num_outputs, args, layer_norm):
        super().__init__()
        sizes = [num_inputs] + [args.hidden_size] * args.num_hidden_layers
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False))
        norm = nn.LayerNorm if layer_norm else lambda _: nn.Identity()
        self.norms = nn.ModuleList(norm(args.hidden_size) for _ in self.layers)
        self.head = nn.Linear(args.hidden_size, num_outputs)
        self.bf16 = args.bf16

    def forward(self, x):
        bf16 = self.bf16 and self.training
        for i, (layer, norm) in enumerate(zip(self.layers, self.norms, strict=True)):
            # The first layer and the head stay in float32: 2 cm need more than bfloat16's 8 bits.
            # No kernel gets two types: CUDA's refuse that.
            if bf16 and i > 0:
                x = F.linear(x.bfloat16(), layer.weight.bfloat16(), layer.bias.bfloat16()).float()
            else:
                x = layer(x)
            x = F.relu(norm(x))
        return self.head(x)


# END SHARED


LOG_STD_MAX = 2
LOG_STD_MIN = -5


class Actor(nn.Module):
    """A mixture of Gaussians with diagonal covariances over the action, in units of `MAX_STEP`."""

    def __init__(self, args, observation_size):
        super().__init__()
        self.features = Features(args, observation_size)
        self.num_modes = args.num_modes
        self.mlp = MLP(self.features.size, 15 * args.num_modes, args, layer_norm=False)

    def modes(self, observation, desired_goal):
        """Means and log standard deviations (N, K, 7), log weights (N, K)."""
        outputs = self.mlp(self.features(observation, desired_goal))
        outputs = outputs.unflatten(1, (self.num_modes, 15))
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (
            torch.tanh(outputs[..., 7:14]) + 1
        )
        return outputs[..., :7], log_std, F.log_softmax(outputs[..., 14], dim=1)

    def log_likelihood(self, observation, desired_goal, action):
        """Of actions (N, 7), in units of `MAX_STEP`: (N,)."""
        mean, log_std, log_weight = self.modes(observation, desired_goal)
        standard = (action.unsqueeze(1) - mean) * torch.exp(-log_std)
        log_density = -0.5 * standard.square() - log_std - 0.5 * math.log(2 * math.pi)
        return torch.logsumexp(log_weight + log_density.sum(2), dim=1)

    def forward(self, observation, achieved_goal, desired_goal):
        """The most likely mode's mean (N, 7), as an action; this is what policy.pt contains."""
        mean, _, log_weight = self.modes(observation, desired_goal)
        likeliest = log_weight.argmax(1).reshape(-1, 1, 1).expand(-1, 1, 7)
        return MAX_STEP * mean.gather(1, likeliest).squeeze(1)


# ALGO LOGIC: demonstrations
def transitions(demos, goal_type, num_demos=None):
    """The observations, goals and actions of demonstrations: float32 (n, 10), (n, g), (n, 7).

    And the index of the demonstration that each is of: int64 (n,).
    All of a demonstration, beyond where its goal counts as reached: it goes on to the very goal.
    Actions are in units of `MAX_STEP`.
    """
    number = len(demos) if num_demos is None else min(num_demos, len(demos))
    demo_index = np.repeat(np.arange(number), np.diff(demos.offsets[: number + 1]))
    commanded = np.ones(len(demo_index), bool)
    commanded[demos.offsets[1 : number + 1] - 1] = False  # from the last, nothing was
    rows, demo_index = np.flatnonzero(commanded), demo_index[commanded]
    observation, _, goal = observed(demos.states[rows], demos.goal[:number], goal_type)
    return observation, goal[demo_index], demos.actions[rows] / MAX_STEP, demo_index


# SHARED: averaging
def polyak_update(target_parameters, parameters, tau):
    """target <- (1 - tau) target + tau parameter, all tensors at once."""
    with torch.no_grad():
        torch._foreach_lerp_(target_parameters, parameters, tau)


# END SHARED


# ALGO LOGIC: one update
def update(actor, optimizer, observation, goal, action):
    """One step on a batch, (N, o), (N, g), (N, 7); the loss before it."""
    loss = -actor.log_likelihood(observation, goal, action).mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return loss


if __name__ == "__main__":
    args = runs.parse_args(Args, may_change={"total_updates", "test_queries"})
    device = runs.seed_torch(args)
    validation, test = protocol.load_task(args)
    try:
        files = [load_demos(file, args.task) for file in args.demos or (args.task,)]
    except DatasetError as error:
        sys.exit(f"--demos: {error}")
    env_arguments = {
        "goal_type": args.goal_type,
        "encoder": args.encoder,
        "num_points": args.num_points,
    }
    eval_envs = protocol.make_eval_envs(args.task, len(validation), **env_arguments)

    # ALGO LOGIC: data
    parts = [transitions(demos, args.goal_type, args.num_demos) for demos in files]
    firsts = np.cumsum([0, *map(len, files[:-1])])
    for first, (*_, demo_index) in zip(firsts, parts, strict=True):
        demo_index += first  # it counts on from file to file
    data = [
        torch.as_tensor(np.concatenate(arrays), device=device)
        for arrays in zip(*parts, strict=True)
    ]
    latents = None  # the encoded scene of each demonstration
    if args.encoder is not None:
        encoded = [eval_envs[0].encoder.encode_demos(demos) for demos in files]
        latents = torch.as_tensor(np.concatenate(encoded), device=device)
    del files, parts

    # ALGO LOGIC: network and optimiser
    observation_size = eval_envs[0].observation_space["observation"].shape[0]
    actor = Actor(args, observation_size).to(device)
    actor_average = Actor(args, observation_size).to(device).eval()  # evaluated and saved
    actor_average.load_state_dict(actor.state_dict())
    parameters, average_parameters = list(actor.parameters()), list(actor_average.parameters())
    optimizer = torch.optim.Adam(parameters, lr=args.learning_rate, fused=True)
    state = {"actor": actor, "actor_average": actor_average, "optimizer": optimizer}
    run = protocol.PolicyRun(args, state, device, env_arguments, eval_envs, validation)
    run.start(args.total_updates, "update")

    while run.step < args.total_updates:
        # ALGO LOGIC: learn
        if args.anneal:
            remaining = 1.0 - run.step / args.total_updates
            optimizer.param_groups[0]["lr"] = args.learning_rate * remaining
        rows = torch.randint(len(data[0]), (args.batch_size,), device=device)
        observation, goal, action, demo_index = (tensor[rows] for tensor in data)
        if latents is not None:
            observation = torch.cat([observation, latents[demo_index]], dim=1)
        loss = update(actor, optimizer, observation, goal, action)
        polyak_update(average_parameters, parameters, args.policy_average)
        step = run.advance()
        if step % 1000 == 0:
            run.log({"losses/negative_log_likelihood": loss})
            learning_rate = optimizer.param_groups[0]["lr"]
            run.log({"charts/learning_rate": learning_rate, "charts/SPS": int(run.rate)})

        # Evaluate, keep the best policy, checkpoint
        evaluating = step % args.eval_every == 0 or step == args.total_updates
        if evaluating and run.validate(actor_average):
            run.save_policy(actor_average)
        if evaluating or run.interrupted:
            run.checkpoint()
    run.final_test(test)
