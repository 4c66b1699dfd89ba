"""Offline goal-conditioned implicit Q-learning (GCIQL). One file: read it top to bottom.

    roboarm train gciql --task no_obstacles --goal-type combined
    python bc_script/gciql.py --task double_walls --goal-type ee    # the same script

Reinforcement learning from demonstrations alone, without a simulator (Kostrikov et al., 2022): the
value of a state is an expectile of the values of demonstrated actions, and the policy takes those
of them that are better than it. Goals are from hindsight, as in OGBench (Park et al., 2025). For
your own algorithm, copy this file and change the parts under `# ALGO LOGIC`; `# SHARED` is as in
`bc.py` and `diffusion.py`.
"""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn as nn

import roboarm_nmp
from roboarm_nmp.datasets.demonstrations import load_demo_files
from roboarm_nmp.datasets.episodes import observed
from roboarm_nmp.envs.subgoals import MAX_STEP
from roboarm_nmp.envs.tasks import task_name
from roboarm_nmp.evaluation.evaluate import evaluate, first_episode_images
from roboarm_nmp.policies.export import save_policy
from roboarm_nmp.training.arguments import errors_of, fail, parse_args
from roboarm_nmp.training.cuda_graphs import graphed
from roboarm_nmp.training.devices import adam, seed_torch, to_device
from roboarm_nmp.training.final_test import RESULTS, finish, load_task
from roboarm_nmp.training.network_parts import Bf16Linear, GoalFeatures, polyak_update
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
    total_updates: flags.PositiveInt = 200_000
    """updates of the whole run (OGBench: 1,000,000)"""
    batch_size: flags.PositiveInt = 256
    """transitions per update (OGBench: 1,024)"""
    policy_loss: Literal["awr", "ddpg_bc"] = "ddpg_bc"
    """imitation that prefers better actions (advantage-weighted regression), or ascent of the value
    with imitation (DDPG+BC)"""
    temperature: flags.PositiveFloat = 1.0
    """with `awr`, the advantage, in steps, that makes an action's weight e times as large"""
    bc_weight: flags.NonNegativeFloat = 0.1
    """with `ddpg_bc`, weight of imitation; the value is divided by the mean of its magnitude"""
    expectile: flags.Share = 0.9
    """expectile of the actions' values that is the state's value (0.5: their mean)"""
    random_goals: flags.Share = 0.3
    """share of the value's goals that are from other demonstrations"""
    her_exponent: flags.PositiveFloat = 1.0
    """of the policy's goals, preference for those that are reached soon (1: none)"""
    gamma: flags.Share = 0.99
    """discount factor; also, a goal k steps ahead is drawn for the value with a probability
    proportional to gamma^k"""
    tau: flags.PositiveShare = 0.005
    """share of the critics that moves into the target critics per update"""
    learning_rate: flags.PositiveFloat = 1e-3
    """learning rate of all networks (Adam; OGBench: 3e-4)"""
    policy_average: flags.PositiveShare = 0.001
    """share of the policy that moves per update into the average that is saved (1: no averaging)"""
    hidden_size: flags.Width = 256
    """width of the hidden layers (OGBench: 512)"""
    num_hidden_layers: flags.Layers = 2
    """number of hidden layers (OGBench: 3)"""
    jacobian: bool = True
    """network inputs: how the joints move the end effector straight to the goal (Jacobian)"""
    plain_networks: bool = False
    """raw observations and goals as inputs"""
    bf16: bool | None = None
    """train with hidden layers in bfloat16; by default where that is faster"""
    encoder: str | None = None
    """the encoded scene in the observation: latent code (`vae`, `vqvae`, `pointnet2`, `field`, or
    the path of your own `encoder.onnx`), `point_cloud`, or `oracle` (ground-truth obstacles)"""
    num_points: flags.PositiveInt = 64
    """points of the encoder `point_cloud`"""
    eval_every: flags.PositiveInt = 25_000
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


