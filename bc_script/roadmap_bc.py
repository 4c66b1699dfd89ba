"""Imitation of roadmap paths: a policy for scenes never seen. One file: read it top to bottom.

    roboarm train roadmap-bc --task random_boxes_hard --stop-at-success 0.9
    python bc_script/roadmap_bc.py --task random_boxes_hard --stop-at-success 0.9    # the same

In one random scene of the task after the other, a probabilistic roadmap plans a few hundred
smoothed paths. The policy imitates the directions of these paths from configurations near them. It
observes the encoded scene (`--encoder`) and the signed distance of each link, here and at the goal
(`envs.wrappers.LinkDistancesWrapper`). Other processes make the roadmaps while this one learns.
A safety filter is part of the saved policy. For an algorithm of your own, copy this file and change
the parts under `# ALGO LOGIC`; `# SHARED` is as in `bc.py`.
"""

import functools
import itertools
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
from roboarm_nmp.datasets.roadmap_paths import load_roadmap_paths
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.envs.perception.encoders import make_encoder
from roboarm_nmp.envs.perception.geometry_source import find_geometry_source
from roboarm_nmp.envs.subgoals import MAX_STEP
from roboarm_nmp.envs.tasks import task_name
from roboarm_nmp.evaluation.evaluate import evaluate, first_episode_images
from roboarm_nmp.networks.export import read_weights
from roboarm_nmp.policies.export import save_policy
from roboarm_nmp.policies.registry import policy_file
from roboarm_nmp.policies.safety_filter import SafetyFilter
from roboarm_nmp.training.arguments import errors_of, fail, parse_args
from roboarm_nmp.training.cuda_graphs import graphed
from roboarm_nmp.training.devices import adam, seed_torch, set_learning_rate, to_device
from roboarm_nmp.training.final_test import RESULTS, finish, load_task
from roboarm_nmp.training.network_parts import Bf16Linear, polyak_update, pose_difference
from roboarm_nmp.training.runs import Run, script_name
from roboarm_nmp.utils import flags, workers
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


# ALGO LOGIC: flags
@dataclass
class Args(RunArgs):
    task: str = "random_boxes_hard"
    """a task of `roboarm_nmp.TASKS` or a scene file, whose random scenes the policy learns in and
    whose validation scenes it is evaluated in; with another arm TASK@FILE, a robot's file"""
    goal_type: Literal["config", "combined", "pose"] = "combined"
    """what the goal is: configuration, that and end-effector position, or end-effector pose"""
    paths: tuple[Path, ...] = ()
    """learn from these folders of roadmap paths (`roboarm roadmaps`), in scenes of any tasks of the
    same robot, instead of making roadmaps in new scenes of the task"""
    initial_policy: str | None = None
    """begin with the weights of this policy of the same sizes: a name, a run's folder or a file"""
    stop_at_success: flags.Share | None = None
    """end at the first evaluation with this success rate on the validation queries"""

    # The algorithm
    total_updates: flags.PositiveInt = 3_000
    """batches of the whole run"""
    batch_size: flags.PositiveInt = 768
    """examples per batch"""
    learning_rate: flags.PositiveFloat = 1e-3
    """learning rate (Adam) at the start"""
    anneal: bool = True
    """decrease the learning rate linearly to zero"""
    policy_average: flags.PositiveShare = 0.003
    """share of the policy that moves, in each of its updates, into the running average that is
    evaluated and saved (1: no averaging)"""
    first_scenes: flags.PositiveInt = 16
    """scenes whose examples are made before the first update"""
    pool_scenes: flags.PositiveInt = 64
    """scenes whose examples are in memory, from which batches are sampled; after that, each new
    scene replaces the oldest one"""
    examples_per_scene: flags.PositiveInt = 4096
    """examples of each scene"""
    updates_per_scene: flags.PositiveInt = 16
    """updates from one new scene to the next; with the default numbers each example is used three
    times, and using them more often causes overfitting (docs/lab_notebook.md)"""
    workers: flags.Helpers = flags.CORES
    """processes that make roadmaps and examples, by default as many as there are cores (0: none
    beside this one); results do not depend on their number"""
    noise: flags.NonNegativeFloat = 0.03
    """standard deviation of the configurations around paths (normalised, each joint)"""
    length_weight: flags.NonNegativeFloat = 0.1
    """weight of the second loss, that of the remaining length"""
    encoder: str = "point_cloud"
    """the encoded scene as tokens: `point_cloud` for observed points, `oracle` for the ground-truth
    obstacles, or an encoder's latent code, a single token (`vae`, `vqvae`, `pointnet2`, `field`, or
    the path of your own `encoder.onnx`)"""
    num_points: flags.PositiveInt = 32
    """points of the encoder `point_cloud`"""
    geometry_source: str | None = None
    """where link distances take the obstacles from: `ground_truth`, `point_cloud`, or an encoder
    with a decoder (`field`, or a path); by default the encoder's own"""
    token_width: flags.Width = 128
    """width of the layers that process each token"""
    hidden_size: flags.Width = 384
    """width of the residual blocks"""
    num_blocks: flags.Layers = 3
    """number of residual blocks"""
    bf16: bool | None = None
    """train with hidden layers in bfloat16; by default where that is faster"""

    # The safety filter
    safety_margin: flags.NonNegativeFloat = 0.01
    """minimum clearance of the links, m"""
    escape: bool = True
    """escape from local minima"""

    eval_every: flags.PositiveInt = 1_000
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
        return x + self.second(F.relu(self.first(self.norm(x))))


