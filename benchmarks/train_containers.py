"""Train the pretrained policy `dagger-combined-point_cloud-containers-s1`. Read it top to bottom.

    roboarm roadmaps --task containers --scenes 396 --paths-per-scene 100 --margin 0.02 --seed 1 \\
        --output roadmaps/containers
    roboarm roadmaps --task random_boxes_hard --scenes 198 --paths-per-scene 100 --margin 0.02 \\
        --seed 1 --output roadmaps/hard
    python benchmarks/train_containers.py --paths roadmaps/containers roadmaps/hard \\
        --output runs/containers

Network, examples and updates are those of `roboarm train dagger`. What differs:

- Rounds of DAgger run all the time: `--visitors` of the worker processes' jobs are queries on which
  a policy acts, through the safety filter with approach paths. The others draw examples.
- There are as many examples per update as the workers draw, and at least `--draws-per-update`.
- The training ends after `--seconds`; the learning rate decreases with time, not with updates.
- Two policies learn from the same batches. One has the weights of `--initial-policy` at first, the
  other is new. The fine-tuned one acts in the queries; the new one is the pretrained policy, since
  it was better on validation queries (docs/lab_notebook.md, "Containers").
- Roadmaps for labels have nodes on the scene's paths, which lead into narrow places, and the same
  margin as the paths.

So no two runs are the same, whatever the seed. The pretrained policy took 264 s, scenes included,
with an NVIDIA H200 and 16 cores. Its 5,893 updates drew nine times 256 examples each.
"""

import collections
import concurrent.futures
import copy
import json
import multiprocessing
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from roboarm_nmp import envs
from roboarm_nmp.bc_script import dagger
from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.datasets.roadmap_paths import load_roadmap_paths
from roboarm_nmp.demo_generation.roadmap_examples import RoadmapExamples
from roboarm_nmp.demo_generation.roadmaps import Roadmap
from roboarm_nmp.envs.perception.geometry_source import find_geometry_source, ground_truth_checker
from roboarm_nmp.envs.perception.point_clouds import NUM_POINTS, POINT_CLOUD, remember_points
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.networks.exported_networks import save_network
from roboarm_nmp.policies.safety_filter import PATIENCE, PROGRESS, SafetyFilter
from roboarm_nmp.training import protocol
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import write_atomically
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.random_streams import Stream

TASK = "random_boxes_hard"  # in the policies' metadata
EXAMPLES_PER_DRAW = 256  # all of one scene
NOISE = 0.03  # standard deviation of configurations around paths (normalised, each joint)
LENGTH_WEIGHT = 0.1  # of the second loss, that of the remaining length
WARM_UP = 200  # updates in which learning rates grow from zero
SHARE_EVERY = 200  # updates after which the acting policy is renewed
# Share of a policy in its running average, but the mean of the first updates.
POLICY_AVERAGE, FAST_AVERAGE = 0.003, 300
SAFETY_FILTER = SafetyFilter(0.01, escape=True, approach=True)
JOBS_AHEAD, MOST_DRAWS = 4, 64  # draws that wait or run, per worker; between two updates
LABELS_PER_QUERY = 16  # states that are labelled, of those that the policy visits on a query
MARGIN = 0.02  # distance (m) of labels' paths from obstacles
LABEL_NODES, NODES_ON_PATHS = 700, 300  # of roadmaps that label: random ones, and at most on paths
# Labelled states in memory; probability of one in a batch, relative to a drawn example.
VISITED_SIZE, VISITED_WEIGHT = 200_000, 5.0


@dataclass
class Args:
    paths: tuple[Path, ...] = (Path("roadmaps/containers"), Path("roadmaps/hard"))
    """folders of roadmap paths to learn from (`roboarm roadmaps`)"""
    output: Path = Path("runs/containers")
    """folder for fine_tuned.pt, new.pt and made.json"""
    seconds: flags.PositiveFloat = 170.0
    """of the training, from the first update on"""
    workers: flags.Workers = flags.CORES
    """processes that draw examples and act"""
    visitors: flags.PositiveInt = 5
    """queries that wait or run at any time"""
    seed: flags.Seed = 1
    """of examples, queries and weights"""
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    """device of the updates"""
    initial_policy: str = "dagger-combined-point_cloud-random_boxes_hard-s1"
    """the policy that is fine-tuned"""
    learning_rates: tuple[flags.PositiveFloat, flags.PositiveFloat] = (5e-4, 1e-3)
    """at the start (Adam): of the fine-tuned policy, and of the new one"""
    batch_size: flags.PositiveInt = 2048
    """examples per batch"""
    pool_size: flags.PositiveInt = 400_000
    """drawn examples in memory"""
    draws_per_update: flags.PositiveFloat = 2.0
    """updates wait for at least so many"""
    first_draws: flags.PositiveInt = 200
    """draws before the first update"""


