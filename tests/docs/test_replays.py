"""The site's replays: each mark in a page has a recording, and becomes a frame that shows it."""

import sys
from types import SimpleNamespace

import markdown_tables
import pytest
from paths import ROOT

pytest.importorskip("mkdocs")  # of the extra `docs`

sys.path.append(str(ROOT / "docs"))
import record_replays  # noqa: E402


def test_every_replay_is_in_a_page_and_every_mark_has_one():
    pages = "".join(page.read_text() for page in markdown_tables.pages())
    marks = record_replays.MARK.findall(pages)
    assert sorted(marks) == sorted(record_replays.REPLAYS)


@pytest.mark.parametrize("recorded", [True, False])
def test_mark_becomes_a_frame_where_there_is_a_recording(recorded):
    recording = SimpleNamespace(url="recordings/demo.html") if recorded else None
    files = SimpleNamespace(get_file_from_path={"recordings/demo.html": recording}.get)
    page = SimpleNamespace(url="guide/viewer.html")
    text = "before\n\n<!-- replay: demo -->\n\nafter"
    shown = record_replays.on_page_markdown(text, page=page, config=None, files=files)
    assert ('<iframe src="../recordings/demo.html"' in shown) == recorded
    assert shown.startswith("before\n\n") and shown.endswith("\n\nafter")
    assert recorded or shown == text
