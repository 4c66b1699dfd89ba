"""Behavioural cloning (BC) of demonstrations. One file: read it top to bottom.

    roboarm train bc --task no_obstacles --goal-type combined
    python bc_script/bc.py --task double_walls --goal-type config --demos a.h5 b.h5

Maximum likelihood of the demonstrated actions under a Gaussian policy, or with `--num-modes` a
mixture of Gaussians (paper, sections 2 and 5, appendix "Parameter sweeps"). For your own algorithm,
copy this file and change the parts under `# ALGO LOGIC`; `# SHARED` is as in `sac_her_mp.py`.
"""

import functools
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

import roboarm_nmp
from roboarm_nmp.datasets.demonstrations import load_demo_files
from roboarm_nmp.datasets.episodes import observed
from roboarm_nmp.envs.subgoals import MAX_STEP
from roboarm_nmp.envs.tasks import task_name
from roboarm_nmp.evaluation.evaluate import evaluate, first_episode_images
from roboarm_nmp.policies.export import save_policy
from roboarm_nmp.training.arguments import errors_of, parse_args
from roboarm_nmp.training.cuda_graphs import graphed
from roboarm_nmp.training.devices import adam, seed_torch, set_learning_rate
from roboarm_nmp.training.final_test import RESULTS, finish, load_task
from roboarm_nmp.training.network_parts import Bf16Linear, polyak_update, pose_difference
from roboarm_nmp.training.runs import Run, script_name
from roboarm_nmp.utils import flags


# SHARED: flags of the run
@dataclass
class RunArgs:
    task: str = "no_obstacles"
    """a task of `roboarm_nmp.TASKS` or a scene file; with another arm TASK@FILE, a robot's file"""
    seed: flags.Seed = 1
    """seed of all random numbers; runs with the same seed, machine and device are identical"""
    eval_queries: flags.PositiveInt = 200
    """validation queries per evaluation; the best policy is saved"""
    test_queries: flags.NonNegativeInt = 1_000
    """test queries for the best policy at the end (0: no test)"""
    capture_video: bool = False
    """a video of the first validation query per evaluation, in TensorBoard and as a file"""
    runs_dir: Path = Path("runs")
    """parent of the run's folder: TensorBoard events, checkpoint, `policy.onnx`, result.json"""
    resume: Path | None = None
    """continue the run in this folder from its last checkpoint, with its flags"""
    device: str = "cpu"
    """`cpu`, `cuda` or one of several, `cuda:1`"""
    track: bool = False
    """log to Weights & Biases as well as to TensorBoard (`pip install wandb`)"""


# ALGO LOGIC: flags
@dataclass
class Args(RunArgs):
    goal_type: Literal["ee", "config", "combined", "pose"] = "combined"
    """what the goal is: end-effector position, configuration, both, or end-effector pose"""
    demos: tuple[Path, ...] = ()
    """demonstration files of the task; by default the task's own"""
    num_demos: flags.PositiveInt | None = None
    """number of demonstrations of each file, the first ones; by default all"""
    total_updates: flags.PositiveInt = 1_000_000
    """batches of the whole run, which the learning rate depends on (paper: 1,000,000)"""
    batch_size: flags.PositiveInt = 256
    """transitions per batch"""
    learning_rate: flags.PositiveFloat = 1e-3
    """learning rate (Adam) at the start"""
    anneal: bool = True
    """decrease the learning rate linearly to zero"""
    num_modes: flags.Width = 1
    """Gaussians of the policy's mixture; the most likely one's mean is the action in evaluation"""
    policy_average: flags.PositiveShare = 0.001
    """share of the policy that moves per update into the average that is saved (1: no averaging)"""
    hidden_size: flags.Width = 256
    """width of the hidden layers"""
    num_hidden_layers: flags.Layers = 2
    """number of hidden layers"""
    plain_networks: bool = False
    """raw observations and goals as inputs"""
    bf16: bool = False
    """train with hidden layers in bfloat16"""
    encoder: str | None = None
    """the encoded scene in the observation: latent code (`vae`, `vqvae`, `pointnet2`, `field`, or
    the path of your own `encoder.onnx`), `point_cloud`, or `oracle` (ground-truth obstacles)"""
    num_points: flags.PositiveInt = 64
    """points of the encoder `point_cloud`"""
    eval_every: flags.PositiveInt = 50_000
    """updates between evaluations on validation queries"""


