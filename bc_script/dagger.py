"""Imitation of a roadmap planner, with rounds of DAgger. One file: read it top to bottom.

    python -m roboarm_nmp.demo_generation.roadmaps --task random_boxes_hard --scenes 800 --output roadmaps
    python bc_script/dagger.py --paths roadmaps --encoder oracle

A policy for scenes that it never saw. It learns the direction in which a roadmap's smoothed path
goes on, from configurations anywhere on such paths, and from those that it came to by itself
(DAgger: Ross et al., 2011). It is told what is there (`--encoder`), and how far each link is from
the nearest thing, here and at the goal (`envs.wrappers.LinkDistancesWrapper`). Part of it is a last
layer that keeps links away from things (`envs.policies.safety_filter`). To make an algorithm of your own, copy
this file and change the parts under `# ALGO LOGIC`. Parts between `# SHARED` and `# END SHARED` are
those of `bc_script/bc.py`.
"""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
from tqdm import tqdm

from roboarm_nmp.demo_generation.roadmaps import Roadmap
from roboarm_nmp.envs import panda
from roboarm_nmp.envs.datasets.episodes import observed
from roboarm_nmp.envs.datasets.format import DatasetError
from roboarm_nmp.envs.datasets.queries import Query
from roboarm_nmp.envs.datasets.roadmap_paths import load_roadmap_paths
from roboarm_nmp.envs.networks.operations import NetworkError
from roboarm_nmp.envs.perception.encoders import make_encoder
from roboarm_nmp.envs.perception.geometry_source import find_geometry_source, ground_truth_checker
from roboarm_nmp.envs.policies.safety_filter import PATIENCE, PROGRESS, SafetyFilter
from roboarm_nmp.envs.subgoals import MAX_STEP
from roboarm_nmp.envs.training import flags, protocol, runs


@dataclass
class Args(runs.RunFlags):
    # Those of the run's folder are in `envs/training/runs.py`.
    exp_name: str = "dagger"
    """name of the experiment, part of the run's folder"""

    # The task (the paper's MDP; `docs/environment.md`)
    task: str = "random_boxes_hard"
    """task to evaluate on, one of `envs.TASKS`, or a scene file (docs/your_own_scene.md)"""
    goal_type: Literal["config", "combined"] = "combined"
    """what the goal is: configuration, or that and the end-effector's position"""
    paths: Path = Path("roadmaps")
    """folder of roadmap paths to learn from (demo_generation.roadmaps), in whatever scenes"""

    # The algorithm
    total_updates: flags.PositiveInt = 24_000
    """batches of the whole run"""
    batch_size: flags.PositiveInt = 768
    """examples per batch"""
    learning_rate: flags.PositiveFloat = 1e-3
    """learning rate (Adam) at the start"""
    anneal: bool = True
    """let the learning rate fall linearly, to zero at the end"""
    policy_average: flags.PositiveShare = 0.003
    """share of the policy that moves into its running average per update; the average is what is
    evaluated and saved (1: no averaging)"""
    pool_size: flags.PositiveInt = 200_000
    """examples at hand, of which batches are drawn"""
    examples_per_update: flags.PositiveInt = 256
    """new examples per update, all of one scene; they replace the oldest. With an eighth of a batch
    they are learned by heart (docs/experiments.md)"""
    noise: flags.NonNegativeFloat = 0.03
    """standard deviation of the configurations drawn around paths (normalised, each joint)"""
    length_weight: flags.NonNegativeFloat = 0.1
    """of the second loss, that of the remaining length"""
    encoder: str = "oracle"
    """the scene as the policy receives it, as tokens: `point_cloud` for observed points, `oracle`
    for the ground-truth obstacles, or an encoder's latent code, one token (`vae`, `vqvae`,
    `pointnet2`, `field`, or the path of your own `encoder.pt`)"""
    num_points: flags.PositiveInt = 64
    """points of the encoder `point_cloud`"""
    token_size: flags.Width = 128
    """width of the layers that look at one obstacle or point each"""
    hidden_size: flags.Width = 384
    """width of the residual blocks"""
    num_blocks: flags.Layers = 3
    """number of residual blocks"""
    bf16: bool | None = None
    """train with hidden products in bfloat16; by default where the hardware has it"""
    velocities: ClassVar[bool] = False  # paths have none

    # The last layer
    safety_margin: flags.NonNegativeFloat = 0.01
    """m, that it keeps"""
    escape: bool = True
    """whether it leaves dead ends"""

    # DAgger
    round_every: flags.NonNegativeInt = 2_000
    """updates between rounds (0: none)"""
    round_queries: flags.PositiveInt = 40
    """queries of a round, each in a scene of the paths"""
    round_labels: flags.NonNegativeInt = 16
    """of the states that the policy came to on a query, how many are labelled"""
    round_weight: flags.NonNegativeFloat = 5.0
    """how much likelier such a state is in a batch than an example of the pool"""

    # Evaluation and bookkeeping
    eval_every: flags.PositiveInt = 4_000
    """updates between evaluations on validation queries; the best policy is kept"""
    eval_queries: flags.PositiveInt = 200
    """validation queries per evaluation"""
    test_queries: flags.PositiveInt = 1_000
    """test queries for the best policy at the end"""


