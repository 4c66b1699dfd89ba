"""Poses as inputs of networks."""

import torch


def pose_difference(pose, goal):
    """What is left from poses to goals: (N, 7), (N, 7) -> (N, 6).

    Poses are positions (m) and quaternions (xyzw) of norm 1. The difference is that of the
    positions (m), and the vector part of the rotation between them, in the world's axes: its axis
    times the sine of half the angle. A quaternion and its negative give the same.
    """
    here, there = pose[:, 3:], goal[:, 3:]
    x, y, z, w = here[:, 0:1], here[:, 1:2], here[:, 2:3], here[:, 3:4]
    a, b, c, d = there[:, 0:1], there[:, 1:2], there[:, 2:3], there[:, 3:4]
    vector = torch.cat(
        [
            w * a - d * x + c * y - b * z,
            w * b - d * y + a * z - c * x,
            w * c - d * z + b * x - a * y,
        ],
        dim=1,
    )
    is_longer = (here * there).sum(dim=1, keepdim=True) < 0.0  # than half a turn
    return torch.cat([goal[:, :3] - pose[:, :3], torch.where(is_longer, -vector, vector)], dim=1)
