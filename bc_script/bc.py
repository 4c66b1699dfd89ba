"""Behavioural cloning (BC) of demonstrations. One file: read it top to bottom.

    roboarm train bc --task no_obstacles --goal-type combined
    python bc_script/bc.py --task double_walls --goal-type config --demos a.h5 b.h5

Maximum likelihood of the demonstrated actions under a Gaussian policy, or with `--num-modes` a
mixture of Gaussians (paper, sections 2 and 5, appendix "Parameter sweeps"). For an algorithm of
your own, copy this file and change the parts under `# ALGO LOGIC`. Parts between `# SHARED` and
`# END SHARED` are the same in `sac_her_mp.py`.
"""

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from roboarm_nmp.datasets.demonstrations import load_demo_files
from roboarm_nmp.datasets.episodes import observed
from roboarm_nmp.envs.subgoals import MAX_STEP
from roboarm_nmp.training import cuda_graphs, protocol, runs
from roboarm_nmp.training.network_parts import Bf16Linear, pose_difference
from roboarm_nmp.utils import flags


@dataclass
class Args(protocol.PolicyFlags):
    # More flags: `roboarm_nmp.training.protocol` (task), `roboarm_nmp.training.runs` (run).
    goal_type: Literal["ee", "config", "combined", "pose"] = "combined"
    """what the goal is: end-effector position, configuration, both, or end-effector pose"""
    demos: tuple[Path, ...] = ()
    """demonstration files of the task; by default the task's own"""
    num_demos: flags.PositiveInt | None = None
    """number of demonstrations of each file, the first ones; by default all"""
    total_updates: flags.PositiveInt = 1_000_000
    """batches of the whole run (paper: 1,000,000); a resumed run may have more, and then has the
    learning rate of that longer run"""
    batch_size: flags.PositiveInt = 256
    """transitions per batch"""
    learning_rate: flags.PositiveFloat = 1e-3
    """learning rate (Adam) at the start"""
    anneal: bool = True
    """decrease the learning rate linearly to zero"""
    num_modes: flags.Width = 1
    """Gaussians of the policy's mixture; the most likely one's mean is the action in evaluation"""
    policy_average: flags.PositiveShare = 0.001
    """share of the policy that moves, in each of its updates, into the running average that is
    evaluated and saved (1: no averaging)"""
    hidden_size: flags.Width = 256
    """width of the hidden layers"""
    num_hidden_layers: flags.Layers = 2
    """number of hidden layers"""
    plain_networks: bool = False
    """raw observations and goals as inputs"""
    bf16: bool = False
    """train with hidden layers in bfloat16"""
    encoder: str | None = None
    """the encoded scene, appended to the observation: an encoder's latent code (`vae`, `vqvae`,
    `pointnet2`, `field`, or the path of your own `encoder.onnx`, docs/guide/perception.md),
    `point_cloud` for observed points, or `oracle` for the ground-truth obstacles; by default
    nothing"""
    num_points: flags.PositiveInt = 64
    """points of the encoder `point_cloud`"""
    eval_every: flags.PositiveInt = 50_000
    """updates between evaluations on validation queries; the best policy is saved"""


# ALGO LOGIC: the policy
# SHARED: averaging
def polyak_update(target, network, tau):
    """target <- (1 - tau) target + tau network, all parameters at once."""
    with torch.no_grad():
        torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage]
            list(target.parameters()), list(network.parameters()), tau
        )


# END SHARED


# SHARED: MLP
def mlp(num_inputs, num_outputs, args, layer_norm=False):
    """Hidden layers and a head. The first is in float32: 2 cm need more than bfloat16's 8 bits."""
    size = args.hidden_size
    layers = []
    for i in range(args.num_hidden_layers):
        layers.append(nn.Linear(num_inputs, size) if i == 0 else Bf16Linear(size, size, args.bf16))
        if layer_norm:
            layers.append(nn.LayerNorm(size))
        layers.append(nn.ReLU())
    return nn.Sequential(*layers, nn.Linear(size, num_outputs))


# END SHARED


class Features(nn.Module):
    """Network inputs: observation, goal and, unless plain, functions of them that ease learning."""

    def __init__(self, args, env):
        super().__init__()
        self.plain = args.plain_networks
        self.goal_type = args.goal_type
        robot = env.unwrapped.robot
        self.num_joints = robot.num_joints
        low, high = torch.tensor(robot.lower), torch.tensor(robot.upper)
        self.register_buffer("middle", ((high + low) / 2).float())
        self.register_buffer("half_range", ((high - low) / 2).float())
        observation = torch.zeros(1, *env.observation_space["observation"].shape)
        goal = torch.zeros(1, *env.observation_space["desired_goal"].shape)
        self.size = self(observation, goal).shape[1]

    def forward(self, observation, desired_goal):
        """(N, o), (N, g) -> (N, size)."""
        inputs = [observation, desired_goal]
        if not self.plain:
            joints = self.num_joints
            angles = observation[:, :joints] * self.half_range + self.middle
            inputs += [torch.sin(angles), torch.cos(angles)]
            if self.goal_type == "pose":
                poses = observation[:, joints : joints + 7]
                inputs.append(5.0 * pose_difference(poses, desired_goal))
            elif self.goal_type != "config":  # end-effector positions
                inputs.append(5.0 * (desired_goal[:, -3:] - observation[:, joints : joints + 3]))
        return torch.cat(inputs, dim=1)


LOG_STD_MIN, LOG_STD_MAX = -5, 2