# SHARED: hidden layers
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


# ALGO LOGIC: the policy
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
    """All transitions of `Demos`, m of an arm with n joints, also those after a goal is reached.

    Returns observations (m, o), goals (m, g), actions (m, n), in units of `MAX_STEP`, float32, and
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


LOG_SECONDS = 10  # between two logs of the losses

if __name__ == "__main__":
    args = parse_args(Args, may_change={"total_updates", "test_queries"})
    device = seed_torch(args)
    validation, test = load_task(args)
    with errors_of("--demos"):
        demos = load_demo_files(args.demos, args.task, args.num_demos)
    env_arguments = {name: getattr(args, name) for name in ("goal_type", "encoder", "num_points")}
    with errors_of("--encoder"):
        env: Any = roboarm_nmp.make(args.task, **env_arguments)  # for its spaces

    # ALGO LOGIC: data
    data = [torch.as_tensor(array, device=device) for array in transitions(demos, args.goal_type)]

    # ALGO LOGIC: network and optimiser
    actor = Actor(args, env).to(device)
    actor_average = Actor(args, env).to(device).eval()  # evaluated and saved
    actor_average.load_state_dict(actor.state_dict())
    optimizer = adam(actor.parameters(), args.learning_rate, device)
    learn = graphed(functools.partial(update, actor, optimizer), device)
    progress = {"evaluated": 0, "best": -1.0, "best_step": 0}
    state = {"actor": actor, "actor_average": actor_average, "optimizer": optimizer}
    run = Run(args, task_name(args.task), state | {"progress": progress})

    latents = None  # the encoded scene of each demonstration; the first time takes minutes
    if args.encoder is not None:
        with errors_of("--encoder"):
            latents = torch.as_tensor(env.encoder.encode_demos(demos), device=device)
    del demos
    logged = 0.0
    run.start(args.total_updates, "update")

    while True:
        # Evaluate, keep the best policy
        due = run.step % args.eval_every == 0 or run.step >= args.total_updates
        if due and run.step > progress["evaluated"]:
            run.save()  # a run that is stopped while it evaluates repeats the evaluation
            run.interruptible = True
            latest = run.folder / "latest.onnx"
            origin = {"script": script_name(), "seed": args.seed, "step": run.step}
            save_policy(latest, actor_average, args.task, None, origin, **env_arguments)
            result = evaluate(latest, args.task, queries=validation)
            run.log({f"eval/{name}": result[name] for name in RESULTS})
            if args.capture_video:
                images = first_episode_images(latest, args.task, 40, queries=validation)
                run.log_video("eval/episode", images)
            run.interruptible = False
            progress["evaluated"] = run.step
            if result["success_rate"] >= progress["best"]:
                progress |= {"best": result["success_rate"], "best_step": run.step}
                os.replace(latest, run.folder / "policy.onnx")
        if run.step >= args.total_updates:
            break

        # ALGO LOGIC: learn
        remaining = 1.0 - run.step / args.total_updates if args.anneal else 1.0
        set_learning_rate(optimizer, args.learning_rate * remaining)
        rows = torch.randint(len(data[0]), (args.batch_size,), device=device)
        observation, goal, action, demo_index = (tensor[rows] for tensor in data)
        if latents is not None:
            observation = torch.cat([observation, latents[demo_index]], dim=1)
        losses = learn({"observation": observation, "goal": goal, "action": action})
        polyak_update(actor_average, actor, args.policy_average)
        run.advance()
        if time.monotonic() - logged > LOG_SECONDS or run.step == 1:
            logged = time.monotonic()
            run.log({f"losses/{name}": value for name, value in losses.items()})
            run.log(
                {"charts/learning_rate": args.learning_rate * remaining, "charts/SPS": run.rate}
            )
        if run.interrupted:
            run.save()
    run.save()  # a longer run, which continues this one, knows its best policy
    finish(run, test, progress["best"], progress["best_step"])
