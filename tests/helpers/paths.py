"""Folders that tests need."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The repository."""
