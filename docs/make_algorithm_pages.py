"""Write the result tables and the learning curves of the pages in docs/algorithms.

    pip install -c constraints.txt -e ".[bench]"
    python docs/make_algorithm_pages.py

A table stands between the marks `<!-- table: NAME -->` and `<!-- end -->` of a page; a test
compares the two. The numbers are those of `src/roboarm_nmp/policies/pretrained`,
`envs/perception/pretrained` and `benchmarks/results`.
"""

import csv
import io
import json
import re
import statistics
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PAGES, FIGURES = ROOT / "docs" / "algorithms", ROOT / "docs" / "figures"
RUNS, ENCODERS = ROOT / "src/roboarm_nmp/policies/pretrained", ROOT / "envs/perception/pretrained"
RESULTS = ROOT / "benchmarks" / "results"
TASKS = ("no_obstacles", "wall", "double_walls_wide_gap", "double_walls", "boxes")
HARD = "random_boxes_hard"
NAMES = {
    "vae": "VAE",
    "vqvae": "VQ-VAE",
    "pointnet2": "PointNet++",
    "field": "distance field",
    "point_cloud": "none: observed points",
    "oracle": "none: ground-truth obstacles (privileged)",
}
# Per encoder, the score that its curve shows: key and label.
CURVES = {
    "vae": ("error_foreground", "squared error, foreground"),
    "vqvae": ("error_foreground", "squared error, foreground"),
    "pointnet2": ("iou_obstacle", "IoU of obstacles"),
}


def read(path):
    return json.loads(path.read_text())


def columns(name):
    """The rows of a CSV file of `benchmarks/results`: dicts of column -> text."""
    with open(RESULTS / name, newline="") as file:
        return list(csv.DictReader(file))


def runs(cell):
    """The results of a cell, one per seed."""
    return [read(path) for path in sorted(RUNS.glob(f"{cell}-s[0-9].json"))]


def paper():
    """The paper's mean success by cell: dict of its columns' values -> text."""
    rows = columns("paper_cells.csv")
    keys = ("algorithm", "goal_type", "task", "demo_prob", "hindsight", "encoder")
    same = [row for row in rows if row["task"] == row["trained_on"]]
    return {tuple(row[key] for key in keys): row["mean"] for row in same}


def markdown(header, rows):
    lines = [" | ".join(row) for row in (header, ["---"] * len(header), *rows)]
    return "\n".join(f"| {line} |" for line in lines) + "\n"


def share(value):
    return f"{value:.3f}"


def interval(result):
    low, high = result["success_rate_interval"]
    return f"{low:.3f}\u00a0to\u00a0{high:.3f}"  # stays in one line


# --- Tables


def reinforcement(algorithm):
    """Goal `ee`, seed 1, with and without demonstrations."""
    rows = []
    of_paper = paper()
    for task in TASKS:
        for p in ("0", "1"):
            for result in runs(f"{algorithm}-ee-{task}-p{p}")[:1]:
                row = [f"`{task}`", p, f"{result['steps']:,}", share(result["success_rate"])]
                row += [interval(result), share(result["collision_free_success_rate"])]
                row += [f"{result['num_queries']:,}"]
                rows.append([*row, of_paper[algorithm, "ee", task, p, "yes", ""]])
    header = ["task", "p", "steps", "success", "95 % interval", "collision-free success"]
    header += ["test queries", "paper's success"]
    return markdown(header, rows)


def behavioural_cloning():
    """The means over all seeds."""
    rows = []
    of_paper = paper()
    for goal in ("combined", "config", "ee"):
        for task in TASKS:
            found = runs(f"bc-{goal}-{task}")
            rates = [result["success_rate"] for result in found]
            free = [result["collision_free_success_rate"] for result in found]
            row = [f"`{goal}`", f"`{task}`", f"{found[0]['steps']:,}", str(len(found))]
            row += [share(statistics.mean(rates)), share(statistics.stdev(rates))]
            row += [share(statistics.mean(free)), of_paper["bc", goal, task, "", "", ""]]
            rows.append(row)
    header = ["goal", "task", "batches", "seeds", "success", "standard deviation over seeds"]
    header += ["collision-free success", "paper's success"]
    return markdown(header, rows)


def roadmap_bc():
    """On `random_boxes_hard`, without and with the safety filter."""
    found, rows = read(RESULTS / "unseen_obstacles.json")[HARD], []
    for encoder in ("point_cloud", "vae", "vqvae", "pointnet2", "field", "oracle"):
        alone = found[f"roadmap BC, {encoder}, no filter"]
        filtered = found[f"roadmap BC, {encoder}"]
        row = [f"`{encoder}`"]
        row += [share(alone[name]) for name in ("success_rate", "collision_free_success_rate")]
        row += [share(filtered["success_rate"]), interval(filtered)]
        row += [share(filtered["collision_free_success_rate"]), f"{filtered['num_queries']:,}"]
        rows.append(row)
    header = ["encoder", "no filter: success", "no filter: collision-free success"]
    header += ["filter: success", "filter: 95 % interval", "filter: collision-free success"]
    return markdown([*header, "test queries with the filter"], rows)