class Actor(nn.Module):
    """The unit vector to the goal, plus a learned direction; of a goal pose, the latter alone.

    The encoded scene is a set of tokens, a row each: obstacles, points, or a single latent code. A
    row of zeros is no token. Each token is processed together with the features of the arm, and
    max-pooling combines them (PointNet: Qi et al., 2017).
    """

    middle: torch.Tensor
    half_range: torch.Tensor

    def __init__(self, args, env):
        super().__init__()
        robot = env.unwrapped.robot
        joints = robot.num_joints
        self.num_joints = joints
        self.bf16 = args.bf16
        self.token_size = env.encoder.token_size  # numbers per token
        self.goal_is_pose = args.goal_type == "pose"
        self.arm_size = joints + GOAL_TYPES[args.goal_type].end_effector_size  # in the observation
        low, high = torch.tensor(robot.lower), torch.tensor(robot.upper)
        self.register_buffer("middle", ((high + low) / 2).float())
        self.register_buffer("half_range", ((high - low) / 2).float())
        goal_size = env.observation_space["desired_goal"].shape[0]
        # Sines, cosines and link distances; here and, unless it is a pose, at the goal.
        computed = 2 * joints + int(np.prod(robot.link_distances_shape))
        computed = computed + 6 if self.goal_is_pose else 2 * computed
        size = self.arm_size + goal_size + computed
        self.token_in = nn.Linear(self.token_size, args.token_width)
        self.arm_in = nn.Linear(size, args.token_width)
        self.fuse = Bf16Linear(args.token_width, args.token_width, args.bf16)
        self.first = nn.Linear(size + args.token_width, args.hidden_size)
        blocks = (Block(args.hidden_size, args.bf16) for _ in range(args.num_blocks))
        self.blocks = nn.Sequential(*blocks)
        self.head = nn.Linear(args.hidden_size, joints + 1)
        if not self.goal_is_pose:
            nn.init.zeros_(self.head.weight)  # the initial policy is go-to-goal
            nn.init.zeros_(self.head.bias)

    def features(self, observation, desired_goal, link_distances, goal_link_distances=None):
        """Features of the arm and of the goal (N, size)."""
        joints = self.num_joints
        arm = observation[:, : self.arm_size]
        states = arm[:, :joints]
        distances = link_distances.unsqueeze(1)
        inputs = [arm, desired_goal]
        if self.goal_is_pose:
            inputs.append(5.0 * pose_difference(arm[:, joints:], desired_goal))
        else:
            assert goal_link_distances is not None
            states = torch.cat([states, desired_goal[:, :joints]], dim=1)
            distances = torch.stack([link_distances, goal_link_distances], dim=1)
        angles = (states.unflatten(1, (-1, joints)) * self.half_range + self.middle).flatten(1)
        # The distances themselves, the first number of each link, are small.
        distances = torch.cat([10.0 * distances[..., :1], distances[..., 1:]], dim=-1)
        inputs += [torch.sin(angles), torch.cos(angles), distances.flatten(1)]
        return torch.cat(inputs, dim=1)

    def outputs(self, observation, desired_goal, **distances):
        """The direction (N, n), of any length, and the remaining length of the path (N,)."""
        features = self.features(observation, desired_goal, **distances)
        joints = self.num_joints
        tokens = observation[:, self.arm_size :].unflatten(1, (-1, self.token_size))
        dtype = torch.bfloat16 if self.bf16 and self.training else features.dtype
        arm = self.arm_in(features).to(dtype).unsqueeze(1)
        fused = self.fuse(F.relu(self.token_in(tokens).to(dtype) + arm))
        no_token = (tokens == 0.0).all(dim=2, keepdim=True)
        pooled = F.relu(fused.masked_fill(no_token, 0.0).max(1).values).to(features.dtype)
        x = self.blocks(F.relu(self.first(torch.cat([features, pooled], dim=1))))
        outputs = self.head(x)
        if self.goal_is_pose:
            return outputs[:, :joints], F.softplus(outputs[:, joints])
        to_goal = desired_goal[:, :joints] - observation[:, :joints]
        direction = F.normalize(to_goal, dim=1) + outputs[:, :joints]
        return direction, to_goal.norm(dim=1) + F.softplus(outputs[:, joints])

    def forward(self, observation, achieved_goal, desired_goal, **distances):
        """The action (N, n); policy.onnx contains this function."""
        direction, length = self.outputs(observation, desired_goal, **distances)
        joints = self.num_joints
        if self.goal_is_pose:
            return F.normalize(direction, dim=1) * length.unsqueeze(1).clamp(max=MAX_STEP)
        to_goal = (desired_goal[:, :joints] - observation[:, :joints]).norm(dim=1, keepdim=True)
        return F.normalize(direction, dim=1) * to_goal.clamp(max=MAX_STEP)


