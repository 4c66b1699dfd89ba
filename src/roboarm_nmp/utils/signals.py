"""Ctrl-C and SIGTERM (`kill`, `timeout`, cluster schedulers) end a command with one line.

So does, without a line, a reader that closes its output (`roboarm train sac --help | head`).

A command calls `end_with_one_line` first, and again as soon as another advice holds:

    end_with_one_line("the same command continues")
"""

import errno
import os
import select
import signal
import sys
from pathlib import Path
from typing import NoReturn


def program() -> str:
    """The name of the running program, for messages: `roboarm evaluate`, or a script's name."""
    main = sys.modules["__main__"]
    return getattr(main, "PROGRAM", Path(sys.argv[0]).name)  # `roboarm` sets it


def error_line(error: object) -> str:
    """An error in one line that begins with the command that was typed: `roboarm evaluate: …`."""
    return f"{program()}: {error}".replace("\n", " ")


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived. Raised in the main thread, like the KeyboardInterrupt of Ctrl-C."""


def end_with_one_line(advice: str) -> None:
    """From now on, Ctrl-C and SIGTERM unwind the program and end it as `exit_interrupted` does.

    Call it in the main thread of a command, not in a library: it replaces `sys.excepthook`.

    Args:
        advice: how to continue, or what was kept.
    """

    def terminate(number, frame):
        raise Terminated

    def hook(kind, error, trace):
        if isinstance(error, KeyboardInterrupt):
            exit_interrupted(error, advice)
        if isinstance(error, BrokenPipeError) and _output_is_closed():
            sys.exit(128 + signal.SIGPIPE)
        if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
            _end_without_output(error)
        sys.__excepthook__(kind, error, trace)

    signal.signal(signal.SIGTERM, terminate)
    sys.excepthook = hook


def flush_output() -> None:
    """Write what is left of stdout; if its disk is full, end the program with a line."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        _end_without_output(error)


def _end_without_output(error: OSError) -> NoReturn:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    print(f"{program()}: cannot write its output: {error.strerror}", file=sys.stderr)
    sys.exit(1)


def _output_is_closed():
    """Whether nobody reads stdout any more. What Python writes there at exit then goes nowhere."""
    poll = select.poll()
    poll.register(sys.stdout, 0)
    if not any(event & select.POLLERR for _, event in poll.poll(0)):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return True


def exit_interrupted(interrupt: KeyboardInterrupt, advice: str) -> NoReturn:
    """Print one line on stderr and end the process.

    Args:
        interrupt: the KeyboardInterrupt. The exit code is 143 for `Terminated`, otherwise 130, as
            shells report a process that the signal has ended.
        advice: how to continue, or what was kept.
    """
    if isinstance(interrupt, Terminated):
        print(f"terminated; {advice}", file=sys.stderr)
        sys.exit(128 + signal.SIGTERM)
    print(f"interrupted; {advice}", file=sys.stderr)
    sys.exit(128 + signal.SIGINT)
