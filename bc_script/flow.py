"""Flow matching of whole paths, from observed points. One file: read it top to bottom.

    roboarm train flow --task wide_scenes
    python bc_script/flow.py --task wide_scenes    # the same

A network learns to turn noise into the paths of roadmaps (conditional flow matching: Lipman et al.,
2023): straight lines from start to goal, plus a few smooth curves in each joint. It observes points
of the scene, and at every step of the flow the distances of the arm from these points along the
present path (`envs.collision.distance_field`). Other processes make roadmaps in random scenes of
the task while it learns.

The saved policy draws many paths, repairs and checks them in the observed cloud, and follows the
best one with a safety filter (`policies.generative`). For an algorithm of your own, copy this file
and change the parts under `# ALGO LOGIC`; `# SHARED` is as in `roadmap_bc.py`.
"""

import itertools
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from roboarm_nmp.datasets.roadmap_paths import load_roadmap_paths
from roboarm_nmp.envs.perception.encoders import make_encoder
from roboarm_nmp.envs.tasks import task_name
from roboarm_nmp.evaluation.evaluate import evaluate, first_episode_images
from roboarm_nmp.policies.export import save_path_policy
from roboarm_nmp.policies.safety_filter import SafetyFilter
from roboarm_nmp.training.arguments import errors_of, fail, parse_args
from roboarm_nmp.training.devices import adam, seed_torch, set_learning_rate
from roboarm_nmp.training.final_test import RESULTS, finish, load_task
from roboarm_nmp.training.network_parts import Bf16Linear, polyak_update
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
    """a task of `roboarm_nmp.TASKS` or a scene file, in whose validation scenes the policy is
    evaluated; with another arm TASK@FILE, a robot's file"""
    goal_type: Literal["combined"] = "combined"
    """what the goal is: a configuration, which is reached where the end effector is"""
    paths: tuple[Path, ...] = ()
    """learn from these folders of roadmap paths (`roboarm roadmaps`), in scenes of any tasks of the
    same robot, instead of making roadmaps in new scenes of the task"""
    scenes: tuple[str, ...] = ()
    """make roadmaps in random scenes of these tasks in turn; by default of `--task`"""
    stop_at_success: flags.Share | None = None
    """end at the first evaluation with this success rate on the validation queries"""

    # The algorithm
    total_updates: flags.PositiveInt = 20_000
    """batches of the whole run"""
    batch_size: flags.PositiveInt = 256
    """paths per batch, a sixteenth of them from each of 16 scenes"""
    noises: flags.PositiveInt = 3
    """noisy versions of each path in a batch, which share the encoded scene"""
    learning_rate: flags.PositiveFloat = 1e-3
    """learning rate (Adam) at the start; it decreases to zero with a cosine"""
    policy_average: flags.PositiveShare = 0.003
    """share of the network that moves, in each update, into the running average that is evaluated
    and saved (1: no averaging)"""
    collision_weight: flags.NonNegativeFloat = 2.0
    """weight of the second loss, what the predicted path lacks in distance from points"""
    collision_distance: flags.PositiveFloat = 0.035
    """that distance, m"""
    curves: flags.PositiveInt = 12
    """smooth curves in each joint that a path may have"""
    first_scenes: flags.PositiveInt = 32
    """scenes whose paths are made before the first update"""
    pool_scenes: flags.PositiveInt = 400
    """scenes whose paths are in memory, from which batches are sampled; after that, each new scene
    replaces the oldest one"""
    updates_per_scene: flags.PositiveInt = 10
    """updates from one new scene to the next"""
    workers: flags.Helpers = flags.CORES
    """processes that make roadmaps, by default as many as there are cores (0: none beside this
    one); results do not depend on their number"""
    num_points: flags.PositiveInt = 32
    """observed points as tokens"""
    token_width: flags.Width = 128
    """width of the layers that process each token"""
    hidden_size: flags.Width = 384
    """width of the residual blocks"""
    num_blocks: flags.Layers = 3
    """number of residual blocks"""
    bf16: bool | None = None
    """train with hidden layers in bfloat16; by default where that is faster"""

    safety_margin: flags.NonNegativeFloat = 0.003
    """minimum clearance of the links, m, of the safety filter in the saved policy"""

    eval_every: flags.PositiveInt = 5_000
    """updates between evaluations on validation queries"""


