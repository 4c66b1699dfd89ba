"""The command `roboarm`: its subcommands, their help, and its errors."""

import argparse
import os
import re
import signal
import subprocess
import sys
import time

import pytest
import tyro

from roboarm_nmp import __main__ as command

NAMES = [*(name for name in command.COMMANDS if name not in ("train", "robot")), "robot check"]
NAMES += [f"train {name}" for name in command.TRAINERS]
WITHOUT_GROUPS = ("robot check", "data", "policies", "benchmark")  # which have few flags


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "roboarm_nmp", *arguments], capture_output=True, text=True
    )


@pytest.mark.parametrize("name", ["collect", "queries"])
def test_planning_without_ompl_is_refused_in_one_line(name, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ompl", None)
    for module in ("planner", "ompl_planners"):
        monkeypatch.delitem(sys.modules, f"roboarm_nmp.planning.{module}", raising=False)
    monkeypatch.setattr(sys, "argv", sys.argv)
    assert command.main([name, "--task", "wall"]) == 1
    message = capsys.readouterr().err
    assert f"roboarm {name} needs OMPL" in message and message.count("\n") == 1


@pytest.fixture
def same_process(monkeypatch):
    """What a command changes in its process."""
    monkeypatch.setattr(sys, "argv", sys.argv)
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.mark.filterwarnings("ignore:.*found in sys.modules")
@pytest.mark.parametrize("name", NAMES)
def test_every_subcommand_has_help_with_an_example_and_groups(name, same_process, capsys):
    with pytest.raises(SystemExit) as end:
        command.main([*name.split(), "--help"])
    assert not end.value.code
    shown = capsys.readouterr().out
    assert f"usage: roboarm {name} [-h]" in shown
    examples = [line for line in shown.splitlines() if "usage:" not in line]
    assert any(f"roboarm {name} " in f"{line} " for line in examples)
    if name not in WITHOUT_GROUPS:
        groups = re.findall(r"(?m)^[^\w\n]*([a-z-]+) options[^\w\n]*$", shown)
        assert groups and len(set(groups)) == len(groups)
        assert ("algorithm" in groups) == name.startswith("train ")


def test_help_is_quick_and_lists_all_subcommands():
    began = time.perf_counter()
    done = run("--help")
    assert time.perf_counter() - began < 2.0  # 0.3 s where nothing else runs
    assert all(name in done.stdout for name in command.COMMANDS)
    trainers = run("train", "--help")
    assert all(name in trainers.stdout for name in command.TRAINERS)


@pytest.mark.filterwarnings("ignore:.*found in sys.modules")
@pytest.mark.parametrize("name", NAMES)
def test_signal_ends_every_subcommand_with_one_line(name, same_process, monkeypatch, capsys):
    def parse(*_, **__):  # the first thing that a script does
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)

    monkeypatch.setattr(tyro, "cli", parse)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)
    with pytest.raises(KeyboardInterrupt) as interrupt:
        command.main(name.split())
    with pytest.raises(SystemExit) as end:
        sys.excepthook(interrupt.type, interrupt.value, interrupt.tb)
    assert end.value.code == 143
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("terminated; ")


def test_ctrl_c_while_workers_start_ends_an_evaluation_with_one_line():
    arguments = ["--policy", "random", "--task", "no_obstacles", "--workers", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "roboarm_nmp", "evaluate", *arguments],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    began = process.stderr.readline()
    os.killpg(process.pid, signal.SIGINT)  # from a terminal, to the workers too
    _, error = process.communicate(timeout=100)
    assert began.startswith("0%, 0/10000, ") and process.returncode == 130
    line = "interrupted; nothing was written; the same command starts again"
    assert [one for one in error.splitlines() if not one.startswith("0%, ")] == [line]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [(["evalute"], "did you mean evaluate?"), (["train", "sca"], "did you mean sac?")],
)
def test_unknown_subcommand_is_rejected_in_one_line(arguments, text):
    done = run(*arguments)
    assert done.returncode == 2 and text in done.stderr.splitlines()[-1]
    assert not done.stdout
