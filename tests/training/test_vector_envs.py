"""training/vector_envs.py: processes with environments end with their trainer."""

import subprocess
import sys

import pytest

SCRIPT = """
import functools, os, signal, sys
import gymnasium
import numpy as np
from roboarm_nmp.training.vector_envs import async_envs

if __name__ == "__main__":
    number = int(sys.argv[2])
    envs = async_envs([functools.partial(gymnasium.make, "CartPole-v1")] * number)
    envs.reset(seed=1)
    pids = [process.pid for process in envs.processes]
    print(*pids, flush=True)
    for pid in pids:
        os.kill(pid, signal.SIGINT)
        os.kill(pid, signal.SIGTERM)
    envs.step(np.zeros(number, int))
    exec(sys.argv[1])
"""
KILL_ONE = """
from pathlib import Path
from roboarm_nmp.training.errors import say_plainly
sys.excepthook = functools.partial(say_plainly, Path("a"))
envs.processes[0].kill()
for _ in range(2):
    envs.step(np.zeros(2, int))
"""


@pytest.mark.parametrize(
    "end, number, code, message",
    [
        ("envs.step_async(np.zeros(1, int)); sys.exit(3)", 1, 3, ""),
        ("os.kill(os.getpid(), signal.SIGKILL)", 1, -9, ""),
        (KILL_ONE, 2, 1, "error: a process with environments has died"),
    ],
)
def test_processes_survive_signals_and_end_with_the_trainer(tmp_path, end, number, code, message):
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, tmp_path / "script.py", end, str(number)]
    # It is over when the last process has closed the pipes of stdout and stderr.
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == code, ended.stderr
    assert len(ended.stdout.split()) == number
    lines = [line for line in ended.stderr.splitlines() if line and "resource_tracker" not in line]
    assert lines == [message] * bool(message)
