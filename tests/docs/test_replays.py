"""The site's replays: each mark in a page has a recording."""

import sys

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
