"""The paper's tables, cell by cell: run any of them, and see ours beside the paper's.

    python benchmarks/paper_tables.py --list                        # the cells, and which are done
    python benchmarks/paper_tables.py --only 'bc-*-double_walls' --steps 150000
    python benchmarks/paper_tables.py --only sac-ee-wall-p1 --seeds 1 2 3 4
    python benchmarks/paper_tables.py                               # only writes the page

A cell is a run: algorithm, goal type, task, p of the demo injection. It is trained with its script
(flags that differ from the defaults: `RECIPES`) in `--runs-dir`, where one that was stopped goes
on. Its best policy by validation goes to envs/policies/pretrained, in half precision, is
evaluated on test queries as it is there, and gets its result beside it, in JSON: what has one is
done, with the same flags and as many steps or more; on more queries than before the same policy is
only evaluated again. (With `--no-keep-policies` the result stays alone.) The page,
docs/benchmark/results.md,
and its figures are made of those results, of the planners' and of `go-to-goal`'s
(benchmarks/results/baselines.json), and of the paper's numbers (`paper_cells.csv`: sections 5.2 and
5.3 and the tables of the appendix; means and standard deviations of four seeds).
"""

import csv
import datetime
import fnmatch
import json
import os
import signal
import statistics
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from roboarm_nmp.envs.datasets.queries import load_queries
from roboarm_nmp.envs.networks.exported_networks import to_float16
from roboarm_nmp.envs.training.evaluation import wilson_interval
from roboarm_nmp.envs.training.flags import PositiveInt, Seed, check
from roboarm_nmp.envs.utils.files import check_folder, write_atomically

ROOT = Path(__file__).resolve().parent.parent
CELLS = ROOT / "benchmarks/results/paper_cells.csv"
POLICIES = ROOT / "envs" / "policies" / "pretrained"
BASELINES = ROOT / "benchmarks/results/baselines.json"
UNSEEN = ROOT / "benchmarks/results/unseen_obstacles.json"
PAGE, FIGURES = ROOT / "docs/benchmark/results.md", ROOT / "docs" / "figures"
SCRIPTS = {
    "bc": ROOT / "bc_script" / "bc.py",
    "sac": ROOT / "clean_rl_scripts" / "sac_her_mp.py",
    "td3": ROOT / "clean_rl_scripts" / "td3_her_mp.py",
}
STEPS = {"bc": "--total-updates", "sac": "--total-timesteps", "td3": "--total-timesteps"}
# Settings for long runs (docs/algorithms).
RECIPES = {
    "bc": ["--eval-every", "25000"],
    "sac": ["--gamma", "0.98", "--target-entropy", "-14", "--num-hidden-layers", "3"],
    "td3": ["--gamma", "0.98", "--num-hidden-layers", "3", "--preactivation-penalty", "0.1"],
}
GOALS = {"ee": "end-effector", "config": "configuration", "combined": "combined"}
ENCODERS = {
    "vae": "VAE",
    "vqvae": "VQ-VAE",
    "pointnet2": "PointNet++",
    "oracle": "the ground-truth obstacles",
}
LINES = {"bc": ":", "sac": "-", "td3": "--"}  # of the curves
FAR_BELOW = 0.05  # of the paper's mean: worth an explanation
# In benchmarks/results/baselines.json; the second in `UNSEEN`.
GO_TO_GOAL, REACTIVE = "go-to-goal", "go-to-goal, filter, point_cloud"
RRT_CONNECT = "RRT-Connect, 5 s"
PLAN_FROM_POINTS = "plan from the point cloud, 5 s"
# Policies in `UNSEEN` beside the paper's encoders. All have a safety filter.
IMITATED = {
    "dagger, vae": "latent code (VAE), link distances from observed points",
    "dagger, vqvae": "latent code (VQ-VAE), link distances from observed points",
    "dagger, pointnet2": "latent code (PointNet++), link distances from observed points",
    "dagger, field": "latent code (field) alone",
    "dagger, decoded by field": "points decoded from the latent code (field)",
    "dagger, point_cloud": "observed points",
    "dagger, oracle": "the ground-truth obstacles",
}
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

    @property
    def paper(self):
        return "not in the paper" if self.mean is None else f"{self.mean:.3f} ± {self.std:.3f}"

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
        given = self.flags()
        for flag, value in dict(zip(given[::2], given[1::2], strict=True)).items():
            had = args.get(flag.removeprefix("--").replace("-", "_"))
            if str(had) != value and not (isinstance(had, float) and had == float(value)):
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
    script, name = SCRIPTS[cell.algorithm], f"{cell.name}-s{seed}"
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
    kept.with_suffix(".pt").unlink(missing_ok=True)
    policy = (kept if keep_policies else folder / kept.name).with_suffix(".pt")
    to_float16(trained / "policy.pt", policy)
    evaluation = evaluate(policy, cell.task, num_queries, folder / "evaluation.json")
    write_result(kept, summary(cell, trained, evaluation))


