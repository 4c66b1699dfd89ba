"""SAC with hindsight experience replay (HER) and demonstrations. One file: read it top to bottom.

    python clean_rl_scripts/sac_her_mp.py --task no_obstacles --goal-type ee
    python clean_rl_scripts/sac_her_mp.py --task double_walls --demo-prob 1

Soft Actor-Critic (Haarnoja et al., 2018) in CleanRL's form, goals relabelled with the `future`
strategy (Andrychowicz et al., 2017), demonstrations injected upon failure (SAC-MP), as in the
paper's sections 2 and 5. To make an algorithm of your own, copy this file and change the parts
under `# ALGO LOGIC`. Parts between `# SHARED` and `# END SHARED` are those of `td3_her_mp.py`; what
is imported from `envs` is the benchmark, not the algorithm.
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from roboarm_nmp.envs import panda
from roboarm_nmp.envs.datasets.episodes import demo_transitions, transition
from roboarm_nmp.envs.tasks import task_name
from roboarm_nmp.envs.training import flags, protocol, runs


@dataclass
class Args(runs.RunFlags, protocol.EnvFlags):
    # Those of the run's folder are in `envs/training/runs.py`, those of the MDP in `envs/training/protocol.py`.
    exp_name: str = "sac_her_mp"
    """name of the experiment, part of the run's folder"""
    # SHARED: the task
    task: str = "no_obstacles"
    """task to train on, one of `envs.TASKS`, or a scene file (docs/your_own_scene.md)"""
    num_envs: flags.Environments = 4
    """environments stepped together; every one of their steps counts"""
    # END SHARED

    # The algorithm
    total_timesteps: flags.PositiveInt = 1_000_000
    """environment steps of the whole run"""
    learning_starts: flags.NonNegativeInt = 2_000
    """environment steps with random actions before the first update"""
    updates_per_step: flags.NonNegativeFloat = 0.5
    """updates of the critics per environment step (CleanRL: 1)"""
    buffer_size: flags.PositiveInt = 1_000_000
    """transitions in the replay buffer"""
    batch_size: flags.PositiveInt = 256
    """transitions per update"""
    her_probability: flags.Share = 0.8
    """share of sampled transitions whose goal is replaced by one reached later in their episode"""
    demo_prob: flags.Share | None = None
    """train on the queries of the task's demonstrations; when an episode fails, its demonstration
    enters the replay buffer with this probability (the paper's p). Without it: random queries"""
    demos: Path | None = None
    """demonstration file to use with --demo-prob; by default the task's own"""
    gamma: flags.Share = 0.95
    """discount factor (CleanRL: 0.99)"""
    tau: flags.PositiveShare = 0.005
    """share of the critics that moves into the target critics per update"""
    policy_lr: flags.PositiveFloat = 1e-3
    """learning rate of the policy (Adam; CleanRL: 3e-4)"""
    q_lr: flags.PositiveFloat = 1e-3
    """learning rate of the critics (Adam)"""
    alpha: flags.PositiveFloat = 0.2
    """entropy coefficient; where tuning begins, if it is tuned"""
    autotune: bool = True
    """tune the entropy coefficient to the target entropy"""
    target_entropy: flags.FiniteFloat = -7.0
    """entropy that the tuning aims at, of the unscaled action (CleanRL: minus its dimensions)"""
    policy_frequency: flags.PositiveInt = 2
    """updates of the critics per update of the policy (CleanRL: as often as the critics)"""
    policy_average: flags.PositiveShare = 0.0003
    """share of the policy that moves into its running average per update of the policy; the average
    is what is evaluated and saved, the policy itself explores (1: no averaging, as CleanRL)"""
    hidden_size: flags.Width = 256
    """width of the hidden layers of policy and critics"""
    num_hidden_layers: flags.Layers = 2
    """number of hidden layers of policy and critics"""
    layer_norm: bool = True
    """LayerNorm in the critics' hidden layers (CleanRL: no)"""
    action_scale: flags.PositiveFloat = 0.06
    """the policy's outputs are in [-action_scale, action_scale]; the MDP clips a step at max_step,
    so with the full range of 1 every step is a longest step, which overshoots the goal"""
    relative_goal: bool = True
    """add goal minus end-effector position, times 5, to the networks' inputs"""
    relative_configuration: bool = True
    """add goal minus configuration, times 5, to the networks' inputs, where goals have one"""
    trigonometric: bool = True
    """add the joint angles' sines and cosines to the networks' inputs"""
    bf16: bool | None = None
    """train with hidden layers in bfloat16 (first layer, head and weights stay in float32); by
    default where the hardware has it"""

    # SHARED: flags of the evaluation
    # Evaluation and bookkeeping
    eval_every: flags.PositiveInt = 25_000
    """environment steps between evaluations on validation queries; the best policy is kept"""
    eval_queries: flags.PositiveInt = 200
    """validation queries per evaluation"""
    test_queries: flags.PositiveInt = 1_000
    """test queries for the best policy at the end"""
    stop_at_success: flags.Share | None = None
    """stop as soon as a validation success rate is this high, e.g. 0.9; by default never"""
    # END SHARED


