"""SIGTERM and Ctrl-C: one line that says how to continue, and the exit codes of shells."""

import signal
import subprocess
import sys

import pytest

COMMAND = """
import time
from roboarm_nmp.envs.utils.signals import end_with_one_line
end_with_one_line("nothing has begun")
end_with_one_line("start again")
try:
    print("ready", flush=True)
    time.sleep(60)
finally:
    print("cleaned up")
"""


@pytest.mark.parametrize(
    ("number", "code", "line"),
    [
        (signal.SIGTERM, 143, "terminated; start again"),
        (signal.SIGINT, 130, "interrupted; start again"),
    ],
)
def test_signal_unwinds_the_command_and_sets_its_exit_code(number, code, line):
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n"
    process.send_signal(number)
    stdout, stderr = process.communicate(timeout=30)
    assert (process.returncode, stdout) == (code, "cleaned up\n")
    assert stderr.splitlines() == [line]


def test_other_errors_keep_their_traceback():
    code = COMMAND.replace("time.sleep(60)", "1 / 0")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 1 and "ZeroDivisionError" in ended.stderr
