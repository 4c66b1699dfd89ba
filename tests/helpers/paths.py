"""Folders that tests need."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The repository."""
LIBRARY = ROOT / "src" / "roboarm_nmp"
"""The package, with links to the folders of the root."""
