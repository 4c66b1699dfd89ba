"""The benchmark's table: verified rows, as Markdown."""

from pathlib import Path
from typing import Any

from roboarm_nmp.evaluation.submissions import TRACKS, SubmissionError
from roboarm_nmp.utils.documents import DocumentError, load_document, plain_data

COLUMNS = (
    *("method", "success", "95 % interval", "collision-free success", "95 % interval"),
    *("path (rad)", "duration (s)", "jerk (rad/s³)", "s per query", "training seeds"),
    "queries, version",
)
CRITERION = "Motion Policy Networks' criterion"
"""What collision-free success is called where goals are poses, with `POSE_TOLERANCES`."""
CLASSES = (
    ("ground truth", False),
    ("ground truth", True),
    ("point cloud", False),
    ("point cloud", True),
    ("latent code", False),
    ("latent code", True),
    ("nothing", False),
    ("nothing", True),
)
"""What a method observes of the scene, and whether it searches for paths."""


def leaderboard(folder: str | Path) -> str:
    """Tables of the rows (`*.yaml`) in a folder, per task and type of goal, best first.

    Raises SubmissionError: there is no row, or one is damaged.
    """
    rows = [_read_row(path) for path in sorted(Path(folder).glob("*.yaml"))]
    if not rows:
        raise SubmissionError(f"{folder}: no rows; `roboarm benchmark verify --row` writes them")
    parts = []
    for track, tasks in TRACKS.items():
        tables = []
        for task in tasks:
            entered = [row for row in rows if task in row["tasks"]]
            for has_poses in (False, True):
                suitable = [row for row in entered if _has_pose_goals(row, task) == has_poses]
                if suitable:
                    goals = ", goals are poses" if has_poses else ""
                    tables.append(f"### `{task}`{goals}\n\n{_table(task, suitable, has_poses)}\n")
        if tables:
            parts += [f"## {track[0].upper()}{track[1:]}\n", *tables]
    return "\n".join(parts).rstrip()


def _has_pose_goals(row: dict[str, Any], task: str) -> bool:
    return row["tasks"][task].get("goal_type") == "pose"


def _read_row(path: Path) -> dict[str, Any]:
    try:
        row = plain_data(load_document(path, allow_tags=False))
        row["tasks"] = dict(row["tasks"])
        row["method"] = str(row["method"])
        verified = all("success_rate_interval" in numbers for numbers in row["tasks"].values())
    except (DocumentError, TypeError, KeyError, AttributeError) as error:
        raise SubmissionError(f"{path}: no row of the benchmark: {error}") from error
    if not verified:
        raise SubmissionError(
            f"{path}: not a verified row: make it with `roboarm benchmark verify ENTRY --row FILE`"
        )
    return row


def _table(task: str, rows: list[dict[str, Any]], has_poses: bool) -> str:
    columns = [*COLUMNS]
    if has_poses:
        columns[3] = CRITERION
    lines = ["| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
    for observes, searches in CLASSES:
        group = [row for row in rows if (row["observes"], row["searches"]) == (observes, searches)]
        group.sort(key=lambda row: _rank(row["tasks"][task]))
        if group:
            search = "searches" if searches else "no search"
            privileged = ", privileged" if observes == "ground truth" else ""
            title = f"**observes {observes}{privileged}; {search}**"
            lines.append(f"| {title} |" + " |" * (len(columns) - 1))
            lines += [_line(row, row["tasks"][task], task) for row in group]
    return "\n".join(lines)


def _rank(numbers: dict[str, Any]) -> tuple[float, ...]:
    """Smaller for a better row: more success, then less contact, then shorter paths."""
    rates = -numbers["success_rate"], -numbers["collision_free_success_rate"]
    return *rates, numbers["path_length"] or 0.0


def _line(row: dict[str, Any], numbers: dict[str, Any], task: str) -> str:
    method = f"[{row['method']}]({row['link']})" if row.get("link") else row["method"]
    if task in row.get("developed_on", []):
        method += " †"
    cells = [method]
    for name in ("success_rate", "collision_free_success_rate"):
        low, high = numbers[f"{name}_interval"]
        cells += [f"{numbers[name]:.3f}", f"{low:.3f} to {high:.3f}"]
    cells += [_number(numbers[name]) for name in ("path_length", "duration", "mean_jerk")]
    cells += [
        _number(numbers["seconds_per_query"]),
        str(row["training_seeds"]) if row["training_data"] != "none" else "–",
        f"{numbers['num_queries']:,}, `{numbers['queries_digest'][:8]}`",
    ]
    return "| " + " | ".join(cells) + " |"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
