"""Contrastive reinforcement learning (CRL), with demonstrations. One file: read it top to bottom.

    roboarm train crl --task no_obstacles --goal-type ee
    python clean_rl_scripts/crl_mp.py --task double_walls --demo-prob 1    # the same script

There are no rewards (Eysenbach et al., 2022): the critic learns to tell the goal that is reached
some steps after an action from the goals of other episodes, and the policy makes its goal likely.
Losses and energies are those of JaxGCRL (Bortkiewicz et al., 2025). For an algorithm of your own,
copy this file and change the parts under `# ALGO LOGIC`; `# SHARED` is as in `sac_her_mp.py`.
"""

import functools
import math
import os
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import roboarm_nmp
from roboarm_nmp.datasets import episodes
from roboarm_nmp.envs.subgoals import MAX_STEP
from roboarm_nmp.envs.tasks import task_name
from roboarm_nmp.evaluation.evaluate import evaluate, first_episode_images
from roboarm_nmp.policies.export import save_policy
from roboarm_nmp.training.arguments import errors_of, fail, parse_args
from roboarm_nmp.training.cuda_graphs import graphed
from roboarm_nmp.training.devices import adam, seed_torch, to_device
from roboarm_nmp.training.errors import check_finite
from roboarm_nmp.training.final_test import RESULTS, finish, load_task
from roboarm_nmp.training.network_parts import Bf16Linear, GoalFeatures, polyak_update
from roboarm_nmp.training.runs import Run, script_name
from roboarm_nmp.training.vector_envs import async_envs
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.progress import progress_bar


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


# SHARED: flags of the environment
@dataclass
class EnvArgs:
    goal_type: Literal["ee", "config", "combined", "pose"] = "ee"
    """what the goal is: end-effector position, configuration, both, or end-effector pose"""
    velocities: bool = False
    """joint velocities in the observation"""
    encoder: str | None = None
    """the encoded scene in the observation: latent code (`vae`, `vqvae`, `pointnet2`, `field`, or
    the path of your own `encoder.onnx`), `point_cloud`, or `oracle` (ground-truth obstacles)"""
    geometry_source: str | None = None
    """where link distances take the obstacles from: `ground_truth`, `point_cloud`, or an encoder
    with a decoder (`field`, or a path), which also gives the points of the encoder `point_cloud`"""
    link_distances: bool = False
    """signed distance of each link from the nearest obstacle of --geometry-source, and its
    gradient, in the observation"""


