"""The paper's tables, cell by cell: run any of them, and see ours beside the paper's.

    python benchmarks/paper_tables.py --list                        # the cells, and which are done
    python benchmarks/paper_tables.py --only 'bc-*-double_walls' --steps 150000
    python benchmarks/paper_tables.py --only sac-ee-wall-p1 --seeds 1 2 3 4 --workers 2
    python benchmarks/paper_tables.py                  # only writes the tables and figures

A cell is a run: algorithm, goal type, task, p of the demo injection. It is trained with its script
(flags that differ from the defaults: `RECIPES`) in `--runs-dir`, where one that was stopped goes
on. Its best policy by validation goes to src/roboarm_nmp/policies/pretrained, in half precision, is
evaluated on test queries as it is there, and gets its result beside it, in JSON: what has one is
done, with the same flags and as many steps or more; on more queries than before the same policy is
only evaluated again. (With `--no-keep-policies` the result stays alone.) The tables and figures of
docs/benchmark/results.md are made of those results, of the planners' and of `go-to-goal`'s
(benchmarks/results/baselines.json), and of the paper's numbers (`paper_cells.csv`: sections 5.2 and
5.3 and the tables of the appendix; means and standard deviations of four seeds).
"""

import csv
import datetime
import fnmatch
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from baselines import papers_go_to_goal
from markdown_tables import NOTHING, interval, share, table, write
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.evaluation.evaluate import wilson_interval
from roboarm_nmp.networks.export import to_float16
from roboarm_nmp.utils.files import check_folder, write_atomically
from roboarm_nmp.utils.flags import PositiveInt, Seed, Workers, check
from roboarm_nmp.utils.signals import end_with_one_line

ROOT = Path(__file__).resolve().parent.parent
CELLS = ROOT / "benchmarks/results/paper_cells.csv"
POLICIES = ROOT / "src" / "roboarm_nmp" / "policies" / "pretrained"
BASELINES = ROOT / "benchmarks/results/baselines.json"
UNSEEN = ROOT / "benchmarks/results/unseen_obstacles.json"
FIGURES = ROOT / "docs" / "figures"
SCRIPTS = {
    "bc": ROOT / "bc_script" / "bc.py",
    "sac": ROOT / "clean_rl_scripts" / "sac_her_mp.py",
    "td3": ROOT / "clean_rl_scripts" / "td3_her_mp.py",
}
STEPS = {"bc": "--total-updates", "sac": "--total-timesteps", "td3": "--total-timesteps"}
# Settings for long runs (docs/algorithms). As in the paper, hindsight goals are drawn evenly, and
# the arm's Jacobian is no input of the networks.
AS_IN_THE_PAPER = ["--her-exponent", "1", "--no-jacobian"]
RECIPES = {
    "bc": ["--eval-every", "25000"],
    "sac": ["--gamma", "0.98", "--target-entropy", "-14", "--num-hidden-layers", "3"]
    + AS_IN_THE_PAPER,
    "td3": ["--gamma", "0.98", "--num-hidden-layers", "3", "--preactivation-penalty", "0.1"]
    + AS_IN_THE_PAPER,
}
EARLIER_DEFAULTS = {"her_exponent": 1.0, "jacobian": False}  # of runs from before they were flags
GOALS = {"ee": "end-effector", "config": "configuration", "combined": "combined"}
ENCODERS = {
    "vae": "VAE",
    "vqvae": "VQ-VAE",
    "pointnet2": "PointNet++",
    "oracle": "ground-truth obstacles",
}
# What a policy's scene input is computed from. Policies of the fixed scenes have none.
SOURCES = ENCODERS | {"": "none", "oracle": "ground truth (privileged)"}
FAR_BELOW = 0.05  # of the paper's mean: worth an explanation
# In benchmarks/results/baselines.json; the second in `UNSEEN`.
GO_TO_GOAL, REACTIVE = "go-to-goal", "go-to-goal, filter, point_cloud"
RRT_CONNECT = "RRT-Connect, 5 s"
# Rows beside the policies: method, geometry source, whether it searches.
REFERENCES = {
    GO_TO_GOAL: ("*go-to-goal*", "none", "no"),
    RRT_CONNECT: ("*RRT-Connect*", "ground truth (privileged)", "yes"),
}
HEAD = [
    *("task", "method", "geometry source", "search", "success", "95 % interval"),
    *("collision-free", "queries", "seeds (range)", "training steps", "paper's success"),
]
LONG_RUN = 7_000_000  # steps of the paper's runs with encoders (section 5.3)