class Actor(nn.Module):
    """A mixture of Gaussians with diagonal covariances over the action, in units of `MAX_STEP`."""

    def __init__(self, args, env):
        super().__init__()
        self.features = Features(args, env)
        self.num_joints = self.features.num_joints
        self.num_modes = args.num_modes
        outputs = (2 * self.num_joints + 1) * args.num_modes
        self.mlp = mlp(self.features.size, outputs, args)

    def modes(self, observation, desired_goal):
        """Means and log standard deviations (N, K, n), log weights (N, K)."""
        outputs = self.mlp(self.features(observation, desired_goal))
        n = self.num_joints
        outputs = outputs.unflatten(1, (self.num_modes, 2 * n + 1))
        log_std = torch.tanh(outputs[..., n : 2 * n])
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (log_std + 1)
        return outputs[..., :n], log_std, F.log_softmax(outputs[..., 2 * n], dim=1)

    def log_likelihood(self, observation, desired_goal, action):
        """Of actions (N, n), in units of `MAX_STEP`: (N,)."""
        mean, log_std, log_weight = self.modes(observation, desired_goal)
        standard = (action.unsqueeze(1) - mean) * torch.exp(-log_std)
        log_density = -0.5 * standard.square() - log_std - 0.5 * math.log(2 * math.pi)
        return torch.logsumexp(log_weight + log_density.sum(2), dim=1)

    def forward(self, observation, achieved_goal, desired_goal):
        """The most likely mode's mean (N, n), as an action; policy.onnx contains this function."""
        mean, _, log_weight = self.modes(observation, desired_goal)
        likeliest = log_weight.argmax(1).reshape(-1, 1, 1).expand(-1, 1, self.num_joints)
        return MAX_STEP * mean.gather(1, likeliest).squeeze(1)


# ALGO LOGIC: demonstrations
def transitions(demos, goal_type):
    """All transitions of `Demos`, m of an arm with n joints.

    A demonstration is used to its end, also after its goal counts as reached.

    Returns:
        Observations (m, o), goals (m, g) and actions (m, n), in units of `MAX_STEP`, float32; and
        the numbers of their demonstrations, int64 (m,).
    """
    demo_index = np.repeat(np.arange(len(demos)), np.diff(demos.offsets))
    has_action = np.ones(len(demo_index), bool)
    has_action[demos.offsets[1:] - 1] = False  # the last states
    demo_index = demo_index[has_action]
    robot = demos.scenes.base.robot
    observation, _, goal = observed(demos.states[has_action], demos.goal, goal_type, robot)
    return observation, goal[demo_index], demos.actions[has_action] / MAX_STEP, demo_index


# ALGO LOGIC: one update
def update(actor, optimizer, batch):
    """One step on a batch, a dict of tensors (N, ...). Returns the loss before it."""
    loss = -actor.log_likelihood(batch["observation"], batch["goal"], batch["action"]).mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return {"negative_log_likelihood": loss}


if __name__ == "__main__":
    args = runs.parse_args(Args, may_change={"total_updates", "test_queries"})
    device = runs.seed_torch(args)
    validation, test = protocol.load_task(args)
    with runs.errors_of("--demos"):
        demos = load_demo_files(args.demos, args.task, args.num_demos)
    env_arguments = {
        "goal_type": args.goal_type,
        "encoder": args.encoder,
        "num_points": args.num_points,
    }
    eval_envs = protocol.make_eval_envs(args.task, len(validation), **env_arguments)

    # ALGO LOGIC: data
    data = [torch.as_tensor(array, device=device) for array in transitions(demos, args.goal_type)]

    # ALGO LOGIC: network and optimiser
    actor = Actor(args, eval_envs[0]).to(device)
    actor_average = Actor(args, eval_envs[0]).to(device).eval()  # evaluated and saved
    actor_average.load_state_dict(actor.state_dict())
    optimizer = cuda_graphs.adam(actor.parameters(), args.learning_rate, args, device)
    learn = cuda_graphs.graphed(functools.partial(update, actor, optimizer), args, device)
    state = {"actor": actor, "actor_average": actor_average, "optimizer": optimizer}
    run = protocol.PolicyRun(args, state, device, env_arguments, eval_envs, validation)

    latents = None  # the encoded scene of each demonstration; the first time takes minutes
    if args.encoder is not None:
        with runs.errors_of("--encoder"):
            encoded = eval_envs[0].encoder.encode_demos(demos)
        latents = torch.as_tensor(encoded, device=device)
    del demos
    run.start(args.total_updates, "update")
    run.repeat_evaluation(actor_average)

    while run.step < args.total_updates:
        # ALGO LOGIC: learn
        remaining = 1.0 - run.step / args.total_updates if args.anneal else 1.0
        learning_rate = args.learning_rate * remaining
        cuda_graphs.set_learning_rate(optimizer, learning_rate)
        rows = torch.randint(len(data[0]), (args.batch_size,), device=device)
        observation, goal, action, demo_index = (tensor[rows] for tensor in data)
        if latents is not None:
            observation = torch.cat([observation, latents[demo_index]], dim=1)
        losses = learn({"observation": observation, "goal": goal, "action": action})
        polyak_update(actor_average, actor, args.policy_average)
        step = run.advance()
        if step % 1000 == 0:
            run.log({f"losses/{name}": value for name, value in losses.items()})
            run.log({"charts/learning_rate": learning_rate, "charts/SPS": int(run.rate)})

        # Evaluate, save the best policy, checkpoint
        evaluating = step % args.eval_every == 0 or step == args.total_updates
        if evaluating and run.validate(actor_average):
            run.save_policy(actor_average)
        if evaluating or run.interrupted:
            run.checkpoint()
    run.final_test(test)
