"""TD3 with hindsight experience replay (HER) and demonstrations. One file: read it top to bottom.

    roboarm train td3 --task no_obstacles --goal-type ee
    python clean_rl_scripts/td3_her_mp.py --task double_walls --demo-prob 1    # the same script

Twin Delayed DDPG (Fujimoto et al., 2018) in CleanRL's form, goals relabelled with the `future`
strategy (Andrychowicz et al., 2017), demonstrations injected upon failure (TD3-MP), as in the
paper's sections 2 and 5. For an algorithm of your own, copy this file and change the parts under
`# ALGO LOGIC`. Parts under `# SHARED` are the same in `sac_her_mp.py`.
"""

import functools
import os
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn as nn
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
    horizon: flags.Horizon = 400
    """steps after which an episode of the training is truncated"""
    stop_on_collision: bool = False
    """end an episode of the training at the first contact; as every step costs 1, a contact then
    costs less than a long way to the goal, unless --contact-cost makes up for it"""
    contact_cost: flags.NonNegativeFloat = 0.0
    """taken off the reward of each step with a contact; the best policy is then the one with the
    highest collision-free success"""
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
    from demonstrated actions, in units of the action scale"""
    gamma: flags.Share | Literal["auto"] = "auto"
    """discount factor (CleanRL: 0.99); `auto`: 0.95, and 0.98 for arms with a joint that turns all
    the way round, as an arm at its limit may have to"""
    tau: flags.PositiveShare = 0.005
    """share of policy and critics that moves into the target networks, per update of the policy"""
    learning_rate: flags.PositiveFloat = 1e-3
    """learning rate of all networks (Adam; CleanRL: 3e-4)"""
    exploration_noise: flags.NonNegativeFloat = 0.35
    """standard deviation of the noise on the actions in training, in units of the action scale
    (CleanRL: 0.1)"""
    preactivation_penalty: flags.NonNegativeFloat = 0.1
    """weight of the squared inputs of the policy's tanh in its loss, which keeps it from saturating
    (Andrychowicz et al., 2017, appendix A; CleanRL: 0)"""
    policy_average: flags.PositiveShare = 0.0003
    """share of the policy that moves per update into the average that is saved (1: no averaging);
    larger at first"""
    hidden_size: flags.Width = 256
    """width of the hidden layers of policy and critics"""
    num_hidden_layers: flags.Layers = 2
    """number of hidden layers of policy and critics"""
    jacobian: bool = True
    """network inputs: how the joints move the end effector straight to the goal (Jacobian)"""
    plain_networks: bool = False
    """CleanRL's networks: raw inputs, no LayerNorm, actions in [-1, 1] (not in twice the step)"""
    bf16: bool | None = None
    """train with hidden layers in bfloat16; by default where that is faster"""
    eval_every: flags.PositiveInt = 25_000
    """environment steps between evaluations on validation queries"""
    stop_at_success: flags.Share | None = None
    """stop at this success rate on validation queries, e.g. 0.9; by default never"""


RULES = ("horizon", "stop_on_collision", "contact_cost")  # flags that are arguments of `make`


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


# SHARED: critics
class Critics(nn.Module):
    """Q1 and Q2."""

    def __init__(self, args, actor):
        super().__init__()
        self.action_scale = actor.action_scale
        size = actor.features.size + actor.features.num_joints
        layer_norm = not args.plain_networks
        self.mlps = nn.ModuleList(mlp(size, 1, args, layer_norm) for _ in range(2))

    def forward(self, features, action, number=2):
        """(N, f), (N, n) -> (number, N); of Q1 only with `number` 1."""
        inputs = torch.cat([features, action / self.action_scale], dim=1)
        return torch.stack([qf(inputs).squeeze(-1) for qf in self.mlps[:number]])


# ALGO LOGIC: policy
class Actor(nn.Module):
    def __init__(self, args, env):
        super().__init__()
        self.features = GoalFeatures(env, args.plain_networks, args.jacobian)
        self.action_scale = 1.0 if args.plain_networks else 2.0 * MAX_STEP  # largest action
        self.mlp = mlp(self.features.size, self.features.num_joints, args)

    def get_action(self, features):
        """The action (N, n) without noise, and the inputs of the tanh (N, n)."""
        preactivation = self.mlp(features)
        return self.action_scale * torch.tanh(preactivation), preactivation

    def forward(self, observation, achieved_goal, desired_goal, **_):
        """The action (N, n) without noise; policy.onnx contains this function."""
        return self.get_action(self.features(observation, desired_goal))[0]


# SHARED: replay buffer
BUFFER_SIZE = 1_000_000  # transitions; memory is taken as they come