# ALGO LOGIC: networks
class Actor(nn.Module):
    """The mean action; its length is at most `MAX_STEP`, as that of all executed ones."""

    def __init__(self, args, env):
        super().__init__()
        self.features = GoalFeatures(env, args.plain_networks, args.jacobian)
        self.mlp = mlp(self.features.size, self.features.num_joints, args)

    def mean_action(self, features):
        """(N, f) -> (N, n), in units of `MAX_STEP`."""
        mean = self.mlp(features)
        return mean / mean.norm(dim=1, keepdim=True).clamp_min(1.0)

    def forward(self, observation, achieved_goal, desired_goal):
        """The action (N, n), for evaluation; policy.onnx contains this function."""
        return MAX_STEP * self.mean_action(self.features(observation, desired_goal))


class Critics(nn.Module):
    """Q1 and Q2."""

    def __init__(self, args, features):
        super().__init__()
        size = features.size + features.num_joints
        self.mlps = nn.ModuleList(mlp(size, 1, args, layer_norm=True) for _ in range(2))

    def forward(self, features, action):
        """(N, f), (N, n), in units of `MAX_STEP` -> (2, N)."""
        inputs = torch.cat([features, action], dim=1)
        return torch.stack([qf(inputs).squeeze(1) for qf in self.mlps])


# SHARED: demonstrations
class DemoSteps:
    """The steps of all demonstrations of D one after the other, m rows, float32 (m, ...) each.

    The last row of a demonstration has no action: zeros. `steps` are the rows that have one.
    """

    def __init__(self, demos, goal_type, encoder):
        robot = demos.scenes.base.robot
        parts = observed(demos.states, demos.goal, goal_type, robot)
        self.observation, self.achieved_goal, self.desired_goal = parts  # the last one: (D, g)
        self.action = demos.actions
        lengths = np.diff(demos.offsets)
        self.demo = np.repeat(np.arange(len(demos)), lengths)
        self.last = np.repeat(demos.offsets[1:] - 1, lengths)  # row of the demonstration's end
        self.steps = np.flatnonzero(np.arange(len(self.last)) < self.last)
        self.latents = None if encoder is None else encoder.encode_demos(demos)

    def observe(self, rows):
        """Observations (N, o), the encoded scene included."""
        observation = self.observation[rows]
        if self.latents is None:
            return observation
        return np.hstack([observation, self.latents[self.demo[rows]]])


# ALGO LOGIC: batches
def sample(data, env, args, rng):
    """A dict of float32 arrays (N, ...); `reward` and `terminated` (N,).

    Goals are reached by the demonstration at a later step, or, a share of the value's, by another
    demonstration. Those of the policy's updates, `policy_goal`, are others than those of the value.
    """
    number = args.batch_size
    row = data.steps[rng.integers(len(data.steps), size=number)]
    remaining = data.last[row] - row
    share = 1.0 - args.gamma**remaining
    soon = np.log1p(-share * rng.random(number)) / np.log(args.gamma)
    goal_row = row + 1 + np.minimum(soon.astype(int), remaining - 1)
    others = rng.random(number) < args.random_goals
    goal_row = np.where(others, rng.integers(len(data.last), size=number), goal_row)
    later = rng.random(number) ** args.her_exponent * remaining
    goal = data.achieved_goal[goal_row]
    terminated = env.compute_terminated(data.achieved_goal[row + 1], goal, {})
    return {
        "observation": data.observe(row),
        "action": data.action[row] / np.float32(MAX_STEP),
        "next_observation": data.observe(row + 1),
        "goal": goal,
        "policy_goal": data.achieved_goal[row + 1 + later.astype(int)],
        "terminated": terminated.astype(np.float32),
        "reward": terminated.astype(np.float32) - 1.0,
    }


# ALGO LOGIC: networks, optimisers and updates
LOG_SECONDS = 10  # between two logs of the losses
MAX_WEIGHT = 100.0  # of an action in advantage-weighted regression


def step(optimizer, loss):
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


