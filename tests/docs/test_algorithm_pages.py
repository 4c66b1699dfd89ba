"""docs/algorithms: its tables are of docs/make_algorithm_pages.py, its defaults of the flags."""

import importlib
import re

import pytest
from docs_scripts import load
from paths import ROOT

from roboarm_nmp.__main__ import TRAINERS

PAGES = ROOT / "docs" / "algorithms"


@pytest.mark.parametrize("name", ["sac", "td3", "bc", "roadmap_bc", "encoders"])
def test_tables_show_the_results_in_the_data_files(name):
    text = (PAGES / f"{name}.md").read_text()
    assert "<!-- table: " in text
    assert load("make_algorithm_pages").with_tables(text) == text


@pytest.mark.parametrize("name", ["sac", "td3", "crl", "bc", "gciql", "diffusion", "roadmap_bc"])
def test_flag_tables_show_the_defaults(name):
    Args = importlib.import_module(f"roboarm_nmp.{TRAINERS[name.replace('_', '-')][0]}").Args
    words, defaults = load("make_command_line").words, vars(Args())
    rows = re.findall(r"^\| `--([\w-]+)` \| (.*?) \|", (PAGES / f"{name}.md").read_text(), re.M)
    assert len(rows) >= 7
    for flag, shown in rows:
        assert shown.strip() == words(defaults[flag.replace("-", "_")]), flag