# ALGO LOGIC: flags
@dataclass
class Args(RunArgs, EnvArgs):
    num_envs: flags.Environments = 4
    """environments stepped together; every one of their steps counts"""
    total_timesteps: flags.PositiveInt = 1_000_000
    """environment steps of the whole run"""
    learning_starts: flags.NonNegativeInt = 2_000
    """environment steps with random actions before the first update"""
    horizon: flags.Horizon = 100
    """steps after which an episode of the training is truncated"""
    updates_per_step: flags.NonNegativeFloat = 0.1
    """updates of the critic per environment step; with 0.5, success stops rising early"""
    batch_size: flags.PositiveInt = 256
    """transitions per update; for each, the goals of all others are negatives"""
    contrastive_loss: Literal["symmetric", "forward", "backward", "binary"] = "symmetric"
    """InfoNCE that finds the goal of an action (`forward`), the action of a goal (`backward`) or
    both, or a binary classification of all pairs (Eysenbach et al., 2022)"""
    energy: Literal["norm", "l2", "dot", "cosine"] = "norm"
    """what the critic makes of two representations: minus their distance or its square, their
    product, or the cosine between them"""
    representation_size: flags.Width = 64
    """numbers in the representation of an action, and in that of a goal"""
    logsumexp_penalty: flags.NonNegativeFloat = 0.1
    """weight of the squared log of the sum over goals in the critic's loss, which keeps its values
    comparable between states"""
    random_goals: flags.Share = 0.5
    """share of the policy's updates towards the goal of another transition, not of their own"""
    demo_prob: flags.Share | None = None
    """train on the queries of the task's demonstrations; when an episode fails, its demonstration
    enters the replay buffer with this probability (the paper's p). Without it: random queries"""
    demos: tuple[Path, ...] = ()
    """demonstration files of the task, to use with --demo-prob; by default the task's own"""
    bc_weight: flags.NonNegativeFloat = 0.0
    """with --demo-prob, weight of behavioural cloning in the policy's loss: the squared difference
    from demonstrated actions, in units of the action scale"""
    gamma: flags.Share | Literal["auto"] = "auto"
    """a goal k steps ahead is drawn with a probability proportional to gamma^k (JaxGCRL: 0.99);
    `auto`: 0.95, and 0.98 for arms with a joint that turns all the way round"""
    learning_rate: flags.PositiveFloat = 1e-3
    """learning rate of all networks (Adam; JaxGCRL: 3e-4)"""
    alpha: flags.PositiveFloat = 0.02
    """entropy coefficient; the initial one, if it is tuned (JaxGCRL: 1)"""
    target_entropy: flags.FiniteFloat | Literal["auto"] | None = "auto"
    """entropy that alpha is tuned to, of the unscaled action; `auto`: minus the number of joints;
    `None`: alpha is constant"""
    policy_average: flags.PositiveShare = 0.003
    """share of the policy that moves per update into the average that is saved (1: no averaging);
    larger at first"""
    hidden_size: flags.Width = 256
    """width of the hidden layers of policy and critic"""
    num_hidden_layers: flags.Layers = 2
    """number of hidden layers of policy and critic"""
    jacobian: bool = True
    """network inputs: how the joints move the end effector straight to the goal, and where an
    action moves it (Jacobian)"""
    plain_networks: bool = False
    """raw inputs, no LayerNorm, actions in [-1, 1] (not in twice the step)"""
    bf16: bool | None = None
    """train with hidden layers in bfloat16; by default where that is faster"""
    eval_every: flags.PositiveInt = 25_000
    """environment steps between evaluations on validation queries"""
    stop_at_success: flags.Share | None = None
    """stop at this success rate on validation queries, e.g. 0.9; by default never"""


RULES = ("horizon",)  # flags that are arguments of `make`


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


# SHARED: stochastic policy
LOG_STD_MIN, LOG_STD_MAX = -5, 2


class Actor(nn.Module):
    def __init__(self, args, env):
        super().__init__()
        self.features = GoalFeatures(env, args.plain_networks, args.jacobian)
        self.action_scale = 1.0 if args.plain_networks else 2.0 * MAX_STEP  # largest action
        self.mlp = mlp(self.features.size, 2 * self.features.num_joints, args)

    def get_action(self, features):
        """A random action (N, n), and its log-density (N,) before scaling by `action_scale`."""
        mean, log_std = self.mlp(features).chunk(2, dim=1)
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (torch.tanh(log_std) + 1)
        noise = torch.randn_like(mean)
        x_t = mean + log_std.exp() * noise
        log_prob = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - 2 * (math.log(2) - x_t - F.softplus(-2 * x_t))  # log(1 - tanh(x_t)^2)
        return self.action_scale * torch.tanh(x_t), log_prob.sum(1)

    def mean_action(self, features):
        """The deterministic action (N, n)."""
        mean = self.mlp(features)[:, : self.features.num_joints]
        return self.action_scale * torch.tanh(mean)

    def forward(self, observation, achieved_goal, desired_goal, **_):
        """The deterministic action (N, n), for evaluation; policy.onnx contains this function."""
        return self.mean_action(self.features(observation, desired_goal))


