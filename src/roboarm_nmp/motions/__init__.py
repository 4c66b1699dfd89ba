"""Motions: trajectories and their formats, time parameterisation, metrics."""