def policy_file(name, policies, runs_dir):
    """Where a policy is: beside its result, or with its run, if the result stands alone."""
    beside = policies / f"{name}.pt"
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
    return head.stdout.strip() + "+" * (changed != 0)


def curve(run):
    """[[step, validation success], ...] of a run, from TensorBoard's events."""
    events = EventAccumulator(str(run), size_guidance={"scalars": 0}).Reload()
    points = {event.step: round(event.value, 4) for event in events.Scalars("eval/success_rate")}
    return sorted(points.items())


# --- The page


def load_results(folders):
    """Cell's name -> list of results (dicts), by seed."""
    results = {}
    for folder in folders:
        for path in sorted(folder.glob("*.json")):
            result = json.loads(path.read_text())
            result["kept"] = path.with_name(f"{result.get('policy', path.stem)}.pt").exists()
            results.setdefault(result["cell"], []).append(result)
    return {name: sorted(found, key=lambda r: r["seed"]) for name, found in results.items()}


def ours(found):
    """Success over all seeds' queries, and its interval; ± the seeds' deviation."""
    rates = [result["success_rate"] for result in found]
    counts = [result["num_queries"] for result in found]
    successes, count = round(np.dot(rates, counts)), sum(counts)
    rate, (low, high) = successes / count, wilson_interval(successes, count)
    deviation = f" ± {statistics.stdev(rates):.3f}" if len(rates) > 1 else ""
    return f"{rate:.3f}{deviation} [{low:.3f}, {high:.3f}]"


def of_recipe(cell, results):
    """A cell's results: those with its flags; where there are none, those with others."""
    found = results.get(cell.name, [])
    return [result for result in found if cell.is_recipe_of(result["args"])] or found


def mean_success(cell, results):
    """Over the seeds of a cell that was run."""
    return statistics.mean(result["success_rate"] for result in of_recipe(cell, results))


def in_small(cell, found):
    """How many steps and seeds a cell's results have, and whether they had other flags."""
    steps = sorted({result["steps"] for result in found})
    steps = " to ".join(f"{n:,}" for n in (steps[0], steps[-1])[: len(steps)])
    others = "" if cell.is_recipe_of(found[0]["args"]) else ", other flags"
    return f"<sub>{steps} steps, {_seeds(found)}{others}</sub>"


def _seeds(found):
    return f"{len(found)} seed{'s' * (len(found) > 1)}"


def imitated_rows(unseen, tasks):
    """Of `IMITATED`: dict of a row's name -> dict of column's name -> text.

    Other seeds of a policy are cells named like its own, with `, seed 2` and so on.
    """
    rows = {}
    for name, source in IMITATED.items():
        texts = rows[f"DAgger with a safety filter: {source}"] = {}
        for task in tasks:
            cells = unseen.get(task, {})
            found = [cells[key] for key in cells if key == name or key.startswith(f"{name}, seed ")]
            if found:
                number = sum(result["num_queries"] for result in found)
                small = f"<sub>{number:,} queries, {_seeds(found)}</sub>"
                texts[f"`{task}`"] = f"**{ours(found)}**<br>{small}"
    return {name: texts for name, texts in rows.items() if texts}