# ALGO LOGIC: critic
class Critic(nn.Module):
    """Log-probability of reaching a goal after an action, up to a constant."""

    def __init__(self, args, env, actor):
        super().__init__()
        self.args = args
        self.features = features = actor.features  # for its constants
        self.action_scale = actor.action_scale
        spaces = env.observation_space
        goal = torch.zeros(1, *spaces["desired_goal"].shape)
        state = torch.zeros(1, *spaces["observation"].shape)
        action = torch.zeros(1, features.num_joints)
        size, layer_norm = args.representation_size, not args.plain_networks
        self.of_action = mlp(self.action_inputs(state, action).shape[1], size, args, layer_norm)
        self.of_goal = mlp(goal.shape[1], size, args, layer_norm)

    def action_inputs(self, observation, action):
        """(N, o), (N, n) -> (N, size)."""
        inputs = [observation, action / self.action_scale]
        if self.args.plain_networks:
            return torch.cat(inputs, 1)
        features, state = self.features, observation[:, : self.features.num_joints]
        angles = state * features.half_range + features.middle
        step = action * (MAX_STEP / action.norm(dim=1, keepdim=True).clamp_min(MAX_STEP))
        step = (state + step).clamp(-1.0, 1.0) - state  # joints stop at their limits
        inputs += [torch.sin(angles), torch.cos(angles), step / MAX_STEP]
        if features.jacobian is not None:
            end_effector = observation[:, features.ee][:, :3]
            moves = []  # of the end effector along, and for poses about, each axis
            for axis in torch.eye(features.jacobian.size - 3, device=step.device):
                along = axis.expand(len(step), -1)
                moves.append((features.jacobian(state, end_effector, along) * step).sum(1))
            moves = torch.stack(moves, 1)
            inputs += [20.0 * moves, 5.0 * (end_effector + moves[:, :3])]
        if features.distances is not None:
            inputs.append(10.0 * observation[:, features.distances])
        return torch.cat(inputs, 1)

    def representations(self, observation, action, goal):
        """Of actions and of goals, (N, r) each."""
        scaled = goal if self.args.plain_networks else 5.0 * goal
        return self.of_action(self.action_inputs(observation, action)), self.of_goal(scaled)

    def all_pairs(self, observation, action, goal):
        """(N, o), (N, n), (N, g) -> (N, N): a row per action, a column per goal."""
        x, y = self.representations(observation, action, goal)
        if self.args.energy == "cosine":
            x, y = F.normalize(x), F.normalize(y)
        products = x @ y.T
        if self.args.energy in ("dot", "cosine"):
            return products
        square = x.square().sum(1, keepdim=True) - 2.0 * products + y.square().sum(1)
        return -square if self.args.energy == "l2" else -(square.clamp_min(0.0) + 1e-6).sqrt()

    def forward(self, observation, action, goal):
        """(N, o), (N, n), (N, g) -> (N,): of each action and its goal."""
        x, y = self.representations(observation, action, goal)
        if self.args.energy == "cosine":
            return F.cosine_similarity(x, y)
        if self.args.energy == "dot":
            return (x * y).sum(1)
        square = (x - y).square().sum(1)
        return -square if self.args.energy == "l2" else -(square + 1e-6).sqrt()


# ALGO LOGIC: replay buffer
BUFFER_SIZE = 1_000_000  # transitions; memory is taken as they come


