"""Policies in scenes that they never saw, without and with a last layer: docs/unseen_obstacles.md.

    python benchmarks/unseen_obstacles.py --keep runs/RUN         # a run of dagger.py: its policy
    python benchmarks/unseen_obstacles.py --workers 2             # hours; what is done is skipped
    python benchmarks/unseen_obstacles.py --only random_boxes_hard --num 10000 --workers 2
    python benchmarks/unseen_obstacles.py --table                 # only writes the tables

Each cell is a call of `clean_rl_scripts/evaluate.py` on the first `--num` test queries, goal
`combined`. Results go to docs/unseen_obstacles.json at once; the tables in
docs/unseen_obstacles.md, between its marks, are of what is there. Nothing may be chosen by them:
for that there is `evaluate.py --split validation`.
"""

import argparse
import csv
import datetime
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from roboarm_nmp import envs
from roboarm_nmp.envs.datasets.roadmap_paths import load_roadmap_paths
from roboarm_nmp.envs.networks.exported_networks import to_float16
from roboarm_nmp.envs.perception.encoders import PRETRAINED
from roboarm_nmp.envs.policies.registry import PolicyError, find_policy
from roboarm_nmp.envs.policies.safety_filter import VERSION
from roboarm_nmp.envs.utils.files import write_atomically

ROOT = Path(__file__).resolve().parent.parent
RESULTS, PAGE = (ROOT / "docs" / f"unseen_obstacles.{ending}" for ending in ("json", "md"))
BASELINES = ROOT / "docs" / "baselines.json"
PAPER_CELLS = ROOT / "benchmarks" / "paper_cells.csv"
POLICIES = ROOT / "envs" / "policies" / "pretrained"
HARD = "random_boxes_hard"
# What a last layer around any policy keeps: see docs/experiments.md.
OBSTACLES = ["--safety-margin", "0.01"]
POINTS = ["--safety-margin", "0.01", "--encoder", "points"]
STRAIGHT = ["--policy", "go-to-goal", "--goal-type", "combined"]
PLANNER = ["--policy", "planner", "--goal-type", "combined"]
CELLS = {
    "reactive, points, no way out": [*STRAIGHT, *POINTS, "--no-escape"],
    "reactive, points": [*STRAIGHT, *POINTS],
    "reactive, obstacles, no way out": [*STRAIGHT, *OBSTACLES, "--no-escape"],
    "reactive, obstacles": [*STRAIGHT, *OBSTACLES],
    "look, then plan": [*PLANNER, "--encoder", "points"],
    "look, then plan, field": [*PLANNER, "--encoder", "field"],
    "RRT-Connect": PLANNER,
}
# What the layer around a policy of bc.py with an encoder knows.
BC_LAYERS = {"vae": POINTS, "vqvae": POINTS, "pointnet2": POINTS, "oracle": OBSTACLES}
for _encoder, _layer in BC_LAYERS.items():
    _flags = ["--policy", f"bc-combined-{_encoder}-{HARD}-s1"]
    CELLS |= {
        f"bc, {_encoder}, alone": _flags,
        f"bc, {_encoder}, no way out": [*_flags, *_layer, "--no-escape"],
        f"bc, {_encoder}": [*_flags, *_layer],
    }
TOLD = "dagger, points told by field"  # trained with points that are seen
SEES = "dagger, points"
# The same training with other seeds (the first learned from older roadmaps): in `HARD` only.
SEEDS = {f"{SEES}, seed {_seed}": f"dagger-combined-points-{HARD}-s{_seed}" for _seed in (2, 3)}
CELLS |= {_name: ["--policy", _policy] for _name, _policy in SEEDS.items()}
for _name, _policy, _layer, _encoder in (
    ("dagger, vae", f"vae-{HARD}", POINTS[:2], []),
    ("dagger, vqvae", f"vqvae-{HARD}", POINTS[:2], []),
    ("dagger, pointnet2", f"pointnet2-{HARD}", POINTS[:2], []),
    ("dagger, field", f"field-{HARD}", POINTS[:2], []),
    (TOLD, f"points-{HARD}", POINTS[:2], ["--encoder", "field"]),
    (SEES, f"points-{HARD}", POINTS[:2], []),
    ("dagger, points, mixed scenes", "points-mixed_scenes", POINTS[:2], []),
    ("dagger, oracle", f"oracle-{HARD}", OBSTACLES, []),
):
    _flags = ["--policy", f"dagger-combined-{_policy}-s1", *_encoder]
    CELLS |= {
        f"{_name}, alone": [*_flags, "--safety-margin", "0"],
        f"{_name}, no way out": [*_flags, *_layer, "--no-escape"],
        _name: _flags,  # its own layer
    }