@dataclass(frozen=True)
class Cell:
    """A number of the paper's tables, and the run that gives ours."""

    algorithm: str
    goal_type: str
    trained_on: str
    task: str
    demo_prob: str
    hindsight: str
    encoder: str
    mean: float | None  # None: the paper has no such cell
    std: float | None

    @property
    def name(self):
        parts = [self.algorithm, self.goal_type, self.encoder, self.trained_on]
        parts.append(self.demo_prob and f"p{self.demo_prob}")
        parts.append("no_hindsight" if self.hindsight == "no" else "")
        parts.append("" if self.task == self.trained_on else f"on-{self.task}")
        return "-".join(filter(None, parts))

    @property
    def label(self):
        """The algorithm as in the paper."""
        name = self.algorithm.upper()
        if self.demo_prob:
            name += " (p = 0)" if self.demo_prob == "0" else f"-MP (p = {self.demo_prob})"
        return name

    def flags(self):
        """Of the trainer, but for the seed and the number of steps."""
        flags = ["--task", self.trained_on, "--goal-type", self.goal_type, *RECIPES[self.algorithm]]
        if self.demo_prob:
            flags += ["--demo-prob", self.demo_prob]
        if self.encoder:  # paper, section 5.3; of a flag that is given twice, the later counts
            flags += ["--encoder", self.encoder, "--num-hidden-layers", "4"]
        if self.hindsight == "no":
            flags += ["--her-probability", "0"]
        return flags

    def is_recipe_of(self, args):
        """Whether a run with the flags `args`, a dict from its JSON, is one of this cell."""
        if self.algorithm not in RECIPES:
            return True  # an algorithm of one's own
        has_configuration = self.algorithm in ("sac", "td3") and self.goal_type != "ee"
        # Goal minus configuration is an input of all runs but the oldest.
        if has_configuration and not args.get("relative_configuration", "plain_networks" in args):
            return False
        args = EARLIER_DEFAULTS | args
        flags = iter(self.flags())
        expected = {}
        for flag in flags:
            name = flag.removeprefix("--").removeprefix("no-").replace("-", "_")
            expected[name] = "False" if flag.startswith("--no-") else next(flags)
        for name, value in expected.items():
            actual = args.get(name)
            is_same_number = isinstance(actual, float) and actual == float(value)
            if str(actual) != value and not is_same_number:
                return False
        return True


def read_cells(path=CELLS):
    """All `Cell`s, in the paper's order."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        row |= {key: float(row[key]) if row[key] else None for key in ("mean", "std")}
    return [Cell(**row) for row in rows]


# --- Running


def run(cell, seed, steps, num_queries, runs_dir, keep_policies=True):
    """Train, evaluate and keep one cell's policy with one seed; what was done is not done again."""
    script = SCRIPTS[cell.algorithm]
    name = f"{cell.name}-s{seed}"
    runs_dir.mkdir(parents=True, exist_ok=True)
    kept = POLICIES / f"{name}.json"
    if kept.exists():
        result = json.loads(kept.read_text())
        if not cell.is_recipe_of(result["args"]):
            print(f"{name}: the one that is kept had other flags")
        elif result["steps"] >= steps:
            evaluate_on_more(kept, result, cell.task, num_queries, runs_dir)
            return
    if cell.task != cell.trained_on:  # a policy of another cell
        trained = replace(cell, task=cell.trained_on)
        run(trained, seed, steps, num_queries, runs_dir, keep_policies)
        policy = policy_file(f"{trained.name}-s{seed}", kept.parent, runs_dir)
        evaluation = evaluate(policy, cell.task, num_queries, runs_dir / f"{name}.json")
        result = json.loads((kept.parent / f"{policy.stem}.json").read_text())
        result |= {"cell": cell.name, "policy": policy.stem, **evaluation}
        result["date"] = datetime.date.today().isoformat()
        write_result(kept, result)
        return
    folder = runs_dir / name
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, script, STEPS[cell.algorithm], str(steps), "--test-queries", "10"]
    begun = [
        path.parent
        for path in sorted(folder.glob("*/args.json"))
        if cell.is_recipe_of(json.loads(path.read_text()))
    ]
    if begun:
        command += ["--resume", begun[-1]]
    else:
        command += [*cell.flags(), "--seed", str(seed), "--runs-dir", folder]
    print(f"{name}: {' '.join(map(str, command[1:]))}", flush=True)
    subprocess.run(command, check=True)
    trained = begun[-1] if begun else max(folder.glob("*/result.json")).parent
    kept.parent.mkdir(exist_ok=True)
    kept.unlink(missing_ok=True)  # a result is never beside another's policy
    kept.with_suffix(".onnx").unlink(missing_ok=True)
    policy = (kept if keep_policies else folder / kept.name).with_suffix(".onnx")
    to_float16(trained / "policy.onnx", policy)
    evaluation = evaluate(policy, cell.task, num_queries, folder / "evaluation.json")
    write_result(kept, summary(cell, trained, evaluation))