# ALGO LOGIC: networks
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


# SHARED: critics
class Critics(nn.Module):
    """Q1 and Q2."""

    def __init__(self, args, num_features):
        super().__init__()
        self.action_scale = args.action_scale if args.action_mode == "relative" else 1.0
        self.mlps = nn.ModuleList(MLP(num_features + 7, 1, args, args.layer_norm) for _ in range(2))

    def forward(self, features, action, number=2):
        """(N, f), (N, 7) -> (number, N); of Q1 only with `number` 1."""
        inputs = torch.cat([features, action / self.action_scale], dim=1)
        return torch.stack([mlp(inputs).squeeze(-1) for mlp in self.mlps[:number]])


# END SHARED


LOG_STD_MAX = 2
LOG_STD_MIN = -5


class Actor(nn.Module):
    def __init__(self, args, observation_size):
        super().__init__()
        self.features = Features(args, observation_size)
        self.action_scale = args.action_scale if args.action_mode == "relative" else 1.0
        self.mlp = MLP(self.features.size, 14, args, layer_norm=False)

    def sample(self, features):
        """A random action (N, 7) and its log-density (N,) before scaling by `action_scale`."""
        mean, log_std = self.mlp(features).chunk(2, dim=1)
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (torch.tanh(log_std) + 1)
        noise = torch.randn_like(mean)
        unsquashed = mean + log_std.exp() * noise
        log_prob = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        # log(1 - tanh(u)^2) without cancellation
        log_prob = log_prob - 2 * (math.log(2) - unsquashed - F.softplus(-2 * unsquashed))
        return self.action_scale * torch.tanh(unsquashed), log_prob.sum(1)

    def forward(self, observation, achieved_goal, desired_goal, **_):
        """The deterministic action (N, 7), for evaluation; this is what policy.pt contains."""
        mean = self.mlp(self.features(observation, desired_goal))[:, :7]
        return self.action_scale * torch.tanh(mean)


# SHARED: replay buffer and demonstrations
# ALGO LOGIC: replay buffer
class LatentTable:
    """Latent codes of scenes, each stored once: `rows` (n, size), in the order they were added."""

    def __init__(self, size):
        self.size, self._row_of = size, {}  # the latent's bytes -> its row
        self._latents = np.zeros((1, size), np.float32)

    @property
    def rows(self):
        return self._latents[: len(self._row_of)]

    def row_of(self, latent):
        """The row of a latent (size,), which is added if it is new."""
        latent = np.float32(latent)
        row = self._row_of.setdefault(latent.tobytes(), len(self._row_of))
        if row == len(self._latents):
            self._latents = np.concatenate([self._latents, np.zeros_like(self._latents)])
        self._latents[row] = latent
        return row