LAYERS = ("alone", "with the layer", "and the way out")
# z_E is less exact than points are.
CELLS[TOLD] = [*CELLS[TOLD], "--safety-margin", "0.015"]
# What stands in the first table: policy, what it knows, what its layer knows, and its cells.
ROWS = (
    ("`go-to-goal`", "nothing", "points", "go-to-goal", "reactive, points"),
    ("`go-to-goal`", "nothing", "the obstacles", "go-to-goal", "reactive, obstacles"),
    ("`bc.py`", "64 numbers (VAE)", "points", "bc, vae, alone", "bc, vae"),
    ("`bc.py`", "64 numbers (VQ-VAE)", "points", "bc, vqvae, alone", "bc, vqvae"),
    ("`bc.py`", "64 numbers (PointNet++)", "points", "bc, pointnet2, alone", "bc, pointnet2"),
    ("`bc.py`", "the obstacles", "the obstacles", "bc, oracle, alone", "bc, oracle"),
    (
        *("`dagger.py`", "64 numbers (VAE); points, how near", "points"),
        *("dagger, vae, alone", "dagger, vae"),
    ),
    (
        *("`dagger.py`", "64 numbers (VQ-VAE); points, how near", "points"),
        *("dagger, vqvae, alone", "dagger, vqvae"),
    ),
    (
        *("`dagger.py`", "64 numbers (PointNet++); points, how near", "points"),
        *("dagger, pointnet2, alone", "dagger, pointnet2"),
    ),
    (
        *("`dagger.py`", "64 numbers (field)", "64 numbers (field)"),
        *("dagger, field, alone", "dagger, field"),
    ),
    (
        *("`dagger.py`, with points", "64 numbers (field): points", "64 numbers (field)"),
        *(f"{TOLD}, alone", TOLD),
    ),
    ("`dagger.py`", "points", "points", "dagger, points, alone", "dagger, points"),
    (
        *("`dagger.py`, mixed scenes", "points", "points"),
        *("dagger, points, mixed scenes, alone", "dagger, points, mixed scenes"),
    ),
    ("`dagger.py`", "the obstacles", "the obstacles", "dagger, oracle, alone", "dagger, oracle"),
)
# And in the second one, for every task.
EVERYWHERE = (
    "reactive, points",
    "dagger, points",
    "dagger, points, mixed scenes",
    "dagger, oracle",
    "look, then plan",
)
# In the third one, for tasks with scenes of other kinds, and the random boxes.
WITH_ENCODERS = (
    *("dagger, vae", "dagger, vqvae", "dagger, pointnet2", "dagger, field"),
    *(TOLD, "dagger, points", "dagger, oracle"),
)
UNSEEN = [
    name for name, task in envs.TASKS.items() if name.startswith("random") or not task.trainable
]
# What docs/baselines.json has, too: whatever the goal is said to be, these do the same, and
# `combined` is reached like `ee`.
OF_BASELINES = {
    "go-to-goal": "go-to-goal",
    "look, then plan": "look, then plan, 5 s",
    "RRT-Connect": "RRT-Connect, 5 s",
}
KEPT = (
    *(
        "success_rate",
        "success_rate_interval",
        "collision_free_success_rate",
        "collision_free_success_rate_interval",
    ),
    *("num_queries", "ms_per_action", "planning_seconds", "mean_steps", "path_length"),
    *("env", "encoder", "safety_filter", "seed"),
)
LAYER_MARKS = {1: "\\*", 2: "‡"}  # by the version of the last layer that a result had
ENCODER_MARK = "†"
MARKS = {
    LAYER_MARKS[1]: "with the way out of dead ends as it was before 2026-11-24, without a memory",
    LAYER_MARKS[2]: "with the last layer as it was when it took slow arrivals for dead ends",
    ENCODER_MARK: "with an encoder that has been replaced since",
}
BEGIN, END = "<!-- written by benchmarks/unseen_obstacles.py -->\n", "<!-- until here -->\n"


