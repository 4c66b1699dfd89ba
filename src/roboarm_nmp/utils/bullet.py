"""PyBullet, without the line "pybullet build time: ..." that its C code prints when it is imported.

from roboarm_nmp.utils.bullet import load_urdf
from roboarm_nmp.utils.bullet import pybullet as p
"""

import contextlib
import ctypes
import os
from typing import Any


@contextlib.contextmanager
def _no_stderr():
    """A context in which what C code writes on stderr is lost."""
    try:
        stderr = os.dup(2)
    except OSError:  # it is closed
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


with _no_stderr():
    import pybullet

__all__ = ["load_urdf", "pybullet"]

_LC_NUMERIC_MASK = 2  # of glibc's newlocale
_C = ctypes.CDLL(None)
_C.newlocale.restype = _C.uselocale.restype = ctypes.c_void_p
_C.uselocale.argtypes = [ctypes.c_void_p]
_POINTS = _C.newlocale(_LC_NUMERIC_MASK, b"C", None)


def load_urdf(*args: Any, **kwargs: Any) -> int:
    """`pybullet.loadURDF`, for which 0.5 is one half in every locale.

    PyBullet reads a URDF's numbers and those of its meshes with the locale of the process, which Qt
    and `locale.setlocale(locale.LC_ALL, "")` set: with a decimal comma, 0.5 would be 0.
    """
    before = _C.uselocale(_POINTS)  # of this thread alone
    try:
        return pybullet.loadURDF(*args, **kwargs)
    finally:
        _C.uselocale(before)