class HerReplayBuffer:
    """Transitions of finished episodes in a ring; goals are relabelled when they are sampled.

    One float32 row per transition. `remaining` counts the transitions that follow in the same
    episode, so a goal reached later in it is found without storing episodes. New episodes
    overwrite the oldest rows from an episode's start on, so what a row points to outlives it. The
    encoded scene at the end of observations (its latent) is stored once per scene, in `latents`.
    """

    def __init__(self, env, capacity, her_probability, rng):
        spaces, encoder = env.observation_space, getattr(env, "encoder", None)
        self.latents = LatentTable(0 if encoder is None else encoder.size)
        observation_size = spaces["observation"].shape[0] - self.latents.size
        goal_size = spaces["desired_goal"].shape[0]
        sizes = {"observation": observation_size, "action": 7}
        sizes |= {"next_observation": observation_size, "next_achieved_goal": goal_size}
        sizes |= {"desired_goal": goal_size, "collision": 1}
        ends = np.cumsum(list(sizes.values())).tolist()
        self.columns = {n: slice(end - sizes[n], end) for n, end in zip(sizes, ends, strict=True)}
        self.rows = np.zeros((capacity, ends[-1]), np.float32)
        self.remaining = np.zeros(capacity, np.int32)
        self.latent_row = np.zeros(capacity, np.int32)  # of each transition
        self.env, self.rng = env, rng
        self.capacity, self.her_probability = capacity, her_probability
        self.position, self.size = 0, 0

    def add_episode(self, transitions):
        """`transitions`: a list of dicts with the columns' names as keys."""
        index = (self.position + np.arange(len(transitions))) % self.capacity
        for name, columns in self.columns.items():
            width = columns.stop - columns.start  # without the encoded scene
            values = [np.atleast_1d(transition[name])[:width] for transition in transitions]
            self.rows[index, columns] = np.stack(values)
        latent = transitions[0]["observation"][self.columns["observation"].stop :]
        self.latent_row[index] = self.latents.row_of(latent)
        self.remaining[index] = np.arange(len(transitions))[::-1]
        self.position = (self.position + len(transitions)) % self.capacity
        self.size = min(self.size + len(transitions), self.capacity)

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
        if self.latents.size > 0:
            latent = self.latents.rows[self.latent_row[index]]
            for name in ("observation", "next_observation"):
                batch[name] = np.hstack([batch[name], latent])
        return batch

    def state_dict(self):
        return {
            "rows": torch.from_numpy(self.rows[: self.size]),
            "remaining": torch.from_numpy(self.remaining[: self.size]),
            "latent_row": torch.from_numpy(self.latent_row[: self.size]),
            "latents": torch.from_numpy(self.latents.rows),
            "position": self.position,
        }

    def load_state_dict(self, state):
        self.size, self.position = len(state["rows"]), state["position"]
        for name in ("rows", "remaining", "latent_row"):
            getattr(self, name)[: self.size] = state[name].numpy()
        for latent in state["latents"].numpy():
            self.latents.row_of(latent)


# ALGO LOGIC: demonstrations
def inject_demonstration(is_success, demo_prob, rng):
    """Whether a demonstration enters the buffer: after a failure, with probability `demo_prob`."""
    return not is_success and rng.random() < demo_prob


# END SHARED


def td_target(reward, terminated, next_q, next_log_prob, alpha, gamma):
    """The critics' target r + gamma (1 - terminated) (min(Q1', Q2') - alpha log pi').

    `next_q` (2, N) has Q1' and Q2'; all others, and the target, are (N,).
    """
    next_value = next_q.amin(0) - alpha * next_log_prob
    return reward + gamma * (1.0 - terminated) * next_value


# SHARED: averaging
def polyak_update(target_parameters, parameters, tau):
    """target <- (1 - tau) target + tau parameter, all tensors at once."""
    with torch.no_grad():
        torch._foreach_lerp_(target_parameters, parameters, tau)


# END SHARED


# SHARED: batches
def updates_due(step, buffer, args):
    """Number of updates that fall due in the environment steps that led to `step`.

    None before `learning_starts`, and none before the first episode has ended.
    """
    if buffer.size == 0:
        return 0
    before, now = (max(0, s - args.learning_starts) for s in (step - args.num_envs, step))
    return int(now * args.updates_per_step) - int(before * args.updates_per_step)


DRAWN_TOGETHER = 64  # batches


def batches(buffer, number, batch_size, device):
    """Draw `number` batches, dicts of tensors, from the buffer: some at once, which is faster."""
    for first in range(0, number, DRAWN_TOGETHER):
        count = min(DRAWN_TOGETHER, number - first)
        drawn = buffer.sample(count * batch_size)
        parts = [torch.as_tensor(a, device=device).split(batch_size) for a in drawn.values()]
        for batch in zip(*parts, strict=True):
            yield dict(zip(drawn, batch, strict=True))


# END SHARED


