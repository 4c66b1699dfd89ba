"""Writing files atomically, and checking that they can be written or are undamaged."""

import contextlib
import errno
import fcntl
import functools
import glob
import os
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


def cache_folder() -> Path:
    """The folder for files that can be made again. It may not exist yet.

    `$ROBOARM_NMP_CACHE`, by default `roboarm-nmp` in `$XDG_CACHE_HOME`, by default `~/.cache`.
    Raises OSError: there is no home folder.
    """
    folder = os.environ.get("ROBOARM_NMP_CACHE")
    if folder:
        return Path(folder).absolute()
    base = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(base):  # a relative path counts as none (XDG Base Directory Specification)
        return Path(base, "roboarm-nmp")
    try:
        return Path.home() / ".cache" / "roboarm-nmp"
    except RuntimeError as error:
        raise OSError(f"{error}; ROBOARM_NMP_CACHE may name a cache folder") from error


def write_atomically(path: str | Path, contents: bytes | memoryview) -> None:
    """Write bytes: at every moment, whatever happens, `path` is the old file or the whole new one.

    A device or a pipe, such as `/dev/stdout`, is written to directly. Raises OSError if the file
    cannot be written: an old file stays as it is, and no other file is left.
    """
    path = Path(path)
    if _is_device(path):
        with open(path, "ab") as file:  # /dev/stdout may be a file: nothing in it is lost
            file.write(contents)
        return
    with new_contents(path) as temporary:
        temporary.write_bytes(contents)


def lock_file(file: IO[bytes], wait: bool = True) -> bool:
    """Lock an open file until it is closed. Returns False if another process has it, and `wait` is.

    On a file system without locks (Lustre without `flock`, some NFS) it says so, once, and goes on:
    two processes must not write the same file there.

    Raises OSError: anything else is wrong.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        _warn_without_locks(str(Path(file.name).absolute().parent))
    return True


@functools.cache
def _warn_without_locks(folder):
    print(
        f"no file locks in {folder}: do not let two processes write the same file there",
        file=sys.stderr,
    )


@contextlib.contextmanager
def new_contents(path: str | Path) -> Iterator[Path]:
    """A context whose value is the path of an empty file, which replaces `path` at its end.

    The contents are first flushed to the disk: after a power cut too, `path` is the old file or the
    whole new one. After an exception it is the old one. Leftovers of killed processes are deleted.
    """
    path = Path(path)
    clear_leftovers(path.parent, path.name)
    while True:
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
        lock = open(temporary, "wb")  # noqa: SIM115 (closed below)
        lock_file(lock)
        if temporary.exists():  # otherwise another process took it for a leftover before the lock
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


def clear_leftovers(folder: str | Path, name: str | None = None) -> None:
    """Delete temporary files that killed processes left in a folder, of the file `name` or of all.

    A process that is still writing holds a lock.
    """
    pattern = "*" if name is None else glob.escape(name)
    for temporary in Path(folder).glob(f".{pattern}.*.tmp"):
        with contextlib.suppress(OSError), open(temporary, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            temporary.unlink()


def _is_device(path):
    return path.exists() and (not path.is_file() or path.absolute().parts[1] in ("dev", "proc"))


def check_writable(path: str | Path) -> None:
    """Raise ValueError if no file can be written at `path`. Call it before long work."""
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


def check_folder(path: str | Path) -> None:
    """Raise ValueError unless files can be written in a folder, which need not exist yet."""
    path = Path(path)
    try:
        folder = path.absolute()
        while not folder.exists():
            folder = folder.parent
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error.strerror}") from error
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{path}: {folder} is not a folder that can be written")


def check_archive(path: Path) -> None:
    """Detect damage in a file of `torch.save` that `torch.load` ignores.

    Raises:
        ValueError: a checksum does not match, or an entry is not of the kind that `torch.save`
            writes.
        OSError, zipfile.BadZipFile: as `zipfile`.
    """
    with zipfile.ZipFile(path) as archive:
        # Torch does not compress: the contents are no larger than the file.
        stored = all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.filelist)
        if not stored or sum(entry.file_size for entry in archive.filelist) > path.stat().st_size:
            raise ValueError("it is compressed")
        if archive.testzip() is not None:
            raise ValueError("a checksum does not match")
        # `torch.load` reads nothing of an entry that is marked as a folder: the tensor would be
        # uninitialised memory.
        if any(entry.external_attr for entry in archive.filelist):
            raise ValueError("an entry is not a plain file")


@contextlib.contextmanager
def temporary_file(text, suffix):
    """A context: the path of a file with this text."""
    with tempfile.NamedTemporaryFile("w", suffix=suffix, encoding="utf-8") as file:
        file.write(text)
        file.flush()
        yield file.name
