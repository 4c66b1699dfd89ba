"""SAC with hindsight experience replay (HER) and demonstrations. One file: read it top to bottom.

    python clean_rl_scripts/sac_her_mp.py --task no_obstacles --goal-type ee
    python clean_rl_scripts/sac_her_mp.py --task double_walls --demo-prob 1

Soft Actor-Critic (Haarnoja et al., 2018) in CleanRL's form, goals relabelled with the `future`
strategy (Andrychowicz et al., 2017), demonstrations injected upon failure (SAC-MP), as in the
paper's sections 2 and 5. To make an algorithm of your own, copy this file and change the parts
under `# ALGO LOGIC`. Parts between `# SHARED` and `# END SHARED` are those of `td3_her_mp.py`.
"""

import json
import math
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

import envs as roboarm
from envs import panda
from envs.datasets import MAX_STEP, DatasetError, load_demos, load_queries
from envs.programs import load_program, save_program
from envs.runs import (
    elapsed,
    load_checkpoint,
    parse_args,
    progress_bar,
    rate,
    run_folder,
    save_checkpoint,
    seed_torch,
    summary_writer,
    write_json,
)
from envs.tasks import task_name


@dataclass
class Args:
    # The run
    exp_name: str = "sac_her_mp"
    """name of the experiment, part of the run's folder"""
    # SHARED: the run and the task
    seed: int = 1
    """seed of everything random; the same seed gives the same run on the same machine and device"""
    runs_dir: Path = Path("runs")
    """the run's folder is made in here: TensorBoard events, checkpoint, policy.pt, result.json"""
    resume: Path | None = None
    """continue the run in this folder from its last checkpoint; its own flags are used"""
    device: str = "cpu"
    """`cpu` or `cuda`"""
    threads: int = 1
    """torch threads; one is fastest for networks of this size, and leaves the other cores alone"""

    # The task (the paper's MDP; `docs/environment.md`)
    task: str = "no_obstacles"
    """task to train on, one of `envs.TASKS`, or a scene file (docs/your_own_scene.md)"""
    goal_type: Literal["ee", "config", "combined"] = "ee"
    """what the goal is: end-effector position, configuration, or both"""
    action_mode: Literal["relative", "subgoal"] = "relative"
    """action: a displacement of the normalised configuration, or the next one itself"""
    max_step: float = 0.03
    """longest displacement per step (L2, normalised configuration)"""
    horizon: int = 400
    """steps after which an episode is cut off"""
    stop_on_collision: bool = False
    """end an episode at the first touch"""
    velocities: bool = False
    """joint velocities in the observation"""
    encoder: str | None = None
    """what the policy sees of the scene, appended to the observation: a trained encoder (`vae`,
    `vqvae`, `pointnet2`, or the path of your own `encoder.pt`, docs/sensors.md), or `oracle`, the
    obstacles themselves; by default nothing"""
    num_envs: int = 4
    """environments stepped together; every one of their steps counts"""
    scene_size: ClassVar[int] = 0  # numbers of the encoded scene; set when the encoder is there
    # END SHARED

    # The algorithm
    total_timesteps: int = 1_000_000
    """environment steps of the whole run"""
    learning_starts: int = 2_000
    """environment steps with random actions before the first update"""
    updates_per_step: float = 0.5
    """updates of the critics per environment step (CleanRL: 1)"""
    buffer_size: int = 1_000_000
    """transitions in the replay buffer"""
    batch_size: int = 256
    """transitions per update"""
    her_probability: float = 0.8
    """share of sampled transitions whose goal is replaced by one reached later in their episode"""
    demo_prob: float | None = None
    """train on the queries of the task's demonstrations; when an episode fails, its demonstration
    enters the replay buffer with this probability (the paper's p). Without it: random queries"""
    demos: Path | None = None
    """demonstration file to use with --demo-prob; by default the task's own"""
    gamma: float = 0.95
    """discount factor (CleanRL: 0.99)"""
    tau: float = 0.005
    """share of the critics that moves into the target critics per update"""
    policy_lr: float = 1e-3
    """learning rate of the policy (Adam; CleanRL: 3e-4)"""
    q_lr: float = 1e-3
    """learning rate of the critics (Adam)"""
    alpha: float = 0.2
    """entropy coefficient, if it is not tuned"""
    autotune: bool = True
    """tune the entropy coefficient to the target entropy"""
    target_entropy: float = -7.0
    """entropy that the tuning aims at, of the unscaled action (CleanRL: minus its dimensions)"""
    policy_frequency: int = 2
    """updates of the critics per update of the policy (CleanRL: as often as the critics)"""
    policy_average: float = 0.001
    """share of the policy that moves into its running average per update of the policy; the average
    is what is evaluated and saved, the policy itself explores (1: no averaging, as CleanRL)"""
    hidden_size: int = 256
    """width of the hidden layers of policy and critics"""
    num_hidden_layers: int = 2
    """number of hidden layers of policy and critics"""
    layer_norm: bool = True
    """LayerNorm in the critics' hidden layers (CleanRL: no)"""
    action_scale: float = 0.06
    """the policy's outputs are in [-action_scale, action_scale]; the MDP clips a step at max_step,
    so with the full range of 1 every step is a longest step, which overshoots the goal"""
    relative_goal: bool = True
    """add goal minus end-effector position, times 5, to the networks' inputs"""
    trigonometric: bool = True
    """add the joint angles' sines and cosines to the networks' inputs"""
    bf16: bool | None = None
    """train with hidden layers in bfloat16 (first layer, head and weights stay in float32); by
    default where the hardware has it"""

    # SHARED: flags of the evaluation
    # Evaluation and bookkeeping
    eval_every: int = 25_000
    """environment steps between evaluations on validation queries; the best policy is kept"""
    eval_queries: int = 200
    """validation queries per evaluation"""
    test_queries: int = 1_000
    """test queries for the best policy at the end"""
    stop_at_success: float = 1.0
    """stop as soon as a validation success rate is this high, e.g. 0.9"""
    # END SHARED


