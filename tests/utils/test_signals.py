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


WORKERS = """
import concurrent.futures.process as pool
import os
import signal
from roboarm_nmp.utils import workers
from roboarm_nmp.utils.signals import end_with_one_line

def make_worker():
    return abs

if __name__ == "__main__":
    end_with_one_line("start again")
    start = pool._ExecutorManagerThread.start

    def signal_and_start(thread):
        os.kill(os.getpid(), signal.SIGTERM)
        start(thread)

    pool._ExecutorManagerThread.start = signal_and_start
    list(workers.run(make_worker, (), [1, 2], 2))
"""


def test_signal_while_workers_are_started_ends_in_one_line(tmp_path):
    (tmp_path / "script.py").write_text(WORKERS)
    command = [sys.executable, tmp_path / "script.py"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    [line] = ended.stderr.splitlines()
    assert ended.returncode == 143 and line.startswith("terminated")


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


def test_other_broken_pipe_keeps_its_traceback():
    code = ENDLESS.replace('print("more")', "raise BrokenPipeError")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 1 and "BrokenPipeError" in ended.stderr
