"""Every `roboarm …` and `python …` line of README and the docs is accepted by its parser.

Each command runs in this process up to the point where its arguments are parsed: flags exist,
values have the right type, and tasks, policies and encoders are known.
"""

import argparse
import dataclasses
import io
import re
import runpy
import shlex
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout

import markdown_tables
import pytest
import tyro
from paths import ROOT

from roboarm_nmp import TASKS, __main__
from roboarm_nmp.policies.registry import find_policy

OTHER_TASKS = {"mixed_scenes", "containers", "roadmaps"}  # to train on; a folder, for the viewer
OPTIONAL = {"panda_gym", "optuna", "ray", "viser"}  # imported before arguments are parsed
SHELL = ("", "bash", "sh", "shell", "console", "text")


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
        copies = dict(re.findall(r"^cp (\S+) (\S+)$", text, re.M))
        copies = {new: old for old, new in copies.items()}
        for words in commands_of(text):
            found.setdefault(shlex.join(words), (page.name, copies))
    return found


COMMANDS = all_commands()


class Parsed(Exception):
    """Raised in place of everything that follows the parsing."""


def parse(words, copies, monkeypatch):
    """The parsed arguments of a command; raises SystemExit as the parser does."""
    parse_args, cli = argparse.ArgumentParser.parse_args, tyro.cli

    def stop(parser):
        def stopping(*args, **kwargs):
            raise Parsed(parser(*args, **kwargs))

        return stopping

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop(parse_args))
    monkeypatch.setattr(tyro, "cli", stop(cli))
    try:
        if words[0] == "roboarm":
            code = __main__.main(words[1:])
        else:
            script = ROOT / copies.get(words[1], words[1])
            assert script.exists(), f"there is no {words[1]}"
            monkeypatch.setattr(sys, "argv", [str(script), *words[2:]])
            monkeypatch.syspath_prepend(str(script.parent))
            code = runpy.run_path(str(script), run_name="__main__")
    except Parsed as parsed:
        return parsed.args[0]
    return code


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
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    with redirect_stdout(out), redirect_stderr(error):
        try:
            args = parse(shlex.split(command), copies, monkeypatch)
        except ModuleNotFoundError as missing:
            if missing.name not in OPTIONAL:
                raise
            pytest.skip(f"needs {missing.name}")
        except SystemExit as end:
            if end.code in (None, 0) and "--help" in command:
                return
            pytest.fail(f"{page}: {command}\n{out.getvalue()}{error.getvalue()}{end.code}")
    if isinstance(args, int):
        assert args == 0, error.getvalue()
        return
    values = {}
    for name, value in vars(args).items():  # a group of flags or a flag
        values |= vars(value) if dataclasses.is_dataclass(value) else {name: value}
    for task in as_list(values.get("task")):
        assert task in {*TASKS, *OTHER_TASKS} or is_example(task), f"{page}: unknown task {task}"
    for policy in as_list(values.get("policy")):
        if not is_example(policy):
            find_policy(policy)  # raises PolicyError


def test_misspelt_flags_and_names_are_found(monkeypatch):
    for command in (
        "roboarm evaluate --polcy go-to-goal --task wall",
        "roboarm evalute --policy go-to-goal --task wall",
        "python clean_rl_scripts/sac_her_mp.py --goal-type elbow",
        "python benchmarks/baselines.py --only walls",
    ):
        with redirect_stderr(io.StringIO()), redirect_stdout(io.StringIO()):
            try:
                code = parse(shlex.split(command), {}, monkeypatch)
            except SystemExit as end:
                code = end.code
        assert code not in (None, 0) and isinstance(code, int | str), command
        monkeypatch.undo()


QUICK = [
    command
    for command in COMMANDS
    if re.match(r"roboarm (policies|data describe) ?", command)
    and not re.search(r"[A-Z]{3,}|\.yaml", command)
]


@pytest.mark.parametrize("command", QUICK)
def test_quick_command_runs(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    try:
        code = __main__.main(shlex.split(command)[1:])
    except SystemExit as end:
        code = end.code
    assert not code and capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("command", [one for one in COMMANDS if one.startswith("roboarm evaluate")])
def test_evaluation_begins_without_an_error(command, tmp_path):
    """At most a minute: longer ones are ended then."""
    if re.search(r"[A-Z]{3,}|\.yaml|runs/", command):
        pytest.skip("needs the reader's own files")
    run(command, tmp_path)


def run(command, folder):
    words = [sys.executable, "-m", "roboarm_nmp", *shlex.split(command)[1:]]
    try:
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        return
    assert done.returncode == 0, done.stderr
