"""Rotations as quaternions (x, y, z, w) and as matrices.

SciPy's `Rotation` rounds the last bits differently, which would reach collision checks and saved
files, and takes three times as long for a single rotation.
"""

import numpy as np


def matrix(quaternion) -> np.ndarray:
    """A quaternion (xyzw) of norm 1 as a rotation matrix (3, 3)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) as quaternions (..., 4), xyzw; the largest number is positive.

    The result is the row of 4 q q^T with the largest diagonal entry: q times a positive number.
    """
    m = rotations
    x, y, z = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    xy = m[..., 0, 1] + m[..., 1, 0]
    xz = m[..., 0, 2] + m[..., 2, 0]
    yz = m[..., 1, 2] + m[..., 2, 1]
    xw = m[..., 2, 1] - m[..., 1, 2]
    yw = m[..., 0, 2] - m[..., 2, 0]
    zw = m[..., 1, 0] - m[..., 0, 1]
    rows = [
        [1 + x - y - z, xy, xz, xw],
        [xy, 1 - x + y - z, yz, yw],
        [xz, yz, 1 - x - y + z, zw],
        [xw, yw, zw, 1 + x + y + z],
    ]
    rows = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    largest = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    return row / np.linalg.norm(row, axis=-1, keepdims=True)


def signed(quaternion: np.ndarray) -> np.ndarray:
    """A quaternion (4,) or its negative, the same rotation, whose largest number is positive."""
    return -quaternion if quaternion[np.argmax(np.abs(quaternion))] < 0.0 else quaternion


def rotation_angle(quaternion, other) -> np.ndarray:
    """The angle between rotations, quaternions (..., 4) of norm 1: rad, (...), from 0 to pi.

    From the shorter one of two chords: accurate for small angles, unlike the arc cosine.
    """
    quaternion = np.asarray(quaternion, dtype=np.float64)
    other = np.asarray(other, dtype=np.float64)
    squared_chord = np.minimum(
        np.square(quaternion + other).sum(-1), np.square(quaternion - other).sum(-1)
    )
    return 4.0 * np.arcsin(np.minimum(np.sqrt(squared_chord) / 2.0, 1.0))