def keep(run):
    """Put a run's policy where it is found by name, in half precision, with how it was made."""
    training = json.loads((run / "result.json").read_text())
    args = training["args"]
    encoder = args["encoder"].partition(":")[0]
    scenes = load_roadmap_paths(Path(args["paths"])).task  # that it learned from
    name = f"dagger-{args['goal_type']}-{encoder}-{scenes}-s{args['seed']}"
    to_float16(run / "policy.pt", POLICIES / f"{name}.pt")
    made = {"cell": name.rpartition("-")[0], "seed": args["seed"], "steps": training["steps"]}
    made |= {key: training[key] for key in ("policy_step", "validation_success_rate")}
    made |= {"training_seconds": training["seconds"], "date": datetime.date.today().isoformat()}
    folders = ("runs_dir", "resume", "paths")  # on the machine that it was made on
    made["args"] = {key: args[key] for key in args if key not in folders}
    write_atomically(POLICIES / f"{name}.json", (json.dumps(made, indent=1) + "\n").encode())
    results = {
        task: {cell: one for cell, one in cells.items() if name not in one["flags"]}
        for task, cells in load_results().items()
    }
    write_results(results)  # those of an earlier policy of that name are void
    print(f"{POLICIES / name}.pt")


def load_results():
    """Dict of task -> dict of cell's name -> its result."""
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


def write_results(results):
    write_atomically(RESULTS, (json.dumps(results, indent=1) + "\n").encode())


def run(tasks, names, num, workers):
    """Fill in the cells that are missing, or had fewer queries, other flags, an older last layer or
    encoder.

    Those of a policy that is not there are left out.
    """
    for task in tasks:
        for name in names:
            if is_done(load_results().get(task, {}).get(name), name, num):
                continue
            try:
                find_policy(CELLS[name][1])
            except PolicyError:
                print(f"{name}: left out, as there is no policy {CELLS[name][1]}")
                continue
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "result.json"
                command = [sys.executable, ROOT / "clean_rl_scripts" / "evaluate.py", *CELLS[name]]
                command += ["--task", task, "--num-queries", str(num)]
                command += ["--workers", str(workers), "--json", path]
                subprocess.run(command, check=True)
                result = json.loads(path.read_text())
            result = {key: result[key] for key in KEPT}
            result |= {"flags": CELLS[name], "date": datetime.date.today().isoformat()}
            result["encoders"] = digests(result)
            results = load_results()  # again: another run of this may have added to it
            results.setdefault(task, {})[name] = result
            write_results(results)


def is_done(result, name, num):
    if result is None or result["num_queries"] < num or result["flags"] != CELLS[name]:
        return False
    return not is_older(result) and not had_other_encoder(result)


def digests(result):
    """Of the pretrained encoders that a result depends on, by name."""
    knows = result["encoder"], *(result["env"].get(key) for key in ("encoder", "link_distances"))
    files = {name: PRETRAINED / f"{name}.pt" for text in knows if text for name in text.split(":")}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        for name, path in files.items()
        if path.exists()
    }


def had_other_encoder(result):
    """Whether an encoder that it depends on has been replaced since."""
    return "encoders" in result and result["encoders"] != digests(result)


def version_of_layer(result):
    """Of the last layer that a result had; today's, if it had none."""
    layer = result.get("safety_filter")
    if layer is None:
        return VERSION
    # The first two differ in the way out of dead ends only.
    return max(layer.get("version", 1), 1 if layer["escape"] else 2)


def is_older(result):
    """Whether the last layer did otherwise than it does now."""
    return version_of_layer(result) < VERSION


def papers_best():
    """Dict of task -> success of the paper's best policy, sections 5.1 to 5.4.

    On `random_boxes_*` and shelves it knew 64 numbers of the scene; the others it was trained in.
    """
    best = {}
    with open(PAPER_CELLS, newline="") as file:
        for row in csv.DictReader(file):
            if row["mean"]:
                best[row["task"]] = max(best.get(row["task"], 0.0), float(row["mean"]))
    return best


def others_results(baselines):
    """Of cells that other benchmarks ran: dict of task -> dict of cell's name -> its result."""
    found = {
        task: {ours: of[theirs] for ours, theirs in OF_BASELINES.items() if theirs in of}
        for task, of in baselines.items()
    }
    for encoder in BC_LAYERS:
        path = POLICIES / f"bc-combined-{encoder}-{HARD}-s1.json"
        found[HARD][f"bc, {encoder}, alone"] = json.loads(path.read_text())
    return found