# ALGO LOGIC: paths
KNOTS = 31  # configurations that describe a path; straight motions between them are executed
EVERY = 3  # the network sees the distances at each third of them
LINE = 5  # configurations of the straight line at which the scene is encoded


def coefficients(path, basis):
    """Of paths (n, knots, j), what they have of each curve: (n, curves, j)."""
    share = np.linspace(0.0, 1.0, basis.shape[1])[:, None]
    line = path[:, :1] + (path[:, -1:] - path[:, :1]) * share
    return np.einsum("ck,nkj->ncj", basis, path - line) * 2.0 / (basis.shape[1] - 1)


# ALGO LOGIC: the network
class PathNetwork(nn.Module):
    """The path at the flow's end, predicted from a noisy one.

    Tokens are observed points, each processed together with its distances from the arm at the
    beginning, middle and end of the straight line; max-pooling combines them (PointNet).
    """

    middle: torch.Tensor
    half_range: torch.Tensor

    def __init__(self, args, robot, num_spheres):
        super().__init__()
        joints = robot.num_joints
        low, high = torch.tensor(robot.lower), torch.tensor(robot.upper)
        self.register_buffer("middle", ((high + low) / 2).float())
        self.register_buffer("half_range", ((high - low) / 2).float())
        self.register_buffer("frequencies", math.pi / 2 * torch.arange(1.0, 9.0))
        size, hidden = args.curves * joints, args.hidden_size
        query_size = 6 * joints + 1 + LINE * (num_spheres + joints)
        path_size = len(range(EVERY, KNOTS - 1, EVERY)) * (num_spheres + joints)
        self.token_in = nn.Linear(3 + 3 * num_spheres, args.token_width)
        self.query_in = nn.Linear(query_size, args.token_width)
        self.fuse = Bf16Linear(args.token_width, args.token_width, args.bf16)
        self.condition = nn.Linear(query_size + args.token_width, hidden)
        self.first = nn.Linear(size + path_size + 16, hidden)
        self.blocks = nn.ModuleList()
        for _ in range(args.num_blocks):
            layers = [Bf16Linear(hidden, hidden, args.bf16) for _ in range(2)]
            self.blocks.append(nn.Sequential(nn.LayerNorm(hidden), layers[0], nn.SiLU(), layers[1]))
        self.norm = nn.LayerNorm(hidden)
        self.head = nn.Linear(hidden, size)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def encode(self, start, goal, scene, line_centres, line_distances, line_uphill):
        """The query and its scene: (n, hidden)."""
        query = [start, goal, (goal - start).norm(dim=1, keepdim=True)]
        for states in (start, goal):
            angles = states * self.half_range + self.middle
            query += [angles.sin(), angles.cos()]
        query.append(10.0 * line_distances.flatten(1) - 1.0)
        query.append((2.0 * line_uphill).clamp(-3.0, 3.0).flatten(1))
        query = torch.cat(query, dim=1)
        points = scene.unflatten(1, (-1, 3))
        centres = line_centres[:, :: LINE // 2].flatten(1, 2)
        nearness = torch.exp(-8.0 * torch.cdist(points, centres))
        tokens = self.token_in(torch.cat([points, nearness], dim=2))
        tokens = self.fuse(F.relu(tokens + self.query_in(query).unsqueeze(1)))
        no_token = (points == 0.0).all(dim=2, keepdim=True)
        pooled = F.relu(tokens.masked_fill(no_token, 0.0).amax(1))
        return self.condition(torch.cat([query, pooled], dim=1))

    def predict(self, condition, noisy, time, distances, uphill):
        """The path's coefficients (n, curves * j), from noisy ones at a time in [0, 1), (n, 1)."""
        phases = time * self.frequencies
        inputs = [noisy, phases.sin(), phases.cos(), 10.0 * distances.flatten(1)]
        inputs.append((2.0 * uphill).clamp(-3.0, 3.0).flatten(1))
        x = self.first(torch.cat(inputs, dim=1)) + condition
        for layers in self.blocks:
            x = x + layers(x)
        # What would be best without a condition: a share of the noisy path.
        share = time / ((1.0 - time) ** 2 + time**2)
        return self.head(F.silu(self.norm(x))) + noisy * share

    def forward(self, noisy, time, distances, uphill, **query):
        """`predict`; policy.onnx contains this function."""
        return self.predict(self.encode(**query), noisy, time, distances, uphill)


LOG_SECONDS = 10  # between two logs of the losses

if __name__ == "__main__":
    args = parse_args(Args, may_change={"test_queries", "workers"})
    device = seed_torch(args)
    validation, test = load_task(args)
    if device.type != "cpu":
        fail("--device: the distances along paths are computed on the CPU, so it must be cpu")
    if args.first_scenes > args.pool_scenes:
        fail("--first-scenes must be at most --pool-scenes")
    robot = validation.scenes.base.robot
    encoder = make_encoder("point_cloud", args.num_points)
    with errors_of("--paths"):
        paths = load_roadmap_paths(args.paths, robot) if args.paths else None
    safety_filter = SafetyFilter(args.safety_margin, escape=False)

    # Here, because SciPy and Numba take a while to import, which --help would wait for.
    from roboarm_nmp.demo_generation.roadmap_examples import WholePaths
    from roboarm_nmp.envs.collision.distance_field import HINGE, DistanceField

    # ALGO LOGIC: network and optimiser
    distance_field = DistanceField(robot)
    network = PathNetwork(args, robot, distance_field.num_spheres).to(device)
    average = PathNetwork(args, robot, distance_field.num_spheres).to(device).eval()
    average.load_state_dict(network.state_dict())
    optimizer = adam(network.parameters(), args.learning_rate, device)
    scale = torch.zeros(args.curves)  # standard deviations of the curves' coefficients
    progress = {"evaluated": 0, "best": -1.0, "best_step": 0}
    state = {"network": network, "average": average, "optimizer": optimizer, "scale": scale}
    run = Run(args, task_name(args.task), {**state, "progress": progress})

    # ALGO LOGIC: data. The pool is not in checkpoints: a resumed run makes the same paths again.
    pool: dict[str, np.ndarray] = {}  # (pool_scenes, ...): paths, and what is observed of scenes

    def add_scene(number, arrays):
        """Add scene `number` to the pool, in place of the oldest when all are there."""
        for name, array in arrays.items():
            if name not in pool:
                pool[name] = np.zeros((args.pool_scenes, *array.shape), array.dtype)
            pool[name][number % args.pool_scenes] = array

    make_paths = WholePaths(args.scenes or (args.task,), paths, encoder, args.seed, KNOTS)
    num_scenes = args.first_scenes + run.step // args.updates_per_scene
    oldest = max(num_scenes - args.pool_scenes, 0)
    scenes = workers.in_order(make_paths, itertools.count(oldest), args.workers)
    for number in progress_bar(range(oldest, num_scenes), "roadmaps", unit="scene"):
        add_scene(number, next(scenes))
    # Sines that are zero at both ends.
    basis = np.sin(np.pi * np.outer(np.arange(1, args.curves + 1), np.linspace(0.0, 1.0, KNOTS)))
    if run.step == 0:
        first = pool["path"][: args.first_scenes].reshape(-1, KNOTS, robot.num_joints)
        scale.copy_(torch.from_numpy(coefficients(first, basis).std((0, 2))))
    curves = torch.from_numpy(basis).float() * scale[:, None]  # of whitened coefficients
    line_share = torch.linspace(0.0, 1.0, KNOTS)[:, None]
    weight = (scale / scale.mean()).repeat_interleave(robot.num_joints)

    def knots_of(x, start, goal):
        """Paths (n, knots, j) of whitened coefficients (n, curves * j)."""
        bends = torch.einsum("ck,ncj->nkj", curves, x.unflatten(1, (args.curves, -1)))
        return start[:, None] * (1.0 - line_share) + goal[:, None] * line_share + bends

    def distances_along(path, scene, hinge):
        """Distances (n, k, s) and the way out (n, k, j) along paths (n, k, j) of scenes (n,)."""
        rows = np.repeat(scene, path.shape[1])
        states = path.detach().flatten(0, 1).numpy()
        found = distance_field.distances(states, pool["field"], rows, hinge)
        return [torch.from_numpy(one).unflatten(0, path.shape[:2]) for one in found]

    # ALGO LOGIC: one update
    def update():
        """One step on a batch of paths. Returns the losses before it."""
        # Paths from 16 scenes
        number, known = args.batch_size, min(num_scenes, args.pool_scenes)
        scene = torch.randint(known, (16,)).repeat_interleave(-(-number // 16))[:number].numpy()
        row = torch.randint(pool["path"].shape[1], (number,)).numpy()
        path = torch.from_numpy(pool["path"][scene, row])
        path = torch.where(torch.rand(len(path), 1, 1) < 0.5, path.flip(1), path)
        target = torch.from_numpy(coefficients(path.numpy(), basis)).float().flatten(1)
        target = target / scale.repeat_interleave(robot.num_joints)
        start, goal = path[:, 0], path[:, -1]
        line = start[:, None] + (goal - start)[:, None] * torch.linspace(0, 1, LINE)[:, None]
        centres = torch.from_numpy(distance_field.centres(line.flatten(0, 1).numpy()))
        centres = centres.unflatten(0, line.shape[:2])
        observed = torch.from_numpy(pool["scene"][scene])
        line_distances = distances_along(line, scene, HINGE)
        condition = network.encode(start, goal, observed, centres, *line_distances)
        repeated = [x.repeat_interleave(args.noises, 0) for x in (condition, target, start, goal)]
        condition, target, start, goal = repeated
        scene = scene.repeat(args.noises)
        t = 0.98 * torch.rand(len(target), 1)
        noisy = (1.0 - t) * torch.randn_like(target) + t * target
        seen = knots_of(noisy, start, goal)[:, EVERY : KNOTS - 1 : EVERY]
        predicted = network.predict(condition, noisy, t, *distances_along(seen, scene, HINGE))
        squared = ((predicted - target) ** 2 * weight).mean(1, keepdim=True)
        path_loss = (squared / (1.0 - t + 0.05) ** 2).mean()
        # Of the predicted path: what its spheres lack in distance. The gradient is the field's.
        ahead = knots_of(predicted, start, goal)[:, 2:-2:2]
        distances, uphill = distances_along(ahead, scene, args.collision_distance)
        lacking = (args.collision_distance - distances).clamp(min=0.0).sum(2)
        lacking = lacking - (uphill * (ahead - ahead.detach())).sum(2)
        beyond = (ahead.abs() - 1.0).clamp(min=0.0).sum(2)  # the joints' limits
        collision_loss = (t**2 * (lacking + beyond)).mean()
        optimizer.zero_grad()
        (path_loss + args.collision_weight * collision_loss).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        return {"losses/path": path_loss, "losses/collision": collision_loss}

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
            form = curves, EVERY, LINE, args.num_points
            save_path_policy(latest, average, args.task, safety_filter, *form, origin)
            result = evaluate(latest, args.task, queries=validation, workers=max(args.workers, 1))
            run.log({f"eval/{name}": result[name] for name in RESULTS})
            run.show(success=f"{result['success_rate']:.3f}")
            if args.capture_video:
                images = first_episode_images(latest, args.task, 40, queries=validation)
                run.log_video("eval/episode", images)
            run.interruptible = False
            progress["evaluated"] = run.step
            if result["success_rate"] >= progress["best"]:
                progress |= {"best": result["success_rate"], "best_step": run.step}
                os.replace(latest, run.folder / "policy.onnx")
        enough = 2.0 if args.stop_at_success is None else args.stop_at_success
        if run.step >= args.total_updates or progress["best"] >= enough:
            break

        # ALGO LOGIC: learn, while other processes make the next scene's paths
        rate = args.learning_rate * (0.5 + 0.5 * math.cos(math.pi * run.step / args.total_updates))
        set_learning_rate(optimizer, rate * min(1.0, (run.step + 1) / 200))
        losses = update()
        polyak_update(average, network, max(args.policy_average, 1.0 / (run.step + 2)))
        run.advance()
        if run.step % args.updates_per_scene == 0:
            add_scene(num_scenes, next(scenes))
            num_scenes += 1
        if time.monotonic() - logged > LOG_SECONDS or run.step == 1:
            logged = time.monotonic()
            run.log(losses | {"charts/learning_rate": rate})
            run.log({"charts/SPS": run.rate, "charts/scenes": num_scenes})
        if run.interrupted:
            run.save()
    scenes.close()
    run.save()  # a longer run, which continues this one, knows its best policy
    finish(run, test, progress["best"], progress["best_step"], max(args.workers, 1))
