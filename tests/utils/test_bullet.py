"""PyBullet's line about its build is never printed, and nothing else is lost."""

import subprocess
import sys

SCRIPT = """
import os
import roboarm_nmp
from roboarm_nmp.utils import workers

def make_worker():
    return abs

if __name__ == "__main__":
    assert list(workers.run(make_worker, (), [-1, -1], 1)) == [1, 1]
    os.write(2, b"an error of C code")
"""


def test_import_prints_nothing_here_and_in_workers(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, tmp_path / "script.py"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "an error of C code")