class HerReplayBuffer:
    """Transitions of finished episodes in a ring; goals are drawn when they are sampled.

    `remaining` counts the transitions that follow one in its episode. New episodes overwrite the
    oldest ones from their start on, so that these transitions outlive it.
    """

    def __init__(self, env, capacity, args, rng):
        spaces = env.observation_space
        sizes = {
            "observation": spaces["observation"].shape[0],
            "next_achieved_goal": spaces["desired_goal"].shape[0],
            "action": env.action_space.shape[0],
        }
        self.arrays: dict[str, np.ndarray] = {}
        for name, size in sizes.items():
            self.arrays[name] = np.zeros((capacity, size), np.float32)
        self.arrays["remaining"] = np.zeros(capacity, np.int32)
        self.gamma = discount_factor(args.gamma, env.unwrapped.robot)
        self.capacity = capacity
        self.rng = rng
        self.running = [[] for _ in range(args.num_envs)]  # the episodes that have not ended
        self.position = 0
        self.size = 0

    # SHARED: episodes in the buffer
    def add(self, observations, actions, next_observations, collisions, ended):
        """A step of all environments: dicts of arrays (num_envs, ...), and arrays (num_envs, ...).

        `next_observations` are those of the same episodes, also where an episode has `ended`.
        """
        for i, episode in enumerate(self.running):
            before = {name: array[i] for name, array in observations.items()}
            after = {name: array[i] for name, array in next_observations.items()}
            episode.append(episodes.transition(before, actions[i], after, collisions[i]))
            if ended[i]:
                self.add_episode(episode)
                self.running[i] = []

    def end_episodes(self):
        """The running episodes end as they are."""
        for episode in self.running:
            self.add_episode(episode)
        self.running = [[] for _ in self.running]

    def add_episode(self, transitions):
        """`transitions`: a list, each as `roboarm_nmp.datasets.episodes.transition` makes them."""
        if not transitions:
            return
        index = (self.position + np.arange(len(transitions))) % self.capacity
        self.arrays["remaining"][index] = np.arange(len(transitions))[::-1]
        for name in self.arrays.keys() - {"remaining"}:
            self.arrays[name][index] = [transition[name] for transition in transitions]
        self.position = (self.position + len(transitions)) % self.capacity
        self.size = min(self.size + len(transitions), self.capacity)

    # ALGO LOGIC: hindsight
    def sample(self, batch_size):
        """A dict of float32 arrays (batch_size, ...): `observation`, `action`, and a `goal`.

        The goal is reached k steps after the observation, with a probability proportional to
        gamma^k, as far as the episode goes.
        """
        index = self.rng.integers(self.size, size=batch_size)
        share = 1.0 - self.gamma ** (self.arrays["remaining"][index] + 1.0)
        later = np.log1p(-share * self.rng.random(batch_size)) / np.log(self.gamma)
        later = np.minimum(later.astype(int), self.arrays["remaining"][index])  # k - 1
        data = {name: self.arrays[name][index] for name in ("observation", "action")}
        data["goal"] = self.arrays["next_achieved_goal"][(index + later) % self.capacity]
        return data

    # SHARED: batches, state of the buffer
    def batches(self, number, batch_size, device):
        """Yield `number` batches, dicts of tensors; up to 64 are sampled together, for speed."""
        for first in range(0, number, 64):
            data = self.sample(min(64, number - first) * batch_size)
            parts = [to_device(array, device).split(batch_size) for array in data.values()]
            for tensors in zip(*parts, strict=True):
                yield dict(zip(data, tensors, strict=True))

    def state_dict(self):
        arrays = {name: torch.from_numpy(a[: self.size]) for name, a in self.arrays.items()}
        return {"arrays": arrays, "position": self.position}

    def load_state_dict(self, state):
        self.size = len(state["arrays"]["remaining"])
        self.position = state["position"]
        for name, array in state["arrays"].items():
            self.arrays[name][: self.size] = array.numpy()


# SHARED: environments
def env_arguments(args):
    """The arguments of `roboarm_nmp.make` that a policy is saved with."""
    arguments = {field.name: getattr(args, field.name) for field in fields(EnvArgs)}
    return arguments | {"append_link_distances": args.link_distances}


def make_env(args, demos=None) -> Any:
    """An environment; with demonstrations, its episodes are their queries."""
    rules = {name: getattr(args, name) for name in RULES}
    rules["goal_link_distances"] = False  # relabelled goals would not have them
    env = roboarm_nmp.make(args.task, **env_arguments(args), **rules)
    return env if demos is None else episodes.DemoQueriesWrapper(env, demos)