# ALGO LOGIC: the policy
class Hidden(nn.Linear):
    """A linear layer whose product is computed in bfloat16 in training, if `bf16`."""

    def __init__(self, num_inputs, num_outputs, bf16):
        super().__init__(num_inputs, num_outputs)
        self.bf16 = bf16

    def forward(self, x):
        if not (self.bf16 and self.training):
            return super().forward(x)
        return F.linear(x.bfloat16(), self.weight.bfloat16(), self.bias.bfloat16()).float()


class Block(nn.Module):
    """A residual block."""

    def __init__(self, size, bf16):
        super().__init__()
        self.norm = nn.LayerNorm(size)
        self.first, self.second = Hidden(size, size, bf16), Hidden(size, size, bf16)

    def forward(self, x):
        return x + self.second(F.relu(self.first(self.norm(x))))


class Actor(nn.Module):
    """Straight to the goal, and a learned direction added to that.

    What is seen of the scene are tokens, obstacles or points, zeros where there is none, or a
    single one, z_E. Each is looked at together with all that is known of the arm; of what comes
    out, the maximum counts (PointNet: Qi et al., 2017).
    """

    def __init__(self, args):
        super().__init__()
        self.token_size = make_encoder(args.encoder, args.num_points).token_size
        low, high = torch.tensor(panda.LOWER), torch.tensor(panda.UPPER)
        self.register_buffer("middle", ((high + low) / 2).float())
        self.register_buffer("half_range", ((high - low) / 2).float())
        size = 10 + {"config": 7, "combined": 10}[args.goal_type] + 28 + 2 * 80
        self.token_in = nn.Linear(self.token_size, args.token_size)
        self.of_arm = nn.Linear(size, args.token_size)
        self.fuse = Hidden(args.token_size, args.token_size, args.bf16)
        self.first = nn.Linear(size + args.token_size, args.hidden_size)
        blocks = (Block(args.hidden_size, args.bf16) for _ in range(args.num_blocks))
        self.blocks = nn.Sequential(*blocks)
        self.head = nn.Linear(args.hidden_size, 8)
        nn.init.zeros_(self.head.weight)  # it begins as go-to-goal
        nn.init.zeros_(self.head.bias)

    def features(self, observation, desired_goal, link_distances, goal_link_distances):
        """What is known of the arm, and of the goal."""
        states = torch.cat([observation[:, :7], desired_goal[:, :7]], dim=1)
        angles = (states.unflatten(1, (2, 7)) * self.half_range + self.middle).flatten(1)
        near = torch.stack([link_distances, goal_link_distances], dim=1)
        near = torch.cat([10.0 * near[..., :1], near[..., 1:]], dim=-1)  # distances are small
        inputs = observation[:, :10], desired_goal, torch.sin(angles), torch.cos(angles)
        return torch.cat([*inputs, near.flatten(1)], dim=1)

    def outputs(self, observation, desired_goal, link_distances, goal_link_distances):
        """The direction (N, 7), of any length, and the length of the rest of the way (N,)."""
        features = self.features(observation, desired_goal, link_distances, goal_link_distances)
        tokens = observation[:, 10:].unflatten(1, (-1, self.token_size))
        seen = F.relu(self.token_in(tokens) + self.of_arm(features).unsqueeze(1))
        seen = F.relu(self.fuse(seen))
        there = (tokens != 0.0).any(dim=2, keepdim=True)
        seen = (seen * there).amax(1)  # (nothing is below zero)
        x = self.blocks(F.relu(self.first(torch.cat([features, seen], dim=1))))
        outputs = self.head(x)
        to_goal = desired_goal[:, :7] - observation[:, :7]
        direction = F.normalize(to_goal, dim=1) + outputs[:, :7]
        return direction, to_goal.norm(dim=1) + F.softplus(outputs[:, 7])

    def forward(
        self, observation, achieved_goal, desired_goal, link_distances, goal_link_distances
    ):
        """The action (N, 7); this is what policy.pt contains."""
        direction, _ = self.outputs(observation, desired_goal, link_distances, goal_link_distances)
        to_goal = (desired_goal[:, :7] - observation[:, :7]).norm(dim=1, keepdim=True)
        return F.normalize(direction, dim=1) * to_goal.clamp(max=MAX_STEP)


