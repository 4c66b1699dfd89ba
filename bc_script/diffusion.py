"""Diffusion policy: chunks of actions, drawn by denoising. One file: read it top to bottom.

    roboarm train diffusion --task no_obstacles --goal-type combined
    python bc_script/diffusion.py --task double_walls --goal-type ee    # the same script

A network learns to remove noise from the next actions of demonstrations (Chi et al., 2023). The
policy turns noise into a chunk of actions in a few steps (DDIM: Song et al., 2021), executes a part
of it, and draws the next chunk. For your own algorithm, copy this file and change the parts under
`# ALGO LOGIC`; `# SHARED` is as in `bc.py` and `gciql.py`.
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
from roboarm_nmp.training.arguments import errors_of, fail, parse_args
from roboarm_nmp.training.cuda_graphs import graphed
from roboarm_nmp.training.devices import adam, seed_torch, set_learning_rate, to_device
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
    """batches of the whole run, which the learning rate depends on"""
    batch_size: flags.PositiveInt = 256
    """chunks per batch"""
    learning_rate: flags.PositiveFloat = 1e-3
    """learning rate (Adam) at the start; it decreases to zero (Chi et al.: 1e-4)"""
    chunk_size: flags.Width = 16
    """actions in a chunk"""
    executed_actions: flags.Width = 2
    """actions of a chunk that are executed before the next one is drawn"""
    denoising_steps: flags.Layers = 5
    """steps from noise to a chunk, when the policy acts (Chi et al.: 10 to 100)"""
    noise_scale: flags.NonNegativeFloat = 0.0
    """of the noise that the saved policy's chunks are made of; below 1, chunks are nearer to the
    demonstrations' mean"""
    hindsight: flags.Share = 0.5
    """share of chunks whose goal is a place that their demonstration reaches on its way"""
    policy_average: flags.PositiveShare = 0.001
    """share of the policy that moves per update into the average that is saved (1: no averaging)"""
    hidden_size: flags.Width = 256
    """width of the residual blocks"""
    num_blocks: flags.Layers = 3
    """number of residual blocks"""
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


# ALGO LOGIC: the policy
class Block(nn.Module):
    """A residual block."""

    def __init__(self, size, bf16):
        super().__init__()
        self.norm = nn.LayerNorm(size)
        self.first = Bf16Linear(size, size, bf16)
        self.second = Bf16Linear(size, size, bf16)

    def forward(self, x):
        return x + self.second(F.silu(self.first(self.norm(x))))


class Actor(nn.Module):
    """A chunk of k actions at time t is cos(t) actions + sin(t) noise; t is from 0 to pi / 2.

    Actions are in units of `scale`, in which their standard deviation is about 1.
    """

    noise: torch.Tensor
    frequencies: torch.Tensor

    def __init__(self, args, env):
        super().__init__()
        self.args = args
        self.features = GoalFeatures(env, args.plain_networks, args.jacobian)
        n = self.features.num_joints
        size = args.chunk_size * n
        self.scale = MAX_STEP / math.sqrt(n)
        self.recurrent_size = 1 + args.executed_actions * n  # how many are left, and which
        self.condition = nn.Linear(self.features.size, args.hidden_size)
        self.first = nn.Linear(size + 16, args.hidden_size)
        blocks = (Block(args.hidden_size, args.bf16) for _ in range(args.num_blocks))
        self.blocks = nn.Sequential(*blocks)
        self.head = nn.Sequential(nn.LayerNorm(args.hidden_size), nn.Linear(args.hidden_size, size))
        # Evaluations are to be repeatable, so that every chunk is made of the same noise.
        noise = np.random.default_rng(args.seed).standard_normal((1, size), np.float32)
        self.register_buffer("noise", args.noise_scale * torch.from_numpy(noise))
        self.register_buffer("frequencies", torch.arange(1.0, 9.0))

    def velocity(self, noisy, t, condition):
        """The derivative of noisy chunks (N, k * n) by the time (N, 1).

        That is cos(t) noise - sin(t) actions: the v of Salimans and Ho (2022).
        """
        phases = t * self.frequencies
        x = torch.cat([noisy, phases.sin(), phases.cos()], dim=1)
        return self.head(self.blocks(self.first(x) + condition))

    def draw(self, observation, desired_goal):
        """A chunk for each observation: (N, k * n), in units of `scale`."""
        condition = self.condition(self.features(observation, desired_goal))
        x = self.noise + 0.0 * condition[:, :1]  # (N, k * n), in a form that can be exported
        step = 0.5 * math.pi / self.args.denoising_steps
        for i in range(self.args.denoising_steps, 0, -1):  # DDIM: a turn towards the actions
            t = 0.0 * x[:, :1] + i * step
            x = math.cos(step) * x - math.sin(step) * self.velocity(x, t, condition)
        return x

    def forward(self, observation, achieved_goal, desired_goal, recurrent_state):
        """The action (N, n), and the recurrent state after it; policy.onnx contains this function.

        A network has no branches, so a chunk is drawn at each step, but is used only when the last
        one is over.
        """
        n = self.features.num_joints
        left, chunk = recurrent_state[:, :1], recurrent_state[:, 1:]
        drawn = self.draw(observation, desired_goal)[:, : self.args.executed_actions * n]
        chunk = torch.where(left > 0.0, chunk, drawn)
        left = torch.where(left > 0.0, left, self.args.executed_actions) - 1.0
        later = torch.cat([left, chunk[:, n:], 0.0 * chunk[:, :n]], dim=1)
        return self.scale * chunk[:, :n], later


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
def sample(data, args, rng):
    """A dict of float32 arrays: `observation` (N, o), `goal` (N, g), `chunk` (N, k, n).

    After the goal is reached, the arm rests.
    """
    row = data.steps[rng.integers(len(data.steps), size=args.batch_size)]
    later = row + 1 + (rng.random(args.batch_size) * (data.last[row] - row)).astype(int)
    on_the_way = rng.random(args.batch_size) < args.hindsight
    end = np.where(on_the_way, later, data.last[row])
    goal = np.where(
        on_the_way[:, None], data.achieved_goal[later], data.desired_goal[data.demo[row]]
    )
    rows = row[:, None] + np.arange(args.chunk_size)
    chunk = data.action[np.minimum(rows, end[:, None])] * (rows < end[:, None])[:, :, None]
    return {"observation": data.observe(row), "goal": goal, "chunk": chunk}


