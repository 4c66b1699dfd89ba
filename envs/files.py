"""Writing files whole."""

import os
import tempfile
from pathlib import Path


def write_atomically(path, contents):
    """Write bytes: at every moment, whatever happens, `path` is the old file or the whole new one.

    Raises OSError if it cannot be written; an old file is left as it was, and no other.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(contents)
        replace_atomically(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def check_writable(path):
    """Raise ValueError if no file can be written at `path`. To be called before long work."""
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a directory, not a file")
    try:
        tempfile.TemporaryFile(dir=path.absolute().parent).close()
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error.strerror}") from error


def replace_atomically(temporary, path):
    """Rename a file that is whole, in `path`'s folder, to `path`, which it replaces.

    What was written is brought to the disk first: after a power cut too, `path` is whole.
    """
    with open(temporary, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(temporary, path)
