"""Sensors, point clouds, and encoders of scenes."""
