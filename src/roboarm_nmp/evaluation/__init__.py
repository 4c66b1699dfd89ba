"""Evaluation: one episode loop and one evaluation for everybody."""