# ALGO LOGIC: one update
def update(actor, optimizer, length_weight, batch):
    """One step on a batch of examples. Returns the losses before it."""
    inputs = ("observation", "desired_goal", "link_distances", "goal_link_distances")
    direction, length = actor.outputs(**{name: batch[name] for name in inputs})
    direction_loss = 1.0 - F.cosine_similarity(direction, batch["direction"]).mean()
    length_loss = F.smooth_l1_loss(length, batch["length"])
    optimizer.zero_grad()
    (direction_loss + length_weight * length_loss).backward()
    optimizer.step()
    return {"losses/direction": direction_loss, "losses/length": length_loss}


# ALGO LOGIC: examples in memory
class ExamplePool:
    """The examples of the last `num_scenes` scenes, and the scenes' codes."""

    def __init__(self, num_scenes, token_size, device):
        self.num_scenes = num_scenes
        self.token_size = token_size
        self.device = device
        self.num_added = 0
        self.arrays = {}  # (num_scenes, examples, ...), allocated with the first scene

    def add(self, scene, examples):
        """Add a scene's code (z,) and its examples, in place of the oldest when all are there."""
        arrays = {name: to_device(array, self.device) for name, array in examples.items()}
        arrays["scene"] = to_device(scene, self.device)
        if not self.arrays:
            self.arrays = {
                name: array.new_zeros(self.num_scenes, *array.shape)
                for name, array in arrays.items()
            }
        for name, array in arrays.items():
            self.arrays[name][self.num_added % self.num_scenes] = array
        self.num_added += 1

    def sample(self, number):
        """A batch of random examples, with replacement: a dict of tensors (number, ...)."""
        num_rows = self.arrays["length"].shape[1]
        scenes = min(self.num_added, self.num_scenes)
        scene = torch.randint(scenes, (number,), device=self.device)
        row = torch.randint(num_rows, (number,), device=self.device)
        batch = {name: array[scene, row] for name, array in self.arrays.items() if name != "scene"}
        codes = self.arrays["scene"][scene]
        if self.device.type == "cpu":  # without padding (a CUDA graph needs the same shape always)
            tokens = codes.unflatten(1, (-1, self.token_size))
            most = int((tokens != 0.0).any(2).sum(1).max())
            codes = tokens[:, : max(most, 1)].flatten(1)
        batch["observation"] = torch.cat([batch["observation"], codes], dim=1)
        return batch


def copy_weights(policy, module):
    """Give a module the weights of a policy of the same sizes: `--initial-policy`."""
    with errors_of("--initial-policy"):
        weights = read_weights(policy_file(policy))
        for name, parameter in module.named_parameters():
            if name not in weights or weights[name].shape != parameter.shape:
                raise ValueError(f"{policy}: the sizes of its layers or its goal type are others")
            parameter.data.copy_(torch.from_numpy(weights[name]))


