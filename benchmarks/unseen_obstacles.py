"""Policies in unseen scenes, without and with a safety filter: docs/benchmark/unseen_obstacles.md.

    python benchmarks/unseen_obstacles.py --keep runs/RUN         # a run's policy
    python benchmarks/unseen_obstacles.py --workers 2             # hours; what is done is skipped
    python benchmarks/unseen_obstacles.py --only random_boxes_hard --num 10000 --workers 2
    python benchmarks/unseen_obstacles.py --table                 # only writes the tables

Each cell is a call of `clean_rl_scripts/evaluate.py` on the first `--num` test queries, goal
`combined`. Results go to benchmarks/results/unseen_obstacles.json at once; the tables of
docs/benchmark/unseen_obstacles.md show these results. Nothing may be chosen by them: use
`evaluate.py --split validation` for that.
"""

import argparse
import csv
import datetime
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from baselines import STATIC_TASKS, TABULATED
from markdown_tables import NOTHING, interval, share, table, write, write_cells

from roboarm_nmp.datasets.roadmap_paths import load_roadmap_paths
from roboarm_nmp.envs.perception.encoders import PRETRAINED
from roboarm_nmp.networks.export import to_float16
from roboarm_nmp.policies.registry import PolicyError, find_policy
from roboarm_nmp.policies.safety_filter import VERSION
from roboarm_nmp.utils.files import write_atomically

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks/results/unseen_obstacles.json"
BASELINES = ROOT / "benchmarks/results/baselines.json"
PAPER_CELLS = ROOT / "benchmarks/results/paper_cells.csv"
POLICIES = ROOT / "src" / "roboarm_nmp" / "policies" / "pretrained"
HARD = "random_boxes_hard"
# The margin of the safety filter: see docs/lab_notebook.md.
GROUND_TRUTH = ["--safety-margin", "0.01"]
POINT_CLOUD = ["--safety-margin", "0.01", "--geometry-source", "point_cloud"]
STRAIGHT = ["--policy", "go-to-goal", "--goal-type", "combined"]
PLANNER = ["--policy", "planner", "--goal-type", "combined"]
CELLS = {
    "go-to-goal, filter, point_cloud, no escape": [*STRAIGHT, *POINT_CLOUD, "--no-escape"],
    "go-to-goal, filter, point_cloud": [*STRAIGHT, *POINT_CLOUD],
    "go-to-goal, filter, ground_truth, no escape": [*STRAIGHT, *GROUND_TRUTH, "--no-escape"],
    "go-to-goal, filter, ground_truth": [*STRAIGHT, *GROUND_TRUTH],
    "go-to-goal, filter and approach, point_cloud": [*STRAIGHT, *POINT_CLOUD, "--approach"],
    "plan from the point cloud": [*PLANNER, "--geometry-source", "point_cloud"],
    "plan from the decoded cloud, field": [*PLANNER, "--geometry-source", "field"],
    "RRT-Connect": PLANNER,
}
# The filter around policies of bc.py, by encoder.
BC_FILTERS = dict.fromkeys(("vae", "vqvae", "pointnet2"), POINT_CLOUD) | {"oracle": GROUND_TRUTH}
for _encoder, _filter in BC_FILTERS.items():
    _flags = ["--policy", f"bc-combined-{_encoder}-{HARD}-s1"]
    CELLS |= {
        f"bc, {_encoder}, no filter": _flags,
        f"bc, {_encoder}, no escape": [*_flags, *_filter, "--no-escape"],
        f"bc, {_encoder}": [*_flags, *_filter],
    }
DECODED = "roadmap BC, decoded by field"  # trained with observed points
OBSERVED = "roadmap BC, point_cloud"
# The same training with other seeds (the first learned from older roadmaps): in `HARD` only.
SEEDS = {
    f"{OBSERVED}, seed {_seed}": f"roadmap-bc-combined-point_cloud-{HARD}-s{_seed}"
    for _seed in (2, 3)
}
CELLS |= {_name: ["--policy", _policy] for _name, _policy in SEEDS.items()}
for _name, _policy, _filter, _source in (
    ("roadmap BC, vae", f"vae-{HARD}", POINT_CLOUD[:2], []),
    ("roadmap BC, vqvae", f"vqvae-{HARD}", POINT_CLOUD[:2], []),
    ("roadmap BC, pointnet2", f"pointnet2-{HARD}", POINT_CLOUD[:2], []),
    ("roadmap BC, field", f"field-{HARD}", POINT_CLOUD[:2], []),
    (DECODED, f"point_cloud-{HARD}", POINT_CLOUD[:2], ["--geometry-source", "field"]),
    (OBSERVED, f"point_cloud-{HARD}", POINT_CLOUD[:2], []),
    (f"{OBSERVED}, mixed scenes", "point_cloud-mixed_scenes", POINT_CLOUD[:2], []),
    ("roadmap BC, oracle", f"oracle-{HARD}", GROUND_TRUTH, []),
):
    _flags = ["--policy", f"roadmap-bc-combined-{_policy}-s1", *_source]
    CELLS |= {
        f"{_name}, no filter": [*_flags, "--safety-margin", "0"],
        f"{_name}, no escape": [*_flags, *_filter, "--no-escape"],
        _name: _flags,  # its own filter
    }
