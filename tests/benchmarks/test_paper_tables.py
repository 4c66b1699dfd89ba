"""The paper's cells: what a run is, what its tables show, and that nothing is run twice."""

import json
import re
import subprocess
import sys

import paper_tables
import pytest
from trainers import succeeds_here

from roboarm_nmp.networks.network_file import load_network

CELLS = {cell.name: cell for cell in paper_tables.read_cells()}


@pytest.fixture
def in_this_process(monkeypatch):
    """Scripts that `paper_tables` starts run in this process, which saves seconds of imports."""
    run = subprocess.run

    def run_script(command, **options):
        if command[0] != sys.executable:  # git
            return run(command, **options)
        assert options == {"check": True}
        return succeeds_here(*command[1:])

    monkeypatch.setattr(paper_tables.subprocess, "run", run_script)


def test_run_is_kept_and_not_done_again(
    tmp_path, monkeypatch, capfd, in_this_process, short_episodes
):
    monkeypatch.setattr(paper_tables, "POLICIES", tmp_path / "policies")
    few = ["--eval-queries", "1", "--num-demos", "20", "--eval-every", "60"]
    monkeypatch.setitem(paper_tables.RECIPES, "bc", few)
    cell = CELLS["bc-config-wall"]
    paper_tables.run(cell, 5, 60, 2, tmp_path / "runs")
    kept = json.loads((tmp_path / "policies" / "bc-config-wall-s5.json").read_text())
    assert kept["cell"] == cell.name and kept["seed"] == kept["args"]["seed"] == 5
    assert kept["steps"] == 60 and kept["num_queries"] == 2
    assert [step for step, _ in kept["curve"]] == [60]
    assert re.fullmatch(r"[0-9a-f]{7,}\+?", kept["commit"])
    load_network(tmp_path / "policies" / "bc-config-wall-s5.onnx")
    capfd.readouterr()
    paper_tables.run(cell, 5, 60, 2, tmp_path / "runs")
    assert capfd.readouterr().out == "bc-config-wall-s5: done before\n"
