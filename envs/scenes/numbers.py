"""What all values in scenes ask of numbers and quaternions."""

import math
from collections.abc import Iterable

import numpy as np

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""
IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)
MAX_LENGTH = 1000.0
"""m, the limit of sizes and coordinates."""
MAX_SCENE_OBSTACLES = 10_000
# Quaternions: of up to the first deviation of the norm from 1, they stay as they are, bit for bit;
# up to the second, such as (0, 0, 0.7071, 0.7071), they are normalised.
_EXACT_NORM, _ROUNDED_NORM = 1e-6, 0.01


def is_number(value: object) -> bool:
    """Whether a value is a finite real number of Python or NumPy: no text, date or tensor."""
    try:
        kinds = (int, float, np.integer, np.floating)
        return isinstance(value, kinds) and math.isfinite(value)
    except (OverflowError, TypeError):  # 10**400; a time span, an integer according to NumPy
        return False


def unit_quaternion(orientation: Iterable[float]) -> Quaternion:
    """A quaternion (x, y, z, w) as a tuple of norm 1.

    Raises ValueError: it is not four finite numbers, or its norm differs from 1 by more than 1 %.
    """
    quaternion = tuple(orientation)
    if len(quaternion) != 4 or not all(map(is_number, quaternion)):
        raise ValueError(f"a quaternion x, y, z, w is four finite numbers, got {quaternion}")
    norm = math.hypot(*quaternion)
    if not abs(norm - 1) <= _ROUNDED_NORM:
        raise ValueError(
            f"a quaternion x, y, z, w must have norm 1 (within 1 %), got norm {norm:.9g}"
        )
    if abs(norm - 1) <= _EXACT_NORM:
        return quaternion
    x, y, z, w = quaternion
    return float(x) / norm, float(y) / norm, float(z) / norm, float(w) / norm


def multiply(left: Quaternion, right: Quaternion) -> Quaternion:
    """The product of two quaternions (x, y, z, w): the right rotation, followed by the left one."""
    a, b, c, d = left
    x, y, z, w = right
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )
