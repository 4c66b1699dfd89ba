"""How the success of `dagger.py` grows with the number of scenes, and with rounds of DAgger.

    roboarm roadmaps --task random_boxes_hard --scenes 800 --seed 1 --output roadmaps
    roboarm queries --task random_boxes_hard --solvable --queries-per-scene 5 --seed 78 \\
        --num-test 1 --num-validation 1000 --output fresh.h5
    python benchmarks/scaling.py --paths roadmaps --queries fresh.h5 --runs-dir runs/scaling
    python benchmarks/scaling.py --figure      # only draws what benchmarks/results/scaling.json has

Each run is a short training with 32 observed points, in which one setting is varied, evaluated on
the fresh queries. What is done is skipped. Results go to benchmarks/results/scaling.json and to
docs/figures/unseen_scaling.png.
"""

import argparse
import io
import json
import os
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import matplotlib

from roboarm_nmp.datasets.shards import shard_paths
from roboarm_nmp.utils.files import write_atomically

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks/results/scaling.json"
FIGURE = ROOT / "docs" / "figures" / "unseen_scaling.png"
UPDATES = 4000
# Scenes, of 300 paths each; updates between rounds of DAgger, of 40 queries each (0: none).
RUNS = ((50, 2000), (200, 2000), (800, 2000), (800, 0), (800, 500))
SHARD = 50  # scenes of a shard: demo_generation.roadmaps' default
KEPT = (
    *(
        "success_rate",
        "success_rate_interval",
        "collision_free_success_rate",
        "collision_free_success_rate_interval",
    ),
    *("num_queries", "safety_filter", "seed"),
)


def run(scenes, round_every, args):
    """Train and evaluate one policy: its result."""
    folder = args.runs_dir / f"scenes-{scenes}-round-every-{round_every}"
    report = folder / "evaluation.json"
    if not report.exists():
        paths = folder / "paths"
        paths.mkdir(parents=True, exist_ok=True)
        for shard in shard_paths(args.paths, "roadmap paths")[: scenes // SHARD]:
            if not (paths / shard.name).exists():
                (paths / shard.name).symlink_to(shard.resolve())
        if not list(folder.glob("*/result.json")):
            command = [sys.executable, ROOT / "bc_script" / "dagger.py", "--paths", paths]
            command += ["--encoder", "point_cloud", "--num-points", "32"]
            command += ["--round-every", str(round_every)]
            command += ["--total-updates", str(args.updates), "--eval-every", str(args.updates)]
            command += ["--eval-queries", "100", "--test-queries", "1", "--runs-dir", folder]
            subprocess.run(command, check=True)
        (result,) = folder.glob("*/result.json")
        command = [sys.executable, ROOT / "clean_rl_scripts" / "evaluate.py"]
        command += ["--policy", result.parent, "--task", "random_boxes_hard", "--json", report]
        command += ["--queries", args.queries, "--split", "validation"]
        subprocess.run(command, check=True)
    result = json.loads(report.read_text())
    result = {key: result[key] for key in KEPT}
    return {"scenes": scenes, "round_every": round_every, "updates": args.updates} | result


def rounds_of(result):
    """How many rounds of DAgger there were; none at the very end."""
    every = result["round_every"]
    return (result["updates"] - 1) // every if every else 0


def figure_of(results):
    """A PNG file's bytes: success and collision-free success over scenes, and over rounds."""
    default = next(one for one in results if (one["scenes"], one["round_every"]) == RUNS[2])
    figure, axes = plt.subplots(1, 2, figsize=(8, 3), sharey=True, layout="constrained")
    panels = (
        ("scenes of the training", lambda one: one["scenes"], "round_every"),
        ("rounds of DAgger", rounds_of, "scenes"),
    )
    for axis, (label, where, same) in zip(axes, panels, strict=True):
        shown = sorted((one for one in results if one[same] == default[same]), key=where)
        for name, words in (
            ("success_rate", "success"),
            ("collision_free_success_rate", "collision-free success"),
        ):
            values = [one[name] for one in shown]
            ends = [one[f"{name}_interval"] for one in shown]
            errors = [
                [value - low for value, (low, _) in zip(values, ends, strict=True)],
                [high - value for value, (_, high) in zip(values, ends, strict=True)],
            ]
            xs = [where(one) for one in shown]
            axis.errorbar(xs, values, errors, marker="o", capsize=3, label=words)
        axis.set_xlabel(label)
    axes[0].set_xscale("log")
    scenes = sorted({one["scenes"] for one in results})
    axes[0].set_xticks(scenes, [str(one) for one in scenes])
    axes[0].minorticks_off()
    axes[0].set_ylabel("share of fresh queries")
    axes[1].legend(loc="lower right")
    contents = io.BytesIO()
    figure.savefig(contents, format="png", dpi=110)
    plt.close(figure)
    return contents.getvalue()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--paths", type=Path, help="folder of roadmap paths, 800 scenes")
    parser.add_argument("--queries", type=Path, help="query file, validation split")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs/scaling"))
    parser.add_argument("--updates", type=int, default=UPDATES, help=f"of each run ({UPDATES:,})")
    parser.add_argument("--figure", action="store_true", help="run nothing")
    args = parser.parse_args()
    if args.figure:
        results = json.loads(RESULTS.read_text())
    else:
        if args.paths is None or args.queries is None:
            parser.error("--paths and --queries are needed, or --figure")
        if len(shard_paths(args.paths, "roadmap paths")) < max(RUNS)[0] // SHARD:
            parser.error(f"--paths: there are fewer than {max(RUNS)[0]} scenes")
        results = []
        for one in RUNS:
            results.append(run(*one, args))
            write_atomically(RESULTS, (json.dumps(results, indent=1) + "\n").encode())
    write_atomically(FIGURE, figure_of(results))
    print(f"{FIGURE} written")


if __name__ == "__main__":
    main()