FLOW = "flow, point_cloud"
CELLS[FLOW] = ["--policy", "flow-combined-point_cloud-wide_scenes-s1"]
CELLS[f"{FLOW}, search"] = [*CELLS[FLOW], "--search"]
for _name, _other in (
    ("itself", CELLS[OBSERVED][1]),
    ("flow", CELLS[FLOW][1]),
    ("planner", "planner"),
):
    CELLS[f"{OBSERVED}, verified, else {_name}"] = [*CELLS[OBSERVED], "--verify-else", _other]
# Decoded points are less exact than observed ones.
CELLS[DECODED] = [*CELLS[DECODED], "--safety-margin", "0.015"]
PRIVILEGED = "ground truth (privileged)"
# Rows of the first tables: method, source of its observation and of its link distances, its cell.
ROWS = (
    ("go-to-goal", "none", "point cloud", "go-to-goal, filter, point_cloud"),
    ("go-to-goal", "none", PRIVILEGED, "go-to-goal, filter, ground_truth"),
    ("BC", "latent code (VAE)", "point cloud", "bc, vae"),
    ("BC", "latent code (VQ-VAE)", "point cloud", "bc, vqvae"),
    ("BC", "latent code (PointNet++)", "point cloud", "bc, pointnet2"),
    ("BC", PRIVILEGED, PRIVILEGED, "bc, oracle"),
    ("roadmap BC", "latent code (VAE)", "point cloud", "roadmap BC, vae"),
    ("roadmap BC", "latent code (VQ-VAE)", "point cloud", "roadmap BC, vqvae"),
    ("roadmap BC", "latent code (PointNet++)", "point cloud", "roadmap BC, pointnet2"),
    ("roadmap BC", "latent code (field)", "latent code (field)", "roadmap BC, field"),
    ("roadmap BC, trained with points", "decoded points (field)", "latent code (field)", DECODED),
    ("roadmap BC", "point cloud", "point cloud", OBSERVED),
    ("roadmap BC, mixed scenes", "point cloud", "point cloud", f"{OBSERVED}, mixed scenes"),
    ("roadmap BC", PRIVILEGED, PRIVILEGED, "roadmap BC, oracle"),
    ("flow", "point cloud", "point cloud", FLOW),
)
SEARCHING = (
    ("flow, searches where it verifies nothing", "point cloud", f"{FLOW}, search"),
    ("plan from the decoded cloud", "latent code (field)", "plan from the decoded cloud, field"),
    ("plan from the point cloud", "point cloud", "plan from the point cloud"),
    ("RRT-Connect", PRIVILEGED, "RRT-Connect"),
)
# Columns of the tables of every task.
EVERYWHERE = (
    *(
        "go-to-goal, filter, point_cloud",
        OBSERVED,
        f"{OBSERVED}, mixed scenes",
        "roadmap BC, oracle",
        FLOW,
        f"{FLOW}, search",
    ),
    "plan from the point cloud",
)
# Columns of the tables of tasks with scenes of other kinds, and the random boxes.
WITH_ENCODERS = (
    *("roadmap BC, vae", "roadmap BC, vqvae", "roadmap BC, pointnet2", "roadmap BC, field"),
    *(DECODED, OBSERVED, "roadmap BC, oracle"),
)
# How the columns are called in the tables.
SHOWN = {
    "go-to-goal, filter, point_cloud": "go-to-goal with safety filter",
    "roadmap BC, vae": "VAE",
    "roadmap BC, vqvae": "VQ-VAE",
    "roadmap BC, pointnet2": "PointNet++",
    "roadmap BC, field": "field",
    DECODED: "decoded points (field)",
    OBSERVED: "roadmap BC, point cloud",
    f"{OBSERVED}, mixed scenes": "roadmap BC, mixed scenes",
    "roadmap BC, oracle": "roadmap BC, privileged",
    FLOW: "flow",
    f"{FLOW}, search": "flow, search",
}
UNSEEN = [
    name for name, task in TABULATED.items() if name.startswith("random") or not task.trainable
]
# Results of benchmarks/results/baselines.json, which do not depend on the goal type: `combined` is
# reached like `ee`.
OF_BASELINES = {
    "go-to-goal": "go-to-goal",
    "plan from the point cloud": "plan from the point cloud, 5 s",
    "RRT-Connect": "RRT-Connect, 5 s",
}
KEPT = ("success_rate", "success_rate_interval", "collision_free_success_rate")
KEPT += ("collision_free_success_rate_interval", "num_queries", "ms_per_action", "planning_seconds")
KEPT += ("mean_steps", "path_length", "env", "geometry_source", "privileged", "safety_filter")
KEPT += ("seed",)
KEPT_OF_SOME = ("verified_rate", "search_rate", "unobserved_share")
FILTER_MARKS = {1: "\\*", 2: "‡"}  # by the version of the safety filter that a result had
ENCODER_MARK = "†"
MARKS = {
    FILTER_MARKS[1]: "measured with version 1 of the safety filter",
    FILTER_MARKS[2]: "measured with version 2 of the safety filter",
    ENCODER_MARK: "measured with an encoder that has been replaced",
}