# ALGO LOGIC: networks, optimisers and one update
class SAC:
    def __init__(self, args, observation_size, device):
        self.args = args
        self.actor = Actor(args, observation_size).to(device)
        self.actor_average = Actor(args, observation_size).to(device).eval()  # evaluated and saved
        self.actor_average.load_state_dict(self.actor.state_dict())
        self.critics, self.critics_target = (
            Critics(args, self.actor.features.size).to(device) for _ in range(2)
        )
        self.critics_target.load_state_dict(self.critics.state_dict())
        self.log_alpha = torch.full((1,), math.log(args.alpha), device=device, requires_grad=True)

        self.actor_parameters = list(self.actor.parameters())
        self.average_parameters = list(self.actor_average.parameters())
        self.q_parameters = list(self.critics.parameters())
        self.target_parameters = list(self.critics_target.parameters())
        self.q_optimizer = torch.optim.Adam(self.q_parameters, lr=args.q_lr, fused=True)
        self.actor_optimizer = torch.optim.Adam(
            [{"params": self.actor_parameters}, {"params": [self.log_alpha], "lr": args.q_lr}],
            lr=args.policy_lr,
            fused=True,
        )

    def checkpoint_state(self):
        """What a checkpoint has of it."""
        names = "actor actor_average critics critics_target q_optimizer actor_optimizer log_alpha"
        return {name: getattr(self, name) for name in names.split()}

    @torch.no_grad()
    def explore(self, observation):
        """Random actions (N, 7), a NumPy array, for training."""
        self.actor.eval()
        features = self.actor.features(observation["observation"], observation["desired_goal"])
        action, _ = self.actor.sample(features)
        self.actor.train()
        return action.cpu().numpy()

    def update_critics(self, batch, features):
        """One step on a batch of the replay buffer; tensors whose means are logged, by tag.

        `features`: the networks' inputs for its observations and goals.
        """
        alpha = self.log_alpha.detach().exp()
        with torch.no_grad():
            next_features = self.actor.features(batch["next_observation"], batch["desired_goal"])
            next_action, next_log_prob = self.actor.sample(next_features)
            next_q = self.critics_target(next_features, next_action)
            target = td_target(
                batch["reward"], batch["terminated"], next_q, next_log_prob, alpha, self.args.gamma
            )
        q = self.critics(features, batch["action"])
        loss = (q - target).square().mean(1)  # of Q1 and of Q2
        self.q_optimizer.zero_grad()
        loss.sum().backward()
        self.q_optimizer.step()
        tensors = {"qf1_values": q[0], "qf2_values": q[1], "qf1_loss": loss[0], "qf2_loss": loss[1]}
        return tensors | {"qf_loss": loss, "alpha": alpha}

    def update_policy(self, features):
        """One step of the policy and of the entropy coefficient; as `update_critics`."""
        alpha = self.log_alpha.detach().exp()
        self.critics.requires_grad_(False)  # the policy's gradient needs none into the critics
        action, log_prob = self.actor.sample(features)
        actor_loss = (alpha * log_prob - self.critics(features, action).amin(0)).mean()
        surplus = log_prob.detach().mean() + self.args.target_entropy
        alpha_loss = -self.log_alpha.exp() * surplus * self.args.autotune
        self.actor_optimizer.zero_grad()
        (actor_loss + alpha_loss).backward()
        self.actor_optimizer.step()
        self.critics.requires_grad_(True)
        polyak_update(self.average_parameters, self.actor_parameters, self.args.policy_average)
        return {"actor_loss": actor_loss, "alpha_loss": alpha_loss}

    def update(self, batch, count):
        """Update number `count` of the run."""
        features = self.actor.features(batch["observation"], batch["desired_goal"])
        losses = self.update_critics(batch, features)
        if count % self.args.policy_frequency == 0:
            losses |= self.update_policy(features)
        polyak_update(self.target_parameters, self.q_parameters, self.args.tau)
        return losses


