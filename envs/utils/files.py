"""Writing files whole, and whether they still are."""

import contextlib
import fcntl
import glob
import os
import tempfile
import uuid
import zipfile
from pathlib import Path


def write_atomically(path, contents):
    """Write bytes: at every moment, whatever happens, `path` is the old file or the whole new one.

    What is no file but a device or a pipe, such as `/dev/stdout`, is written to. Raises OSError if
    it cannot be written; an old file is left as it was, and no other.
    """
    path = Path(path)
    if _is_device(path):
        with open(path, "ab") as file:  # which may be a file all the same: nothing in it is lost
            file.write(contents)
        return
    with new_contents(path) as temporary:
        temporary.write_bytes(contents)


@contextlib.contextmanager
def new_contents(path):
    """A context whose value is the path of an empty file; at its end that replaces `path`.

    What was written is brought to the disk first: after a power cut too, `path` is the old file or
    the whole new one. After an exception it is the old one. What processes that were killed have
    left is cleared away.
    """
    path = Path(path)
    clear_leftovers(path.parent, path.name)
    while True:
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
        lock = open(temporary, "wb")  # noqa: SIM115 (closed below)
        fcntl.flock(lock, fcntl.LOCK_EX)
        if temporary.exists():  # or it looked like a leftover, before it was locked
            break
        lock.close()
    try:
        with lock:
            yield temporary
            os.fsync(lock)
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def clear_leftovers(folder, name="*"):
    """Delete what killed processes left of new contents of the file `name`, or of all, in a folder.

    Who is still writing holds a lock.
    """
    for temporary in Path(folder).glob(f".{name if name == '*' else glob.escape(name)}.*.tmp"):
        with contextlib.suppress(OSError), open(temporary, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            temporary.unlink()


def _is_device(path):
    return path.exists() and (not path.is_file() or path.absolute().parts[1] in ("dev", "proc"))


def check_writable(path):
    """Raise ValueError if no file can be written at `path`. To be called before long work."""
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a directory, not a file")
    if _is_device(path):
        return
    try:
        tempfile.TemporaryFile(dir=path.absolute().parent).close()
        clear_leftovers(path.parent, path.name)
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error.strerror}") from error


def check_folder(path):
    """Raise ValueError unless files can be written in a folder, which may not be there yet."""
    path = Path(path)
    try:
        there = next(one for one in (path.absolute(), *path.absolute().parents) if one.exists())
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error.strerror}") from error
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{path}: {there} is no folder that can be written")


def check_archive(path):
    """Raise an exception if a file that `torch.save` wrote is damaged, which `torch.load` ignores.

    ValueError: one of its checksums does not match, or what is said of an entry is not what
    `torch.save` says. OSError, zipfile.BadZipFile: as `zipfile`.
    """
    with zipfile.ZipFile(path) as archive:
        # As torch writes it. What comes out is no larger than the file.
        stored = all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.filelist)
        if not stored or sum(entry.file_size for entry in archive.filelist) > path.stat().st_size:
            raise ValueError("it is compressed")
        if archive.testzip() is not None:
            raise ValueError("a checksum does not match")
        # Of an entry marked as a folder `torch.load` reads nothing: the tensor is what memory had.
        if any(entry.external_attr for entry in archive.filelist):
            raise ValueError("an entry is no plain file")