# ALGO LOGIC: one update
def update(actor, optimizer, batch):
    """One step on a batch, a dict of tensors (N, ...). Returns the loss before it."""
    actions = batch["chunk"].flatten(1) / actor.scale
    t = 0.5 * math.pi * torch.rand_like(actions[:, :1])
    noise = torch.randn_like(actions)
    condition = actor.condition(actor.features(batch["observation"], batch["goal"]))
    predicted = actor.velocity(t.cos() * actions + t.sin() * noise, t, condition)
    loss = (predicted - (t.cos() * noise - t.sin() * actions)).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return {"denoising_loss": loss}


LOG_SECONDS = 10  # between two logs of the losses

if __name__ == "__main__":
    args = parse_args(Args, may_change={"total_updates", "test_queries"})
    if args.executed_actions > args.chunk_size:
        fail("--executed-actions must be at most --chunk-size")
    device = seed_torch(args)
    validation, test = load_task(args)
    with errors_of("--demos"):
        demos = load_demo_files(args.demos, args.task, args.num_demos)
    env_arguments = {name: getattr(args, name) for name in ("goal_type", "encoder", "num_points")}
    with errors_of("--encoder"):
        env: Any = roboarm_nmp.make(args.task, **env_arguments)  # for its spaces

    # ALGO LOGIC: network and optimiser
    actor = Actor(args, env).to(device)
    actor_average = Actor(args, env).to(device).eval()  # evaluated and saved
    actor_average.load_state_dict(actor.state_dict())
    optimizer = adam(actor.parameters(), args.learning_rate, device)
    learn = graphed(functools.partial(update, actor, optimizer), device)
    rng = np.random.default_rng(args.seed)
    progress = {"evaluated": 0, "best": -1.0, "best_step": 0}
    state = {"actor": actor, "actor_average": actor_average, "optimizer": optimizer, "rng": rng}
    run = Run(args, task_name(args.task), state | {"progress": progress})
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
        rate = args.learning_rate * (0.5 + 0.5 * math.cos(math.pi * run.step / args.total_updates))
        set_learning_rate(optimizer, rate)
        batch = sample(data, args, rng)
        losses = learn({name: to_device(array, device) for name, array in batch.items()})
        polyak_update(actor_average, actor, args.policy_average)
        run.advance()
        if time.monotonic() - logged > LOG_SECONDS or run.step == 1:
            logged = time.monotonic()
            run.log({f"losses/{name}": value for name, value in losses.items()})
            run.log({"charts/learning_rate": rate, "charts/SPS": run.rate})
        if run.interrupted:
            run.save()
    run.save()  # a longer run, which continues this one, knows its best policy
    finish(run, test, progress["best"], progress["best_step"])