def encoder_runs():
    """The size of each training."""
    rows = []
    for name in ("vae", "vqvae", "pointnet2", "field"):
        result = read(ENCODERS / f"{name}.json")
        task = re.search(r"--task (\w+)", result["observations"])[1]
        row = [NAMES[name], f"`{task}`", f"{result['scenes']:,}", f"{result['updates']:,}"]
        rows.append([*row, str(result["args"]["batch_size"]), f"{result['seconds'] / 60:.0f}"])
    header = ["encoder", "scenes of", "scenes", "batches", "scenes per batch", "duration (min)"]
    return markdown(header, rows)


def encoder_scores():
    """Errors on validation scenes."""
    scores = {name: read(ENCODERS / f"{name}.json") for name in ("vae", "vqvae")}
    rows = []
    for name, score in scores.items():
        for key, measure in (
            ("error", "squared error of pixels"),
            ("error_foreground", "squared error of pixels that differ from the mean image"),
        ):
            rows.append(
                [NAMES[name], measure, f"{score[key]:.4f}", f"{score[f'mean_image_{key}']:.4f}"]
            )
    points, field = (read(ENCODERS / f"{name}.json") for name in ("pointnet2", "field"))
    for key, measure in (
        ("accuracy", "accuracy of the points' classes"),
        ("iou_obstacle", "intersection over union, obstacles"),
        ("iou_robot", "intersection over union, robot"),
        ("absent", "share of other scenes' points classified as absent"),
    ):
        rows.append([NAMES["pointnet2"], measure, share(points[key]), ""])
    for key, measure in (
        ("error_near", "mean error of distances below 10 cm (cm)"),
        ("error_5cm", "mean error of distances below 5 cm (cm)"),
        ("error_20cm", "mean error of distances from 10 to 20 cm (cm)"),
    ):
        rows.append([NAMES["field"], measure, f"{100 * field[key]:.2f}", ""])
    return markdown(
        ["encoder", "measure on validation scenes", "value", "value of the mean image"], rows
    )


def encoder_policies():
    """Behavioural cloning and roadmap BC with each encoder, on `random_boxes_hard`."""
    unseen, of_paper, rows = read(RESULTS / "unseen_obstacles.json")[HARD], paper(), []
    for encoder in NAMES:
        cloned = runs(f"bc-combined-{encoder}-{HARD}")[:1]
        row = [NAMES[encoder]]
        row += [share(one["success_rate"]) for one in cloned] or [""]
        row += [interval(one) for one in cloned] or [""]
        row += [of_paper.get(("bc", "combined", HARD, "", "", encoder), "")]
        imitated = unseen[f"roadmap BC, {encoder}"]
        row += [share(imitated["success_rate"]), interval(imitated)]
        rows.append([*row, share(imitated["collision_free_success_rate"])])
    header = ["encoder", "BC: success", "BC: 95 % interval", "BC: paper's success"]
    header += ["Roadmap BC with filter: success", "Roadmap BC: 95 % interval"]
    return markdown([*header, "Roadmap BC: collision-free success"], rows)


TABLES = {
    "sac": lambda: reinforcement("sac"),
    "td3": lambda: reinforcement("td3"),
    "bc": behavioural_cloning,
    "roadmap_bc": roadmap_bc,
    "encoder runs": encoder_runs,
    "encoder scores": encoder_scores,
    "encoder policies": encoder_policies,
}


def with_tables(text):
    """A page's text with all of its tables written anew."""

    def written(match):
        return f"<!-- table: {match[1]} -->\n{TABLES[match[1]]()}<!-- end -->"

    return re.sub(r"<!-- table: ([\w ]+) -->\n.*?<!-- end -->", written, text, flags=re.DOTALL)


# --- Learning curves


