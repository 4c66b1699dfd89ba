"""The figures of docs/benchmark/unseen_obstacles.md: an animation of a policy, and its results.

    python benchmarks/unseen_figures.py
    python benchmarks/unseen_figures.py --no-animation

The animation is of validation queries: above `go-to-goal`, below the policy, in the same scenes.
The policy must reach each goal without a contact: otherwise choose other --queries.
The others show benchmarks/results/unseen_obstacles.json (benchmarks/unseen_obstacles.py).
"""

import argparse
import io
import json
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image
from unseen_obstacles import BASELINES, HARD, load_results, others_results, papers_best

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.tasks import STATIC_TASKS
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.policies.registry import find_policy, make_policy
from roboarm_nmp.utils.files import write_atomically
from roboarm_nmp.viewer.show import render_configurations

matplotlib.use("Agg")
import matplotlib.pyplot as plt

FIGURES = Path(__file__).resolve().parent.parent / "docs" / "figures"
FRAMES, SECONDS_PER_FRAME, LAST_SECONDS, COLOURS = 36, 0.12, 1.5, 48
# Of the bars: label, cell without the filter, cell with it.
ALONE = (
    ("go-to-goal", "go-to-goal", "go-to-goal, filter, point_cloud"),
    ("BC,\nVAE", "bc, vae, no filter", "bc, vae"),
    ("BC,\nprivileged", "bc, oracle, no filter", "bc, oracle"),
    ("DAgger,\nlatent code", "dagger, decoded by field, no filter", "dagger, decoded by field"),
    ("DAgger,\npoint cloud", "dagger, point_cloud, no filter", "dagger, point_cloud"),
    ("DAgger,\nprivileged", "dagger, oracle, no filter", "dagger, oracle"),
    ("plan from the\npoint cloud", "plan from the point cloud", None),
)
# Of the figure of all tasks: label, cell, marker.
BY_TASK = (
    ("go-to-goal", "go-to-goal", "o"),
    ("go-to-goal with safety filter, point cloud", "go-to-goal, filter, point_cloud", "s"),
    ("DAgger with safety filter, point cloud", "dagger, point_cloud", "D"),
    ("plan from the point cloud (searches)", "plan from the point cloud", "^"),
)


def animation(policy, numbers, size):
    """A GIF file's bytes: a column per validation query; above `go-to-goal`, below the policy.

    Raises ValueError: in one of these episodes, the policy is in contact or misses the goal.
    """
    queries, rows = load_queries(HARD, "validation"), []
    for name in ("go-to-goal", policy):
        found, arguments = find_policy(name)
        arguments = arguments or {"goal_type": "combined"}
        env = envs.make(HARD, render_mode="rgb_array", **arguments)
        begin = make_policy(found, env)
        columns = []
        for number in numbers:
            query = queries[number]
            trajectory = rollout(env, query, begin(number, query).act)
            if name == policy and (trajectory.collides or not trajectory.success):
                raise ValueError(f"query {number}: {name} is in contact or misses the goal")
            # All at the same speed: what arrives early stands still for the rest.
            steps = np.linspace(0, 200, FRAMES).round().astype(int)
            configurations = trajectory.configurations[np.minimum(steps, len(trajectory))]
            columns.append(list(render_configurations(env, query, configurations, size)))
            ended = "reached" if trajectory.success else "not reached"
            contact = "with contact" if trajectory.collides else "collision-free"
            print(f"{name}, query {number}: {ended} in {len(trajectory)} steps, {contact}")
        env.close()
        rows.append(np.concatenate(columns, axis=2))
    frames = [Image.fromarray(frame) for frame in np.concatenate(rows, axis=1)]
    palette = frames[0].quantize(COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=3)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    seconds = [SECONDS_PER_FRAME] * (FRAMES - 1) + [LAST_SECONDS]
    contents = io.BytesIO()
    durations = [round(1000 * one) for one in seconds]
    frames[0].save(
        contents, "GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0
    )
    return contents.getvalue()


