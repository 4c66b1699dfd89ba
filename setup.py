"""Stops pip before it searches packages for a Python that none of them supports any more."""

import sys

from setuptools import setup

if sys.version_info < (3, 10):  # noqa: UP036
    sys.exit(
        f"RoboArm-NMP needs Python 3.10 or later, and this is {sys.version_info[0]}."
        f"{sys.version_info[1]}: make the virtual environment with a later one, such as "
        f"`python3.11 -m venv .venv`"
    )
setup()