if __name__ == "__main__":
    # SHARED: checks, environments, folder
    args = runs.parse_args(Args, may_change={"total_timesteps", "test_queries", "stop_at_success"})
    device = runs.seed_torch(args)
    runs.resolve_bf16(args)
    if args.buffer_size < args.horizon:
        sys.exit(f"--buffer-size {args.buffer_size}: an episode has {args.horizon} transitions")
    validation, test = protocol.load_task(args)
    env_arguments = protocol.env_arguments_of(args)
    envs = protocol.make_training_envs(args, args.demo_prob, args.demos)
    eval_envs = protocol.make_eval_envs(args.task, len(validation), **env_arguments)
    run = runs.run_folder(args, task_name(args.task))
    rng = np.random.default_rng(args.seed)
    buffer = HerReplayBuffer(eval_envs[0], args.buffer_size, args.her_probability, rng)
    progress = {"global_step": 0, "updates": 0, "seconds": 0.0}
    progress |= {"best_success": -1.0, "best_step": 0, "demos_injected": 0}
    # END SHARED

    agent = SAC(args, eval_envs[0].observation_space["observation"].shape[0], device)

    # SHARED: resuming and episodes
    checkpoint_state = agent.checkpoint_state() | {
        "buffer": buffer,
        "rng": rng,
        "progress": progress,
    }
    runs.load_checkpoint(args, checkpoint_state)
    writer = runs.summary_writer(run, args, progress["global_step"])
    observations = protocol.begin_episodes(envs, args.seed, progress["global_step"])
    episodes, returns = [[] for _ in envs], [0.0 for _ in envs]  # of the running episodes
    recent_success, losses, stop = [], {}, False
    seconds_before = progress["seconds"]
    bar = runs.progress_bar(args.total_timesteps, progress["global_step"], "step")
    # END SHARED

    while progress["global_step"] < args.total_timesteps and not stop:
        # ALGO LOGIC: act
        if progress["global_step"] < args.learning_starts:
            actions = (2 * torch.rand(args.num_envs, 7) - 1).numpy() * agent.actor.action_scale
        else:
            actions = agent.explore(protocol.stack(observations, device))

        # SHARED: a step in every environment
        runs.check_finite("the policy's actions", actions)
        for i, env in enumerate(envs):
            before = observations[i]
            observations[i], reward, terminated, truncated, info = env.step(actions[i])
            episodes[i].append(transition(before, actions[i], observations[i], info["collision"]))
            returns[i] += reward
            if terminated or truncated:
                buffer.add_episode(episodes[i])
                step = progress["global_step"] + i + 1
                protocol.log_episode(writer, step, returns[i], info, recent_success)
                if args.demo_prob is not None:
                    if inject_demonstration(info["is_success"], args.demo_prob, env.np_random):
                        buffer.add_episode(demo_transitions(env.demo, env.env))
                        progress["demos_injected"] += 1
                    writer.add_scalar("charts/demos_injected", progress["demos_injected"], step)
                episodes[i], returns[i], observations[i] = [], 0.0, env.reset()[0]
        progress["global_step"] += args.num_envs
        bar.update(args.num_envs)
        step = progress["global_step"]
        for batch in batches(buffer, updates_due(step, buffer, args), args.batch_size, device):
            losses |= agent.update(batch, progress["updates"])
            progress["updates"] += 1
            if progress["updates"] % 1000 == 0:
                for name, value in losses.items():
                    writer.add_scalar(f"losses/{name}", value.mean().item(), step)
                writer.add_scalar("charts/SPS", int(runs.rate(bar)), step)

        # Evaluate, keep the best policy, checkpoint
        if step % args.eval_every < args.num_envs or step >= args.total_timesteps:
            policy = agent.actor_average
            success = protocol.validate(
                policy, eval_envs, validation, device, writer, step, progress
            )
            if progress["best_step"] == step:
                protocol.save_policy(run, policy, eval_envs, device, args, env_arguments, step)
            bar.set_postfix(eval=success, best=progress["best_success"])
            for episode in filter(None, episodes):
                buffer.add_episode(episode)
            episodes, returns = [[] for _ in envs], [0.0 for _ in envs]
            progress["seconds"] = seconds_before + runs.elapsed(bar)
            runs.save_checkpoint(run, checkpoint_state, device)
            # A resumed run goes on exactly as this one does: with new episodes.
            observations = protocol.begin_episodes(envs, args.seed, step)
            stop = args.stop_at_success is not None and success >= args.stop_at_success
    bar.close()
    protocol.final_test(run, args, env_arguments, test, device, progress, bar.n)
    writer.close()
    # END SHARED