# ALGO LOGIC: examples
AHEAD = 0.1  # normalised: an example's direction is to where its path is after so much
PER_PATH = 4  # examples of each path that is chosen: its goal's link_distances serves all of them
STUCK = 5.0  # states that the policy was stuck in are so much likelier to be labelled
DRAW, ROUND = 6, 7  # streams of random numbers; those before belong to demo_generation's files


class Examples:
    """Makes examples, dicts of tensors, a row each:

    `observation` (n, 10), `desired_goal` (n, g), `link_distances` and `goal_link_distances` (n, 10, 8); the
    unit vector to go on, `direction` (n, 7), and the `length` of the rest of the way (n,); the
    number of the `scene` (n,), int64.

    Args:
        paths: `envs.datasets.roadmap_paths.RoadmapPaths`.
        args: the flags.
        device: of the tensors.
    """

    def __init__(self, paths, args, device):
        self.paths, self.args, self.device = paths, args, device
        self.geometry_source = find_geometry_source(
            make_encoder(args.encoder, args.num_points).geometry_source
        )
        self.with_paths = np.flatnonzero(np.diff(paths.path_offsets))  # numbers of scenes
        steps = np.linalg.norm(np.diff(paths.points, axis=0), axis=1)
        steps[paths.offsets[1:-1] - 1] = 1.0  # from the end of a path to the next one: anything
        # Length of all paths up to each point.
        self.travelled = np.concatenate([[0.0], np.cumsum(steps, dtype=np.float64)])

    def draw(self, number):
        """Examples anywhere on the paths of one scene; they depend on seed and `number` only."""
        rng = np.random.default_rng([self.args.seed, DRAW, number])
        scene, first, last = self._choose(rng, -(-self.args.examples_per_update // PER_PATH))
        which = np.arange(self.args.examples_per_update) // PER_PATH
        first, last = first[which], last[which]
        backwards = (rng.random(len(first)) < 0.5)[which]
        rest = rng.random(len(first)) * (self.travelled[last] - self.travelled[first])

        def at(rest):  # the points on the paths from where so much is left
            here = np.where(backwards, self.travelled[first] + rest, self.travelled[last] - rest)
            i = np.clip(np.searchsorted(self.travelled, here, side="right") - 1, first, last - 1)
            share = (here - self.travelled[i]) / (self.travelled[i + 1] - self.travelled[i])
            tail, head = self.paths.points[i], self.paths.points[i + 1]
            return tail + share[:, None] * (head - tail)

        states = at(rest) + self.args.noise * rng.standard_normal((len(first), 7))
        states = np.clip(states, -1.0, 1.0)
        rest = np.maximum(rest - AHEAD, 0.0)
        moves = at(rest) - states
        lengths = np.linalg.norm(moves, axis=1)
        goals = self.paths.points[np.where(backwards, first, last)]
        return self._examples(scene, states, goals, moves / lengths[:, None], lengths + rest)

    def visit(self, actor, env, safety_filter, step):
        """Examples of a round of DAgger, and the share of its queries that the policy reached."""
        rng = np.random.default_rng([self.args.seed, ROUND, step])
        parts, reached, visited = [], [], []

        def act(**observed):
            visited.append(observed["observation"][0, :7].cpu().numpy())
            return actor(**observed)

        while len(reached) < self.args.round_queries:
            number, first, last = self._choose(rng, 1)
            scene, ends = self.paths.scenes[number], self.paths.points[np.r_[first, last]]
            if not ground_truth_checker(scene).is_free(ends, margin=0.001).all():
                continue  # rounded, the environment might refuse it
            query = Query(*panda.denormalise(ends).astype(np.float32), scene)
            visited.clear()
            seed = int(rng.integers(2**32))  # of the ways out of dead ends
            result = protocol.evaluate(act, [env], [query], self.device, safety_filter, seed)
            reached.append(result["success_rate"])
            states = np.array(visited)
            chances = np.ones(len(states))
            moved = np.linalg.norm(states[PATIENCE:] - states[:-PATIENCE], axis=1)
            chances[PATIENCE:][moved < PROGRESS] = STUCK
            count = min(self.args.round_labels, len(states))
            states = states[rng.choice(len(states), count, False, chances / chances.sum())]
            goals = np.repeat(ends[1:], count, axis=0)
            directions, lengths = Roadmap(scene, rng).labels(states, goals, rng)
            kept = lengths > 0.0  # there is a way, and it is not at the goal
            labelled = (x[kept] for x in (states, goals, directions, lengths))
            parts.append(self._examples(number, *labelled))
        return concat(parts), np.mean(reached)

    def _choose(self, rng, number):
        """A scene, and the first and the last point of some of its paths (number,)."""
        scene = int(rng.choice(self.with_paths))
        path = rng.integers(*self.paths.path_offsets[scene : scene + 2], number)
        return scene, self.paths.offsets[path], self.paths.offsets[path + 1] - 1

    def _examples(self, scene, states, goals, directions, lengths):
        checker = self.geometry_source(self.paths.scenes[scene])
        ends, which = np.unique(goals, axis=0, return_inverse=True)
        observation, _, goal = observed(states, panda.denormalise(goals), self.args.goal_type)
        examples = {
            "observation": observation,
            "desired_goal": goal,
            "link_distances": checker.link_distances(states),
            "goal_link_distances": checker.link_distances(ends)[which],
            "direction": directions.astype(np.float32),
            "length": lengths.astype(np.float32),
            "scene": np.full(len(states), scene),
        }
        return {name: torch.as_tensor(x, device=self.device) for name, x in examples.items()}


def concat(parts):
    """Examples of several dicts in one."""
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def sample(examples, number):
    """So many random ones of them."""
    rows = torch.randint(len(examples["scene"]), (number,), device=examples["scene"].device)
    return {name: tensor[rows] for name, tensor in examples.items()}


def with_scene(batch, latents, token_size):
    """The batch with encoded scenes (scenes, z) in observations, as far as there are any tokens."""
    tokens = latents[batch["scene"]].unflatten(1, (-1, token_size))
    tokens = tokens[:, : max(int((tokens != 0.0).any(2).sum(1).max()), 1)]
    observation = torch.cat([batch["observation"], tokens.flatten(1)], dim=1)
    return batch | {"observation": observation}


# SHARED: averaging
def polyak_update(target_parameters, parameters, tau):
    """target <- (1 - tau) target + tau parameter, all tensors at once."""
    with torch.no_grad():
        torch._foreach_lerp_(target_parameters, parameters, tau)


# END SHARED


# ALGO LOGIC: one update
def update(actor, optimizer, batch, length_weight):
    """One step on a batch of examples; the losses before it, of direction and length."""
    inputs = ("observation", "desired_goal", "link_distances", "goal_link_distances")
    direction, length = actor.outputs(*(batch[name] for name in inputs))
    direction_loss = 1.0 - F.cosine_similarity(direction, batch["direction"]).mean()
    length_loss = F.smooth_l1_loss(length, batch["length"])
    optimizer.zero_grad()
    (direction_loss + length_weight * length_loss).backward()
    optimizer.step()
    return direction_loss, length_loss


if __name__ == "__main__":
    args = runs.parse_args(Args, may_change={"test_queries"})
    device = runs.seed_torch(args)
    runs.resolve_bf16(args)
    validation, test = protocol.load_task(args)
    try:
        geometry_source = make_encoder(args.encoder, args.num_points).geometry_source
    except NetworkError as error:
        sys.exit(f"--encoder: {error}")
    num_draws = args.pool_size // args.examples_per_update
    if num_draws < 1:
        sys.exit("--pool-size must be at least --examples-per-update")
    try:
        paths = load_roadmap_paths(args.paths)
    except DatasetError as error:
        sys.exit(f"--paths: {error}")
    env_arguments = {"goal_type": args.goal_type, "encoder": args.encoder}
    env_arguments |= {"num_points": args.num_points, "geometry_source": geometry_source}
    env_arguments |= {"link_distances": True}
    eval_envs = protocol.make_eval_envs(args.task, len(validation), **env_arguments)
    safety_filter = SafetyFilter(args.safety_margin, args.escape)

    # ALGO LOGIC: network and optimiser
    actor = Actor(args).to(device)
    actor_average = Actor(args).to(device).eval()  # evaluated and saved
    actor_average.load_state_dict(actor.state_dict())
    parameters, average_parameters = list(actor.parameters()), list(actor_average.parameters())
    optimizer = torch.optim.Adam(parameters, lr=args.learning_rate, fused=True)
    visited = {}  # examples of all rounds
    state = {"actor": actor, "actor_average": actor_average, "optimizer": optimizer}
    state |= {"visited": visited}
    run = protocol.PolicyRun(
        args, state, device, env_arguments, eval_envs, validation, safety_filter
    )
    visited |= {name: tensor.to(device) for name, tensor in visited.items()}

    # ALGO LOGIC: data. The pool is not in checkpoints: what was drawn is drawn again.
    latents = torch.as_tensor(eval_envs[0].encoder.encode_demos(paths), device=device)
    examples = Examples(paths, args, device)
    pool = [None] * num_draws
    firsts = range(run.step, run.step + num_draws)
    for number in tqdm(firsts, desc="drawing examples", mininterval=2.0):
        pool[number % num_draws] = examples.draw(number)
    pool = concat(pool)

    run.start(args.total_updates, "update")
    background = ThreadPoolExecutor(1)

    while run.step < args.total_updates:
        # ALGO LOGIC: learn, while the next examples are drawn
        drawn = background.submit(examples.draw, run.step + num_draws)
        if args.anneal:
            remaining = 1.0 - run.step / args.total_updates
            optimizer.param_groups[0]["lr"] = args.learning_rate * remaining
        batch = sample(pool, args.batch_size)
        if visited and len(visited["scene"]):
            weight = args.round_weight * len(visited["scene"])
            count = int(args.batch_size * weight / (weight + len(pool["scene"])))
            batch = concat([sample(visited, count), batch])
            batch = {name: tensor[: args.batch_size] for name, tensor in batch.items()}
        batch = with_scene(batch, latents, actor.token_size)
        direction_loss, length_loss = update(actor, optimizer, batch, args.length_weight)
        polyak_update(average_parameters, parameters, args.policy_average)
        oldest = run.step % num_draws * args.examples_per_update
        for name, tensor in drawn.result().items():
            pool[name][oldest : oldest + len(tensor)] = tensor
        step = run.advance()
        if step % 100 == 0:
            run.log({"losses/direction": direction_loss, "losses/length": length_loss})
            learning_rate = optimizer.param_groups[0]["lr"]
            run.log({"charts/learning_rate": learning_rate, "charts/SPS": int(run.rate)})

        # ALGO LOGIC: a round of DAgger
        if args.round_every and step % args.round_every == 0 and step < args.total_updates:
            # In the last environment: the first one draws, and is slower to change its scene.
            found, reached = examples.visit(actor_average, eval_envs[-1], safety_filter, step)
            visited |= concat([visited, found]) if visited else found
            run.log({"charts/round_success": reached})

        # Evaluate, keep the best policy, checkpoint
        evaluating = step % args.eval_every == 0 or step == args.total_updates
        if evaluating and run.validate(actor_average):
            run.save_policy(actor_average)
        if evaluating or run.interrupted:
            run.checkpoint()
    background.shutdown()
    run.final_test(test)