def make_env():
    """The policies' environment, and its arguments."""
    kwargs = {"goal_type": "combined", "encoder": POINT_CLOUD, "num_points": NUM_POINTS}
    kwargs |= {"geometry_source": POINT_CLOUD, "link_distances": True}
    return envs.make(TASK, **kwargs), kwargs


def make_actor(env):
    sizes = dagger.Args(encoder=POINT_CLOUD, num_points=NUM_POINTS, bf16=False)
    return dagger.Actor(sizes, env)


# Jobs of the worker processes
class Examples(RoadmapExamples):
    """Examples whose scenes' points stay in memory: the cache has room for fewer scenes."""

    def choose_paths(self, rng, number):
        scene, first, last = super().choose_paths(rng, number)
        remember_points(self.paths.scenes[scene])
        return scene, first, last


def begin(given_args, weights_path):
    global args, examples, env, actor, weights, loaded
    torch.set_num_threads(1)
    args, weights, loaded = given_args, weights_path, None
    paths = load_roadmap_paths(args.paths)
    examples = Examples(paths, find_geometry_source(POINT_CLOUD), args.seed)
    env, _ = make_env()
    actor = make_actor(env).eval()


def draw(number):
    return examples.draw(number, EXAMPLES_PER_DRAW, NOISE)


def visit(number):
    """Act on a random query: labelled states or None, success, and whether there was a contact.

    None alone where the simulator might refuse the query.
    """
    global loaded
    if loaded != (changed := weights.stat().st_mtime_ns):
        actor.load_state_dict(torch.load(weights, weights_only=True))
        loaded = changed
    rng = np.random.default_rng([args.seed, Stream.DAGGER_ROUNDS, number])
    scene_number, first, last = examples.choose_paths(rng, 1)
    scene, ends = examples.paths.scenes[scene_number], examples.paths.points[np.r_[first, last]]
    ends = ends if rng.random() < 0.5 else ends[::-1]
    if not ground_truth_checker(scene).is_free(ends, margin=0.001).all():
        return None
    robot, states, goals = env.unwrapped.robot, [], []

    def act(observation):
        states.append(observation["observation"][: robot.num_joints].copy())
        goals.append(observation["desired_goal"][: robot.num_joints].copy())  # or a pre-grasp
        given = {name: torch.as_tensor(array)[None] for name, array in observation.items()}
        with torch.no_grad():
            return actor(**given)[0].numpy()

    query = Query(*robot.denormalise(ends).astype(np.float32), scene)
    env.reset_specific(*query)
    trajectory = rollout(env, query, SAFETY_FILTER.filter_policy(act, env, rng))
    if not states:  # approach paths alone lead from start to goal
        return None, trajectory.success, trajectory.collides
    states, goals = np.array(states, np.float64), np.array(goals, np.float64)
    likelihood = np.ones(len(states))
    moved = np.linalg.norm(states[PATIENCE:] - states[:-PATIENCE], axis=1)
    likelihood[PATIENCE:][moved < PROGRESS] = dagger.STUCK
    count = min(LABELS_PER_QUERY, len(states))
    chosen = rng.choice(len(states), count, False, likelihood / likelihood.sum())
    nodes = np.concatenate(examples.paths.of_scene(scene_number)).astype(np.float64)
    nodes = nodes[rng.permutation(len(nodes))[:NODES_ON_PATHS]]
    roadmap = Roadmap(scene, rng, LABEL_NODES, margin=MARGIN, more_nodes=nodes)
    labelled = examples.label(scene_number, states[chosen], goals[chosen], rng, roadmap)
    return labelled, trajectory.success, trajectory.collides


class Pool:
    """The last `size` examples, on a device."""

    def __init__(self, size, device):
        self.size, self.device, self.arrays, self.total = size, device, {}, 0

    def __len__(self):
        return min(self.total, self.size)

    def add(self, examples):
        new = dagger.on_device(examples, self.device)
        if not self.arrays:
            self.arrays = {k: v.new_empty((self.size, *v.shape[1:])) for k, v in new.items()}
        count = len(new["scene"])
        rows = (torch.arange(count, device=self.device) + self.total) % self.size
        for name, array in new.items():
            self.arrays[name][rows] = array
        self.total += count

    def sample(self, number):
        rows = torch.randint(len(self), (number,), device=self.device)
        return {name: array[rows] for name, array in self.arrays.items()}


