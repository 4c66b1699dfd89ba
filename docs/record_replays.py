"""A hook of MkDocs: records the site's replays, and shows them, and notebooks, in the pages.

A page shows the replay NAME where it has the mark `<!-- replay: NAME -->`. A replay is recorded
into docs/recordings if it is not there yet; delete it to record it again. Without the extra
`viewer`, the site has none. `<!-- notebook: examples/NAME.ipynb -->` shows the cells of a notebook,
without the first one, its title.
"""

import importlib.util
import json
import logging
import re
import subprocess
import sys
from pathlib import Path

from mkdocs.utils import get_relative_url

FOLDER = Path(__file__).parent / "recordings"
POLICY = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"
REPLAYS = {
    "demo": ["demo"],
    "shelves": ["view", "narrow_shelves", "--policy", POLICY, "go-to-goal", "--query", "2"],
    "moving_boxes": ["view", "moving_boxes_hard", "--policy", POLICY, "go-to-goal", "--query", "0"],
}
MARK = re.compile(r"<!-- replay: (\w+) -->")
NOTEBOOK = re.compile(r"<!-- notebook: (\S+) -->")
FRAME = """\
<iframe src="{}" width="100%" height="480" style="border: 0" loading="lazy"></iframe>
*A replay: drag to look from elsewhere.*"""
log = logging.getLogger("mkdocs.hooks.record_replays")


def on_pre_build(config):
    if importlib.util.find_spec("viser") is None:
        log.info("no replays: they need the extra `viewer`")
        return
    for name, command in REPLAYS.items():
        file = FOLDER / f"{name}.html"
        if not file.exists():
            FOLDER.mkdir(exist_ok=True)
            log.info("recording %s", file.name)
            roboarm = [sys.executable, "-m", "roboarm_nmp"]
            subprocess.run([*roboarm, *command, "--record", file], check=True)


def cells_of(mark):
    cells = []
    for cell in json.loads(Path(mark[1]).read_text())["cells"][1:]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "code":
            source = f"```python\n{source}\n```"
        cells.append(source.replace("../docs/", "../"))
    return "\n\n".join(cells)


def on_page_markdown(markdown, page, config, files):
    def replay(mark):
        file = files.get_file_from_path(f"recordings/{mark[1]}.html")
        return FRAME.format(get_relative_url(file.url, page.url)) if file else mark[0]

    return NOTEBOOK.sub(cells_of, MARK.sub(replay, markdown))