# SHARED: arguments
def env_arguments(args):
    names = ("goal_type", "action_mode", "max_step", "horizon", "stop_on_collision", "velocities")
    return {name: getattr(args, name) for name in (*names, "encoder")}


# END SHARED


# ALGO LOGIC: networks
# SHARED: features and layers
class Features(nn.Module):
    """Network inputs: observation, desired goal, and functions of them that speed up learning."""

    def __init__(self, args):
        super().__init__()
        self.goal_type, self.relative_goal = args.goal_type, args.relative_goal
        self.trigonometric = args.trigonometric
        low, high = torch.tensor(panda.LOWER), torch.tensor(panda.UPPER)
        self.register_buffer("middle", ((high + low) / 2).float())
        self.register_buffer("half_range", ((high - low) / 2).float())
        goal_size = {"ee": 3, "config": 7, "combined": 10}[args.goal_type]
        self.ee = slice(7 + 7 * args.velocities, 10 + 7 * args.velocities)  # end-effector
        self.size = self.ee.stop + args.scene_size + goal_size
        self.size += 14 * args.trigonometric
        self.size += 3 * (args.relative_goal and args.goal_type != "config")

    def forward(self, observation, desired_goal):
        """(N, o), (N, g) -> (N, size)."""
        inputs = [observation, desired_goal]
        if self.trigonometric:
            angles = observation[:, :7] * self.half_range + self.middle
            inputs += [torch.sin(angles), torch.cos(angles)]
        if self.relative_goal and self.goal_type != "config":
            inputs.append(5.0 * (desired_goal[:, -3:] - observation[:, self.ee]))
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
            if not bf16:
                x = layer(x)
            elif i == 0:
                x = layer(x).bfloat16()
            else:
                x = F.linear(x, layer.weight.bfloat16(), layer.bias.bfloat16())
            x = F.relu(norm(x))
        return self.head(x.float())