def policy_file(name, policies, runs_dir):
    """Where a policy is: beside its result, or with its run, if the result stands alone."""
    beside = policies / f"{name}.onnx"
    return beside if beside.exists() else runs_dir / name / beside.name


def evaluate_on_more(kept, result, task, num_queries, runs_dir):
    """Evaluate the policy of a result again, if that was on fewer test queries."""
    policy = policy_file(result.get("policy", kept.stem), kept.parent, runs_dir)
    if result["num_queries"] >= num_queries:
        print(f"{kept.stem}: done before")
    elif not policy.exists():
        print(f"{kept.stem}: done on {result['num_queries']} queries; its policy is gone")
    else:
        print(f"{kept.stem}: on {num_queries} queries, not {result['num_queries']}", flush=True)
        evaluation = evaluate(policy, task, num_queries, runs_dir / f"{kept.stem}.json")
        write_result(kept, result | evaluation)


def write_result(path, result):
    write_atomically(path, (json.dumps(result, indent=1) + "\n").encode())


def evaluate(policy, task, num_queries, path):
    """A dict of `evaluate.py`: success rates, interval of the first, number of test queries."""
    command = [sys.executable, ROOT / "clean_rl_scripts" / "evaluate.py", "--policy", policy]
    command += ["--task", task, "--num-queries", str(num_queries), "--json", path]
    subprocess.run(command, check=True)
    evaluation = json.loads(path.read_text())
    names = ("success_rate", "success_rate_interval", "collision_free_success_rate", "num_queries")
    return {name: evaluation[name] for name in names}


def summary(cell, run, evaluation):
    """How a run's policy was made and what it reached, a dict."""
    training = json.loads((run / "result.json").read_text())
    return {
        "cell": cell.name,
        "seed": training["args"]["seed"],
        **evaluation,
        "steps": training["steps"],
        "policy_step": training["policy_step"],
        "validation_success_rate": training["validation_success_rate"],
        "training_seconds": training["seconds"],
        "date": datetime.date.today().isoformat(),
        "commit": commit(),
        "curve": curve(run),
        "args": {k: v for k, v in training["args"].items() if k not in ("runs_dir", "resume")},
    }


def commit():
    """The commit that is checked out, with a `+` if code was changed since."""
    git = ["git", "-C", ROOT]
    head = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    code = ("*.py", "constraints.txt")  # not the page and its figures, which the last cell wrote
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", *code]).returncode
    return head.stdout.strip() + ("+" if changed else "")


def curve(run):
    """[[step, validation success], ...] of a run, from TensorBoard's events."""
    events = EventAccumulator(str(run), size_guidance={"scalars": 0}).Reload()
    points = {event.step: round(event.value, 4) for event in events.Scalars("eval/success_rate")}
    return sorted(points.items())


# --- The tables


def load_results(folders):
    """Cell's name -> list of results (dicts), by seed."""
    results = {}
    for folder in folders:
        for path in sorted(folder.glob("*.json")):
            result = json.loads(path.read_text())
            result["kept"] = path.with_name(f"{result.get('policy', path.stem)}.onnx").exists()
            results.setdefault(result["cell"], []).append(result)
    return {name: sorted(found, key=lambda r: r["seed"]) for name, found in results.items()}


def load_references():
    """Baselines' results, and those in unseen scenes: dicts of task -> name -> result."""
    baselines = json.loads(BASELINES.read_text())
    unseen = json.loads(UNSEEN.read_text())
    for task, found in unseen.items():
        if REACTIVE in found:
            baselines.setdefault(task, {})[REACTIVE] = found[REACTIVE]
    return baselines, unseen


def pooled(found):
    """Success, its interval, collision-free success and number of queries, over all seeds.

    Collision-free success is None where a result lacks it.
    """
    counts = [result["num_queries"] for result in found]
    free = [result["collision_free_success_rate"] for result in found]
    rates = [result["success_rate"] for result in found]
    successes, count = round(np.dot(rates, counts)), sum(counts)
    free = None if None in free else np.dot(free, counts) / count
    return successes / count, wilson_interval(successes, count), free, count


