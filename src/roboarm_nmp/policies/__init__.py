"""Pretrained policies, non-learning baselines, and the safety filter."""
