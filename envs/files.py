"""Writing files whole, and whether they still are."""

import os
import tempfile
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
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(contents)
        replace_atomically(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


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
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error.strerror}") from error


def replace_atomically(temporary, path):
    """Rename a file that is whole, in `path`'s folder, to `path`, which it replaces.

    What was written is brought to the disk first: after a power cut too, `path` is whole.
    """
    with open(temporary, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(temporary, path)


def check_archive(path):
    """Raise an exception if a file that `torch.save` wrote is damaged, which `torch.load` ignores.

    ValueError: one of its checksums does not match. OSError, zipfile.BadZipFile: as `zipfile`.
    """
    with zipfile.ZipFile(path) as archive:
        # As torch writes it. What comes out is no larger than the file.
        stored = all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.filelist)
        if not stored or sum(entry.file_size for entry in archive.filelist) > path.stat().st_size:
            raise ValueError("it is compressed")
        if archive.testzip() is not None:
            raise ValueError("a checksum does not match")
