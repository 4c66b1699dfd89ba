"""Obstacles and scenes as values, distributions of scenes, and scene files."""
