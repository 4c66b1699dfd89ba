"""How long until a policy is good? SAC and HER: ours and Stable-Baselines3's.

    pip install -c constraints.txt -e ".[bench]"
    python benchmarks/time_to_success.py --folder time_to_success --workers 2
    python benchmarks/time_to_success.py --folder time_to_success --task double_walls

Each run trains until 0.9 of 200 fresh queries of `no_obstacles` are solved (goal `ee`), or 0.75 of
those of `double_walls`, for at most an hour. The queries have a seed of their own, and are the same
for all. They are solved after every 10,000 environment steps; the clock stands still meanwhile. A
run has a process of its own, and one thread.

- `ours`: `sac_her_mp.py` with default flags, on `double_walls` with `--demo-prob 1 --bc-weight 5`.
- `earlier`: without what makes it fast: hindsight goals are drawn evenly from the rest of an
  episode, the arm's Jacobian is no input of the networks, and no behavioural cloning (`EARLIER`).
- `sb3`: Stable-Baselines3's SAC with its `HerReplayBuffer` and its defaults, but 2,000 random
  steps first, because it needs a whole episode.
- `sb3-ours`: Stable-Baselines3 with our rates, discount, number of environments, updates per step
  and network inputs.

A run that is done has a file in `--folder`, beside the log of its output, and is not repeated. The
table shows the median run over seeds; of an even number of runs, the faster one of the two in the
middle. A figure of the docs shows the success of all runs over time.
"""

import contextlib
import dataclasses
import io
import json
import os
import runpy
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, get_args
from unittest import mock

os.environ["OMP_NUM_THREADS"] = "1"

import matplotlib
import numpy as np
import torch
import tyro
from markdown_tables import NOTHING, ROOT, write_csv
from PIL import Image

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from roboarm_nmp import envs
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.policies.export import save_policy
from roboarm_nmp.training.network_parts import GoalFeatures
from roboarm_nmp.training.runs import Run
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import write_atomically

Learner = Literal["ours", "earlier", "sb3", "sb3-ours"]
LEARNERS = get_args(Learner)
WITH_DEMOS = ("ours", "earlier")
EARLIER = ["--her-exponent", "1", "--no-jacobian", "--bc-weight", "0"]
GOALS = {"no_obstacles": 0.9, "double_walls": 0.75}  # success rates
QUERIES = 200
QUERY_SEED = 20_261_127
INTERVAL = 10_000  # environment steps between evaluations
LIMIT = 3600.0  # s


@dataclasses.dataclass
class Args:
    folder: Path
    """where results are kept, a JSON file per run"""
    task: Literal["no_obstacles", "double_walls"] = "no_obstacles"
    """task; Stable-Baselines3 has no demonstrations, so `double_walls` is for ours"""
    only: tuple[Learner, ...] = ()
    """learners to run, by default all that can learn the task; the table has all in `--folder`"""
    seeds: tuple[flags.Seed, ...] = (1, 2, 3)
    """seeds, one run each"""
    workers: flags.Workers = 1
    """runs at a time, one core each"""
    limit: flags.PositiveFloat = LIMIT
    """seconds of training at most"""
    in_process: bool = False
    """train the first learner with the first seed in this process; the command does so itself"""


@dataclasses.dataclass
class FreshQueries:
    """Queries as `roboarm_nmp.evaluate` takes them."""

    start: np.ndarray
    goal: np.ndarray
    scenes: list  # of `Scene`s


def fresh_queries(task):
    """The `QUERIES` queries that decide, none of which is in the task's file."""
    env, rng = envs.make(task), np.random.default_rng(QUERY_SEED)
    env.reset(seed=0)
    pairs = [env.sample_query(rng) for _ in range(QUERIES)]
    scene = env.unwrapped.scene
    env.close()
    starts, goals = zip(*pairs, strict=True)
    return FreshQueries(np.array(starts), np.array(goals), [scene] * QUERIES)


class Clock:
    """Seconds of training; solves the fresh queries now and then, while the clock stands still."""

    def __init__(self, task, limit):
        self.task = task
        self.goal = GOALS[task]
        self.limit = limit
        self.queries = fresh_queries(task)
        self.curve = []
        self.paused = 0.0  # s
        self.began = 0.0

    def start(self):
        self.began = time.perf_counter()

    @contextlib.contextmanager
    def pause(self):
        now = time.perf_counter()
        yield
        self.paused += time.perf_counter() - now

    def evaluate(self, policy, steps, updates):
        """The result of a policy, as of `roboarm_nmp.evaluate`."""
        seconds = time.perf_counter() - self.began - self.paused
        with self.pause():
            result = evaluate(policy, self.task, queries=self.queries)
        point = {"steps": steps, "updates": updates, "seconds": seconds}
        self.curve.append(point | {"success": result["success_rate"]})
        print(json.dumps(self.curve[-1]), flush=True)
        return result

    @property
    def is_over(self):
        """Whether training ends here: the latest policy is good, or it takes too long."""
        latest = self.curve[-1]
        return latest["success"] >= self.goal or latest["seconds"] >= self.limit