def of_recipe(cell, results):
    """A cell's results: those with its flags; where there are none, those with others."""
    found = results.get(cell.name, [])
    return [result for result in found if cell.is_recipe_of(result["args"])] or found


def success_of(cell, results):
    """Over the seeds of a cell that was run."""
    return pooled(of_recipe(cell, results))[0]


def seeds_of(results):
    """The number of a cell's seeds, and the lowest and highest success."""
    rates = [result["success_rate"] for result in results]
    if len(results) == 1:
        return "1"
    return f"{len(results)} ({share(min(rates))} to {share(max(rates))})"


def steps_of(results):
    """How long a cell's results were trained."""
    return " or ".join(f"{steps:,}" for steps in sorted({result["steps"] for result in results}))


def method_of(cell):
    return cell.label + (f" with {ENCODERS[cell.encoder]}" if cell.encoder else "")


def results_table(cells, results, baselines):
    """Markdown: per task a row for each cell that was run, and for each of `REFERENCES`.

    `baselines`: dict of task -> name -> result.
    """
    rows = []
    for task in dict.fromkeys(cell.task for cell in cells):
        of_task = [cell for cell in cells if cell.task == task]
        for cell in of_task:
            if found := of_recipe(cell, results):
                rows.append([f"`{task}`", method_of(cell), SOURCES[cell.encoder], "no"])
                rows[-1] += _numbers(found, seeds_of(found), steps_of(found), cell.mean)
        best = max((c for c in of_task if c.encoder and c.mean is not None), default=None,
                   key=lambda cell: cell.mean)  # fmt: skip
        if best:
            rows.append([f"`{task}`", f"paper's best: {method_of(best)}", SOURCES[best.encoder]])
            rows[-1] += ["no", NOTHING, NOTHING, NOTHING, NOTHING, "4", f"{LONG_RUN:,}"]
            rows[-1] += [share(best.mean)]
        for name, (method, source, search) in REFERENCES.items():
            if one := baselines.get(task, {}).get(name):
                rows.append([f"`{task}`", method, source, search])
                papers = papers_go_to_goal().get(task) if name == GO_TO_GOAL else None
                rows[-1] += _numbers([one], NOTHING, NOTHING, papers)
    return table(HEAD, rows)


def _numbers(found, seeds, steps, paper):
    success, ends, free, count = pooled(found)
    return [share(success), interval(ends), share(free), f"{count:,}", seeds, steps, share(paper)]


def hindsight_table(cells, results):
    """Markdown: SAC on `no_obstacles`, goal `combined`, with and without hindsight."""
    rows = []
    for cell in cells:
        if found := of_recipe(cell, results):
            hindsight = "no" if cell.hindsight == "no" else "yes"
            rows.append([cell.label, hindsight])
            rows[-1] += _numbers(found, seeds_of(found), steps_of(found), cell.mean)
    return table(["method", "hindsight", *HEAD[4:]], rows)


def missing(cells, results):
    """A sentence that names the paper's cells that were not run."""
    tasks = list(dict.fromkeys(cell.task for cell in cells))
    absent = {}
    is_compared = any(cell.hindsight == "no" for cell in cells)
    for cell in cells:
        if cell.mean is not None and cell.name not in results:
            name = method_of(cell)
            if is_compared:
                name += " without hindsight" if cell.hindsight == "no" else " with hindsight"
            absent.setdefault(name, []).append(cell.task)
    if not absent:
        return "All cells of the paper were run."
    everywhere = [name for name, of in absent.items() if len(of) == len(tasks)]
    parts = [", ".join(everywhere)] if everywhere else []
    for name, of in absent.items():
        if name not in everywhere:
            parts.append(f"{name} on {', '.join(f'`{task}`' for task in of)}")
    return f"Not run: {'; '.join(parts)}."


def runs_table(cells, results):
    """Markdown: what was run, a row per policy."""
    rows = []
    for cell in cells:
        for result in results.get(cell.name, []):
            success, ends, free, count = pooled([result])
            row = [f"`{cell.name}-s{result['seed']}`", share(success), interval(ends), share(free)]
            row += [f"{count:,}", f"{result['steps']:,}", f"{result['policy_step']:,}"]
            row += [f"{result['training_seconds'] / 60:.0f}", result["date"], result["commit"]]
            row += ["yes" if result["kept"] else "no"]
            rows.append([*row, "recipe" if cell.is_recipe_of(result["args"]) else "earlier"])
    head = ["policy", *HEAD[4:8], "steps", "best at step", "training (min)", "date", "commit"]
    return table([*head, "pretrained file", "flags"], rows)