def main(args):
    args.output.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(args.seed)
    device = torch.device(args.device)
    env, kwargs = make_env()
    latents = env.encoder.encode_demos(load_roadmap_paths(args.paths))
    latents = torch.as_tensor(latents, device=device)

    # Two policies, their running averages and their optimisers.
    actors = [make_actor(env) for _ in args.learning_rates]
    protocol.copy_weights(args.initial_policy, actors[0])
    actors = [actor.to(device) for actor in actors]
    averages = [copy.deepcopy(actor).eval() for actor in actors]
    optimizers = [torch.optim.Adam(actor.parameters(), fused=True) for actor in actors]
    folder = tempfile.TemporaryDirectory()
    weights = Path(folder.name) / "weights.pt"

    def share_weights():
        partial = weights.with_suffix(".partial")
        torch.save({name: x.cpu() for name, x in averages[0].state_dict().items()}, partial)
        partial.rename(weights)

    share_weights()
    executor = concurrent.futures.ProcessPoolExecutor(
        args.workers, multiprocessing.get_context("spawn"), begin, (args, weights)
    )
    pool, visited = Pool(args.pool_size, device), Pool(VISITED_SIZE, device)
    drawing, visiting, outcomes = collections.deque(), [], collections.deque(maxlen=100)
    num_drawn, num_visits, step, start = 0, 0, 0, None
    bar = progress_bar(description="training", unit="update")
    while start is None or time.time() < start + args.seconds:
        # New examples.
        while len(drawing) < JOBS_AHEAD * args.workers:
            drawing.append(executor.submit(draw, num_drawn + len(drawing)))
        while len(visiting) < args.visitors and len(pool):
            visiting.append(executor.submit(visit, num_visits))
            num_visits += 1
        for job in [job for job in visiting if job.done()]:
            visiting.remove(job)
            if (result := job.result()) is not None:
                labelled, success, collides = result
                outcomes.append((success, success and not collides))
                if labelled is not None and len(labelled["scene"]):
                    visited.add(labelled)
        wanted = args.first_draws + args.draws_per_update * step
        parts = []
        while drawing and len(parts) < MOST_DRAWS:
            if not drawing[0].done() and num_drawn + len(parts) >= wanted:
                break
            parts.append(drawing.popleft().result())
        if parts:
            pool.add({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
            num_drawn += len(parts)
        if num_drawn < wanted:
            continue

        # One update of each policy.
        start = start or time.time()
        remaining = max(1.0 - (time.time() - start) / args.seconds, 1e-3)
        remaining *= min(1.0, (step + 1) / WARM_UP)
        weight = VISITED_WEIGHT * len(visited)
        count = int(args.batch_size * weight / (weight + len(pool)))
        batch = pool.sample(args.batch_size - count)
        if count:
            batch = dagger.concat([visited.sample(count), batch])
        scenes = latents[batch.pop("scene")]
        batch["observation"] = torch.cat([batch["observation"], scenes], dim=1)
        share = 1 / (step + 1) if step < FAST_AVERAGE else POLICY_AVERAGE
        learners = zip(actors, averages, optimizers, args.learning_rates, strict=True)
        for actor, average, optimizer, rate in learners:
            optimizer.param_groups[0]["lr"] = rate * remaining
            losses = dagger.update(actor, optimizer, batch, LENGTH_WEIGHT)
            dagger.polyak_update(average, actor, share)
        step += 1
        bar.update()
        if step % SHARE_EVERY == 0:
            share_weights()
            reached, collision_free = np.mean(outcomes, axis=0) if outcomes else (np.nan, np.nan)
            loss = f"{losses['losses/direction'].item():.4f}"
            bar.set_postfix(loss=loss, reached=f"{reached:.2f}", free=f"{collision_free:.2f}")
    bar.close()
    executor.shutdown(cancel_futures=True)
    folder.cleanup()

    example = {name: torch.as_tensor(x)[None] for name, x in env.reset(seed=0)[0].items()}
    metadata = {"kind": "policy", "task": TASK, "env": kwargs}
    metadata |= {"safety_filter": SAFETY_FILTER.to_metadata()}
    metadata |= {"script": "dagger", "seed": args.seed, "step": step}
    for name, average in zip(("fine_tuned", "new"), averages, strict=True):
        save_network(args.output / f"{name}.pt", average, example, metadata)
    made = {"updates": step, "drawn": num_drawn, "visited": len(visited), "flags": asdict(args)}
    write_atomically(args.output / "made.json", json.dumps(made, indent=1, default=str).encode())
    print(f"{args.output}: {step} updates")


if __name__ == "__main__":
    main(flags.parse(Args))
