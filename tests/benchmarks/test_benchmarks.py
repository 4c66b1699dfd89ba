"""Every benchmark can be started."""

import subprocess
import sys

import pytest
from paths import ROOT

PEERS = {"env_throughput": "panda_gym", "viewer": "viser"}  # of extras, imported first thing
BENCHMARKS = sorted(
    set((ROOT / "benchmarks").glob("*.py")) - {ROOT / "benchmarks/markdown_tables.py"}
)


@pytest.mark.parametrize("path", BENCHMARKS, ids=lambda path: path.stem)
def test_it_explains_itself(path):
    if path.stem in PEERS:
        pytest.importorskip(PEERS[path.stem], reason="needs an extra")
    done = subprocess.run([sys.executable, path, "--help"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "usage:" in done.stdout and "--help" in done.stdout
