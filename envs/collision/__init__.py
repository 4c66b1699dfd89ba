"""Exact collision checks and signed distances, compiled."""