def reset_seeds(args, step):
    """The seeds of the environments' episodes that begin at a step of the run."""
    return np.random.SeedSequence([args.seed, step]).generate_state(args.num_envs).tolist()


def concat(batch, more):
    """A batch with the rows of another after its own."""
    return {name: torch.cat([value, more[name]]) for name, value in batch.items()}


WHOLE_TURN = 6.28  # rad


def discount_factor(gamma, robot):
    """`--gamma` as a number, for an `envs.robots.robot.Robot`."""
    if gamma != "auto":
        return gamma
    return 0.98 if (robot.upper - robot.lower).max() >= WHOLE_TURN else 0.95


# ALGO LOGIC: networks, optimisers and updates
LOG_SECONDS = 10  # between two logs of the losses
DEMO_BATCH_SIZE = 128  # transitions of demonstrations in every batch, with --bc-weight
POLICY_FREQUENCY = 2  # updates of the critic per update of the policy (JaxGCRL: 1)


class CRL(nn.Module):
    def __init__(self, args, env, device):
        super().__init__()
        self.args = args
        self.target_entropy = args.target_entropy
        if args.target_entropy == "auto":
            self.target_entropy = -float(env.action_space.shape[0])
        self.actor = Actor(args, env).to(device)
        self.actor_average = Actor(args, env).to(device).eval()  # evaluated and saved
        self.actor_average.load_state_dict(self.actor.state_dict())
        self.critic = Critic(args, env, Actor(args, env)).to(device)
        self.log_alpha = nn.Parameter(torch.full((1,), math.log(args.alpha), device=device))
        actor_parameters = [*self.actor.parameters(), self.log_alpha]
        self.actor_optimizer = adam(actor_parameters, args.learning_rate, device)
        self.critic_optimizer = adam(self.critic.parameters(), args.learning_rate, device)

    @torch.no_grad()
    def explore(self, data):
        """From observations, (N, ...) each, to a dict with random `actions` (N, n)."""
        self.actor.eval()
        features = self.actor.features(data["observation"], data["desired_goal"])
        actions, _ = self.actor.get_action(features)
        self.actor.train()
        return {"actions": actions}

    def update_critics(self, data):
        """A step of the critic on a batch. Returns tensors whose means are logged."""
        logits = self.critic.all_pairs(data["observation"], data["action"], data["goal"])
        is_own = torch.eye(len(logits), device=logits.device)
        over_goals, over_actions = logits.logsumexp(1), logits.logsumexp(0)
        own = logits.diagonal()
        critic_loss = {
            "forward": over_goals - own,
            "backward": over_actions - own,
            "symmetric": over_goals + over_actions - 2.0 * own,
            "binary": F.binary_cross_entropy_with_logits(logits, is_own, reduction="none"),
        }[self.args.contrastive_loss].mean()
        penalty = self.args.logsumexp_penalty * over_goals.square().mean()
        self.critic_optimizer.zero_grad()
        (critic_loss + penalty).backward()
        self.critic_optimizer.step()
        found = (own >= logits.amax(1)).float()  # the goal of an action, among all of the batch
        return {"critic_loss": critic_loss, "accuracy": found, "own_goal": own}

    def update_actor(self, data):
        """A step of the policy and of the entropy coefficient. Returns tensors to log."""
        args = self.args
        alpha = self.log_alpha.detach().exp()
        number = round(args.random_goals * args.batch_size)  # those of demonstrations keep theirs
        goal = torch.cat([data["goal"].roll(1, 0)[:number], data["goal"][number:]])
        features = self.actor.features(data["observation"], goal)
        self.critic.requires_grad_(False)  # it needs no gradient of the policy's loss
        actions, log_pi = self.actor.get_action(features)
        value = self.critic(data["observation"], actions, goal)
        actor_loss = (alpha * log_pi - value).mean()
        losses = {"alpha": alpha, "entropy": -log_pi}
        if args.bc_weight > 0:  # the last transitions are those of demonstrations
            demonstrated = data["action"][-DEMO_BATCH_SIZE:]
            difference = self.actor.mean_action(features[-DEMO_BATCH_SIZE:]) - demonstrated
            losses["bc_loss"] = (difference / self.actor.action_scale).square().sum(1).mean()
            actor_loss = actor_loss + args.bc_weight * losses["bc_loss"]
        alpha_loss = 0.0 * self.log_alpha.exp()
        if self.target_entropy is not None:
            surplus = log_pi.detach().mean() + self.target_entropy
            alpha_loss = -self.log_alpha.exp() * surplus
        self.actor_optimizer.zero_grad()
        (actor_loss + alpha_loss).backward()
        self.actor_optimizer.step()
        self.critic.requires_grad_(True)
        return losses | {"actor_loss": actor_loss, "alpha_loss": alpha_loss}


