"""Errors that are no mistake of a trainer, such as a full disk, end it with one or two lines."""

import errno
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import torch

from roboarm_nmp.utils.signals import exit_interrupted

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)


def check_finite(name: str, values: torch.Tensor | np.ndarray) -> None:
    """Raise FloatingPointError, which ends a run with a line, if training has diverged.

    Args:
        name: of the values, a plural, for the message.
        values: tensor or array.
    """
    if not torch.as_tensor(values).isfinite().all():
        raise FloatingPointError(f"{name} are no longer finite: lower --learning-rate")


def say_plainly(run: Path, kind, error, trace) -> None:
    """Python's `excepthook`: one or two lines for errors that are no mistake of the program."""
    checkpoint = ""
    if (run / "checkpoint.pt").exists():
        checkpoint = f"--resume {run} continues from the last checkpoint"
    if isinstance(error, KeyboardInterrupt):
        print(file=sys.stderr)  # ends the line of a progress bar
        exit_interrupted(error, checkpoint or f"no checkpoint yet; --resume {run} starts again")
    if isinstance(error, MemoryError) or "allocate" in str(error):  # PyTorch's, a RuntimeError
        text = f"error: out of memory {str(error).partition(chr(10))[0]}".rstrip()
    elif isinstance(error, (EOFError, ConnectionError)):
        text = "error: a process with environments has died"
    elif isinstance(error, BrokenProcessPool) or getattr(error, "errno", None) in DISK_ERRORS:
        text = f"error: {error}"
    elif isinstance(error, FloatingPointError):
        text = f"error: training has diverged: {error}; its files are in {run}"
        checkpoint = ""
    else:
        return sys.__excepthook__(kind, error, trace)
    print("\n".join(filter(None, ["", text, checkpoint])), file=sys.stderr)