def table(cells, results, column, baselines, more=()):
    """Markdown: a row per algorithm, a column per `column(cell)`; ours, and the paper's below.

    `more`: further rows, dict of name -> dict of column -> text.
    Where the columns are tasks, `baselines` gives the last rows: each task's results of baselines.
    """
    rows, columns = {}, {}
    for cell in cells:
        columns[column(cell)] = cell.task
        found = of_recipe(cell, results)
        text = f"**{ours(found)}**<br>{in_small(cell, found)}" if found else "not run"
        label = cell.label + (f", {ENCODERS[cell.encoder]}" if cell.encoder else "")
        rows.setdefault(label, {})[column(cell)] = f"{text}<br>{cell.paper}"
    rows |= dict(more)
    lines = ["| | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name, word in (
        *((GO_TO_GOAL, "no learning"), (REACTIVE, "no learning")),
        *((PLAN_FROM_POINTS, "search"), (RRT_CONNECT, "search, ground truth")),
    ):
        known = {text: baselines.get(task, {}).get(name) for text, task in columns.items()}
        if len(set(columns.values())) == len(columns) and any(known.values()):
            rates = {text: f"{one['success_rate']:.3f}" for text, one in known.items() if one}
            rows[f"*{word}: {name}*"] = rates
    for label, texts in rows.items():
        lines.append("| " + " | ".join([label, *(texts.get(name, "") for name in columns)]) + " |")
    return lines


def long_runs(cells, results):
    """A sentence: how long runs with encoders of as many steps as the paper's would take here."""
    hours = {}
    for cell in cells:
        for result in results.get(cell.name, []):
            if cell.encoder and cell.algorithm != "bc":
                rate = result["training_seconds"] / result["steps"]
                hours.setdefault(cell.algorithm.upper(), []).append(LONG_RUN * rate / 3600)
    if not hours:
        return []
    took = ", ".join(f"{name} {statistics.mean(found):.0f} h" for name, found in hours.items())
    return ["", f"A run of {LONG_RUN:,} steps would take, as those that were begun did: {took}."]


def runs_table(cells, results):
    """Markdown: what was run, a row per policy."""
    lines = [
        "| policy | success [95 %] | collision-free | steps (best at) | test queries | training "
        "| made |",
        "|---|---|---|---|---|---|---|",
    ]
    for cell in cells:
        for result in results.get(cell.name, []):
            minutes = result["training_seconds"] / 60
            free = result["collision_free_success_rate"]
            free = "not known" if free is None else f"{free:.3f}"
            name = f"`{cell.name}-s{result['seed']}`" + ("" if result["kept"] else ", not kept")
            if not cell.is_recipe_of(result["args"]):
                name += ", other flags"
            lines.append(
                f"| {name} | {ours([result])} | {free} "
                f"| {result['steps']:,} ({result['policy_step']:,}) | {result['num_queries']:,} "
                f"| {minutes:.0f} min | {result['date']}, {result['commit']} |"
            )
    return lines


