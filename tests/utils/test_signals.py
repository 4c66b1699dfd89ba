"""SIGTERM and Ctrl-C: one line that says how to continue, and the exit codes of shells."""

import signal
import subprocess
import sys

import pytest

COMMAND = """
import time
from roboarm_nmp.utils.signals import end_with_one_line
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


ENDLESS = """
from roboarm_nmp.utils.signals import end_with_one_line
end_with_one_line("start again")
while True:
    print("more")
"""


def test_reader_that_closes_the_output_ends_a_command_without_a_word():
    process = subprocess.Popen(
        [sys.executable, "-c", ENDLESS], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "more\n"
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait(timeout=30) == 141


def test_full_disk_of_the_output_ends_a_command_with_one_line():
    command = [sys.executable, "-m", "roboarm_nmp", "policies"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1
    assert done.stderr == "roboarm policies: cannot write its output: No space left on device\n"