# END SHARED


# SHARED: critic
class QNetwork(nn.Module):
    def __init__(self, args):
        super().__init__()
        self.features = Features(args)
        self.action_scale = args.action_scale if args.action_mode == "relative" else 1.0
        self.mlp = MLP(self.features.size + 7, 1, args, args.layer_norm)

    def forward(self, observation, desired_goal, action):
        """(N, o), (N, g), (N, 7) -> (N,)."""
        inputs = [self.features(observation, desired_goal), action / self.action_scale]
        return self.mlp(torch.cat(inputs, dim=1)).squeeze(-1)


# END SHARED


LOG_STD_MAX = 2
LOG_STD_MIN = -5


class Actor(nn.Module):
    def __init__(self, args):
        super().__init__()
        self.features = Features(args)
        self.action_scale = args.action_scale if args.action_mode == "relative" else 1.0
        self.mlp = MLP(self.features.size, 14, args, layer_norm=False)

    def sample(self, observation, desired_goal):
        """A random action (N, 7) and its log-density (N,) before scaling by `action_scale`."""
        mean, log_std = self.mlp(self.features(observation, desired_goal)).chunk(2, dim=1)
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (torch.tanh(log_std) + 1)
        noise = torch.randn_like(mean)
        unsquashed = mean + log_std.exp() * noise
        log_prob = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        # log(1 - tanh(u)^2) without cancellation
        log_prob = log_prob - 2 * (math.log(2) - unsquashed - F.softplus(-2 * unsquashed))
        return self.action_scale * torch.tanh(unsquashed), log_prob.sum(1)

    def forward(self, observation, achieved_goal, desired_goal):
        """The deterministic action (N, 7), for evaluation; this is what policy.pt contains."""
        mean = self.mlp(self.features(observation, desired_goal))[:, :7]
        return self.action_scale * torch.tanh(mean)


