"""What all values in scenes ask of numbers and quaternions."""

import math

import numpy as np

IDENTITY = (0.0, 0.0, 0.0, 1.0)
MAX_LENGTH, MAX_SCENE_OBSTACLES = 1000.0, 10_000
"""Limits of sizes and coordinates (m), and of a scene's obstacles: more is a mistake."""
# Quaternions: of up to the first deviation of the norm from 1, they stay as they are, bit for bit;
# up to the second, such as (0, 0, 0.7071, 0.7071), they are normalised.
_EXACT_NORM, _ROUNDED_NORM = 1e-6, 0.01


def is_number(value):
    """Whether a value is a finite real number of Python or NumPy: no text, date or tensor."""
    try:
        kinds = (int, float, np.integer, np.floating)
        return isinstance(value, kinds) and math.isfinite(value)
    except (OverflowError, TypeError):  # 10**400; a time span, an integer according to NumPy
        return False


def unit_quaternion(orientation):
    """A quaternion (x, y, z, w) as a tuple of norm 1.

    Raises ValueError: it is not four finite numbers, or its norm differs from 1 by more than 1 %.
    """
    orientation = tuple(orientation)
    if len(orientation) != 4 or not all(map(is_number, orientation)):
        raise ValueError(f"a quaternion x, y, z, w is four finite numbers, got {orientation}")
    norm = math.hypot(*orientation)
    if not abs(norm - 1) <= _ROUNDED_NORM:
        raise ValueError(
            f"a quaternion x, y, z, w must have norm 1 (within 1 %), got norm {norm:.9g}"
        )
    if abs(norm - 1) <= _EXACT_NORM:
        return orientation
    return tuple(float(number) / norm for number in orientation)
