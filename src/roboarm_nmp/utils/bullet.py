"""PyBullet, without the line "pybullet build time: ..." that its C code prints when it is imported.

from roboarm_nmp.utils.bullet import pybullet as p
"""

import contextlib
import os


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

__all__ = ["pybullet"]