class GCIQL(nn.Module):
    def __init__(self, args, env, device):
        super().__init__()
        self.args = args
        self.actor = Actor(args, env).to(device)
        self.actor_average = Actor(args, env).to(device).eval()  # evaluated and saved
        self.actor_average.load_state_dict(self.actor.state_dict())
        features = self.actor.features
        self.critics = Critics(args, features).to(device)
        self.critics_target = Critics(args, features).to(device)
        self.critics_target.load_state_dict(self.critics.state_dict())
        self.value = mlp(features.size, 1, args, layer_norm=True).to(device)
        self.actor_optimizer = adam(self.actor.parameters(), args.learning_rate, device)
        self.critic_optimizer = adam(self.critics.parameters(), args.learning_rate, device)
        self.value_optimizer = adam(self.value.parameters(), args.learning_rate, device)

    def update(self, data):
        """A step of all networks on a batch. Returns tensors whose means are logged."""
        args, action = self.args, data["action"]
        features = self.actor.features(data["observation"], data["goal"])
        with torch.no_grad():
            next_features = self.actor.features(data["next_observation"], data["goal"])
            next_value = self.value(next_features).squeeze(1)
            target = data["reward"] + args.gamma * (1.0 - data["terminated"]) * next_value
            better = self.critics_target(features, action).amin(0)

        surplus = better - self.value(features).squeeze(1)
        weight = torch.where(surplus > 0.0, args.expectile, 1.0 - args.expectile)
        value_loss = (weight * surplus.square()).mean()
        qf_values = self.critics(features, action)
        qf_losses = (qf_values - target).square().mean(1)  # of Q1 and of Q2
        step(self.value_optimizer, value_loss)
        step(self.critic_optimizer, qf_losses.sum())
        actor_loss = self.actor_loss(data)
        step(self.actor_optimizer, actor_loss)
        polyak_update(self.critics_target, self.critics, args.tau)
        polyak_update(self.actor_average, self.actor, args.policy_average)
        losses = {"value_loss": value_loss, "qf_loss": qf_losses, "actor_loss": actor_loss}
        return losses | {"qf1_values": qf_values[0]}

    def actor_loss(self, data):
        """The policy's loss, of a Gaussian with standard deviation 1 (in units of `MAX_STEP`)."""
        args = self.args
        features = self.actor.features(data["observation"], data["policy_goal"])
        mean = self.actor.mean_action(features)
        imitation = 0.5 * (mean - data["action"]).square().sum(1)
        if args.policy_loss == "awr":
            with torch.no_grad():
                advantage = self.critics(features, data["action"]).amin(0)
                advantage = advantage - self.value(features).squeeze(1)
                weight = (advantage / args.temperature).exp().clamp_max(MAX_WEIGHT)
            return (weight * imitation).mean()
        self.critics.requires_grad_(False)  # they need no gradient of the policy's loss
        value = self.critics(features, mean).amin(0)
        self.critics.requires_grad_(True)
        return args.bc_weight * imitation.mean() - value.mean() / value.abs().mean().detach()


if __name__ == "__main__":
    args = parse_args(Args, may_change={"total_updates", "test_queries"})
    if args.gamma in (0.0, 1.0):
        fail("--gamma must be between 0 and 1")
    device = seed_torch(args)
    validation, test = load_task(args)
    with errors_of("--demos"):
        demos = load_demo_files(args.demos, args.task, args.num_demos)
    env_arguments = {name: getattr(args, name) for name in ("goal_type", "encoder", "num_points")}
    with errors_of("--encoder"):
        env: Any = roboarm_nmp.make(args.task, **env_arguments)  # for its spaces and goals

    agent = GCIQL(args, env, device)
    update = graphed(agent.update, device)
    rng = np.random.default_rng(args.seed)
    progress = {"evaluated": 0, "best": -1.0, "best_step": 0}
    state = {"agent": agent, "rng": rng, "progress": progress}
    state["actor_optimizer"] = agent.actor_optimizer
    state["critic_optimizer"] = agent.critic_optimizer
    state["value_optimizer"] = agent.value_optimizer
    run = Run(args, task_name(args.task), state)
    with errors_of("--encoder"):  # scenes are encoded, which takes minutes the first time
        data = DemoSteps(demos, args.goal_type, getattr(env, "encoder", None))
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
            save_policy(latest, agent.actor_average, args.task, None, origin, **env_arguments)
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
        batch = sample(data, env, args, rng)
        losses = update({name: to_device(array, device) for name, array in batch.items()})
        run.advance()
        if time.monotonic() - logged > LOG_SECONDS or run.step == 1:
            logged = time.monotonic()
            run.log({f"losses/{name}": value for name, value in losses.items()})
            run.log({"charts/SPS": run.rate})
        if run.interrupted:
            run.save()
    run.save()  # a longer run, which continues this one, knows its best policy
    finish(run, test, progress["best"], progress["best_step"])