def draw(path, lines, tasks, unit):
    """Validation success over training, a panel per task.

    `lines`: dict of label -> (pattern of the cells' names with `{task}`, colour). The dashed line
    is go-to-goal on test queries.
    """
    baselines = read(RESULTS / "baselines.json")
    figure, axes = plt.subplots(
        1, len(tasks), figsize=(2.1 * len(tasks), 2.6), sharey=True, layout="constrained"
    )
    for panel, task in zip(axes, tasks, strict=True):
        reference = baselines[task]["go-to-goal"]["success_rate"]
        panel.axhline(reference, color="0.4", linestyle="--", linewidth=1, label="go-to-goal")
        for label, (cell, colour) in lines.items():
            for result in runs(cell.format(task=task)):
                steps, success = zip(*result["curve"], strict=True)
                panel.plot([n / 1000 for n in steps], success, colour, linewidth=1.2, label=label)
        panel.set_title(task, fontsize=9)
        panel.set(ylim=(0, 1))
        panel.grid(alpha=0.3)
    axes[0].set_ylabel("validation success")
    figure.supxlabel(f"thousand {unit}", fontsize=10)
    handles = {}
    for panel in axes:
        handles |= dict(zip(*panel.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(handles.values(), handles, loc="outside upper center", ncols=4, fontsize=8)
    save(figure, path)


def save(figure, path):
    contents = io.BytesIO()
    figure.savefig(contents, dpi=110)
    plt.close(figure)
    with Image.open(contents) as image:
        image.convert("RGB").quantize(128).save(path, optimize=True)


def draw_roadmap_bc(path):
    """Validation success over updates, with and without contacts."""
    rows = columns("roadmap_bc_curves.csv")
    reference = read(RESULTS / "baselines.json")[HARD]["go-to-goal"]
    figure, axes = plt.subplots(1, 2, figsize=(7.6, 2.9), sharey=True, layout="constrained")
    for panel, column, key in (
        (axes[0], "success", "success_rate"),
        (axes[1], "collision-free success", "collision_free_success_rate"),
    ):
        panel.axhline(reference[key], color="0.4", linestyle="--", linewidth=1, label="go-to-goal")
        for encoder, colour in (("oracle", "tab:orange"), ("point_cloud", "tab:blue")):
            for has_filter, style in (("yes", "-"), ("no", ":")):
                own = [r for r in rows if r["encoder"] == f"`{encoder}`"]
                own = [r for r in own if r["safety filter"] == has_filter]
                updates = [int(r["updates"].replace(",", "")) / 1000 for r in own]
                label = encoder if has_filter == "yes" else f"{encoder}, no filter"
                values = [float(r[column]) for r in own]
                panel.plot(updates, values, style, color=colour, linewidth=1.2, label=label)
        panel.set_title(column, fontsize=9)
        panel.set(ylim=(0, 1))
        panel.grid(alpha=0.3)
    axes[0].set_ylabel("validation")
    figure.supxlabel("thousand updates", fontsize=10)
    handles = axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside right center", fontsize=8)
    save(figure, path)


def draw_encoders(path):
    """A score on validation scenes over updates; the points are the pretrained encoders."""
    rows = columns("encoder_curves.csv")
    figure, axes = plt.subplots(1, len(CURVES), figsize=(8.4, 2.6), layout="constrained")
    for panel, (name, (key, measure)) in zip(axes, CURVES.items(), strict=True):
        own = [row for row in rows if row["encoder"] == name]
        updates = [int(row["updates"]) / 1000 for row in own]
        panel.plot(updates, [float(row["value"]) for row in own], linewidth=1.2)
        pretrained = read(ENCODERS / f"{name}.json")
        panel.plot(pretrained["updates"] / 1000, pretrained[key], "o", color="tab:orange")
        panel.set_title(NAMES[name], fontsize=9)
        panel.set_ylabel(measure, fontsize=8)
        panel.set_ylim(bottom=0)
        panel.grid(alpha=0.3)
    figure.supxlabel("thousand updates", fontsize=10)
    save(figure, path)


def draw_all():
    sac = {
        "SAC, p = 0": ("sac-ee-{task}-p0", "tab:blue"),
        "SAC-MP, p = 1": ("sac-ee-{task}-p1", "tab:orange"),
    }
    td3 = {
        "TD3-MP, p = 1": ("td3-ee-{task}-p1", "tab:green"),
        "SAC-MP, p = 1": sac["SAC-MP, p = 1"],
    }
    bc = {
        "goal combined": ("bc-combined-{task}", "tab:blue"),
        "goal config": ("bc-config-{task}", "tab:orange"),
        "goal ee": ("bc-ee-{task}", "tab:red"),
    }
    steps = "environment steps"
    draw(FIGURES / "curves_sac.png", sac, TASKS, steps)
    draw(FIGURES / "curves_td3.png", td3, [t for t in TASKS if "wide" not in t], steps)
    draw(FIGURES / "curves_bc.png", bc, TASKS, "batches")
    draw_roadmap_bc(FIGURES / "curves_roadmap_bc.png")
    draw_encoders(FIGURES / "curves_encoders.png")


if __name__ == "__main__":
    for page in sorted(PAGES.glob("*.md")):
        page.write_text(with_tables(page.read_text()))
    draw_all()