def train_ours(task, seed, clock, changed):
    """Run the trainer as it is, but for the queries that it is validated on."""
    runs = []  # the trainer's only one

    class Done(Exception):
        pass

    def start(run, *args):
        runs.append(run)
        started(run, *args)
        clock.start()

    def save_paused(*args, **options):  # for the evaluation
        with clock.pause():
            save_policy(*args, **options)

    def evaluate_fresh(policy, task, queries):
        (run,) = runs
        steps = max(0, run.step - run.args.learning_starts)
        result = clock.evaluate(policy, run.step, int(steps * run.args.updates_per_step))
        if clock.is_over:
            run.close()
            raise Done
        return result

    started = Run.start
    script = ROOT / "clean_rl_scripts" / "sac_her_mp.py"
    sys.argv = [str(script), "--task", task, "--seed", str(seed), "--eval-every", str(INTERVAL)]
    sys.argv += ["--runs-dir", os.environ["TMPDIR"], "--total-timesteps", "10000000"]
    if task == "double_walls":
        sys.argv += ["--demo-prob", "1", "--bc-weight", "5"]
    sys.argv += changed
    with (
        mock.patch.object(Run, "start", start),
        mock.patch("roboarm_nmp.evaluation.evaluate.evaluate", evaluate_fresh),
        mock.patch("roboarm_nmp.policies.export.save_policy", save_paused),
        contextlib.suppress(Done),
    ):
        runpy.run_path(str(script), run_name="__main__")


class OurFeatures(torch.nn.Module):
    """Stable-Baselines3's features extractor with the inputs of our networks."""

    def __init__(self, observation_space):
        super().__init__()
        self.features = GoalFeatures(envs.make("no_obstacles"))
        self.features_dim = self.features.size

    def forward(self, data):
        return self.features(data["observation"], data["desired_goal"])