def tables(results, others):
    """In Markdown. `others` are the results of `others_results`."""
    results = {task: others.get(task, {}) | results.get(task, {}) for task in envs.TASKS}
    hard, best = results[HARD], papers_best()
    lines = _row("policy", "knows", "its layer", *LAYERS, "ms per action", is_head=True)
    for policy, knows, layer_knows, alone, layered in ROWS:
        cells = [_cell(hard.get(name)) for name in (alone, f"{layered}, no way out", layered)]
        taken = hard.get(layered, {}).get("ms_per_action")
        shown = "not measured" if taken is None else f"{taken:.1f}"
        lines += _row(policy, knows, layer_knows, *cells, shown)
    for policy, knows, name in (
        ("look, then plan", "64 numbers (field)", "look, then plan, field"),
        ("look, then plan", "points", "look, then plan"),
        ("RRT-Connect", "the obstacles", "RRT-Connect"),
    ):
        seconds = f"searches {hard[name]['planning_seconds']:.3f} s" if name in hard else "not run"
        lines += _row(policy, knows, "none", _cell(hard.get(name)), "", "", seconds)
    for names, tasks in (("go-to-goal", *EVERYWHERE), envs.TASKS), (WITH_ENCODERS, UNSEEN):
        lines += ["", *_row("task", "paper's best policy", *names, is_head=True)]
        for task in tasks:
            paper = f"{best[task]:.3f}" if task in best else "none given"
            lines += _row(f"`{task}`", paper, *(_cell(results[task].get(name)) for name in names))
    if any(name in hard for name in SEEDS):
        lines += ["", _of_seeds([hard[name] for name in (SEES, *SEEDS) if name in hard])]
    dates = sorted({result["date"] for cells in results.values() for result in cells.values()})
    lines += ["", f"In brackets, test queries and the 95 % interval of success. To {dates[-1]}."]
    shown = "".join(lines)
    lines += [f"{mark}: {meaning}." for mark, meaning in MARKS.items() if mark in shown]
    return "\n".join(lines) + "\n"


def _of_seeds(results):
    """A sentence: what policies with points have that differ in the seed of their training."""
    text = f"`dagger.py` with points, {len(results)} seeds, `{HARD}`:"
    for words, key in (("success", "success_rate"), ("clean", "collision_free_success_rate")):
        rates = [result[key] for result in results]
        each = ", ".join(f"{rate:.3f}" for rate in rates)
        text += f" {words} {each}, so {statistics.mean(rates):.3f}"
        text += f" ± {statistics.stdev(rates):.3f};"
    counts = ", ".join(f"{result['num_queries']:,}" for result in results)
    return f"{text} of {counts} test queries."


def _row(*cells, is_head=False):
    """Lines of a table."""
    return [f"| {' | '.join(cells)} |", *["|---" * len(cells) + "|"] * is_head]


def _cell(result):
    if result is None:
        return "not run"
    low, high = result["success_rate_interval"]
    rates = f"{result['success_rate']:.3f}, {result['collision_free_success_rate']:.3f}"
    mark = LAYER_MARKS.get(version_of_layer(result), "") + ENCODER_MARK * had_other_encoder(result)
    return f"{rates}{mark} [{result['num_queries']:,}: {low:.3f}, {high:.3f}]"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(envs.TASKS), metavar="TASK")
    parser.add_argument("--cells", nargs="+", choices=list(CELLS), metavar="CELL")
    parser.add_argument("--num", type=int, default=1000, help="queries of a cell")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="run nothing")
    parser.add_argument("--keep", type=Path, metavar="RUN", help="only keep a run's policy")
    args = parser.parse_args()
    if args.keep:
        return keep(args.keep)
    if not args.table:
        if args.only is None or HARD in args.only:
            run([HARD], args.cells or CELLS, args.num, args.workers)
        others = [task for task in args.only or envs.TASKS if task != HARD]
        run(others, args.cells or EVERYWHERE, args.num, args.workers)
        if args.cells is None:
            unseen = [task for task in others if task in UNSEEN]
            run(unseen, WITH_ENCODERS, args.num, args.workers)
    before, _, rest = PAGE.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    others = others_results(json.loads(BASELINES.read_text()))
    page = before + BEGIN + tables(load_results(), others) + END + after
    write_atomically(PAGE, page.encode())
    print(f"{PAGE} written")


if __name__ == "__main__":
    main()