LOG_SECONDS = 10  # between two logs of the losses

if __name__ == "__main__":
    args = parse_args(Args, may_change={"test_queries", "workers"})
    device = seed_torch(args)
    validation, test = load_task(args)
    if args.first_scenes > args.pool_scenes:
        fail("--first-scenes must be at most --pool-scenes")
    robot = validation.scenes.base.robot
    with errors_of("--encoder"):
        encoder = make_encoder(args.encoder, args.num_points)
        encoder.check_robot(robot)
    with errors_of("--geometry-source"):
        geometry_source = args.geometry_source or encoder.geometry_source
        find_checker = find_geometry_source(geometry_source, robot)
    with errors_of("--paths"):
        paths = load_roadmap_paths(args.paths, robot) if args.paths else None
    env_arguments = {
        "goal_type": args.goal_type,
        "encoder": args.encoder,
        "num_points": args.num_points,
        "geometry_source": geometry_source,
        "link_distances": True,
    }
    with errors_of("--encoder"):
        env: Any = roboarm_nmp.make(args.task, **env_arguments)
    safety_filter = SafetyFilter(args.safety_margin, args.escape)

    # ALGO LOGIC: network and optimiser
    actor = Actor(args, env).to(device)
    if args.initial_policy is not None:
        copy_weights(args.initial_policy, actor)
    actor_average = Actor(args, env).to(device).eval()  # evaluated and saved
    actor_average.load_state_dict(actor.state_dict())
    optimizer = adam(actor.parameters(), args.learning_rate, device)
    learn = graphed(functools.partial(update, actor, optimizer, args.length_weight), device)
    progress = {"evaluated": 0, "best": -1.0, "best_step": 0}
    state = {"actor": actor, "actor_average": actor_average, "optimizer": optimizer}
    run = Run(args, task_name(args.task), {**state, "progress": progress})

    # Here, because SciPy and Numba take a while to import, which --help would wait for.
    from roboarm_nmp.demo_generation.roadmap_examples import RoadmapExamples

    # ALGO LOGIC: data. The pool is not in checkpoints: a resumed run makes the same examples again.
    make_examples = RoadmapExamples(
        task=args.task,
        paths=paths,
        encoder=encoder,
        find_checker=find_checker,
        seed=args.seed,
        goal_type=args.goal_type,
        count=args.examples_per_scene,
        noise=args.noise,
    )
    pool = ExamplePool(args.pool_scenes, actor.token_size, device)
    num_scenes = args.first_scenes + run.step // args.updates_per_scene
    pool.num_added = max(num_scenes - args.pool_scenes, 0)
    scenes = workers.in_order(make_examples, itertools.count(pool.num_added), args.workers)
    for _ in progress_bar(range(pool.num_added, num_scenes), "roadmaps", unit="scene"):
        pool.add(*next(scenes))
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
            save_policy(latest, actor_average, args.task, safety_filter, origin, **env_arguments)
            evaluation = {"queries": validation, "workers": max(args.workers, 1)}
            result = evaluate(latest, args.task, **evaluation)
            run.log({f"eval/{name}": result[name] for name in RESULTS})
            bare = evaluate(latest, args.task, safety_filter=False, **evaluation)
            run.log({f"eval/{name}_without_filter": bare[name] for name in RESULTS})
            run.show(success=f"{result['success_rate']:.3f}")
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
        if args.stop_at_success is not None and progress["best"] >= args.stop_at_success:
            break

        # ALGO LOGIC: learn, while other processes make the next scene's examples
        remaining = 1.0 - run.step / args.total_updates if args.anneal else 1.0
        set_learning_rate(optimizer, args.learning_rate * remaining)
        losses = learn(pool.sample(args.batch_size))
        polyak_update(actor_average, actor, args.policy_average)
        run.advance()
        if run.step % args.updates_per_scene == 0:
            pool.add(*next(scenes))
        if time.monotonic() - logged > LOG_SECONDS or run.step == 1:
            logged = time.monotonic()
            run.log(losses | {"charts/learning_rate": args.learning_rate * remaining})
            run.log({"charts/SPS": run.rate, "charts/scenes": pool.num_added})
        if run.interrupted:
            run.save()
    scenes.close()
    run.save()  # a longer run, which continues this one, knows its best policy
    finish(run, test, progress["best"], progress["best_step"], max(args.workers, 1))