def page(cells, results, baselines, unseen):
    """docs/benchmark/results.md."""
    goals = [cell for cell in cells if not cell.encoder and cell.hindsight != "no"]
    lines = [
        "# Results",
        "",
        "![go-to-goal, paper, ours, RRT-Connect](figures/results_story.png)",
        "",
        "Success on test queries: in bold ours with its 95 % interval (of several seeds: over",
        "all their queries, and the seeds' deviation), in small the steps (BC: batches) and seeds",
        "([other flags](#the-runs): only where there is no run with today's);",
        "below it the paper's, mean ± standard deviation of four seeds, after 1,000,000 steps",
        f"({LONG_RUN:,} for random boxes). The last rows are non-learning baselines, which receive",
        "a goal configuration (goal `ee`: [baselines.md](baselines.md)). `" + REACTIVE + "` is",
        "`go-to-goal` with a [safety filter](safety_filter.md) on observed points (goal",
        "`combined`, 200 test queries or more: [unseen_obstacles.md](unseen_obstacles.md)). With",
        "p = 0,",
        "queries are those of the demonstrations, which are not shown; the paper samples them.",
        "`python benchmarks/paper_tables.py` runs cells and writes this page;",
        "`clean_rl_scripts/evaluate.py --policy NAME` runs any policy below that was kept.",
        "Minutes are of one core of an AMD EPYC or Intel Xeon, mostly beside other jobs.",
        "Earlier runs: [lab notebook](../lab_notebook.md#the-first-long-runs).",
        "The words: [glossary.md](glossary.md).",
    ]
    for goal_type, text in GOALS.items():
        chosen = [cell for cell in goals if cell.goal_type == goal_type]
        lines += ["", f"## Goal: {text} (`{goal_type}`)", ""]
        lines += table(chosen, results, lambda cell: f"`{cell.task}`", baselines)
    hindsight = [
        cell
        for cell in cells
        if (cell.algorithm, cell.goal_type, cell.task) == ("sac", "combined", "no_obstacles")
    ]
    lines += ["", "## Hindsight: `no_obstacles`, goal `combined`", ""]
    names = {"yes": "hindsight", "no": "no hindsight"}
    lines += table(hindsight, results, lambda cell: names[cell.hindsight], {})
    lines += ["", "How far learning without hindsight had come when ours stopped:"]
    lines += ["[lab notebook](../lab_notebook.md#demonstrations)."]
    lines += ["", "## Encoders: trained on `random_boxes_hard`, goal `combined`", ""]
    encoded = [cell for cell in cells if cell.encoder]
    imitated = imitated_rows(unseen, dict.fromkeys(cell.task for cell in encoded))
    lines += table(encoded, results, lambda cell: f"`{cell.task}`", baselines, imitated)
    if imitated:
        lines += [
            "",
            "DAgger imitates a roadmap planner in other scenes of `random_boxes_hard`. Unlike the",
            "paper's policies it has a safety filter, which enforces a minimum clearance.",
            "Collision-free success, success without filter, versions of the filter:",
            "[unseen_obstacles.md](unseen_obstacles.md).",
        ]
    lines += long_runs(cells, results)
    lines += ["", "Why policies with a latent code fail to generalise to scenes of other kinds:"]
    lines += ["[lab notebook](../lab_notebook.md#behavioural-cloning-in-scenes-of-other-kinds)."]
    lines += ["", "## The runs", ""]
    done = [cell for cell in cells if cell.name in results]
    if not done:
        return "\n".join([*lines, "None yet.", ""])
    lines += runs_table(cells, results)
    lines += ["", "Flags that are not the scripts' defaults, beside task, goal and p: "]
    lines[-1] += "; ".join(
        f"{name}: `{' '.join(flags)}`" for name, flags in RECIPES.items() if flags
    )
    lines[-1] += ". Each kept policy's JSON has all of its flags, also where it says `other flags`"
    lines[-1] += ": TD3 with goal `ee` there is older than its penalty, others than goal minus"
    lines[-1] += " configuration ([lab notebook](../lab_notebook.md#goal-minus-configuration))."
    lines[-1] += " (The paper's networks have two hidden layers, with encoders four.)"
    below = []
    for cell in done:
        mean = mean_success(cell, results)
        if cell.mean is not None and mean < cell.mean - FAR_BELOW:
            below.append(f"`{cell.name}` ({mean:.3f}, paper {cell.mean:.3f})")
    lines += ["", f"Below the paper by more than {FAR_BELOW}: {', '.join(below) or 'none'}"]
    lines[-1] += " of these runs."
    if below:
        lines[-1] += " What was found: [lab notebook](../lab_notebook.md#demonstrations);"
        lines[-1] += " with encoders, see below their table."
    lines += ["", "![success over steps](figures/results_curves.png)"]
    lines += ["", "![success per task](figures/results_bars.png)", ""]
    return "\n".join(lines)


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
        rates = (papers, [mean_success(c, results) for c in of_task if c.name in results])
        observed = unseen.get(task, {}).get("dagger, point_cloud")
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


