"""SIGTERM (`kill`, `timeout`, cluster schedulers) ends a command like Ctrl-C.

A command calls `raise_on_sigterm` first. Where it handles Ctrl-C, it handles SIGTERM too:

    except KeyboardInterrupt as interrupt:
        exit_interrupted(interrupt, "the same command continues")
"""

import signal
import sys


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived. Raised in the main thread, like the KeyboardInterrupt of Ctrl-C."""


def raise_on_sigterm():
    """From now on, SIGTERM raises `Terminated`. Call it in the main thread of a command."""

    def handle(number, frame):
        raise Terminated

    signal.signal(signal.SIGTERM, handle)


def exit_interrupted(interrupt, advice):
    """Print one line on stderr and end the process.

    Args:
        interrupt: the KeyboardInterrupt. The exit code is 143 for `Terminated`, otherwise 130, as
            shells report a process that the signal has ended.
        advice: how to continue, or what was kept.
    """
    terminated = isinstance(interrupt, Terminated)
    print(f"{'terminated' if terminated else 'interrupted'}; {advice}", file=sys.stderr)
    sys.exit(143 if terminated else 130)