def errors(found, name):
    """Lengths of the 95 % intervals below and above, (2, n), for error bars."""
    ends = np.array([one[f"{name}_interval"] if one else (np.nan, np.nan) for one in found])
    values = np.array([one[name] if one else np.nan for one in found])
    return np.stack([values - ends[:, 0], ends[:, 1] - values]).clip(0)  # but for rounding


def bars(results):
    """A PNG file's bytes: without and with the safety filter, success and collision-free."""
    rows = [row for row in ALONE if row[1] in results or row[2] in results]
    figure, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
    styles = (
        ("no filter", -0.2, 1, "#b8c4d6"),
        ("with the safety filter", 0.2, 2, "#3f6fb5"),
    )
    for label, shift, column, colour in styles:
        found = [results.get(row[column]) for row in rows]
        for collision_free in (False, True):
            name = "collision_free_success_rate" if collision_free else "success_rate"
            axes.bar(
                np.arange(len(rows)) + shift,
                [one[name] if one else np.nan for one in found],
                0.36,
                color=colour,
                edgecolor="black" if collision_free else colour,
                linewidth=0.8,
                alpha=1.0 if collision_free else 0.55,
                label=f"{label}, {'collision-free' if collision_free else 'success'}",
                yerr=None if collision_free else errors(found, name),
                error_kw={"elinewidth": 1, "capsize": 3},
            )
    axes.axhline(
        papers_best()[HARD],
        color="#b5533f",
        linestyle="--",
        linewidth=1,
        label="paper's best policy",
    )
    axes.set_xticks(np.arange(len(rows)), [row[0] for row in rows])
    axes.set_ylim(0, 1.3)
    axes.set_ylabel(f"share of test queries,\n{HARD}")
    axes.legend(loc="upper left", fontsize=8, ncols=3)
    return png_of(figure)


def by_task(results):
    """A PNG file's bytes: success and its interval per task. `results`: task -> cell -> result."""
    figure, axes = plt.subplots(figsize=(10, 3.8), layout="constrained")
    tasks, best = list(STATIC_TASKS), papers_best()
    shifts = np.linspace(-0.28, 0.28, len(BY_TASK))
    for (label, cell, marker), shift in zip(BY_TASK, shifts, strict=True):
        found = [results[task].get(cell) for task in tasks]
        values = [one["success_rate"] if one else np.nan for one in found]
        axes.errorbar(
            np.arange(len(tasks)) + shift,
            values,
            errors(found, "success_rate"),
            fmt=marker,
            markersize=4,
            capsize=2,
            label=label,
        )
    papers = [best.get(task, np.nan) for task in tasks]
    axes.plot(papers, linestyle="", marker="_", markersize=22, color="0.5", label="paper's best")
    axes.set_xticks(np.arange(len(tasks)), [task.replace("_", "\n") for task in tasks], fontsize=7)
    axes.set_ylim(0.25, 1.02)
    axes.set_ylabel("success on test queries")
    axes.grid(alpha=0.3, axis="y")
    axes.legend(fontsize=8, loc="lower right")
    return png_of(figure)


def png_of(figure):
    contents = io.BytesIO()
    figure.savefig(contents, format="png", dpi=110)
    plt.close(figure)
    return contents.getvalue()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--policy", default=f"dagger-combined-point_cloud-{HARD}-s1")
    parser.add_argument("--queries", type=int, nargs="+", default=[1, 4, 8])
    parser.add_argument("--size", type=int, nargs=2, default=(224, 168))
    parser.add_argument("--no-animation", action="store_true", help="only the figures")
    args = parser.parse_args()
    others = others_results(json.loads(BASELINES.read_text()))
    results = {task: others[task] | found for task, found in load_results().items()}
    write_atomically(FIGURES / "unseen_bars.png", bars(results[HARD]))
    write_atomically(FIGURES / "unseen_tasks.png", by_task(results))
    if args.no_animation:
        return
    contents = animation(args.policy, args.queries, tuple(args.size))
    write_atomically(FIGURES / "unseen_episodes.gif", contents)
    print(f"{len(contents) / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
