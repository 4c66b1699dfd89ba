"""Tables between marks in README and the docs, rendered from result files.

A table stands between `<!-- NAME -->` and `<!-- end of NAME -->`. `benchmarks/render_tables.py`
renders all of them; the benchmarks render their own. A name that ends in `.csv` is a file in
benchmarks/results, shown as it is.
"""

import csv
import io
import json
import re
from pathlib import Path

from roboarm_nmp.utils.files import write_atomically

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
MARKS = re.compile(r"<!-- (?P<name>\S+) -->\n(?P<text>.*?)<!-- end of (?P=name) -->", re.DOTALL)
NOTHING = "–"


def pages():
    """README and all pages of the docs."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def table(head, rows):
    """Markdown: `rows` (lists of cells) under `head`. Cells are shown as `str` does."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in lines)


def share(value):
    """A success rate with three digits; a dash for None."""
    return NOTHING if value is None else f"{value:.3f}"


def interval(ends):
    """The ends of an interval; the space between them does not break a line."""
    low, high = ends
    return f"[{low:.3f},\u00a0{high:.3f}]"


def csv_table(name):
    """A file of benchmarks/results as it is."""
    with open(RESULTS / name, newline="") as file:
        head, *rows = csv.reader(file)
    return table(head, rows)


def csv_rows(name):
    """Rows of a file of benchmarks/results as dicts; none if there is no such file."""
    if not (RESULTS / name).exists():
        return []
    with open(RESULTS / name, newline="") as file:
        return list(csv.DictReader(file))


def write_csv(name, head, rows):
    """Write a file of benchmarks/results, and its table into the pages that have its marks."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    write_atomically(RESULTS / name, text.getvalue().encode())
    write({name: csv_table(name)})


def write_cells(path, results):
    """Write results as JSON, dict of task -> dict of cell -> result: a line per cell."""
    tasks = []
    for task, cells in results.items():
        lines = [f"  {json.dumps(name)}: {json.dumps(cell)}" for name, cell in cells.items()]
        tasks.append(f" {json.dumps(task)}: {{\n" + ",\n".join(lines) + "\n }")
    write_atomically(path, ("{\n" + ",\n".join(tasks) + "\n}\n").encode())


def csv_tables():
    """Name -> Markdown of all CSV files whose marks stand in a page."""
    names = {mark["name"] for page in pages() for mark in MARKS.finditer(page.read_text())}
    return {name: csv_table(name) for name in sorted(names) if name.endswith(".csv")}


def render(text, tables):
    """A page's text with `tables` (name -> Markdown) between their marks; others stay."""

    def replaced(mark):
        name = mark["name"]
        if name not in tables:
            return mark[0]
        return f"<!-- {name} -->\n\n{tables[name]}\n\n<!-- end of {name} -->"

    return MARKS.sub(replaced, text)


def write(tables):
    """Put tables into all pages that have their marks; prints the pages that change."""
    for page in pages():
        before = page.read_text()
        after = render(before, tables)
        if after != before:
            write_atomically(page, after.encode())
            print(f"{page.relative_to(ROOT)} written")