def below_table(cells, results):
    """Markdown: cells that are far below the paper's mean."""
    rows = []
    for cell in cells:
        if cell.mean is not None and cell.name in results:
            success = success_of(cell, results)
            if success < cell.mean - FAR_BELOW:
                rows.append([f"`{cell.name}`", share(success), share(cell.mean)])
    return table(["cell", "success", "paper's success"], rows)


def tables(cells, results, baselines):
    """Name -> Markdown of all tables of docs/benchmark/results.md that show the paper's cells."""
    found = {}
    for goal_type in GOALS:
        chosen = [cell for cell in cells if not cell.encoder and cell.goal_type == goal_type]
        chosen = [cell for cell in chosen if cell.hindsight != "no"]
        found[f"paper-{goal_type}"] = results_table(chosen, results, baselines)
        found[f"paper-{goal_type}"] += f"\n\n{missing(chosen, results)}"
    hindsight = [
        cell
        for cell in cells
        if (cell.algorithm, cell.goal_type, cell.task) == ("sac", "combined", "no_obstacles")
    ]
    found["paper-hindsight"] = hindsight_table(hindsight, results)
    found["paper-hindsight"] += f"\n\n{missing(hindsight, results)}"
    encoded = [cell for cell in cells if cell.encoder]
    found["paper-encoders"] = results_table(encoded, results, baselines)
    found["paper-encoders"] += f"\n\n{missing(encoded, results)}"
    found["paper-below"] = below_table(cells, results)
    found["paper-runs"] = runs_table(cells, results)
    return found


def draw_story(cells, results, baselines, unseen, path):
    """Per task: from go-to-goal to RRT-Connect, the paper's best cell, and our best.

    `unseen` (benchmarks/results/unseen_obstacles.json) has policies with point clouds and a safety
    filter.
    """
    tasks = list(dict.fromkeys(cell.task for cell in cells))
    figure, axes = plt.subplots(figsize=(10, 4.5), layout="constrained")
    marks = {
        "paper, the best of its policies": ("D", "tab:gray"),
        "ours, the best of the same cells": ("o", "tab:blue"),
        "ours, point cloud and safety filter; trained on random boxes": ("s", "tab:orange"),
    }
    points = {name: [] for name in marks}
    for x, task in enumerate(tasks):
        known = [baselines.get(task, {}).get(name) for name in (GO_TO_GOAL, RRT_CONNECT)]
        if all(known):
            low, high = (one["success_rate"] for one in known)
            axes.bar(x, high - low, 0.7, low, color="0.9", label="go-to-goal to RRT-Connect")
        of_task = [cell for cell in cells if cell.task == task]
        papers = [cell.mean for cell in of_task if cell.mean is not None]
        rates = (papers, [success_of(c, results) for c in of_task if c.name in results])
        observed = unseen.get(task, {}).get("roadmap BC, point_cloud")
        rates += ([observed["success_rate"]] if observed else [],)
        for name, found in zip(marks, rates, strict=True):
            if found:
                points[name].append((x, max(found)))
    for (name, (marker, color)), found in zip(marks.items(), points.values(), strict=True):
        if found:
            axes.scatter(*zip(*found, strict=True), 60, color=color, marker=marker, label=name)
    axes.set_xticks(range(len(tasks)), [task.replace("_", "\n") for task in tasks])
    axes.set(ylabel="success on test queries", ylim=(0, 1.02))
    handles = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=2, fontsize="small")
    _save(figure, path)


def _save(figure, path):
    """A quarter as large as it would be with all colours."""
    figure.savefig(path, dpi=100)
    plt.close(figure)
    with Image.open(path) as image:
        image = image.convert("RGB").quantize(128)
    image.save(path, optimize=True)


@dataclass
class Args:
    only: tuple[str, ...] = ()
    """run these cells (names, or patterns of names)"""
    seeds: tuple[Seed, ...] = (1,)
    """of the training"""
    steps: PositiveInt = 1_000_000
    """environment steps, or batches"""
    num_queries: PositiveInt = 10_000
    """test queries"""
    runs_dir: Path = Path("runs/paper_tables")
    """where runs are made, and go on"""
    keep_policies: bool = True
    """keep policies among the pretrained ones; otherwise only the results, and policies stay in
    `--runs-dir`"""
    workers: Workers = 1
    """policies at a time; with more than one, each writes its output to a file in `--runs-dir`"""
    tables: bool = True
    """write the tables and figures at the end"""
    list: bool = False
    """list cells and what is done; run none"""


