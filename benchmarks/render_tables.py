"""Render all tables of README and the docs from their result files.

    python benchmarks/render_tables.py

Tables stand between marks (`benchmarks/markdown_tables.py`). Nothing is run.
"""

import argparse
import json

import baselines
import paper_tables
import quarter_hour
import unseen_obstacles
from markdown_tables import NOTHING, ROOT, csv_tables, interval, share, table, write

from roboarm_nmp.evaluation.leaderboard import leaderboard

HARD = "random_boxes_hard"
FIXED = ("wall", "double_walls")
REMARK = (
    "Success is reaching the goal, contacts allowed. Go-to-goal moves straight to the goal. "
    "Roadmap BC has a safety filter and receives link distances from the same source as its "
    "observation; flow has the filter, and verifies the path that it draws. The paper's policies "
    "have neither. Only the last three methods of `random_boxes_hard` search for a path before "
    "they move, the first of them where it can verify none. Most rows are from one training seed; "
    "BC, and SAC on `wall`, are from three."
)


def results_table():
    """README's table: success with and without contact, ours beside the paper's."""
    cells = {cell.name: cell for cell in paper_tables.read_cells()}
    results = paper_tables.load_results([paper_tables.POLICIES])
    papers = baselines.papers_go_to_goal()
    references, unseen = paper_tables.load_references()
    hard = references[HARD] | unseen[HARD]
    bc = f"bc-combined-vae-{HARD}"
    rows = []

    def add(task, method, observation, safety_filter, found, paper):
        numbers = [NOTHING] * 3
        if found:
            success, ends, free, _ = paper_tables.pooled(found)
            numbers = [share(success), interval(ends), share(free)]
        rows.append([f"`{task}`", method, observation, safety_filter, *numbers, share(paper)])

    best = unseen_obstacles.papers_best()[HARD]
    code = "latent code"
    privileged = "ground truth (privileged)"
    add(HARD, "go-to-goal", "none", "no", [hard["go-to-goal"]], papers[HARD])
    add(HARD, "paper's best learned policy", f"{code} (VQ-VAE)", "no", [], best)
    add(HARD, "BC", f"{code} (VAE)", "no", paper_tables.of_recipe(cells[bc], results),
        cells[bc].mean)  # fmt: skip
    add(HARD, "roadmap BC", f"{code} (field)", "yes", [hard["roadmap BC, decoded by field"]], None)
    add(HARD, "roadmap BC", "point cloud", "yes", [hard["roadmap BC, point_cloud"]], None)
    add(HARD, "flow", "point cloud", "yes", [hard["flow, point_cloud"]], None)
    add(HARD, "flow, else search", "point cloud", "yes", [hard["flow, point_cloud, search"]], None)
    add(HARD, "plan from the point cloud", "point cloud", "no",
        [hard["plan from the point cloud"]], None)  # fmt: skip
    add(HARD, "RRT-Connect", privileged, "no", [hard["RRT-Connect, 5 s"]], None)
    for task in FIXED:
        add(task, "go-to-goal", "none", "no", [references[task]["go-to-goal"]], papers[task])
        cell = cells[f"sac-ee-{task}-p1"]
        found = paper_tables.of_recipe(cell, results)
        add(task, "SAC with demonstrations", "none", "no", found, cell.mean)
    head = ["task", "method", "observation of the scene", "safety filter", "success"]
    head += ["95 % interval", "collision-free success", "paper's success"]
    return f"{table(head, rows)}\n\n{REMARK}"


def all_tables():
    """Name -> Markdown of every table that a page has."""
    references, unseen = paper_tables.load_references()
    results = paper_tables.load_results([paper_tables.POLICIES])
    others = json.loads(baselines.RESULTS.read_text())
    return {
        "results": results_table(),
        **paper_tables.tables(paper_tables.read_cells(), results, references),
        **baselines.tables(others, unseen),
        **unseen_obstacles.tables(unseen, unseen_obstacles.others_results(others)),
        "leaderboard": leaderboard(ROOT / "benchmarks" / "leaderboard"),
        "quarter_hour": quarter_hour.quarter_hour_table(quarter_hour.load_results()),
        **csv_tables(),
    }


def main():
    argparse.ArgumentParser(description=__doc__.split("\n")[0]).parse_args()
    write(all_tables())


if __name__ == "__main__":
    main()