def keep(run):
    """Put a run's policy where it is found by name, in half precision, with how it was made."""
    training = json.loads((run / "result.json").read_text())
    args = training["args"]
    # Those that it learned from: a folder, or the first of several; or the first of its tasks.
    scenes = (args.get("scenes") or [args["task"]])[0]
    if args["paths"]:
        paths = args["paths"][0] if isinstance(args["paths"], list) else args["paths"]
        scenes = load_roadmap_paths(Path(paths)).task
    trainer = training["script"].replace("_", "-")
    encoder = args.get("encoder", "point_cloud")
    name = f"{trainer}-{args['goal_type']}-{encoder}-{scenes}-s{args['seed']}"
    to_float16(run / "policy.onnx", POLICIES / f"{name}.onnx")
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
    print(f"{POLICIES / name}.onnx")


def load_results():
    """Dict of task -> dict of cell's name -> its result."""
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


def write_results(results):
    write_cells(RESULTS, results)


def run(tasks, names, num, workers):
    """Fill in cells that are missing, or had fewer queries, other flags, or older files.

    Cells of a policy that is not there are left out.
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
            kept = [*KEPT, *(key for key in KEPT_OF_SOME if key in result)]
            result = {key: result[key] for key in kept}
            result |= {"flags": CELLS[name], "date": datetime.date.today().isoformat()}
            result["encoders"] = digests(result)
            results = load_results()  # again: another run of this may have added to it
            results.setdefault(task, {})[name] = result
            write_results(results)
            write_card(task, result)


def write_card(task, result):
    """Put a policy's result on its own task, with its own filter, into its model card's file."""
    path = POLICIES / f"{result['flags'][1]}.json"
    if len(result["flags"]) > 2 or not path.exists():
        return
    card = json.loads(path.read_text())
    if card["args"]["task"] == task:
        keys = ("success_rate", "success_rate_interval")
        keys += ("collision_free_success_rate", "num_queries")
        card |= {key: result[key] for key in keys}
        write_atomically(path, (json.dumps(card, indent=1) + "\n").encode())


def is_done(result, name, num):
    if result is None or result["num_queries"] < num or result["flags"] != CELLS[name]:
        return False
    return not is_older(result) and not had_other_encoder(result)


def digests(result):
    """Of the pretrained encoders that a result depends on, by name."""
    names = result["geometry_source"], result["env"].get("encoder")
    names = {*names, result["env"].get("geometry_source")} - {None}
    files = {name: PRETRAINED / f"{name}.onnx" for name in sorted(names)}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        for name, path in files.items()
        if path.exists()
    }


def had_other_encoder(result):
    """Whether an encoder that it depends on has been replaced since."""
    return "encoders" in result and result["encoders"] != digests(result)


def version_of_filter(result):
    """Of the safety filter that a result had; today's, if it had none."""
    made_with = result.get("safety_filter")
    if made_with is None:
        return VERSION
    # The first two differ in the escape from local minima only, the last two in approach paths.
    version = max(made_with.get("version", 1), 1 if made_with["escape"] else 2)
    return 4 if version == 3 and not made_with.get("approach") else version


def is_older(result):
    """Whether the safety filter has changed since."""
    return version_of_filter(result) < VERSION