def draw_curves(cells, results, path):
    """Validation success over steps: a panel per task, a line per run, a colour per cell."""
    done = [cell for cell in cells if cell.task == cell.trained_on and cell.name in results]
    tasks = list(dict.fromkeys(cell.task for cell in done))
    figure, all_axes = plt.subplots(
        len(tasks), figsize=(9, 2.4 * len(tasks)), squeeze=False, sharex=True, layout="constrained"
    )
    for task, axes in zip(tasks, all_axes[:, 0], strict=True):
        for i, cell in enumerate(cell for cell in done if cell.task == task):
            style = {"marker": ".", "linestyle": LINES.get(cell.algorithm, "-."), "color": f"C{i}"}
            for result in of_recipe(cell, results):
                (line,) = axes.plot(*zip(*result["curve"], strict=True), **style)
            line.set_label(_label(cell))  # once for all seeds
        axes.set(title=task, ylabel="validation success", ylim=(0, 1))
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1, 0.5))
    all_axes[-1, 0].set_xlabel("environment steps (BC: batches)")
    _save(figure, path)


def draw_bars(cells, results, path):
    """Test success per task: ours and the paper's, for all cells that were run."""
    done = [cell for cell in cells if cell.name in results]
    tasks = list(dict.fromkeys(cell.task for cell in done))
    figure, all_axes = plt.subplots(
        len(tasks), figsize=(9, 1 + 0.45 * len(done)), squeeze=False, layout="constrained",
        height_ratios=[sum(cell.task == task for cell in done) for task in tasks],
    )  # fmt: skip
    for task, axes in zip(tasks, all_axes[:, 0], strict=True):
        chosen = [cell for cell in done if cell.task == task][::-1]
        for i, cell in enumerate(chosen):
            mean = mean_success(cell, results)
            axes.barh(i + 0.2, mean, 0.4, color="tab:blue", label="ours")
            if cell.mean is not None:
                axes.barh(i - 0.2, cell.mean, 0.4, xerr=cell.std, color="tab:gray", label="paper")
        axes.set_yticks(range(len(chosen)), [_label(cell) for cell in chosen])
        axes.set(title=task, xlim=(0, 1))
    handles, labels = all_axes[0, 0].get_legend_handles_labels()
    figure.legend(handles[:2], labels[:2], loc="outside lower center", ncols=2)
    _save(figure, path)


def _save(figure, path):
    """A quarter as large as it would be with all colours."""
    figure.savefig(path, dpi=100)
    plt.close(figure)
    with Image.open(path) as image:
        image = image.convert("RGB").quantize(128)
    image.save(path, optimize=True)


def _label(cell):
    encoder = f", {ENCODERS[cell.encoder]}" if cell.encoder else ""
    return f"{cell.label}, {cell.goal_type}{encoder}" + ", no hindsight" * (cell.hindsight == "no")


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


def main():
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
            print(f"{cell.name:60} {cell.paper}   {ours(found) if found else 'not run'}")
        return
    # `kill` ends the trainer too: `subprocess.run` does that for whatever is raised.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("killed; the same command goes on"))
    for cell in chosen:
        for seed in args.seeds:
            try:
                run(cell, seed, args.steps, args.num_queries, args.runs_dir, args.keep_policies)
            except subprocess.CalledProcessError as error:
                sys.exit(f"error: {cell.name}, seed {seed}: exit code {error.returncode}")
            except KeyboardInterrupt:
                sys.exit("interrupted; the same command goes on from the last checkpoint")
    results = load_results(folders)
    baselines, unseen = (json.loads(path.read_text()) for path in (BASELINES, UNSEEN))
    for task, found in unseen.items():
        if REACTIVE in found:
            baselines.setdefault(task, {})[REACTIVE] = found[REACTIVE]
    if results:
        draw_story(cells, results, baselines, unseen, FIGURES / "results_story.png")
        draw_curves(cells, results, FIGURES / "results_curves.png")
        draw_bars(cells, results, FIGURES / "results_bars.png")
    write_atomically(PAGE, page(cells, results, baselines, unseen).encode())
    print(f"{PAGE} written")


if __name__ == "__main__":
    main()
