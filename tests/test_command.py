"""The command `roboarm`: its subcommands, their help, and its errors."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from roboarm_nmp import __main__ as command

NAMES = [*(name for name in command.COMMANDS if name != "train")]
NAMES += [f"train {name}" for name in command.TRAINERS]


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "roboarm_nmp", *arguments], capture_output=True, text=True
    )


@pytest.mark.parametrize("name", ["collect", "queries"])
def test_planning_without_ompl_is_refused_in_one_line(name, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ompl", None)
    monkeypatch.delitem(sys.modules, "roboarm_nmp.demo_generation.planning", raising=False)
    monkeypatch.setattr(sys, "argv", sys.argv)
    assert command.main([name, "--task", "wall"]) == 1
    message = capsys.readouterr().err
    assert f"roboarm {name} needs OMPL" in message and message.count("\n") == 1


@pytest.mark.parametrize("name", NAMES)
def test_every_subcommand_has_help(name):
    done = run(*name.split(), "--help")
    assert done.returncode == 0, done.stderr
    assert "usage:" in done.stdout and "--help" in done.stdout


def test_help_is_quick_and_lists_all_subcommands():
    began = time.perf_counter()
    done = run("--help")
    assert time.perf_counter() - began < 2.0  # 0.3 s where nothing else runs
    assert all(name in done.stdout for name in command.COMMANDS)
    trainers = run("train", "--help")
    assert all(name in trainers.stdout for name in command.TRAINERS)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["evalute"], "did you mean evaluate?"),
        (["train", "sca"], "did you mean sac?"),
        (["nothing"], "one of train, evaluate"),
    ],
)
def test_unknown_subcommand_is_rejected_in_one_line(arguments, text):
    done = run(*arguments)
    assert done.returncode == 2 and text in done.stderr.splitlines()[-1]
    assert not done.stdout


def test_modules_of_subcommands_exist_where_the_command_says():
    for module, _ in [*command.COMMANDS.values(), *command.TRAINERS.values()]:
        if module is not None:
            path = command.__file__.replace("__main__.py", module.replace(".", "/"))
            assert Path(f"{path}.py").exists() or Path(path, "__main__.py").exists(), module