def papers_best():
    """Dict of task -> success of the paper's best policy, sections 5.1 to 5.4.

    On `random_boxes_*` and shelves it received a latent code; it was trained in the other scenes.
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
    for encoder in BC_FILTERS:
        path = POLICIES / f"bc-combined-{encoder}-{HARD}-s1.json"
        found[HARD][f"bc, {encoder}, no filter"] = json.loads(path.read_text())
    return found


def tables(results, others):
    """Name -> Markdown. `others` are the results of `others_results`."""
    results = {task: others.get(task, {}) | results.get(task, {}) for task in TABULATED}
    hard = results[HARD]
    found = {
        "unseen-policies": policies_table(hard),
        "unseen-filter": filter_table(hard),
        "unseen-seeds": seeds_table(hard),
    }
    for name, columns, tasks in (
        ("unseen-tasks", ("go-to-goal", *EVERYWHERE), list(TABULATED)),
        ("unseen-encoders", WITH_ENCODERS, UNSEEN),
    ):
        found[f"{name}-success"] = matrix(results, "success_rate", columns, tasks, papers_best())
        free = "collision_free_success_rate"
        found[f"{name}-collision-free"] = matrix(results, free, columns, tasks)
    return {name: with_footnotes(text) for name, text in found.items()}


def policies_table(hard):
    """Markdown: policies with their filters, and methods that search."""
    rows = []
    for method, observation, source, cell in ROWS:
        if cell in hard:
            result = hard[cell]
            row = [method, observation, source, "no", *_numbers(result)]
            seconds = result["planning_seconds"]
            planning = NOTHING if seconds is None else f"{seconds:.3f}"
            rows.append([*row, f"{result['ms_per_action']:.1f}", planning])
    for method, source, cell in SEARCHING:
        if cell in hard:
            result = hard[cell]
            row = [method, source, NOTHING, "yes", *_numbers(result)]
            rows.append([*row, NOTHING, f"{result['planning_seconds']:.3f}"])
    head = ["method", "observation", "source of link distances", "search", "success"]
    head += ["95 % interval", "collision-free", "queries", "ms per action", "planning time (s)"]
    return table(head, rows)


def filter_table(hard):
    """Markdown: policies without a filter, with it, and with the escape from local minima."""
    rows = []
    for method, observation, source, name in ROWS:
        unfiltered = "go-to-goal" if name == "go-to-goal, filter, point_cloud" else None
        unfiltered = unfiltered or f"{name}, no filter"
        for variant, cell in (
            ("none", unfiltered),
            ("filter", f"{name}, no escape"),
            ("filter and escape", name),
        ):
            if cell in hard:
                shown = NOTHING if variant == "none" else source
                rows.append([method, observation, variant, shown, *_numbers(hard[cell])])
    head = ["method", "observation", "safety filter", "source of its link distances", "success"]
    return table([*head, "95 % interval", "collision-free", "queries"], rows)


def seeds_table(hard):
    """Markdown: policies with point clouds of several seeds."""
    rows = []
    for seed, name in enumerate((OBSERVED, *SEEDS), 1):
        if name in hard:
            rows.append([seed, *_numbers(hard[name])])
    return table(["seed", "success", "95 % interval", "collision-free", "queries"], rows)


def matrix(results, key, columns, tasks, papers=None):
    """Markdown: a row per task, and one quantity of each policy that was evaluated there."""
    rows = []
    for task in tasks:
        cells = [results[task].get(name) for name in columns]
        shown = [share(cell[key]) + _mark(cell) if cell else NOTHING for cell in cells]
        paper = [share(papers.get(task))] if papers else []
        rows.append([f"`{task}`", *paper, *shown])
    names = [SHOWN.get(name, name) for name in columns]
    head = ["task", "paper's best"] if papers else ["task"]
    return table([*head, *names], rows)


def with_footnotes(text):
    notes = [f"{mark}: {meaning}." for mark, meaning in MARKS.items() if mark in text]
    return "\n\n".join([text, *notes])


def _numbers(result):
    """Cells: success, its interval, collision-free success, queries."""
    success = share(result["success_rate"]) + _mark(result)
    free = share(result["collision_free_success_rate"])
    count = f"{result['num_queries']:,}"
    return [success, interval(result["success_rate_interval"]), free, count]


def _mark(result):
    """Says that a result was measured with an earlier safety filter or encoder."""
    mark = FILTER_MARKS.get(version_of_filter(result), "")
    return mark + ENCODER_MARK if had_other_encoder(result) else mark


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(STATIC_TASKS), metavar="TASK")
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
        others = [task for task in args.only or TABULATED if task != HARD]
        run(others, args.cells or EVERYWHERE, args.num, args.workers)
        if args.cells is None:
            unseen = [task for task in others if task in UNSEEN]
            run(unseen, WITH_ENCODERS, args.num, args.workers)
    others = others_results(json.loads(BASELINES.read_text()))
    write(tables(load_results(), others))


if __name__ == "__main__":
    main()
