"""Progress of long work on stderr: a bar in a terminal, a line every 30 s in a log file."""

import multiprocessing
import sys
from collections.abc import Iterable

from tqdm import tqdm

LOG_INTERVAL = 30  # s


class _LogBar(tqdm):
    def set_postfix(self, ordered_dict=None, refresh=True, **values):
        super().set_postfix(ordered_dict, refresh=False, **values)  # the next line shows them


class _LogFile:
    """The file of a bar whose every state is a line of its own."""

    def write(self, text):
        text = text.strip("\r\n ")
        if text:
            sys.stderr.write(f"{text}\n")

    def flush(self):
        sys.stderr.flush()


def progress_bar(
    iterable: Iterable | None = None,
    description: str | None = "",
    total: int | None = None,
    unit: str = "step",
    initial: int = 0,
    transient: bool = False,
    disable: bool = False,
    smoothing: float = 0.3,
) -> tqdm:
    """A `tqdm` bar.

    Args:
        iterable: to iterate over, or None: `update(n)` counts.
        description: of the work; precedes the numbers.
        total: number of units; by default the length of `iterable`.
        unit: of the numbers, a singular.
        initial: number of units that are done already.
        transient: the bar disappears at its end, and work of less than 30 s leaves no line in a log
            file.
        disable: show nothing.
        smoothing: of the rate, as in tqdm: 0 for the mean, 1 for the latest.
    """
    common = {
        "total": total,
        "initial": initial,
        "unit": unit,
        "smoothing": smoothing,
        "leave": not transient,
        "disable": disable,
    }
    if sys.stderr.isatty():
        return tqdm(iterable, desc=description, mininterval=0.2, **common)
    return _LogBar(
        iterable,
        desc=f"{description}: " if description else "",
        bar_format="{desc}{percentage:.0f}%, {n_fmt}/{total_fmt}, {elapsed}<{remaining}, "
        "{rate_fmt}{postfix}",
        file=_LogFile(),
        mininterval=LOG_INTERVAL,
        maxinterval=LOG_INTERVAL,  # tqdm draws slow bars at least so often
        delay=LOG_INTERVAL if transient else 0,
        position=0,  # at another one, tqdm moves the cursor
        **common,
    )


def write_line(text: str) -> None:
    """Write a line on stderr, above a bar."""
    if multiprocessing.parent_process() is not None and sys.stderr.isatty():
        text = f"\r\x1b[K{text}"  # replaces the bar of the parent, which will draw it again
    tqdm.write(text, file=sys.stderr)