# SHARED: replay buffer and demonstrations
# ALGO LOGIC: replay buffer
class HerReplayBuffer:
    """Transitions of finished episodes in a ring; goals are relabelled when they are sampled.

    One float32 row per transition. `remaining` counts the transitions that follow in the same
    episode, so a goal reached later in it is found without storing episodes. New episodes
    overwrite the oldest rows from an episode's start on, so what a row points to outlives it. The
    encoded scene at the end of observations is stored once per scene, in `codes`.
    """

    def __init__(self, env, capacity, her_probability, rng):
        spaces = env.unwrapped.observation_space
        scene_size = env.observation_space["observation"].shape[0] - spaces["observation"].shape[0]
        sizes = {
            "observation": spaces["observation"].shape[0],
            "action": 7,
            "next_observation": spaces["observation"].shape[0],
            "next_achieved_goal": spaces["achieved_goal"].shape[0],
            "desired_goal": spaces["desired_goal"].shape[0],
            "collision": 1,
        }
        ends = np.cumsum(list(sizes.values()))
        self.columns = {
            name: slice(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)
        }
        self.rows = np.zeros((capacity, ends[-1]), np.float32)
        self.remaining = np.zeros(capacity, np.int32)
        self.codes, self.numbers = np.zeros((1, scene_size), np.float32), {}
        self.scene = np.zeros(capacity, np.int32)  # row of `codes`
        self.env, self.rng = env, rng
        self.capacity, self.her_probability = capacity, her_probability
        self.position, self.size = 0, 0

    def add_episode(self, transitions):
        """`transitions`: a list of dicts with the columns' names as keys."""
        index = (self.position + np.arange(len(transitions))) % self.capacity
        for name, columns in self.columns.items():
            width = columns.stop - columns.start  # without the encoded scene
            self.rows[index, columns] = np.stack(
                [np.atleast_1d(t[name])[:width] for t in transitions]
            )
        self.scene[index] = self.number_of(transitions[0]["observation"])
        self.remaining[index] = np.arange(len(transitions))[::-1]
        self.position = (self.position + len(transitions)) % self.capacity
        self.size = min(self.size + len(transitions), self.capacity)

    def number_of(self, observation):
        """The row of `codes` that has the encoded scene of an observation."""
        code = np.float32(observation[len(observation) - self.codes.shape[1] :])
        number = self.numbers.setdefault(code.tobytes(), len(self.numbers))
        if number == len(self.codes):
            self.codes = np.concatenate([self.codes, np.zeros_like(self.codes)])
        self.codes[number] = code
        return number

    def sample(self, batch_size):
        """A dict of float32 arrays (batch_size, ...); `reward` and `terminated` (batch_size,)."""
        index = self.rng.integers(self.size, size=batch_size)
        rows = self.rows[index]
        batch = {name: rows[:, columns] for name, columns in self.columns.items()}
        later = self.rng.random(batch_size) * (self.remaining[index] + 1)
        later = (index + later.astype(np.int64)) % self.capacity
        relabel = self.rng.random(batch_size) < self.her_probability
        hindsight_goal = self.rows[later, self.columns["next_achieved_goal"]]
        batch["desired_goal"] = np.where(relabel[:, None], hindsight_goal, batch["desired_goal"])
        goals = batch["next_achieved_goal"], batch["desired_goal"]
        info = {"collision": batch["collision"][:, 0] > 0}
        batch["reward"] = self.env.compute_reward(*goals, info).astype(np.float32)
        batch["terminated"] = self.env.compute_terminated(*goals, info).astype(np.float32)
        if self.codes.shape[1] > 0:
            code = self.codes[self.scene[index]]
            for name in ("observation", "next_observation"):
                batch[name] = np.hstack([batch[name], code])
        return batch

    def state_dict(self):
        return {
            "rows": torch.from_numpy(self.rows[: self.size]),
            "remaining": torch.from_numpy(self.remaining[: self.size]),
            "scene": torch.from_numpy(self.scene[: self.size]),
            "codes": torch.from_numpy(self.codes[: len(self.numbers)]),
            "position": self.position,
            "rng": json.dumps(self.rng.bit_generator.state),
        }

    def load_state_dict(self, state):
        self.size, self.position = len(state["rows"]), state["position"]
        self.rows[: self.size] = state["rows"].numpy()
        self.remaining[: self.size] = state["remaining"].numpy()
        self.scene[: self.size] = state["scene"].numpy()
        for code in state["codes"].numpy():
            self.number_of(code)
        self.rng.bit_generator.state = json.loads(state["rng"])


# ALGO LOGIC: demonstrations
def demonstration_to_inject(demos, query, is_success, demo_prob, rng):
    """After an episode on `demos`' query number `query`: its demonstration, or None.

    Only failures are shown how to do it, and only with probability `demo_prob`.
    """
    if is_success or rng.random() >= demo_prob:
        return None
    return demos[query]


def demonstration_episode(demo, env, args):
    """A demonstration as transitions for `HerReplayBuffer.add_episode`, up to reaching its goal."""
    positions = panda.forward_kinematics(panda.denormalise(demo.states))
    goal_position, goal_state = panda.forward_kinematics(demo.goal), panda.normalise(demo.goal)
    achieved_goals, desired_goal = {
        "ee": (positions, goal_position),
        "config": (demo.states, goal_state),
        "combined": (np.hstack([demo.states, positions]), np.hstack([goal_state, goal_position])),
    }[args.goal_type]
    observations = np.hstack([demo.states, positions])
    if args.encoder is not None:
        code = env.encoder(demo.scene)
        observations = np.hstack([observations, np.tile(code, (len(observations), 1))])
    actions = demo.actions
    if args.action_mode == "subgoal":
        actions = demo.states[:-1] + demo.actions
    ended = env.compute_terminated(achieved_goals[1:], desired_goal, {})
    length = int(np.argmax(ended)) + 1 if ended.any() else len(ended)
    return [
        {
            "observation": observations[t],
            "action": actions[t],
            "next_observation": observations[t + 1],
            "next_achieved_goal": achieved_goals[t + 1],
            "desired_goal": desired_goal,
            "collision": False,
        }
        for t in range(length)
    ]