class HerReplayBuffer:
    """Transitions of finished episodes in a ring; goals are relabelled when they are sampled.

    `remaining` counts the transitions that follow one in its episode. New episodes overwrite the
    oldest ones from their start on, so that these transitions outlive it.
    """

    def __init__(self, env, capacity, args, rng):
        spaces = env.observation_space
        sizes = {
            "observation": spaces["observation"].shape[0],
            "next_observation": spaces["observation"].shape[0],
            "next_achieved_goal": spaces["desired_goal"].shape[0],
            "desired_goal": spaces["desired_goal"].shape[0],
            "action": env.action_space.shape[0],
        }
        self.arrays: dict[str, np.ndarray] = {}
        for name, size in sizes.items():
            self.arrays[name] = np.zeros((capacity, size), np.float32)
        self.arrays["collision"] = np.zeros(capacity, bool)
        self.arrays["remaining"] = np.zeros(capacity, np.int32)
        self.compute_reward = env.get_wrapper_attr("compute_reward")
        self.compute_terminated = env.get_wrapper_attr("compute_terminated")
        self.capacity = capacity
        self.args = args
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

    # SHARED: hindsight
    def sample(self, batch_size):
        """A dict of arrays (batch_size, ...), `reward` and `terminated` (batch_size,) with them."""
        index = self.rng.integers(self.size, size=batch_size)
        data = {name: array[index] for name, array in self.arrays.items()}
        later = self.rng.random(batch_size) ** self.args.her_exponent * (data.pop("remaining") + 1)
        later = (index + later.astype(np.int64)) % self.capacity
        relabel = self.rng.random(batch_size) < self.args.her_probability
        hindsight_goal = self.arrays["next_achieved_goal"][later]
        data["desired_goal"] = np.where(relabel[:, None], hindsight_goal, data["desired_goal"])
        achieved, desired = data["next_achieved_goal"], data["desired_goal"]
        info = {"collision": data["collision"]}
        data["reward"] = self.compute_reward(achieved, desired, info).astype(np.float32)
        data["terminated"] = self.compute_terminated(achieved, desired, info).astype(np.float32)
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
POLICY_FREQUENCY = 2  # updates of the critics per update of the policy and of all target networks
POLICY_NOISE, NOISE_CLIP = 0.2, 0.5  # of the critics' target, in units of the action scale


class TD3(nn.Module):
    def __init__(self, args, env, device):
        super().__init__()
        self.args = args
        self.gamma = discount_factor(args.gamma, env.unwrapped.robot)
        self.actor = Actor(args, env).to(device)
        self.actor_target = Actor(args, env).to(device)
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.actor_average = Actor(args, env).to(device).eval()  # evaluated and saved
        self.actor_average.load_state_dict(self.actor.state_dict())
        self.critics = Critics(args, self.actor).to(device)
        self.critics_target = Critics(args, self.actor).to(device)
        self.critics_target.load_state_dict(self.critics.state_dict())
        self.actor_optimizer = adam(self.actor.parameters(), args.learning_rate, device)
        self.critic_optimizer = adam(self.critics.parameters(), args.learning_rate, device)

    @torch.no_grad()
    def explore(self, data):
        """From observations, (N, ...) each, to a dict with noisy `actions` (N, n)."""
        self.actor.eval()
        actions = self.actor(**data)
        self.actor.train()
        scale = self.actor.action_scale
        noise = self.args.exploration_noise * torch.randn_like(actions)
        return {"actions": (actions + scale * noise).clamp(-scale, scale)}

    def update_critics(self, data):
        """A step of the critics on a batch. Returns tensors whose means are logged."""
        scale = self.actor.action_scale
        features = self.actor.features(data["observation"], data["desired_goal"])
        with torch.no_grad():
            next_features = self.actor.features(data["next_observation"], data["desired_goal"])
            next_actions, _ = self.actor_target.get_action(next_features)
            clipped_noise = POLICY_NOISE * torch.randn_like(next_actions)
            clipped_noise = clipped_noise.clamp(-NOISE_CLIP, NOISE_CLIP)
            next_actions = (next_actions + scale * clipped_noise).clamp(-scale, scale)
            next_value = self.critics_target(next_features, next_actions).amin(0)
            # An episode that was truncated, not terminated, would have gone on: its value counts.
            next_q_value = data["reward"] + self.gamma * (1.0 - data["terminated"]) * next_value
        qf_values = self.critics(features, data["action"])
        qf_losses = (qf_values - next_q_value).square().mean(1)  # of Q1 and of Q2
        self.critic_optimizer.zero_grad()
        qf_losses.sum().backward()
        self.critic_optimizer.step()
        return {"qf1_values": qf_values[0], "qf_loss": qf_losses}

    def update_actor(self, data):
        """A step of the policy and of all target networks. Returns tensors to log."""
        args = self.args
        features = self.actor.features(data["observation"], data["desired_goal"])
        self.critics.requires_grad_(False)  # they need no gradient of the policy's loss
        actions, preactivation = self.actor.get_action(features)
        penalty = args.preactivation_penalty * preactivation.square().mean()
        actor_loss = penalty - self.critics(features, actions, number=1).mean()
        losses = {}
        if args.bc_weight > 0:  # the last transitions are those of demonstrations
            difference = (actions - data["action"])[-DEMO_BATCH_SIZE:]
            losses["bc_loss"] = (difference / self.actor.action_scale).square().sum(1).mean()
            actor_loss = actor_loss + args.bc_weight * losses["bc_loss"]
        self.actor_optimizer.zero_grad()
        actor_loss.backward()
        self.actor_optimizer.step()
        self.critics.requires_grad_(True)
        polyak_update(self.actor_target, self.actor, args.tau)
        polyak_update(self.critics_target, self.critics, args.tau)
        return losses | {"actor_loss": actor_loss, "preactivation": preactivation.abs()}


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
    agent = TD3(args, env, device)
    criterion = "collision_free_success_rate" if args.contact_cost else "success_rate"
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