def train_peer(name, task, seed, clock):
    """Stable-Baselines3."""
    from stable_baselines3 import SAC, HerReplayBuffer
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env

    from roboarm_nmp.clean_rl_scripts.sac_her_mp import Args as OurArgs
    from roboarm_nmp.clean_rl_scripts.sac_her_mp import discount_factor

    torch.set_num_threads(1)
    args = OurArgs()
    ours = name == "sb3-ours"
    her = {"n_sampled_goal": 4, "goal_selection_strategy": "future"}
    options = {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": her, "seed": seed}
    options |= {"learning_starts": args.learning_starts, "device": "cpu"}  # after the first episode
    number = args.num_envs if ours else 1
    if ours:
        steps = round(1 / args.updates_per_step)
        gamma = discount_factor(args.gamma, PANDA)
        options |= {"learning_rate": args.learning_rate, "gamma": gamma, "tau": args.tau}
        options |= {"train_freq": steps, "gradient_steps": args.num_envs}
        size = [args.hidden_size] * args.num_hidden_layers
        networks = {"features_extractor_class": OurFeatures, "net_arch": size}
        options["policy_kwargs"] = networks

    def policy(observation):
        return model.predict(observation, deterministic=True)[0]

    class Evaluate(BaseCallback):
        def _on_training_start(self):
            clock.start()

        def _on_step(self):
            if self.num_timesteps % INTERVAL >= number:
                return True
            clock.evaluate(policy, self.num_timesteps, model._n_updates)
            return not clock.is_over

    vec_env = make_vec_env(envs.gymnasium_id(task), number, seed=seed)
    model = SAC("MultiInputPolicy", vec_env, **options)
    model.learn(10_000_000, callback=Evaluate())


def run_one(args, name, seed):
    """Train in this process; the result goes to the folder."""
    clock = Clock(args.task, args.limit)
    if name in WITH_DEMOS:
        train_ours(args.task, seed, clock, EARLIER if name == "earlier" else [])
    else:
        train_peer(name, args.task, seed, clock)
    reached = clock.curve[-1]["success"] >= clock.goal
    result = {"task": args.task, "learner": name, "seed": seed, "reached": reached}
    path = file_of(args, name, seed)
    path.write_text(json.dumps(result | clock.curve[-1] | {"curve": clock.curve}, indent=1) + "\n")


def run_in_process(args, name, seed):
    """`run_one` in a process of its own; the trainer's run folder is gone afterwards."""
    command = [sys.executable, __file__, "--in-process", "--folder", str(args.folder)]
    command += ["--task", args.task, "--only", name, "--seeds", str(seed)]
    path = file_of(args, name, seed).with_suffix(".log")
    print(f"{args.task}, {name}, seed {seed}: begins; its output is in {path}", flush=True)
    with tempfile.TemporaryDirectory() as folder, open(path, "w") as log:
        subprocess.run(
            [*command, "--limit", str(args.limit)],
            check=True,
            env=os.environ | {"TMPDIR": folder},
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    print(f"{args.task}, {name}, seed {seed}: ends", flush=True)


def file_of(args, name, seed):
    return args.folder / f"{args.task}-{name}-{seed}.json"


def runs_of(args, names):
    """Learner -> results of its runs, of the learners that have results."""
    runs = {}
    for name in names:
        files = [file_of(args, name, seed) for seed in args.seeds]
        runs[name] = [json.loads(file.read_text()) for file in files if file.exists()]
    return {name: done for name, done in runs.items() if done}


def median(runs):
    """The median run; those that did not reach the goal are the slowest."""
    runs = sorted(runs, key=lambda run: (not run["reached"], run["seconds"]))
    return runs[(len(runs) - 1) // 2]


def rows_of(all_runs):
    """Cells of the table, a row per learner."""
    rows = []
    ours = all_runs.get("ours")
    for name, runs in all_runs.items():
        run = median(runs)
        reached = sum(run["reached"] for run in runs)
        more = "" if run["reached"] else "more than "
        row = [name, f"{reached} of {len(runs)}", f"{more}{run['seconds'] / 60:.1f}"]
        row += [f"{run['steps']:,}", f"{run['updates']:,}", f"{max_success(run):.3f}"]
        ratio = f"{more}{run['seconds'] / median(ours)['seconds']:.1f}" if ours else NOTHING
        rows.append([*row, ratio])
    return rows


def max_success(run):
    return max(point["success"] for point in run["curve"])


def figure_of(task, all_runs):
    """A PNG file's bytes: success over minutes of training, a line per run."""
    figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
    axes.axhline(GOALS[task], color="0.4", linestyle="--", linewidth=1)
    for i, (name, runs) in enumerate(all_runs.items()):
        for run in runs:
            minutes = [0.0] + [point["seconds"] / 60 for point in run["curve"]]
            success = [0.0] + [point["success"] for point in run["curve"]]
            label = name if run is runs[0] else None
            axes.plot(minutes, success, "o-", color=f"C{i}", linewidth=1.2, ms=3, label=label)
    axes.set(xlabel="minutes of training", ylabel=f"success on {task}", xlim=(0, None), ylim=(0, 1))
    axes.grid(alpha=0.3)
    axes.legend(loc="center right")
    contents = io.BytesIO()
    figure.savefig(contents, format="png", dpi=110)
    plt.close(figure)
    few_colours = io.BytesIO()
    Image.open(contents).convert("RGB").quantize(64).save(few_colours, "png", optimize=True)
    return few_colours.getvalue()


def main():
    args = tyro.cli(Args, description=__doc__)
    flags.check(args)
    able = LEARNERS if args.task == "no_obstacles" else WITH_DEMOS  # that can learn the task
    names = args.only or able
    if not set(names) <= set(able):
        sys.exit(f"--only: on {args.task}, with demonstrations, there are {' and '.join(able)}")
    if args.in_process:
        run_one(args, names[0], args.seeds[0])
        return
    args.folder.mkdir(parents=True, exist_ok=True)
    runs = [(name, seed) for seed in args.seeds for name in names]
    waiting = [run for run in runs if not file_of(args, *run).exists()]
    with ThreadPoolExecutor(args.workers) as pool:
        list(pool.map(lambda run: run_in_process(args, *run), waiting))
    head = ["learner", "runs that reached it", "minutes", "environment steps", "updates"]
    head += ["best success rate", "minutes / minutes of `ours`"]
    all_runs = runs_of(args, able)
    name = f"time_to_success_{args.task}"
    write_csv(f"{name}.csv", head, rows_of(all_runs))
    write_atomically(ROOT / "docs" / "figures" / f"{name}.png", figure_of(args.task, all_runs))


if __name__ == "__main__":
    main()
