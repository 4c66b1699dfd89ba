"""The benchmark's table: verified rows, as Markdown."""

from pathlib import Path
from typing import Any

from roboarm_nmp.evaluation.submissions import TRACKS, SubmissionError
from roboarm_nmp.utils.documents import DocumentError, load_document, plain_data

COLUMNS = (
    *("method", "success", "95 % interval", "collision-free", "path (rad)", "duration (s)"),
    *("jerk (rad/s³)", "s per query", "training seeds", "queries"),
)
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
    """Tables of all rows (`*.yaml`) of a folder, one per task and class, the best method first.

    Raises SubmissionError: there is no row, or one is damaged.
    """
    rows = [_read_row(path) for path in sorted(Path(folder).glob("*.yaml"))]
    if not rows:
        raise SubmissionError(f"{folder}: no rows; `roboarm benchmark verify --row` writes them")
    parts = []
    for track, tasks in TRACKS.items():
        parts.append(f"## {track.capitalize()}\n")
        for task in tasks:
            table = _table(task, [row for row in rows if task in row["tasks"]])
            if table:
                parts.append(f"### `{task}`\n\n{table}\n")
    return "\n".join(parts).rstrip() + "\n"


def _read_row(path: Path) -> dict[str, Any]:
    try:
        row = plain_data(load_document(path, allow_tags=False))
        row["tasks"] = dict(row["tasks"])
        row["method"] = str(row["method"])
    except (DocumentError, TypeError, KeyError, AttributeError) as error:
        raise SubmissionError(f"{path}: no row of the benchmark: {error}") from error
    return row


def _table(task: str, rows: list[dict[str, Any]]) -> str:
    lines = []
    for observes, searches in CLASSES:
        group = [row for row in rows if (row["observes"], row["searches"]) == (observes, searches)]
        group.sort(key=lambda row: -row["tasks"][task]["success_rate"])
        if group:
            search = "searches" if searches else "no search"
            privileged = ", privileged" if observes == "ground truth" else ""
            title = f"**observes {observes}{privileged}; {search}**"
            lines.append(f"| {title} |" + " |" * (len(COLUMNS) - 1))
            lines += [_line(row, row["tasks"][task], task) for row in group]
    if not lines:
        return ""
    header = ["| " + " | ".join(COLUMNS) + " |", "|" + " --- |" * len(COLUMNS)]
    return "\n".join(header + lines)


def _line(row: dict[str, Any], numbers: dict[str, Any], task: str) -> str:
    method = f"[{row['method']}]({row['link']})" if row.get("link") else row["method"]
    if task in row.get("developed_on", []):
        method += " †"
    low, high = numbers["success_rate_interval"]
    cells = [
        method,
        f"{numbers['success_rate']:.3f}",
        f"{low:.3f} to {high:.3f}",
        f"{numbers['collision_free_success_rate']:.3f}",
        *(_number(numbers[name]) for name in ("path_length", "duration", "mean_jerk")),
        _number(numbers["seconds_per_query"]),
        str(row["training_seeds"]) if row["training_data"] != "none" else "–",
        f"{numbers['num_queries']:,}",
    ]
    return "| " + " | ".join(cells) + " |"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
