"""Progress: a bar in a terminal, a line every 30 s in a log file."""

import io
import sys
import time

from roboarm_nmp.utils import progress
from roboarm_nmp.utils.progress import progress_bar, write_line


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_log_file_gets_a_line_per_interval(capsys, monkeypatch):
    assert progress.LOG_INTERVAL == 30
    monkeypatch.setattr(progress, "LOG_INTERVAL", 0.2)
    bar = progress_bar(description="wall", total=40, initial=10, unit="demo")
    for _ in range(30):
        time.sleep(0.02)
        bar.update()
        bar.set_postfix(success="0.50")  # more often than lines
    bar.close()
    error = capsys.readouterr().err
    lines = error.splitlines()
    assert "\r" not in error and error.endswith("\n") and 3 <= len(lines) <= 8
    assert lines[0].startswith("wall: 25%, 10/40, ")
    assert lines[-1].startswith("wall: 100%, 40/40, ") and "success=0.50" in lines[-1]


def test_short_transient_work_leaves_nothing_in_a_log_file(capsys):
    assert list(progress_bar(range(3), "validation", transient=True)) == [0, 1, 2]
    assert capsys.readouterr().err == ""


def test_bar_stays_in_a_terminal_below_other_lines(monkeypatch):
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    bar = progress_bar(total=3, unit="query")
    bar.update(3)
    write_line("a worker died")
    bar.close()
    lines = terminal.getvalue().splitlines()
    assert "a worker died" in lines and "100%" in lines[-1] and "3/3" in lines[-1]
