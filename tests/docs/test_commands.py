"""Every `roboarm …` and `python …` line of README and the docs is accepted by its parser.

Flags exist, values have the right type, and tasks and policies are known. Nothing is run.
"""

import argparse
import dataclasses
import importlib
import io
import re
import shlex
import sys
from contextlib import redirect_stderr, redirect_stdout

import markdown_tables
import pytest
from docs_scripts import load
from paths import ROOT

from roboarm_nmp import TASKS, __main__
from roboarm_nmp.policies.registry import find_policy
from roboarm_nmp.utils import flags
from roboarm_nmp.viewer.episodes import DEMO

OTHER_TASKS = {"mixed_scenes", "containers", "roadmaps"}  # to train on; a folder, for the viewer
OPTIONAL = {"panda_gym", "optuna", "ray", "viser"}  # imported before arguments are parsed
SHELL = ("", "bash", "sh", "shell", "console", "text")
flags_of = load("make_command_line").flags_of


def blocks(page):
    """The fenced blocks of commands, with continued lines joined."""
    found = re.findall(r"^ *```(\w*)[^\n]*\n(.*?)^ *```", page.read_text(), re.S | re.M)
    return [re.sub(r"\\\n\s*", " ", text) for kind, text in found if kind in SHELL]


def commands_of(text):
    """Lists of words: each command that the project's parsers accept, without its comment."""
    for line in text.splitlines():
        if not re.search(r"(^|&& |; |\$ |\S=\S* )(time )?(roboarm|python) ", line.strip()):
            continue  # perhaps an output, with single quotes
        lexer = shlex.shlex(line.strip().removeprefix("$ "), posix=True, punctuation_chars=";&|")
        lexer.whitespace_split = True
        commands = [[]]
        for word in lexer:
            if set(word) <= set(";&|"):
                commands.append([])
            else:
                commands[-1].append(word)
        for words in commands:
            while words and re.fullmatch(r"[A-Z_]+=\S*|time", words[0]):
                words = words[1:]
            if words[:3] == ["python", "-m", "roboarm_nmp"]:
                words = ["roboarm", *words[3:]]
            is_script = words[:1] == ["python"] and words[1:] and words[1].endswith(".py")
            if is_script or words[:1] == ["roboarm"]:
                yield words


def all_commands():
    """Command line -> the page where it stands first, and the copies of scripts made there."""
    found = {}
    for page in markdown_tables.pages():
        text = "\n".join(blocks(page))
        copies = {new: old for old, new in re.findall(r"^cp (\S+) (\S+)$", text, re.M)}
        for words in commands_of(text):
            found.setdefault(shlex.join(words), (page.name, copies))
    return found


COMMANDS = all_commands()


class Parsed(Exception):
    """Raised in place of everything that follows the parsing by `argparse`."""


def module_of(words, copies):
    """The module that a command runs, and the arguments that it parses."""
    if words[0] == "roboarm":
        commands, arguments = __main__.COMMANDS, words[1:]
        if arguments[0] == "train":
            commands, arguments = __main__.TRAINERS, arguments[1:]
        assert arguments[0] in commands, f"there is no command {arguments[0]}"
        path = f"roboarm_nmp.{commands[arguments[0]][0]}"
        module = importlib.import_module(path)
        if hasattr(module, "__path__"):
            module = importlib.import_module(f"{path}.__main__")
        if arguments[0] == "robot":
            assert arguments.pop(1) == "check"
        return module, arguments[1:]
    script = ROOT / copies.get(words[1], words[1])
    assert script.exists(), f"there is no {words[1]}"
    if script.parent.name in ("benchmarks", "docs", "examples"):
        return importlib.import_module(script.stem), words[2:]  # these folders are on the path
    return importlib.import_module(f"roboarm_nmp.{script.parent.name}.{script.stem}"), words[2:]


def parse(words, copies, monkeypatch):
    """The parsed flags of a command, a dict; raises SystemExit as its parser does."""
    module, arguments = module_of(words, copies)
    if "--help" in arguments:
        return {}
    arguments = arguments[: arguments.index("--")] if "--" in arguments else arguments  # sweep's
    Args = flags_of(module)
    if Args is not None:
        args = flags.parse(Args, arguments)
        flags.check(args)
    else:
        parse_args = argparse.ArgumentParser.parse_known_args

        def stop(parser, words=None, namespace=None):
            raise Parsed(*parse_args(parser, words, namespace))

        monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", stop)
        monkeypatch.setattr(sys, "argv", [words[1], *arguments])
        with pytest.raises(Parsed) as parsed:
            module.main()
        args, others = parsed.value.args
        assert not others or module.__name__ == "07_own_algorithm", others  # a trainer's flags
    values = {}
    for name, value in vars(args).items():  # a group of flags or a flag
        values |= vars(value) if dataclasses.is_dataclass(value) else {name: value}
    return values


def is_example(value):
    """Whether a value stands for the reader's own file or name: `runs/RUN`, `NAME`, `x.pt`."""
    return bool(re.search(r"[A-Z]{3,}|/|\.\w+$|^my_", str(value)))


def as_list(value):
    """Of a flag that takes one value or several."""
    if value is None:
        return []
    return list(value) if isinstance(value, list | tuple) else [value]


@pytest.mark.parametrize("command", COMMANDS)
def test_command_is_accepted_by_its_parser(command, monkeypatch):
    page, copies = COMMANDS[command]
    out, error = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(error):
        try:
            values = parse(shlex.split(command), copies, monkeypatch)
        except ModuleNotFoundError as missing:
            if missing.name not in OPTIONAL:
                raise
            pytest.skip(f"needs {missing.name}")
        except (SystemExit, ValueError) as end:
            pytest.fail(f"{page}: {command}\n{out.getvalue()}{error.getvalue()}{end}")
    for task in as_list(values.get("task")):
        assert task in {*TASKS, *OTHER_TASKS} or is_example(task), f"{page}: unknown task {task}"
    for policy in as_list(values.get("policy")):
        if not is_example(policy) and policy != DEMO:
            find_policy(policy)  # raises PolicyError
