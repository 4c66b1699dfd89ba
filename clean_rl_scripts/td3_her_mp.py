"""TD3 with hindsight experience replay (HER) and demonstrations. One file: read it top to bottom.

    roboarm train td3 --task no_obstacles --goal-type ee
    python clean_rl_scripts/td3_her_mp.py --task double_walls --demo-prob 1    # the same script

Twin Delayed DDPG (Fujimoto et al., 2018) in CleanRL's form, goals relabelled with the `future`
strategy (Andrychowicz et al., 2017), demonstrations injected upon failure (TD3-MP), as in the
paper's sections 2 and 5. For an algorithm of your own, copy this file and change the parts under
`# ALGO LOGIC`. Parts between `# SHARED` and `# END SHARED` are the same in `sac_her_mp.py`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn as nn

from roboarm_nmp.datasets.episodes import demo_transitions
from roboarm_nmp.training import cuda_graphs, protocol, runs
from roboarm_nmp.training.network_parts import (
    Bf16Linear,
    JacobianTranspose,
    pose_difference,
)
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.progress import progress_bar


@dataclass
class Args(protocol.PolicyFlags, protocol.EnvFlags):
    # More flags: `roboarm_nmp.training.protocol` (task, MDP), `roboarm_nmp.training.runs` (run).
    num_envs: flags.Environments = 4
    """environments stepped together; every one of their steps counts"""
    total_timesteps: flags.PositiveInt = 1_000_000
    """environment steps of the whole run"""
    learning_starts: flags.NonNegativeInt = 2_000
    """environment steps with random actions before the first update"""
    updates_per_step: flags.NonNegativeFloat = 0.5
    """updates of the critics per environment step (CleanRL: 1)"""
    batch_size: flags.PositiveInt = 256
    """transitions per update"""
    her_probability: flags.Share = 0.8
    """share of sampled transitions whose goal is replaced by one reached later in their episode"""
    her_exponent: flags.PositiveFloat = 2.0
    """preference for goals that are reached soon (1: none, HER's strategy `future`)"""
    demo_prob: flags.Share | None = None
    """train on the queries of the task's demonstrations; when an episode fails, its demonstration
    enters the replay buffer with this probability (the paper's p). Without it: random queries"""
    demos: tuple[Path, ...] = ()
    """demonstration files of the task, to use with --demo-prob; by default the task's own"""
    bc_weight: flags.NonNegativeFloat = 0.0
    """with --demo-prob, weight of behavioural cloning in the policy's loss: the squared difference
    from demonstrated actions, in units of the action scale (Fujimoto and Gu, 2021). Measured: 5, on
    double_walls"""
    demo_batch_size: flags.PositiveInt = 128
    """transitions of demonstrations in every batch, besides the others, with --bc-weight"""
    gamma: flags.Share | Literal["auto"] = "auto"
    """discount factor (CleanRL: 0.99); `auto`: 0.95, and 0.98 for arms with a joint that turns all
    the way round, as an arm at its limit may have to"""
    tau: flags.PositiveShare = 0.005
    """share of policy and critics that moves into the target networks, per update of the policy"""
    policy_lr: flags.PositiveFloat = 1e-3
    """learning rate of the policy (Adam; CleanRL: 3e-4)"""
    q_lr: flags.PositiveFloat = 1e-3
    """learning rate of the critics (Adam)"""
    exploration_noise: flags.NonNegativeFloat = 0.35
    """standard deviation of the noise on the actions in training, in units of the action scale
    (CleanRL: 0.1)"""
    policy_frequency: flags.PositiveInt = 2
    """updates of the critics per update of the policy and of all target networks"""
    preactivation_penalty: flags.NonNegativeFloat = 0.1
    """weight of the squared inputs of the policy's tanh in its loss, which keeps it from saturating
    (Andrychowicz et al., 2017, appendix A; CleanRL: 0)"""
    policy_average: flags.PositiveShare = 0.0003
    """share of the policy that moves per update into the average that is saved (1: no averaging)"""
    hidden_size: flags.Width = 256
    """width of the hidden layers of policy and critics"""
    num_hidden_layers: flags.Layers = 2
    """number of hidden layers of policy and critics"""
    jacobian: bool = True
    """network inputs: how the joints move the end effector straight to the goal (Jacobian); without
    effect where the goal is a configuration, and on plain networks"""
    plain_networks: bool = False
    """CleanRL's networks: raw inputs, no LayerNorm, actions in [-1, 1] (not twice `max_step`)"""
    bf16: bool | None = None
    """train with hidden layers in bfloat16; by default where the hardware has it"""
    eval_every: flags.PositiveInt = 25_000
    """environment steps between evaluations on validation queries; the best policy is saved"""
    stop_at_success: flags.Share | None = None
    """stop at this success rate on validation queries, e.g. 0.9; by default never"""


# ALGO LOGIC: networks
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


# SHARED: features and critics
class Features(nn.Module):
    """Network inputs: observation, goal and, unless plain, functions of them that ease learning."""

    def __init__(self, args, env):
        super().__init__()
        self.plain = args.plain_networks
        self.goal_type = args.goal_type
        robot = env.unwrapped.robot
        self.num_joints = robot.num_joints
        self.jacobian = None
        if args.jacobian and not self.plain and self.goal_type != "config":
            self.jacobian = JacobianTranspose(robot, rotates=self.goal_type == "pose")
        low, high = torch.tensor(robot.lower), torch.tensor(robot.upper)
        self.register_buffer("middle", ((high + low) / 2).float())
        self.register_buffer("half_range", ((high - low) / 2).float())
        # The configuration, velocities (or not) and the end effector's position or pose.
        first = 2 * self.num_joints if args.velocities else self.num_joints
        end = env.unwrapped.observation_space["observation"].shape[0]
        self.ee = slice(first, end)
        # Link distances follow; the first number of each link is the distance.
        links, numbers = robot.link_distances_shape
        near = slice(end, end + links * numbers, numbers)
        self.distances = near if args.link_distances else None
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
                inputs.append(5.0 * pose_difference(observation[:, self.ee], desired_goal))
            if self.goal_type in ("ee", "combined"):
                inputs.append(5.0 * (desired_goal[:, -3:] - observation[:, self.ee]))
            if self.jacobian is not None:
                position = observation[:, self.ee][:, :3]
                towards = self.jacobian(observation[:, :joints], position, inputs[-1])
                inputs += [towards, towards / (towards.norm(dim=1, keepdim=True) + 1e-6)]
            if self.goal_type in ("config", "combined"):
                inputs.append(5.0 * (desired_goal[:, :joints] - observation[:, :joints]))
        if self.distances is not None:
            inputs.append(10.0 * observation[:, self.distances])  # they are small numbers
        return torch.cat(inputs, dim=1)


def action_scale(args):
    """The policy's actions are in [-scale, scale]."""
    is_plain = args.plain_networks or args.action_mode == "subgoal"
    return 1.0 if is_plain else 2.0 * args.max_step


class Critics(nn.Module):
    """Q1 and Q2."""

    def __init__(self, args, features):
        super().__init__()
        self.action_scale = action_scale(args)
        size = features.size + features.num_joints
        layer_norm = not args.plain_networks
        self.mlps = nn.ModuleList(mlp(size, 1, args, layer_norm) for _ in range(2))

    def forward(self, features, action, number=2):
        """(N, f), (N, n) -> (number, N); of Q1 only with `number` 1."""
        inputs = torch.cat([features, action / self.action_scale], dim=1)
        return torch.stack([qf(inputs).squeeze(-1) for qf in self.mlps[:number]])


# END SHARED


class Actor(nn.Module):
    def __init__(self, args, env):
        super().__init__()
        self.features = Features(args, env)
        self.action_scale = action_scale(args)
        self.mlp = mlp(self.features.size, self.features.num_joints, args)

    def get_action(self, features):
        """The action (N, n) without noise, and the inputs of the tanh (N, n)."""
        preactivation = self.mlp(features)
        return self.action_scale * torch.tanh(preactivation), preactivation

    def forward(self, observation, achieved_goal, desired_goal, **_):
        """The action (N, n) without noise; policy.onnx contains this function."""
        return self.get_action(self.features(observation, desired_goal))[0]


# ALGO LOGIC: replay buffer
# SHARED: replay buffer
BUFFER_SIZE = 1_000_000  # transitions; memory is taken as they come


class HerReplayBuffer:
    """Transitions of finished episodes in a ring; goals are relabelled when they are sampled.

    `remaining` counts the transitions that follow one in its episode. New episodes overwrite the
    oldest ones from their start on, so that these transitions outlive it. The encoded scene at the
    end of an observation is stored once: `latents[latent]`; of the next one `latents[next_latent]`.
    """

    def __init__(self, env, capacity, her_probability, rng, her_exponent=1.0):
        spaces = env.observation_space
        encoder = getattr(env, "encoder", None)
        latent_size = 0 if encoder is None else encoder.size
        observation_size = spaces["observation"].shape[0] - latent_size
        goal_size = spaces["desired_goal"].shape[0]
        sizes = {
            "observation": observation_size,
            "next_observation": observation_size,
            "next_achieved_goal": goal_size,
            "desired_goal": goal_size,
            "action": env.action_space.shape[0],
            "collision": 1,
        }
        self.arrays: dict[str, np.ndarray] = {}
        for name, size in sizes.items():
            self.arrays[name] = np.zeros((capacity, size), np.float32)
        for name in ("remaining", "latent", "next_latent"):
            self.arrays[name] = np.zeros(capacity, np.int32)
        self.latents = np.zeros((1, latent_size), np.float32)
        self.latent_numbers = {}
        self.env = env.unwrapped
        self.capacity = capacity
        self.rng = rng
        self.her_probability = her_probability
        self.her_exponent = her_exponent
        self.position = 0
        self.size = 0

    def add_episode(self, transitions):
        """`transitions`: a list of dicts with the float arrays' names as keys."""
        index = (self.position + np.arange(len(transitions))) % self.capacity
        for name in transitions[0]:
            width = self.arrays[name].shape[1]  # an observation's is without the latent
            values = np.stack([np.atleast_1d(transition[name]) for transition in transitions])
            self.arrays[name][index] = values[:, :width]
            if name.endswith("observation"):
                latents = values[:, width:].astype(np.float32)
                numbers = [self.latent_number(latent) for latent in latents]
                self.arrays[name.replace("observation", "latent")][index] = numbers
        self.arrays["remaining"][index] = np.arange(len(transitions))[::-1]
        self.position = (self.position + len(transitions)) % self.capacity
        self.size = min(self.size + len(transitions), self.capacity)

    def latent_number(self, latent):
        """The row of a latent (z,) in `latents`, where a new one is added."""
        number = self.latent_numbers.setdefault(latent.tobytes(), len(self.latent_numbers))
        if number == len(self.latents):
            self.latents = np.concatenate([self.latents, np.zeros_like(self.latents)])
        self.latents[number] = latent
        return number

    def sample(self, batch_size):
        """A dict of float32 arrays (batch_size, ...); `reward` and `terminated` (batch_size,)."""
        index = self.rng.integers(self.size, size=batch_size)
        data = {name: array[index] for name, array in self.arrays.items()}
        later = self.rng.random(batch_size) ** self.her_exponent * (data.pop("remaining") + 1)
        later = (index + later.astype(np.int64)) % self.capacity
        relabel = self.rng.random(batch_size) < self.her_probability
        hindsight_goal = self.arrays["next_achieved_goal"][later]
        data["desired_goal"] = np.where(relabel[:, None], hindsight_goal, data["desired_goal"])
        achieved, desired = data["next_achieved_goal"], data["desired_goal"]
        info = {"collision": data["collision"][:, 0] > 0}
        data["reward"] = self.env.compute_reward(achieved, desired, info).astype(np.float32)
        data["terminated"] = self.env.compute_terminated(achieved, desired, info).astype(np.float32)
        for name in ("", "next_"):
            latent = self.latents[data.pop(f"{name}latent")]
            data[f"{name}observation"] = np.hstack([data[f"{name}observation"], latent])
        return data

    def batches(self, number, batch_size, device):
        """Yield `number` batches, dicts of tensors; up to 64 are sampled together, for speed."""
        for first in range(0, number, 64):
            data = self.sample(min(64, number - first) * batch_size)
            parts = [cuda_graphs.to_device(a, device).split(batch_size) for a in data.values()]
            for tensors in zip(*parts, strict=True):
                yield dict(zip(data, tensors, strict=True))

    def state_dict(self):
        arrays = {name: torch.from_numpy(a[: self.size]) for name, a in self.arrays.items()}
        latents = torch.from_numpy(self.latents[: len(self.latent_numbers)])
        return {"arrays": arrays, "latents": latents, "position": self.position}

    def load_state_dict(self, state):
        self.size = len(state["arrays"]["remaining"])
        self.position = state["position"]
        for name, array in state["arrays"].items():
            self.arrays[name][: self.size] = array.numpy()
        for latent in state["latents"].numpy():
            self.latent_number(latent)


def buffer_of_demos(demos, env, args, rng):
    """A `HerReplayBuffer` with all transitions of `Demos`, as `env` would have recorded them."""
    size = int(demos.offsets[-1])
    buffer = HerReplayBuffer(env, size, args.her_probability, rng, args.her_exponent)
    if args.encoder is not None:
        env.encoder.encode_demos(demos)  # the environments may have done so in other processes
    for demo in progress_bar(demos, "demonstrations", unit="demonstration", transient=True):
        buffer.add_episode(demo_transitions(demo, env))
    return buffer


def concat(batches, more):
    """Yield each batch with the rows of the next one of `more` after its own."""
    for batch, rows in zip(batches, more, strict=True):
        yield {name: torch.cat([value, rows[name]]) for name, value in batch.items()}


def updates_due(step, args):
    """Number of updates in the last `num_envs` steps; the first `learning_starts` have none."""
    begin = max(0, step - args.num_envs - args.learning_starts)
    end = max(0, step - args.learning_starts)
    return int(end * args.updates_per_step) - int(begin * args.updates_per_step)


WHOLE_TURN = 6.28  # rad


def discount_factor(gamma, robot):
    """`--gamma` as a number, for an `envs.robots.robot.Robot`."""
    if gamma != "auto":
        return gamma
    return 0.98 if (robot.upper - robot.lower).max() >= WHOLE_TURN else 0.95


# END SHARED


# ALGO LOGIC: networks, optimisers and one update
POLICY_NOISE, NOISE_CLIP = 0.2, 0.5  # of the critics' target, in units of the action scale


class TD3:
    def __init__(self, args, env, device):
        self.args = args
        self.gamma = discount_factor(args.gamma, env.unwrapped.robot)
        self.actor = Actor(args, env).to(device)
        self.actor_target = Actor(args, env).to(device)
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.actor_average = Actor(args, env).to(device).eval()  # evaluated and saved
        self.actor_average.load_state_dict(self.actor.state_dict())
        self.critics = Critics(args, self.actor.features).to(device)
        self.critics_target = Critics(args, self.actor.features).to(device)
        self.critics_target.load_state_dict(self.critics.state_dict())
        parameters = self.actor.parameters()
        self.actor_optimizer = cuda_graphs.adam(parameters, args.policy_lr, args, device)
        self.q_optimizer = cuda_graphs.adam(self.critics.parameters(), args.q_lr, args, device)

    def checkpoint_state(self):
        """The parts of a checkpoint, by name."""
        constants = ("args", "gamma")
        return {name: part for name, part in vars(self).items() if name not in constants}

    @torch.no_grad()
    def explore(self, data):
        """From observations, (N, ...) each, to a dict with noisy `actions` (N, n)."""
        self.actor.eval()
        actions = self.actor(**data)
        scale = self.actor.action_scale
        self.actor.train()
        noise = self.args.exploration_noise * torch.randn_like(actions)
        return {"actions": (actions + scale * noise).clamp(-scale, scale)}

    def update(self, data, of_policy):
        """An update on a batch, `of_policy` or not. Returns tensors whose means are logged."""
        args, scale = self.args, self.actor.action_scale
        both = torch.cat([data["observation"], data["next_observation"]])
        features = self.actor.features(both, data["desired_goal"].repeat(2, 1))
        features, next_features = features.chunk(2)
        with torch.no_grad():
            next_actions, _ = self.actor_target.get_action(next_features)
            clipped_noise = POLICY_NOISE * torch.randn_like(next_actions)
            clipped_noise = clipped_noise.clamp(-NOISE_CLIP, NOISE_CLIP)
            next_actions = (next_actions + scale * clipped_noise).clamp(-scale, scale)
            min_qf_next_target = self.critics_target(next_features, next_actions).amin(0)
            not_terminated = 1.0 - data["terminated"]
            next_q_value = data["reward"] + self.gamma * not_terminated * min_qf_next_target
        qf_values = self.critics(features, data["action"])
        qf_losses = (qf_values - next_q_value).square().mean(1)  # of Q1 and of Q2
        self.q_optimizer.zero_grad()
        qf_losses.sum().backward()
        self.q_optimizer.step()
        losses = {
            "qf1_values": qf_values[0],
            "qf2_values": qf_values[1],
            "qf1_loss": qf_losses[0],
            "qf2_loss": qf_losses[1],
            "qf_loss": qf_losses,
        }

        if of_policy:
            self.critics.requires_grad_(False)  # they need no gradient of the policy's loss
            actions, preactivation = self.actor.get_action(features)
            qf1 = self.critics(features, actions, number=1)
            penalty = args.preactivation_penalty * preactivation.square().mean()
            actor_loss = penalty - qf1.mean()
            if args.bc_weight > 0:  # the last transitions are those of demonstrations
                difference = (actions - data["action"])[-args.demo_batch_size :]
                bc_loss = (difference / scale).square().sum(1).mean()
                actor_loss = actor_loss + args.bc_weight * bc_loss
                losses["bc_loss"] = bc_loss
            self.actor_optimizer.zero_grad()
            actor_loss.backward()
            self.actor_optimizer.step()
            self.critics.requires_grad_(True)
            polyak_update(self.actor_average, self.actor, args.policy_average)
            polyak_update(self.actor_target, self.actor, args.tau)
            polyak_update(self.critics_target, self.critics, args.tau)
            losses["actor_loss"] = actor_loss
            losses["preactivation"] = preactivation.abs()
        return losses


if __name__ == "__main__":
    # SHARED: checks and environments
    args = runs.parse_args(Args, may_change={"total_timesteps", "test_queries", "stop_at_success"})
    device = runs.seed_torch(args)
    validation, test = protocol.load_task(args)
    env_arguments = protocol.env_arguments_of(args)
    envs = protocol.make_training_envs(args, args.demo_prob, args.demos, args.bc_weight)
    eval_envs = protocol.make_eval_envs(args.task, len(validation), **env_arguments)
    # END SHARED

    agent = TD3(args, eval_envs[0], device)
    # SHARED: run and episodes
    explore = cuda_graphs.graphed(agent.explore, args, device)
    update = cuda_graphs.graphed(agent.update, args, device)
    rng = np.random.default_rng(args.seed)
    buffer = HerReplayBuffer(
        eval_envs[0], BUFFER_SIZE, args.her_probability, rng, args.her_exponent
    )
    counts = {"updates": 0, "demos_injected": 0}
    losses = {}
    state = agent.checkpoint_state() | {"buffer": buffer, "rng": rng, "counts": counts}
    run = protocol.PolicyRun(args, state, device, env_arguments, eval_envs, validation)
    envs.encode_demos()
    run.start(args.total_timesteps, "step")
    demo_buffer = None
    if args.bc_weight > 0:
        demo_buffer = buffer_of_demos(envs.demos, eval_envs[0], args, rng)
    envs.begin_episodes(args.seed, run.step)
    run.repeat_evaluation(agent.actor_average)
    # END SHARED

    while run.step < args.total_timesteps and not run.reached(args.stop_at_success):
        # ALGO LOGIC: act
        if run.step < args.learning_starts:
            actions = 2 * torch.rand(args.num_envs, *eval_envs[0].action_space.shape) - 1
            actions = actions.numpy() * agent.actor.action_scale
        else:
            actions = explore(protocol.stack(envs.observations, device))["actions"].cpu().numpy()

        # SHARED: a step in every environment
        runs.check_finite("the policy's actions", actions)
        for episode in envs.step(actions):
            buffer.add_episode(episode.transitions)
            if episode.demo is not None:
                buffer.add_episode(episode.demo)
                counts["demos_injected"] += 1
            run.log_episode(episode, counts["demos_injected"] if args.demo_prob else None)
        global_step = run.advance(args.num_envs)

        # ALGO LOGIC: learn
        due = updates_due(global_step, args) if buffer.size > 0 else 0
        batches = buffer.batches(due, args.batch_size, device)
        if demo_buffer is not None:
            batches = concat(batches, demo_buffer.batches(due, args.demo_batch_size, device))
        for data in batches:
            losses |= update(data, counts["updates"] % args.policy_frequency == 0)
            counts["updates"] += 1
            if counts["updates"] % 1000 == 0:
                named = {f"losses/{name}": value for name, value in losses.items()}
                run.log(named | {"charts/SPS": int(run.rate)})

        # Evaluate, save the best policy, checkpoint
        evaluating = run.step % args.eval_every < args.num_envs or run.step >= args.total_timesteps
        if evaluating and run.validate(agent.actor_average):
            run.save_policy(agent.actor_average)
        if evaluating or run.interrupted:
            # New episodes begin, in this run as in one that is resumed from the checkpoint.
            for transitions in envs.begin_episodes(args.seed, run.step):
                buffer.add_episode(transitions)
            run.checkpoint()
    run.final_test(test)
    # END SHARED