if __name__ == "__main__":
    # SHARED: checks, environments
    args: Any = parse_args(Args, may_change={"total_timesteps", "test_queries", "stop_at_success"})
    device = seed_torch(args)
    validation, test = load_task(args)
    with errors_of("--encoder, --geometry-source, --link-distances"):
        env = make_env(args)  # for its spaces and rewards
    demos: Any = None
    if args.demo_prob is not None:
        with errors_of("--demo-prob"):
            demos = episodes.load_demos_for(env, args.demos, args.task)
    elif args.demos or args.bc_weight > 0:
        fail("--demos and --bc-weight go with --demo-prob")

    # ALGO LOGIC: the agent
    if args.gamma in (0.0, 1.0):
        fail("--gamma must be between 0 and 1")
    agent = CRL(args, env, device)
    criterion = "success_rate"  # of the best policy
    # SHARED: run, buffers, episodes
    explore = graphed(agent.explore, device)
    update_critics = graphed(agent.update_critics, device)
    update_actor = graphed(agent.update_actor, device)
    rng = np.random.default_rng(args.seed)
    buffer = HerReplayBuffer(env, BUFFER_SIZE, args, rng)
    progress = {"best": -1.0, "best_success": -1.0, "best_step": 0}
    progress |= {"updates": 0, "demos_injected": 0, "evaluated": 0}
    state = {"agent": agent, "buffer": buffer, "rng": rng, "progress": progress}
    state["actor_optimizer"] = agent.actor_optimizer
    state["critic_optimizer"] = agent.critic_optimizer
    run = Run(args, task_name(args.task), state)
    makers = [functools.partial(make_env, args, demos)] * args.num_envs
    if device.type == "cuda":  # it would wait for the environments; a CPU computes longer than they
        envs = async_envs(makers)
    else:
        envs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
    demo_buffer = None
    if args.bc_weight > 0:
        demo_buffer = HerReplayBuffer(env, int(demos.offsets[-1]), args, rng)
        for demo in progress_bar(demos, "demonstrations", transient=True):
            demo_buffer.add_episode(episodes.demo_transitions(demo, env))
    observations, _ = envs.reset(seed=reset_seeds(args, run.step))
    returns, contacts = np.zeros(args.num_envs), np.zeros(args.num_envs)
    losses = {}
    logged = 0.0
    run.start(args.total_timesteps, "step")

    while True:
        # SHARED: evaluate, keep the best policy
        due = run.step % args.eval_every < args.num_envs or run.step >= args.total_timesteps
        if due and run.step > progress["evaluated"]:
            buffer.end_episodes()  # new ones begin, here as in a run that is resumed
            run.save()  # a run that is stopped while it evaluates repeats the evaluation
            run.interruptible = True
            latest = run.folder / "latest.onnx"
            origin = {"script": script_name(), "seed": args.seed, "step": run.step}
            save_policy(latest, agent.actor_average, args.task, None, origin, **env_arguments(args))
            result = evaluate(latest, args.task, queries=validation)
            run.log({f"eval/{name}": result[name] for name in RESULTS})
            if args.capture_video:
                images = first_episode_images(latest, args.task, 40, queries=validation)
                run.log_video("eval/episode", images)
            run.interruptible = False
            progress["evaluated"] = run.step
            if result[criterion] >= progress["best"]:
                progress |= {"best": result[criterion], "best_step": run.step}
                progress["best_success"] = result["success_rate"]
                os.replace(latest, run.folder / "policy.onnx")
            observations, _ = envs.reset(seed=reset_seeds(args, run.step))
            returns[:] = contacts[:] = 0.0
        best = progress["best_success"]
        reached = args.stop_at_success is not None and best >= args.stop_at_success
        if run.step >= args.total_timesteps or reached:
            break

        # ALGO LOGIC: act
        if run.step < args.learning_starts:
            actions = 2 * torch.rand(args.num_envs, env.action_space.shape[0]) - 1
            actions = actions.numpy() * agent.actor.action_scale
        else:
            on_device = {name: to_device(array, device) for name, array in observations.items()}
            actions = explore(on_device)["actions"].cpu().numpy()

        # SHARED: a step in every environment
        check_finite("the policy's actions", actions)
        next_observations, rewards, terminated, truncated, infos = envs.step(actions)
        run.advance(args.num_envs)
        # Where an episode has ended, the next one has begun: what the last step led to is in infos.
        ended = terminated | truncated
        reached_observations = {name: array.copy() for name, array in next_observations.items()}
        collisions = infos["collision"].copy()
        for i in np.flatnonzero(ended):
            collisions[i] = infos["final_info"]["collision"][i]
            for name, array in reached_observations.items():
                array[i] = infos["final_obs"][i][name]
        buffer.add(observations, actions, reached_observations, collisions, ended)
        returns += rewards
        contacts += collisions
        for i in np.flatnonzero(ended):
            success = infos["final_info"]["is_success"][i]
            if args.demo_prob is not None and not success and rng.random() < args.demo_prob:
                demo = demos[int(infos["final_info"]["demo"][i])]
                buffer.add_episode(episodes.demo_transitions(demo, env))
                progress["demos_injected"] += 1
            steps = infos["final_info"]["elapsed_steps"][i]
            episode = {"episodic_return": returns[i], "episodic_length": steps, "success": success}
            episode["contact_share"] = contacts[i] / steps
            run.log({f"charts/{name}": value for name, value in episode.items()})
            returns[i] = contacts[i] = 0.0
        observations = next_observations

        # SHARED: learn
        steps = max(0, run.step - args.learning_starts) if buffer.size > 0 else 0
        earlier_steps = max(0, steps - args.num_envs)
        number = int(steps * args.updates_per_step) - int(earlier_steps * args.updates_per_step)
        batches = buffer.batches(number, args.batch_size, device)
        if demo_buffer is not None:
            more = demo_buffer.batches(number, DEMO_BATCH_SIZE, device)
            batches = map(concat, batches, more)
        for data in batches:
            losses |= update_critics(data)
            if progress["updates"] % POLICY_FREQUENCY == 0:
                losses |= update_actor(data)
                # Faster at first, or the average would keep much of the untrained policy.
                share = max(args.policy_average, 8.0 / (progress["updates"] + 8))
                polyak_update(agent.actor_average, agent.actor, share)
            progress["updates"] += 1
            if time.monotonic() - logged > LOG_SECONDS or progress["updates"] == 1:
                logged = time.monotonic()
                run.log({f"losses/{name}": value for name, value in losses.items()})
                run.log({"charts/SPS": run.rate, "charts/running_return": returns.mean()})
        if run.interrupted:
            buffer.end_episodes()
            run.save()
    envs.close()
    run.save()  # a longer run, which continues this one, knows its best policy
    finish(run, test, progress["best_success"], progress["best_step"])