# END SHARED


def td_target(reward, terminated, next_q1, next_q2, next_log_prob, alpha, gamma):
    """The critics' target r + gamma (1 - terminated) (min(Q1', Q2') - alpha log pi'), all (N,)."""
    next_value = torch.minimum(next_q1, next_q2) - alpha * next_log_prob
    return reward + gamma * (1.0 - terminated) * next_value


# SHARED: averaging and evaluation
def polyak_update(target_parameters, parameters, tau):
    """target <- (1 - tau) target + tau parameter, all tensors at once."""
    with torch.no_grad():
        torch._foreach_lerp_(target_parameters, parameters, tau)


# Evaluation
def stack(observations, device):
    """List of observation dicts -> dict of float32 tensors (N, ...)."""
    return {
        name: torch.as_tensor(np.stack([o[name] for o in observations]), device=device)
        for name in observations[0]
    }


@torch.no_grad()
def evaluate(policy, envs, queries, device):
    """Run a deterministic policy on every query, each env one at a time; mean results."""
    waiting = iter(range(len(queries)))
    running, results = {}, []

    def start(env):
        i = next(waiting, None)
        running.pop(env, None)
        if i is not None:
            running[env] = env.reset_specific(*queries[i])[0]

    for env in envs:
        start(env)
    while running:
        actions = policy(**stack(list(running.values()), device)).cpu().numpy()
        for env, action in zip(list(running), actions, strict=True):
            running[env], _, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                results.append(
                    (info["is_success"], info["collision_so_far"], info["elapsed_steps"])
                )
                start(env)
    success, touched, steps = np.array(results, dtype=np.float64).T
    return {
        "success_rate": float(success.mean()),
        "clean_success_rate": float((success * (1 - touched)).mean()),
        "collision_rate": float(touched.mean()),
        "episode_length": float(steps.mean()),
    }


@torch.no_grad()
def picture_of_rollout(policy, env, queries, device, frames=8):
    """An image strip (height, frames * width, 3), uint8, of the policy on the first query."""
    observation, _ = env.reset_specific(*queries[0])
    pictures, done = [env.render()], False
    while not done:
        action = policy(**stack([observation], device))[0].cpu().numpy()
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        if info["elapsed_steps"] % 10 == 0 or done:
            pictures.append(env.render())
    chosen = np.linspace(0, len(pictures) - 1, frames).round().astype(int)
    return np.concatenate([pictures[i] for i in chosen], axis=1)


# END SHARED