def _check(args, cells):
    """The cells to run. Raises ValueError for arguments that cannot work."""
    check(args)
    chosen = []
    for pattern in args.only:
        found = [cell for cell in cells if fnmatch.fnmatch(cell.name, pattern)]
        if not found:
            raise ValueError(f"no cell is called {pattern}; --list shows them")
        chosen += found
    for cell in chosen:
        available = len(load_queries(cell.task, "test"))
        if args.num_queries > available:
            raise ValueError(f"--num-queries: {cell.task} has {available}, not {args.num_queries}")
    if chosen:
        check_folder(args.runs_dir)
    return list(dict.fromkeys(chosen))


def run_in_turn(cells, seed, args):
    """Run the cells of one policy. Where one fails, the command ends."""
    for cell in cells:
        try:
            run(cell, seed, args.steps, args.num_queries, args.runs_dir, args.keep_policies)
        except subprocess.CalledProcessError as error:
            sys.exit(f"error: {cell.name}, seed {seed}: exit code {error.returncode}")


def run_side_by_side(policies, args):
    """Run cells, `args.workers` policies at a time, each in a process with a log.

    `policies`: dict of (name, seed) -> the policy's cells. Where one fails, the others go on.
    """
    waiting = list(policies)
    running = {}
    failed = []
    options = ["--steps", str(args.steps), "--num-queries", str(args.num_queries)]
    options += ["--runs-dir", args.runs_dir, "--no-tables"]
    if not args.keep_policies:
        options.append("--no-keep-policies")
    try:
        while waiting or running:
            while waiting and len(running) < args.workers:
                name, seed = waiting.pop(0)
                cells = [cell.name for cell in policies[name, seed]]
                command = [sys.executable, __file__, *options, "--seeds", str(seed), "--only"]
                with open(args.runs_dir / f"{name}.log", "wb") as log:
                    running[name] = subprocess.Popen([*command, *cells], stdout=log, stderr=log)
                print(f"{name}: begins; its output is in {log.name}", flush=True)
            time.sleep(0.2)
            for name in [name for name, process in running.items() if process.poll() is not None]:
                code = running.pop(name).returncode
                if code != 0:
                    failed.append(name)
                print(f"{name}: {'ends' if code == 0 else f'exit code {code}'}", flush=True)
    finally:
        for process in running.values():
            process.terminate()
        for process in running.values():
            process.wait()
    if failed:
        sys.exit(f"error: {', '.join(failed)}: {args.runs_dir} has the logs")


def main():
    # The trainer ends too: `subprocess.run` sees to that, whatever is raised.
    end_with_one_line("the same command goes on from the last checkpoint")
    args = tyro.cli(Args, description=__doc__)
    cells = read_cells()
    try:
        chosen = _check(args, cells)
    except ValueError as error:
        sys.exit(f"error: {error}")
    folders = [POLICIES]
    if args.list:
        results = load_results(folders)
        for cell in cells:
            found = of_recipe(cell, results)
            reached = f"ours {pooled(found)[0]:.3f}, seeds: {len(found)}" if found else "not run"
            print(f"{cell.name:60} paper {share(cell.mean)}   {reached}")
        seeds = [len(of_recipe(cell, results)) for cell in cells]
        done = sum(number >= 1 for number in seeds)
        thrice = sum(number >= 3 for number in seeds)
        print(f"{len(cells)} cells: {done} were run, {thrice} of them with three seeds or more")
        return
    policies = {}  # trained once, and evaluated on one task after the other
    for cell in chosen:
        for seed in args.seeds:
            trained = replace(cell, task=cell.trained_on)
            policies.setdefault((f"{trained.name}-s{seed}", seed), []).append(cell)
    if args.workers > 1:
        run_side_by_side(policies, args)
    else:
        for (_, seed), of_policy in policies.items():
            run_in_turn(of_policy, seed, args)
    if not args.tables:
        return
    results = load_results(folders)
    baselines, unseen = load_references()
    if results:
        draw_story(cells, results, baselines, unseen, FIGURES / "results_story.png")
    write(tables(cells, results, baselines))


if __name__ == "__main__":
    main()