if __name__ == "__main__":
    # SHARED: checks, folder, seeds and environments
    args = parse_args(Args, may_change={"total_timesteps", "test_queries", "stop_at_success"})
    try:
        if not roboarm.get_task(args.task).trainable:
            sys.exit(f"{args.task} is for testing only: nothing may be learned from it")
        validation = load_queries(args.task, "validation")[: args.eval_queries]
        test = load_queries(args.task, "test")[: args.test_queries]
    except ValueError as error:
        sys.exit(f"--task: {error}")
    if args.buffer_size < args.horizon:
        sys.exit(f"--buffer-size {args.buffer_size}: an episode has {args.horizon} transitions")
    demos = None
    if args.demos is not None and args.demo_prob is None:
        sys.exit("--demos goes with --demo-prob")
    if args.demo_prob is not None:
        if not 0 <= args.demo_prob <= 1:
            sys.exit(f"--demo-prob {args.demo_prob}: a probability is in [0, 1]")
        if args.velocities or args.max_step < MAX_STEP:
            sys.exit(f"--demo-prob: demonstrations have no velocities, and steps up to {MAX_STEP}")
        try:
            demos = load_demos(args.demos or args.task, args.task)
        except DatasetError as error:
            sys.exit(f"--demo-prob: {error}")
        if args.stop_on_collision and demos.collided.any():
            sys.exit("--stop-on-collision: some of these demonstrations touch something")
    run = run_folder(args, task_name(args.task))
    device = seed_torch(args)

    if args.bf16 is None:
        args.bf16 = args.device != "cpu" or torch.cpu._is_avx512_bf16_supported()

    # env setup
    kwargs = env_arguments(args)
    try:
        roboarm.make(args.task, **kwargs).close()
    except ValueError as error:
        sys.exit(f"--encoder: {error}" if args.encoder is not None else str(error))
    envs = [roboarm.make(args.task, **kwargs) for _ in range(args.num_envs)]
    eval_envs = [roboarm.make(args.task, **kwargs) for _ in range(8)]
    picture_env = roboarm.make(args.task, **kwargs, render_mode="rgb_array", render_size=(240, 180))
    observation_size = eval_envs[0].observation_space["observation"].shape[0]
    args.scene_size = observation_size - 10 - 7 * args.velocities
    if args.encoder is not None and demos is not None:
        eval_envs[0].encoder.encode_demos(demos)  # once, not in the loop

    # END SHARED

    # ALGO LOGIC: networks and optimisers
    actor = Actor(args).to(device)
    actor_average = Actor(args).to(device).eval()  # evaluated and saved
    actor_average.load_state_dict(actor.state_dict())
    actor_parameters = list(actor.parameters())
    average_parameters = list(actor_average.parameters())
    qf1, qf2 = QNetwork(args).to(device), QNetwork(args).to(device)
    qf1_target, qf2_target = QNetwork(args).to(device), QNetwork(args).to(device)
    qf1_target.load_state_dict(qf1.state_dict())
    qf2_target.load_state_dict(qf2.state_dict())
    q_parameters = [*qf1.parameters(), *qf2.parameters()]
    q_target_parameters = [*qf1_target.parameters(), *qf2_target.parameters()]
    q_optimizer = torch.optim.Adam(q_parameters, lr=args.q_lr, fused=True)
    log_alpha = torch.full((1,), math.log(args.alpha), device=device, requires_grad=True)
    actor_optimizer = torch.optim.Adam(
        [{"params": actor_parameters}, {"params": [log_alpha], "lr": args.q_lr}],
        lr=args.policy_lr,
        fused=True,
    )
    buffer = HerReplayBuffer(
        eval_envs[0], args.buffer_size, args.her_probability, np.random.default_rng(args.seed)
    )
    progress = {"global_step": 0, "updates": 0, "seconds": 0.0}
    progress |= {"best_success": -1.0, "best_step": 0, "demos_injected": 0}
    saved_parts = {
        "actor": actor,
        "actor_average": actor_average,
        "qf1": qf1,
        "qf2": qf2,
        "qf1_target": qf1_target,
        "qf2_target": qf2_target,
        "q_optimizer": q_optimizer,
        "actor_optimizer": actor_optimizer,
        "log_alpha": log_alpha,
        "buffer": buffer,
        "progress": progress,
    }
    load_checkpoint(args, saved_parts)

    # SHARED: episodes
    writer = summary_writer(run, args, progress["global_step"])

    query = [None] * args.num_envs  # number of the demonstration whose query each env is on

    def begin_episode(i):
        """A query of the demonstrations, or a random one."""
        if demos is None:
            return envs[i].reset()[0]
        query[i] = int(envs[i].np_random.integers(len(demos)))
        demo = demos[query[i]]
        return envs[i].reset_specific(demo.start, demo.goal, demo.scene)[0]

    def begin_episodes():
        """Fresh episodes in all envs, from seeds that depend on the step count alone.

        Every checkpoint cuts the running episodes off and begins new ones here, so a resumed run
        needs no simulator state to go on exactly like an uninterrupted one.
        """
        seeds = np.random.SeedSequence([args.seed, progress["global_step"]])
        seeds = seeds.generate_state(args.num_envs).tolist()
        first = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=True)]
        return first if demos is None else [begin_episode(i) for i in range(args.num_envs)]

    observations = begin_episodes()
    staged = [[] for _ in envs]  # transitions of the running episodes
    returns = [0.0] * args.num_envs
    recent_success = []
    seconds_before = progress["seconds"]
    bar = progress_bar(args.total_timesteps, progress["global_step"], "step")

    # END SHARED

    stop = False
    while progress["global_step"] < args.total_timesteps and not stop:
        # ALGO LOGIC: act
        if progress["global_step"] < args.learning_starts:
            actions = (2 * torch.rand(args.num_envs, 7) - 1).numpy() * actor.action_scale
        else:
            with torch.no_grad():
                now = stack(observations, device)
                actor.eval()
                actions, _ = actor.sample(now["observation"], now["desired_goal"])
                actor.train()
                actions = actions.cpu().numpy()

        # SHARED: a step in every environment
        for i, env in enumerate(envs):
            next_observation, reward, terminated, truncated, info = env.step(actions[i])
            staged[i].append(
                {
                    "observation": observations[i]["observation"],
                    "action": actions[i],
                    "next_observation": next_observation["observation"],
                    "next_achieved_goal": next_observation["achieved_goal"],
                    "desired_goal": next_observation["desired_goal"],
                    "collision": info["collision"],
                }
            )
            observations[i] = next_observation
            returns[i] += reward
            if terminated or truncated:
                buffer.add_episode(staged[i])
                recent_success = [*recent_success[-99:], info["is_success"]]
                step = progress["global_step"] + i + 1
                writer.add_scalar("charts/episodic_return", returns[i], step)
                writer.add_scalar("charts/episodic_length", info["elapsed_steps"], step)
                writer.add_scalar("charts/success", np.mean(recent_success), step)
                if demos is not None:
                    demo = demonstration_to_inject(
                        demos, query[i], info["is_success"], args.demo_prob, env.np_random
                    )
                    if demo is not None:
                        buffer.add_episode(demonstration_episode(demo, env, args))
                        progress["demos_injected"] += 1
                    writer.add_scalar("charts/demos_injected", progress["demos_injected"], step)
                staged[i], returns[i] = [], 0.0
                observations[i] = begin_episode(i)
        progress["global_step"] += args.num_envs
        bar.update(args.num_envs)
        # END SHARED

        # ALGO LOGIC: learn
        # SHARED: batches
        due = (progress["global_step"] - args.learning_starts) * args.updates_per_step
        updates = max(0, int(due) - progress["updates"]) if buffer.size > 0 else 0
        if updates > 0:
            batches = {  # sampled together, because that is faster
                name: torch.as_tensor(array, device=device).split(args.batch_size)
                for name, array in buffer.sample(updates * args.batch_size).items()
            }
        for update in range(updates):
            batch = {name: tensors[update] for name, tensors in batches.items()}
            goal = batch["desired_goal"]
            # END SHARED
            alpha = log_alpha.detach().exp()

            with torch.no_grad():
                next_action, next_log_prob = actor.sample(batch["next_observation"], goal)
                target = td_target(
                    batch["reward"],
                    batch["terminated"],
                    qf1_target(batch["next_observation"], goal, next_action),
                    qf2_target(batch["next_observation"], goal, next_action),
                    next_log_prob,
                    alpha,
                    args.gamma,
                )
            q1 = qf1(batch["observation"], goal, batch["action"])
            q2 = qf2(batch["observation"], goal, batch["action"])
            qf1_loss, qf2_loss = F.mse_loss(q1, target), F.mse_loss(q2, target)
            q_optimizer.zero_grad()
            (qf1_loss + qf2_loss).backward()
            q_optimizer.step()

            if progress["updates"] % args.policy_frequency == 0:
                for parameter in q_parameters:  # the policy's gradient needs none into the critics
                    parameter.requires_grad_(False)
                action, log_prob = actor.sample(batch["observation"], goal)
                min_q = torch.minimum(
                    qf1(batch["observation"], goal, action), qf2(batch["observation"], goal, action)
                )
                actor_loss = (alpha * log_prob - min_q).mean()
                surplus = log_prob.detach().mean() + args.target_entropy
                alpha_loss = -log_alpha.exp() * surplus * args.autotune
                actor_optimizer.zero_grad()
                (actor_loss + alpha_loss).backward()
                actor_optimizer.step()
                for parameter in q_parameters:
                    parameter.requires_grad_(True)
                polyak_update(average_parameters, actor_parameters, args.policy_average)

            polyak_update(q_target_parameters, q_parameters, args.tau)
            progress["updates"] += 1

            if progress["updates"] % 1000 == 0:
                step = progress["global_step"]
                writer.add_scalar("losses/qf1_values", q1.mean().item(), step)
                writer.add_scalar("losses/qf2_values", q2.mean().item(), step)
                writer.add_scalar("losses/qf1_loss", qf1_loss.item(), step)
                writer.add_scalar("losses/qf2_loss", qf2_loss.item(), step)
                writer.add_scalar("losses/qf_loss", (qf1_loss + qf2_loss).item() / 2, step)
                writer.add_scalar("losses/actor_loss", actor_loss.item(), step)
                writer.add_scalar("losses/alpha", alpha.item(), step)
                writer.add_scalar("losses/alpha_loss", alpha_loss.item(), step)
                writer.add_scalar("charts/SPS", int(rate(bar)), step)

        # SHARED: evaluate, keep the best policy, checkpoint
        step = progress["global_step"]
        if step % args.eval_every < args.num_envs or step >= args.total_timesteps:
            result = evaluate(actor_average, eval_envs, validation, device)
            for name, value in result.items():
                writer.add_scalar(f"eval/{name}", value, step)
            picture = picture_of_rollout(actor_average, picture_env, validation, device)
            writer.add_image("eval/rollout", picture, step, dataformats="HWC")
            if result["success_rate"] > progress["best_success"]:
                progress["best_success"], progress["best_step"] = result["success_rate"], step
                metadata = {"kind": "policy", "task": args.task, "env": env_arguments(args)}
                metadata |= {"script": args.exp_name, "seed": args.seed, "step": step}
                save_program(
                    run / "policy.pt", actor_average, stack(observations, device), metadata
                )
            bar.set_postfix(
                eval=f"{result['success_rate']:.3f}", best=f"{progress['best_success']:.3f}"
            )
            for episode in filter(None, staged):
                buffer.add_episode(episode)
            staged, returns = [[] for _ in envs], [0.0] * args.num_envs
            progress["seconds"] = seconds_before + elapsed(bar)
            save_checkpoint(run, saved_parts)
            observations = begin_episodes()
            stop = result["success_rate"] >= args.stop_at_success
    bar.close()

    # The best policy (by validation) on test queries
    best = load_program(run / "policy.pt").to(device)
    result = evaluate(best, eval_envs, test, device)
    result |= {"task": args.task, "goal_type": args.goal_type, "num_queries": len(test)}
    result |= {"policy": str(run / "policy.pt"), "policy_step": progress["best_step"]}
    result |= {"validation_success_rate": progress["best_success"]}
    result |= {"steps": progress["global_step"], "seconds": round(progress["seconds"])}
    write_json(run / "result.json", result | {"args": asdict(args)})
    print(
        f"{args.task}, goal {args.goal_type}, {len(test)} test queries: "
        f"success {result['success_rate']:.3f}, clean {result['clean_success_rate']:.3f}; "
        f"{progress['global_step']} steps in {progress['seconds']:.0f} s. {run / 'result.json'}"
    )
    writer.close()
    # END SHARED
